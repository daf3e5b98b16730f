//! Who chooses the latents.

use super::way::{Way, Ways};
use crate::acts::normal_rows;
use crate::{Compute, Error, Policy, Result};
use egogen::agent::ObsGroup;
use egogen::agent::bundle::Bundle;
use egogen::body::{JOINTS, canonical_frame, joint};
use egogen::motion::{FUTURE, SEED};
use egogen::scene::Polygon;
use egogen::sim::{People, Primitives};
use egogen_envs::VecEnv;
use egogen_envs::motion::{MotionEnv, blocked};
use glam::{Vec2, Vec3};
use std::sync::{Arc, Mutex, PoisonError};

/// Stream of all noise in evaluation.
const NOISE: &str = "evaluation noise";
/// What the rays are called in an observation.
const EGOSENSING: &str = "egosensing";

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
    /// A trained policy, with its noise or with its mean action; `blind`: told that nothing is in sight.
    Policy { policy: Box<Policy>, noise: bool, blind: bool },
    /// The latent 0: the motion model's most ordinary continuation.
    Zero,
    /// Latents from N(0, I): the motion model wandering.
    Prior,
    /// The best of sampled latents by where they lead.
    Greedy(Greedy),
}

impl Actor {
    /// The policy of a bundle; refused when it was trained on another motion model or body than `env` has, or sees something else.
    pub fn policy(bundle: &Bundle, env: &MotionEnv, noise: bool) -> Result<Self> {
        bundle.require("motion", env.sim().model().hash())?;
        bundle.require("body", env.sim().body().hash())?;
        let shapes = |groups: &[ObsGroup]| groups.iter().map(|g| format!("{} {:?}", g.name, g.shape)).collect::<Vec<_>>().join(", ");
        let (seen, shown) = (shapes(&bundle.spec.layout.groups), shapes(&env.spec().obs));
        if seen != shown {
            return Err(Error::config(format!("it sees {seen}, but the walking task shows {shown}; train it anew")));
        }
        env.sim().widen(&[], bundle.spec.action.count())?;
        Ok(Self::Policy { policy: Box::new(Policy::new(&bundle.spec, &bundle.params, &Compute::Own)?), noise, blind: false })
    }

    /// A policy that is told nothing of what is in sight; baselines stay as they are.
    pub fn blind(mut self) -> Self {
        if let Self::Policy { blind, .. } = &mut self {
            *blind = true;
        }
        self
    }

    /// Latents for everyone in `env`, who sees `obs`; people not `playing` any more may get any. `seed` and `step` fix the noise.
    pub fn choose(&self, env: &MotionEnv, obs: &[f32], playing: &[bool], seed: u64, step: u64) -> Result<Choice> {
        let people = env.people();
        let dim = env.sim().model().latent_dim();
        match self {
            Self::Policy { policy, noise, blind } => {
                let acts = if *blind { policy.act(&blinded(env, obs))? } else { policy.act(obs)? };
                let k = policy.actions();
                let (kl, kl_mean) = acts.divergences().into_iter().map(|[kl, mean]| (kl, mean)).unzip();
                Ok(Choice { kl, kl_mean, latents: env.sim().widen(&if *noise { acts.sample(seed, NOISE, step) } else { acts.mu }, k)? })
            }
            Self::Zero => Ok(Choice { latents: vec![0.0; people.len() * dim], ..Default::default() }),
            Self::Prior => Ok(Choice { latents: normal_rows(people.len(), dim, seed, NOISE, step), ..Default::default() }),
            Self::Greedy(greedy) => Ok(Choice { latents: greedy.choose(env, playing, seed, step)?, ..Default::default() }),
        }
    }
}

/// Observation rows with every ray at its full length.
fn blinded(env: &MotionEnv, obs: &[f32]) -> Vec<f32> {
    let (mut out, spec) = (obs.to_vec(), env.spec());
    let before: usize = spec.obs.iter().take_while(|g| g.name != EGOSENSING).map(ObsGroup::len).sum();
    let rays = spec.obs.iter().find(|g| g.name == EGOSENSING).map_or(0, ObsGroup::len);
    out.chunks_exact_mut(spec.obs_dim()).for_each(|row| row[before..before + rays].fill(1.0));
    out
}

/// One-step search: every latent is tried in the simulation, and judged by how far it leads along the shortest way round what stands still.
pub struct Greedy {
    /// Latents tried per person and step.
    pub candidates: usize,
    /// People searched for at once, which bounds the memory.
    pub at_once: usize,
    /// Ways over the floor that each person walked on last.
    ways: Mutex<Vec<Arc<Ways>>>,
}

impl Default for Greedy {
    fn default() -> Self {
        Self { candidates: 64, at_once: 16, ways: Mutex::default() }
    }
}

