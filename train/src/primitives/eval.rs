//! Judging a motion model: on held-out motion, and in roll-outs of its prior through the simulation.

use super::gait::{Drift, Gait, data_gait, distance, mean, roll_out, spread};
use super::predictor::{Ready, Tape};
use super::sample::normals;
use super::seeds::make_seeds;
use crate::Result;
use crate::evaluate::{Actor, Greedy, Played, play};
use egogen::Error;
use egogen::body::{BETAS, BodyModel, MARKER_DIM, PARAMS, ShapedBody};
use egogen::kernels::{MotionEngine, Regressor};
use egogen::metrics::kl_to_standard;
use egogen::motion::{FRAMES, FUTURE, LATENT, MotionSet, MotionWeights, Origin, PredictorWeights, SEED};
use egogen::rng::stream;
use egogen::scene::{SparseKind, SparseScenes};
use egogen::sim::{SeedBank, Sim};
use egogen_envs::motion::{MotionEnv, MotionTask};
use serde::Serialize;
use std::fmt;
use std::sync::Arc;

/// Errors on motion the model has not seen; millimetres, mean distance per marker.
#[derive(Clone, Debug, Serialize)]
pub struct HeldOut {
    /// Windows of 20 frames.
    pub windows: usize,
    /// With the encoder's mean latent: over all 18 frames, and in the last.
    pub posterior: [f32; 2],
    /// With a latent of zero, and with one drawn from the prior.
    pub zero: f32,
    pub prior: f32,
    /// Skinned markers of bodies regressed from true markers, and from those of the posterior mean, against the true markers.
    pub reskinned: f32,
    pub reskinned_posterior: f32,
    /// Latent dimensions whose mean varies by more than 0.01.
    pub active: usize,
    /// Divergence from the prior, nats.
    pub nats: f32,
}

/// Everything measured.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    pub model: String,
    pub held_out: HeldOut,
    /// Of the training data.
    pub data: Gait,
    /// Of prior roll-outs.
    pub prior: Gait,
    pub drift: Vec<Drift>,
    pub greedy: GreedyWalk,
}

/// Walks to goals by the best of some prior latents at each step.
#[derive(Clone, Debug, Serialize)]
pub struct GreedyWalk {
    pub episodes: usize,
    pub candidates: usize,
    /// Share that came within 0.1 m at a primitive's end, in at most 11 primitives.
    pub success: f32,
    /// Mean primitives of those.
    pub steps: f32,
    /// Mean distance left of the others, m.
    pub missed_by: f32,
}

/// Sizes of an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// People of the roll-outs.
    pub people: usize,
    /// Episodes of the greedy walk.
    pub episodes: usize,
}

/// Judges `weights`.
pub fn evaluate(weights: &MotionWeights, body: &Arc<BodyModel>, train: &MotionSet, held_out: &MotionSet, effort: Effort) -> Result<Report> {
    let sim = Arc::new(Sim::new(body.clone(), Arc::new(MotionEngine::new(weights)?)));
    let mean = body.shape(&[0.0; BETAS]);
    let (prior, drift) = roll_out(&sim, &mean, train, effort.people)?;
    Ok(Report {
        model: weights.hash.clone(),
        held_out: judge_held_out(weights, &mean, held_out)?,
        data: data_gait(train)?,
        prior,
        drift,
        greedy: greedy(&sim, make_seeds(&sim, train)?, effort.episodes)?,
    })
}

/// All windows of `set` in canonical frames with that origin, time-major: their number, seeds and futures.
fn windows_of(set: &MotionSet, origin: Origin) -> Result<(usize, Vec<f32>, Vec<f32>)> {
    let windows = set.windows(FRAMES, 5);
    let n = windows.len();
    if n == 0 {
        return Err(Error::invalid("no held-out clip holds a primitive").into());
    }
    let (mut seed, mut future) = (vec![0.0; n * SEED * MARKER_DIM], vec![0.0; n * FUTURE * MARKER_DIM]);
    let mut window = vec![0.0; FRAMES * MARKER_DIM];
    for (i, (clip, start)) in windows.into_iter().enumerate() {
        set.window(origin, clip, start, FRAMES, &mut window);
        for (t, frame) in window.chunks_exact(MARKER_DIM).enumerate() {
            let (to, t) = if t < SEED { (&mut seed, t) } else { (&mut future, t - SEED) };
            to[(t * n + i) * MARKER_DIM..][..MARKER_DIM].copy_from_slice(frame);
        }
    }
    Ok((n, seed, future))
}

/// Distance of the posterior mean from the motion of `set`, mm: over all 18 frames, and in the last.
pub fn held_out_error(predictor: &PredictorWeights, set: &MotionSet) -> Result<[f32; 2]> {
    let (n, seed, future) = windows_of(set, Origin::Floor)?;
    let ready = Ready::new(predictor)?;
    let mut tape = Tape::default();
    tape.encode(&ready, &seed, &future, n);
    let mu = tape.mu.clone();
    tape.decode(&ready, &seed, &mu, n, FUTURE);
    let last = (FUTURE - 1) * n * MARKER_DIM;
    let made = &tape.frames[n * MARKER_DIM..];
    Ok([distance(made, &future), distance(&made[last..], &future[last..])])
}

