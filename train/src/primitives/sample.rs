//! Training batches: windows of motion for the predictor, bodies for the regressor.

use super::predictor::Batch;
use super::regressor::Truth;
use super::settings::Frames;
use egogen::body::{BETAS, BodyModel, Frame, MARKER_DIM, PARAMS, ShapedBody, TRANSL, canonical_frame, joint};
use egogen::kernels::{Decoder, Regressor};
use egogen::motion::{FRAMES, FUTURE, LATENT, MotionSet, SEED};
use egogen::rng::{Stream, stream};
use egogen::{Error, Result};
use glam::Vec3;
use rand::RngExt;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// People whose forward and backward pass is one task; a batch is cut into such shards whatever the number of threads.
pub const SHARD: usize = 32;
/// Floats of a seed.
const SEED_DIM: usize = SEED * MARKER_DIM;

/// Standard normal numbers.
pub fn normals(rng: &mut Stream, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.sample(StandardNormal)).collect()
}

/// Copies row `row` of `rows` of one frame of a time-major array.
fn put(to: &mut [f32], rows: usize, t: usize, row: usize, frame: &[f32]) {
    let at = (t * rows + row) * MARKER_DIM;
    to[at..at + MARKER_DIM].copy_from_slice(frame);
}

/// The manoeuvre of the primitive at `start`: classes of speed, change of speed, and turn.
fn manoeuvre(set: &MotionSet, clip: usize, start: usize) -> [i32; 3] {
    let frame = |t: usize| set.frame(clip, start + t);
    let half = |a: usize, b: usize| frame(a).inverse().point(frame(b).transl).y;
    let (first, second) = (half(0, FRAMES / 2), half(FRAMES / 2, FRAMES - 1));
    let x = frame(0).inverse().dir(frame(FRAMES - 1).rot.x_axis);
    let class = |v: f32, width: f32, most: i32| ((v / width).round() as i32).clamp(-most, most);
    // Half a primitive takes a quarter of a second: 0.3 m/s, 0.25 m/s and 10 degrees.
    let turn = x.y.atan2(x.x);
    [class(first, 0.075, 6), class(second - first, 0.06, 4), class(turn, 10f32.to_radians(), 5)]
}

/// Weights that even out how often each class is drawn (see [`Settings::favour`](super::settings::Settings)).
fn even_out(classes: &[[i32; 3]], favour: f32) -> Vec<f32> {
    let mut counts = BTreeMap::new();
    classes.iter().for_each(|c| *counts.entry(c).or_insert(0u32) += 1);
    classes.iter().map(|c| (counts[c] as f32).powf(-favour)).collect()
}

/// A batch of people who each walk through up to `depth` consecutive primitives of a clip, then start anew, as they do where their
/// clip ends before.
pub struct Lanes<'a> {
    set: &'a MotionSet,
    windows: Vec<(usize, usize)>,
    /// Running sum of the windows' weights.
    weights: Vec<f64>,
    depth: u64,
    at: Vec<(usize, usize)>,
    /// Who starts anew in this step.
    fresh: Vec<bool>,
    /// rows x 2 x 201: where the predictions led.
    seeds: Vec<f32>,
}

impl<'a> Lanes<'a> {
    /// `rows` people through up to `depth` primitives each; `favour` as in [`Settings`](super::settings::Settings).
    pub fn new(set: &'a MotionSet, rows: usize, depth: usize, favour: f32) -> Result<Self> {
        let windows = set.windows(FRAMES, 1);
        if windows.is_empty() {
            return Err(Error::invalid(format!("no clip holds {FRAMES} frames")));
        }
        let classes: Vec<[i32; 3]> = windows.par_iter().map(|&(clip, start)| manoeuvre(set, clip, start)).collect();
        let single: BTreeMap<(usize, usize), f32> = windows.iter().copied().zip(even_out(&classes, favour)).collect();
        // A start counts as the mean of the primitives that follow.
        let weight = |&(clip, start): &(usize, usize)| -> f64 {
            let (sum, n) = (0..depth)
                .filter_map(|k| single.get(&(clip, start + k * FUTURE)))
                .fold((0.0, 0), |(sum, n), w| (sum + f64::from(*w), n + 1));
            sum / f64::from(n)
        };
        let running = |sum: &mut f64, w: &(usize, usize)| {
            *sum += weight(w);
            Some(*sum)
        };
        let weights = windows.iter().scan(0.0, running).collect();
        let (at, fresh, seeds) = (vec![(0, 0); rows], vec![true; rows], vec![0.0; rows * SEED_DIM]);
        Ok(Self { set, windows, weights, depth: depth as u64, at, fresh, seeds })
    }

    /// Whether `step` starts anew, so that training may be cut there.
    pub fn is_start(&self, step: u64) -> bool {
        step.is_multiple_of(self.depth)
    }

