//! Recordings that hold the rotations of SMPL-X's body joints, and how they come onto the project's body.

use super::clip::{Clip, Pose, SIDES, Skeleton, quantile, upright};
use super::resample::{check_fps, resample};
use super::retarget::{RetargetReport, settle};
use crate::body::{BODY_JOINTS, PARENTS};
use crate::io::numpy::Array;
use crate::{Error, Result};
use glam::{Quat, Vec3};
use std::path::Path;

/// Numbers of a frame of SMPL-X (55 joints) and of SMPL-H (52); both begin with the same 22 body joints.
const WIDTHS: [usize; 2] = [165, 156];
/// Ratios of leg lengths that people have; another one means that the recording's floor is not at height 0.
const SCALES: std::ops::RangeInclusive<f32> = 0.75..=1.33;

/// The world axis that points up in a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Up {
    Y,
    Z,
}

/// A recording as rotations of SMPL-X's 22 body joints, world with z up.
#[derive(Clone, Debug)]
pub struct PoseClip {
    pub name: String,
    /// Frames per second.
    pub fps: f32,
    /// The root is the recording's translation, metres: its person's pelvis but for a constant.
    pub frames: Vec<Pose>,
}

/// Arrays of a file with the keys that hold them.
pub(super) struct Recording<'a> {
    pub path: &'a Path,
    /// (T, 165) or (T, 156) axis-angle rotations, radians, of joints against their parents.
    pub poses: (&'a str, Array),
    /// (T, 3) metres.
    pub trans: (&'a str, Array),
    pub fps: (&'a str, Array),
}

impl Recording<'_> {
    /// Checks shapes, numbers and rate. Without `up` the file must have z up, and a file that has y up is recognised and refused.
    pub fn clip(&self, name: &str, up: Option<Up>) -> Result<PoseClip> {
        let (path, (poses_key, poses), (trans_key, trans)) = (self.path, &self.poses, &self.trans);
        let width = match poses.shape[..] {
            [_, width] if WIDTHS.contains(&width) => width,
            _ => {
                let what = format!("'{poses_key}' has shape {:?}, expected (T, 165) as of SMPL-X or (T, 156) as of SMPL-H", poses.shape);
                return Err(Error::file(path, what));
            }
        };
        if poses.data.is_empty() {
            return Err(Error::file(path, format!("'{poses_key}' holds no frame")));
        }
        trans.check(path, trans_key, &[poses.shape[0], 3])?;
        poses.check_finite(path, poses_key)?;
        trans.check_finite(path, trans_key)?;
        let fps = check_fps(path, self.fps.0, self.fps.1.scalar(path, self.fps.0)?)?;
        let turn = if up == Some(Up::Y) { upright() } else { Quat::IDENTITY };
        let rows = poses.data.chunks_exact(width).zip(trans.data.chunks_exact(3));
        let frames: Vec<Pose> = rows.map(|(p, t)| pose(p, Vec3::from_slice(t), turn)).collect();
        let mean = frames.iter().map(|p| p.rots[0] * Vec3::Y).sum::<Vec3>() / frames.len() as f32;
        if up.is_none() && mean.y > 0.7 && mean.z < 0.3 {
            let what = format!(
                "'{poses_key}': the pelvis points up along y ({:.2}, along z {:.2}), expected z up; say so if y is up",
                mean.y, mean.z
            );
            return Err(Error::file(path, what));
        }
        Ok(PoseClip { name: name.to_string(), fps, frames })
    }
}

/// Rotations against the world from those against the parents, after turning the world by `turn`.
fn pose(locals: &[f32], trans: Vec3, turn: Quat) -> Pose {
    let mut rots = [Quat::IDENTITY; BODY_JOINTS];
    for j in 0..BODY_JOINTS {
        let local = Quat::from_scaled_axis(Vec3::from_slice(&locals[3 * j..]));
        rots[j] = (if j == 0 { turn } else { rots[PARENTS[j]] } * local).normalize();
    }
    Pose { root: turn * trans, rots }
}

impl PoseClip {
    /// Puts the recording on `skeleton` at 40 frames per second, on the floor, with locked feet.
    ///
    /// Rotations carry over as they are, because the body has SMPL-X's joints and rest pose. Translations are scaled by the ratio of the
    /// heights at which the two pelvises ride above the lower foot (their medians), or not at all where that is no ratio of leg
    /// lengths.
    pub fn put_on(&self, skeleton: &Skeleton) -> Result<(Clip, RetargetReport)> {
        let mut poses = resample(&self.name, &self.frames, self.fps, Pose::between)?;
        let scale = scale(skeleton, &poses);
        poses.iter_mut().for_each(|p| p.root *= scale);
        let contact = vec![[false; SIDES]; poses.len()];
        let mut clip = Clip { name: self.name.clone(), poses, contact };
        let mut report = RetargetReport::default();
        settle(skeleton, &mut clip, &mut report);
        Ok((clip, report))
    }
}

fn scale(skeleton: &Skeleton, poses: &[Pose]) -> f32 {
    let ours: Vec<f32> = poses.iter().map(|p| p.root.z - skeleton.lowest(p)).collect();
    let theirs: Vec<f32> = poses.iter().map(|p| p.root.z).collect();
    let ratio = quantile(&ours, 0.5) / quantile(&theirs, 0.5);
    if SCALES.contains(&ratio) { ratio } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::BodyModel;

    /// Two seconds at 60 per second of a stiff body gliding along x by 1.1 m, its pelvis a tenth too high for our legs.
    fn glide(lift: f32) -> PoseClip {
        let skeleton = Skeleton::new(&BodyModel::embedded());
        let pose = |t: usize| Pose { root: Vec3::new(1.1 * t as f32 / 120.0, 0.0, lift), rots: [upright(); BODY_JOINTS] };
        let high = 1.1 * (pose(0).root.z - skeleton.lowest(&pose(0)));
        let raise = |mut p: Pose| {
            p.root.z += high;
            p
        };
        PoseClip { name: "glide".into(), fps: 60.0, frames: (0..=120).map(|t| raise(pose(t))).collect() }
    }

    #[test]
    fn paths_scale_with_the_height_of_the_pelvis() {
        let skeleton = Skeleton::new(&BodyModel::embedded());
        for (lift, way) in [(0.0, 1.0), (3.0, 1.1)] {
            let (clip, _) = glide(lift).put_on(&skeleton).unwrap();
            assert_eq!(clip.len(), 81);
            let moved = clip.poses[80].root.x - clip.poses[0].root.x;
            assert!((moved - way).abs() < 1e-3, "{moved}");
            assert!(clip.poses.iter().all(|p| skeleton.lowest(p).abs() < 0.01));
            assert!(clip.poses.iter().all(|p| p.rots[9].angle_between(upright()) < 1e-3));
        }
    }

    fn recording(width: usize, frames: usize, orient: Vec3) -> Recording<'static> {
        let mut data = vec![0.0; frames * width];
        data.chunks_exact_mut(width).for_each(|row| row[..3].copy_from_slice(&orient.to_array()));
        Recording {
            path: Path::new("walk.npz"),
            poses: ("poses", Array { shape: vec![frames, width], data }),
            trans: ("trans", Array { shape: vec![frames, 3], data: vec![0.5; 3 * frames] }),
            fps: ("mocap_framerate", Array { shape: vec![], data: vec![120.0] }),
        }
    }

    #[test]
    fn y_up_is_recognised_and_turned_when_told() {
        let message = recording(165, 2, Vec3::ZERO).clip("walk", None).unwrap_err().to_string();
        assert!(message.contains("walk.npz: 'poses': the pelvis points up along y (1.00"), "{message}");
        let clip = recording(165, 2, Vec3::ZERO).clip("walk", Some(Up::Y)).unwrap();
        assert!((clip.frames[0].rots[0] * Vec3::Y - Vec3::Z).length() < 1e-6);
        assert!((clip.frames[0].root - Vec3::new(0.5, -0.5, 0.5)).length() < 1e-6);
    }

    #[test]
    fn bad_arrays_name_key_and_frame() {
        let upright = Vec3::X * std::f32::consts::FRAC_PI_2;
        let bad = |change: fn(&mut Recording)| {
            let mut r = recording(156, 4, upright);
            change(&mut r);
            r.clip("walk", None).unwrap_err().to_string()
        };
        for (message, want) in [
            (bad(|r| r.poses.1.data[2 * 156 + 5] = f32::NAN), "'poses' frame 2 holds NaN"),
            (bad(|r| r.trans.1.data[10] = f32::INFINITY), "'trans' frame 3 holds inf"),
            (bad(|r| r.trans.1.shape = vec![3, 4]), "'trans' has shape (3, 4), expected (4, 3)"),
            (bad(|r| r.poses.1.shape = vec![8, 78]), "'poses' has shape [8, 78], expected (T, 165)"),
            (bad(|r| r.poses.1 = Array { shape: vec![0, 156], data: vec![] }), "'poses' holds no frame"),
            (bad(|r| r.fps.1.data = vec![0.0]), "'mocap_framerate' means 0 frames per second"),
            (bad(|r| r.fps.1.data = vec![]), "'mocap_framerate' has shape ()"),
        ] {
            assert!(message.contains(want) && message.starts_with("walk.npz"), "{message}");
        }
        assert_eq!(recording(156, 4, upright).clip("walk", None).unwrap().frames.len(), 4);
    }
}
