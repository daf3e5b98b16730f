//! The learning: collector, GAE, PPO, trainer, checkpoints, loggers; and the programs.

mod backward;
pub mod checkpoint;
pub mod cli;
mod collector;
mod error;
mod gae;
pub mod logger;
mod loss;
mod optim;
mod policy;
mod ppo;
pub mod primitives;
pub mod recipe;
pub mod registry;
mod shards;
pub mod stats;
pub mod trainer;

pub use backward::Tape;
pub use collector::{Collector, Episode, Rollout, test_episodes};
pub use error::{Error, Result};
pub use gae::{Steps, gae};
pub use loss::{Batch, Losses, gradients};
pub use optim::{AdamConfig, AdamW, clip_scale, global_norm};
pub use policy::{Acts, Compute, Policy};
pub use ppo::{Learner, PpoConfig, UpdateStats};
pub use shards::Shards;
