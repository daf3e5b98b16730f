//! Plays each start once and measures it.

use super::{Actor, Fate, Measured};
use crate::{Error, Result};
use egogen::body::{BETAS, MARKER_DIM, PARAMS};
use egogen::metrics::stance_slide;
use egogen::motion::{FRAMES, PosePrior, SEED};
use egogen::scene::{Setting, TriMesh};
use egogen_envs::motion::{EPISODE, MotionEnv, TERMS};
use egogen_envs::{StepResult, VecEnv};
use std::sync::Arc;

/// The recorded motion of one episode.
#[derive(Clone, Debug, Default)]
pub struct Film {
    /// T x 93 bodies in the world, 40 frames per second; the first two frames are the seed.
    pub frames: Vec<f32>,
    /// 10 shape coefficients.
    pub betas: Vec<f32>,
    /// Where it happened.
    pub setting: Setting,
    /// What stood there, in a room.
    pub room: Option<Arc<TriMesh>>,
}

/// One episode, measured.
#[derive(Clone, Debug, Default)]
pub struct Played {
    /// Number of the person.
    pub person: usize,
    /// Number of the start.
    pub start: u64,
    /// Number of the scene, whose people are not independent of each other.
    pub group: usize,
    /// The environment's figures, in the order of [`EPISODE`].
    pub figures: [f32; EPISODE.len()],
    /// Mean distance between predicted and skinned markers, metres: how far the prediction is from any body.
    pub body_error: f32,
    /// Mean ||VP|| of its frames under the shipped pose prior (eq. 9).
    pub pose_norm: f32,
    /// Mean slide per stance of its primitives, metres.
    pub slide: f32,
    /// Mean per-dimension KL to N(0, I) of the actions, nats; NaN for baselines.
    pub kl: f32,
    /// Mean 0.5 mean(mu^2) of the actions; NaN for baselines.
    pub kl_mean: f32,
    /// steps x 9 weighted reward terms, in the order of [`TERMS`].
    pub terms: Vec<f32>,
    /// Whether a penetration ended it.
    pub stopped: bool,
    /// The motion, where it was asked for.
    pub film: Option<Film>,
    /// What the motion tells, where it was looked at.
    pub measured: Option<Measured>,
}

impl Played {
    /// The environment's figure `name`; NaN where there is none of that name.
    pub fn figure(&self, name: &str) -> f32 {
        EPISODE.iter().position(|&n| n == name).map_or(f32::NAN, |k| self.figures[k])
    }

    /// How it ended, in words.
    pub fn outcome(&self) -> String {
        let how = Fate::of(self).words();
        format!("{how} after {} steps, {:.2} m from the goal", self.figure("steps"), self.figure("final_dist"))
    }
}

/// Sums over the steps of an episode under way.
#[derive(Clone, Default)]
struct Running {
    steps: f32,
    sums: [f32; 5],
    terms: Vec<f32>,
    film: Film,
}

/// The first episode of every environment of `env` (one start each, numbered from 0) with `actor`. `record` keeps the motion.
pub fn play(env: &mut MotionEnv, actor: &Actor, seed: u64, record: bool) -> Result<Vec<Played>> {
    let n = env.num_envs();
    let (prior, width, ends) = (PosePrior::embedded()?, env.spec().info.len(), env.task().end_on_penetration);
    let (mut obs, mut result) = (Vec::new(), StepResult::default());
    env.reset(seed, &mut obs)?;
    let mut running = vec![Running::default(); n];
    let mut done: Vec<Option<Played>> = vec![None; n];
    for (i, r) in running.iter_mut().enumerate() {
        let room = env.room(i).and_then(|room| room.mesh.clone());
        let betas = env.people().betas[i * BETAS..(i + 1) * BETAS].to_vec();
        r.film = Film { frames: vec![], betas, setting: env.setting(i).clone(), room };
    }
    for step in 0..u64::from(env.task().max_depth) {
        let choice = actor.choose(env, &obs, &done.iter().map(Option::is_none).collect::<Vec<_>>(), seed, step)?;
        env.step(&choice.latents, &mut result)?;
        for i in (0..n).filter(|&i| done[i].is_none()).collect::<Vec<_>>() {
            let kl = [&choice.kl, &choice.kl_mean].map(|k| k.get(i).copied().unwrap_or(f32::NAN));
            running[i].add(env, &prior, i, kl, record);
            running[i].terms.extend_from_slice(&result.info[i * width..][..TERMS.len()]);
            if result.terminated[i] || result.truncated[i] {
                let figures = result.episode[i * EPISODE.len()..].first_chunk().copied().unwrap_or_default();
                let mut played = std::mem::take(&mut running[i]).finish(i, figures, record);
                played.stopped = ends && played.figure("penetration") > 0.5;
                done[i] = Some(played);
            }
        }
        if done.iter().all(Option::is_some) {
            break;
        }
        std::mem::swap(&mut obs, &mut result.obs);
    }
    let missing = done.iter().position(Option::is_none);
    match missing {
        Some(i) => Err(Error::run(format!("the episode of start {i} did not end within its step limit"))),
        None => Ok(done.into_iter().flatten().collect()),
    }
}

impl Running {
    fn add(&mut self, env: &MotionEnv, prior: &PosePrior, i: usize, kl: [f32; 2], record: bool) {
        let prims = env.primitives();
        let markers = &prims.markers[i * FRAMES * MARKER_DIM..][..FRAMES * MARKER_DIM];
        let params = &prims.params[i * FRAMES * PARAMS..][..FRAMES * PARAMS];
        let mut betas = [0.0; BETAS];
        betas.copy_from_slice(&self.film.betas);
        let shaped = env.sim().body().shape(&betas);
        let norms = prior.norms(&params[SEED * PARAMS..]);
        let pose_norm = norms.iter().sum::<f32>() / norms.len() as f32;
        let figures = [body_error(&shaped, markers, params), pose_norm, stance_slide(markers), kl[0], kl[1]];
        self.sums.iter_mut().zip(figures).for_each(|(sum, x)| *sum += x);
        if record {
            prims.record(i, &shaped, &mut self.film.frames);
        }
        self.steps += 1.0;
    }

    fn finish(self, person: usize, figures: [f32; EPISODE.len()], record: bool) -> Played {
        let [body_error, pose_norm, slide, kl, kl_mean] = self.sums.map(|s| s / self.steps);
        let (start, group, film) = (person as u64, person, record.then_some(self.film));
        Played { person, start, group, figures, body_error, pose_norm, slide, kl, kl_mean, terms: self.terms, film, ..Default::default() }
    }
}

/// Mean distance of predicted from skinned markers over the predicted frames. The markers that are fed back lie half-way
/// between the two, so the distance is twice theirs from the skinned ones.
fn body_error(shaped: &egogen::body::ShapedBody, markers: &[f32], params: &[f32]) -> f32 {
    let mut skinned = [0.0; MARKER_DIM];
    let (mut sum, mut count) = (0.0f64, 0);
    for (m, p) in markers.chunks_exact(MARKER_DIM).zip(params.chunks_exact(PARAMS)).skip(SEED) {
        shaped.markers(&shaped.pose(p), &mut skinned);
        for (a, b) in m.chunks_exact(3).zip(skinned.chunks_exact(3)) {
            sum += 2.0 * f64::from(glam::Vec3::from_slice(a).distance(glam::Vec3::from_slice(b)));
            count += 1;
        }
    }
    (sum / f64::from(count)) as f32
}
