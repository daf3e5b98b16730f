//! The learning: collector, GAE, PPO, trainer, checkpoints, loggers; and the programs.

pub mod primitives;
