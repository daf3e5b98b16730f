//! Given episodes: people who share scenes and see each other, and boxes that move among them.

use egogen::body::{BodyModel, MARKER_DIM};
use egogen::motion::{FPS, FUTURE, SEED};
use egogen::scene::{BoxObstacle, Polygon, Scene, Setting};
use egogen::sim::{People, SeedMotion, yaw_towards};
use egogen::{Error, Result};
use glam::{DVec2, Vec2, Vec3};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// A box whose middle goes back and forth between two points.
#[derive(Clone, Debug, PartialEq)]
pub struct Mover {
    /// The box, at one end of its way.
    pub shape: BoxObstacle,
    /// Its middle at the other end.
    pub to: Vec2,
    /// Metres per second.
    pub speed: f32,
    /// Share of the way there and back that lies behind it at the start, 0 to 1.
    pub phase: f32,
}

impl Mover {
    /// The box `seconds` after the first frame of the episode.
    pub fn at(&self, seconds: f32) -> BoxObstacle {
        let length = self.shape.centre.distance(self.to);
        if length == 0.0 {
            return self.shape;
        }
        let gone = (2.0 * length * self.phase + self.speed * seconds).rem_euclid(2.0 * length);
        let share = gone.min(2.0 * length - gone) / length;
        BoxObstacle { centre: self.shape.centre.lerp(self.to, share), ..self.shape }
    }
}

/// A scene with what moves in it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Place {
    pub scene: Scene,
    pub movers: Vec<Mover>,
}

/// One person's episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Role {
    /// Number of the place it happens in. People with the same one see each other.
    pub place: usize,
    /// Where it starts and where it should go, on the floor.
    pub start: Vec2,
    pub goal: Vec2,
    /// How far it is turned away from the goal at the start, radians.
    pub turn: f32,
    /// First pose and shape.
    pub seed: SeedMotion,
}

/// Whose places a person sees after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Everybody's after the step: the order of people has no influence.
    #[default]
    Simultaneous,
    /// As in the authors' code, where people step one after the other: those after it where they stood before.
    Sequential,
}

/// Episodes of many people, each played once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cast {
    pub places: Vec<Place>,
    pub roles: Vec<Role>,
    pub order: Order,
}

/// Lower and upper corner of a person's box on the floor, world.
type Bounds = (Vec2, Vec2);

/// A cast under way.
#[derive(Clone, Debug)]
pub(super) struct Stage {
    pub cast: Cast,
    /// People of each place.
    people: Vec<Vec<usize>>,
    /// Who has ended and stands where it is.
    pub done: Vec<bool>,
    steps: u32,
    before: Vec<Bounds>,
    now: Vec<Bounds>,
}

impl Stage {
    pub fn new(cast: Cast) -> Result<Self> {
        let mut people = vec![Vec::new(); cast.places.len()];
        for (i, role) in cast.roles.iter().enumerate() {
            let place = people.get_mut(role.place);
            place.ok_or_else(|| Error::invalid(format!("person {i} plays in place {} of {}", role.place, cast.places.len())))?.push(i);
        }
        let n = cast.roles.len();
        Ok(Self { cast, people, done: vec![false; n], steps: 0, before: Vec::new(), now: Vec::new() })
    }

    /// Puts person `i` at its start.
    pub fn place(&self, i: usize, body: &BodyModel, people: &mut People) -> Result<Setting> {
        let role = &self.cast.roles[i];
        let to = role.goal - role.start;
        people.place(i, body, &role.seed, yaw_towards(to.x, to.y) + role.turn, role.start.x, role.start.y)?;
        Ok(Setting { scene: self.cast.places[role.place].scene.clone(), start: role.start, goal: role.goal })
    }

    /// Begins anew, with everybody at its start.
    pub fn begin(&mut self, people: &People) {
        self.steps = 0;
        self.done.fill(false);
        self.now = all_bounds(people);
        self.before.clone_from(&self.now);
    }

    /// Takes note of everybody's step.
    pub fn moved(&mut self, people: &People) {
        self.steps += 1;
        std::mem::swap(&mut self.before, &mut self.now);
        self.now = all_bounds(people);
    }

    /// Numbers of those who have ended.
    pub fn held(&self) -> Vec<usize> {
        (0..self.done.len()).filter(|&i| self.done[i]).collect()
    }

