//! One step of the simulated people: a primitive of 20 frames from two seed frames and a latent.

use super::people::{JOINT_DIM, PersonMut};
use super::plant::plant;
use super::{People, Primitives};
use crate::body::{BETAS, BodyModel, MARKER_DIM, ORIENT, PARAMS, POSE, ShapedBody, TRANSL};
use crate::kernels::first_not_finite;
use crate::motion::clip::Skeleton;
use crate::motion::{FRAMES, FUTURE, MotionModel, Origin, SEED};
use crate::{Error, Result};
use glam::{Quat, Vec2, Vec3};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::{Arc, Mutex};

/// Fewest people that one task works on.
const CHUNK: usize = 4;

/// The world's people: a body and the motion model that moves it.
pub struct Sim {
    body: Arc<BodyModel>,
    model: Arc<dyn MotionModel>,
    /// The mean body's soles, for models that want feet planted.
    soles: Option<Skeleton>,
    /// Buffers between steps; a step takes one and puts it back, so steps may run side by side.
    spare: Mutex<Vec<Buffers>>,
}

/// What the motion model reads and writes in one step.
#[derive(Default)]
struct Buffers {
    /// n x 18 x 201.
    predicted: Vec<f32>,
    /// Markers (n x k x 201), betas (n x k x 10) and bodies (n x k x 93) of the k frames that get bodies from the regressor.
    fitted: Vec<f32>,
    betas: Vec<f32>,
    regressed: Vec<f32>,
}

impl Sim {
    /// People with `body`, moved by `model`.
    pub fn new(body: Arc<BodyModel>, model: Arc<dyn MotionModel>) -> Self {
        let soles = model.planted().then(|| Skeleton::new(&body));
        Self { body, model, soles, spare: Mutex::default() }
    }

    /// The body everybody has, up to shape.
    pub fn body(&self) -> &Arc<BodyModel> {
        &self.body
    }

    /// The motion model.
    pub fn model(&self) -> &Arc<dyn MotionModel> {
        &self.model
    }

    /// Whole latents from their `k` most active dimensions, the others 0. `latents`: n x k; returns n x latent_dim.
    ///
    /// # Errors
    /// If the model has not that many.
    pub fn widen(&self, latents: &[f32], k: usize) -> Result<Vec<f32>> {
        let active = self.model.active();
        let dim = active.len();
        if k == 0 || k > dim {
            return Err(Error::invalid(format!("actions of {k} latents, the motion model has {dim}")));
        }
        let mut wide = vec![0.0; latents.len() / k * dim];
        for (from, to) in latents.chunks_exact(k).zip(wide.chunks_exact_mut(dim)) {
            from.iter().zip(&active).for_each(|(v, &at)| to[at] = *v);
        }
        Ok(wide)
    }

    /// Moves everybody by one primitive of 20 frames, 18 of them new. `latents`: n x latent_dim.
    ///
    /// 1. Decode 18 frames of markers, regress their bodies (in canonical frames of the model's own origin), prepend the 2 seed bodies.
    /// 2. Smooth the seam: of frames 2 and 3 (from 0), parameters from index 6 on become the mean of their two neighbours,
    ///    both from the values before smoothing.
    /// 3. If the model asks for it ([`MotionModel::planted`]), let standing feet stand: move the bodies in the plane against the slip
    ///    of the foot that bears them, and the legs so that standing feet keep place and heading.
    /// 4. New markers = 0.5 x skinned + 0.5 x predicted (moved as the body was).
    /// 5. The last two frames, in the canonical frame of the first of them, become the next seed in `people`.
    ///
    /// Sizes that do not fit and results that are not finite are refused (naming the person), with `people` as they were.
    pub fn step(&self, people: &mut People, latents: &[f32], out: &mut Primitives) -> Result<()> {
        self.step_by(1, people, latents, out)
    }