impl Greedy {
    fn choose(&self, env: &MotionEnv, playing: &[bool], seed: u64, step: u64) -> Result<Vec<f32>> {
        let (n, dim) = (env.people().len(), env.sim().model().latent_dim());
        let mut chosen = vec![0.0; n * dim];
        let mut prims = Primitives::default();
        let ways = self.ways(env);
        let who: Vec<usize> = (0..n).filter(|&i| playing[i]).collect();
        for group in who.chunks(self.at_once) {
            let rows: Vec<usize> = group.iter().flat_map(|&i| std::iter::repeat_n(i, self.candidates)).collect();
            let mut people = env.people().select(&rows);
            let latents: Vec<f32> =
                group.iter().flat_map(|&i| normal_rows(self.candidates, dim, seed, NOISE, step * n as u64 + i as u64)).collect();
            env.sim().step(&mut people, &latents, &mut prims)?;
            for (g, &i) in group.iter().enumerate() {
                let setting = env.setting(i);
                let way = ways[i].plan(Stance::of(env.people(), i).at, setting.goal);
                let ground = env.ground(i);
                let costs: Vec<f32> =
                    (0..self.candidates).map(|k| cost(env, (&way, &ground, setting.goal), &people, g * self.candidates + k)).collect();
                let best = (0..self.candidates).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
                let at = (g * self.candidates + best) * dim;
                chosen[i * dim..(i + 1) * dim].copy_from_slice(&latents[at..at + dim]);
            }
        }
        Ok(chosen)
    }

    /// Ways over each person's floor: those of the last step, where that is the same, and one for all people of a scene.
    fn ways(&self, env: &MotionEnv) -> Vec<Arc<Ways>> {
        let mut kept = self.ways.lock().unwrap_or_else(PoisonError::into_inner);
        let mut out: Vec<Arc<Ways>> = Vec::with_capacity(env.people().len());
        for i in 0..env.people().len() {
            let floor = &env.setting(i).scene.walkable;
            let known = kept.get(i).into_iter().chain(out.iter().rev()).find(|ways| ways.floor() == floor).cloned();
            out.push(known.unwrap_or_else(|| Arc::new(Ways::over(floor))));
        }
        kept.clone_from(&out);
        out
    }
}

/// See [`greedy_cost`]; a step that arrives comes first, one that hits something last.
fn cost(env: &MotionEnv, (way, ground, goal): (&Way, &Polygon, Vec2), people: &People, row: usize) -> f32 {
    let task = env.task();
    let stance = Stance::of(people, row);
    let (left, ahead) = way.follow(stance.at);
    let missing = stance.at.distance(goal);
    if blocked(task, people, row, ground) >= task.blocked_cells {
        1e3 + left
    } else if missing < task.success_distance {
        missing - 1e3
    } else {
        greedy_cost(left, stance.forward.angle_to(ahead - stance.at), stance.stride)
    }
}

/// Strides shorter than this count as this, metres: who stands can still begin to walk.
const LEAST_STRIDE: f32 = 0.2;

/// What it costs a greedy walker to be `distance` metres from the goal, turned away from it by `turn` radians, going on by
/// `stride` metres a step; metres.
///
/// Only where steps end counts as arriving, so whoever strides across the goal has missed it: what is left should be a whole
/// number of strides. Facing away costs half a metre; close by, the direction to the goal says little.
fn greedy_cost(distance: f32, turn: f32, stride: f32) -> f32 {
    let stride = stride.max(LEAST_STRIDE);
    let strides = (distance / stride).round().max(1.0);
    0.5 * distance + 0.5 * (1.0 - turn.cos()) * (distance / 0.5).min(1.0) + (distance / strides - stride).abs()
}

/// How a person stands at the end of its seed, in the world's plane.
struct Stance {
    at: Vec2,
    /// Where the hips face.
    forward: Vec2,
    /// The way of one more step at the present speed, metres.
    stride: f32,
}

impl Stance {
    fn of(people: &People, i: usize) -> Self {
        let at = |t: usize, j: usize| Vec3::from_slice(&people.joints[((i * SEED + t) * JOINTS + j) * 3..]);
        let end = |j: usize| at(SEED - 1, j);
        let world = people.frames[i].compose(&canonical_frame(end(joint::PELVIS), end(joint::L_HIP), end(joint::R_HIP)));
        let moved = (end(joint::PELVIS) - at(SEED - 2, joint::PELVIS)).truncate().length();
        Self { at: world.transl.truncate(), forward: world.rot.y_axis.truncate(), stride: moved * FUTURE as f32 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greedy_costs_by_hand() {
        // One metre ahead in strides of 0.5: no correction.
        assert!((greedy_cost(1.0, 0.0, 0.5) - 0.5).abs() < 1e-6);
        // Two strides of 0.4 leave 0.1, so both must grow by 0.05.
        assert!((greedy_cost(0.9, 0.0, 0.4) - (0.45 + 0.05)).abs() < 1e-6);
        // Facing away from 0.25 m: half of half a metre twice, and the one stride of 0.6 is 0.35 too long.
        assert!((greedy_cost(0.25, std::f32::consts::PI, 0.6) - (0.125 + 0.5 + 0.35)).abs() < 1e-6);
        // Standing counts as strides of 0.2.
        assert!((greedy_cost(0.3, 0.0, 0.0) - (0.15 + 0.05)).abs() < 1e-6);
    }
}
