//! What SMPL-X has beyond joints, shape and skinning: a jaw and fingers, and corrections of the surface by the pose.

use super::model::blend;
use super::rotation::from_axis_angle;
use super::{BETAS, BODY_JOINTS, JOINTS, MARKERS};
use glam::{Mat3, Vec3};

/// Entries of a rotation matrix.
const ENTRIES: usize = 9;

/// Bones behind the joints, numbered on from [`JOINTS`], and pose correctives.
///
/// A bone's axis-angle is its mean plus the hands' 24 coefficients times `components`. The correctives move a vertex at rest by the sum of
/// its directions times the entries (row-major) of L_k - I, L_k the local rotations of joints 1 to 21 and then of the bones.
#[derive(Clone, Debug)]
pub(super) struct Extra {
    /// Joint or bone that carries each bone, a lower number.
    pub parents: Vec<usize>,
    pub joints: Vec<Vec3>,
    pub joint_dirs: Vec<[Vec3; BETAS]>,
    /// Axis-angle, radians.
    pub mean: Vec<Vec3>,
    /// 24 x bones.
    pub components: Vec<Vec3>,
    /// V x [`Extra::columns`].
    pub correctives: Vec<Vec3>,
    /// Those of the 67 markers.
    pub marker_correctives: Vec<Vec3>,
}

/// Rotations and positions of the bones of one frame, and what the correctives go by.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct PosedExtra {
    pub bones: Vec<(Mat3, Vec3)>,
    pub feature: Vec<f32>,
}

impl Extra {
    /// Correctives of a vertex.
    pub fn columns(&self) -> usize {
        ENTRIES * (BODY_JOINTS - 1 + self.parents.len())
    }

    /// Takes the markers' share of the correctives.
    pub fn with_markers(mut self, markers: &[usize; MARKERS]) -> Self {
        let n = self.columns();
        self.marker_correctives = markers.iter().flat_map(|&m| &self.correctives[m * n..(m + 1) * n]).copied().collect();
        self
    }

    /// Adds to `feature` the gradient of a scalar whose gradient with respect to marker `i` at rest is `grad`.
    pub fn add_feature_gradient(&self, i: usize, grad: Vec3, feature: &mut [f32]) {
        let n = self.columns();
        let dirs = &self.marker_correctives[i * n..(i + 1) * n];
        feature.iter_mut().zip(dirs).for_each(|(f, d)| *f += d.dot(grad));
    }

    /// Rest positions of the bones of shape `betas`.
    pub fn shape(&self, betas: &[f32]) -> Vec<Vec3> {
        self.joints.iter().zip(&self.joint_dirs).map(|(&j, dirs)| blend(j, dirs, betas)).collect()
    }

    /// Poses the bones: `rest` and `joints` at rest, `rot` and `pos` of the posed joints, `hands` the 24 coefficients (none: all zero).
    pub fn pose(
        &self,
        rest: &[Vec3],
        joints: &[Vec3; JOINTS],
        (rot, pos): (&[Mat3; JOINTS], &[Vec3; JOINTS]),
        local: &[Mat3; BODY_JOINTS],
        hands: &[f32],
    ) -> PosedExtra {
        let n = self.parents.len();
        let turn = |i: usize| hands.iter().enumerate().fold(self.mean[i], |v, (k, &h)| v + h * self.components[k * n + i]);
        let locals: Vec<Mat3> = (0..n).map(|i| from_axis_angle(turn(i))).collect();
        let mut bones: Vec<(Mat3, Vec3)> = Vec::with_capacity(n);
        for (i, &parent) in self.parents.iter().enumerate() {
            let (up, at, from) = match parent.checked_sub(JOINTS) {
                None => (rot[parent], pos[parent], joints[parent]),
                Some(b) => (bones[b].0, bones[b].1, rest[b]),
            };
            bones.push((up * locals[i], at + up * (rest[i] - from)));
        }
        let entries = |m: &Mat3| (*m - Mat3::IDENTITY).transpose().to_cols_array();
        let feature = local[1..].iter().chain(&locals).flat_map(entries).collect();
        PosedExtra { bones, feature }
    }
}

/// The displacement of a vertex whose corrective directions are `dirs`.
pub(super) fn correct(dirs: &[Vec3], feature: &[f32]) -> Vec3 {
    dirs.iter().zip(feature).fold(Vec3::ZERO, |v, (&d, &f)| v + f * d)
}
