//! Classic control tasks with Gymnasium's dynamics: references with published scores for testing learners.
//!
//! [`Control`] owns the environments, their random streams, the step limit and the resets; a task is a [`Dynamics`].
//! The state is f64 as in Gymnasium and observations are rounded to f32. Starts are drawn from the same ranges, but from
//! streams of this project, so Gymnasium's seeds give other starts.

mod acrobot;
mod cartpole;
mod mountain_car;
mod pendulum;
#[cfg(test)]
mod tests;

pub use acrobot::Acrobot;
pub use cartpole::CartPole;
pub use mountain_car::{MountainCar, MountainCarContinuous};
pub use pendulum::Pendulum;

use crate::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
use egogen::rng::{Stream, stream};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// One task; the value is its state.
pub trait Dynamics: Clone + Send + Serialize + DeserializeOwned + 'static {
    /// Gymnasium's name, e.g. "CartPole-v1".
    const NAME: &'static str;
    /// Steps after which an episode is cut off.
    const LIMIT: u32;
    /// Floats of an observation.
    const OBS: usize;
    /// Choices, or one float.
    const ACTION: ActionSpace;

    /// Draws the start of an episode.
    fn draw(rng: &mut Stream) -> Self;

    /// Moves on by one step and returns the reward and whether the task ended.
    ///
    /// `action` is finite, and a whole number below the number of choices where actions are discrete. A continuous action is
    /// first cut to the task's range, as trainers do in front of Gymnasium, so that effort is that of what was applied.
    fn step(&mut self, action: f32) -> (f64, bool);

    /// Writes the observation, `OBS` floats.
    fn observe(&self, out: &mut [f32]);
}

/// n environments of one task, stepped on the calling thread: a step costs less than handing it to another.
///
/// Observation "state". Reaching the step limit truncates, since the observation does not show the time; a step on which the
/// task itself ends is terminated only. Episode figure "terminated": 1 where the task ended, 0 where the limit did.
pub struct Control<D> {
    spec: EnvSpec,
    members: Vec<Member<D>>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Member<D> {
    rng: Stream,
    state: D,
    steps: u32,
}

impl<D: Dynamics> Control<D> {
    /// n environments, started by `seed`.
    pub fn new(n: usize, seed: u64) -> Self {
        let spec = EnvSpec {
            obs: vec![ObsGroup { name: "state".into(), shape: vec![D::OBS] }],
            action: D::ACTION,
            info: Vec::new(),
            episode: vec!["terminated".into()],
        };
        Self { spec, members: (0..n).map(|i| Member::new(seed, i as u64)).collect() }
    }

    /// Marks saved states.
    fn kind() -> String {
        format!("control 1 {}", D::NAME)
    }
}

impl<D: Dynamics> Member<D> {
    fn new(seed: u64, index: u64) -> Self {
        let mut rng = stream(seed, D::NAME, index);
        Self { state: D::draw(&mut rng), rng, steps: 0 }
    }

    fn restart(&mut self) {
        (self.state, self.steps) = (D::draw(&mut self.rng), 0);
    }
}

impl<D: Dynamics> VecEnv for Control<D> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.members.len()
    }

    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        *self = Self::new(self.members.len(), seed);
        self.observe(obs)
    }

    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError> {
        self.spec.check_actions(self.members.len(), actions)?;
        out.prepare(&self.spec, self.members.len());
        for (i, member) in self.members.iter_mut().enumerate() {
            let row = i * D::OBS..(i + 1) * D::OBS;
            let (reward, terminated) = member.state.step(actions[i]);
            member.steps += 1;
            out.reward[i] = reward as f32;
            out.terminated[i] = terminated;
            out.truncated[i] = !terminated && member.steps >= D::LIMIT;
            member.state.observe(&mut out.final_obs[row.clone()]);
            if terminated || out.truncated[i] {
                out.episode[i] = f32::from(terminated);
                member.restart();
            }
            member.state.observe(&mut out.obs[row]);
        }
        Ok(())
    }

    fn save_state(&self) -> Result<Vec<u8>, EnvError> {
        let bad = |e| EnvError::Invalid(format!("cannot save {}: {e}", D::NAME));
        postcard::to_stdvec(&(Self::kind(), &self.members)).map_err(bad)
    }

    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let bad = |why: String| EnvError::Invalid(format!("not a saved state of {} x {}: {why}", self.members.len(), D::NAME));
        // The kind comes first, so that a state of another task is named rather than misread.
        let (kind, rest): (String, &[u8]) = postcard::take_from_bytes(state).map_err(|e| bad(e.to_string()))?;
        if kind != Self::kind() {
            return Err(bad(format!("it is of kind '{kind}'")));
        }
        let members: Vec<Member<D>> = postcard::from_bytes(rest).map_err(|e| bad(e.to_string()))?;
        if members.len() != self.members.len() {
            return Err(bad(format!("it holds {}", members.len())));
        }
        self.members = members;
        Ok(())
    }

    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        obs.clear();
        obs.resize(D::OBS * self.members.len(), 0.0);
        for (member, row) in self.members.iter().zip(obs.chunks_exact_mut(D::OBS)) {
            member.state.observe(row);
        }
        Ok(())
    }
}
