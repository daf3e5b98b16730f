//! A scenario ready to be played: people placed in their scenes.

use super::people::{Start, first_poses, stands_free};
use super::scenario::{Layout, Moving, Scenario};
use super::{Actor, Played, measure, play};
use crate::program::Given;
use crate::{Error, Result};
use egogen::rng::{Stream, stream};
use egogen::scene::{BoxObstacle, CrowdedScene, Scene, SceneBundle, SdfGrid, Split, TriMesh};
use egogen::sim::World;
use egogen_envs::motion::{Cast, MotionEnv, MotionTask, Mover, Place, Role};
use glam::Vec2;
use rand::RngExt;
use std::f32::consts::TAU;
use std::sync::Arc;

/// Starts that are tried until everybody stands free.
const DRAWS: usize = 1000;

/// What stands in a room, whose floor is at z = 0.
#[derive(Clone)]
pub struct Solids {
    pub sdf: Arc<SdfGrid>,
    /// For pictures, where it is known.
    pub mesh: Option<Arc<TriMesh>>,
}

impl Solids {
    fn of(room: &CrowdedScene) -> Self {
        Self { sdf: room.sdf.clone(), mesh: room.mesh.clone() }
    }
}

/// A scenario's people on their marks.
pub struct Setup {
    pub scenario: Scenario,
    pub env: MotionEnv,
    /// Of each person the number of its scene.
    pub place: Vec<usize>,
    /// Of each person the number of its start; repeats of a scene have the same.
    pub start: Vec<usize>,
    /// Of each scene what stands in it, where that is not made of boxes.
    pub solids: Vec<Option<Solids>>,
}

/// A scene and where people start and go.
struct Drawn {
    place: Place,
    solids: Option<Solids>,
    pairs: Vec<[Vec2; 2]>,
}

impl Setup {
    /// The scenario with starts drawn from `seed`; `task` gives what the scenario leaves open.
    pub fn new(scenario: Scenario, task: &MotionTask, world: &World, seed: u64) -> Result<Self> {
        if scenario.layout == Layout::Task {
            let n = scenario.scenes;
            let env = MotionEnv::evaluation(task.clone(), world.sim.clone(), world.held_out.clone(), n, seed).given()?;
            let room = |i| env.room(i).map(Solids::of);
            let solids = (0..n).map(room).collect();
            return Ok(Self { scenario, env, place: (0..n).collect(), start: (0..n).collect(), solids });
        }
        let task = MotionTask { max_depth: scenario.max_depth, end_on_penetration: scenario.end_on_penetration, ..task.clone() };
        let source = Source::new(&scenario.layout)?;
        let mut cast = Cast { order: scenario.order, ..Cast::default() };
        let (mut place, mut start, mut solids) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..scenario.scenes {
            let rng = &mut stream(seed, "scenario", k as u64);
            let (drawn, people) = on_their_marks(&source, &scenario, world, rng)?;
            for _ in 0..scenario.repeats {
                let at = cast.places.len();
                for (j, ([from, to], (seed, turn))) in drawn.pairs.iter().zip(&people).enumerate() {
                    cast.roles.push(Role { place: at, start: *from, goal: *to, turn: *turn, seed: seed.clone() });
                    place.push(at);
                    start.push(k * drawn.pairs.len() + j);
                }
                cast.places.push(drawn.place.clone());
                solids.push(drawn.solids.clone());
            }
        }
        let env = MotionEnv::staged(task, world.sim.clone(), cast).given()?;
        Ok(Self { scenario, env, place, start, solids })
    }

    /// Everybody's episode with `actor`, recorded and measured. `seed` fixes the noise.
    pub fn play(&mut self, actor: &Actor, seed: u64) -> Result<Vec<Played>> {
        let mut played = play(&mut self.env, actor, seed, true)?;
        for (i, p) in played.iter_mut().enumerate() {
            (p.start, p.group) = (self.start[i] as u64, self.place[i]);
        }
        measure(self, &mut played);
        Ok(played)
    }

    /// Numbers of the people of each scene.
    pub fn groups(&self) -> Vec<Vec<usize>> {
        let mut out = vec![Vec::new(); self.solids.len()];
        self.place.iter().enumerate().for_each(|(i, &p)| out[p].push(i));
        out
    }
}

