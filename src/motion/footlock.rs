//! Foot contact: finding stances, and making feet stand still in them.

use super::clip::{Clip, FootPose, SIDES, Skeleton, heading, quantile, smoothstep, speeds, upright, wrap};
use super::ik::{overreach, place_feet};
use glam::{Quat, Vec3};
use std::ops::Range;

/// A sole point below this height (metres) and speed (m/s) touches the floor.
const CONTACT_HEIGHT: f32 = 0.045;
const CONTACT_SPEED: f32 = 0.45;
/// Shorter stances and gaps between stances (frames) are taken as noise.
const MIN_STANCE: usize = 4;
const MIN_GAP: usize = 4;
/// Height over which contact passes from one sole point to another, metres.
const ROLL: f32 = 0.008;
/// Most the toes bend against the foot, radians, and the time they take to straighten after toe-off, frames.
const TOE_BEND: f32 = 0.8;
const TOE_RELAX: f32 = 6.0;

/// Marks in `clip.contact` when each foot stands, by height and speed of heel and ball.
pub fn detect_contact(skeleton: &Skeleton, clip: &mut Clip) {
    clip.contact = vec![[false; SIDES]; clip.len()];
    for side in 0..SIDES {
        let soles: Vec<[Vec3; 3]> = clip.feet(skeleton, side).iter().map(|f| skeleton.sole(side, f)).collect();
        let mut flags = vec![false; clip.len()];
        for point in 0..2 {
            let track: Vec<Vec3> = soles.iter().map(|s| s[point]).collect();
            for (t, speed) in speeds(&track).into_iter().enumerate() {
                flags[t] |= speed < CONTACT_SPEED && track[t].z < CONTACT_HEIGHT;
            }
        }
        clean(&mut flags, false, MIN_GAP);
        clean(&mut flags, true, MIN_STANCE);
        flags.iter().zip(&mut clip.contact).for_each(|(f, c)| c[side] = *f);
    }
}

/// Flips inner runs of `value` that are shorter than `min`.
fn clean(flags: &mut [bool], value: bool, min: usize) {
    let marked: Vec<bool> = flags.iter().map(|&f| f == value).collect();
    for run in super::clip::runs(&marked) {
        if run.len() < min && run.start > 0 && run.end < flags.len() {
            flags[run].fill(!value);
        }
    }
}

/// What the lock changes on a foot in one frame.
#[derive(Clone, Copy, Default)]
struct Correction {
    yaw: f32,
    shift: Vec3,
}

/// Makes the feet of `clip` stand still in the stances `clip.contact` marks, blends between them, and lets no foot sink.
///
/// In a stance the foot keeps the clip's pitch and roll, takes one heading, and moves so that whichever part of the sole
/// bears (heel, then ball, then toes) has no horizontal speed and stands on the floor. The legs follow by IK.
pub fn lock_feet(skeleton: &Skeleton, clip: &mut Clip) {
    let feet: [Vec<FootPose>; SIDES] = std::array::from_fn(|side| locked_track(skeleton, clip, side));
    set_feet(skeleton, clip, &feet);
}

/// Puts the feet `feet` (one track per side) under the clip, lowering the pelvis smoothly where a leg would not reach.
pub fn set_feet(skeleton: &Skeleton, clip: &mut Clip, feet: &[Vec<FootPose>; SIDES]) {
    let drop: Vec<f32> =
        (0..clip.len()).map(|t| (0..SIDES).map(|s| overreach(skeleton, &clip.poses[t], s, feet[s][t].ankle)).fold(0.0, f32::max)).collect();
    for (t, drop) in smooth_envelope(&drop, 5).into_iter().enumerate() {
        clip.poses[t].root.z -= drop;
        place_feet(skeleton, &mut clip.poses[t], &[feet[0][t], feet[1][t]]);
    }
}

/// A smooth curve on or above `values`: the running maximum over +-`radius`, then the mean over the same window.
fn smooth_envelope(values: &[f32], radius: usize) -> Vec<f32> {
    let window = |t: usize| t.saturating_sub(radius)..(t + radius + 1).min(values.len());
    let top: Vec<f32> = (0..values.len()).map(|t| values[window(t)].iter().copied().fold(0.0, f32::max)).collect();
    (0..values.len()).map(|t| top[window(t)].iter().sum::<f32>() / window(t).len() as f32).collect()
}

fn locked_track(skeleton: &Skeleton, clip: &Clip, side: usize) -> Vec<FootPose> {
    let mut feet = clip.feet(skeleton, side);
    let stances = clip.stances(side);
    bend_toes(skeleton, side, &mut feet, &stances);
    let mut fix = vec![Correction::default(); feet.len()];
    for stance in &stances {
        let values = stance_corrections(skeleton, side, &feet[stance.clone()]);
        fix[stance.clone()].copy_from_slice(&values);
    }
    fill_swings(&mut fix, &stances);
    for (foot, fix) in feet.iter_mut().zip(&fix) {
        *foot = corrected(foot, fix);
        let low = skeleton.sole(side, foot).iter().map(|p| p.z).fold(f32::INFINITY, f32::min);
        foot.ankle.z += (-low).max(0.0);
    }
    feet
}

