//! A body of one shape: forward kinematics, skinned markers and their adjoint.

use super::extra::{Extra, PosedExtra, correct};
use super::model::{BodyModel, blend};
use super::rotation::{from_axis_angle, to_axis_angle};
use super::{BETAS, BODY_JOINTS, Frame, HANDS, JOINTS, MARKER_DIM, MARKERS, ORIENT, PARAMS, PARENTS, TRANSL, joint};
use glam::{Mat3, Mat3A, Vec3, Vec3A};
use rayon::prelude::*;
use std::sync::Arc;

/// Frames that one task of a batched call works on.
const CHUNK: usize = 16;

/// What one bone does to one marker.
#[derive(Clone, Copy, Debug)]
struct Pull {
    bone: usize,
    weight: f32,
    /// weight x (rest marker - rest joint), what the bone's rotation acts on.
    arm: Vec3A,
}

/// A body of one shape, at rest: joints and markers. Cheap to make; the full mesh stays in [`BodyModel`].
#[derive(Clone, Debug)]
pub struct ShapedBody {
    pub(super) betas: [f32; BETAS],
    pub(super) joints: [Vec3; JOINTS],
    /// Rest markers.
    rest: [Vec3; MARKERS],
    /// Those of marker i end at `ends[i]`.
    pulls: Vec<Pull>,
    ends: [usize; MARKERS],
    extra: Option<Arc<Extra>>,
    /// Rest positions of its bones.
    bones: Vec<Vec3>,
}