    /// What of the floor `walkable` movers and others leave person `i`.
    pub fn ground<'a>(&self, i: usize, walkable: &'a Polygon) -> Cow<'a, Polygon> {
        let place = self.cast.roles[i].place;
        let seconds = ((SEED - 1) as u32 + FUTURE as u32 * self.steps) as f32 / FPS;
        let movers = self.cast.places[place].movers.iter().map(|m| m.at(seconds).corners().to_vec());
        let late = |j: usize| self.cast.order == Order::Sequential && j > i;
        let bounds = |j: usize| if late(j) { self.before[j] } else { self.now[j] };
        let others = self.people[place].iter().filter(|&&j| j != i).map(|&j| corners(bounds(j)));
        let cut: Vec<_> = movers.chain(others).collect();
        if cut.is_empty() { Cow::Borrowed(walkable) } else { Cow::Owned(walkable.less(cut)) }
    }
}

/// The axis-aligned box round the markers of person `i` over both seed frames, on the world's floor.
fn bounds(people: &People, i: usize) -> Bounds {
    let (markers, frame) = (&people.markers[i * SEED * MARKER_DIM..][..SEED * MARKER_DIM], &people.frames[i]);
    markers.chunks_exact(3).fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(low, high), m| {
        let p = frame.point(Vec3::from_slice(m)).truncate();
        (low.min(p), high.max(p))
    })
}

fn all_bounds(people: &People) -> Vec<Bounds> {
    (0..people.len()).map(|i| bounds(people, i)).collect()
}

fn corners((low, high): Bounds) -> Vec<DVec2> {
    [low, Vec2::new(high.x, low.y), high, Vec2::new(low.x, high.y)].map(|p| p.as_dvec2()).to_vec()
}

#[cfg(test)]
mod tests {
    use super::super::toy::Toy;
    use super::super::{EPISODE, MotionEnv, MotionTask};
    use super::*;
    use crate::{StepResult, VecEnv};
    use egogen::body::{BETAS, Frame};
    use egogen::sensing::RAYS;
    use egogen::sim::Sim;
    use std::sync::Arc;

    /// First egosensing number of an observation row.
    const EGO: usize = 804;
    const OBS: usize = 870;

    fn role(start: Vec2, goal: Vec2) -> Role {
        let params = Toy::new().at(&Frame::IDENTITY).repeat(2);
        Role { place: 0, start, goal, turn: 0.0, seed: SeedMotion { params, betas: [0.0; BETAS] } }
    }

    fn place() -> Place {
        Place { scene: Scene::with_boxes(5.0, vec![]).unwrap(), movers: vec![] }
    }

    fn env(cast: Cast) -> MotionEnv {
        let sim = Arc::new(Sim::new(BodyModel::embedded(), Arc::new(Toy::new())));
        let task = MotionTask { end_on_penetration: false, ..Default::default() };
        MotionEnv::staged(task, sim, cast).unwrap()
    }

    /// Free way straight ahead of person `i` in the last seed frame, metres: the shorter of the two middle rays.
    fn ahead(obs: &[f32], i: usize) -> f32 {
        let rays = &obs[i * OBS + EGO + RAYS..][..RAYS];
        (rays[15].min(rays[16]) + 1.0) * 3.5
    }

    #[test]
    fn movers_by_hand() {
        let shape = BoxObstacle { centre: Vec2::new(0.0, -1.0), size: Vec2::ONE, yaw: 0.3, height: 2.0 };
        let mover = Mover { shape, to: Vec2::new(0.0, 1.0), speed: 0.5, phase: 0.25 };
        // A quarter of 4 m there and back is the middle; after 1 s it is half a metre on, after 2 s at the end, after 4 s back in the middle.
        for (seconds, y) in [(0.0, 0.0), (1.0, 0.5), (2.0, 1.0), (4.0, 0.0), (6.0, -1.0), (8.0, 0.0)] {
            assert!((mover.at(seconds).centre - Vec2::new(0.0, y)).length() < 1e-5, "{seconds}: {:?}", mover.at(seconds));
        }
        assert_eq!(Mover { to: shape.centre, ..mover }.at(3.0), shape);
    }