/// Reconstruction of all windows of `set`, one each 5 frames.
///
/// # Errors
/// If no clip holds a window.
pub fn judge_held_out(weights: &MotionWeights, body: &ShapedBody, set: &MotionSet) -> Result<HeldOut> {
    let (n, seed, future) = windows_of(set, weights.config.canonical)?;
    let ready = Ready::new(&weights.predictor)?;
    let mut tape = Tape::default();
    tape.encode(&ready, &seed, &future, n);
    let (mu, logvar) = (tape.mu.clone(), tape.logvar.clone());
    let mut run = |z: &[f32]| {
        tape.decode(&ready, &seed, z, n, FUTURE);
        tape.frames[n * MARKER_DIM..].to_vec()
    };
    let posterior = run(&mu);
    let regressor = Regressor::new(&weights.regressor)?;
    let reskin = |markers: &[f32]| -> Result<Vec<f32>> {
        let frames = markers.len() / MARKER_DIM;
        let mut params = vec![0.0; frames * PARAMS];
        regressor.regress(markers, &vec![0.0; frames * BETAS], &mut params)?;
        let mut out = vec![0.0; markers.len()];
        body.markers_batch(&params, &mut out);
        Ok(out)
    };
    let last = (FUTURE - 1) * n * MARKER_DIM;
    Ok(HeldOut {
        windows: n,
        posterior: [distance(&posterior, &future), distance(&posterior[last..], &future[last..])],
        zero: distance(&run(&vec![0.0; n * LATENT]), &future),
        prior: distance(&run(&normals(&mut stream(0, "held-out prior", 0), n * LATENT)), &future),
        reskinned: distance(&reskin(&future)?, &future),
        reskinned_posterior: distance(&reskin(&posterior)?, &future),
        active: active(&mu),
        nats: kl_to_standard(&mu, &logvar) / n as f32,
    })
}

/// Dimensions of `mu` (n x latent) with a variance over 0.01.
fn active(mu: &[f32]) -> usize {
    (0..LATENT).filter(|&k| spread(mu[k..].iter().step_by(LATENT).copied())[1].powi(2) > 0.01).count()
}

/// Goals 2 to 3 m away with nothing in the way; at each step the best of 64 prior latents.
fn greedy(sim: &Arc<Sim>, bank: SeedBank, episodes: usize) -> Result<GreedyWalk> {
    let (_, held_out) = bank.halves();
    let scene = SparseScenes { kind: SparseKind::Open, min_distance: 2.0, max_distance: 3.0, ..Default::default() };
    let task = MotionTask { scene, ..Default::default() };
    let mut env = MotionEnv::evaluation(task, sim.clone(), Arc::new(held_out), episodes, 0)?;
    let played = play(&mut env, &Actor::Greedy(Greedy::default()), 0, false)?;
    let (arrived, missed): (Vec<_>, Vec<_>) = played.iter().partition(|p| p.figure("success") > 0.5);
    let average = |of: &[&Played], name: &str| if of.is_empty() { 0.0 } else { mean(of.iter().map(|p| p.figure(name))) };
    Ok(GreedyWalk {
        episodes,
        candidates: Greedy::default().candidates,
        success: arrived.len() as f32 / episodes as f32,
        steps: average(&arrived, "steps"),
        missed_by: average(&missed, "final_dist"),
    })
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let h = &self.held_out;
        writeln!(f, "held out, mm ({} windows)", h.windows)?;
        writeln!(f, "  posterior mean {:.1}, last frame {:.1}; zero {:.1}; prior {:.1}", h.posterior[0], h.posterior[1], h.zero, h.prior)?;
        writeln!(f, "  re-skinned: from true markers {:.1}, from the posterior mean's {:.1}", h.reskinned, h.reskinned_posterior)?;
        writeln!(f, "  active dimensions {}, {:.1} nats", h.active, h.nats)?;
        for (name, g) in [("data", &self.data), ("prior", &self.prior)] {
            let three = |v: [f32; 3], d: usize| v.map(|x| format!("{x:.d$}")).join(" / ");
            let feet = format!("contact {:.3}, slide {:.2} cm, lowest foot {:.1} +- {:.1} cm", g.contact, g.slide, g.foot[0], g.foot[1]);
            writeln!(f, "{name:<6}{feet}, speed {} m/s, turn {} deg (5/50/95 %)", three(g.speed, 2), three(g.yaw, 0))?;
        }
        for d in &self.drift {
            writeln!(
                f,
                "after {:>2} primitives: lowest foot {:.1} +- {:.1} cm, pelvis {:.2} +- {:.2} m, bone markers off {:.1} mm, regression {:.1} mm",
                d.primitive, d.foot[0], d.foot[1], d.pelvis[0], d.pelvis[1], d.shape, d.regression
            )?;
        }
        let g = &self.greedy;
        let (share, steps) = (100.0 * g.success, g.steps);
        write!(
            f,
            "greedy best of {}: {share:.0} % of {} goals in {steps:.1} steps, others miss by {:.2} m",
            g.candidates, g.episodes, g.missed_by
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn active_dimensions_by_hand() {
        let mut mu = vec![0.0; 2 * LATENT];
        (mu[3], mu[5]) = (0.3, 0.1);
        // Variances 0.0225 and 0.0025.
        assert_eq!(active(&mu), 1);
    }
}
