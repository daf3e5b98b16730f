//! People among furniture: which room an episode plays in, and how much of a body lies inside what stands there.

use super::MotionTask;
use egogen::body::{BETAS, BodyModel, Frame, Inside, JOINTS, Moving, Obstacles, PARAMS, Points, ShapedBody, ShapedSurface, Surface};
use egogen::kernels::{Group, Lanes, Probe};
use egogen::motion::{FRAMES, SEED};
use egogen::rng::Stream;
use egogen::scene::{CrowdedScene, SdfGrid, Setting, Split};
use egogen::sim::{People, Primitives, Sim};
use egogen::{Error, Result};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Vertices inside that eq. 8's count form divides by.
const COUNTS: f32 = 10.0;
/// How much a distance between voxels may be too great, near corners, voxels.
const SLACK: f32 = 0.5;

/// How penetration is judged in rooms. Defaults are those of pretraining. Where neither `weights.penetration` nor `most` asks for it,
/// nobody is measured, which saves time.
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
    /// Of what lies inside in each frame.
    pub fn over(frames: &[Inside]) -> Self {
        let n = frames.len().max(1) as f32;
        let mean = |of: fn(&Inside) -> f32| frames.iter().map(of).sum::<f32>() / n;
        Self { count: mean(|f| f.count), depth: mean(|f| f.depth), most: frames.iter().map(|f| f.count).fold(0.0, f32::max) }
    }

    /// Eq. 8.
    pub fn reward(&self, form: Form) -> f32 {
        match form {
            Form::Depth => (-self.depth).exp(),
            Form::Count => (-self.count / COUNTS).exp(),
        }
    }
}

/// A body of one shape with its surface.
struct Shaped {
    body: ShapedBody,
    surface: ShapedSurface,
}

/// The rooms of a task and the people in them.
pub(super) struct Crowd {
    scenes: Arc<Vec<CrowdedScene>>,
    model: Arc<BodyModel>,
    surface: Arc<Surface>,
    /// Of each environment's person.
    shapes: Vec<Arc<Shaped>>,
    /// Whether penetration counts; if not, nobody is measured.
    counts: bool,
}

impl Crowd {
    /// None where the task has no rooms; `n` people.
    pub fn new(task: &MotionTask, sim: &Sim, n: usize, split: Split) -> Result<Option<Self>> {
        let Some(rooms) = &task.rooms else { return Ok(None) };
        let scenes = rooms.make(split)?;
        let points = if task.penetration.points == 0 { Points::All } else { Points::Spread(task.penetration.points) };
        let (model, surface) = (sim.body().clone(), Arc::new(Surface::new(sim.body(), points)));
        let mean = Arc::new(Shaped::new(&model, &surface, &[0.0; BETAS]));
        let counts = task.weights.penetration != 0.0 || task.penetration.most.is_some();
        Ok(Some(Self { scenes, model, surface, shapes: vec![mean; n], counts }))
    }

    /// Takes notice of person `i`'s shape; to be told before anything is asked of a new person.
    pub fn dress(&mut self, i: usize, people: &People) {
        let betas = &people.betas[i * BETAS..][..BETAS];
        if self.shapes[i].body.betas() != betas {
            self.shapes[i] = Arc::new(Shaped::new(&self.model, &self.surface, betas));
        }
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
    pub fn presence(&self, room: u32, prims: &Primitives, i: usize) -> Presence {
        if !self.counts {
            return Presence::default();
        }
        self.measure(room, (&prims.params, &prims.joints, &prims.frames), FRAMES, i)
    }

    /// Whether person `i` stands clear of everything in both seed frames.
    pub fn stands_free(&self, room: u32, people: &People, i: usize) -> bool {
        self.measure(room, (&people.params, &people.joints, &people.frames), SEED, i).most == 0.0
    }

    /// Of n people's parameters, joints and frames those of person `i`, who has that many frames.
    fn measure<'a>(&self, room: u32, (params, joints, to_world): (&'a [f32], &'a [f32], &[Frame]), frames: usize, i: usize) -> Presence {
        let (Some(scene), Shaped { body, surface }) = (self.scenes.get(room as usize), &*self.shapes[i]) else {
            return Presence::default();
        };
        let own = |all: &'a [f32], width: usize| &all[i * frames * width..(i + 1) * frames * width];
        let motion = Moving { body, params: own(params, PARAMS), joints: own(joints, 3 * JOINTS), to_world: &to_world[i] };
        let obstacles = Room::new(&scene.sdf);
        Presence::over(&surface.over(&motion, &obstacles))
    }
}

/// What stands in a room.
struct Room<'a> {
    probe: Probe<'a>,
    /// Metres.
    slack: f32,
}

impl<'a> Room<'a> {
    fn new(sdf: &'a SdfGrid) -> Self {
        Self { probe: sdf.probe(), slack: SLACK * sdf.voxel }
    }
}

impl Obstacles for Room<'_> {
    fn distances(&self, at: &Group, out: &mut Lanes) {
        self.probe.distances(at, out);
    }

    fn slack(&self) -> f32 {
        self.slack
    }
}

impl Shaped {
    fn new(model: &BodyModel, surface: &Arc<Surface>, betas: &[f32]) -> Self {
        let body = model.shape(betas);
        let surface = surface.shape(&body);
        Self { body, surface }
    }
}

#[cfg(test)]
mod tests;
