//! What selection measures of a policy on its starts.

use super::rule::Quality;
use crate::acts::normal_rows;
use crate::collector::{Player, first_episodes};
use crate::evaluate::{Estimate, mean, proportion};
use crate::{Error, Policy, Result};
use egogen::body::{BETAS, MARKER_DIM, PARAMS};
use egogen::metrics::rigid_marker_error;
use egogen::motion::{FRAMES, PosePrior, SEED};
use egogen_envs::motion::MotionEnv;
use egogen_envs::{ActionSpace, VecEnv};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::sync::Arc;

/// Stream of all noise in selection.
const NOISE: &str = "selection noise";

/// Figures of the test episodes of one candidate, with 95 % intervals.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Sum of an episode's rewards.
    pub reward: Estimate,
    /// Share of episodes whose figure `success` is 1; the same of `hover`.
    pub success: Option<Estimate>,
    pub hover: Option<Estimate>,
    /// Mean per-dimension KL of the actions to N(0, I), nats; none for discrete actions.
    pub kl: Option<Estimate>,
    /// 0.5 mean(mu^2) of the actions, the authors' figure.
    pub kl_mean: Option<Estimate>,
    /// In the motion task alone.
    pub quality: Option<Quality>,
}

/// The test episodes of one candidate.
pub struct Measured {
    pub figures: Figures,
    /// Whether each start's episode succeeded, where the environment has such a figure.
    pub success: Option<Vec<bool>>,
}

/// Who acts.
enum Actor<'a> {
    Policy {
        policy: &'a Policy,
        noise: bool,
    },
    /// Normal noise of that width.
    Prior(usize),
}

/// Plays, and adds up what it sees.
struct Watched<'a> {
    actor: Actor<'a>,
    seed: u64,
    judge: Option<Judge>,
    /// Of every environment: steps of its episode, and sums over them of both divergences, ||VP|| and bone error.
    steps: Vec<f64>,
    sums: Vec<[f64; 4]>,
    /// Divergences of the actions of the present step; empty where there are none.
    divergences: Vec<[f32; 2]>,
}

/// Looks at bodies in the motion task.
struct Judge {
    prior: Arc<PosePrior>,
    /// Shapes at the episodes' begin.
    betas: Vec<f32>,
}

impl Player for Watched<'_> {
    fn begin(&mut self, env: &dyn VecEnv) {
        if let (Some(judge), Some(motion)) = (&mut self.judge, as_motion(env)) {
            judge.betas.clone_from(&motion.people().betas);
        }
    }

    fn act(&mut self, obs: &[f32], step: u64) -> Result<Vec<f32>> {
        match self.actor {
            Actor::Policy { policy, noise } => {
                let acts = policy.act(obs)?;
                self.divergences = acts.divergences();
                Ok(if noise { acts.sample(self.seed, NOISE, step) } else { acts.best() })
            }
            Actor::Prior(width) => Ok(normal_rows(self.steps.len(), width, self.seed, NOISE, step)),
        }
    }

    fn look(&mut self, env: &dyn VecEnv, playing: &[usize]) {
        let bodies = self.judge.as_ref().zip(as_motion(env)).map(|(judge, motion)| judge.look(motion, playing));
        for (k, &i) in playing.iter().enumerate() {
            let [full, mean] = self.divergences.get(i).copied().unwrap_or_default().map(f64::from);
            let [pose, bones] = bodies.as_ref().map_or([0.0; 2], |b| b[k]);
            self.sums[i].iter_mut().zip([full, mean, pose, bones]).for_each(|(sum, x)| *sum += x);
            self.steps[i] += 1.0;
        }
    }
}

impl Judge {
    /// ||VP|| and bone error, metres, of the last step's primitives of the people `who`.
    fn look(&self, env: &MotionEnv, who: &[usize]) -> Vec<[f64; 2]> {
        let (prims, body) = (env.primitives(), env.sim().body());
        let one = |&i: &usize| {
            let mut betas = [0.0; BETAS];
            betas.copy_from_slice(&self.betas[i * BETAS..][..BETAS]);
            let markers = &prims.markers[i * FRAMES * MARKER_DIM..][SEED * MARKER_DIM..FRAMES * MARKER_DIM];
            let params = &prims.params[i * FRAMES * PARAMS..][SEED * PARAMS..FRAMES * PARAMS];
            let norms = self.prior.norms(params);
            let pose = norms.iter().sum::<f32>() / norms.len() as f32;
            [pose, rigid_marker_error(markers, &body.shape(&betas))].map(f64::from)
        };
        who.par_iter().map(one).collect()
    }
}

fn as_motion(env: &dyn VecEnv) -> Option<&MotionEnv> {
    (env as &dyn Any).downcast_ref()
}

/// The first episodes of all environments of `env` with a policy.
pub fn measure(env: &mut dyn VecEnv, policy: &Policy, seed: u64, noise: bool) -> Result<Measured> {
    play(env, Actor::Policy { policy, noise }, seed)
}

/// How natural bodies are that actions from N(0, I) lead; none but in the motion task.
pub fn of_prior(env: &mut dyn VecEnv, seed: u64) -> Result<Option<Quality>> {
    match env.spec().action {
        ActionSpace::Continuous(width) if as_motion(env).is_some() => Ok(play(env, Actor::Prior(width), seed)?.figures.quality),
        _ => Ok(None),
    }
}

fn play(env: &mut dyn VecEnv, actor: Actor, seed: u64) -> Result<Measured> {
    let n = env.num_envs();
    let judge = as_motion(env).map(|_| Ok::<_, Error>(Judge { prior: PosePrior::embedded()?, betas: Vec::new() })).transpose()?;
    let mut watched = Watched { actor, seed, judge, steps: vec![0.0; n], sums: vec![[0.0; 4]; n], divergences: Vec::new() };
    let episodes = first_episodes(env, seed, &mut watched)?;
    let shares = |name: &str| -> Option<Vec<bool>> {
        let k = env.spec().episode.iter().position(|figure| figure == name)?;
        Some(episodes.iter().map(|e| e.as_ref().is_some_and(|e| e.figures[k] > 0.5)).collect())
    };
    let share = |all: &Vec<bool>| proportion(all.iter().filter(|b| **b).count(), all.len());
    let ended: Vec<f32> = episodes.iter().flatten().map(|e| e.total).collect();
    let reward = mean(&ended).ok_or_else(|| Error::run("no test episode came to its end"))?;
    let averages = |k: usize| mean(&watched.sums.iter().zip(&watched.steps).map(|(s, n)| (s[k] / n) as f32).collect::<Vec<_>>());
    let per_step = |k: usize| watched.sums.iter().map(|s| s[k]).sum::<f64>() / watched.steps.iter().sum::<f64>();
    let success = shares("success");
    let figures = Figures {
        reward,
        success: success.as_ref().map(share),
        hover: shares("hover").as_ref().map(share),
        kl: averages(0).filter(|_| !watched.divergences.is_empty()),
        kl_mean: averages(1).filter(|_| !watched.divergences.is_empty()),
        quality: watched.judge.as_ref().map(|_| Quality { pose_norm: per_step(2), bone_error_mm: 1000.0 * per_step(3) }),
    };
    Ok(Measured { figures, success })
}
