//! How people move: feet, speeds and turns, in recordings and in roll-outs of the prior through the simulation.

use super::sample::normals;
use egogen::body::{BETAS, Frame, MARKER_DIM, PARAMS, ShapedBody, joint};
use egogen::metrics::{Collapse, collapse, contact_score, foot_heights, rigid_marker_error, stance_slide};
use egogen::motion::primitive::JOINT_DIM;
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
    /// Share of people who are collapsed, see [`collapse`].
    pub collapsed: f32,
}

/// Primitives of a roll-out, and those after which it is looked at.
const ROLLOUT: usize = 20;
const LOOK: [usize; 4] = [1, 5, 11, 20];

/// `n` beginnings recorded somewhere in `set`, all equally likely, in the world of their clips.
pub fn draw_starts(set: &MotionSet, n: usize, seed: u64, purpose: &str) -> Result<Vec<SeedMotion>> {
    let windows = set.windows(SEED, 1);
    if windows.is_empty() {
        return Err(Error::invalid("the motion set is empty"));
    }
    let draw = |i: usize| {
        let (clip, start) = windows[stream(seed, purpose, i as u64).random_range(0..windows.len())];
        SeedMotion { params: set.clips[clip].params[start * PARAMS..(start + SEED) * PARAMS].to_vec(), betas: [0.0; BETAS] }
    };
    Ok((0..n).map(draw).collect())
}

/// People at the origin who face along y and start with `starts`.
pub fn place_people(sim: &Sim, starts: &[SeedMotion]) -> Result<People> {
    let mut people = People::new(starts.len());
    for (i, start) in starts.iter().enumerate() {
        people.place(i, sim.body(), start, 0.0, 0.0, 0.0)?;
    }
    Ok(people)
}

/// `n` people at the origin who start as recorded somewhere in `set`.
pub fn start_people(sim: &Sim, set: &MotionSet, n: usize, purpose: &str) -> Result<People> {
    place_people(sim, &draw_starts(set, n, 0, purpose)?)
}

/// Planar displacement (right, ahead, metres) and turn (degrees, to the left positive) from one canonical frame to another.
pub fn displacement(from: &Frame, to: &Frame) -> [f32; 3] {
    let end = from.inverse().compose(to);
    [end.transl.x, end.transl.y, end.rot.x_axis.y.atan2(end.rot.x_axis.x).to_degrees()]
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
    /// `markers`: 20 x 201, canonical at the first frame; `way`: the [`displacement`] of frame 18 from the first.
    fn add(&mut self, markers: &[f32], way: [f32; 3]) {
        self.contact.push(contact_score(markers));
        self.slide.push(100.0 * stance_slide(markers));
        self.foot.extend(foot_heights(&markers[markers.len() - MARKER_DIM..]).map(|z| 100.0 * z));
        self.speed.push(way[1] * FPS / FUTURE as f32);
        self.yaw.push(way[2]);
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
        sums.add(&window, displacement(&set.frame(clip, start), &set.frame(clip, start + FUTURE)));
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
            let way = displacement(&out.frames[i], &people.frames[i]);
            sums.add(&out.markers[i * FRAMES * MARKER_DIM..(i + 1) * FRAMES * MARKER_DIM], way);
        }
        if LOOK.contains(&k) {
            let states: Vec<State> = (0..n).map(|i| State::of(&out, i, body)).collect();
            drift.push(Drift::of(k, &states));
        }
    }
    Ok((sums.finish(), drift))
}

/// One person at the end of a primitive.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Lowest foot marker, cm.
    pub foot: f32,
    /// Error of distances between markers of one bone, mm.
    pub shape: f32,
    /// Predicted against skinned markers, mm.
    pub regression: f32,
    /// Height of the pelvis, m.
    pub pelvis: f32,
    pub collapse: Option<Collapse>,
}

impl State {
    /// Person `i` in the last frame of `out`, of the shape of `body`.
    pub fn of(out: &Primitives, i: usize, body: &ShapedBody) -> Self {
        let frame = i * FRAMES + FRAMES - 1;
        let markers = &out.markers[frame * MARKER_DIM..][..MARKER_DIM];
        let joints = &out.joints[frame * JOINT_DIM..][..JOINT_DIM];
        let mut skinned = [0.0; MARKER_DIM];
        body.markers(&body.pose(&out.params[frame * PARAMS..][..PARAMS]), &mut skinned);
        Self {
            foot: 100.0 * foot_heights(markers).fold(f32::INFINITY, f32::min),
            shape: 1000.0 * rigid_marker_error(markers, body),
            // The markers are half predicted, half skinned.
            regression: 2.0 * distance(markers, &skinned),
            pelvis: joints[3 * joint::PELVIS + 2],
            collapse: collapse(markers, joints, body),
        }
    }
}

impl Drift {
    /// What `states` of all people amount to after `primitive` primitives.
    pub fn of(primitive: usize, states: &[State]) -> Self {
        let of = |value: fn(&State) -> f32| states.iter().map(value);
        Self {
            primitive,
            foot: spread(of(|s| s.foot)),
            shape: mean(of(|s| s.shape)),
            regression: mean(of(|s| s.regression)),
            pelvis: spread(of(|s| s.pelvis)),
            collapsed: mean(of(|s| f32::from(u8::from(s.collapse.is_some())))),
        }
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
