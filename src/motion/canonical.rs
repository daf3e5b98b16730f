//! EgoGen's files of one canonical primitive each, `.npz`.

use super::clip::Pose;
use super::poses::{PoseClip, Recording, Up};
use super::primitive::{JOINT_DIM, MotionSet};
use super::{FPS, FRAMES};
use crate::body::{BETAS, BODY_JOINTS, Frame, MARKER_DIM, MARKERS, PARAMS, ShapedBody, TRANSL};
use crate::io::numpy::{Array, Npz, NpzWriter};
use crate::io::write_atomic;
use crate::{Error, Result};
use glam::{Mat3, Quat, Vec3};
use std::fs;
use std::path::Path;

/// Numbers of SMPL-X's 55 rotations.
const POSE_DIM: usize = 165;
/// Numbers of the 22 joints of a frame.
const BODY_DIM: usize = 3 * BODY_JOINTS;
/// Frame rate that EgoGen's files state of data at 40 frames per second.
const STATED_FPS: f32 = 120.0;

/// 20 frames at 40 per second in the canonical frame of the first, as EgoGen stores them.
///
/// Unlike [`crate::body::canonical_frame`] its frame has the origin AT the first pelvis, not on the floor below it.
#[derive(Clone, Debug, PartialEq)]
pub struct CanonicalPrimitive {
    /// Local to world.
    pub frame: Frame,
    /// 20 x 3, metres: SMPL-X's translation.
    pub trans: Vec<f32>,
    /// 20 x 165, radians: SMPL-X's rotations against the parents, axis-angle; the first 22 are the body's.
    pub poses: Vec<f32>,
    pub betas: [f32; BETAS],
    pub gender: String,
    /// What the file states: 120 in EgoGen's files, 40 in ours.
    pub stated_fps: f32,
    /// 20 x 22 x 3, metres.
    pub joints: Vec<f32>,
    /// 20 x 67 x 3, metres, SSM2 order.
    pub markers: Vec<f32>,
}

