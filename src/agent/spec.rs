//! Sizes of a policy: what it sees, its layers, and where each layer's weights lie in one flat vector.
//!
//! | tensor | shape | |
//! |---|---|---|
//! | `encoder.<group>.weight_ih_l0`, `bias_ih_l0` | (3H, F), (3H) | GRU over a sequence group, gates in the order r, z, n |
//! | `encoder.<group>.weight_hh_l0`, `bias_hh_l0` | (3H, H), (3H) | |
//! | `project.weight`, `project.bias` | (trunk, E), (trunk) | only with [`PolicyConfig::trunk`] |
//! | `shared.<i>.weight`, `.bias` | (W', W), (W') | plain layers before both heads, with [`PolicyConfig::shared`] |
//! | `actor.<b>.<0 or 1>.weight`, `.bias` | (W, W), (W) | h = block(h) + h, block = two leaky ReLU layers |
//! | `actor.<i>.weight`, `.bias` | (W', W), (W') | plain layers instead, with [`PolicyConfig::hidden`] |
//! | `actor.out.weight`, `.bias` | (2A, W), (2A) | mean, then log variance before the clamp |
//! | | (A, W), (A) | the mean alone, with [`PolicyConfig::log_std`] or [`PolicyConfig::state_noise`] |
//! | | (K, W), (K) | logits of K discrete actions |
//! | `critic.<b>.<0 or 1>` or `critic.<i>`, `critic.out` | (W, W), (1, W) | |
//! | `actor.log_std` | (A) | log standard deviation before the clamp, with [`PolicyConfig::log_std`] |
//! | | (W, A) | of the entries of E, with [`PolicyConfig::state_noise`] |
//! | `obs.mean`, `obs.std` | (D), (D) | of all observations seen, with [`PolicyConfig::obs_norm`]; not learned by gradients |
//!
//! Layouts are torch's: `weight` is (out, in) row-major, y = W x + b.

use super::config::check;
use super::{ActionSpace, ObsGroup, ObsLayout, PolicyConfig};
use crate::io::Tensors;
use crate::{Error, Result};
use std::borrow::Cow;

/// Scalar groups are encoded; this is their width.
const SCALAR: usize = 1;
/// Tensor name of [`PolicySpec::log_std`].
const LOG_STD: &str = "actor.log_std";
/// Tensor names of [`PolicySpec::obs_norm`].
pub(super) const OBS_NORM: [&str; 2] = ["obs.mean", "obs.std"];
/// Normalised observations are cut to plus and minus this.
const OBS_MAX: f32 = 10.0;

/// Where a layer's weights lie in the flat parameter vector; the bias follows the weight.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dense {
    /// Tensor name of the weight (output, input).
    pub weight: String,
    /// Tensor name of the bias (output).
    pub bias: String,
    /// Inputs.
    pub input: usize,
    /// Outputs.
    pub output: usize,
    /// First float of the weight.
    pub offset: usize,
}

impl Dense {
    /// Floats of weight and bias.
    pub fn params(&self) -> usize {
        self.output * (self.input + 1)
    }

    /// The weight within the flat vector.
    pub fn weight_of<'a>(&self, flat: &'a [f32]) -> &'a [f32] {
        &flat[self.offset..self.offset + self.output * self.input]
    }

    /// The bias within the flat vector.
    pub fn bias_of<'a>(&self, flat: &'a [f32]) -> &'a [f32] {
        &flat[self.offset + self.output * self.input..self.offset + self.params()]
    }
}

/// How one observation group enters the trunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// Last hidden state of a GRU over `frames` rows of `width`; layers `ih` and `hh` by index.
    Gru { frames: usize, width: usize, ih: usize, hh: usize },
    /// sin and cos of the scalar's octaves.
    Sine,
    /// The vector itself.
    Plain { width: usize },
}

/// One observation group: where it starts in a row, how it is encoded, and to how many floats.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Encoder {
    pub start: usize,
    pub part: Part,
    pub output: usize,
}

/// A checked policy: its layers and encoders for one observation layout and action width.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicySpec {
    pub config: PolicyConfig,
    pub layout: ObsLayout,
    /// What an action is.
    pub action: ActionSpace,
    /// Encoders in the order of the groups, which is the order of the concatenation.
    pub encoders: Vec<Encoder>,
    /// All layers, in the order of the flat vector.
    pub layers: Vec<Dense>,
    /// Index of the projection in `layers`.
    pub project: Option<usize>,
    /// Indices of the plain layers before both heads.
    pub shared: Vec<usize>,
    /// Indices of the actor's layers: two per block or the plain ones, then the output.
    pub actor: Vec<usize>,
    /// Indices of the critic's layers.
    pub critic: Vec<usize>,
    /// First float of the log standard deviations that are parameters.
    pub log_std: Option<usize>,
    /// First float of the observations' means and standard deviations, which lie behind all that is learned.
    pub obs_norm: Option<usize>,
}

