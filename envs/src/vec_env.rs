//! The contract between an environment and a trainer.

pub use egogen::agent::{ActionSpace, ObsGroup};
use std::any::Any;

/// Shapes and names that stay fixed for the life of an environment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EnvSpec {
    /// Groups in the order in which they lie in an observation row.
    pub obs: Vec<ObsGroup>,
    /// The action space.
    pub action: ActionSpace,
    /// Names of the per-step figures in [`StepResult::info`] (reward terms first).
    pub info: Vec<String>,
    /// Names of the per-episode figures in [`StepResult::episode`], reported when an episode ends (e.g. "success").
    pub episode: Vec<String>,
}

impl EnvSpec {
    /// Floats of one observation row.
    pub fn obs_dim(&self) -> usize {
        self.obs.iter().map(ObsGroup::len).sum()
    }

    /// Refuses a batch of actions for `n` environments that has the wrong size, is not finite or names no choice.
    pub fn check_actions(&self, n: usize, actions: &[f32]) -> Result<(), EnvError> {
        let width = self.action.width();
        if actions.len() != n * width {
            return Err(EnvError::Invalid(format!("{} action values, expected {n} x {width}", actions.len())));
        }
        let ok = |a: f32| match self.action {
            ActionSpace::Continuous(_) => a.is_finite(),
            ActionSpace::Discrete(k) => a >= 0.0 && a < k as f32 && a.fract() == 0.0,
        };
        match actions.iter().position(|&a| !ok(a)) {
            Some(i) => Err(EnvError::Invalid(format!(
                "action of environment {} holds {} at place {}, expected {:?}",
                i / width,
                actions[i],
                i % width,
                self.action
            ))),
            None => Ok(()),
        }
    }
}

/// What a batch of n environments returns from one step. Buffers are owned by the caller and reused.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepResult {
    /// n x obs_dim: the observation to act on next; for environments that ended, the first of the NEW episode.
    pub obs: Vec<f32>,
    /// n x obs_dim: the observation the step led to, before any reset (equal to `obs` where nothing ended).
    pub final_obs: Vec<f32>,
    /// n rewards.
    pub reward: Vec<f32>,
    /// n: the task itself ended here (success, failure, or a step limit that the observation shows). No bootstrapping.
    pub terminated: Vec<bool>,
    /// n: cut off from outside; the value of `final_obs` stands for what was missed.
    pub truncated: Vec<bool>,
    /// n x info.len(): figures of this step.
    pub info: Vec<f32>,
    /// n x episode.len(): figures of the episode that ended in this step; zero where none ended.
    pub episode: Vec<f32>,
}

impl StepResult {
    /// Sizes all buffers for `n` environments of `spec` and zeroes them.
    pub fn prepare(&mut self, spec: &EnvSpec, n: usize) {
        let zero = |v: &mut Vec<f32>, len| {
            v.clear();
            v.resize(len, 0.0);
        };
        zero(&mut self.obs, n * spec.obs_dim());
        zero(&mut self.final_obs, n * spec.obs_dim());
        zero(&mut self.reward, n);
        zero(&mut self.info, n * spec.info.len());
        zero(&mut self.episode, n * spec.episode.len());
        for flags in [&mut self.terminated, &mut self.truncated] {
            flags.clear();
            flags.resize(n, false);
        }
    }
}

/// Why an environment refused a step.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// Wrong sizes, non-finite actions, foreign saved states.
    #[error("{0}")]
    Invalid(String),
    /// The world underneath failed.
    #[error(transparent)]
    World(#[from] egogen::Error),
}

/// n environments stepped together, with same-step auto-reset.
///
/// Every environment has random streams of its own, so results depend on the seed and the actions only: not on n's other
/// members' actions, not on the number of threads. What knows the kind can ask for it: `(env as &dyn Any).downcast_ref()`.
pub trait VecEnv: Any + Send {
    /// Fixed shapes and names.
    fn spec(&self) -> &EnvSpec;

    /// Number of environments n.
    fn num_envs(&self) -> usize;

    /// Starts fresh episodes everywhere from `seed` and writes the first observations to `obs` (n x obs_dim).
    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError>;

    /// Acts in all environments. `actions`: n x action width, all finite. Ended environments are reset at once.
    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError>;

    /// The whole state, random streams included.
    fn save_state(&self) -> Result<Vec<u8>, EnvError>;

    /// Restores what `save_state` of the same kind and size wrote; afterwards steps repeat bit for bit.
    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError>;

    /// The current observations (n x obs_dim), for resuming after `load_state`.
    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError>;
}
