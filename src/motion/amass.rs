//! AMASS recordings: `.npz` archives of SMPL-X (`*_stageii.npz`) and SMPL-H.

use super::numpy::Npz;
use super::poses::{PoseClip, Recording, Up};
use crate::{Error, Result};
use std::fs;
use std::path::Path;

/// Keys of the frame rate: SMPL-X's and SMPL-H's.
const RATES: [&str; 2] = ["mocap_frame_rate", "mocap_framerate"];

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
