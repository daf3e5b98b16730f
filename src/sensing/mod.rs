//! Egocentric sensing: what the eyes see of the walkable area, as 32 distances.

use crate::body::{JOINTS, joint};
use crate::motion::SEED;
use crate::scene::Polygon;
use crate::sim::People;
use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};

/// Rays of one look.
pub const RAYS: usize = 32;
/// Distances are clamped to this, metres. (Sec. S2.1 calls the rays "potentially infinite"; the authors' code uses 7 m.)
pub const RANGE: f64 = 7.0;

/// One look (sec. S2.1): distances to the first border along rays from -90 to +90 degrees round the direction `view`.
///
/// Ray 0 points to the right of `view`, ray 31 to its left. `out` gets 32 values -1 + 2 d / 7 in [-1, 1]; an eye outside
/// the walkable area reads -1 everywhere. `eye`, `view`: on the floor, world; `view` need not be of unit length.
pub fn look(walkable: &Polygon, eye: Vec2, view: Vec2, out: &mut [f32]) {
    let eye = eye.as_dvec2();
    if !walkable.contains(eye) {
        return out.fill(-1.0);
    }
    let view = view.as_dvec2().normalize_or(DVec2::Y);
    for (i, v) in out.iter_mut().enumerate() {
        let angle = -FRAC_PI_2 + PI * i as f64 / (RAYS - 1) as f64;
        let hit = walkable.first_hit(eye, DVec2::from_angle(angle).rotate(view));
        *v = (-1.0 + 2.0 * hit.unwrap_or(RANGE).min(RANGE) / RANGE) as f32;
    }
}

/// The looks of person `i` in both seed frames; `out`: 2 x 32.
///
/// The eye is the midpoint of the two eye joints. A head that looks straight up or down sees along the body's forward axis.
pub fn look_person(people: &People, i: usize, walkable: &Polygon, out: &mut [f32]) {
    let frame = &people.frames[i];
    for (t, out) in out.chunks_exact_mut(RAYS).enumerate() {
        let k = i * SEED + t;
        let eye = |j: usize| Vec3::from_slice(&people.joints[(k * JOINTS + j) * 3..][..3]);
        let middle = frame.point((eye(joint::L_EYE) + eye(joint::R_EYE)) / 2.0);
        let view = Vec3::from_slice(&people.views[3 * k..][..3]);
        let flat = if view.truncate().length_squared() > 1e-12 { view } else { Vec3::Y };
        look(walkable, middle.truncate(), frame.dir(flat).truncate(), out);
    }
}

/// The looks of everyone, each in a scene of its own; `out`: n x 2 x 32.
pub fn look_all<'a>(people: &People, walkable: impl Fn(usize) -> &'a Polygon + Sync, out: &mut [f32]) {
    out.par_chunks_exact_mut(SEED * RAYS).with_min_len(8).enumerate().for_each(|(i, out)| look_person(people, i, walkable(i), out));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Frame;
    use crate::scene::{BoxObstacle, Scene};

    fn looked(scene: &Scene, eye: Vec2, view: Vec2) -> [f32; RAYS] {
        let mut out = [0.0; RAYS];
        look(&scene.walkable, eye, view, &mut out);
        out
    }

    /// Walls at +-3 m, a box of 1 x 1 m at (1.5, 0), the eye at the origin looking along +x.
    fn scene() -> Scene {
        let b = BoxObstacle { centre: Vec2::new(1.5, 0.0), size: Vec2::ONE, yaw: 0.0, height: 2.0 };
        Scene::with_boxes(3.0, vec![b]).unwrap()
    }

    #[test]
    fn by_hand() {
        let out = looked(&scene(), Vec2::ZERO, Vec2::new(5.0, 0.0));
        // Sideways to the walls at 3 m: -1 + 6/7; rays 15 and 16 at -+2.903 degrees to the box face at 1 m.
        assert!((out[0] + 1.0 / 7.0).abs() < 1e-6 && (out[31] + 1.0 / 7.0).abs() < 1e-6);
        let near = (-1.0 + 2.0 / 7.0 / (PI / 62.0).cos()) as f32;
        assert!((out[15] - near).abs() < 1e-6 && (out[16] - near).abs() < 1e-6);
        // Looking along +y from (-1, -1), ray 0 (right) goes along +x to the wall 4 m away and ray 31 to the left wall at 2 m.
        let out = looked(&scene(), Vec2::new(-1.0, -1.0), Vec2::Y);
        assert!((out[0] - (-1.0 + 8.0 / 7.0)).abs() < 1e-6 && (out[31] - (-1.0 + 4.0 / 7.0)).abs() < 1e-6);
    }

    #[test]
    fn clamped_and_blind() {
        let wide = Scene::with_boxes(20.0, vec![]).unwrap();
        assert_eq!(looked(&wide, Vec2::ZERO, Vec2::X), [1.0; RAYS]);
        assert_eq!(looked(&scene(), Vec2::new(1.5, 0.1), Vec2::X), [-1.0; RAYS], "inside the box");
        assert_eq!(looked(&scene(), Vec2::new(4.0, 0.1), Vec2::X), [-1.0; RAYS], "outside the floor");
    }

    #[test]
    fn people_look_from_their_eyes() {
        let n = 3;
        let mut people = People { frames: vec![Frame::planar(0.3, 0.4, -1.0); n], ..Default::default() };
        people.joints = vec![0.0; n * SEED * JOINTS * 3];
        people.views = [0.1, 0.8, 0.6].repeat(n * SEED);
        // Straight up in the second frame of the last person: falls back to the body's forward axis.
        people.views[15..].copy_from_slice(&[0.0, 0.0, 1.0]);
        for k in 0..n * SEED {
            let eyes = &mut people.joints[k * JOINTS * 3..][joint::L_EYE * 3..];
            eyes[..6].copy_from_slice(&[-0.03 + 0.1 * k as f32, 0.1, 1.6, 0.03 + 0.1 * k as f32, 0.1, 1.6]);
        }
        let s = scene();
        let mut out = vec![0.0; n * SEED * RAYS];
        look_all(&people, |_| &s.walkable, &mut out);
        let turn = Vec2::from_angle(0.3);
        for (k, got) in out.chunks_exact(RAYS).enumerate() {
            let eye = turn.rotate(Vec2::new(0.1 * k as f32, 0.1)) + Vec2::new(0.4, -1.0);
            let view = if k == 5 { Vec2::Y } else { Vec2::new(0.1, 0.8) };
            let want = looked(&s, eye, turn.rotate(view));
            assert!(got.iter().zip(&want).all(|(a, b)| (a - b).abs() < 1e-5), "look {k}");
        }
    }
}
