//! The state of people between two primitives, and the frames of one primitive.

use super::SeedMotion;
use crate::body::{BETAS, BodyModel, Frame, JOINTS, MARKER_DIM, PARAMS, Posed, ShapedBody, canonical_frame, joint};
use crate::motion::{FRAMES, SEED};
use crate::{Error, Result};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// State of n people between two primitives. Flat arrays, person outermost; local = the person's canonical frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct People {
    /// n; canonical-to-world frame of each person's seed.
    pub frames: Vec<Frame>,
    /// n x 10 shape coefficients.
    pub betas: Vec<f32>,
    /// n x 2 x 201 seed markers, local, metres.
    pub markers: Vec<f32>,
    /// n x 2 x 93 seed bodies, local.
    pub params: Vec<f32>,
    /// n x 2 x 24 x 3 seed joints (eyes last), local, metres.
    pub joints: Vec<f32>,
    /// n x 2 x 3 unit viewing directions of the head, local.
    pub views: Vec<f32>,
}

/// The 20 frames of one primitive of n people, in the canonical frames they started from.
#[derive(Clone, Debug, Default)]
pub struct Primitives {
    /// n; canonical-to-world frame of each primitive.
    pub frames: Vec<Frame>,
    /// n x 20 x 201 markers fed back to the model (seed markers first, then blended ones), local.
    pub markers: Vec<f32>,
    /// n x 20 x 93 bodies, local.
    pub params: Vec<f32>,
    /// n x 20 x 24 x 3 joints of the bodies, local.
    pub joints: Vec<f32>,
    /// n x 20 x 3 unit viewing directions of the head, local.
    pub views: Vec<f32>,
}

/// Floats of one frame of joints.
pub(super) const JOINT_DIM: usize = 3 * JOINTS;

impl People {
    /// Room for `n` people, each of whom [`People::place`] has to set before the first step.
    pub fn new(n: usize) -> Self {
        Self {
            frames: vec![Frame::IDENTITY; n],
            betas: vec![0.0; n * BETAS],
            markers: vec![0.0; n * SEED * MARKER_DIM],
            params: vec![0.0; n * SEED * PARAMS],
            joints: vec![0.0; n * SEED * JOINT_DIM],
            views: vec![0.0; n * SEED * 3],
        }
    }

    /// Number of people.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// The people with these numbers, in this order; a number may come more than once.
    ///
    /// # Panics
    /// When a number is not below [`People::len`].
    pub fn select(&self, rows: &[usize]) -> Self {
        let pick = |from: &[f32]| {
            let width = from.len() / self.len().max(1);
            rows.iter().flat_map(|&i| &from[i * width..(i + 1) * width]).copied().collect()
        };
        Self {
            frames: rows.iter().map(|&i| self.frames[i]).collect(),
            betas: pick(&self.betas),
            markers: pick(&self.markers),
            params: pick(&self.params),
            joints: pick(&self.joints),
            views: pick(&self.views),
        }
    }

    /// Sets the people with the numbers `rows` to those of `from`, in this order.
    ///
    /// # Panics
    /// When a number is not below [`People::len`] or `from` has not as many people as there are numbers.
    pub fn put(&mut self, rows: &[usize], from: &Self) {
        assert_eq!(rows.len(), from.len(), "one number for each person");
        let n = self.len().max(1);
        let set = |to: &mut [f32], from: &[f32]| {
            let width = to.len() / n;
            rows.iter().enumerate().for_each(|(k, i)| to[i * width..][..width].copy_from_slice(&from[k * width..][..width]));
        };
        rows.iter().zip(&from.frames).for_each(|(&i, frame)| self.frames[i] = *frame);
        set(&mut self.betas, &from.betas);
        set(&mut self.markers, &from.markers);
        set(&mut self.params, &from.params);
        set(&mut self.joints, &from.joints);
        set(&mut self.views, &from.views);
    }

    /// Height of person `i`'s pelvis in the seed's first frame above the floor, metres.
    ///
    /// # Panics
    /// When `i` is not below [`People::len`].
    pub fn pelvis_height(&self, i: usize) -> f32 {
        self.joints[i * SEED * JOINT_DIM + 3 * joint::PELVIS + 2]
    }

