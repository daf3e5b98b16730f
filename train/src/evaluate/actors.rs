//! Who chooses the latents.

use crate::{Compute, Policy, Result};
use egogen::agent::bundle::Bundle;
use egogen::body::{canonical_frame, joint};
use egogen::metrics::{kl_mean_only, kl_to_standard};
use egogen::motion::SEED;
use egogen::rng::stream;
use egogen::sim::{People, Primitives};
use egogen_envs::motion::{MotionEnv, blocked};
use glam::{Vec2, Vec3};
use rand_distr::{Distribution, StandardNormal};

/// Stream of all noise in evaluation.
const NOISE: &str = "evaluation noise";

/// Latents for everyone, and for policies the divergence of each person's action distribution from N(0, I).
#[derive(Default)]
pub struct Choice {
    /// n x latent_dim.
    pub latents: Vec<f32>,
    /// Mean per-dimension KL to N(0, I) of each person, nats; empty for baselines.
    pub kl: Vec<f32>,
    /// 0.5 mean(mu^2) of each person; empty for baselines.
    pub kl_mean: Vec<f32>,
}

/// Something that walks: a policy or a baseline.
pub enum Actor {
    /// A trained policy, with its noise or with its mean action.
    Policy { policy: Box<Policy>, noise: bool },
    /// The latent 0: the motion model's most ordinary continuation.
    Zero,
    /// Latents from N(0, I): the motion model wandering.
    Prior,
    /// The best of sampled latents by where they lead.
    Greedy(Greedy),
}

impl Actor {
    /// The policy of a bundle; refused when it was trained on another motion model or body than `env` has.
    pub fn policy(bundle: &Bundle, env: &MotionEnv, noise: bool) -> Result<Self> {
        bundle.require("motion", env.sim().model().hash())?;
        bundle.require("body", env.sim().body().hash())?;
        Ok(Self::Policy { policy: Box::new(Policy::new(&bundle.spec, &bundle.params, &Compute::Own)?), noise })
    }

    /// Latents for everyone in `env`, who sees `obs`. `seed` and `step` fix the noise.
    pub fn choose(&self, env: &MotionEnv, obs: &[f32], seed: u64, step: u64) -> Result<Choice> {
        let people = env.people();
        let dim = env.sim().model().latent_dim();
        match self {
            Self::Policy { policy, noise } => {
                let acts = policy.act(obs)?;
                let rows = || acts.mu.chunks_exact(dim).zip(acts.logvar.chunks_exact(dim));
                Ok(Choice {
                    kl: rows().map(|(mu, logvar)| kl_to_standard(mu, logvar) / dim as f32).collect(),
                    kl_mean: rows().map(|(mu, _)| kl_mean_only(mu)).collect(),
                    latents: if *noise { acts.sample(seed, NOISE, step) } else { acts.mu },
                })
            }
            Self::Zero => Ok(Choice { latents: vec![0.0; people.len() * dim], ..Default::default() }),
            Self::Prior => Ok(Choice { latents: normal(people.len(), dim, seed, step), ..Default::default() }),
            Self::Greedy(greedy) => Ok(Choice { latents: greedy.choose(env, seed, step)?, ..Default::default() }),
        }
    }
}

/// n rows of standard normal noise; row i of a step has a stream of its own.
fn normal(n: usize, dim: usize, seed: u64, step: u64) -> Vec<f32> {
    let row = |i: usize| StandardNormal.sample_iter(stream(seed, NOISE, step * n as u64 + i as u64)).take(dim);
    (0..n).flat_map(row).collect()
}

/// One-step search: every latent is tried in the simulation.
pub struct Greedy {
    /// Latents tried per person and step.
    pub candidates: usize,
    /// People searched for at once, which bounds the memory.
    pub at_once: usize,
}

impl Default for Greedy {
    fn default() -> Self {
        Self { candidates: 64, at_once: 16 }
    }
}

impl Greedy {
    fn choose(&self, env: &MotionEnv, seed: u64, step: u64) -> Result<Vec<f32>> {
        let (n, dim) = (env.people().len(), env.sim().model().latent_dim());
        let mut chosen = Vec::with_capacity(n * dim);
        let mut prims = Primitives::default();
        for first in (0..n).step_by(self.at_once) {
            let group: Vec<usize> = (first..n.min(first + self.at_once)).collect();
            let rows: Vec<usize> = group.iter().flat_map(|&i| std::iter::repeat_n(i, self.candidates)).collect();
            let mut people = env.people().select(&rows);
            let latents: Vec<f32> = group.iter().flat_map(|&i| normal(self.candidates, dim, seed, step * n as u64 + i as u64)).collect();
            env.sim().step(&mut people, &latents, &mut prims)?;
            for (g, &i) in group.iter().enumerate() {
                let cost = |k: usize| self.cost(env, i, &people, g * self.candidates + k);
                let best = (0..self.candidates).min_by(|&a, &b| cost(a).total_cmp(&cost(b))).unwrap_or(0);
                let at = (g * self.candidates + best) * dim;
                chosen.extend_from_slice(&latents[at..at + dim]);
            }
        }
        Ok(chosen)
    }

    /// Distance left after the step plus what the turn towards the goal will cost; a step that hits something comes last.
    fn cost(&self, env: &MotionEnv, i: usize, people: &People, row: usize) -> f32 {
        let setting = env.setting(i);
        let hits = blocked(env.task(), people, row, &setting.scene.walkable) >= env.task().blocked_cells;
        let (at, forward) = stance(people, row);
        let to = setting.goal - at;
        greedy_cost(to.length(), forward.angle_to(to)) + if hits { 1e3 } else { 0.0 }
    }
}

/// What being `distance` metres from the goal and turned away from it by `turn` radians costs a greedy walker, metres.
/// Facing away costs a metre; close by, the direction to the goal says little.
pub fn greedy_cost(distance: f32, turn: f32) -> f32 {
    distance + 0.5 * (1.0 - turn.cos()) * (distance / 0.5).min(1.0)
}

/// Where person `i` stands at the end of its seed and which way the hips face, in the world's plane.
fn stance(people: &People, i: usize) -> (Vec2, Vec2) {
    let at = |j: usize| Vec3::from_slice(&people.joints[((i * SEED + SEED - 1) * egogen::body::JOINTS + j) * 3..]);
    let local = canonical_frame(at(joint::PELVIS), at(joint::L_HIP), at(joint::R_HIP));
    let world = people.frames[i].compose(&local);
    (world.transl.truncate(), world.rot.y_axis.truncate())
}
