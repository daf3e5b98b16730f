//! What a policy sees, and the sizes of its network as a recipe gives them.

use super::ActionSpace;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the rules by which observations become network inputs.
pub const LAYOUT_VERSION: u32 = 1;
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

/// How dense layers start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Init {
    /// Orthogonal with gain sqrt 2, biases zero, actor layers scaled as `actor_scale` says.
    #[default]
    Orthogonal,
    /// As torch's layers start: weights and biases uniform in +-1/sqrt(inputs), the actor's too.
    Uniform,
}

/// What follows a plain layer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Nonlinearity {
    /// tanh x
    #[default]
    Tanh,
    /// max(x, 0)
    Relu,
}

/// Noise that depends on the state (gSDE, Raffin et al. 2021): actions are mean + h E, h the actor's last hidden activations and E
/// normal with standard deviations of its own, which are learned; their gradients do not move h.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateNoise {
    /// Where the log standard deviations of E start.
    pub log_std: f32,
    /// Steps for which each environment keeps its E.
    pub steps: u64,
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
    /// Residual blocks of actor and critic each, where `hidden` names no layers.
    #[serde(default = "default_blocks")]
    pub blocks: usize,
    /// Widths of plain layers in place of the residual blocks.
    #[serde(default)]
    pub hidden: Vec<usize>,
    /// What follows each of them.
    #[serde(default)]
    pub activation: Nonlinearity,
    /// Whether actor and critic share them; else each has its own.
    #[serde(default)]
    pub shared: bool,
    /// Start of a log standard deviation of actions that is a parameter of its own; absent: the network gives the log variance.
    #[serde(default)]
    pub log_std: Option<f32>,
    /// Noise that depends on the state, in place of one that is drawn anew for every step; absent: none.
    #[serde(default)]
    pub state_noise: Option<StateNoise>,
    /// Observations are brought to mean 0 and standard deviation 1, as far as training has seen them, and cut to +-10.
    #[serde(default)]
    pub obs_norm: bool,
    /// Range to which the log variance of actions is clamped.
    #[serde(default = "default_logvar")]
    pub logvar: [f32; 2],
    /// Which actor layers start 100 times smaller.
    #[serde(default)]
    pub actor_scale: ActorScale,
    /// How dense layers start.
    #[serde(default)]
    pub init: Init,
}

impl Default for PolicyConfig {
    /// What a recipe without any of the keys gives.
    fn default() -> Self {
        Self {
            gru: BTreeMap::new(),
            octaves: default_octaves(),
            trunk: None,
            blocks: default_blocks(),
            hidden: Vec::new(),
            activation: Nonlinearity::default(),
            shared: false,
            log_std: None,
            state_noise: None,
            obs_norm: false,
            logvar: default_logvar(),
            actor_scale: ActorScale::default(),
            init: Init::default(),
        }
    }
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

pub(super) fn check(config: &PolicyConfig, layout: &ObsLayout, action: ActionSpace) -> Result<()> {
    let bad = |what: String| Err(Error::invalid(what));
    if layout.version != LAYOUT_VERSION {
        return bad(format!("observation layout version {} is not the version {LAYOUT_VERSION} of this program", layout.version));
    }
    if action.count() == 0 || layout.dim() == 0 {
        return bad(format!("a policy needs observations and actions, not {} floats and {action:?}", layout.dim()));
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
    check_heads(config, action)
}

fn check_heads(config: &PolicyConfig, action: ActionSpace) -> Result<()> {
    let bad = |what: String| Err(Error::invalid(what));
    let [low, high] = config.logvar;
    if config.hidden.contains(&0) {
        return bad(format!("policy.hidden is {:?}, expected widths above 0", config.hidden));
    }
    if config.shared && config.hidden.is_empty() {
        return bad("policy.shared is true, but policy.hidden names no layers to share".into());
    }
    if let Some(noise) = config.state_noise {
        if matches!(action, ActionSpace::Discrete(_)) || config.log_std.is_some() {
            return bad("policy.state_noise is set, expected continuous actions and no policy.log_std".into());
        }
        if noise.steps == 0 || !noise.log_std.is_finite() {
            return bad(format!("policy.state_noise is {noise:?}, expected a finite log_std and steps above 0"));
        }
    }
    match (config.log_std, action) {
        (Some(_), ActionSpace::Discrete(_)) => bad("policy.log_std is set, but the actions are discrete".into()),
        (Some(x), _) if !(low..=high).contains(&(2.0 * x)) => {
            bad(format!("policy.log_std is {x}, expected {} to {}, half of policy.logvar", 0.5 * low, 0.5 * high))
        }
        _ => Ok(()),
    }
}