    /// The shards of step `step`: true futures in the true canonical frames, seeds as the model left them.
    pub fn batch(&mut self, seed: u64, step: u64) -> Vec<Batch> {
        let begins = self.is_start(step);
        let rng = &mut stream(seed, "windows", step);
        let total = self.weights[self.weights.len() - 1];
        for (at, fresh) in self.at.iter_mut().zip(&mut self.fresh) {
            at.1 += FUTURE;
            *fresh = begins || at.1 + FRAMES > self.set.clips[at.0].len();
            if *fresh {
                let r = rng.random_range(0.0..total);
                *at = self.windows[self.weights.partition_point(|&w| w <= r).min(self.windows.len() - 1)];
            }
        }
        let shards: Vec<usize> = (0..self.at.len()).step_by(SHARD).collect();
        shards.par_iter().map(|&first| self.shard(first, &mut stream(seed, "latent noise", step << 16 | first as u64))).collect()
    }

    fn shard(&self, first: usize, rng: &mut Stream) -> Batch {
        let rows = SHARD.min(self.at.len() - first);
        let mut b = Batch {
            rows,
            seed: vec![0.0; rows * SEED_DIM],
            target: vec![0.0; rows * (1 + FUTURE) * MARKER_DIM],
            eps: normals(rng, rows * LATENT),
        };
        let mut window = vec![0.0; FRAMES * MARKER_DIM];
        for row in 0..rows {
            let (clip, start) = self.at[first + row];
            self.set.canonical_window(clip, start, FRAMES, &mut window);
            let own = &self.seeds[(first + row) * SEED_DIM..(first + row + 1) * SEED_DIM];
            let seed = if self.fresh[first + row] { &window[..SEED_DIM] } else { own };
            for (t, frame) in seed.chunks_exact(MARKER_DIM).enumerate() {
                put(&mut b.seed, rows, t, row, frame);
            }
            for (t, frame) in window[MARKER_DIM..].chunks_exact(MARKER_DIM).enumerate() {
                put(&mut b.target, rows, t, row, frame);
            }
        }
        b
    }

    /// Takes the last predicted frames of each shard (time-major, as `Tape::frames`) as the next seeds.
    pub fn advance(&mut self, ends: &[&[f32]], body: &ShapedBody, regressor: &Regressor, frames: Frames) -> Result<()> {
        if self.depth == 1 {
            return Ok(());
        }
        for (i, frames) in ends.iter().enumerate() {
            let first = i * SHARD;
            let rows = SHARD.min(self.at.len() - first);
            let last = &frames[frames.len() - SEED * rows * MARKER_DIM..];
            let seeds = &mut self.seeds[first * SEED_DIM..(first + rows) * SEED_DIM];
            for (row, seed) in seeds.chunks_exact_mut(SEED_DIM).enumerate() {
                for (t, frame) in seed.chunks_exact_mut(MARKER_DIM).enumerate() {
                    frame.copy_from_slice(&last[(t * rows + row) * MARKER_DIM..][..MARKER_DIM]);
                }
            }
        }
        let next = |&(clip, start): &(usize, usize)| {
            // Whose clip ends here starts anew in any case.
            let end = (start + FUTURE).min(self.set.clips[clip].len() - 1);
            self.set.frame(clip, end).inverse().compose(&self.set.frame(clip, start))
        };
        let truth: Option<Vec<Frame>> = (frames == Frames::Truth).then(|| self.at.iter().map(next).collect());
        reseed(&mut self.seeds, body, regressor, truth.as_deref())
    }
}

/// Turns the last frames of predictions (n x 2 x 201) into the next seeds as the simulation does, planted feet apart: half predicted markers,
/// half those of the regressed body, in the canonical frame of the regressed body; or in the frames `locals` (n, from the old
/// canonical frames) where given.
pub fn reseed(seeds: &mut [f32], body: &ShapedBody, regressor: &Regressor, locals: Option<&[Frame]>) -> Result<()> {
    let frames = seeds.len() / MARKER_DIM;
    let betas = body.betas().repeat(frames);
    let mut params = vec![0.0; frames * PARAMS];
    regressor.regress(seeds, &betas, &mut params)?;
    seeds.par_chunks_mut(SEED_DIM).zip(params.par_chunks(SEED * PARAMS)).enumerate().for_each(|(i, (seed, params))| {
        let mut local = locals.map_or(Frame::IDENTITY, |l| l[i]);
        for (t, (frame, params)) in seed.chunks_exact_mut(MARKER_DIM).zip(params.chunks_exact(PARAMS)).enumerate() {
            let posed = body.pose(params);
            if t == 0 && locals.is_none() {
                local = canonical_frame(posed.pos[joint::PELVIS], posed.pos[joint::L_HIP], posed.pos[joint::R_HIP]).inverse();
            }
            let mut skin = [0.0; MARKER_DIM];
            body.markers(&posed, &mut skin);
            for (a, b) in frame.chunks_exact_mut(3).zip(skin.chunks_exact(3)) {
                let p = local.point(0.5 * (Vec3::from_slice(a) + Vec3::from_slice(b)));
                a.copy_from_slice(&p.to_array());
            }
        }
    });
    Ok(())
}

