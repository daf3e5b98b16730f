//! A body of one shape: forward kinematics, skinned markers and their adjoint.

use super::model::{BONES, BodyModel, blend};
use super::rotation::{from_axis_angle, to_axis_angle};
use super::{BETAS, BODY_JOINTS, Frame, JOINTS, MARKER_DIM, MARKERS, ORIENT, PARAMS, PARENTS, TRANSL, joint};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Frames that one task of a batched call works on.
const CHUNK: usize = 16;

/// The bones that move a vertex and how much each weighs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Skin {
    pub bone: [usize; BONES],
    /// Sum 1.
    pub weight: [f32; BONES],
}

/// A body of one shape, at rest: joints and markers. Cheap to make; the full mesh stays in [`BodyModel`].
#[derive(Clone, Debug)]
pub struct ShapedBody {
    pub(super) betas: [f32; BETAS],
    pub(super) joints: [Vec3; JOINTS],
    /// Rest markers.
    rest: [Vec3; MARKERS],
    skin: [Skin; MARKERS],
    /// Per marker and bone: weight x (rest marker - rest joint), what the bone's rotation acts on.
    arm: [[Vec3; BONES]; MARKERS],
}

/// Joint rotations and positions of one frame, in the frame of its parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Posed {
    /// Global rotation of each joint; the eyes turn with the head.
    pub rot: [Mat3; JOINTS],
    /// Position of each joint, metres.
    pub pos: [Vec3; JOINTS],
}

impl Posed {
    /// Unit viewing direction: the head's rotation of the rest pose's forward axis z.
    pub fn view(&self) -> Vec3 {
        self.rot[joint::HEAD].z_axis
    }

    /// Midpoint of the eyes.
    pub fn eye_centre(&self) -> Vec3 {
        0.5 * (self.pos[joint::L_EYE] + self.pos[joint::R_EYE])
    }

    /// Writes the 24 joints as 72 floats.
    pub fn write_joints(&self, out: &mut [f32]) {
        write_points(&self.pos, out);
    }
}

impl ShapedBody {
    pub(super) fn new(model: &BodyModel, betas: &[f32]) -> Self {
        assert_eq!(betas.len(), BETAS, "a shape has {BETAS} coefficients");
        let joints = std::array::from_fn(|k| blend(model.joints[k], &model.joint_dirs[k], betas));
        let rest: [Vec3; MARKERS] = std::array::from_fn(|i| model.rest_vertex(model.markers[i], betas));
        let skin: [Skin; MARKERS] = std::array::from_fn(|i| model.skin[model.markers[i]]);
        let arm = std::array::from_fn(|i| std::array::from_fn(|b| skin[i].weight[b] * (rest[i] - joints[skin[i].bone[b]])));
        Self { betas: std::array::from_fn(|i| betas[i]), joints, rest, skin, arm }
    }

    /// Shape coefficients.
    pub fn betas(&self) -> &[f32; BETAS] {
        &self.betas
    }

    /// Rest joints.
    pub fn joints(&self) -> &[Vec3; JOINTS] {
        &self.joints
    }

    /// Rest markers.
    pub fn rest_markers(&self) -> &[Vec3; MARKERS] {
        &self.rest
    }