impl PolicySpec {
    /// Checks the sizes and lays out all layers. A number as `action` is the floats of a continuous one.
    pub fn new(config: PolicyConfig, layout: ObsLayout, action: impl Into<ActionSpace>) -> Result<Self> {
        let action = action.into();
        check(&config, &layout, action)?;
        let (encoders, layers, project, log_std, obs_norm) = (vec![], vec![], None, None, None);
        let (shared, actor, critic) = (vec![], vec![], vec![]);
        let mut spec = Self { config, layout, action, encoders, layers, project, shared, actor, critic, log_std, obs_norm };
        let mut start = 0;
        for group in spec.layout.groups.clone() {
            let encoder = spec.encoder(&group, start);
            start += group.len();
            spec.encoders.push(encoder);
        }
        let encoded = spec.encoders.iter().map(|e| e.output).sum();
        let mut trunk = spec.config.trunk.unwrap_or(encoded);
        if spec.config.trunk.is_some() {
            spec.project = Some(spec.dense("project", encoded, trunk));
        }
        if spec.config.shared {
            (spec.shared, trunk) = spec.plain("shared", trunk);
        }
        spec.actor = spec.head("actor", trunk, spec.outputs());
        spec.critic = spec.head("critic", trunk, 1);
        spec.log_std = (spec.config.log_std.is_some() || spec.config.state_noise.is_some()).then(|| spec.params());
        spec.obs_norm = spec.config.obs_norm.then(|| spec.params());
        Ok(spec)
    }

    /// Floats the actor gives: means and log variances, means alone, or logits.
    pub fn outputs(&self) -> usize {
        match self.action {
            ActionSpace::Continuous(n) if self.config.log_std.is_none() && self.config.state_noise.is_none() => 2 * n,
            _ => self.action.count(),
        }
    }

    /// Where [`PolicySpec::log_std`] lies; empty where there is none.
    pub fn log_std_range(&self) -> std::ops::Range<usize> {
        self.log_std.map_or(0..0, |at| at..at + self.log_std_shape().iter().product::<usize>())
    }

    fn log_std_shape(&self) -> Vec<usize> {
        let latent = self.config.state_noise.map(|_| self.latent());
        latent.into_iter().chain([self.action.count()]).collect()
    }

    /// Width of the actor's last hidden activations.
    pub fn latent(&self) -> usize {
        self.actor.last().map_or(0, |&out| self.layers[out].input)
    }

    /// Variances of the entries of E (latent x A); empty without [`PolicyConfig::state_noise`].
    pub fn noise_variances(&self, flat: &[f32]) -> Vec<f32> {
        let range = if self.config.state_noise.is_some() { self.log_std_range() } else { 0..0 };
        flat[range].iter().map(|s| (2.0 * s).exp()).collect()
    }

    /// Floats that gradients move; they come first.
    pub fn learned(&self) -> usize {
        self.obs_norm.unwrap_or(self.params())
    }

    /// Where means and then standard deviations of the observations lie; empty where there are none.
    pub fn obs_norm_range(&self) -> std::ops::Range<usize> {
        self.obs_norm.map_or(0..0, |at| at..at + 2 * self.layout.dim())
    }

