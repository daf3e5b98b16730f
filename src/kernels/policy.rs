//! Acting: the policy network's forward pass.

use super::linear::dense;
use super::pool::{Pool, check, take};
use super::{Activation, GruCell, Linear, Source, View, ViewMut};
use crate::Result;
use crate::agent::{ActionSpace, Encoder, Nonlinearity, Part, PolicySpec, SLOPE, state_logvar};

/// Most people of one task. Tens of megabytes of weights stream by for each task, so tasks are as large as the batch allows.
const ROWS: usize = 256;

/// Residual blocks of two layers each or plain layers, then the output.
struct Head {
    blocks: Vec<[Linear; 2]>,
    plain: Vec<(Linear, Activation)>,
    out: Linear,
}

/// The policy with its weights packed; rebuilt after each update of the parameters.
pub struct PolicyEngine {
    spec: PolicySpec,
    /// One per encoder that is a GRU, in their order.
    cells: Vec<GruCell>,
    /// The projection and the shared plain layers.
    stem: Vec<(Linear, Activation)>,
    /// Log variances that do not depend on the observation.
    logvar: Vec<f32>,
    /// Variances of the entries of E, where noise depends on the state.
    noise: Vec<f32>,
    /// Means and standard deviations of observations.
    obs_norm: Vec<f32>,
    actor: Head,
    critic: Head,
    pool: Pool,
}

impl PolicyEngine {
    /// Packs the flat parameters.
    ///
    /// # Errors
    /// If `flat` is not as long as `spec.params()`.
    pub fn new(spec: &PolicySpec, flat: &[f32]) -> Result<Self> {
        check("the parameter vector", flat.len(), spec.params())?;
        let linear = |layer: usize| {
            let d = &spec.layers[layer];
            Linear::new(d.weight_of(flat), d.bias_of(flat), d.input)
        };
        let cell = |e: &Encoder| {
            let Part::Gru { width, ih, hh, .. } = e.part else { return None };
            let (ih, hh) = (&spec.layers[ih], &spec.layers[hh]);
            Some(GruCell::new(ih.weight_of(flat), hh.weight_of(flat), ih.bias_of(flat), hh.bias_of(flat), width))
        };
        let activation = match spec.config.activation {
            Nonlinearity::Tanh => Activation::Tanh,
            Nonlinearity::Relu => Activation::Relu,
        };
        let plain = |layer: &usize| Ok((linear(*layer)?, activation));
        let head = |layers: &[usize]| -> Result<Head> {
            let (out, inner) = (linear(layers[layers.len() - 1])?, &layers[..layers.len() - 1]);
            if !spec.config.hidden.is_empty() {
                return Ok(Head { blocks: vec![], plain: inner.iter().map(plain).collect::<Result<_>>()?, out });
            }
            let blocks = inner.as_chunks::<2>().0.iter().map(|[a, b]| Ok([linear(*a)?, linear(*b)?]));
            Ok(Head { blocks: blocks.collect::<Result<_>>()?, plain: vec![], out })
        };
        let project = spec.project.map(|i| Ok((linear(i)?, Activation::None)));
        Ok(Self {
            cells: spec.encoders.iter().filter_map(cell).collect::<Result<_>>()?,
            stem: project.into_iter().chain(spec.shared.iter().map(plain)).collect::<Result<_>>()?,
            logvar: spec.free_logvar(flat),
            noise: spec.noise_variances(flat),
            obs_norm: flat[spec.obs_norm_range()].to_vec(),
            actor: head(&spec.actor)?,
            critic: head(&spec.critic)?,
            pool: Pool::default(),
            spec: spec.clone(),
        })
    }

    /// Floats that [`PolicyEngine::forward`] writes for a person: mean A and clamped log variance A, or logits K; then value 1; then,
    /// where noise depends on the state, the actor's last hidden activations.
    pub fn output_dim(&self) -> usize {
        self.value_at() + 1 + if self.noise.is_empty() { 0 } else { self.spec.latent() }
    }

    /// Where the value lies among them.
    pub fn value_at(&self) -> usize {
        match self.spec.action {
            ActionSpace::Continuous(n) => 2 * n,
            ActionSpace::Discrete(k) => k,
        }
    }

    /// Means and log variances (or logits) and values. `obs`: n x layout.dim(), `out`: n x output_dim().
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn forward(&self, obs: &[f32], out: &mut [f32]) -> Result<()> {
        let (width, at) = (self.output_dim(), self.value_at());
        let logvars = self.spec.action.count()..at;
        let [low, high] = self.spec.config.logvar;
        self.run(obs, out, width, |rows, trunk, scratch, out| {
            let latent = self.actor.run(rows, trunk, scratch, ViewMut::new(out, width));
            if !self.noise.is_empty() {
                for (row, latent) in out.chunks_exact_mut(width).zip(latent.chunks_exact(self.spec.latent())) {
                    row[at + 1..].copy_from_slice(latent);
                    state_logvar(latent, &self.noise, &mut row[logvars.clone()]);
                }
            }
            self.critic.run(rows, trunk, scratch, ViewMut::new(&mut out[at..], width));
            for row in out.chunks_exact_mut(width).filter(|_| self.noise.is_empty()) {
                let row = &mut row[logvars.clone()];
                match self.logvar.is_empty() {
                    true => row.iter_mut().for_each(|v| *v = v.clamp(low, high)),
                    false => row.copy_from_slice(&self.logvar),
                }
            }
        })
    }