/// A scene whose people stand clear of what stands there.
fn on_their_marks(source: &Source, scenario: &Scenario, world: &World, rng: &mut Stream) -> Result<(Drawn, Vec<Start>)> {
    for _ in 0..DRAWS {
        let drawn = source.draw(rng)?;
        let people = first_poses(&scenario.people, drawn.pairs.len(), world, rng)?;
        let free = |sdf: &SdfGrid| drawn.pairs.iter().zip(&people).all(|(pair, person)| stands_free(person, *pair, sdf, world));
        if drawn.solids.as_ref().is_none_or(|s| free(&s.sdf)) {
            return Ok((drawn, people));
        }
    }
    Err(Error::config(format!("scenario '{}': nobody stands free at {DRAWS} starts: give the pairs more clearance", scenario.name)))
}

/// Where scenes come from.
enum Source<'a> {
    Midpoint { distance: f32, side: [f32; 2], height: f32, wall: f32, moving: Option<&'a Moving> },
    Circle { people: usize, radius: f32, wall: f32 },
    Rooms { people: usize, rooms: Vec<Furnished> },
}

/// A room to draw pairs from.
struct Furnished {
    scene: Scene,
    solids: Option<Solids>,
    pairs: Vec<[Vec2; 2]>,
}

impl<'a> Source<'a> {
    fn new(layout: &'a Layout) -> Result<Self> {
        Ok(match layout {
            Layout::Task => return Err(Error::run("the task draws its scenes itself")),
            &Layout::Midpoint { distance, side, height, wall, ref moving } => {
                Self::Midpoint { distance, side, height, wall, moving: moving.as_ref() }
            }
            &Layout::Circle { people, radius, wall } => Self::Circle { people, radius, wall },
            Layout::Rooms { people, rooms } => {
                let made = rooms.make(Split::Test).given()?;
                let furnished = made.iter().map(|r| Furnished {
                    scene: r.scene.clone(),
                    solids: Some(Solids::of(r)),
                    pairs: r.pairs.iter().map(|p| [p.start, p.goal]).collect(),
                });
                Self::Rooms { people: *people, rooms: furnished.collect() }
            }
            Layout::Bundle { people, path } => {
                let bundle = SceneBundle::read(path).given()?.on_floor();
                if bundle.pairs.is_empty() {
                    let what = format!("{} holds no pairs of start and goal; make it again with `scene`", path.display());
                    return Err(Error::config(what));
                }
                let pairs = bundle.pairs.iter().map(|p| [p.start, p.goal]).collect();
                let mesh = bundle.mesh.map(Arc::new);
                let solids = bundle.sdf.map(|sdf| Solids { sdf: Arc::new(sdf), mesh });
                let scene = Scene { walkable: bundle.walkable, obstacles: Vec::new() };
                Self::Rooms { people: *people, rooms: vec![Furnished { scene, solids, pairs }] }
            }
        })
    }