/// Inputs of the regressor with what should come out.
pub struct Bodies {
    /// rows x 201.
    pub markers: Vec<f32>,
    /// rows x 10.
    pub betas: Vec<f32>,
    pub truth: Vec<Truth>,
    /// Which of [`BodySource::shapes`] each is.
    pub shape: Vec<usize>,
}

/// Draws bodies: recorded poses on several shapes with marker noise, and frames that the predictor made.
pub struct BodySource<'a> {
    set: &'a MotionSet,
    /// The mean shape first.
    pub shapes: Vec<ShapedBody>,
    /// The only shape to draw, or all, the mean one half of the time.
    only: Option<usize>,
    /// Frames of markers predicted from the prior, for the mean shape.
    predicted: Vec<f32>,
}

/// Shapes to train on.
const SHAPES: u64 = 64;
/// Largest standard deviation of marker noise, metres.
const NOISE: f32 = 0.015;

impl<'a> BodySource<'a> {
    pub fn new(set: &'a MotionSet, model: &BodyModel, seed: u64) -> Self {
        let shape = |i| if i == 0 { vec![0.0; BETAS] } else { normals(&mut stream(seed, "shapes", i), BETAS) };
        Self { set, shapes: (0..SHAPES).map(|i| model.shape(&shape(i))).collect(), only: None, predicted: Vec::new() }
    }

    /// Draws the shape of `betas` (10) alone, which is the second of the shapes.
    pub fn one(set: &'a MotionSet, model: &BodyModel, betas: &[f32]) -> Self {
        Self { set, shapes: vec![model.shape(&[0.0; BETAS]), model.shape(betas)], only: Some(1), predicted: Vec::new() }
    }

    /// Replaces the predicted frames by fresh ones of the prior.
    pub fn predict(&mut self, decoder: &Decoder, rng: &mut Stream) -> Result<()> {
        let windows = self.set.windows(SEED, 1);
        let n = 2 * SHARD;
        let mut seeds = vec![0.0; n * SEED_DIM];
        for seed in seeds.chunks_exact_mut(SEED_DIM) {
            let (clip, start) = windows[rng.random_range(0..windows.len())];
            self.set.canonical_window(clip, start, SEED, seed);
        }
        self.predicted.resize(n * FUTURE * MARKER_DIM, 0.0);
        decoder.decode(&seeds, &normals(rng, n * LATENT), &mut self.predicted)
    }

    /// `rows` bodies.
    pub fn draw(&self, rows: usize, rng: &mut Stream) -> Bodies {
        let mut b = Bodies { markers: Vec::new(), betas: Vec::new(), truth: Vec::new(), shape: Vec::new() };
        let frames = self.predicted.len() / MARKER_DIM;
        for _ in 0..rows {
            if frames > 0 && rng.random_range(0..4) == 0 {
                let at = rng.random_range(0..frames) * MARKER_DIM;
                let markers = self.predicted[at..at + MARKER_DIM].to_vec();
                b.markers.extend_from_slice(&markers);
                b.truth.push(Truth { markers, pose: None });
                b.shape.push(0);
            } else {
                let any = if rng.random() { 0 } else { rng.random_range(0..self.shapes.len()) };
                let shape = self.only.unwrap_or(any);
                let truth = self.recorded(shape, rng);
                let noise = (NOISE * rng.random_range(-0.5..1.0f32)).max(0.0);
                b.markers.extend(truth.markers.iter().map(|v| v + noise * rng.sample::<f32, _>(StandardNormal)));
                b.truth.push(truth);
                b.shape.push(shape);
            }
            b.betas.extend_from_slice(self.shapes[b.shape[b.shape.len() - 1]].betas());
        }
        b
    }

