//! Environments by name.

use crate::{Error, Result};
use egogen::sim::World;
use egogen_envs::VecEnv;
use egogen_envs::control::{Acrobot, CartPole, Control, Dynamics, MountainCar, MountainCarContinuous, Pendulum};
use egogen_envs::motion::{MotionEnv, MotionTask, Outcome, OwnTerm};
use egogen_envs::point::PointGoal;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A made environment and what it stands on.
pub struct Made {
    /// The environment; the trainer resets it from the recipe's seed.
    pub env: Box<dyn VecEnv>,
    /// Content hashes of what its observations and actions mean, e.g. "motion" and "body"; a policy trained here names them.
    pub origin: BTreeMap<String, String>,
}

/// What environments are made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Learning: fresh starts.
    Train,
    /// Tests: the same starts after every reset with the same seed, whatever the policy does.
    Test,
}

/// Makes that many environments from a recipe's `[env_options]`; refuses options it does not know.
pub type Factory = Box<dyn Fn(&toml::Table, usize, Purpose) -> Result<Made> + Send + Sync>;

/// A reward term of one's own: its name, and its value before weighting.
pub type OwnReward = (&'static str, fn(&Outcome) -> f32);

/// The environments a program knows.
#[derive(Default)]
pub struct Registry {
    factories: BTreeMap<String, Factory>,
}

impl Registry {
    /// The environments of this project.
    pub fn standard() -> Self {
        let mut registry = Self::default();
        registry.add_motion("motion", &[]);
        registry.add_plain("point", |n| Box::new(PointGoal::new(n, 0)));
        registry.add_control::<CartPole>("cartpole");
        registry.add_control::<Acrobot>("acrobot");
        registry.add_control::<Pendulum>("pendulum");
        registry.add_control::<MountainCar>("mountaincar");
        registry.add_control::<MountainCarContinuous>("mountaincar_continuous");
        registry
    }

    /// Adds (or replaces) the motion task with reward terms of one's own: names, and functions of a step's outcome. A recipe weighs
    /// them in `[env_options.terms]`; those that it does not name weigh nothing.
    pub fn add_motion(&mut self, name: &str, own: &'static [OwnReward]) {
        self.add(name, move |options, n, purpose| motion(options, own, n, purpose));
    }

    /// Adds an environment without options that stands on nothing.
    fn add_plain(&mut self, name: &'static str, make: impl Fn(usize) -> Box<dyn VecEnv> + Send + Sync + 'static) {
        self.add(name, move |options, n, _| {
            if let Some(key) = options.keys().next() {
                return Err(Error::config(format!("env_options.{key}: the environment '{name}' has no options")));
            }
            Ok(Made { env: make(n), origin: BTreeMap::new() })
        });
    }

    fn add_control<D: Dynamics + 'static>(&mut self, name: &'static str) {
        self.add_plain(name, |n| Box::new(Control::<D>::new(n, 0)));
    }

    /// Adds (or replaces) an environment.
    pub fn add(&mut self, name: &str, factory: impl Fn(&toml::Table, usize, Purpose) -> Result<Made> + Send + Sync + 'static) {
        self.factories.insert(name.into(), Box::new(factory));
    }

    /// Makes `n` environments of kind `name`.
    pub fn make(&self, name: &str, options: &toml::Table, n: usize, purpose: Purpose) -> Result<Made> {
        match self.factories.get(name) {
            Some(factory) => factory(options, n, purpose),
            None => {
                let known: Vec<_> = self.factories.keys().cloned().collect();
                Err(Error::config(format!("env is '{name}', expected one of: {}", known.join(", "))))
            }
        }
    }
}

/// Options of the environment `motion`.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct MotionOptions {
    /// Folder of a motion model with its seed motions; absent: the shipped one.
    motion: Option<PathBuf>,
    /// The task.
    task: MotionTask,
    /// Weights of reward terms that a program adds.
    terms: BTreeMap<String, f32>,
}

/// People that walk to a goal round a box. Tests begin from seed motions that training does not see.
fn motion(options: &toml::Table, own: &[OwnReward], n: usize, purpose: Purpose) -> Result<Made> {
    let bad = |e: toml::de::Error| Error::config(format!("env_options: {}", e.to_string().trim_end()));
    let options: MotionOptions = options.clone().try_into().map_err(bad)?;
    options.task.validate().map_err(|e| Error::config(format!("env_options.task.{e}")))?;
    let known: Vec<&str> = own.iter().map(|(name, _)| *name).collect();
    if let Some((name, weight)) = options.terms.iter().find(|(name, w)| !known.contains(&name.as_str()) || !w.is_finite()) {
        return Err(Error::config(format!("env_options.terms.{name} is {weight}, expected a finite weight of one of {known:?}")));
    }
    let weight = |name: &str| options.terms.get(name).copied().unwrap_or(0.0);
    let own = own.iter().map(|&(name, value)| OwnTerm { name: name.into(), value, weight: weight(name) }).collect();
    let world = match &options.motion {
        Some(dir) => World::load(dir).map_err(|e| Error::config(format!("env_options.motion: {e}")))?,
        None => World::embedded()?,
    };
    let (origin, sim) = (world.origin(), world.sim);
    let env = match purpose {
        Purpose::Train => MotionEnv::new(options.task, sim, world.train, n, 0),
        Purpose::Test => MotionEnv::evaluation(options.task, sim, world.held_out, n, 0),
    };
    let env = env.map_err(|e| Error::config(format!("env_options: {e}")))?;
    Ok(Made { env: Box::new(env.with_terms(own)), origin })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reference_tasks_have_names_and_no_options() {
        let registry = Registry::standard();
        let none = toml::Table::new();
        for (name, obs) in [("cartpole", 4), ("acrobot", 6), ("pendulum", 3), ("mountaincar", 2), ("mountaincar_continuous", 2)] {
            let made = registry.make(name, &none, 3, Purpose::Train).unwrap();
            assert_eq!((made.env.num_envs(), made.env.spec().obs_dim(), made.origin.len()), (3, obs, 0), "{name}");
            let error = registry.make(name, &toml::toml! { gravity = 1.6 }, 3, Purpose::Train).err().unwrap().to_string();
            assert!(error.contains("env_options.gravity") && error.contains(name), "{error}");
        }
    }
}