    /// Observation rows as the network gets them; `norm` is what lies at [`PolicySpec::obs_norm_range`].
    pub fn normalised<'a>(&self, norm: &[f32], obs: &'a [f32]) -> Cow<'a, [f32]> {
        if norm.is_empty() {
            return Cow::Borrowed(obs);
        }
        let (mean, std) = norm.split_at(norm.len() / 2);
        let mut all = Vec::with_capacity(obs.len());
        for row in obs.chunks_exact(mean.len()) {
            all.extend(row.iter().zip(mean).zip(std).map(|((x, m), s)| ((x - m) / s).clamp(-OBS_MAX, OBS_MAX)));
        }
        Cow::Owned(all)
    }

    /// The clamped log variances that do not depend on the observation; empty where they do.
    pub fn free_logvar(&self, flat: &[f32]) -> Vec<f32> {
        let [low, high] = self.config.logvar;
        let range = if self.config.state_noise.is_none() { self.log_std_range() } else { 0..0 };
        flat[range].iter().map(|s| (2.0 * s).clamp(low, high)).collect()
    }

    /// Floats of all parameters.
    pub fn params(&self) -> usize {
        self.layers.iter().map(Dense::params).sum::<usize>() + self.log_std_range().len() + self.obs_norm_range().len()
    }

    /// Width of the concatenated encodings.
    pub fn encoded(&self) -> usize {
        self.encoders.iter().map(|e| e.output).sum()
    }

    /// The flat vector as named tensors.
    pub fn to_tensors(&self, flat: &[f32]) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let named = |d: &Dense| {
            [
                (d.weight.clone(), vec![d.output, d.input], d.weight_of(flat).to_vec()),
                (d.bias.clone(), vec![d.output], d.bias_of(flat).to_vec()),
            ]
        };
        let log_std = self.log_std.map(|_| (LOG_STD.to_string(), self.log_std_shape(), flat[self.log_std_range()].to_vec()));
        let norm = flat[self.obs_norm_range()].chunks(self.layout.dim()).zip(OBS_NORM);
        let norm = norm.map(|(v, name)| (name.to_string(), vec![v.len()], v.to_vec()));
        self.layers.iter().flat_map(named).chain(log_std).chain(norm).collect()
    }

    /// The flat vector from named tensors of exactly these layers.
    pub fn from_tensors(&self, tensors: &Tensors) -> Result<Vec<f32>> {
        let mut flat = Vec::with_capacity(self.params());
        for d in &self.layers {
            flat.extend(tensors.f32s(&d.weight, &[d.output, d.input])?);
            flat.extend(tensors.f32s(&d.bias, &[d.output])?);
        }
        if self.log_std.is_some() {
            flat.extend(tensors.f32s(LOG_STD, &self.log_std_shape())?);
        }
        let extras: Vec<&str> = self.log_std.map(|_| LOG_STD).into_iter().chain(self.obs_norm.iter().flat_map(|_| OBS_NORM)).collect();
        for name in self.obs_norm.iter().flat_map(|_| OBS_NORM) {
            flat.extend(tensors.f32s(name, &[self.layout.dim()])?);
        }
        let known = |name: &String| extras.contains(&name.as_str()) || self.layers.iter().any(|d| d.weight == *name || d.bias == *name);
        match tensors.names().into_iter().find(|n| !known(n)) {
            Some(name) => Err(Error::file(tensors.origin(), format!("tensor '{name}' has no place in this policy"))),
            None => Ok(flat),
        }
    }

    /// Encoded scalar: sin(2^k x) for all k, then cos(2^k x).
    pub fn sine(&self, x: f32, out: &mut Vec<f32>) {
        let angle = |k: usize| x * (k as f32).exp2();
        out.extend((0..self.config.octaves).map(|k| angle(k).sin()));
        out.extend((0..self.config.octaves).map(|k| angle(k).cos()));
    }

    fn encoder(&mut self, group: &ObsGroup, start: usize) -> Encoder {
        match *group.shape.as_slice() {
            [frames, width] => {
                let hidden = self.config.gru[&group.name];
                let mut gate = |part: &str, input: usize| {
                    let name = |kind: &str| format!("encoder.{}.{kind}_{part}_l0", group.name);
                    self.push(name("weight"), name("bias"), input, 3 * hidden)
                };
                let (ih, hh) = (gate("ih", width), gate("hh", hidden));
                Encoder { start, part: Part::Gru { frames, width, ih, hh }, output: hidden }
            }
            [SCALAR] => Encoder { start, part: Part::Sine, output: 2 * self.config.octaves },
            _ => {
                let width = group.shape.iter().product();
                Encoder { start, part: Part::Plain { width }, output: width }
            }
        }
    }

    fn head(&mut self, name: &str, width: usize, output: usize) -> Vec<usize> {
        let (mut layers, mut last) = (vec![], width);
        if self.config.hidden.is_empty() {
            for block in 0..self.config.blocks {
                for i in 0..2 {
                    layers.push(self.dense(&format!("{name}.{block}.{i}"), width, width));
                }
            }
        } else if !self.config.shared {
            (layers, last) = self.plain(name, width);
        }
        layers.push(self.dense(&format!("{name}.out"), last, output));
        layers
    }

    /// The layers of `config.hidden` and the last one's width.
    fn plain(&mut self, name: &str, mut width: usize) -> (Vec<usize>, usize) {
        let mut layers = vec![];
        for (i, next) in self.config.hidden.clone().into_iter().enumerate() {
            layers.push(self.dense(&format!("{name}.{i}"), width, next));
            width = next;
        }
        (layers, width)
    }

    fn dense(&mut self, name: &str, input: usize, output: usize) -> usize {
        self.push(format!("{name}.weight"), format!("{name}.bias"), input, output)
    }

    fn push(&mut self, weight: String, bias: String, input: usize, output: usize) -> usize {
        let offset = self.params();
        self.layers.push(Dense { weight, bias, input, output, offset });
        self.layers.len() - 1
    }
}
