//! Augmentation: turning, slowing, stopping, standing, small, side and backward steps, made from straight walks.

mod edit;
#[cfg(test)]
mod tests;

pub use edit::{Planar, bent_path, calm, mirror, raise, replant, resample, sideways_spread, stand_idly};

use super::FPS;
use super::clip::{Clip, SIDES, Skeleton, heading, quantile, smoothstep, wrap};
use super::footlock::slides;
use crate::rng::{Stream, stream};
use glam::Vec2;
use rand::RngExt;

/// Fastest yaw rate that bending adds, radians per second (110 degrees, as real turns have it).
const MAX_RATE: f32 = 1.92;
/// An augmented clip is kept when its 90 % slide (metres), its 98 % hip twist (radians) and the greatest acceleration of a
/// joint (m/s^2, recorded walks have up to 105) stay below these.
const MAX_SLIDE: f32 = 0.015;
const MAX_TWIST: f32 = 1.05;
const MAX_ACCELERATION: f32 = 130.0;
/// How much further out each foot stands than in a walk when a person stands, metres.
const STANDING_SPREAD: f32 = 0.05;
/// Frames an augmented clip must have.
const MIN_FRAMES: usize = 40;

/// What one variation does to a clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Kind {
    /// Another path: a smooth random yaw rate.
    Bent,
    /// 0.55 to 0.85 of the speed, on another path.
    SlowBent,
    /// Stops at a double support, stands idly, walks on.
    Stop,
    /// Small steps or steps on the spot, with strong turns.
    Small,
    /// Turns on the spot.
    Spot,
    /// Side steps, straight or askew, the body facing ahead.
    Side,
    /// Walks backward: time runs back at 0.6 of the speed.
    Reversed,
}

/// Variations made of every clip (each also mirrored).
pub const RECIPE: [(Kind, usize); 7] =
    [(Kind::Bent, 2), (Kind::SlowBent, 2), (Kind::Stop, 2), (Kind::Small, 1), (Kind::Spot, 1), (Kind::Side, 1), (Kind::Reversed, 1)];

/// Variations of `clips` within the limits of slide and hip twist, and how many were made; `seed` fixes all draws. `idle`: people
/// who stand; without any, stops are mere stops.
pub fn augment(skeleton: &Skeleton, clips: &[Clip], idle: &[Clip], seed: u64) -> (Vec<(Kind, Clip)>, usize) {
    use rayon::prelude::*;
    let mut jobs = Vec::new();
    for clip in clips {
        for (kind, count) in RECIPE {
            jobs.extend((0..count).map(|copy| (clip, kind, copy)));
        }
    }
    let made: Vec<Option<(Kind, Clip)>> = jobs
        .par_iter()
        .enumerate()
        .map(|(i, &(clip, kind, copy))| {
            let mut out = vary(skeleton, clip, idle, kind, &mut stream(seed, "augment", i as u64))?;
            out.name = format!("{}~{kind:?}{copy}", clip.name).to_lowercase();
            keep(skeleton, &out).then_some((kind, out))
        })
        .collect();
    (made.into_iter().flatten().collect(), jobs.len())
}

/// One variation; none when the clip does not offer what it needs.
fn vary(skeleton: &Skeleton, clip: &Clip, idle: &[Clip], kind: Kind, rng: &mut Stream) -> Option<Clip> {
    Some(match kind {
        Kind::Bent => bend(skeleton, clip, 1.0, rng),
        Kind::SlowBent => {
            let speed = rng.random_range(0.55..0.85);
            // The rate is chosen before slowing: what limits a turn is its angle per step.
            let bent = bend(skeleton, clip, 1.0, rng);
            resample(skeleton, &bent, &uniform_times(clip.len(), speed))
        }
        Kind::Stop => stop(skeleton, clip, idle, rng)?,
        Kind::Small => {
            let mut draw = || Vec2::X * rng.random_range(-0.35..0.75f32);
            let ends = [draw(), draw()];
            short_steps(skeleton, clip, ends, 1.1, rng)
        }
        Kind::Spot => {
            let mut draw = || Vec2::X * rng.random_range(-0.1..0.15f32);
            let ends = [draw(), draw()];
            short_steps(skeleton, clip, ends, 1.3, rng)
        }
        Kind::Side => {
            let side = if rng.random() { 1.0 } else { -1.0 };
            let mut draw = || Vec2::new(rng.random_range(-0.2..0.5), side * rng.random_range(0.1..0.4f32));
            let ends = [draw(), draw()];
            short_steps(skeleton, clip, ends, 0.4, rng)
        }
        Kind::Reversed => {
            let bent = bend(skeleton, clip, 0.6, rng);
            let mut times = uniform_times(clip.len(), 0.6);
            times.reverse();
            resample(skeleton, &bent, &times)
        }
    })
}

