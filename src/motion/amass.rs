//! AMASS recordings: `.npz` archives of SMPL-X (`*_stageii.npz`, read and written) and SMPL-H (read).

use super::FPS;
use super::poses::{PoseClip, Recording, Up};
use crate::body::{HANDS, ORIENT, PARAMS, TRANSL, check_motion};
use crate::io::numpy::{Npz, NpzWriter};
use crate::io::write_atomic;
use crate::{Error, Result};
use std::fs;
use std::path::Path;

/// Keys of the frame rate: SMPL-X's and SMPL-H's.
const RATES: [&str; 2] = ["mocap_frame_rate", "mocap_framerate"];
/// Numbers of SMPL-X's 55 rotations.
const POSE_DIM: usize = 165;
/// Shape coefficients in SMPL-X's files.
const FILE_BETAS: usize = 16;

/// Reads `poses` (T, 165) or (T, 156), `trans` (T, 3) and the frame rate; hands, face and the person's shape are left out.
///
/// AMASS has z up; give `up` for a file of its form that differs. Errors name file, key, shape and frame.
pub fn read_amass(path: impl AsRef<Path>, name: &str, up: Option<Up>) -> Result<PoseClip> {
    let path = path.as_ref();
    let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
    parse_amass(path, &Npz::new(path, &bytes)?, name, up)
}

/// [`read_amass`] of an open archive; `path` names it in errors.
pub(super) fn parse_amass(path: &Path, npz: &Npz, name: &str, up: Option<Up>) -> Result<PoseClip> {
    let Some(rate) = RATES.into_iter().find(|key| npz.has(key)) else {
        return Err(Error::file(path, format!("has no frame rate: neither '{}' (SMPL-X) nor '{}' (SMPL-H)", RATES[0], RATES[1])));
    };
    let array = |key| npz.array(key);
    Recording { path, poses: ("poses", array("poses")?), trans: ("trans", array("trans")?), fps: (rate, array(rate)?) }.clip(name, up)
}

/// Writes a motion of T x 93 body parameters in the world (z up, 40 frames per second) as AMASS stores SMPL-X: `poses` (T, 165) with the
/// body's 22 rotations and zeros, `trans` (T, 3), `betas` (16), the given 10 and zeros, in single precision; never a part of a file.
///
/// `trans` and `betas` are those of this project's body, whose pelvis rests at the origin. Errors: see [`check_motion`].
pub fn write_amass(path: impl AsRef<Path>, frames: &[f32], betas: &[f32]) -> Result<()> {
    let path = path.as_ref();
    check_motion(frames, betas).map_err(|e| Error::file(path, format!("is not written: {e}")))?;
    let rows = || frames.chunks_exact(PARAMS);
    let padded = |part: &[f32], width: usize| part.iter().copied().chain(std::iter::repeat(0.0)).take(width).collect::<Vec<_>>();
    let poses: Vec<f32> = rows().flat_map(|f| padded(&f[ORIENT.start..HANDS.start], POSE_DIM)).collect();
    let mut npz = NpzWriter::default();
    npz.f32s("poses", &[rows().len(), POSE_DIM], &poses);
    npz.f32s("trans", &[rows().len(), 3], &rows().flat_map(|f| f[TRANSL].to_vec()).collect::<Vec<_>>());
    npz.f32s("betas", &[FILE_BETAS], &padded(betas, FILE_BETAS));
    npz.text("gender", "neutral");
    npz.text("surface_model_type", "smplx");
    npz.number(RATES[0], f64::from(FPS));
    write_atomic(path, &npz.finish())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::tests::random_params;
    use crate::body::{BETAS, BODY_JOINTS, BodyModel};
    use glam::{Mat3, Vec3};

    #[test]
    fn written_motion_is_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("walk.npz");
        let betas: [f32; BETAS] = std::array::from_fn(|i| 0.1 * i as f32);
        let frames: Vec<f32> = (0..3).flat_map(|t| random_params(t + 1)).collect();
        write_amass(&path, &frames, &betas).unwrap();
        let clip = read_amass(&path, "walk", Some(Up::Z)).unwrap();
        assert_eq!((clip.frames.len(), clip.fps), (3, FPS));
        let body = BodyModel::embedded().shape(&betas);
        for (pose, params) in clip.frames.iter().zip(frames.chunks_exact(PARAMS)) {
            assert_eq!(pose.root, Vec3::from_slice(params));
            let posed = body.pose(params);
            for k in 0..BODY_JOINTS {
                assert!(Mat3::from_quat(pose.rots[k]).abs_diff_eq(posed.rot[k], 1e-5), "joint {k}");
            }
        }
        let bytes = fs::read(&path).unwrap();
        let npz = Npz::new(&path, &bytes).unwrap();
        let betas = npz.array("betas").unwrap();
        assert_eq!((betas.shape, &betas.data[8..12]), (vec![16], &[0.8, 0.1 * 9.0, 0.0, 0.0][..]));
        assert_eq!(npz.array("poses").unwrap().data[66..165], [0.0; 99]);
        assert_eq!((npz.text("gender").unwrap(), npz.text("surface_model_type").unwrap()), ("neutral".into(), "smplx".into()));
    }

    #[test]
    fn bad_motion_is_not_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("walk.npz");
        let message = |frames: &[f32], betas: &[f32]| write_amass(&path, frames, betas).unwrap_err().to_string();
        assert!(message(&[0.0; 92], &[0.0; BETAS]).contains("walk.npz: is not written: 92 frame values"));
        assert!(message(&[0.0; PARAMS], &[0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).contains("beta 2"));
        assert!(!path.exists());
    }
}
