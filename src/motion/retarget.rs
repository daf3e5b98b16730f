//! From the CMU skeleton to the project's body.

use super::FPS;
use super::clean::{clean, smooth};
use super::clip::{Clip, Pose, SIDES, Skeleton, heading, quantile, speeds, upright};
use super::cmu::{SourceClip, SourceFrame, cmu_joint, leg_length, rest_offset};
use super::footlock::{detect_contact, flat, lock_feet, slides};
use super::ik::arc;
use super::resample::resample;
use crate::Result;
use crate::body::BODY_JOINTS;
use glam::{Quat, Vec3};

/// CMU joint whose rotation drives each body joint.
const SOURCE: [usize; BODY_JOINTS] = [0, 2, 8, 13, 3, 9, 14, 4, 10, 15, 4, 10, 17, 20, 29, 18, 21, 30, 22, 31, 22, 31];
/// Limbs whose rest directions are aligned: body joint, its child, and the CMU child of its source joint.
const LIMBS: [(usize, usize, usize); 8] =
    [(1, 4, 3), (2, 5, 9), (4, 7, 4), (5, 8, 10), (16, 18, 22), (17, 19, 31), (18, 20, 23), (19, 21, 32)];
/// CMU joint that stands where each compared body joint stands: hips, knees, ankles, shoulders, elbows, wrists.
const COMPARED: [(usize, usize); 12] =
    [(1, 2), (2, 8), (4, 3), (5, 9), (7, 4), (8, 10), (16, 21), (17, 30), (18, 22), (19, 31), (20, 23), (21, 32)];
/// A foot slower than this (m/s, and rad/s) stands flat.
const FLAT_SPEED: f32 = 0.25;
const FLAT_SPIN: f32 = 0.6;

/// What retargeting did to one clip.
#[derive(Clone, Debug, Default)]
pub struct RetargetReport {
    /// Mean distance of limb joints from the scaled source, metres, after removing the mean offset of each frame; none where the
    /// source holds rotations alone.
    pub joint_error: Option<f32>,
    /// Height by which the clip was shifted to stand on the floor, metres.
    pub ground_shift: f32,
    /// Slide per stance before and after the foot lock, metres.
    pub slide_before: Vec<f32>,
    pub slide_after: Vec<f32>,
}

/// Puts `source` on `skeleton` at 40 frames per second, on the floor, with locked feet.
pub fn retarget(skeleton: &Skeleton, source: &SourceClip) -> Result<(Clip, RetargetReport)> {
    let frames = resample(&source.name, &clean(&source.frames, source.fps), source.fps, SourceFrame::between)?;
    let align = alignments(skeleton);
    let scale = skeleton.leg_length(0) / leg_length();
    let poses = frames.iter().map(|f| map_frame(skeleton, f, &align, scale)).collect();
    let mut clip = Clip { name: source.name.clone(), poses, contact: vec![[false; SIDES]; frames.len()] };
    let mut report = RetargetReport { joint_error: Some(joint_error(skeleton, &clip, &frames, scale)), ..Default::default() };
    clip.poses = smooth(&clip.poses);
    level_posture(skeleton, &mut clip);
    level_feet(skeleton, &mut clip);
    settle(skeleton, &mut clip, &mut report);
    Ok((clip, report))
}

/// Puts `clip` on the floor, finds its stances and locks its feet in them.
pub(super) fn settle(skeleton: &Skeleton, clip: &mut Clip, report: &mut RetargetReport) {
    report.ground_shift = put_on_floor(skeleton, clip);
    detect_contact(skeleton, clip);
    report.slide_before = slides(skeleton, clip);
    lock_feet(skeleton, clip);
    report.slide_after = slides(skeleton, clip);
}

/// Per body joint the rest rotation that turns the body's bone into the source's bone.
fn alignments(skeleton: &Skeleton) -> [Quat; BODY_JOINTS] {
    let mut align = [Quat::IDENTITY; BODY_JOINTS];
    for (j, child, source_child) in LIMBS {
        align[j] = arc(skeleton.rest[child] - skeleton.rest[j], rest_offset(source_child));
    }
    align[20] = align[18];
    align[21] = align[19];
    align
}

