//! Mends a fault of the exponential-map files: clips that turn past a right angle hold the INVERSE of the root's rotation on one
//! side of it, with some tenths of a second of nonsense between.
//!
//! The fault shows as a body that lies down in mid-air and then faces the mirror image of its way: on one side of the nonsense the
//! pelvis looks 7 to 13 degrees past its way on average, on the other 46 to 111 (8 to 13 once inverted).

use super::clip::{quantile, smoothstep};
use super::cmu::SourceFrame;
use glam::{Quat, Vec3};
use std::ops::Range;

/// Tilt of the pelvis above which a frame is nonsense; sound walks stay below 21 degrees.
const WILD: f32 = 25.0 * std::f32::consts::PI / 180.0;
/// Frames before and after a wild one that are not trusted either; also half the span over which the way is measured.
const MARGIN: usize = 12;
/// Travel over that span from which on its direction counts, metres.
const MOVING: f32 = 0.06;

/// Sideways headings, as angles off the files' forward or backward axis: up to the first the pelvis' tilt is sound, from the
/// second on it is not (people lean by up to 20 degrees more than elsewhere).
const SIDEWAYS: [f32; 2] = [40.0 * std::f32::consts::PI / 180.0, 60.0 * std::f32::consts::PI / 180.0];

/// Inverts the root's rotation where that makes the body face its way, and bridges the nonsense; cuts it off at the ends.
/// Where the body then heads sideways, it takes the clip's usual tilt.
///
/// Frames are at 120 per second, y up. A clip without a wild frame is left alone, whichever way it faces.
pub fn mend_root(frames: &mut Vec<SourceFrame>) {
    let sound = sound_ranges(frames);
    let (Some(first), Some(last)) = (sound.first().map(|r| r.start), sound.last().map(|r| r.end)) else { return };
    if sound.len() == 1 && last - first == frames.len() {
        return;
    }
    for range in &sound {
        let (as_is, inverted) = misfit(frames, range.clone());
        if inverted < as_is {
            frames[range.clone()].iter_mut().for_each(|f| set_root(f, f.rots[0].inverse()));
        }
    }
    for pair in sound.windows(2) {
        let (from, to) = (pair[0].end - 1, pair[1].start);
        let (a, b) = (frames[from].rots[0], frames[to].rots[0]);
        for (i, f) in frames[from..to].iter_mut().enumerate().skip(1) {
            set_root(f, a.slerp(b, i as f32 / (to - from) as f32));
        }
    }
    frames.truncate(last);
    frames.drain(..first);
    level_sideways(frames);
}

/// Gives the root the median pitch and roll of the other frames where it heads sideways; headings stay.
fn level_sideways(frames: &mut [SourceFrame]) {
    let parts: Vec<(f32, Vec3)> = frames
        .iter()
        .map(|f| {
            let forward = f.rots[0] * Vec3::Z;
            let yaw = forward.x.atan2(forward.z);
            let tilt = (Quat::from_rotation_y(-yaw) * f.rots[0]).to_scaled_axis();
            (yaw, tilt)
        })
        .collect();
    let sideways = |yaw: f32| {
        let off = yaw.abs().min(std::f32::consts::PI - yaw.abs());
        smoothstep((off - SIDEWAYS[0]) / (SIDEWAYS[1] - SIDEWAYS[0]))
    };
    let sound = |axis: usize| parts.iter().filter(|(y, _)| sideways(*y) == 0.0).map(|(_, t)| t[axis]).collect::<Vec<_>>();
    let usual = Vec3::new(quantile(&sound(0), 0.5), 0.0, quantile(&sound(2), 0.5));
    for (f, (yaw, tilt)) in frames.iter_mut().zip(&parts) {
        set_root(f, Quat::from_rotation_y(*yaw) * Quat::from_scaled_axis(tilt.lerp(usual, sideways(*yaw))));
    }
}