impl CanonicalPrimitive {
    /// Reads a file. Errors name file, key, shape and frame.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
        Self::parse(path, &Npz::new(path, &bytes)?)
    }

    /// [`CanonicalPrimitive::read`] of an open archive; `path` names it in errors.
    pub(super) fn parse(path: &Path, npz: &Npz) -> Result<Self> {
        let array = |key: &str, shape: &[usize]| {
            let array = npz.array(key)?;
            array.check(path, key, shape)?;
            array.check_finite(path, key)?;
            Ok(array.data)
        };
        let rot = Mat3::from_cols_slice(&array("transf_rotmat", &[3, 3])?).transpose();
        let off = (rot * rot.transpose() - Mat3::IDENTITY).to_cols_array().into_iter().fold(0.0, |m: f32, v| m.max(v.abs()));
        if off > 1e-3 || rot.determinant() < 0.0 {
            return Err(Error::file(path, format!("'transf_rotmat' is {rot}, expected a rotation")));
        }
        let transl = Vec3::from_slice(&array("transf_transl", &[1, 3])?);
        let mut primitive = Self {
            frame: Frame { rot, transl },
            trans: array("trans", &[FRAMES, 3])?,
            poses: array("poses", &[FRAMES, POSE_DIM])?,
            betas: [0.0; BETAS],
            joints: array("joints", &[FRAMES, BODY_JOINTS, 3])?,
            markers: array("marker_ssm2_67", &[FRAMES, MARKERS, 3])?,
            gender: String::new(),
            stated_fps: 0.0,
        };
        primitive.betas.copy_from_slice(&array("betas", &[BETAS])?);
        primitive.gender = npz.text("gender")?;
        primitive.stated_fps = npz.array("mocap_framerate")?.scalar(path, "mocap_framerate")?;
        if ![FPS, STATED_FPS].contains(&primitive.stated_fps) {
            let what = format!("'mocap_framerate' is {}, expected {STATED_FPS} (as EgoGen states) or {FPS}", primitive.stated_fps);
            return Err(Error::file(path, what));
        }
        Ok(primitive)
    }

    /// Writes a file that NumPy reads, in single precision; never a part of one.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_atomic(path, &self.to_npz())
    }

    fn to_npz(&self) -> Vec<u8> {
        let mut npz = NpzWriter::default();
        npz.f32s("transf_rotmat", &[3, 3], &self.frame.rot.transpose().to_cols_array());
        npz.f32s("transf_transl", &[1, 3], &self.frame.transl.to_array());
        npz.f32s("trans", &[FRAMES, 3], &self.trans);
        npz.f32s("poses", &[FRAMES, POSE_DIM], &self.poses);
        npz.f32s("betas", &[BETAS], &self.betas);
        npz.text("gender", &self.gender);
        npz.number("mocap_framerate", f64::from(self.stated_fps));
        npz.f32s("joints", &[FRAMES, BODY_JOINTS, 3], &self.joints);
        npz.f32s("marker_ssm2_67", &[FRAMES, MARKERS, 3], &self.markers);
        npz.finish()
    }

    /// The primitive that starts at frame `start` of clip `clip`, whose body is `body`. Panics where fewer than 20 frames are left.
    pub fn from_window(set: &MotionSet, body: &ShapedBody, clip: usize, start: usize) -> Self {
        let source = &set.clips[clip];
        let rows = |data: &[f32], width: usize| data[start * width..(start + FRAMES) * width].to_vec();
        let joints = rows(&source.joints, JOINT_DIM);
        let mut frame = set.frame(clip, start);
        frame.transl.z = joints[2];
        let local = frame.inverse();
        let points = |data: &[f32]| data.as_chunks::<3>().0.iter().flat_map(|&p| local.point(p.into()).to_array()).collect::<Vec<_>>();
        let (mut trans, mut poses) = (Vec::new(), Vec::new());
        for mut row in rows(&source.params, PARAMS).chunks_exact(PARAMS).map(<[f32]>::to_vec) {
            body.transform_params(&mut row, &local);
            trans.extend_from_slice(&row[TRANSL]);
            poses.extend_from_slice(&row[TRANSL.end..TRANSL.end + BODY_DIM]);
            poses.resize(poses.len() + POSE_DIM - BODY_DIM, 0.0);
        }
        Self {
            frame,
            trans,
            poses,
            betas: *body.betas(),
            gender: "neutral".into(),
            stated_fps: FPS,
            joints: points(&joints.chunks_exact(JOINT_DIM).flat_map(|j| j[..BODY_DIM].to_vec()).collect::<Vec<_>>()),
            markers: points(&rows(&source.markers, MARKER_DIM)),
        }
    }

    /// The primitive in the world, rooted at its pelvis joints, at 40 frames per second whatever the file states.
    pub fn clip(&self, name: &str) -> Result<PoseClip> {
        let array = |width: usize, data: &[f32]| Array { shape: vec![FRAMES, width], data: data.to_vec() };
        let roots: Vec<f32> = self.joints.chunks_exact(BODY_DIM).flat_map(|j| j[..3].to_vec()).collect();
        let fps = Array { shape: Vec::new(), data: vec![FPS] };
        let (poses, trans) = (("poses", array(POSE_DIM, &self.poses)), ("joints", array(3, &roots)));
        let mut clip = Recording { path: Path::new(name), poses, trans, fps: ("mocap_framerate", fps) }.clip(name, Some(Up::Z))?;
        let turn = Quat::from_mat3(&self.frame.rot);
        for pose in &mut clip.frames {
            *pose = Pose { root: self.frame.point(pose.root), rots: pose.rots.map(|r| (turn * r).normalize()) };
        }
        Ok(clip)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::BodyModel;
    use crate::io::zip::Archive;
    use crate::motion::clip::{Clip, SIDES, Skeleton, upright};

    fn fixture() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/importers/canonical.npz")
    }

    #[test]
    fn written_arrays_are_numpys_byte_for_byte() {
        let primitive = CanonicalPrimitive::read(fixture()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("again.npz");
        primitive.write(&path).unwrap();
        let entries = |path: &Path| {
            let bytes = fs::read(path).unwrap();
            let zip = Archive::new(&bytes).unwrap();
            zip.names().map(|name| (name.to_string(), zip.read(name).unwrap())).collect::<Vec<_>>()
        };
        assert!(entries(&path) == entries(&fixture()));
        assert_eq!(CanonicalPrimitive::read(&path).unwrap(), primitive);
    }

    #[test]
    fn windows_stand_in_the_frame_of_their_first_pelvis() {
        let model = BodyModel::embedded();
        let (skeleton, body) = (Skeleton::new(&model), model.shape(&[0.0; BETAS]));
        let pose = |t: usize| {
            let turn = Quat::from_rotation_z(0.8 + 0.02 * t as f32) * upright();
            let mut rots = [turn; BODY_JOINTS];
            rots[16] = turn * Quat::from_rotation_z(0.5);
            Pose { root: Vec3::new(1.0 + 0.03 * t as f32, -2.0, 0.93), rots }
        };
        let clip = Clip { name: "walk".into(), poses: (0..30).map(pose).collect(), contact: vec![[false; SIDES]; 30] };
        let set = MotionSet::new(&skeleton, &body, std::slice::from_ref(&clip));
        let primitive = CanonicalPrimitive::from_window(&set, &body, 0, 5);
        // The pelvis of the first frame is the origin; hips span x; markers follow from parameters alone.
        assert!(Vec3::from_slice(&primitive.joints).length() < 1e-5);
        let hips = Vec3::from_slice(&primitive.joints[6..]) - Vec3::from_slice(&primitive.joints[3..]);
        assert!(hips.x > 0.0 && hips.y.abs() < 1e-5);
        for (t, markers) in primitive.markers.chunks_exact(MARKER_DIM).enumerate() {
            let mut params = [0.0; PARAMS];
            params[..3].copy_from_slice(&primitive.trans[3 * t..3 * t + 3]);
            params[3..3 + BODY_DIM].copy_from_slice(&primitive.poses[POSE_DIM * t..POSE_DIM * t + BODY_DIM]);
            let mut want = [0.0; MARKER_DIM];
            body.markers(&body.pose(&params), &mut want);
            assert!(markers.iter().zip(&want).all(|(a, b)| (a - b).abs() < 1e-4), "frame {t}");
        }
        // Back in the world it is the clip again.
        for (got, want) in primitive.clip("walk").unwrap().frames.iter().zip(&clip.poses[5..]) {
            assert!((got.root - want.root).length() < 1e-4);
            assert!(got.rots.iter().zip(&want.rots).all(|(a, b)| a.angle_between(*b) < 2e-3));
        }
    }

    #[test]
    fn bad_files_name_key_and_shape() {
        let good = CanonicalPrimitive::read(fixture()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bad.npz");
        let bad = |change: fn(&mut CanonicalPrimitive)| {
            let mut primitive = good.clone();
            change(&mut primitive);
            primitive.write(&path).unwrap();
            CanonicalPrimitive::read(&path).unwrap_err().to_string()
        };
        for (message, want) in [
            (bad(|p| p.frame.rot = Mat3::from_diagonal(Vec3::new(1.0, 1.0, -1.0))), "'transf_rotmat' is"),
            (bad(|p| p.joints[66 * 3] = f32::NAN), "'joints' frame 3 holds NaN"),
            (bad(|p| p.stated_fps = 30.0), "'mocap_framerate' is 30, expected 120"),
            (bad(|p| p.trans.truncate(9)), "'trans' has 36 bytes, not those of shape (20, 3)"),
        ] {
            assert!(message.contains("bad.npz") && message.contains(want), "{message}");
        }
    }
}