    /// [`Sim::step`] at less cost: of the 18 new frames only every `every`-th one and the last two get bodies, from the regressor, planted and skinned.
    /// A frame between lies between the nearest two of them, or of the seed's last and the first of them: joints and parameters linearly, but for
    /// rotations, which are quaternions taken linearly the shortest way round; views linearly, then made unit; markers as predicted, plus
    /// what the two frames' markers differ from their predictions (the seed's by nothing), linearly. That smooths the seam as well: parameters
    /// there are averaged only if `every` is 1.
    ///
    /// # Errors
    /// As `step`, and if `every` is 0.
    pub fn step_by(&self, every: usize, people: &mut People, latents: &[f32], out: &mut Primitives) -> Result<()> {
        people.check()?;
        if every == 0 {
            return Err(Error::invalid("bodies for every 0th frame, expected 1 or more"));
        }
        let fitted = Self::fitted(every);
        let (n, dim) = (people.len(), self.model.latent_dim());
        if latents.len() != n * dim {
            return Err(Error::invalid(format!("{} latent floats for {n} people, expected {n} x {dim}", latents.len())));
        }
        all_finite("latents", latents, dim)?;
        let bodies: Vec<_> = people.betas.par_chunks_exact(BETAS).with_min_len(CHUNK).map(|betas| self.body.shape(betas)).collect();
        let mut buffers = self.spare.lock().map(|mut s| s.pop().unwrap_or_default()).unwrap_or_default();
        let done = self.predict(&fitted, people, latents, &mut buffers).and_then(|()| {
            self.fill(&fitted, people, &bodies, &buffers, out);
            all_finite("markers", &out.markers, FRAMES * MARKER_DIM)?;
            all_finite("bodies", &out.params, FRAMES * PARAMS)?;
            all_finite("joints", &out.joints, FRAMES * JOINT_DIM)
        });
        if let Ok(mut spare) = self.spare.lock() {
            spare.push(buffers);
        }
        done?;
        advance(people, &bodies, out);
        Ok(())
    }

    /// The new frames, counted from 0, that get bodies from the regressor in [`Sim::step_by`]; `every` is at least 1.
    pub fn fitted(every: usize) -> Vec<usize> {
        (0..FUTURE).filter(|t| (t + 1).is_multiple_of(every) || t + SEED >= FUTURE).collect()
    }

    fn predict(&self, fitted: &[usize], people: &People, latents: &[f32], b: &mut Buffers) -> Result<()> {
        b.predicted.resize(people.len() * FUTURE * MARKER_DIM, 0.0);
        let finite = |predicted: &[f32]| all_finite("predicted markers", predicted, FUTURE * MARKER_DIM);
        if self.model.origin() == Origin::Floor {
            self.model.decode(&people.markers, latents, &mut b.predicted)?;
            finite(&b.predicted)?;
            return self.regress(fitted, people, b);
        }
        // The model's frames have their origin at the pelvis of the seed's first frame instead of on the floor below it.
        let mut seed = people.markers.clone();
        shift(people, -1.0, &mut seed, SEED * MARKER_DIM, 3, 2);
        self.model.decode(&seed, latents, &mut b.predicted)?;
        finite(&b.predicted)?;
        self.regress(fitted, people, b)?;
        shift(people, 1.0, &mut b.predicted, FUTURE * MARKER_DIM, 3, 2);
        shift(people, 1.0, &mut b.regressed, fitted.len() * PARAMS, PARAMS, TRANSL.start + 2);
        Ok(())
    }

    /// Bodies of the predicted frames `fitted`.
    fn regress(&self, fitted: &[usize], people: &People, b: &mut Buffers) -> Result<()> {
        b.regressed.resize(people.len() * fitted.len() * PARAMS, 0.0);
        b.betas.clear();
        b.betas.extend(people.betas.chunks_exact(BETAS).flat_map(|betas| std::iter::repeat_n(betas, fitted.len())).flatten());
        if fitted.len() == FUTURE {
            return self.model.regress(&b.predicted, &b.betas, &mut b.regressed);
        }
        b.fitted.clear();
        for person in b.predicted.chunks_exact(FUTURE * MARKER_DIM) {
            fitted.iter().for_each(|t| b.fitted.extend(&person[t * MARKER_DIM..][..MARKER_DIM]));
        }
        self.model.regress(&b.fitted, &b.betas, &mut b.regressed)
    }

