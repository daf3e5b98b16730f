//! The exported policy: a folder with `policy.json` and `policy.safetensors` (half precision; single for means and standard deviations of
//! observations, and for policies brought from elsewhere).
//!
//! The JSON names the observation layout, the sizes, the log-variance clamp, the hashes of what the policy stands on (motion model,
//! body) and a golden pair: one observation and what the network says of it, computed again whenever the bundle is read.

use super::spec::OBS_NORM;
use super::{ActionSpace, Network, ObsLayout, PolicyConfig, PolicySpec};
use crate::io::{Precision, Tensors, pack_tensors_each, write_atomic};
use crate::kernels::PolicyEngine;
use crate::rng::stream;
use crate::{Error, Result};
use burn::tensor::Device;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

const FORMAT: u32 = 2;
/// File names within the folder.
pub const DESCRIPTION: &str = "policy.json";
pub const WEIGHTS: &str = "policy.safetensors";
/// Outputs may differ by this much (times 1 + their size) from one machine or implementation to another.
const TOLERANCE: f32 = 1e-4;

/// Where a policy comes from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trained {
    pub recipe: String,
    pub seed: u64,
    pub epoch: u64,
    pub env_steps: u64,
    /// Figures of the last test.
    pub test: BTreeMap<String, f64>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    format: u32,
    layout: ObsLayout,
    policy: PolicyConfig,
    action: ActionSpace,
    origin: BTreeMap<String, String>,
    trained: Trained,
    /// Content hash of the weights' file.
    weights: String,
    golden: Golden,
}

/// An observation and the network's outputs for it, from the weights as the file holds them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Golden {
    /// One row, in the order of the layout.
    obs: Vec<f32>,
    /// Means of the action, or logits of a discrete one.
    mu: Vec<f32>,
    /// Clamped; empty for discrete actions.
    logvar: Vec<f32>,
    value: f32,
}

/// What is read before all else, so that other formats are told by their number.
#[derive(Deserialize)]
struct Version {
    format: u32,
}

/// A policy ready to act, and what it stands on.
#[derive(Clone, Debug)]
pub struct Bundle {
    /// Sizes and layers.
    pub spec: Arc<PolicySpec>,
    /// Flat parameters, as the file holds them.
    pub params: Vec<f32>,
    /// Content hashes of what observations and actions stand on, e.g. "motion" and "body".
    pub origin: BTreeMap<String, String>,
    /// Where it comes from.
    pub trained: Trained,
    bytes: Vec<u8>,
}

impl Bundle {
    /// Packs a policy; its parameters are rounded to half precision, but for means and standard deviations of observations.
    pub fn new(spec: PolicySpec, params: &[f32], origin: BTreeMap<String, String>, trained: Trained) -> Result<Self> {
        Self::with_precision(spec, params, origin, trained, Precision::Half)
    }

    /// Packs a policy with what gradients have learned in that precision.
    pub fn with_precision(
        spec: PolicySpec,
        params: &[f32],
        origin: BTreeMap<String, String>,
        trained: Trained,
        precision: Precision,
    ) -> Result<Self> {
        // Means of observations may be far larger than their standard deviations.
        let precision = |name: &str| if OBS_NORM.contains(&name) { Precision::Full } else { precision };
        let bytes = pack_tensors_each(&spec.to_tensors(params), &BTreeMap::new(), precision)?;
        let params = spec.from_tensors(&Tensors::from_bytes(WEIGHTS, bytes.clone())?)?;
        Ok(Self { spec: Arc::new(spec), params, origin, trained, bytes })
    }

    /// Writes the folder; the description, which names the weights, last.
    pub fn write(&self, dir: &Path) -> Result<()> {
        let description = Description {
            format: FORMAT,
            layout: self.spec.layout.clone(),
            policy: self.spec.config.clone(),
            action: self.spec.action,
            origin: self.origin.clone(),
            trained: self.trained.clone(),
            weights: self.weights_hash(),
            golden: self.golden(self.golden_obs())?,
        };
        write_atomic(dir.join(WEIGHTS), &self.bytes)?;
        let text = serde_json::to_string_pretty(&description).map_err(|e| Error::invalid(format!("cannot describe the policy: {e}")))?;
        write_atomic(dir.join(DESCRIPTION), text.as_bytes())
    }