    fn draw(&self, rng: &mut Stream) -> Result<Drawn> {
        match *self {
            Self::Midpoint { distance, side, height, wall, moving } => {
                let size = Vec2::new(rng.random_range(side[0]..=side[1]), rng.random_range(side[0]..=side[1]));
                let shape = BoxObstacle { centre: Vec2::ZERO, size, yaw: rng.random_range(0.0..TAU), height };
                let pairs = vec![[Vec2::new(-0.5 * distance, 0.0), Vec2::new(0.5 * distance, 0.0)]];
                let mover = |m: &Moving| Mover {
                    shape: BoxObstacle { centre: Vec2::new(0.0, -m.reach), ..shape },
                    to: Vec2::new(0.0, m.reach),
                    speed: rng.random_range(m.speed[0]..=m.speed[1]),
                    phase: rng.random_range(0.0..1.0),
                };
                let movers: Vec<Mover> = moving.map(mover).into_iter().collect();
                let standing = if movers.is_empty() { vec![shape] } else { vec![] };
                Ok(Drawn { place: Place { scene: Scene::with_boxes(wall, standing)?, movers }, solids: None, pairs })
            }
            Self::Circle { people, radius, wall } => {
                let phase = rng.random_range(0.0..TAU);
                let at = |k: usize| Vec2::from_angle(phase + TAU * k as f32 / people as f32) * radius;
                let pairs = (0..people).map(|k| [at(k), -at(k)]).collect();
                Ok(Drawn { place: Place { scene: Scene::with_boxes(wall, vec![])?, movers: vec![] }, solids: None, pairs })
            }
            Self::Rooms { people, ref rooms } => {
                let room = &rooms[rng.random_range(0..rooms.len())];
                let [a, b] = room.pairs[rng.random_range(0..room.pairs.len())];
                let pairs = [[a, b], [b, a]][..people].to_vec();
                Ok(Drawn { place: Place { scene: room.scene.clone(), movers: vec![] }, solids: room.solids.clone(), pairs })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::agent::bundle::Bundle;
    use egogen_envs::VecEnv;

    fn setup(name: &str, episodes: usize) -> Setup {
        let world = World::embedded().unwrap();
        Setup::new(Scenario::find(name).unwrap().with_episodes(episodes), &MotionTask::default(), &world, 3).unwrap()
    }

    #[test]
    fn people_swap_places_on_a_circle() {
        let s = setup("circle-8", 16);
        let cast = s.env.cast().unwrap();
        assert_eq!((cast.roles.len(), s.groups().len(), s.start[9]), (16, 2, 9));
        for (i, role) in cast.roles.iter().enumerate() {
            assert!((role.start.length() - 2.0).abs() < 1e-5 && role.goal == -role.start && role.turn.abs() <= 72f32.to_radians());
            let opposite = &cast.roles[i / 8 * 8 + (i + 4) % 8];
            assert!((opposite.start - role.goal).length() < 1e-5);
        }
        assert_eq!(cast, setup("circle-8", 16).env.cast().unwrap());
    }

    #[test]
    fn without_the_other_person_one_sees_and_walks_differently() {
        let world = World::embedded().unwrap();
        let scenario = Scenario::find("circle-2").unwrap().with_episodes(16);
        let task = MotionTask::default();
        let two = Setup::new(scenario, &task, &world, 5).unwrap();
        let mut alone = two.env.cast().unwrap().clone();
        // Of each two the first stays.
        alone.roles = alone.roles.into_iter().step_by(2).collect();
        let task = two.env.task().clone();
        let mut envs = [two.env, MotionEnv::staged(task, world.sim.clone(), alone).unwrap()];
        let bundle = Bundle::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/policy/quick").as_ref()).unwrap();
        let [with, without] = envs.each_mut().map(|env| {
            let actor = Actor::policy(&bundle, env, false).unwrap();
            let mut obs = vec![];
            env.reset(0, &mut obs).unwrap();
            (obs, play(env, &actor, 0, true).unwrap())
        });
        let (mut seen, mut moved) = (0, 0);
        for i in 0..8 {
            let rows = [&with.0[2 * i * 870..][..870], &without.0[i * 870..][..870]];
            assert_eq!(rows[0][..804], rows[1][..804]);
            seen += usize::from(rows[0][804..868] != rows[1][804..868]);
            let frames = |p: &Played| p.film.as_ref().unwrap().frames.clone();
            moved += usize::from(frames(&with.1[2 * i]) != frames(&without.1[i]));
        }
        assert!(seen >= 7 && moved == 8, "{seen} of 8 saw the other, {moved} moved otherwise");
    }

    #[test]
    fn repeats_share_their_start() {
        let s = setup("midpoint", 30);
        let cast = s.env.cast().unwrap();
        assert_eq!((s.place.len(), s.start[9], s.start[10], s.start[29]), (30, 0, 1, 2));
        assert!(cast.places[0] == cast.places[9] && cast.places[0] != cast.places[10] && cast.roles[3].seed == cast.roles[4].seed);
    }

    #[test]
    fn boxes_move_across_the_way() {
        let s = setup("moving", 5);
        let places = &s.env.cast().unwrap().places;
        assert!(places.iter().all(|p| p.scene.obstacles.is_empty() && p.movers.len() == 1));
        let m = &places[0].movers[0];
        assert!((0.3..=0.8).contains(&m.speed) && m.shape.centre == Vec2::new(0.0, -1.5) && m.to == Vec2::new(0.0, 1.5));
        assert!(places[0].movers[0].phase != places[1].movers[0].phase);
    }
}
