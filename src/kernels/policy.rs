//! Acting: the policy network's forward pass.

use super::linear::dense;
use super::pool::{Pool, check, take};
use super::{Activation, GruCell, Linear, Source, View, ViewMut};
use crate::Result;
use crate::agent::{Encoder, Part, PolicySpec, SLOPE};

/// Most people of one task. Tens of megabytes of weights stream by for each task, so tasks are as large as the batch allows.
const ROWS: usize = 256;

/// Two residual layers each, then the output.
struct Head {
    blocks: Vec<[Linear; 2]>,
    out: Linear,
}

/// The policy with its weights packed; rebuilt after each update of the parameters.
pub struct PolicyEngine {
    spec: PolicySpec,
    /// One per encoder that is a GRU, in their order.
    cells: Vec<GruCell>,
    project: Option<Linear>,
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
        let head = |layers: &[usize]| -> Result<Head> {
            let blocks = layers.as_chunks::<2>().0.iter().map(|[a, b]| Ok([linear(*a)?, linear(*b)?]));
            Ok(Head { blocks: blocks.collect::<Result<_>>()?, out: linear(layers[layers.len() - 1])? })
        };
        Ok(Self {
            cells: spec.encoders.iter().filter_map(cell).collect::<Result<_>>()?,
            project: spec.project.map(linear).transpose()?,
            actor: head(&spec.actor)?,
            critic: head(&spec.critic)?,
            pool: Pool::default(),
            spec: spec.clone(),
        })
    }

    /// Floats that [`PolicyEngine::forward`] writes for a person: mean A, clamped log variance A, value 1.
    pub fn output_dim(&self) -> usize {
        2 * self.spec.action + 1
    }

    /// Means, log variances and values. `obs`: n x layout.dim(), `out`: n x output_dim().
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn forward(&self, obs: &[f32], out: &mut [f32]) -> Result<()> {
        let (width, actions) = (self.output_dim(), 2 * self.spec.action);
        let [low, high] = self.spec.config.logvar;
        self.run(obs, out, width, |rows, trunk, scratch, out| {
            let (h, inner) = scratch.split_at_mut(trunk.len());
            h.copy_from_slice(trunk);
            self.actor.run(rows, h, inner, ViewMut::new(out, width));
            h.copy_from_slice(trunk);
            self.critic.run(rows, h, inner, ViewMut::new(&mut out[actions..], width));
            for row in out.chunks_exact_mut(width) {
                row[self.spec.action..actions].iter_mut().for_each(|v| *v = v.clamp(low, high));
            }
        })
    }

    /// Values only. `obs`: n x layout.dim(), `out`: n.
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn values(&self, obs: &[f32], out: &mut [f32]) -> Result<()> {
        self.run(obs, out, 1, |rows, trunk, scratch, out| {
            let (h, inner) = scratch.split_at_mut(trunk.len());
            h.copy_from_slice(trunk);
            self.critic.run(rows, h, inner, ViewMut::new(out, 1));
        })
    }

    /// Calls `heads(rows, trunk, scratch of twice its size, out)` for blocks of people.
    fn run(&self, obs: &[f32], out: &mut [f32], width: usize, heads: impl Fn(usize, &[f32], &mut [f32], &mut [f32]) + Sync) -> Result<()> {
        let dim = self.spec.layout.dim();
        let people = obs.len() / dim;
        check("the observations", obs.len(), people * dim)?;
        check("the policy's output", out.len(), people * width)?;
        let (encoded, trunk) = (self.spec.encoded(), self.actor.out.inputs());
        let cell = self.cells.iter().map(|c| c.scratch(1) + c.size()).max().unwrap_or(0);
        let scratch = trunk + if self.project.is_some() { encoded } else { 0 } + cell.max(2 * trunk);
        self.pool.blocks(out, width, ROWS, scratch, |first, rows, out, mut scratch| {
            let trunk = take(&mut scratch, rows * trunk);
            let obs = &obs[first * dim..];
            match &self.project {
                Some(project) => {
                    let encodings = take(&mut scratch, rows * encoded);
                    self.encode(rows, obs, encodings, scratch);
                    dense(project, rows, encodings, trunk, Source::Fresh, Activation::None);
                }
                None => self.encode(rows, obs, trunk, scratch),
            }
            let len = 2 * trunk.len();
            heads(rows, trunk, &mut scratch[..len], out);
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
    /// `h`: the trunk, overwritten; `inner`: as large.
    fn run(&self, rows: usize, h: &mut [f32], inner: &mut [f32], out: ViewMut) {
        for [first, second] in &self.blocks {
            dense(first, rows, h, inner, Source::Fresh, Activation::LeakyRelu(SLOPE));
            dense(second, rows, inner, h, Source::Residual, Activation::LeakyRelu(SLOPE));
        }
        self.out.forward(rows, View::new(h, self.out.inputs()), out, Source::Fresh, Activation::None);
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

    #[test]
    fn matches_burn() {
        for trunk in [None, Some(33)] {
            let spec = spec(trunk);
            let (people, flat) = (29, noise(spec.params(), 1, 0.3));
            let obs = noise(people * spec.layout.dim(), 2, 1.0);
            let engine = PolicyEngine::new(&spec, &flat).unwrap();
            let (mut out, mut values) = (vec![f32::NAN; people * 13], vec![f32::NAN; people]);
            engine.forward(&obs, &mut out).unwrap();
            engine.values(&obs, &mut values).unwrap();
            let want = Network::new(&spec, &flat, &burn::tensor::Device::flex()).forward(&obs);
            let floats = |data: burn::tensor::TensorData| data.try_to_vec::<f32>().unwrap();
            let (mu, logvar, value) = (floats(want.mu.into_data()), floats(want.logvar.into_data()), floats(want.value.into_data()));
            let close = |a: f32, b: f32| assert!((a - b).abs() < 2e-5 * (1.0 + b.abs()), "{a}, burn says {b}");
            for (p, row) in out.chunks_exact(13).enumerate() {
                (0..6).for_each(|i| close(row[i], mu[6 * p + i]));
                (0..6).for_each(|i| close(row[6 + i], logvar[6 * p + i]));
                close(row[12], value[p]);
                assert_eq!(row[12], values[p]);
            }
            assert!(logvar.contains(&0.05) && logvar.contains(&-0.05) && logvar.iter().any(|v| v.abs() < 0.05), "the clamp is not tested");
        }
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