fn uniform_times(len: usize, speed: f32) -> Vec<f32> {
    (0..).map(|i| i as f32 * speed).take_while(|&t| t <= (len - 1) as f32).collect()
}

fn bend(skeleton: &Skeleton, clip: &Clip, strength: f32, rng: &mut Stream) -> Clip {
    let yaw = random_yaw(clip.len(), strength, rng);
    replant(skeleton, clip, &bent_path(clip, &yaw, &vec![Vec2::X; clip.len()]), &vec![0.0; clip.len()])
}

/// Yaw angle per frame: the integral of a rate that moves smoothly between random values, one each 0.8 to 1.6 s.
fn random_yaw(len: usize, strength: f32, rng: &mut Stream) -> Vec<f32> {
    let limit = strength * MAX_RATE;
    // The square root favours strong turns: smoothing between draws weakens them.
    let draw = |rng: &mut Stream| {
        let u = rng.random_range(-1.0f32..1.0);
        limit * u.signum() * u.abs().sqrt()
    };
    let (mut from, mut to) = (draw(rng), draw(rng));
    let (mut start, mut span) = (0.0, rng.random_range(0.8..1.6) * FPS);
    let mut angle = 0.0;
    (0..len)
        .map(|t| {
            while t as f32 - start > span {
                start += span;
                span = rng.random_range(0.8..1.6) * FPS;
                (from, to) = (to, draw(rng));
            }
            let rate = from + (to - from) * smoothstep((t as f32 - start) / span);
            angle += rate / FPS;
            angle
        })
        .collect()
}

/// Eases to a stand at a double support (the steps before it shrink, limbs calm down), stands like one of `idle`, and walks on.
fn stop(skeleton: &Skeleton, clip: &Clip, idle: &[Clip], rng: &mut Stream) -> Option<Clip> {
    let n = clip.len();
    let margin = (0.3 * FPS) as usize;
    let places: Vec<usize> = (margin..n.saturating_sub(margin)).filter(|&t| clip.contact[t] == [true; SIDES]).collect();
    let at = *places.get(rng.random_range(0..places.len().max(1)))? as f32;
    let least = rng.random_range(0.0..0.5f32);
    // Least stride around the stop, so that both feet are planted beside each other, then back to whole steps.
    let (flat, ramp) = (0.3 * FPS, rng.random_range(0.4..0.8) * FPS);
    let fade: Vec<f32> = (0..n).map(|t| 1.0 - smoothstep(((t as f32 - at).abs() - flat) / ramp)).collect();
    let stride: Vec<Vec2> = fade.iter().map(|f| Vec2::X * (1.0 - (1.0 - least) * f)).collect();
    let quiet: Vec<f32> = fade.iter().map(|f| (1.0 - least) * f).collect();
    let calmed = calm(skeleton, clip, &quiet);
    let yaw = random_yaw(n, 0.7, rng);
    let bent = raise(skeleton, &replant(skeleton, &calmed, &bent_path(&calmed, &yaw, &stride), &wider(&quiet)), &quiet);
    let (ease, hold) = (rng.random_range(0.3..0.6f32), rng.random_range(0.3..2.5f32));
    let stopped = resample(skeleton, &bent, &stop_times(n, at, ease, hold));
    let fits: Vec<&Clip> = idle.iter().filter(|i| i.len() > stopped.len()).collect();
    let Some(&stander) = fits.get(rng.random_range(0..fits.len().max(1))) else { return Some(stopped) };
    let from = rng.random_range(0..stander.len() - stopped.len());
    // From the middle of the one ease to that of the other.
    let (begin, end) = (at, at + (ease + hold) * FPS);
    let ramp = (0.5 * (ease + hold) * FPS).min(0.6 * FPS);
    let near = |t: usize| smoothstep((t as f32 - begin) / ramp) * smoothstep((end - t as f32) / ramp);
    let weight: Vec<f32> = (0..stopped.len()).map(near).collect();
    Some(stand_idly(skeleton, &stopped, stander, from, &weight))
}