/// Joint rotations and positions of one frame, in the frame of its parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// Global rotation of each joint; the eyes turn with the head.
    pub rot: [Mat3; JOINTS],
    /// Position of each joint, metres.
    pub pos: [Vec3; JOINTS],
    pub(super) extra: PosedExtra,
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

    /// Rotation and position of bone `k`.
    fn bone(&self, k: usize) -> (Mat3, Vec3) {
        if k < JOINTS { (self.rot[k], self.pos[k]) } else { self.extra.bones[k - JOINTS] }
    }

    /// All bones, the joints first.
    pub(super) fn bones(&self) -> impl Iterator<Item = (Mat3, Vec3)> + '_ {
        (0..JOINTS + self.extra.bones.len()).map(|k| self.bone(k))
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
        let mut body = Self {
            betas: std::array::from_fn(|i| betas[i]),
            joints,
            rest,
            pulls: Vec::with_capacity(4 * MARKERS),
            ends: [0; MARKERS],
            extra: model.extra.clone(),
            bones: model.extra.as_ref().map(|e| e.shape(betas)).unwrap_or_default(),
        };
        for (i, rest) in rest.into_iter().enumerate() {
            for &(bone, weight) in model.skin.of(model.markers[i]) {
                body.pulls.push(Pull { bone, weight, arm: (weight * (rest - body.rest_bone(bone))).into() });
            }
            body.ends[i] = body.pulls.len();
        }
        body
    }

    fn rest_bone(&self, k: usize) -> Vec3 {
        if k < JOINTS { self.joints[k] } else { self.bones[k - JOINTS] }
    }

    /// Rest positions of all bones, the joints first.
    pub(super) fn rest_bones(&self) -> impl Iterator<Item = Vec3> + '_ {
        self.joints.iter().chain(&self.bones).copied()
    }

    fn pulls(&self, marker: usize) -> &[Pull] {
        &self.pulls[if marker == 0 { 0 } else { self.ends[marker - 1] }..self.ends[marker]]
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
        (0..MARKERS).map(|i| {
            let most = |top: (usize, f32), p: &Pull| if p.weight > top.1 { (p.bone, p.weight) } else { top };
            self.pulls(i).iter().fold((0, 0.0), most)
        })
    }

    /// Poses the body by `params` (93 floats; hands are ignored by bodies without fingers).
    ///
    /// The pelvis turns about its own rest joint J_0: R_0 = global orientation, x_0 = J_0 + translation; below it
    /// R_k = R_parent L_k and x_k = x_parent + R_parent (J_k - J_parent).
    pub fn pose(&self, params: &[f32]) -> Posed {
        assert_eq!(params.len(), PARAMS, "a body frame has {PARAMS} parameters");
        self.pose_with(&local_rotations(params), Vec3::from_slice(&params[TRANSL]), &params[HANDS])
    }

    /// [`ShapedBody::pose`] from local rotation matrices, the first of them the global orientation, and hands at rest.
    pub fn pose_rotations(&self, local: &[Mat3; BODY_JOINTS], transl: Vec3) -> Posed {
        self.pose_with(local, transl, &[])
    }

    fn pose_with(&self, local: &[Mat3; BODY_JOINTS], transl: Vec3, hands: &[f32]) -> Posed {
        let extra = PosedExtra::default();
        let mut posed = Posed { rot: [local[0]; JOINTS], pos: [self.joints[0] + transl; JOINTS], extra };
        for k in 1..JOINTS {
            let parent = PARENTS[k];
            let up = posed.rot[parent];
            posed.rot[k] = if k < BODY_JOINTS { up * local[k] } else { up };
            posed.pos[k] = posed.pos[parent] + up * self.offset(k);
        }
        if let Some(extra) = &self.extra {
            posed.extra = extra.pose(&self.bones, &self.joints, (&posed.rot, &posed.pos), local, hands);
        }
        posed
    }

    /// Skinned markers of one posed frame into `out` (201 floats): sum over bones of w (R (v - J) + x), v corrected by the pose.
    pub fn markers(&self, posed: &Posed, out: &mut [f32]) {
        // Four lanes each, for speed; only bodies with fingers take memory for their bones.
        let wide = |(rot, pos): (Mat3, Vec3)| (Mat3A::from(rot), Vec3A::from(pos));
        let joints: [_; JOINTS] = std::array::from_fn(|k| wide(posed.bone(k)));
        let more: Vec<_> = posed.extra.bones.iter().copied().map(wide).collect();
        let points: [Vec3; MARKERS] = std::array::from_fn(|i| {
            let lift = self.correction(i, posed).map(Vec3A::from);
            let point = self.pulls(i).iter().fold(Vec3A::ZERO, |sum, p| {
                let (rot, pos) = p.bone.checked_sub(JOINTS).map_or_else(|| joints[p.bone], |k| more[k]);
                let arm = lift.map_or(p.arm, |lift| p.arm + p.weight * lift);
                sum + rot * arm + p.weight * pos
            });
            point.into()
        });
        write_points(&points, out);
    }

    /// What the pose adds to rest marker `i`, for bodies that have such.
    fn correction(&self, i: usize, posed: &Posed) -> Option<Vec3> {
        let extra = self.extra.as_ref()?;
        let n = extra.columns();
        Some(correct(&extra.marker_correctives[i * n..(i + 1) * n], &posed.extra.feature))
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
    /// `posed` is what [`ShapedBody::pose_rotations`] made of `rot_local`; hands, where there are any, stay as they are. The 9 entries of a rotation (row-major) are taken
    /// as free numbers: the caller chains with the derivative of its own parametrisation.
    pub fn markers_backward(
        &self,
        posed: &Posed,
        rot_local: &[Mat3; BODY_JOINTS],
        grad: &[f32; MARKER_DIM],
    ) -> ([f32; 3], [[f32; 9]; BODY_JOINTS]) {
        let mut rot = [Mat3::ZERO; JOINTS];
        let mut pos = [Vec3::ZERO; JOINTS];
        let mut bones = vec![(Mat3::ZERO, Vec3::ZERO); self.bones.len()];
        let mut feature = vec![0.0; posed.extra.feature.len()];
        for (i, g) in grad.as_chunks::<3>().0.iter().enumerate() {
            let g = Vec3::from(*g);
            let lift = self.correction(i, posed);
            for p in self.pulls(i) {
                let rest = Vec3::from(p.arm);
                let arm = lift.map_or(rest, |lift| rest + p.weight * lift);
                let (r, x) = match p.bone.checked_sub(JOINTS) {
                    None => (&mut rot[p.bone], &mut pos[p.bone]),
                    Some(b) => {
                        let (r, x) = &mut bones[b];
                        (r, x)
                    }
                };
                *r += outer(g, arm);
                *x += p.weight * g;
            }
            if let Some(extra) = &self.extra {
                let back = |p: &Pull| p.weight * (posed.bone(p.bone).0.transpose() * g);
                extra.add_feature_gradient(i, self.pulls(i).iter().map(back).sum(), &mut feature);
            }
        }
        self.bones_backward(posed, &bones, &mut rot, &mut pos);
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
        for (local, feature) in local[1..].iter_mut().zip(feature.as_chunks::<9>().0) {
            local.iter_mut().zip(feature).for_each(|(l, f)| *l += f);
        }
        (pos[0].to_array(), local)
    }

    /// Passes the gradients of the bones' rotations and positions on to the joints that carry them.
    fn bones_backward(&self, posed: &Posed, grad: &[(Mat3, Vec3)], rot: &mut [Mat3; JOINTS], pos: &mut [Vec3; JOINTS]) {
        let Some(extra) = &self.extra else { return };
        let mut grad = grad.to_vec();
        for i in (0..grad.len()).rev() {
            let ((r, x), parent) = (grad[i], extra.parents[i]);
            let turn = posed.bone(parent).0.transpose() * posed.extra.bones[i].0;
            let up = outer(x, self.bones[i] - self.rest_bone(parent)) + r * turn.transpose();
            let (to_rot, to_pos) = match parent.checked_sub(JOINTS) {
                None => (&mut rot[parent], &mut pos[parent]),
                Some(b) => {
                    let (r, x) = &mut grad[b];
                    (r, x)
                }
            };
            *to_rot += up;
            *to_pos += x;
        }
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
