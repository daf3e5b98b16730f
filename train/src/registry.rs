//! Environments by name.

use crate::{Error, Result};
use egogen_envs::VecEnv;
use egogen_envs::point::PointGoal;
use std::collections::BTreeMap;

/// A made environment and what it stands on.
pub struct Made {
    /// The environment; the trainer resets it from the recipe's seed.
    pub env: Box<dyn VecEnv>,
    /// Content hashes of what its observations and actions mean, e.g. "motion" and "body"; a policy trained here names them.
    pub origin: BTreeMap<String, String>,
}

/// Makes that many environments from a recipe's `[env_options]`; refuses options it does not know.
pub type Factory = Box<dyn Fn(&toml::Table, usize) -> Result<Made> + Send + Sync>;

/// The environments a program knows.
#[derive(Default)]
pub struct Registry {
    factories: BTreeMap<String, Factory>,
}

impl Registry {
    /// The environments of this project.
    pub fn standard() -> Self {
        let mut registry = Self::default();
        registry.add("point", |options, n| {
            if let Some(key) = options.keys().next() {
                return Err(Error::config(format!("env_options.{key}: the environment 'point' has no options")));
            }
            Ok(Made { env: Box::new(PointGoal::new(n, 0)), origin: BTreeMap::new() })
        });
        registry
    }

    /// Adds (or replaces) an environment.
    pub fn add(&mut self, name: &str, factory: impl Fn(&toml::Table, usize) -> Result<Made> + Send + Sync + 'static) {
        self.factories.insert(name.into(), Box::new(factory));
    }

    /// Makes `n` environments of kind `name`.
    pub fn make(&self, name: &str, options: &toml::Table, n: usize) -> Result<Made> {
        match self.factories.get(name) {
            Some(factory) => factory(options, n),
            None => {
                let known: Vec<_> = self.factories.keys().cloned().collect();
                Err(Error::config(format!("env is '{name}', expected one of: {}", known.join(", "))))
            }
        }
    }
}