    /// Reads and checks a folder: format, layout version, sizes, hash of the weights, golden pair.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join(DESCRIPTION);
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
        let bad = |e: serde_json::Error| Error::file(&path, e.to_string());
        let Version { format } = serde_json::from_str(&text).map_err(bad)?;
        if format != FORMAT {
            let what = format!("format is {format}, expected {FORMAT}: export it again from its run (`export RUN --out DIR`)");
            return Err(Error::file(&path, what));
        }
        let d: Description = serde_json::from_str(&text).map_err(bad)?;
        let spec = PolicySpec::new(d.policy, d.layout, d.action).map_err(|e| Error::file(&path, e.to_string()))?;
        let weights = dir.join(WEIGHTS);
        let bytes = std::fs::read(&weights).map_err(|e| Error::io(&weights, e))?;
        if crate::io::content_hash(&bytes) != d.weights {
            return Err(Error::file(&weights, format!("is not the file that {DESCRIPTION} names: its content hash differs")));
        }
        let params = spec.from_tensors(&Tensors::from_bytes(&weights, bytes.clone())?)?;
        let bundle = Self { spec: Arc::new(spec), params, origin: d.origin, trained: d.trained, bytes };
        bundle.check_golden(&path, &d.golden)?;
        Ok(bundle)
    }

    /// Refuses when the policy was trained on another `what` (e.g. "motion") than the one with content hash `hash`.
    pub fn require(&self, what: &str, hash: &str) -> Result<()> {
        match self.origin.get(what) {
            Some(own) if own == hash => Ok(()),
            own => {
                let own = own.map_or("none", String::as_str);
                Err(Error::invalid(format!("the policy was trained on {what} {own}, but {what} {hash} is used here")))
            }
        }
    }

    /// The weights for a policy of these sizes; refused, naming the first difference, when this one has others.
    pub fn weights_for(&self, spec: &PolicySpec) -> Result<Vec<f32>> {
        let value = |s: &PolicySpec| serde_json::json!({"observation": s.layout, "policy": s.config, "action": s.action});
        match difference("", &value(spec), &value(&self.spec)) {
            Some(what) => Err(Error::invalid(what)),
            None => Ok(self.params.clone()),
        }
    }

    /// The policy on `device`.
    pub fn network(&self, device: &Device) -> Network {
        Network::new(&self.spec, &self.params, device)
    }

    /// Content hash of the weights' file.
    pub fn weights_hash(&self) -> String {
        crate::io::content_hash(&self.bytes)
    }

    /// Normal noise from stream (0, "golden observations"), spread like the observations where the policy knows how they are.
    fn golden_obs(&self) -> Vec<f32> {
        let dim = self.spec.layout.dim();
        let mut obs: Vec<f32> = StandardNormal.sample_iter(stream(0, "golden observations", 0)).take(dim).collect();
        let (mean, std) = self.params[self.spec.obs_norm_range()].split_at(self.spec.obs_norm_range().len() / 2);
        obs.iter_mut().zip(mean.iter().zip(std)).for_each(|(x, (m, s))| *x = m + s * *x);
        obs
    }

    fn golden(&self, obs: Vec<f32>) -> Result<Golden> {
        let engine = PolicyEngine::new(&self.spec, &self.params)?;
        let mut out = vec![0.0; engine.output_dim()];
        engine.forward(&obs, &mut out)?;
        let mut rest = out.split_off(self.spec.action.count());
        let value = rest[engine.value_at() - out.len()];
        rest.truncate(engine.value_at() - out.len());
        let logvar = rest;
        Ok(Golden { obs, mu: out, logvar, value })
    }

    fn check_golden(&self, path: &Path, want: &Golden) -> Result<()> {
        let dim = self.spec.layout.dim();
        if want.obs.len() != dim {
            return Err(Error::file(path, format!("golden.obs has {} numbers, the layout has {dim}", want.obs.len())));
        }
        let have = self.golden(want.obs.clone())?;
        let parts: [(&str, &[f32], &[f32]); 3] =
            [("mu", &have.mu, &want.mu), ("logvar", &have.logvar, &want.logvar), ("value", &[have.value], &[want.value])];
        for (name, have, want) in parts {
            if have.len() != want.len() {
                return Err(Error::file(path, format!("golden.{name} has {} numbers, expected {}", want.len(), have.len())));
            }
            let near = |(h, w): (&f32, &f32)| (h - w).abs() <= TOLERANCE * (1.0 + w.abs());
            if let Some(i) = have.iter().zip(want).position(|pair| !near(pair)) {
                return Err(Error::file(
                    path,
                    format!(
                        "golden.{name}[{i}] is {}, but the policy computes {} here (tolerance {TOLERANCE} x (1 + size)): the golden pair \
                         does not fit the weights, and the policy cannot be trusted",
                        want[i], have[i]
                    ),
                ));
            }
        }
        Ok(())
    }
}