    fn fill(&self, fitted: &[usize], people: &People, bodies: &[ShapedBody], b: &Buffers, out: &mut Primitives) {
        out.resize(people.len());
        out.frames.copy_from_slice(&people.frames);
        let parts = (
            out.markers.par_chunks_exact_mut(FRAMES * MARKER_DIM),
            out.params.par_chunks_exact_mut(FRAMES * PARAMS),
            out.joints.par_chunks_exact_mut(FRAMES * JOINT_DIM),
            out.views.par_chunks_exact_mut(FRAMES * 3),
        );
        parts.into_par_iter().with_min_len(CHUNK).enumerate().for_each(|(i, (markers, params, joints, views))| {
            let mut film = Film { markers, params, joints, views };
            film.begin(people, i);
            let regressed = b.regressed[i * fitted.len() * PARAMS..].chunks_exact(PARAMS);
            fitted.iter().zip(regressed).for_each(|(t, body)| film.params[(SEED + t) * PARAMS..][..PARAMS].copy_from_slice(body));
            if fitted.len() == FUTURE {
                smooth_seam(film.params);
            }
            let predicted = &b.predicted[i * FUTURE * MARKER_DIM..][..FUTURE * MARKER_DIM];
            let moved = self.soles.as_ref().map(|soles| plant(soles, &bodies[i], &mut film.params[(SEED - 1) * PARAMS..], fitted));
            for (k, &t) in fitted.iter().enumerate() {
                film.pose(&bodies[i], SEED + t, &predicted[t * MARKER_DIM..], moved.as_ref().map_or(Vec2::ZERO, |m| m[k]));
            }
            fitted.iter().fold(SEED - 1, |last, t| {
                film.between(last..SEED + t, predicted);
                SEED + t
            });
        });
    }
}

/// The 20 frames of one person.
struct Film<'a> {
    markers: &'a mut [f32],
    params: &'a mut [f32],
    joints: &'a mut [f32],
    views: &'a mut [f32],
}

impl Film<'_> {
    /// The first frames are the seed of person `i`.
    fn begin(&mut self, people: &People, i: usize) {
        let copy = |to: &mut [f32], from: &[f32]| {
            let len = from.len() / people.len();
            to[..len].copy_from_slice(&from[i * len..][..len]);
        };
        copy(self.markers, &people.markers);
        copy(self.params, &people.params);
        copy(self.joints, &people.joints);
        copy(self.views, &people.views);
    }

    /// Joints, view and markers of the body of frame `t`: the markers half as skinned, half as `predicted`, moved in the plane as the body was.
    fn pose(&mut self, body: &ShapedBody, t: usize, predicted: &[f32], moved: Vec2) {
        let posed = body.pose(&self.params[t * PARAMS..][..PARAMS]);
        posed.write_joints(&mut self.joints[t * JOINT_DIM..][..JOINT_DIM]);
        self.views[3 * t..][..3].copy_from_slice(&posed.view().to_array());
        let markers = &mut self.markers[t * MARKER_DIM..][..MARKER_DIM];
        body.markers(&posed, markers);
        let by = moved.extend(0.0).to_array();
        for (k, (m, p)) in markers.iter_mut().zip(predicted).enumerate() {
            *m = 0.5 * (*m + (p + by[k % 3]));
        }
    }

    /// The frames between `ends.start` and `ends.end`, as [`Sim::step_by`] has them.
    fn between(&mut self, ends: Range<usize>, predicted: &[f32]) {
        let steps = ends.len();
        if steps < 2 {
            return;
        }
        bodies_between(&mut self.params[ends.start * PARAMS..(ends.end + 1) * PARAMS]);
        lerp(&mut self.joints[ends.start * JOINT_DIM..(ends.end + 1) * JOINT_DIM], JOINT_DIM);
        lerp(&mut self.views[3 * ends.start..3 * (ends.end + 1)], 3);
        for view in self.views[3 * (ends.start + 1)..3 * ends.end].as_chunks_mut::<3>().0 {
            *view = Vec3::from(*view).normalize_or_zero().to_array();
        }
        let (first, rest) = self.markers[ends.start * MARKER_DIM..(ends.end + 1) * MARKER_DIM].split_at_mut(MARKER_DIM);
        let (middle, last) = rest.split_at_mut((steps - 1) * MARKER_DIM);
        let said = |t: usize| t.checked_sub(SEED).map_or(&*first, |t| &predicted[t * MARKER_DIM..][..MARKER_DIM]);
        let (from, to) = (said(ends.start), said(ends.end));
        for (k, frame) in middle.chunks_exact_mut(MARKER_DIM).enumerate() {
            let share = (k + 1) as f32 / steps as f32;
            let now = said(ends.start + k + 1);
            for (i, m) in frame.iter_mut().enumerate() {
                *m = now[i] + (1.0 - share) * (first[i] - from[i]) + share * (last[i] - to[i]);
            }
        }
    }
}