    /// A recorded pose on shape `shape`, in the canonical frame of up to 19 frames earlier, feet on the floor.
    pub fn recorded(&self, shape: usize, rng: &mut Stream) -> Truth {
        let mean = &self.shapes[0];
        let clip = {
            // By length: a frame of all frames.
            let mut at = rng.random_range(0..self.set.frames());
            let mut clip = 0;
            while at >= self.set.clips[clip].len() {
                at -= self.set.clips[clip].len();
                clip += 1;
            }
            clip
        };
        let t = rng.random_range(0..self.set.clips[clip].len());
        let start = t.saturating_sub(rng.random_range(0..FRAMES));
        let mut params = self.set.clips[clip].params[t * PARAMS..(t + 1) * PARAMS].to_vec();
        mean.transform_params(&mut params, &self.set.frame(clip, start).inverse());
        let body = &self.shapes[shape];
        let mut markers = vec![0.0; MARKER_DIM];
        mean.markers(&mean.pose(&params), &mut markers);
        if shape != 0 {
            let floor = lowest(&markers);
            let shift = mean.joints()[joint::PELVIS] - body.joints()[joint::PELVIS];
            params[0] += shift.x;
            params[1] += shift.y;
            body.markers(&body.pose(&params), &mut markers);
            let lift = floor - lowest(&markers);
            params[2] += lift;
            markers.iter_mut().skip(2).step_by(3).for_each(|z| *z += lift);
        }
        Truth { markers, pose: Some((egogen::body::local_rotations(&params), Vec3::from_slice(&params[TRANSL]))) }
    }
}

fn lowest(markers: &[f32]) -> f32 {
    markers.iter().skip(2).step_by(3).fold(f32::INFINITY, |a, &b| a.min(b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::motion::{ClipMarkers, MotionWeights};
    use egogen::sim::{People, Primitives, World};

    #[test]
    fn rare_classes_are_favoured() {
        let (common, rare) = ([0, 0, 1], [2, 0, 0]);
        let w = even_out(&[common, common, common, common, rare], 0.6);
        // Together the four weigh 4^0.4 against 1.
        assert!((w[..4].iter().sum::<f32>() / w[4] - 4f32.powf(0.4)).abs() < 1e-5);
    }

    /// A person of the shipped model who walks `primitives` primitives, as a recording; and the regressor.
    fn walked(primitives: u64) -> (MotionSet, ShapedBody, Regressor) {
        let world = World::embedded().unwrap();
        let body = world.sim.body().shape(&[0.0; BETAS]);
        let mut people = People::new(1);
        people.place(0, world.sim.body(), &world.train.seeds[0], 0.0, 0.0, 0.0).unwrap();
        let (mut film, mut out) = (Vec::new(), Primitives::default());
        for k in 0..primitives {
            world.sim.step(&mut people, &normals(&mut stream(4, "test walk", k), LATENT), &mut out).unwrap();
            out.record(0, &body, &mut film);
        }
        let dir = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/motion"));
        let weights = MotionWeights::load(dir).unwrap();
        let set = MotionSet { clips: vec![ClipMarkers::from_params("walk".into(), &body, film)] };
        (set, body, Regressor::new(&weights.regressor).unwrap())
    }

    /// One row of a time-major array.
    fn row(data: &[f32], rows: usize, row: usize, frames: std::ops::Range<usize>) -> Vec<f32> {
        frames.flat_map(|t| data[(t * rows + row) * MARKER_DIM..][..MARKER_DIM].to_vec()).collect()
    }

    #[test]
    fn lanes_follow_their_clips_and_start_anew_at_their_end() {
        let (set, body, regressor) = walked(4);
        let (rows, depth) = (5, 8);
        for frames in [Frames::Truth, Frames::Own] {
            let mut lanes = Lanes::new(&set, rows, depth, 0.5).unwrap();
            let (mut anew, mut went_on) = (0, 0);
            let mut before = vec![(0, 0); rows];
            for step in 0..2 * depth as u64 {
                let shard = lanes.batch(7, step).remove(0);
                for (i, &(_, last)) in before.iter().enumerate() {
                    let (clip, start) = lanes.at[i];
                    let mut window = vec![0.0; FRAMES * MARKER_DIM];
                    set.canonical_window(clip, start, FRAMES, &mut window);
                    assert_eq!(row(&shard.target, rows, i, 0..FUTURE + 1), window[MARKER_DIM..]);
                    let apart = row(&shard.seed, rows, i, 0..SEED).iter().zip(&window).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                    let over = last + FUTURE + FRAMES > set.clips[0].len();
                    assert_eq!(lanes.fresh[i], lanes.is_start(step) || over, "row {i} of step {step}");
                    if lanes.fresh[i] {
                        assert_eq!(apart, 0.0);
                        anew += usize::from(!lanes.is_start(step));
                    } else {
                        // Who predicts what was recorded has its next seed there too, but for the regressor's error.
                        assert_eq!(start, last + FUTURE);
                        assert!(apart < 0.03, "row {i} of step {step} begins {apart} m away");
                        went_on += 1;
                    }
                }
                before.clone_from(&lanes.at);
                lanes.advance(&[&shard.target], &body, &regressor, frames).unwrap();
            }
            assert!(anew > 0 && went_on > rows, "{anew} and {went_on}");
        }
    }
}