/// The first entry in which what is wanted differs from what a bundle has.
fn difference(path: &str, wanted: &Value, has: &Value) -> Option<String> {
    let at = |key: &str| if path.is_empty() { key.to_string() } else { format!("{path}.{key}") };
    match (wanted, has) {
        (Value::Object(w), Value::Object(h)) => {
            let keys: BTreeSet<&String> = w.keys().chain(h.keys()).collect();
            keys.into_iter().find_map(|k| difference(&at(k), w.get(k).unwrap_or(&Value::Null), h.get(k).unwrap_or(&Value::Null)))
        }
        (Value::Array(w), Value::Array(h)) if w.len() == h.len() => {
            w.iter().zip(h).enumerate().find_map(|(i, (w, h))| difference(&at(&i.to_string()), w, h))
        }
        _ => (wanted != has).then(|| format!("{path} is {wanted} here, {has} in the bundle")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::ObsGroup;

    fn spec(config: &str) -> PolicySpec {
        let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
        let layout = ObsLayout::new(vec![group("state", &[2, 5]), group("dist", &[1])]);
        PolicySpec::new(serde_json::from_str(config).unwrap(), layout, 4).unwrap()
    }

    fn bundle() -> Bundle {
        let spec = spec(r#"{"gru": {"state": 6}, "octaves": 3}"#);
        let params = spec.init(1);
        let origin = BTreeMap::from([("motion".to_string(), "m1".to_string())]);
        Bundle::new(spec, &params, origin, Trained::default()).unwrap()
    }

    #[test]
    fn what_is_written_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let written = bundle();
        written.write(dir.path()).unwrap();
        let read = Bundle::read(dir.path()).unwrap();
        assert_eq!((&read.params, &read.spec, &read.origin), (&written.params, &written.spec, &written.origin));
        read.require("motion", "m1").unwrap();
        assert!(read.require("motion", "m2").unwrap_err().to_string().contains("trained on motion m1"));
        assert!(read.require("body", "b").is_err());
        assert_eq!(read.weights_for(&written.spec).unwrap(), written.params);
        let other = |config: &str, action: usize| {
            let spec = PolicySpec::new(serde_json::from_str(config).unwrap(), written.spec.layout.clone(), action).unwrap();
            read.weights_for(&spec).unwrap_err().to_string()
        };
        let error = other(r#"{"gru": {"state": 7}, "octaves": 3}"#, 4);
        assert!(error.contains("policy.gru.state is 7 here, 6 in the bundle"), "{error}");
        let error = other(r#"{"gru": {"state": 6}, "octaves": 3}"#, 5);
        assert!(error.contains("action is 5 here, 4 in the bundle"), "{error}");
    }

    #[test]
    fn how_observations_are_spread_stays_exact() {
        let spec = spec(r#"{"gru": {"state": 6}, "octaves": 3, "obs_norm": true}"#);
        let mut params = spec.init(1);
        let norm = spec.obs_norm_range();
        params[norm.start] = 2345.678;
        let bundle = Bundle::new(spec, &params, BTreeMap::new(), Trained::default()).unwrap();
        assert_eq!(bundle.params[norm.clone()], params[norm.clone()]);
        assert_ne!(bundle.params[..norm.start], params[..norm.start]);
        assert!(bundle.params.iter().zip(&params).all(|(a, b)| (a - b).abs() <= 1e-3 * b.abs().max(1e-3)));
    }

    #[test]
    fn tampering_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let refused = |change: &dyn Fn(String) -> String, word: &str| {
            bundle().write(dir.path()).unwrap();
            let path = dir.path().join(DESCRIPTION);
            let text = std::fs::read_to_string(&path).unwrap();
            let changed = change(text.clone());
            assert_ne!(text, changed);
            std::fs::write(&path, changed).unwrap();
            let error = Bundle::read(dir.path()).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        };
        refused(&|t| t.replacen("\"version\": 1", "\"version\": 2", 1), "layout version 2");
        refused(&|t| t.replacen("\"format\": 2", "\"format\": 9", 1), "format is 9");
        refused(&|_| "{\"format\": 1, \"golden\": {}}".into(), "export it again");
        // Another clamp gives other outputs; the weights are the same.
        refused(&|t| t.replacen("-2.5", "-1e-4", 1).replacen("2.5\n", "1e-4\n", 1), "golden.logvar");
        let golden = |part: &'static str, value: serde_json::Value| {
            move |text: String| {
                let mut d: serde_json::Value = serde_json::from_str(&text).unwrap();
                d["golden"][part] = value.clone();
                d.to_string()
            }
        };
        // Well beyond the tolerance.
        let want = bundle().golden(bundle().golden_obs()).unwrap();
        refused(&golden("value", (want.value + 3e-4 * (1.0 + want.value.abs())).into()), "golden.value[0]");
        refused(&golden("mu", vec![0.0; 3].into()), "golden.mu has 3 numbers, expected 4");
        refused(&golden("obs", vec![0.0; 10].into()), "golden.obs has 10 numbers, the layout has 11");
        let mut obs = want.obs;
        obs.reverse();
        refused(&golden("obs", obs.into()), "golden.mu");
        bundle().write(dir.path()).unwrap();
        let weights = dir.path().join(WEIGHTS);
        let mut bytes = std::fs::read(&weights).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&weights, bytes).unwrap();
        assert!(Bundle::read(dir.path()).unwrap_err().to_string().contains("content hash"));
    }
}