/// The last two frames become everybody's next seed.
fn advance(people: &mut People, bodies: &[ShapedBody], out: &Primitives) {
    let parts = (
        people.frames.par_iter_mut(),
        people.markers.par_chunks_exact_mut(SEED * MARKER_DIM),
        people.params.par_chunks_exact_mut(SEED * PARAMS),
        people.joints.par_chunks_exact_mut(SEED * JOINT_DIM),
        people.views.par_chunks_exact_mut(SEED * 3),
    );
    parts.into_par_iter().with_min_len(CHUNK).enumerate().for_each(|(i, (frame, markers, params, joints, views))| {
        let last = i * FRAMES + FUTURE;
        let mut person = PersonMut { frame, markers, params, joints, views };
        person.reseed(&bodies[i], &out.params[last * PARAMS..][..SEED * PARAMS], &out.markers[last * MARKER_DIM..][..SEED * MARKER_DIM]);
    });
}

/// Adds `sign` times the height of each person's first seed pelvis to number `at` of every `stride`; `data`: n x `each`.
fn shift(people: &People, sign: f32, data: &mut [f32], each: usize, stride: usize, at: usize) {
    for (i, data) in data.chunks_exact_mut(each).enumerate() {
        let height = sign * people.pelvis_height(i);
        data.iter_mut().skip(at).step_by(stride).for_each(|z| *z += height);
    }
}

/// Bodies of all frames between the first and the last one of `params`: quaternions the shortest way round, all else linearly.
fn bodies_between(params: &mut [f32]) {
    let steps = params.len() / PARAMS - 1;
    lerp(params, PARAMS);
    let (first, rest) = params.split_at_mut(PARAMS);
    let (middle, last) = rest.split_at_mut((steps - 1) * PARAMS);
    for i in (ORIENT.start..POSE.end).step_by(3) {
        let [a, b] = [&*first, &*last].map(|body| Quat::from_scaled_axis(Vec3::from_slice(&body[i..])));
        for (k, frame) in middle.chunks_exact_mut(PARAMS).enumerate() {
            let turn = a.lerp(b, (k + 1) as f32 / steps as f32);
            turn.to_scaled_axis().write_to_slice(&mut frame[i..]);
        }
    }
}

/// Rows of `width` between the first and the last one of `data`, linearly.
fn lerp(data: &mut [f32], width: usize) {
    let steps = data.len() / width - 1;
    let (first, rest) = data.split_at_mut(width);
    let (middle, last) = rest.split_at_mut((steps - 1) * width);
    for (k, row) in middle.chunks_exact_mut(width).enumerate() {
        let share = (k + 1) as f32 / steps as f32;
        row.iter_mut().zip(first.iter().zip(&*last)).for_each(|(x, (a, b))| *x = a + share * (b - a));
    }
}

fn smooth_seam(params: &mut [f32]) {
    for k in POSE.start..PARAMS {
        let at = |t: usize| params[t * PARAMS + k];
        let (second, third) = (0.5 * (at(1) + at(3)), 0.5 * (at(2) + at(4)));
        params[2 * PARAMS + k] = second;
        params[3 * PARAMS + k] = third;
    }
}

fn all_finite(what: &str, data: &[f32], each: usize) -> Result<()> {
    let people = data.par_chunks_exact(each.max(1)).with_min_len(CHUNK).enumerate();
    match people.find_map_first(|(i, person)| first_not_finite(person).map(|k| (i, k))) {
        Some((i, k)) => Err(Error::invalid(format!("{what} of person {i} are not finite: entry {k} is {}", data[i * each + k]))),
        None => Ok(()),
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