    /// The bone that weighs most on each marker, and its weight.
    pub fn marker_bones(&self) -> impl ExactSizeIterator<Item = (usize, f32)> + '_ {
        self.skin.iter().map(|s| {
            let b = (1..BONES).fold(0, |top, b| if s.weight[b] > s.weight[top] { b } else { top });
            (s.bone[b], s.weight[b])
        })
    }

    /// Poses the body by `params` (93 floats; hands are ignored).
    ///
    /// The pelvis turns about its own rest joint J_0: R_0 = global orientation, x_0 = J_0 + translation; below it
    /// R_k = R_parent L_k and x_k = x_parent + R_parent (J_k - J_parent).
    pub fn pose(&self, params: &[f32]) -> Posed {
        assert_eq!(params.len(), PARAMS, "a body frame has {PARAMS} parameters");
        self.pose_rotations(&local_rotations(params), Vec3::from_slice(&params[TRANSL]))
    }

    /// [`ShapedBody::pose`] from local rotation matrices, the first of them the global orientation.
    pub fn pose_rotations(&self, local: &[Mat3; BODY_JOINTS], transl: Vec3) -> Posed {
        let mut posed = Posed { rot: [local[0]; JOINTS], pos: [self.joints[0] + transl; JOINTS] };
        for k in 1..JOINTS {
            let parent = PARENTS[k];
            let up = posed.rot[parent];
            posed.rot[k] = if k < BODY_JOINTS { up * local[k] } else { up };
            posed.pos[k] = posed.pos[parent] + up * self.offset(k);
        }
        posed
    }

    /// Skinned markers of one posed frame into `out` (201 floats): sum over bones of w (R (v - J) + x).
    pub fn markers(&self, posed: &Posed, out: &mut [f32]) {
        let points: [Vec3; MARKERS] = std::array::from_fn(|i| {
            let s = &self.skin[i];
            (0..BONES).fold(Vec3::ZERO, |sum, b| sum + posed.rot[s.bone[b]] * self.arm[i][b] + s.weight[b] * posed.pos[s.bone[b]])
        });
        write_points(&points, out);
    }

    /// Skinned markers of m frames: `params` m x 93 to `out` m x 201, spread over the cores.
    pub fn markers_batch(&self, params: &[f32], out: &mut [f32]) {
        assert_eq!(params.len() / PARAMS * MARKER_DIM, out.len(), "as many frames of markers as of parameters");
        params.par_chunks(CHUNK * PARAMS).zip(out.par_chunks_mut(CHUNK * MARKER_DIM)).for_each(|(params, out)| {
            for (p, o) in params.chunks_exact(PARAMS).zip(out.chunks_exact_mut(MARKER_DIM)) {
                self.markers(&self.pose(p), o);
            }
        });
    }

    /// Re-expresses one body frame `params` in another frame: afterwards every posed point p stands at `m.point(p)`.
    ///
    /// Rotation acts about the pelvis but translation counts from the root, so the rest pelvis d has to be compensated:
    /// `[R | t + d] := M [R | t + d]`, then `t := t - d`.
    pub fn transform_params(&self, params: &mut [f32], m: &Frame) {
        let d = self.joints[joint::PELVIS];
        let rot = m.rot * from_axis_angle(Vec3::from_slice(&params[ORIENT]));
        let transl = m.point(Vec3::from_slice(&params[TRANSL]) + d) - d;
        params[TRANSL].copy_from_slice(&transl.to_array());
        params[ORIENT].copy_from_slice(&to_axis_angle(&rot).to_array());
    }

    /// Gradient of a scalar with respect to translation and local rotations, from its gradient with respect to the markers.
    ///
    /// `posed` is what [`ShapedBody::pose_rotations`] made of `rot_local`. The 9 entries of a rotation (row-major) are taken
    /// as free numbers: the caller chains with the derivative of its own parametrisation.
    pub fn markers_backward(
        &self,
        posed: &Posed,
        rot_local: &[Mat3; BODY_JOINTS],
        grad: &[f32; MARKER_DIM],
    ) -> ([f32; 3], [[f32; 9]; BODY_JOINTS]) {
        let mut rot = [Mat3::ZERO; JOINTS];
        let mut pos = [Vec3::ZERO; JOINTS];
        for (i, g) in grad.as_chunks::<3>().0.iter().enumerate() {
            let g = Vec3::from(*g);
            for b in 0..BONES {
                let k = self.skin[i].bone[b];
                rot[k] += outer(g, self.arm[i][b]);
                pos[k] += self.skin[i].weight[b] * g;
            }
        }
        let mut local = [[0.0; 9]; BODY_JOINTS];
        for k in (1..JOINTS).rev() {
            let parent = PARENTS[k];
            let (rot_k, pos_k) = (rot[k], pos[k]);
            pos[parent] += pos_k;
            rot[parent] += outer(pos_k, self.offset(k));
            if k < BODY_JOINTS {
                rot[parent] += rot_k * rot_local[k].transpose();
                local[k] = row_major(posed.rot[parent].transpose() * rot_k);
            } else {
                rot[parent] += rot_k;
            }
        }
        local[0] = row_major(rot[0]);
        (pos[0].to_array(), local)
    }

    /// Rest joint `k` seen from its parent.
    fn offset(&self, k: usize) -> Vec3 {
        self.joints[k] - self.joints[PARENTS[k]]
    }
}

/// The 22 local rotations of a body frame of 93 floats, the global orientation first.
pub fn local_rotations(params: &[f32]) -> [Mat3; BODY_JOINTS] {
    std::array::from_fn(|k| from_axis_angle(Vec3::from_slice(&params[ORIENT.start + 3 * k..])))
}

fn outer(a: Vec3, b: Vec3) -> Mat3 {
    Mat3::from_cols(a * b.x, a * b.y, a * b.z)
}

fn row_major(m: Mat3) -> [f32; 9] {
    m.transpose().to_cols_array()
}

fn write_points(points: &[Vec3], out: &mut [f32]) {
    for (o, p) in out.as_chunks_mut::<3>().0.iter_mut().zip(points) {
        *o = p.to_array();
    }
}
