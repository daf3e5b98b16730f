//! One person on its task: what it sees, what a step earned it, how its episode went.

use super::rewards::{Outcome, OwnTerm, TERMS};
use super::{EPISODE, MotionTask, Presence};
use egogen::body::{JOINTS, MARKER_DIM, canonical_frame, joint};
use egogen::motion::{FRAMES, Origin, SEED};
use egogen::scene::{Polygon, Setting};
use egogen::sensing::{RAYS, look_person};
use egogen::sim::{People, Primitives};
use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// Steps that end within this of the goal without arriving count as hovering, metres.
const NEAR: f32 = 0.3;
/// Floats of the group "state".
pub(super) const STATE: usize = SEED * 2 * MARKER_DIM;
/// Floats of an observation row: "state", "egosensing", "dist", "time".
pub(super) const OBS: usize = STATE + SEED * RAYS + 2;

/// An episode under way.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Member {
    /// Episodes this environment played before.
    pub episode: u64,
    pub setting: Setting,
    /// Number of the room it plays in.
    pub room: Option<u32>,
    /// The goal at the height of the pelvis at the start, world.
    pub goal: Vec3,
    pub steps: u32,
    /// Distance from pelvis to goal, metres.
    pub dist: f32,
    total: f32,
    min_dist: f32,
    path: f32,
    near_steps: u32,
    hit: bool,
    inside: f32,
}

/// A step that a person made.
pub(super) struct Step<'a> {
    pub people: &'a People,
    pub prims: &'a Primitives,
    pub person: usize,
    /// Its poses were natural.
    pub natural: bool,
    /// Non-walkable cells under its box (eq. 7); not looked at in rooms.
    pub blocked: usize,
    /// How much of it lay inside what stands in its room.
    pub presence: Option<Presence>,
}

/// What a step brought.
pub(super) struct Verdict {
    pub reward: f32,
    pub ended: bool,
}

impl Member {
    /// Begins an episode of person `i`, already placed.
    pub fn begin(episode: u64, (room, setting): (Option<u32>, Setting), people: &People, i: usize) -> Self {
        let frame = &people.frames[i];
        let pelvis = frame.point(seed_joint(people, i, 0, joint::PELVIS));
        let goal = setting.goal.extend(pelvis.z);
        let dist = pelvis.distance(goal);
        let min_dist = pelvis.truncate().distance(setting.goal);
        Self { episode, setting, room, goal, dist, min_dist, ..Self::default() }
    }

    /// Writes the observation row of person `i`, who may walk on `ground`; markers count from `origin`.
    pub fn observe(&self, task: &MotionTask, (people, i): (&People, usize), ground: &Polygon, origin: Origin, row: &mut [f32]) {
        let (state, rest) = row.split_at_mut(STATE);
        let (rays, scalars) = rest.split_at_mut(SEED * RAYS);
        let goal = people.frames[i].inverse().point(self.goal);
        let markers = &people.markers[i * SEED * MARKER_DIM..][..SEED * MARKER_DIM];
        for (frame, out) in markers.chunks_exact(MARKER_DIM).zip(state.chunks_exact_mut(2 * MARKER_DIM)) {
            out[..MARKER_DIM].copy_from_slice(frame);
            if origin == Origin::Pelvis {
                let height = people.pelvis_height(i);
                out[..MARKER_DIM].iter_mut().skip(2).step_by(3).for_each(|z| *z -= height);
            }
            for (m, to) in frame.chunks_exact(3).zip(out[MARKER_DIM..].chunks_exact_mut(3)) {
                (goal - Vec3::from_slice(m)).normalize_or_zero().write_to_slice(to);
            }
        }
        look_person(people, i, ground, rays);
        scalars[0] = 1.0 / (1.0 + self.dist);
        scalars[1] = 1.0 - self.steps as f32 / task.max_depth as f32;
    }

