//! The problem: the vectorised environment contract, the motion task and its rewards, and reference tasks.

pub mod conformance;
pub mod control;
pub mod motion;
pub mod point;
mod vec_env;

pub use vec_env::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
