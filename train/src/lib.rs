//! The learning: collector, GAE, PPO, trainer, checkpoints, loggers; and the programs.

mod actor;
pub mod checkpoint;
pub mod cli;
mod collector;
mod error;
mod gae;
pub mod logger;
mod optim;
mod ppo;
pub mod primitives;
pub mod recipe;
pub mod registry;
mod shards;
pub mod stats;
pub mod trainer;

pub use actor::{Actor, Acts};
pub use collector::{Collector, Episode, Rollout, test_episodes};
pub use error::{Error, Result};
pub use gae::{Steps, gae};
pub use optim::{AdamConfig, AdamW, clip_scale, global_norm};
pub use ppo::{Batch, Learner, Losses, PpoConfig, UpdateStats, gradients};
pub use shards::Shards;