    /// Judges the step just made; writes the weighted reward terms and, at an end, the episode's figures.
    pub fn judge(
        &mut self,
        (task, own): (&MotionTask, &[OwnTerm]),
        &Step { people, prims, person: i, natural, blocked, presence }: &Step,
        terms: &mut [f32],
        episode: &mut [f32],
    ) -> Verdict {
        let frame = &people.frames[i];
        let at = |j: usize| seed_joint(people, i, SEED - 1, j);
        let (pelvis, goal) = (at(joint::PELVIS), frame.inverse().point(self.goal));
        let dist = pelvis.distance(goal);
        self.steps += 1;
        let outcome = Outcome {
            markers: &prims.markers[i * FRAMES * MARKER_DIM..][..FRAMES * MARKER_DIM],
            pelvis,
            head: at(joint::HEAD),
            view: Vec3::from_slice(&people.views[(i * SEED + SEED - 1) * 3..]),
            forward: canonical_frame(pelvis, at(joint::L_HIP), at(joint::R_HIP)).rot.y_axis,
            goal,
            dist_before: self.dist,
            dist,
            natural,
            arrived: dist < task.success_distance,
            penetrates: match presence {
                Some(p) => task.penetration.most.is_some_and(|most| p.most >= most),
                None => blocked >= task.blocked_cells,
            },
            crowded: presence.map(|p| p.reward(task.penetration.form)),
            left: task.max_depth - self.steps,
        };
        for (out, term) in terms.iter_mut().zip(&TERMS) {
            *out = (term.weight)(&task.weights) * (term.value)(&outcome);
        }
        for (out, term) in terms[TERMS.len()..].iter_mut().zip(own) {
            *out = term.weight * (term.value)(&outcome);
        }
        let reward = terms.iter().sum();
        self.dist = dist;
        self.total += reward;
        self.inside += presence.map_or(0.0, |p| p.count);
        self.near_steps += u32::from(dist < NEAR && !outcome.arrived);
        self.hit |= outcome.penetrates;
        self.follow(prims, i);
        let ended = outcome.arrived || (outcome.penetrates && task.end_on_penetration) || outcome.left == 0;
        if ended {
            episode.copy_from_slice(&self.figures(outcome.arrived && !(outcome.penetrates && task.end_on_penetration)));
        }
        Verdict { reward, ended }
    }

    /// Adds the step's frames to the walked path and the smallest distance, both in the plane.
    fn follow(&mut self, prims: &Primitives, i: usize) {
        let pelvis = |t: usize| {
            let at = ((i * FRAMES + t) * JOINTS + joint::PELVIS) * 3;
            prims.frames[i].point(Vec3::from_slice(&prims.joints[at..])).truncate()
        };
        let goal = self.goal.truncate();
        let mut last: Vec2 = pelvis(SEED - 1);
        for t in SEED..FRAMES {
            let p = pelvis(t);
            self.path += p.distance(last);
            self.min_dist = self.min_dist.min(p.distance(goal));
            last = p;
        }
    }

    fn figures(&self, success: bool) -> [f32; EPISODE.len()] {
        [
            f32::from(success),
            f32::from(self.hit),
            self.steps as f32,
            self.total,
            self.dist,
            self.min_dist,
            f32::from(self.near_steps > 2),
            self.path,
            self.inside / self.steps as f32,
        ]
    }
}

/// Non-walkable cells under the axis-aligned box of the markers over both seed frames, in the canonical frame (eq. 7).
pub fn blocked(task: &MotionTask, people: &People, i: usize, walkable: &Polygon) -> usize {
    let markers = &people.markers[i * SEED * MARKER_DIM..][..SEED * MARKER_DIM];
    let start = (Vec2::INFINITY, Vec2::NEG_INFINITY);
    let (lo, hi) = markers.chunks_exact(3).fold(start, |(lo, hi), m| {
        let p = Vec2::new(m[0], m[1]);
        (lo.min(p), hi.max(p))
    });
    walkable.blocked_cells(&people.frames[i], lo, hi, task.cell)
}

/// Joint `j` of person `i` in seed frame `t`, local.
fn seed_joint(people: &People, i: usize, t: usize, j: usize) -> Vec3 {
    Vec3::from_slice(&people.joints[((i * SEED + t) * JOINTS + j) * 3..])
}