    /// Values only. `obs`: n x layout.dim(), `out`: n.
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn values(&self, obs: &[f32], out: &mut [f32]) -> Result<()> {
        self.run(obs, out, 1, |rows, trunk, scratch, out| {
            self.critic.run(rows, trunk, scratch, ViewMut::new(out, 1));
        })
    }

    /// Calls `heads(rows, trunk, scratch, out)` for blocks of people.
    fn run(&self, obs: &[f32], out: &mut [f32], width: usize, heads: impl Fn(usize, &[f32], &mut [f32], &mut [f32]) + Sync) -> Result<()> {
        let dim = self.spec.layout.dim();
        let people = obs.len() / dim;
        check("the observations", obs.len(), people * dim)?;
        check("the policy's output", out.len(), people * width)?;
        let obs = &*self.spec.normalised(&self.obs_norm, obs);
        let encoded = self.spec.encoded();
        let trunk = self.stem.last().map_or(encoded, |(layer, _)| layer.outputs());
        let wide = self.stem.iter().fold(encoded, |w, (layer, _)| w.max(layer.outputs()));
        let cell = self.cells.iter().map(|c| c.scratch(1) + c.size()).max().unwrap_or(0);
        let heads_scratch = 2 * self.actor.wide().max(self.critic.wide());
        let scratch = wide * if self.stem.is_empty() { 1 } else { 2 } + cell.max(heads_scratch);
        self.pool.blocks(out, width, ROWS, scratch, |first, rows, out, mut scratch| {
            let mut from = take(&mut scratch, rows * wide);
            let mut to = take(&mut scratch, if self.stem.is_empty() { 0 } else { rows * wide });
            self.encode(rows, &obs[first * dim..], &mut from[..rows * encoded], scratch);
            for (layer, activation) in &self.stem {
                let size = rows * layer.outputs();
                dense(layer, rows, from, &mut to[..size], Source::Fresh, *activation);
                std::mem::swap(&mut from, &mut to);
            }
            heads(rows, &from[..rows * trunk], &mut scratch[..rows * heads_scratch], out);
        });
        Ok(())
    }

    /// The concatenated encodings, rows x encoded.
    fn encode(&self, rows: usize, obs: &[f32], out: &mut [f32], scratch: &mut [f32]) {
        let (dim, encoded) = (self.spec.layout.dim(), self.spec.encoded());
        let (mut cells, mut at) = (self.cells.iter(), 0);
        for encoder in &self.spec.encoders {
            let columns = at..at + encoder.output;
            at = columns.end;
            let people = out.chunks_exact_mut(encoded).zip(obs[encoder.start..].chunks(dim));
            match encoder.part {
                Part::Gru { frames, .. } => {
                    let Some(cell) = cells.next() else { continue };
                    let (h, scratch) = scratch.split_at_mut(rows * cell.size());
                    cell.encode(rows, frames, View::new(&obs[encoder.start..], dim), h, scratch);
                    people.zip(h.chunks_exact(cell.size())).for_each(|((out, _), h)| out[columns.clone()].copy_from_slice(h));
                }
                Part::Sine => {
                    let mut angles = Vec::with_capacity(encoder.output);
                    for (out, obs) in people {
                        angles.clear();
                        self.spec.sine(obs[0], &mut angles);
                        out[columns.clone()].copy_from_slice(&angles);
                    }
                }
                Part::Plain { width } => people.for_each(|(out, obs)| out[columns.clone()].copy_from_slice(&obs[..width])),
            }
        }
    }
}

impl Head {
    /// Floats of the widest layer's input or output, the last output aside.
    fn wide(&self) -> usize {
        self.plain.iter().map(|(layer, _)| layer.inputs().max(layer.outputs())).fold(self.out.inputs(), usize::max)
    }