fn corrected(foot: &FootPose, fix: &Correction) -> FootPose {
    let turn = Quat::from_rotation_z(fix.yaw);
    FootPose { ankle: foot.ankle + fix.shift, rot: turn * foot.rot, toe: turn * foot.toe }
}

/// Sets the toes from the foot's pitch: flat on the floor while the heel rises in a stance, straight otherwise.
fn bend_toes(skeleton: &Skeleton, side: usize, feet: &mut [FootPose], stances: &[Range<usize>]) {
    let leg = &skeleton.legs[side];
    let sole = leg.ball - leg.heel;
    let pitch = |f: &FootPose| (-(f.rot * sole).z / sole.length()).clamp(-1.0, 1.0).asin();
    let mut bend = vec![0.0f32; feet.len()];
    for stance in stances {
        for t in stance.clone() {
            bend[t] = pitch(&feet[t]).clamp(0.0, TOE_BEND);
        }
        let last = bend[stance.end - 1];
        for (i, bend) in bend[stance.end..].iter_mut().take(TOE_RELAX as usize).enumerate() {
            *bend = last * (1.0 - smoothstep((i + 1) as f32 / TOE_RELAX));
        }
    }
    for (foot, bend) in feet.iter_mut().zip(bend) {
        foot.toe = foot.rot * Quat::from_rotation_x(-bend);
    }
}

/// Corrections that let one stance bear without sliding; their mean horizontal shift is zero.
fn stance_corrections(skeleton: &Skeleton, side: usize, feet: &[FootPose]) -> Vec<Correction> {
    let middle = heading(feet[feet.len() / 2].rot);
    let yaws: Vec<f32> = feet.iter().map(|f| wrap(heading(f.rot) - middle)).collect();
    let yaw0 = quantile(&yaws, 0.5);
    let mut fix: Vec<Correction> = yaws.iter().map(|y| Correction { yaw: yaw0 - y, shift: Vec3::ZERO }).collect();
    let soles: Vec<[Vec3; 3]> = feet.iter().zip(&fix).map(|(f, c)| skeleton.sole(side, &corrected(f, c))).collect();
    for t in 1..feet.len() {
        let (a, b) = (load(&soles[t - 1]), load(&soles[t]));
        let slip: Vec3 = (0..3).map(|i| 0.5 * (a[i] + b[i]) * (soles[t][i] - soles[t - 1][i])).sum();
        fix[t].shift = fix[t - 1].shift - slip.with_z(0.0);
    }
    let mean = fix.iter().map(|c| c.shift).sum::<Vec3>() / fix.len() as f32;
    for (c, sole) in fix.iter_mut().zip(&soles) {
        c.shift = (c.shift - mean).with_z(-sole.iter().map(|p| p.z).fold(f32::INFINITY, f32::min));
    }
    fix
}

/// Share of the load that heel, ball and tip bear: the lowest point all of it, equal heights an equal share.
fn load(sole: &[Vec3; 3]) -> [f32; 3] {
    let low = sole.iter().map(|p| p.z).fold(f32::INFINITY, f32::min);
    let w = sole.map(|p| (-(p.z - low) / ROLL).exp());
    let sum: f32 = w.iter().sum();
    w.map(|w| w / sum)
}

/// Blends corrections over the frames between stances; before the first and after the last they stay constant.
fn fill_swings(fix: &mut [Correction], stances: &[Range<usize>]) {
    let (Some(first), Some(last)) = (stances.first(), stances.last()) else { return };
    let (head, tail) = (fix[first.start], fix[last.end - 1]);
    fix[..first.start].fill(head);
    fix[last.end..].fill(tail);
    for pair in stances.windows(2) {
        let (a, b) = (fix[pair[0].end - 1], fix[pair[1].start]);
        let span = (pair[1].start + 1 - pair[0].end) as f32;
        for (i, fix) in fix[pair[0].end..pair[1].start].iter_mut().enumerate() {
            let s = smoothstep((i + 1) as f32 / span);
            *fix = Correction { yaw: a.yaw + s * wrap(b.yaw - a.yaw), shift: a.shift.lerp(b.shift, s) };
        }
    }
}

/// How far the bearing part of the sole slides in each stance, metres: the greatest distance of heel or ball from its
/// median place while it is within 1.5 cm of the floor.
pub fn slides(skeleton: &Skeleton, clip: &Clip) -> Vec<f32> {
    let mut out = Vec::new();
    for side in 0..SIDES {
        let soles: Vec<[Vec3; 3]> = clip.feet(skeleton, side).iter().map(|f| skeleton.sole(side, f)).collect();
        for stance in clip.stances(side) {
            let worst = (0..2).map(|i| {
                let down: Vec<Vec3> = soles[stance.clone()].iter().map(|s| s[i]).filter(|p| p.z < 0.015).collect();
                let middle = |axis: usize| quantile(&down.iter().map(|p| p[axis]).collect::<Vec<_>>(), 0.5);
                let centre = Vec3::new(middle(0), middle(1), 0.0);
                down.iter().map(|p| (*p - centre).with_z(0.0).length()).fold(0.0, f32::max)
            });
            out.push(worst.fold(0.0, f32::max));
        }
    }
    out
}

/// Rotation of a foot that stands flat with heading `yaw`.
pub fn flat(yaw: f32) -> Quat {
    Quat::from_rotation_z(yaw) * upright()
}
