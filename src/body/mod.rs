//! The parametric body: skeleton, shape, skinning, markers and eyes, in parameters of SMPL-X's layout.

mod extra;
mod frame;
mod model;
mod parts;
pub mod rotation;
mod shaped;
pub(crate) mod smplx;
mod surface;

pub use frame::{Frame, canonical_frame};
pub use model::BodyModel;
pub use shaped::{Posed, ShapedBody, local_rotations};
pub use surface::{Inside, Moving, Obstacles, Points, ShapedSurface, Surface, smplx_weights};

use crate::{Error, Result};
use std::ops::Range;

/// Joints of a body: SMPL-X's 22 body joints, then the left and the right eye.
pub const JOINTS: usize = 24;
/// Joints with a rotation of their own in the parameters.
pub const BODY_JOINTS: usize = 22;
/// Surface markers of the SSM2 set.
pub const MARKERS: usize = 67;
/// Floats of one frame of markers, 67 x 3.
pub const MARKER_DIM: usize = MARKERS * 3;
/// Shape coefficients.
pub const BETAS: usize = 10;
/// Floats of one body frame: translation 3, global orientation 3, body pose 63 (axis-angle), hands 24 (unused by bodies without fingers).
pub const PARAMS: usize = 93;
/// Translation, metres.
pub const TRANSL: Range<usize> = 0..3;
/// Global orientation, axis-angle, radians.
pub const ORIENT: Range<usize> = 3..6;
/// Body pose, 21 axis-angle rotations, radians.
pub const POSE: Range<usize> = 6..69;
/// Hand pose.
pub const HANDS: Range<usize> = 69..93;
/// Parent of each joint; the pelvis is its own root.
pub const PARENTS: [usize; JOINTS] = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15];
/// SMPL-X's names of the joints.
#[rustfmt::skip]
pub const JOINT_NAMES: [&str; JOINTS] = [
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3", "left_foot",
    "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_eye_smplhf", "right_eye_smplhf",
];
/// Indices of the foot markers RHEE, RTOE, RRSTBEEF, LHEE, LTOE, LRSTBEEF in the SSM2 order.
pub const FOOT_MARKERS: [usize; 6] = [47, 60, 55, 16, 30, 25];

/// Joint indices by name.
pub mod joint {
    pub const PELVIS: usize = 0;
    pub const L_HIP: usize = 1;
    pub const R_HIP: usize = 2;
    pub const L_KNEE: usize = 4;
    pub const R_KNEE: usize = 5;
    pub const L_ANKLE: usize = 7;
    pub const R_ANKLE: usize = 8;
    pub const L_FOOT: usize = 10;
    pub const R_FOOT: usize = 11;
    pub const NECK: usize = 12;
    pub const HEAD: usize = 15;
    pub const L_EYE: usize = 22;
    pub const R_EYE: usize = 23;
}

/// Refuses a motion (T x 93 parameters) that has no whole number of frames or none, a shape of other than 10 coefficients, and
/// values that are not finite.
pub fn check_motion(frames: &[f32], betas: &[f32]) -> Result<()> {
    if frames.is_empty() || !frames.len().is_multiple_of(PARAMS) || betas.len() != BETAS {
        let what = format!("{} frame values and {} betas, expected a multiple of {PARAMS} and {BETAS}", frames.len(), betas.len());
        return Err(Error::invalid(what));
    }
    if let Some(i) = frames.iter().position(|v| !v.is_finite()) {
        return Err(Error::invalid(format!("frame {} holds a value that is not finite", i / PARAMS)));
    }
    match betas.iter().position(|v| !v.is_finite()) {
        Some(i) => Err(Error::invalid(format!("beta {i} is not finite"))),
        None => Ok(()),
    }
}

#[cfg(test)]
pub(crate) mod tests;
