//! Sizes of a policy: what it sees, its layers, and where each layer's weights lie in one flat vector.
//!
//! | tensor | shape | |
//! |---|---|---|
//! | `encoder.<group>.weight_ih_l0`, `bias_ih_l0` | (3H, F), (3H) | GRU over a sequence group, gates in the order r, z, n |
//! | `encoder.<group>.weight_hh_l0`, `bias_hh_l0` | (3H, H), (3H) | |
//! | `project.weight`, `project.bias` | (trunk, E), (trunk) | only with [`PolicyConfig::trunk`] |
//! | `actor.<b>.<0 or 1>.weight`, `.bias` | (W, W), (W) | h = block(h) + h, block = two leaky ReLU layers |
//! | `actor.out.weight`, `.bias` | (2A, W), (2A) | mean, then log variance before the clamp |
//! | `critic.<b>.<0 or 1>`, `critic.out` | (W, W), (1, W) | |
//!
//! Layouts are torch's: `weight` is (out, in) row-major, y = W x + b.

use crate::io::Tensors;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the rules by which observations become network inputs.
pub const LAYOUT_VERSION: u32 = 1;
/// Scalar groups are encoded; this is their width.
const SCALAR: usize = 1;

/// One named part of an observation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObsGroup {
    /// Field name, e.g. "egosensing".
    pub name: String,
    /// Shape for one person: \[frames, floats\] is a sequence, \[1\] an encoded scalar, \[n\] a plain vector.
    pub shape: Vec<usize>,
}

impl ObsGroup {
    /// Floats of the group.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the group holds no floats.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The groups in the order in which they lie in an observation row.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObsLayout {
    /// [`LAYOUT_VERSION`] at the time of training.
    pub version: u32,
    /// The groups.
    pub groups: Vec<ObsGroup>,
}

impl ObsLayout {
    /// A layout of the current version.
    pub fn new(groups: Vec<ObsGroup>) -> Self {
        Self { version: LAYOUT_VERSION, groups }
    }

    /// Floats of one observation row.
    pub fn dim(&self) -> usize {
        self.groups.iter().map(ObsGroup::len).sum()
    }
}

/// Which actor layers start 100 times smaller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActorScale {
    /// The last one, as in the paper's text.
    #[default]
    Last,
    /// Every one, as in the authors' code.
    Code,
}

/// Sizes of the policy network, as a recipe gives them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyConfig {
    /// Hidden width of the GRU over each sequence group, by group name.
    #[serde(default)]
    pub gru: BTreeMap<String, usize>,
    /// Scalars x become sin(2^k x), cos(2^k x) for k below this.
    #[serde(default = "default_octaves")]
    pub octaves: usize,
    /// Width of the trunk behind a linear projection of the encodings; absent: their concatenation is the trunk.
    #[serde(default)]
    pub trunk: Option<usize>,
    /// Residual blocks of actor and critic each.
    #[serde(default = "default_blocks")]
    pub blocks: usize,
    /// Range to which the log variance of actions is clamped.
    #[serde(default = "default_logvar")]
    pub logvar: [f32; 2],
    /// Which actor layers start 100 times smaller.
    #[serde(default)]
    pub actor_scale: ActorScale,
}

fn default_octaves() -> usize {
    12
}

fn default_blocks() -> usize {
    2
}

fn default_logvar() -> [f32; 2] {
    [-2.5, 2.5]
}

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
    /// Floats of an action.
    pub action: usize,
    /// Encoders in the order of the groups, which is the order of the concatenation.
    pub encoders: Vec<Encoder>,
    /// All layers, in the order of the flat vector.
    pub layers: Vec<Dense>,
    /// Index of the projection in `layers`.
    pub project: Option<usize>,
    /// Indices of the actor's layers: two per block, then the output.
    pub actor: Vec<usize>,
    /// Indices of the critic's layers.
    pub critic: Vec<usize>,
}

impl PolicySpec {
    /// Checks the sizes and lays out all layers. `action` is the number of floats of an action.
    pub fn new(config: PolicyConfig, layout: ObsLayout, action: usize) -> Result<Self> {
        check(&config, &layout, action)?;
        let mut spec = Self { config, layout, action, encoders: vec![], layers: vec![], project: None, actor: vec![], critic: vec![] };
        let mut start = 0;
        for group in spec.layout.groups.clone() {
            let encoder = spec.encoder(&group, start);
            start += group.len();
            spec.encoders.push(encoder);
        }
        let encoded = spec.encoders.iter().map(|e| e.output).sum();
        let trunk = spec.config.trunk.unwrap_or(encoded);
        if spec.config.trunk.is_some() {
            spec.project = Some(spec.dense("project", encoded, trunk));
        }
        spec.actor = spec.head("actor", trunk, 2 * action);
        spec.critic = spec.head("critic", trunk, 1);
        Ok(spec)
    }

    /// Floats of all parameters.
    pub fn params(&self) -> usize {
        self.layers.iter().map(Dense::params).sum()
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
        self.layers.iter().flat_map(named).collect()
    }

    /// The flat vector from named tensors of exactly these layers.
    pub fn from_tensors(&self, tensors: &Tensors) -> Result<Vec<f32>> {
        let mut flat = Vec::with_capacity(self.params());
        for d in &self.layers {
            flat.extend(tensors.f32s(&d.weight, &[d.output, d.input])?);
            flat.extend(tensors.f32s(&d.bias, &[d.output])?);
        }
        let known = |name: &String| self.layers.iter().any(|d| d.weight == *name || d.bias == *name);
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
        let mut layers = vec![];
        for block in 0..self.config.blocks {
            for i in 0..2 {
                layers.push(self.dense(&format!("{name}.{block}.{i}"), width, width));
            }
        }
        layers.push(self.dense(&format!("{name}.out"), width, output));
        layers
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

fn check(config: &PolicyConfig, layout: &ObsLayout, action: usize) -> Result<()> {
    let bad = |what: String| Err(Error::invalid(what));
    if layout.version != LAYOUT_VERSION {
        return bad(format!("observation layout version {} is not the version {LAYOUT_VERSION} of this program", layout.version));
    }
    if action == 0 || layout.dim() == 0 {
        return bad(format!("a policy needs observations and actions, not {} and {action} floats", layout.dim()));
    }
    let is_sequence = |g: &ObsGroup| g.shape.len() == 2;
    for group in &layout.groups {
        if group.shape.is_empty() || group.shape.len() > 2 || group.shape.contains(&0) {
            return bad(format!("observation group '{}' has shape {:?}, expected [n] or [frames, n]", group.name, group.shape));
        }
        if is_sequence(group) && config.gru.get(&group.name).is_none_or(|&h| h == 0) {
            return bad(format!("policy.gru.{} is missing: the sequence group '{}' needs a hidden width above 0", group.name, group.name));
        }
    }
    if let Some(name) = config.gru.keys().find(|k| !layout.groups.iter().any(|g| is_sequence(g) && g.name == **k)) {
        return bad(format!("policy.gru.{name}: the environment has no sequence group of that name"));
    }
    if config.octaves > 32 || config.octaves == 0 {
        return bad(format!("policy.octaves is {}, expected 1 to 32", config.octaves));
    }
    if config.trunk == Some(0) {
        return bad("policy.trunk is 0, expected a width above 0".into());
    }
    let [low, high] = config.logvar;
    if !(low.is_finite() && high.is_finite() && low < high) {
        return bad(format!("policy.logvar is [{low}, {high}], expected a finite range, low before high"));
    }
    Ok(())
}