    /// `scratch`: at least rows x 2 [`Head::wide`]. Gives the last hidden activations, row after row.
    fn run<'s>(&self, rows: usize, trunk: &[f32], scratch: &'s mut [f32], out: ViewMut) -> &'s [f32] {
        let (mut h, mut inner) = scratch[..2 * rows * self.wide()].split_at_mut(rows * self.wide());
        h[..trunk.len()].copy_from_slice(trunk);
        for (layer, activation) in &self.plain {
            let size = rows * layer.outputs();
            dense(layer, rows, h, &mut inner[..size], Source::Fresh, *activation);
            std::mem::swap(&mut h, &mut inner);
        }
        for [first, second] in &self.blocks {
            dense(first, rows, h, inner, Source::Fresh, Activation::LeakyRelu(SLOPE));
            dense(second, rows, inner, h, Source::Residual, Activation::LeakyRelu(SLOPE));
        }
        self.out.forward(rows, View::new(h, self.out.inputs()), out, Source::Fresh, Activation::None);
        &h[..rows * self.out.inputs()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::{Network, ObsGroup, ObsLayout, PolicyConfig};
    use rand::RngExt;

    fn spec(trunk: Option<usize>) -> PolicySpec {
        let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
        let layout = ObsLayout::new(vec![group("state", &[2, 21]), group("dist", &[1]), group("plain", &[5]), group("rays", &[3, 7])]);
        let config: PolicyConfig = serde_json::from_value(serde_json::json!({
            "gru": {"state": 18, "rays": 9}, "octaves": 4, "trunk": trunk, "logvar": [-0.05, 0.05]
        }))
        .unwrap();
        PolicySpec::new(config, layout, 6).unwrap()
    }

    fn noise(n: usize, seed: u64, size: f32) -> Vec<f32> {
        let mut rng = crate::rng::stream(seed, "policy kernels", 0);
        (0..n).map(|_| rng.random_range(-size..size)).collect()
    }

    /// The engine against burn: every output of 29 people, and log variances on both sides of the clamp where they vary.
    fn compare(spec: &PolicySpec) -> Vec<f32> {
        let (people, flat) = (29, noise(spec.params(), 1, 0.3));
        let obs = noise(people * spec.layout.dim(), 2, 1.0);
        let engine = PolicyEngine::new(spec, &flat).unwrap();
        let (width, count) = (engine.output_dim(), spec.action.count());
        let (mut out, mut values) = (vec![f32::NAN; people * width], vec![f32::NAN; people]);
        engine.forward(&obs, &mut out).unwrap();
        engine.values(&obs, &mut values).unwrap();
        let want = Network::new(spec, &flat, &burn::tensor::Device::flex()).forward(&obs);
        let floats = |data: burn::tensor::TensorData| data.try_to_vec::<f32>().unwrap();
        let (mu, value) = (floats(want.mu.into_data()), floats(want.value.into_data()));
        let latent = floats(want.latent.into_data());
        let logvar = want.logvar.map(|v| floats(v.into_data())).unwrap_or_default();
        let close = |a: f32, b: f32| assert!((a - b).abs() < 2e-5 * (1.0 + b.abs()), "{a}, burn says {b}");
        for (p, row) in out.chunks_exact(width).enumerate() {
            (0..count).for_each(|i| close(row[i], mu[count * p + i]));
            row[count..engine.value_at()].iter().zip(logvar.chunks_exact(count).nth(p).unwrap_or(&[])).for_each(|(a, b)| close(*a, *b));
            let at = engine.value_at();
            close(row[at], value[p]);
            assert_eq!(row[at], values[p]);
            row[at + 1..].iter().zip(latent.chunks_exact(spec.latent()).nth(p).unwrap()).for_each(|(a, b)| close(*a, *b));
        }
        logvar
    }

    #[test]
    fn matches_burn() {
        for trunk in [None, Some(33)] {
            let logvar = compare(&spec(trunk));
            assert!(logvar.contains(&0.05) && logvar.contains(&-0.05) && logvar.iter().any(|v| v.abs() < 0.05), "the clamp is not tested");
        }
    }

    #[test]
    fn plain_layers_match_burn() {
        let layout = ObsLayout::new(vec![ObsGroup { name: "state".into(), shape: vec![7] }, ObsGroup { name: "x".into(), shape: vec![1] }]);
        let make = |config: serde_json::Value, action: ActionSpace| {
            PolicySpec::new(serde_json::from_value(config).unwrap(), layout.clone(), action).unwrap()
        };
        let free = serde_json::json!({"octaves": 2, "hidden": [9, 40, 5], "log_std": -0.05, "logvar": [-0.2, 0.3], "obs_norm": true});
        let logvar = compare(&make(free, ActionSpace::Continuous(3)));
        assert_eq!(logvar.len(), 29 * 3);
        let noisy = serde_json::json!({"octaves": 2, "hidden": [9, 6], "state_noise": {"log_std": -1.0, "steps": 4}});
        assert_eq!(compare(&make(noisy, ActionSpace::Continuous(3))).len(), 29 * 3);
        let blocks = serde_json::json!({"octaves": 2, "trunk": 8, "state_noise": {"log_std": -1.0, "steps": 4}});
        assert_eq!(compare(&make(blocks, ActionSpace::Continuous(2))).len(), 29 * 2);
        let shared = serde_json::json!({"octaves": 2, "trunk": 6, "hidden": [20, 11], "activation": "relu", "shared": true});
        assert!(compare(&make(shared, ActionSpace::Discrete(4))).is_empty());
    }

    #[test]
    fn wrong_lengths_are_refused() {
        let spec = spec(None);
        assert!(PolicyEngine::new(&spec, &[0.0; 3]).is_err());
        let engine = PolicyEngine::new(&spec, &vec![0.0; spec.params()]).unwrap();
        assert!(engine.forward(&[0.0; 3], &mut []).is_err());
        assert!(engine.forward(&vec![0.0; spec.layout.dim()], &mut [0.0; 12]).is_err());
    }
}
