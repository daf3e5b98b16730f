//! Rigid frames and the canonical frame of a motion primitive.

use glam::{Mat3, Vec3};
use serde::{Deserialize, Serialize};

/// A rigid frame given local-to-world: `world = rot * local + transl`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Rotation, columns are the local axes in the world.
    pub rot: Mat3,
    /// Origin of the local frame in the world, metres.
    pub transl: Vec3,
}

impl Frame {
    /// The world itself.
    pub const IDENTITY: Self = Self { rot: Mat3::IDENTITY, transl: Vec3::ZERO };

    /// A frame on the floor turned by `yaw` about z with its origin at (x, y, 0).
    pub fn planar(yaw: f32, x: f32, y: f32) -> Self {
        Self { rot: Mat3::from_rotation_z(yaw), transl: Vec3::new(x, y, 0.0) }
    }

    /// Local point to world.
    pub fn point(&self, p: Vec3) -> Vec3 {
        self.rot * p + self.transl
    }

    /// Local direction to world.
    pub fn dir(&self, d: Vec3) -> Vec3 {
        self.rot * d
    }

    /// World-to-local frame.
    pub fn inverse(&self) -> Self {
        let rot = self.rot.transpose();
        Self { rot, transl: -(rot * self.transl) }
    }

    /// The frame `inner`, given in `self`, expressed in the world.
    pub fn compose(&self, inner: &Self) -> Self {
        Self { rot: self.rot * inner.rot, transl: self.point(inner.transl) }
    }
}

/// The canonical frame of a primitive (local-to-world), from joints of its first frame.
///
/// x points from the left to the right hip flattened to the floor, z up, y = z x x is the body's forward direction.
/// The origin lies on the FLOOR below the pelvis (z = 0): heights stay absolute, so a model sees and can correct its own
/// vertical drift. (The authors put the origin at the pelvis itself.) Degenerate hips (one above the other) fall back to x.
pub fn canonical_frame(pelvis: Vec3, l_hip: Vec3, r_hip: Vec3) -> Frame {
    let across = r_hip - l_hip;
    let x = Vec3::new(across.x, across.y, 0.0).try_normalize().unwrap_or(Vec3::X);
    Frame { rot: Mat3::from_cols(x, Vec3::Z.cross(x), Vec3::Z), transl: Vec3::new(pelvis.x, pelvis.y, 0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn canonical_frame_by_hand() {
        // Hips along world y: right hip at -y, so x = -y and forward y_local = z x (-y) = +x.
        let f = canonical_frame(Vec3::new(1.0, 2.0, 0.9), Vec3::new(1.0, 2.1, 0.85), Vec3::new(1.0, 1.9, 0.95));
        assert!((f.rot.x_axis - Vec3::NEG_Y).length() < 1e-6);
        assert!((f.rot.y_axis - Vec3::X).length() < 1e-6);
        assert_eq!(f.transl, Vec3::new(1.0, 2.0, 0.0));
        assert!((f.inverse().compose(&f).transl).length() < 1e-6);
    }
}
