//! How people move: feet, speeds and turns, in recordings and in roll-outs of the prior through the simulation.

use super::sample::normals;
use egogen::body::{BETAS, Frame, MARKER_DIM, PARAMS, ShapedBody, joint};
use egogen::metrics::{contact_score, foot_heights, rigid_marker_error, stance_slide};
use egogen::motion::{FPS, FRAMES, FUTURE, LATENT, MotionSet, SEED};
use egogen::rng::stream;
use egogen::sim::{People, Primitives, SeedMotion, Sim};
use egogen::{Error, Result};
use glam::Vec3;
use rand::RngExt;
use serde::Serialize;

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

/// Primitives of a roll-out, and those after which it is looked at.
const ROLLOUT: usize = 20;
const LOOK: [usize; 4] = [1, 5, 11, 20];

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
    fn add(&mut self, markers: &[f32], end: &Frame) {
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

/// Of recorded motion.
pub fn data_gait(set: &MotionSet) -> Result<Gait> {
    let mut sums = GaitSums::default();
    let mut window = vec![0.0; FRAMES * MARKER_DIM];
    for (clip, start) in set.windows(FRAMES, FUTURE) {
        set.canonical_window(clip, start, FRAMES, &mut window);
        sums.add(&window, &set.frame(clip, start).inverse().compose(&set.frame(clip, start + FUTURE)));
    }
    Ok(sums.finish())
}

/// Of `n` people who start as recorded in `set` and are led by the prior.
pub fn roll_out(sim: &Sim, body: &ShapedBody, set: &MotionSet, n: usize) -> Result<(Gait, Vec<Drift>)> {
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
pub fn spread(values: impl Iterator<Item = f32>) -> [f32; 2] {
    let values: Vec<f32> = values.collect();
    let m = mean(values.iter().copied());
    [m, mean(values.iter().map(|v| (v - m).powi(2))).sqrt()]
}

/// Mean, summed in double precision.
pub fn mean(values: impl Iterator<Item = f32>) -> f32 {
    let (sum, n) = values.fold((0.0f64, 0), |(s, n), v| (s + v as f64, n + 1));
    (sum / n as f64) as f32
}

/// Mean distance of markers, mm.
pub fn distance(a: &[f32], b: &[f32]) -> f32 {
    let pairs = a.chunks_exact(3).zip(b.chunks_exact(3));
    1000.0 * mean(pairs.map(|(a, b)| Vec3::from_slice(a).distance(Vec3::from_slice(b))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_by_hand() {
        assert_eq!(spread([1.0, 3.0].into_iter()), [2.0, 1.0]);
        assert_eq!(percentiles(&mut [3.0, 1.0, 2.0]), [1.0, 2.0, 2.0]);
        assert!((distance(&[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], &[0.003, 0.004, 0.0, 1.0, 1.0, 1.0]) - 2.5).abs() < 1e-4);
    }
}