/// Frame times that slow from 1 to 0 towards `at` (frames), stand for `hold` seconds and speed up again.
///
/// Each ease takes `ease` seconds, in which half as much of the clip passes.
fn stop_times(len: usize, at: f32, ease: f32, hold: f32) -> Vec<f32> {
    let (ease, hold) = (ease * FPS, hold * FPS);
    let begin = at - 0.5 * ease;
    // Integral of 1 - smoothstep over the ease: s - s^3 + s^4 / 2, of which one half passes.
    let passed = |s: f32| ease * (s - s * s * s + 0.5 * s * s * s * s);
    let time = |t: f32| {
        let (a, b, c) = (begin + ease, begin + ease + hold, begin + 2.0 * ease + hold);
        if t < begin {
            t
        } else if t < a {
            begin + passed((t - begin) / ease)
        } else if t < b {
            at
        } else if t < c {
            at + 0.5 * ease - passed((c - t) / ease)
        } else {
            at + 0.5 * ease + t - c
        }
    };
    (0..).map(|t| time(t as f32)).take_while(|&t| t <= (len - 1) as f32).collect()
}

/// Steps changed smoothly from the first to the second of `ends` (see [`bent_path`]), calmer, a little slower, turning with
/// `strength`.
fn short_steps(skeleton: &Skeleton, clip: &Clip, ends: [Vec2; 2], strength: f32, rng: &mut Stream) -> Clip {
    let n = clip.len();
    let stride: Vec<Vec2> = (0..n).map(|t| ends[0].lerp(ends[1], smoothstep(t as f32 / n as f32))).collect();
    let quiet: Vec<f32> = stride.iter().map(|s| 0.8 * (1.0 - s.length()).max(0.0)).collect();
    let calmed = calm(skeleton, clip, &quiet);
    let yaw = random_yaw(n, strength, rng);
    let spread: Vec<f32> = wider(&quiet).into_iter().zip(sideways_spread(clip, &stride)).map(|(a, b)| a + b).collect();
    let bent = raise(skeleton, &replant(skeleton, &calmed, &bent_path(&calmed, &yaw, &stride), &spread), &quiet);
    resample(skeleton, &bent, &uniform_times(n, rng.random_range(0.7..1.0)))
}

/// The spread of feet that goes with a calm body.
fn wider(quiet: &[f32]) -> Vec<f32> {
    quiet.iter().map(|q| STANDING_SPREAD * q).collect()
}

/// Foot yaw against the pelvis in stance, radians, outward or inward alike.
pub fn hip_twists(skeleton: &Skeleton, clip: &Clip) -> Vec<f32> {
    let mut out = Vec::new();
    for side in 0..SIDES {
        let stands = clip.poses.iter().zip(&clip.contact).filter(|(_, c)| c[side]);
        out.extend(stands.map(|(p, _)| wrap(heading(p.rots[skeleton.legs[side].ankle]) - heading(p.rots[0])).abs()));
    }
    out
}

fn keep(skeleton: &Skeleton, clip: &Clip) -> bool {
    clip.len() >= MIN_FRAMES
        && quantile(&slides(skeleton, clip), 0.9) < MAX_SLIDE
        && quantile(&hip_twists(skeleton, clip), 0.98) < MAX_TWIST
        && greatest_acceleration(skeleton, clip) < MAX_ACCELERATION
}

/// Greatest acceleration of any joint, metres per second squared.
pub fn greatest_acceleration(skeleton: &Skeleton, clip: &Clip) -> f32 {
    let joints: Vec<_> = clip.poses.iter().map(|p| skeleton.joints(p)).collect();
    let bends = joints.windows(3).flat_map(|w| (0..w[0].len()).map(move |j| (w[2][j] - 2.0 * w[1][j] + w[0][j]).length()));
    bends.fold(0.0, f32::max) * FPS * FPS
}
