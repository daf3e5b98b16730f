//! The learning: collector, GAE, PPO, trainer, checkpoints, loggers; and the programs.

mod acts;
mod backward;
pub mod checkpoint;
pub mod cli;
mod clock;
mod collector;
pub mod course;
pub mod curves;
mod error;
pub mod evaluate;
mod gae;
pub mod html;
mod job;
pub mod logger;
mod loss;
mod optim;
pub mod plot;
mod policy;
mod ppo;
pub mod primitives;
pub mod program;
pub mod recipe;
pub mod registry;
pub mod report;
mod running;
mod scaling;
mod schedule;
mod seeds;
pub mod select;
mod shards;
pub mod stages;
mod start;
pub mod stats;
pub mod sweep;
pub mod tensorboard;
pub mod trainer;

pub use acts::Acts;
pub use collector::{Collector, Episode, Rollout, test_episodes};
pub use error::{Error, Result};
pub use gae::{Steps, gae};
pub use loss::{Batch, Losses, gradients};
pub use optim::{AdamConfig, AdamW, clip_scale, global_norm};
pub use policy::{Compute, Policy};
pub use ppo::{Learner, PpoConfig, PriorForm, Progress, Rules, UpdateStats};
pub use running::Running;
pub use scaling::RewardScaling;
pub use schedule::Schedule;
pub use shards::Shards;

/// Numbers from PyTorch and NumPy, made by tests/tools/ppo/make.py.
#[cfg(test)]
fn fixture() -> egogen::io::Tensors {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/fixtures/ppo.safetensors");
    egogen::io::Tensors::read(path).expect("the fixture is in the repository")
}
