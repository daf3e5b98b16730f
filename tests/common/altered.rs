//! A point's task whose steps are changed.

use egogen_envs::point::PointGoal;
use egogen_envs::{EnvError, EnvSpec, StepResult, VecEnv};

/// The point, with the result of every step passed to `change`.
pub struct Altered<F> {
    pub point: PointGoal,
    pub change: F,
}

impl<F: FnMut(&mut StepResult) + Send + 'static> VecEnv for Altered<F> {
    fn spec(&self) -> &EnvSpec {
        self.point.spec()
    }

    fn num_envs(&self) -> usize {
        self.point.num_envs()
    }

    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        self.point.reset(seed, obs)
    }

    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError> {
        self.point.step(actions, out)?;
        (self.change)(out);
        Ok(())
    }

    fn save_state(&self) -> Result<Vec<u8>, EnvError> {
        self.point.save_state()
    }

    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError> {
        self.point.load_state(state)
    }

    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        self.point.observe(obs)
    }
}