    #[test]
    fn people_see_each_other_and_whoever_leaves_is_not_seen() {
        let (a, b) = (Vec2::new(-2.0, 0.0), Vec2::new(2.0, 0.0));
        let two = env(Cast { places: vec![place()], roles: vec![role(a, b), role(b, a)], ..Default::default() });
        let alone = env(Cast { places: vec![place()], roles: vec![role(a, b)], ..Default::default() });
        let (mut seen, mut free) = (vec![], vec![]);
        two.observe(&mut seen).unwrap();
        alone.observe(&mut free).unwrap();
        // The other's chest is some decimetres before its middle; a wall stands 7 m away, where sight ends.
        let way = ahead(&seen, 0);
        assert!((3.5..4.0).contains(&way) && (ahead(&seen, 1) - way).abs() < 1e-3, "{way}");
        assert!(ahead(&free, 0) > 6.8);
        // Nothing else of what a person senses changes.
        assert_eq!((&seen[..EGO], &seen[EGO + 2 * RAYS..OBS]), (&free[..EGO], &free[EGO + 2 * RAYS..OBS]));
        // In a place of their own they do not see each other.
        let apart = Cast { places: vec![place(), place()], roles: vec![role(a, b), Role { place: 1, ..role(b, a) }], ..Default::default() };
        env(apart).observe(&mut seen).unwrap();
        assert_eq!(seen[..OBS], free[..]);
    }

    #[test]
    fn all_see_the_same_moment_unless_they_step_in_turn() {
        let (a, b) = (Vec2::new(-2.0, 0.0), Vec2::new(2.0, 0.0));
        let walk = |order, roles: Vec<Role>| {
            let mut env = env(Cast { places: vec![place()], roles, order });
            let mut out = StepResult::default();
            env.step(&[1.0, 0.0, 0.0, 0.0].repeat(2), &mut out).unwrap();
            [ahead(&out.obs, 0), ahead(&out.obs, 1)]
        };
        // Each went 0.45 m.
        let now = walk(Order::Simultaneous, vec![role(a, b), role(b, a)]);
        assert!((now[0] - now[1]).abs() < 1e-3 && (2.6..3.1).contains(&now[0]), "{now:?}");
        let turned = walk(Order::Simultaneous, vec![role(b, a), role(a, b)]);
        assert!((now[0] - turned[1]).abs() < 1e-6 && (now[1] - turned[0]).abs() < 1e-6);
        let turns = walk(Order::Sequential, vec![role(a, b), role(b, a)]);
        assert!((turns[0] - now[0] - 0.45).abs() < 1e-3 && turns[1] == now[1], "{turns:?}");
    }

    #[test]
    fn who_has_arrived_stands_in_the_way() {
        // The first has only half a step to go, the second follows 3 m behind.
        let front = role(Vec2::ZERO, Vec2::new(0.45, 0.0));
        let back = role(Vec2::new(-3.0, 0.0), Vec2::new(4.0, 0.0));
        let mut env = env(Cast { places: vec![place()], roles: vec![front, back], ..Default::default() });
        let mut out = StepResult::default();
        let mut ends = vec![];
        for step in 0..11 {
            env.step(&[1.0, 0.0, 0.0, 0.0].repeat(2), &mut out).unwrap();
            ends.extend((0..2).filter(|&i| out.terminated[i]).map(|i| (i, step)));
        }
        assert_eq!(ends, [(0, 0), (1, 10)]);
        let stands = env.people().frames[0].transl.truncate();
        assert!((stands - Vec2::new(0.425, 0.0)).length() < 0.03, "{stands}");
        // The second went through the first, which is noted but ends nothing.
        let hit = EPISODE.iter().position(|&n| n == "penetration").unwrap();
        assert_eq!(out.episode[EPISODE.len() + hit], 1.0);
        assert!(env.save_state().is_err());
    }

    #[test]
    fn boxes_move_before_the_eyes() {
        let shape = BoxObstacle { centre: Vec2::new(2.0, 0.0), size: Vec2::ONE, yaw: 0.0, height: 2.0 };
        let mover = Mover { shape, to: Vec2::new(4.0, 0.0), speed: 0.5, phase: 0.0 };
        let place = Place { movers: vec![mover], ..place() };
        let mut env = env(Cast { places: vec![place], roles: vec![role(Vec2::ZERO, Vec2::X * 3.0)], ..Default::default() });
        let (mut obs, mut out) = (vec![], StepResult::default());
        env.observe(&mut obs).unwrap();
        env.step(&[0.0; 4], &mut out).unwrap();
        // 0.45 s at half a metre a second.
        assert!((ahead(&out.obs, 0) - ahead(&obs, 0) - 0.225).abs() < 2e-3);
    }

    #[test]
    fn foreign_places_are_named() {
        let sim = Arc::new(Sim::new(BodyModel::embedded(), Arc::new(Toy::new())));
        let cast = Cast { roles: vec![role(Vec2::ZERO, Vec2::X)], ..Default::default() };
        assert!(MotionEnv::staged(MotionTask::default(), sim, cast).err().unwrap().to_string().contains("place 0 of 0"));
    }
}
