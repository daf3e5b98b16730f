//! People among furniture: which room an episode plays in, and how much of a body lies inside what stands there.

use super::MotionTask;
use egogen::body::{BETAS, BodyModel, Inside, PARAMS, Points, ShapedSurface, Surface};
use egogen::motion::{FRAMES, SEED};
use egogen::rng::Stream;
use egogen::scene::{CrowdedScene, Setting, Split};
use egogen::sim::{People, Primitives, Sim};
use egogen::{Error, Result};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Vertices inside that eq. 8's count form divides by.
const COUNTS: f32 = 10.0;

/// How penetration is judged in rooms. Defaults are those of pretraining.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Penetration {
    /// What eq. 8 adds up.
    pub form: Form,
    /// That many vertices inside in one frame end the episode (eq. 11: 40); absent: never.
    pub most: Option<f32>,
    /// Points on the body that are looked at; 0: all its vertices.
    pub points: usize,
}

/// Forms of eq. 8.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// exp(-mean over the frames of the sum of the depths), metres.
    #[default]
    Depth,
    /// exp(-mean over the frames of the number of vertices inside / 10), as in the authors' code.
    Count,
}

impl Default for Penetration {
    fn default() -> Self {
        Self { form: Form::Depth, most: None, points: 2000 }
    }
}

/// How much of a body lay inside over the frames of a primitive, in vertices of SMPL-X.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Presence {
    /// Mean number.
    pub count: f32,
    /// Mean sum of depths, metres.
    pub depth: f32,
    /// Greatest number in one frame.
    pub most: f32,
}

impl Presence {
    /// Eq. 8.
    pub fn reward(&self, form: Form) -> f32 {
        match form {
            Form::Depth => (-self.depth).exp(),
            Form::Count => (-self.count / COUNTS).exp(),
        }
    }
}

/// The rooms of a task and the body's surface.
pub(super) struct Crowd {
    scenes: Arc<Vec<CrowdedScene>>,
    surface: Arc<Surface>,
    /// The surface on the mean shape, which most people have.
    mean: ShapedSurface,
    body: Arc<BodyModel>,
}

impl Crowd {
    /// None where the task has no rooms.
    pub fn new(task: &MotionTask, sim: &Sim, split: Split) -> Result<Option<Self>> {
        let Some(rooms) = &task.rooms else { return Ok(None) };
        let scenes = rooms.make(split)?;
        let points = if task.penetration.points == 0 { Points::All } else { Points::Spread(task.penetration.points) };
        let surface = Arc::new(Surface::new(sim.body(), points));
        let mean = surface.shape(&[0.0; BETAS]);
        Ok(Some(Self { scenes, surface, mean, body: sim.body().clone() }))
    }

    /// A room, and a start and a goal in it.
    pub fn draw(&self, rng: &mut Stream) -> (Option<u32>, Setting) {
        let room = rng.random_range(0..self.scenes.len());
        (Some(room as u32), self.scenes[room].draw(rng))
    }

    /// A room.
    pub fn scene(&self, room: u32) -> Result<&CrowdedScene> {
        self.scenes.get(room as usize).ok_or_else(|| Error::invalid(format!("room {room} of {}", self.scenes.len())))
    }

    /// Person `i`'s primitive in a room.
    pub fn presence(&self, room: u32, people: &People, prims: &Primitives, i: usize) -> Presence {
        let params = &prims.params[i * FRAMES * PARAMS..][..FRAMES * PARAMS];
        self.measure(room, &people.betas[i * BETAS..][..BETAS], params, &prims.frames[i])
    }

    /// Whether person `i` stands clear of everything in both seed frames.
    pub fn stands_free(&self, room: u32, people: &People, i: usize) -> bool {
        let params = &people.params[i * SEED * PARAMS..][..SEED * PARAMS];
        self.measure(room, &people.betas[i * BETAS..][..BETAS], params, &people.frames[i]).most == 0.0
    }

    fn measure(&self, room: u32, betas: &[f32], params: &[f32], to_world: &egogen::body::Frame) -> Presence {
        let Some(scene) = self.scenes.get(room as usize) else { return Presence::default() };
        let own = betas.iter().any(|b| *b != 0.0).then(|| self.surface.shape(betas));
        let (surface, body) = (own.as_ref().unwrap_or(&self.mean), self.body.shape(betas));
        let (mut sum, mut frames) = (Presence::default(), 0.0);
        for frame in params.chunks_exact(PARAMS) {
            let Inside { count, depth } = surface.inside(&body, &body.pose(frame), to_world, scene.sdf.voxel, |p| scene.sdf.at(p));
            sum = Presence { count: sum.count + count, depth: sum.depth + depth, most: sum.most.max(count) };
            frames += 1.0;
        }
        Presence { count: sum.count / frames, depth: sum.depth / frames, most: sum.most }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equation_8_by_hand() {
        let p = Presence { count: 20.0, depth: 0.3, most: 50.0 };
        assert!((p.reward(Form::Depth) - (-0.3f32).exp()).abs() < 1e-7);
        assert!((p.reward(Form::Count) - (-2.0f32).exp()).abs() < 1e-7);
        assert_eq!(Presence::default().reward(Form::Depth), 1.0);
    }
}