fn map_frame(skeleton: &Skeleton, frame: &SourceFrame, align: &[Quat; BODY_JOINTS], scale: f32) -> Pose {
    let rots = std::array::from_fn(|j| (upright() * frame.rots[SOURCE[j]] * align[j]).normalize());
    let source = frame.joints();
    let hips = upright() * (0.5 * scale * (source[cmu_joint::L_HIP] + source[cmu_joint::R_HIP]));
    Pose { root: hips - rots[0] * rest_hips(skeleton), rots }
}

/// Midpoint of the hips from the pelvis joint, rest axes.
fn rest_hips(skeleton: &Skeleton) -> Vec3 {
    0.5 * (skeleton.rest[1] + skeleton.rest[2]) - skeleton.rest[0]
}

fn joint_error(skeleton: &Skeleton, clip: &Clip, frames: &[SourceFrame], scale: f32) -> f32 {
    let mut sum = 0.0;
    for (pose, frame) in clip.poses.iter().zip(frames) {
        let (ours, theirs) = (skeleton.joints(pose), frame.joints());
        let gaps = COMPARED.map(|(a, b)| ours[a] - upright() * (scale * theirs[b]));
        let mean = gaps.iter().sum::<Vec3>() / gaps.len() as f32;
        sum += gaps.iter().map(|g| (*g - mean).length()).sum::<f32>() / gaps.len() as f32;
    }
    sum / frames.len().max(1) as f32
}

/// Takes the mean pitch and roll out of pelvis and head: each subject's markers have their own zero there.
fn level_posture(skeleton: &Skeleton, clip: &mut Clip) {
    let hips = rest_hips(skeleton);
    for j in [0, 15] {
        let level = mean_tilt(clip.poses.iter().map(|p| p.rots[j])).inverse();
        for pose in &mut clip.poses {
            let centre = pose.root + pose.rots[0] * hips;
            pose.rots[j] = (pose.rots[j] * level).normalize();
            pose.root = centre - pose.rots[0] * hips;
        }
    }
}

/// Mean rotation, in rest axes and without its yaw, by which rotations differ from upright ones of the same heading.
fn mean_tilt(rots: impl Iterator<Item = Quat>) -> Quat {
    let tilts: Vec<Vec3> = rots
        .map(|r| (flat(heading(r)).inverse() * r).normalize())
        .map(|q| if q.w < 0.0 { -q } else { q })
        .map(|q| q.to_scaled_axis())
        .collect();
    let part = |axis: usize| quantile(&tilts.iter().map(|t| t[axis]).collect::<Vec<_>>(), 0.5);
    if tilts.is_empty() { Quat::IDENTITY } else { Quat::from_scaled_axis(Vec3::new(part(0), 0.0, part(2))) }
}

/// Turns each foot by one constant so that it is flat when it stands still.
fn level_feet(skeleton: &Skeleton, clip: &mut Clip) {
    for side in 0..SIDES {
        let leg = &skeleton.legs[side];
        let still = still_frames(skeleton, clip, side);
        if still.len() < 4 {
            continue;
        }
        let level = mean_tilt(still.iter().map(|&t| clip.poses[t].rots[leg.ankle])).inverse();
        for pose in &mut clip.poses {
            pose.rots[leg.ankle] = (pose.rots[leg.ankle] * level).normalize();
            pose.rots[leg.toe] = pose.rots[leg.ankle];
        }
    }
}

fn still_frames(skeleton: &Skeleton, clip: &Clip, side: usize) -> Vec<usize> {
    let feet = clip.feet(skeleton, side);
    let ankles = speeds(&feet.iter().map(|f| f.ankle).collect::<Vec<_>>());
    (1..feet.len().saturating_sub(1))
        .filter(|&t| ankles[t] < FLAT_SPEED && feet[t + 1].rot.angle_between(feet[t - 1].rot) * FPS / 2.0 < FLAT_SPIN)
        .collect()
}

/// Shifts the clip so that the 20 % quantile of its lowest sole points is the floor; returns the shift.
fn put_on_floor(skeleton: &Skeleton, clip: &mut Clip) -> f32 {
    let lowest: Vec<f32> = clip.poses.iter().map(|p| skeleton.lowest(p)).collect();
    let shift = -quantile(&lowest, 0.2);
    clip.poses.iter_mut().for_each(|p| p.root.z += shift);
    shift
}
