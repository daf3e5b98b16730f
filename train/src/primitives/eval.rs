//! Judging a motion model: on held-out motion, and in roll-outs of its prior through the simulation.

use super::predictor::{Ready, Tape};
use super::sample::normals;
use super::seeds::make_seeds;
use crate::evaluate::greedy_cost;
use egogen::body::{BETAS, BodyModel, MARKER_DIM, PARAMS, ShapedBody, joint};
use egogen::kernels::{MotionEngine, Regressor};
use egogen::metrics::{contact_score, foot_heights, kl_to_standard, rigid_marker_error, stance_slide};
use egogen::motion::{FPS, FRAMES, FUTURE, LATENT, MotionSet, MotionWeights, SEED};
use egogen::rng::stream;
use egogen::sim::{People, Primitives, SeedBank, SeedMotion, Sim};
use egogen::{Error, Result};
use glam::Vec3;
use rand::RngExt;
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

/// How people move whom nobody guides.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Gait {
    /// Score of eq. 12.
    pub contact: f32,
    /// Slide per stance, cm.
    pub slide: f32,
    /// Lowest foot marker, cm: mean and standard deviation over primitives' last frames.
    pub foot: [f32; 2],
    /// Speed forward, m/s: 5, 50, 95 %.
    pub speed: [f32; 3],
    /// Turn per primitive, degrees: 5, 50, 95 %.
    pub yaw: [f32; 3],
}

/// The state of roll-outs after some primitives.
#[derive(Clone, Debug, Serialize)]
pub struct Drift {
    /// Primitives done.
    pub primitive: usize,
    /// Lowest foot marker, cm: mean and standard deviation over people.
    pub foot: [f32; 2],
    /// Error of distances between markers of one bone, mm.
    pub shape: f32,
    /// Predicted against skinned markers, mm.
    pub regression: f32,
    /// Height of the pelvis, m: mean and standard deviation over people.
    pub pelvis: [f32; 2],
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
    pub greedy: Greedy,
}

