//! The exported policy: a folder with `policy.json` and `policy.safetensors` (half precision, or single
//! where the policy normalises observations).
//!
//! The JSON names the observation layout, the sizes, the log-variance clamp, the hashes of what the policy stands on (motion model,
//! body) and a golden pair: outputs for a fixed input, computed again whenever the bundle is read.

use super::{ActionSpace, Network, ObsLayout, PolicyConfig, PolicySpec};
use crate::io::{Precision, Tensors, pack_tensors, write_atomic};
use crate::rng::stream;
use crate::{Error, Result};
use burn::tensor::{Device, Tensor};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

const FORMAT: u32 = 1;
/// File names within the folder.
pub const DESCRIPTION: &str = "policy.json";
pub const WEIGHTS: &str = "policy.safetensors";
/// Observations of the golden pair.
const GOLDEN: usize = 2;
/// Outputs may differ by this much (times 1 + their size) from one machine or device to another.
const TOLERANCE: f32 = 1e-3;

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

/// Outputs for [`GOLDEN`] rows of normal noise from stream (0, "golden observations").
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Golden {
    mu: Vec<f32>,
    logvar: Vec<f32>,
    value: Vec<f32>,
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
    /// Packs a policy; its parameters are rounded to half precision, unless it normalises observations.
    pub fn new(spec: PolicySpec, params: &[f32], origin: BTreeMap<String, String>, trained: Trained) -> Result<Self> {
        // Means of observations may be far larger than their standard deviations.
        let precision = if spec.obs_norm.is_some() { Precision::Full } else { Precision::Half };
        let bytes = pack_tensors(&spec.to_tensors(params), &BTreeMap::new(), precision)?;
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
            weights: crate::io::content_hash(&self.bytes),
            golden: self.golden(),
        };
        write_atomic(dir.join(WEIGHTS), &self.bytes)?;
        let text = serde_json::to_string_pretty(&description).map_err(|e| Error::invalid(format!("cannot describe the policy: {e}")))?;
        write_atomic(dir.join(DESCRIPTION), text.as_bytes())
    }

    /// Reads and checks a folder: format, layout version, sizes, hash of the weights, golden pair.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join(DESCRIPTION);
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
        let d: Description = serde_json::from_str(&text).map_err(|e| Error::file(&path, e.to_string()))?;
        if d.format != FORMAT {
            return Err(Error::file(&path, format!("format is {}, expected {FORMAT}", d.format)));
        }
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

    /// The policy on `device`.
    pub fn network(&self, device: &Device) -> Network {
        Network::new(&self.spec, &self.params, device)
    }

    fn golden(&self) -> Golden {
        let rows = GOLDEN * self.spec.layout.dim();
        let obs: Vec<f32> = StandardNormal.sample_iter(stream(0, "golden observations", 0)).take(rows).collect();
        let out = self.network(&Device::flex()).forward(&obs);
        Golden { mu: floats(out.mu), logvar: out.logvar.map(floats).unwrap_or_default(), value: floats(out.value) }
    }

    fn check_golden(&self, path: &Path, want: &Golden) -> Result<()> {
        let have = self.golden();
        for (name, have, want) in [("mu", have.mu, &want.mu), ("logvar", have.logvar, &want.logvar), ("value", have.value, &want.value)] {
            let near = |(h, w): (&f32, &f32)| (h - w).abs() <= TOLERANCE * (1.0 + w.abs());
            if have.len() != want.len() || !have.iter().zip(want).all(near) {
                return Err(Error::file(path, format!("golden.{name} is not what the policy computes here; the policy cannot be trusted")));
            }
        }
        Ok(())
    }
}

fn floats<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::ObsGroup;

    fn bundle() -> Bundle {
        let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
        let layout = ObsLayout::new(vec![group("state", &[2, 5]), group("dist", &[1])]);
        let config = serde_json::from_str(r#"{"gru": {"state": 6}, "octaves": 3}"#).unwrap();
        let spec = PolicySpec::new(config, layout, 4).unwrap();
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
        refused(&|t| t.replacen("\"format\": 1", "\"format\": 9", 1), "format is 9");
        // Another clamp gives other outputs; the weights are the same.
        refused(&|t| t.replacen("-2.5", "-0.01", 1).replacen("2.5\n", "0.01\n", 1), "golden.logvar");
        bundle().write(dir.path()).unwrap();
        let weights = dir.path().join(WEIGHTS);
        let mut bytes = std::fs::read(&weights).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&weights, bytes).unwrap();
        assert!(Bundle::read(dir.path()).unwrap_err().to_string().contains("content hash"));
    }
}