    /// Whether there is nobody.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Sets person `i`: the pelvis of the seed's first frame above (x, y), metres, its forward direction (canonical y) turned by
    /// `yaw` about z from the world's y axis. The seed is made canonical by this body's own joints first.
    pub fn place(&mut self, i: usize, body: &BodyModel, seed: &SeedMotion, yaw: f32, x: f32, y: f32) -> Result<()> {
        if i >= self.len() {
            return Err(Error::invalid(format!("person {i} of {} cannot be placed", self.len())));
        }
        seed.check()?;
        let shaped = body.shape(&seed.betas);
        let mut markers = [0.0; SEED * MARKER_DIM];
        let posed: [Posed; SEED] = std::array::from_fn(|t| shaped.pose(&seed.params[t * PARAMS..][..PARAMS]));
        for (p, m) in posed.iter().zip(markers.chunks_exact_mut(MARKER_DIM)) {
            shaped.markers(p, m);
        }
        self.betas[i * BETAS..][..BETAS].copy_from_slice(&seed.betas);
        let mut person = self.person_mut(i);
        person.reseed(&shaped, &seed.params, &markers);
        *person.frame = Frame::planar(yaw, x, y);
        Ok(())
    }

    fn person_mut(&mut self, i: usize) -> PersonMut<'_> {
        PersonMut {
            frame: &mut self.frames[i],
            markers: &mut self.markers[i * SEED * MARKER_DIM..][..SEED * MARKER_DIM],
            params: &mut self.params[i * SEED * PARAMS..][..SEED * PARAMS],
            joints: &mut self.joints[i * SEED * JOINT_DIM..][..SEED * JOINT_DIM],
            views: &mut self.views[i * SEED * 3..][..SEED * 3],
        }
    }

    /// Whether the arrays fit the number of people.
    pub(super) fn check(&self) -> Result<()> {
        let n = self.len();
        let sizes = [
            ("betas", self.betas.len(), BETAS),
            ("markers", self.markers.len(), SEED * MARKER_DIM),
            ("params", self.params.len(), SEED * PARAMS),
            ("joints", self.joints.len(), SEED * JOINT_DIM),
            ("views", self.views.len(), SEED * 3),
        ];
        match sizes.into_iter().find(|(_, len, each)| *len != n * each) {
            Some((name, len, each)) => Err(Error::invalid(format!("{name} of {n} people hold {len} floats, expected {}", n * each))),
            None => Ok(()),
        }
    }
}

/// The state of one person.
pub(super) struct PersonMut<'a> {
    pub frame: &'a mut Frame,
    pub markers: &'a mut [f32],
    pub params: &'a mut [f32],
    pub joints: &'a mut [f32],
    pub views: &'a mut [f32],
}

impl PersonMut<'_> {
    /// Makes two frames the seed: re-expresses them in the canonical frame of the first, given by the body's joints, and
    /// composes the world frame. `params`: 2 x 93 and `markers`: 2 x 201, in the frame the person has now.
    pub fn reseed(&mut self, body: &ShapedBody, params: &[f32], markers: &[f32]) {
        let first = body.pose(&params[..PARAMS]).pos;
        let local = canonical_frame(first[joint::PELVIS], first[joint::L_HIP], first[joint::R_HIP]);
        let inverse = local.inverse();
        self.params.copy_from_slice(params);
        for t in 0..SEED {
            let params = &mut self.params[t * PARAMS..][..PARAMS];
            body.transform_params(params, &inverse);
            let posed = body.pose(params);
            posed.write_joints(&mut self.joints[t * JOINT_DIM..][..JOINT_DIM]);
            self.views[3 * t..][..3].copy_from_slice(&posed.view().to_array());
        }
        for (out, m) in self.markers.as_chunks_mut::<3>().0.iter_mut().zip(markers.as_chunks::<3>().0) {
            *out = inverse.point(Vec3::from(*m)).to_array();
        }
        *self.frame = self.frame.compose(&local);
    }
}

impl Primitives {
    /// Adds person `i`'s bodies, which have the shape of `body`, to its recording `film` (T x 93, world): all 20 frames to an empty
    /// one, else the 18 new ones, whose seed the recording ends with.
    pub fn record(&self, i: usize, body: &ShapedBody, film: &mut Vec<f32>) {
        let first = if film.is_empty() { 0 } else { SEED };
        for frame in self.params[(i * FRAMES + first) * PARAMS..(i + 1) * FRAMES * PARAMS].chunks_exact(PARAMS) {
            let at = film.len();
            film.extend_from_slice(frame);
            body.transform_params(&mut film[at..], &self.frames[i]);
        }
    }

    /// Makes room for `n` people; the content is then overwritten by a step.
    pub(super) fn resize(&mut self, n: usize) {
        self.frames.resize(n, Frame::IDENTITY);
        self.markers.resize(n * FRAMES * MARKER_DIM, 0.0);
        self.params.resize(n * FRAMES * PARAMS, 0.0);
        self.joints.resize(n * FRAMES * JOINT_DIM, 0.0);
        self.views.resize(n * FRAMES * 3, 0.0);
    }
}

/// The yaw for [`People::place`] that faces along (dx, dy): forward is y, so it is the direction's angle from the y axis.
pub fn yaw_towards(dx: f32, dy: f32) -> f32 {
    (-dx).atan2(dy)
}
