//! A motion model of a stiff figure that glides, for tests: latent 0 is its speed in m/s, latent 1 its turn in rad/s.

use egogen::body::{BETAS, BodyModel, Frame, MARKER_DIM, ORIENT, PARAMS, POSE, ShapedBody, TRANSL, rotation};
use egogen::motion::{FPS, FUTURE, MotionModel, Origin, SEED};
use glam::{Mat3, Vec2, Vec3};
use std::f32::consts::FRAC_PI_2;

pub struct Toy {
    body: ShapedBody,
    /// The figure facing +y at the origin, arms down, soles on the floor.
    params: [f32; PARAMS],
    markers: Vec<f32>,
    pub origin: Origin,
}

impl Toy {
    pub fn new() -> Self {
        let body = BodyModel::embedded().shape(&[0.0; BETAS]);
        let mut params = [0.0; PARAMS];
        // SMPL-X's rest frame has y up and z forward: up to z, then forward from -y to +y.
        let up = Mat3::from_rotation_z(2.0 * FRAC_PI_2) * Mat3::from_rotation_x(FRAC_PI_2);
        rotation::to_axis_angle(&up).write_to_slice(&mut params[ORIENT]);
        // Joints 16 and 17, the shoulders: pose entries 15 and 16.
        params[POSE][3 * 15 + 2] = -1.3;
        params[POSE][3 * 16 + 2] = 1.3;
        let mut markers = vec![0.0; MARKER_DIM];
        body.markers(&body.pose(&params), &mut markers);
        let low = markers.iter().skip(2).step_by(3).fold(f32::INFINITY, |a, &b| a.min(b));
        params[TRANSL][2] -= low;
        body.markers(&body.pose(&params), &mut markers);
        Self { body, params, markers, origin: Origin::Floor }
    }

    /// The figure's body at a place.
    pub fn at(&self, frame: &Frame) -> [f32; PARAMS] {
        let mut params = self.params;
        self.body.transform_params(&mut params, frame);
        params
    }

    /// The planar frame in which the figure has these markers.
    fn fit(&self, markers: &[f32]) -> Frame {
        let centre = |m: &[f32]| m.chunks_exact(3).map(Vec3::from_slice).sum::<Vec3>() * 3.0 / m.len() as f32;
        let (a, b) = (centre(&self.markers), centre(markers));
        let planar = |m: &[f32], c: Vec3| (Vec3::from_slice(m) - c).truncate();
        let pairs = self.markers.chunks_exact(3).zip(markers.chunks_exact(3));
        let turn: Vec2 = pairs.map(|(p, q)| (planar(p, a), planar(q, b))).map(|(p, q)| Vec2::new(p.dot(q), p.perp_dot(q))).sum();
        let rot = Mat3::from_rotation_z(turn.to_angle());
        Frame { rot, transl: b - rot * a }
    }
}

impl MotionModel for Toy {
    fn latent_dim(&self) -> usize {
        4
    }

    fn origin(&self) -> Origin {
        self.origin
    }

    fn decode(&self, seed: &[f32], latent: &[f32], out: &mut [f32]) -> egogen::Result<()> {
        let people = seed.chunks_exact(SEED * MARKER_DIM).zip(latent.chunks_exact(4));
        for ((seed, z), out) in people.zip(out.chunks_exact_mut(FUTURE * MARKER_DIM)) {
            let last = &seed[MARKER_DIM..];
            let here = self.fit(last);
            for (t, out) in out.chunks_exact_mut(MARKER_DIM).enumerate() {
                let dt = (t + 1) as f32 / FPS;
                let moved = here.compose(&Frame { rot: Mat3::from_rotation_z(z[1] * dt), transl: Vec3::Y * z[0] * dt });
                for (m, out) in self.markers.chunks_exact(3).zip(out.chunks_exact_mut(3)) {
                    moved.point(Vec3::from_slice(m)).write_to_slice(out);
                }
            }
        }
        Ok(())
    }

    fn regress(&self, markers: &[f32], _betas: &[f32], out: &mut [f32]) -> egogen::Result<()> {
        for (m, out) in markers.chunks_exact(MARKER_DIM).zip(out.chunks_exact_mut(PARAMS)) {
            out.copy_from_slice(&self.at(&self.fit(m)));
        }
        Ok(())
    }

    fn hash(&self) -> &str {
        "toy"
    }
}
