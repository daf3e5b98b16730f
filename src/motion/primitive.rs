//! Canonical windows of motion: what the motion model trains on.

use super::Origin;
use super::clip::{Clip, Skeleton};
use crate::body::{JOINTS, MARKER_DIM, PARAMS, ShapedBody, canonical_frame, joint};
use glam::Vec3;
use rayon::prelude::*;

/// Floats of the joints of one frame, 24 x 3.
pub const JOINT_DIM: usize = JOINTS * 3;

/// A clip as bodies, joints and markers in the world (z up, metres), T frames.
#[derive(Clone, Debug)]
pub struct ClipMarkers {
    pub name: String,
    /// T x 201.
    pub markers: Vec<f32>,
    /// T x 93.
    pub params: Vec<f32>,
    /// T x 72, eyes last.
    pub joints: Vec<f32>,
}

/// A set of clips to cut windows from.
#[derive(Clone, Debug, Default)]
pub struct MotionSet {
    pub clips: Vec<ClipMarkers>,
}

impl ClipMarkers {
    /// Poses `body` through `clip`.
    pub fn new(skeleton: &Skeleton, body: &ShapedBody, clip: &Clip) -> Self {
        Self::from_params(clip.name.clone(), body, clip.params(skeleton).into_iter().flatten().collect())
    }

    /// Poses `body` by `params` (T x 93, world).
    pub fn from_params(name: String, body: &ShapedBody, params: Vec<f32>) -> Self {
        let frames = params.len() / PARAMS;
        let mut markers = vec![0.0; frames * MARKER_DIM];
        let mut joints = vec![0.0; frames * JOINT_DIM];
        for ((p, m), j) in params.chunks_exact(PARAMS).zip(markers.chunks_exact_mut(MARKER_DIM)).zip(joints.chunks_exact_mut(JOINT_DIM)) {
            let posed = body.pose(p);
            body.markers(&posed, m);
            posed.write_joints(j);
        }
        Self { name, markers, params, joints }
    }

    /// Frames.
    pub fn len(&self) -> usize {
        self.params.len() / PARAMS
    }

    /// Whether the clip holds no frame.
    pub fn is_empty(&self) -> bool {
        self.params.is_empty()
    }

    fn joint(&self, t: usize, j: usize) -> Vec3 {
        Vec3::from_slice(&self.joints[t * JOINT_DIM + 3 * j..])
    }
}

impl MotionSet {
    /// Poses `body` through all clips, in their order.
    pub fn new(skeleton: &Skeleton, body: &ShapedBody, clips: &[Clip]) -> Self {
        Self { clips: clips.par_iter().map(|c| ClipMarkers::new(skeleton, body, c)).collect() }
    }

    /// Frames of all clips together.
    pub fn frames(&self) -> usize {
        self.clips.iter().map(ClipMarkers::len).sum()
    }

    /// All windows of `len` frames that start every `stride` frames, as (clip, first frame).
    pub fn windows(&self, len: usize, stride: usize) -> Vec<(usize, usize)> {
        let starts = |n: usize| (0..(n + 1).saturating_sub(len)).step_by(stride.max(1));
        self.clips.iter().enumerate().flat_map(|(i, c)| starts(c.len()).map(move |s| (i, s))).collect()
    }

    /// The canonical frame (local to world) of frame `t` of clip `clip`.
    pub fn frame(&self, clip: usize, t: usize) -> crate::body::Frame {
        let c = &self.clips[clip];
        canonical_frame(c.joint(t, joint::PELVIS), c.joint(t, joint::L_HIP), c.joint(t, joint::R_HIP))
    }

    /// Markers of frames `start..start + len`, in the canonical frame of frame `start`, into `out` (len x 201, metres).
    pub fn canonical_window(&self, clip: usize, start: usize, len: usize, out: &mut [f32]) {
        self.window(Origin::Floor, clip, start, len, out);
    }

    /// [`MotionSet::canonical_window`] in a canonical frame with that origin.
    pub fn window(&self, origin: Origin, clip: usize, start: usize, len: usize, out: &mut [f32]) {
        let markers = &self.clips[clip].markers[start * MARKER_DIM..(start + len) * MARKER_DIM];
        let mut frame = self.frame(clip, start);
        if origin == Origin::Pelvis {
            frame.transl.z = self.clips[clip].joint(start, joint::PELVIS).z;
        }
        let local = frame.inverse();
        for (from, to) in markers.chunks_exact(3).zip(out.chunks_exact_mut(3)) {
            to.copy_from_slice(&local.point(Vec3::from_slice(from)).to_array());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::MARKERS;

    /// Two frames of a body at (1, 2, 0.9) facing +x, right hip towards -y; frame 1 is 0.1 m ahead.
    fn set() -> MotionSet {
        let (mut markers, mut joints) = (Vec::new(), Vec::new());
        for t in 0..2 {
            let x = 1.0 + 0.1 * t as f32;
            markers.extend([x + 0.2, 2.3, 1.0].repeat(MARKERS));
            let mut j = [0.0; JOINT_DIM];
            j[0..3].copy_from_slice(&[x, 2.0, 0.9]);
            j[3..6].copy_from_slice(&[x, 2.1, 0.8]);
            j[6..9].copy_from_slice(&[x, 1.9, 0.8]);
            joints.extend(j);
        }
        MotionSet { clips: vec![ClipMarkers { name: "two".into(), markers, params: vec![0.0; 2 * PARAMS], joints }] }
    }

    #[test]
    fn canonical_window_by_hand() {
        // Local x is world -y, local y is world +x: (0.2, 0.3) ahead and left of the pelvis becomes (-0.3, 0.2).
        let mut out = [0.0; 2 * MARKER_DIM];
        set().canonical_window(0, 0, 2, &mut out);
        for (got, want) in out[..3].iter().chain(&out[MARKER_DIM..MARKER_DIM + 3]).zip([-0.3, 0.2, 1.0, -0.3, 0.3, 1.0]) {
            assert!((got - want).abs() < 1e-6, "{got} for {want}");
        }
        set().window(Origin::Pelvis, 0, 1, 1, &mut out[..MARKER_DIM]);
        assert!((out[2] - 0.1).abs() < 1e-6, "the pelvis is 0.9 m up, the markers 1 m");
    }

    #[test]
    fn windows_fit_into_their_clips() {
        let set = set();
        assert_eq!(set.windows(1, 1), [(0, 0), (0, 1)]);
        assert_eq!(set.windows(2, 5), [(0, 0)]);
        assert!(set.windows(3, 1).is_empty());
    }
}
