//! SAMP recordings: Python pickles of SMPL-X poses.

use super::poses::{PoseClip, Recording, Up};
use crate::io::pickle::Pickle;
use crate::{Error, Result};
use std::fs;
use std::path::Path;

/// Reads `pose_est_fullposes` (T, 165), `pose_est_trans` (T, 3) and `mocap_framerate`; hands, face and the person's shape are left out.
///
/// The pickle is taken as data, nothing in it is executed. SAMP has z up; give `up` for a file that differs. Errors name file, key,
/// shape and frame, or the name in the pickle that is refused.
pub fn read_samp(path: impl AsRef<Path>, name: &str, up: Option<Up>) -> Result<PoseClip> {
    let path = path.as_ref();
    parse_samp(path, &fs::read(path).map_err(|e| Error::io(path, e))?, name, up)
}

/// [`read_samp`] of the content of a file; `path` names it in errors.
pub(super) fn parse_samp(path: &Path, bytes: &[u8], name: &str, up: Option<Up>) -> Result<PoseClip> {
    let pickle = Pickle::parse(path, bytes)?;
    let array = |key: &'static str| Ok((key, pickle.array(key)?));
    let (poses, trans, fps) = (array("pose_est_fullposes")?, array("pose_est_trans")?, array("mocap_framerate")?);
    Recording { path, poses, trans, fps }.clip(name, up)
}