/// Runs of frames that are more than the margin away from any wild one.
fn sound_ranges(frames: &[SourceFrame]) -> Vec<Range<usize>> {
    let wild: Vec<bool> = frames.iter().map(|f| (f.rots[0] * Vec3::Y).angle_between(Vec3::Y) > WILD).collect();
    let sound = |t: usize| !wild[t.saturating_sub(MARGIN)..(t + MARGIN + 1).min(wild.len())].contains(&true);
    let mut ranges: Vec<Range<usize>> = Vec::new();
    for t in (0..frames.len()).filter(|&t| sound(t)) {
        match ranges.last_mut() {
            Some(r) if r.end == t => r.end = t + 1,
            _ => ranges.push(t..t + 1),
        }
    }
    ranges
}

/// Mean angle between the way and where the pelvis looks, as it is and inverted; (0, 0) where nobody moves.
fn misfit(frames: &[SourceFrame], range: Range<usize>) -> (f32, f32) {
    let flat = |v: Vec3| Vec3::new(v.x, 0.0, v.z);
    let mut sums = (0.0, 0.0, 0.0f32);
    for t in range {
        let way = flat(frames[(t + MARGIN).min(frames.len() - 1)].root - frames[t.saturating_sub(MARGIN)].root);
        if way.length() > MOVING {
            let off = |q: Quat| flat(q * Vec3::Z).angle_between(way);
            let root = frames[t].rots[0];
            sums = (sums.0 + off(root), sums.1 + off(root.inverse()), sums.2 + 1.0);
        }
    }
    (sums.0 / sums.2.max(1.0), sums.1 / sums.2.max(1.0))
}

/// Turns the whole body so that its root has the rotation `root`.
fn set_root(frame: &mut SourceFrame, root: Quat) {
    let turn = root * frame.rots[0].inverse();
    frame.rots.iter_mut().for_each(|r| *r = (turn * *r).normalize());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::cmu::CMU_JOINTS;

    /// Five seconds along a half circle, leaning forward by 0.2, looking along the way; joint 3 bent by 0.5 against the root.
    fn half_circle() -> Vec<SourceFrame> {
        (0..600)
            .map(|t| {
                let yaw = std::f32::consts::PI * t as f32 / 600.0;
                let root = Quat::from_rotation_y(yaw) * Quat::from_rotation_x(0.2);
                let mut rots = [root; CMU_JOINTS];
                rots[3] = root * Quat::from_rotation_x(0.5);
                SourceFrame { root: Vec3::new(-yaw.cos(), 0.9, yaw.sin()) * Vec3::new(1.5, 1.0, 1.5), rots }
            })
            .collect()
    }

    fn worst(frames: &[SourceFrame], truth: &[SourceFrame]) -> f32 {
        let joints = |a: &SourceFrame, b: &SourceFrame| (0..CMU_JOINTS).map(|j| a.rots[j].angle_between(b.rots[j])).fold(0.0, f32::max);
        frames.iter().zip(truth).map(|(a, b)| joints(a, b)).fold(0.0, f32::max)
    }

    #[test]
    fn inverse_side_is_turned_back_and_nonsense_bridged() {
        let truth = half_circle();
        let mut frames = truth.clone();
        for (t, f) in frames.iter_mut().enumerate().skip(280) {
            let fault = if t < 320 { f.rots[0] * Quat::from_rotation_x((t - 270) as f32 * 0.05) } else { f.rots[0].inverse() };
            set_root(f, fault);
        }
        assert!(worst(&frames, &truth) > 1.5);
        mend_root(&mut frames);
        assert_eq!(frames.len(), truth.len());
        assert!(worst(&frames, &truth) < 0.02, "{}", worst(&frames, &truth));
    }

    #[test]
    fn nonsense_at_the_end_is_cut_off() {
        let truth = half_circle();
        let mut frames = truth.clone();
        frames.iter_mut().skip(590).for_each(|f| set_root(f, Quat::from_rotation_x(1.0)));
        mend_root(&mut frames);
        assert_eq!(frames.len(), 590 - MARGIN);
        assert!(worst(&frames, &truth) < 5e-3);
    }

    #[test]
    fn sound_clips_are_left_alone_even_backward() {
        let mut frames = half_circle();
        frames.iter_mut().for_each(|f| set_root(f, Quat::from_rotation_y(std::f32::consts::PI) * f.rots[0]));
        let before = frames.clone();
        mend_root(&mut frames);
        assert!(frames == before);
        let mut none = Vec::new();
        mend_root(&mut none);
        assert!(none.is_empty());
    }
}
