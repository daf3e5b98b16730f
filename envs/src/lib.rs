//! The problem: the vectorised environment contract, the motion task and its rewards.

pub mod conformance;
pub mod motion;
pub mod point;
mod vec_env;

pub use vec_env::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
