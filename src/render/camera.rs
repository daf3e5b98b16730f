//! A pinhole camera in the OpenCV convention.

use crate::body::Frame;
use crate::{Error, Result};
use glam::{Mat3, Vec2, Vec3};

/// A pinhole camera: x right, y down, z forward; pixel (i, j) covers [i, i+1) x [j, j+1), so its centre lies at +0.5.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal lengths, pixels.
    pub focal: Vec2,
    /// Principal point, pixels.
    pub centre: Vec2,
    /// Camera coordinates to the world's; the translation is the eye.
    pub camera_to_world: Frame,
    /// World coordinates to the camera's.
    pub world_to_camera: Frame,
}

impl Camera {
    /// A camera at `eye` that sees `target` in the image centre with z up, square pixels and the vertical field of view `fov`, radians.
    ///
    /// Straight up or down, the top of the image is +y. Errors: `eye` equals `target`, or `fov` is not in (0, pi).
    pub fn look_at(eye: Vec3, target: Vec3, width: usize, height: usize, fov: f32) -> Result<Self> {
        let forward = (target - eye).try_normalize().ok_or_else(|| Error::invalid(format!("camera eye and target are both {eye}")))?;
        if !(fov > 0.0 && fov < std::f32::consts::PI) {
            return Err(Error::invalid(format!("camera field of view is {fov} rad, expected between 0 and pi")));
        }
        let right = forward.cross(Vec3::Z).try_normalize().unwrap_or(Vec3::X);
        let rot = Mat3::from_cols(right, forward.cross(right), forward);
        let camera_to_world = Frame { rot, transl: eye };
        let focal = Vec2::splat(0.5 * height as f32 / (0.5 * fov).tan());
        let centre = Vec2::new(width as f32, height as f32) * 0.5;
        Ok(Self { width, height, focal, centre, camera_to_world, world_to_camera: camera_to_world.inverse() })
    }

    /// The eye's position in the world.
    pub fn eye(&self) -> Vec3 {
        self.camera_to_world.transl
    }

    /// World direction through image position (u, v), with camera z equal to 1: a hit at `t` along it has the depth `t`.
    pub fn direction(&self, uv: Vec2) -> Vec3 {
        self.camera_to_world.dir(((uv - self.centre) / self.focal).extend(1.0))
    }

    /// Image position and depth of the world point `p`; None behind the camera.
    pub fn project(&self, p: Vec3) -> Option<(Vec2, f32)> {
        let c = self.world_to_camera.point(p);
        (c.z > 0.0).then(|| (c.truncate() / c.z * self.focal + self.centre, c.z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        // Looks along world +y from 5 m behind the origin, 1 m up. tan(fov/2) = 0.5, so focal = 0.5 * 480 / 0.5 = 480.
        Camera::look_at(Vec3::new(0.0, -5.0, 1.0), Vec3::new(0.0, 0.0, 1.0), 640, 480, 2.0 * 0.5f32.atan()).unwrap()
    }

    #[test]
    fn conventions_by_hand() {
        let c = camera();
        assert!((c.focal - Vec2::splat(480.0)).length() < 1e-3);
        // Camera x (right) is world +x, y (down) is -z, z (forward) is +y.
        for (local, world) in [(Vec3::X, Vec3::X), (Vec3::Y, Vec3::NEG_Z), (Vec3::Z, Vec3::Y)] {
            assert!((c.camera_to_world.dir(local) - world).length() < 1e-6);
        }
        assert!((c.camera_to_world.rot.determinant() - 1.0).abs() < 1e-6);
        assert!((c.world_to_camera.point(Vec3::new(1.0, 1.0, 3.0)) - Vec3::new(1.0, -2.0, 6.0)).length() < 1e-5);
    }

    #[test]
    fn projection_by_hand() {
        let c = camera();
        // (1, 3, 0) is 8 m ahead, 1 right, 1 down: u = 320 + 480/8 = 380, v = 240 + 480/8 = 300.
        let (uv, z) = c.project(Vec3::new(1.0, 3.0, 0.0)).unwrap();
        assert!((uv - Vec2::new(380.0, 300.0)).length() < 1e-3 && (z - 8.0).abs() < 1e-5);
        assert!(c.project(Vec3::new(0.0, -6.0, 1.0)).is_none());
        assert!((c.eye() + z * c.direction(uv) - Vec3::new(1.0, 3.0, 0.0)).length() < 1e-4);
    }

    #[test]
    fn straight_down_keeps_y_up() {
        let c = Camera::look_at(Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, 100, 100, 1.0).unwrap();
        let (right, _) = c.project(Vec3::X).unwrap();
        let (top, _) = c.project(Vec3::Y).unwrap();
        assert!(right.x > 50.0 && (right.y - 50.0).abs() < 1e-3);
        assert!(top.y < 50.0 && (top.x - 50.0).abs() < 1e-3);
    }

    #[test]
    fn bad_cameras_are_refused() {
        assert!(Camera::look_at(Vec3::X, Vec3::X, 10, 10, 1.0).is_err());
        assert!(Camera::look_at(Vec3::X, Vec3::Y, 10, 10, 0.0).is_err());
        assert!(Camera::look_at(Vec3::X, Vec3::Y, 10, 10, f32::NAN).is_err());
    }
}