/// Walks to goals by the best of some prior latents at each step.
#[derive(Clone, Debug, Serialize)]
pub struct Greedy {
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

/// Primitives of a roll-out, and those after which it is looked at.
const ROLLOUT: usize = 20;
const LOOK: [usize; 4] = [1, 5, 11, 20];

/// Judges `weights`.
pub fn evaluate(weights: &MotionWeights, body: &Arc<BodyModel>, train: &MotionSet, held_out: &MotionSet, effort: Effort) -> Result<Report> {
    let sim = Sim::new(body.clone(), Arc::new(MotionEngine::new(weights)?));
    let mean = body.shape(&[0.0; BETAS]);
    let (prior, drift) = roll_out(&sim, &mean, train, effort.people)?;
    Ok(Report {
        model: weights.hash.clone(),
        held_out: judge_held_out(weights, &mean, held_out)?,
        data: data_gait(train)?,
        prior,
        drift,
        greedy: greedy(&sim, &make_seeds(&sim, train)?, effort.episodes)?,
    })
}

/// The two frames from `start` on as a seed.
fn seed_motion(set: &MotionSet, clip: usize, start: usize) -> SeedMotion {
    SeedMotion { params: set.clips[clip].params[start * PARAMS..(start + SEED) * PARAMS].to_vec(), betas: [0.0; BETAS] }
}

/// `n` people at the origin who start as recorded somewhere in `set`.
pub fn start_people(sim: &Sim, set: &MotionSet, n: usize, purpose: &str) -> Result<People> {
    let windows = set.windows(SEED, 1);
    if windows.is_empty() {
        return Err(Error::invalid("the motion set is empty"));
    }
    let mut people = People::new(n);
    for i in 0..n {
        let (clip, start) = windows[stream(0, purpose, i as u64).random_range(0..windows.len())];
        people.place(i, sim.body(), &seed_motion(set, clip, start), 0.0, 0.0, 0.0)?;
    }
    Ok(people)
}

fn judge_held_out(weights: &MotionWeights, body: &ShapedBody, set: &MotionSet) -> Result<HeldOut> {
    let windows = set.windows(FRAMES, 5);
    let n = windows.len();
    if n == 0 {
        return Err(Error::invalid("no held-out clip holds a primitive"));
    }
    let (mut seed, mut future) = (vec![0.0; n * SEED * MARKER_DIM], vec![0.0; n * FUTURE * MARKER_DIM]);
    let mut window = vec![0.0; FRAMES * MARKER_DIM];
    for (i, (clip, start)) in windows.into_iter().enumerate() {
        set.canonical_window(clip, start, FRAMES, &mut window);
        for (t, frame) in window.chunks_exact(MARKER_DIM).enumerate() {
            let (to, t) = if t < SEED { (&mut seed, t) } else { (&mut future, t - SEED) };
            to[(t * n + i) * MARKER_DIM..][..MARKER_DIM].copy_from_slice(frame);
        }
    }
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

/// Mean distance of markers, mm.
fn distance(a: &[f32], b: &[f32]) -> f32 {
    let pairs = a.chunks_exact(3).zip(b.chunks_exact(3));
    1000.0 * mean(pairs.map(|(a, b)| Vec3::from_slice(a).distance(Vec3::from_slice(b))))
}

/// Dimensions of `mu` (n x latent) with a variance over 0.01.
fn active(mu: &[f32]) -> usize {
    (0..LATENT).filter(|&k| spread(mu[k..].iter().step_by(LATENT).copied())[1].powi(2) > 0.01).count()
}

/// Feet, speeds and turns of primitives of 20 frames.
#[derive(Default)]
struct GaitSums {
    contact: Vec<f32>,
    slide: Vec<f32>,
    foot: Vec<f32>,
    speed: Vec<f32>,
    yaw: Vec<f32>,
}

impl GaitSums {
    /// `markers`: 20 x 201, canonical at the first frame; `end`: canonical frame of frame 18 in the first's.
    fn add(&mut self, markers: &[f32], end: &egogen::body::Frame) {
        self.contact.push(contact_score(markers));
        self.slide.push(100.0 * stance_slide(markers));
        self.foot.extend(foot_heights(&markers[markers.len() - MARKER_DIM..]).map(|z| 100.0 * z));
        self.speed.push(end.transl.y * FPS / FUTURE as f32);
        self.yaw.push(end.rot.x_axis.y.atan2(end.rot.x_axis.x).to_degrees());
    }

    fn finish(mut self) -> Gait {
        let mean = |v: &[f32]| mean(v.iter().copied());
        Gait {
            contact: mean(&self.contact),
            slide: mean(&self.slide),
            foot: spread(self.foot.into_iter()),
            speed: percentiles(&mut self.speed),
            yaw: percentiles(&mut self.yaw),
        }
    }
}

fn percentiles(v: &mut [f32]) -> [f32; 3] {
    v.sort_by(f32::total_cmp);
    [0.05, 0.5, 0.95].map(|q| v[((v.len() - 1) as f32 * q) as usize])
}

fn data_gait(set: &MotionSet) -> Result<Gait> {
    let mut sums = GaitSums::default();
    let mut window = vec![0.0; FRAMES * MARKER_DIM];
    for (clip, start) in set.windows(FRAMES, FUTURE) {
        set.canonical_window(clip, start, FRAMES, &mut window);
        sums.add(&window, &set.frame(clip, start).inverse().compose(&set.frame(clip, start + FUTURE)));
    }
    Ok(sums.finish())
}

fn roll_out(sim: &Sim, body: &ShapedBody, set: &MotionSet, n: usize) -> Result<(Gait, Vec<Drift>)> {
    let mut people = start_people(sim, set, n, "roll-out starts")?;
    let mut out = Primitives::default();
    let (mut sums, mut drift) = (GaitSums::default(), Vec::new());
    for k in 1..=ROLLOUT {
        let z = normals(&mut stream(0, "roll-out latents", k as u64), n * LATENT);
        sim.step(&mut people, &z, &mut out)?;
        for i in 0..n {
            let end = out.frames[i].inverse().compose(&people.frames[i]);
            sums.add(&out.markers[i * FRAMES * MARKER_DIM..(i + 1) * FRAMES * MARKER_DIM], &end);
        }
        if LOOK.contains(&k) {
            drift.push(look(&out, body, k));
        }
    }
    Ok((sums.finish(), drift))
}

/// The last frames of a primitive.
fn look(out: &Primitives, body: &ShapedBody, primitive: usize) -> Drift {
    let last =
        |a: &[f32], width: usize| -> Vec<f32> { a.chunks_exact(FRAMES * width).flat_map(|p| p[(FRAMES - 1) * width..].to_vec()).collect() };
    let markers = last(&out.markers, MARKER_DIM);
    let joints = last(&out.joints, out.joints.len() / out.frames.len() / FRAMES);
    let mut skinned = vec![0.0; markers.len()];
    body.markers_batch(&last(&out.params, PARAMS), &mut skinned);
    let width = joints.len() / out.frames.len();
    Drift {
        primitive,
        foot: spread(foot_heights(&markers).map(|z| 100.0 * z)),
        shape: 1000.0 * rigid_marker_error(&markers, body),
        // The markers are half predicted, half skinned.
        regression: 2.0 * distance(&markers, &skinned),
        pelvis: spread(joints.chunks_exact(width).map(|j| j[3 * joint::PELVIS + 2])),
    }
}

/// Mean and standard deviation.
fn spread(values: impl Iterator<Item = f32>) -> [f32; 2] {
    let values: Vec<f32> = values.collect();
    let m = mean(values.iter().copied());
    [m, mean(values.iter().map(|v| (v - m).powi(2))).sqrt()]
}

fn mean(values: impl Iterator<Item = f32>) -> f32 {
    let (sum, n) = values.fold((0.0f64, 0), |(s, n), v| (s + v as f64, n + 1));
    (sum / n as f64) as f32
}

/// Latents tried at each step of the greedy walk.
const CANDIDATES: usize = 64;
/// Steps of an episode, and the distance that counts as arrival.
const MAX_STEPS: usize = 11;
const ARRIVED: f32 = 0.1;
/// Episodes walked together: bounds the memory.
const TOGETHER: usize = 20;

/// Goals 2 to 3 m away in a direction within 36 degrees of where the person faces; at each step the best of 64 prior latents by
/// distance and heading.
fn greedy(sim: &Sim, bank: &SeedBank, episodes: usize) -> Result<Greedy> {
    if bank.seeds.is_empty() {
        return Err(Error::invalid("the model's own motion gives no seed that stands on the floor"));
    }
    let mut ends: Vec<(Option<usize>, f32)> = Vec::new();
    for first in (0..episodes).step_by(TOGETHER) {
        ends.extend(walk(sim, bank, first, TOGETHER.min(episodes - first))?);
    }
    let steps: Vec<f32> = ends.iter().filter_map(|e| e.0).map(|s| s as f32).collect();
    let missed: Vec<f32> = ends.iter().filter(|e| e.0.is_none()).map(|e| e.1).collect();
    Ok(Greedy {
        episodes,
        candidates: CANDIDATES,
        success: steps.len() as f32 / episodes as f32,
        steps: mean(steps.iter().copied()),
        missed_by: if missed.is_empty() { 0.0 } else { mean(missed.iter().copied()) },
    })
}

/// Episodes `first..first + n`: the step of arrival, and the distance at the end.
fn walk(sim: &Sim, bank: &SeedBank, first: usize, n: usize) -> Result<Vec<(Option<usize>, f32)>> {
    let mut people = Vec::with_capacity(n);
    for i in first..first + n {
        // From the half that is kept for evaluation.
        let (half, mut one) = (bank.seeds.len() / 2, People::new(1));
        one.place(0, sim.body(), &bank.seeds[half + i % (bank.seeds.len() - half)], 0.0, 0.0, 0.0)?;
        people.push(one);
    }
    let goals: Vec<Vec3> = (first..first + n)
        .map(|i| {
            let rng = &mut stream(0, "greedy goals", i as u64);
            let (d, a) = (rng.random_range(2.0..3.0f32), rng.random_range(-36.0..36.0f32).to_radians());
            Vec3::new(-d * a.sin(), d * a.cos(), 0.0)
        })
        .collect();
    let mut ends = vec![(None, 0.0); n];
    let mut out = Primitives::default();
    for step in 1..=MAX_STEPS {
        let open: Vec<usize> = (0..n).filter(|&i| ends[i].0.is_none()).collect();
        if open.is_empty() {
            break;
        }
        let mut tried = join(&open.iter().map(|&i| people[i].select(&[0; CANDIDATES])).collect::<Vec<_>>());
        let z: Vec<f32> = open
            .iter()
            .flat_map(|&i| normals(&mut stream(step as u64, "greedy latents", (first + i) as u64), CANDIDATES * LATENT))
            .collect();
        sim.step(&mut tried, &z, &mut out)?;
        for (slot, &i) in open.iter().enumerate() {
            let range = slot * CANDIDATES..(slot + 1) * CANDIDATES;
            let scores = range.map(|c| (c, score(&tried, &out, c, goals[i])));
            let Some((best, (_, distance))) = scores.min_by(|a, b| a.1.0.total_cmp(&b.1.0)) else { continue };
            people[i] = tried.select(&[best]);
            ends[i] = (if distance < ARRIVED { Some(step) } else { None }, distance);
        }
    }
    Ok(ends)
}

/// What a candidate is worth (less is better) and the distance of its pelvis to the goal over the floor at the end.
fn score(people: &People, out: &Primitives, c: usize, goal: Vec3) -> (f32, f32) {
    let width = out.joints.len() / out.frames.len();
    let pelvis = (c + 1) * width - width / FRAMES + 3 * joint::PELVIS;
    let p = out.frames[c].point(Vec3::from_slice(&out.joints[pelvis..]));
    let to = (goal - p).with_z(0.0);
    let distance = to.length();
    let turn = people.frames[c].rot.y_axis.truncate().angle_to(to.truncate());
    (if distance < ARRIVED { distance - 10.0 } else { greedy_cost(distance, turn) }, distance)
}

fn join(parts: &[People]) -> People {
    let mut all = People::default();
    for p in parts {
        all.frames.extend_from_slice(&p.frames);
        let pairs = [(&mut all.betas, &p.betas), (&mut all.markers, &p.markers), (&mut all.params, &p.params)];
        pairs.into_iter().for_each(|(a, b)| a.extend_from_slice(b));
        all.joints.extend_from_slice(&p.joints);
        all.views.extend_from_slice(&p.views);
    }
    all
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
    use egogen::body::Frame;

    #[test]
    fn figures_by_hand() {
        assert_eq!(spread([1.0, 3.0].into_iter()), [2.0, 1.0]);
        assert_eq!(percentiles(&mut [3.0, 1.0, 2.0]), [1.0, 2.0, 2.0]);
        assert!((distance(&[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], &[0.003, 0.004, 0.0, 1.0, 1.0, 1.0]) - 2.5).abs() < 1e-4);
        let mut mu = vec![0.0; 2 * LATENT];
        (mu[3], mu[5]) = (0.3, 0.1);
        // Variances 0.0225 and 0.0025.
        assert_eq!(active(&mu), 1);
    }

    #[test]
    fn nearer_and_better_turned_scores_less_and_arrival_wins() {
        let width = FRAMES * 72;
        let mut people = People::new(3);
        let mut out = Primitives { frames: vec![Frame::IDENTITY; 3], joints: vec![0.0; 3 * width], ..Default::default() };
        let goal = Vec3::new(0.0, 2.0, 0.9);
        people.frames[1] = Frame::planar(1.0, 0.0, 0.0);
        for (c, y) in [1.0, 1.0, 1.95].into_iter().enumerate() {
            out.joints[(c + 1) * width - 72 + 1] = y;
        }
        let [a, b, c] = [0, 1, 2].map(|c| score(&people, &out, c, goal));
        assert_eq!(a, (1.0, 1.0));
        // Turned by one radian: 0.5 (1 - cos 1).
        assert!((b.0 - 1.0 - 0.5 * (1.0 - 1f32.cos())).abs() < 1e-6);
        assert!(c.0 < -9.0 && (c.1 - 0.05).abs() < 1e-6);
    }
}
