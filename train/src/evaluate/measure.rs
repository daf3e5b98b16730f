//! What the motion of an episode tells: the goal, the way, obstacles and other people.

use super::way::Ways;
use super::{Film, Played, Setup, Solids};
use egogen::body::{BETAS, BodyModel, MARKER_DIM, PARAMS, ShapedBody, joint, smplx_weights};
use egogen::metrics::{
    box_distance, contact_score, deepest, final_distance, least_distance, meets_outline, overlap, passes_left, path_length, time_to_reach,
};
use egogen::motion::FPS;
use egogen::scene::{BoxObstacle, Polygon, Solid};
use egogen_envs::motion::Mover;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::cell::OnceCell;

/// Meshes are looked at in every fourth frame: ten times a second.
const EVERY: usize = 4;
/// The two distances within which the pelvis, seen from above, counts as at the goal, metres.
const AT: f32 = 0.1;
const NEAR: f32 = 0.2;
/// Further than this from its pelvis nobody reaches, metres.
const REACH: f64 = 1.3;
/// Bodies whose bounds are this far apart have no influence on each other, metres.
const APART: f32 = 0.1;

/// Figures of one person's episode. What does not apply (no obstacle, nobody else, goal not reached) is NaN.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    /// The pelvis seen from above, frame by frame.
    pub path: Vec<Vec2>,
    /// Seconds until the pelvis was first within 0.1 m of the goal, seen from above.
    pub seconds: f32,
    /// Whether it ever was within 0.2 m.
    pub near: f32,
    /// Distance to the goal seen from above, in the end and at least, metres.
    pub last: f32,
    pub least: f32,
    /// Foot contact (eq. 12) over all frames.
    pub contact: f32,
    /// Length of the way of those who came within 0.2 m over that of the shortest one.
    pub detour: f32,
    /// Share of the frames in which any vertex's floor projection lies in an obstacle or beyond a wall.
    pub obstacle_frames: f32,
    /// Depth of the deepest vertex inside what stands or moves there, mean over the frames, metres.
    pub obstacle_depth: f32,
    /// Greatest number of vertices inside in a frame, counted as SMPL-X's, without feet (eq. 11).
    pub most_inside: f32,
    /// Share of the frames with any vertex inside another person; mean number of such vertices; mean occupancy there.
    pub inside_frames: f32,
    pub inside_vertices: f32,
    pub occupancy: f32,
    /// Whether it passed the box in the middle on the left; None without one, and where it did not come that far.
    pub left: Option<bool>,
}

/// A person's recording, ready to be posed.
struct Track<'a> {
    model: &'a BodyModel,
    shaped: ShapedBody,
    film: &'a Film,
    /// SMPL-X vertices that each vertex stands for.
    weights: &'a [f32],
}

impl Track<'_> {
    fn len(&self) -> usize {
        self.film.frames.len() / PARAMS
    }

    /// Parameters of frame `t`, or of the last one, in which who has ended stays.
    fn params(&self, t: usize) -> &[f32] {
        &self.film.frames[t.min(self.len() - 1) * PARAMS..][..PARAMS]
    }

    fn path(&self) -> Vec<Vec2> {
        (0..self.len()).map(|t| self.shaped.pose(self.params(t)).pos[joint::PELVIS].truncate()).collect()
    }

    fn vertices(&self, t: usize) -> Vec<Vec3> {
        let mut out = Vec::new();
        self.model.skin(&self.shaped, &self.shaped.pose(self.params(t)), &mut out);
        out
    }
}

/// Adds to each episode of `setup`, recorded, what its motion tells.
pub fn measure(setup: &Setup, played: &mut [Played]) {
    let model: &BodyModel = setup.env.sim().body();
    let films: Vec<&Film> = played.iter().filter_map(|p| p.film.as_ref()).collect();
    let weights = smplx_weights(model);
    let tracks: Vec<Track> =
        films.into_iter().map(|film| Track { model, shaped: model.shape(&film.betas), film, weights: &weights }).collect();
    if tracks.len() != setup.place.len() {
        return;
    }
    let mut measured: Vec<Measured> = tracks.par_iter().enumerate().map(|(i, track)| alone(setup, i, track)).collect();
    let mut rest = Vec::new();
    model.rest_vertices(&[0.0; BETAS], &mut rest);
    let rest = Solid::new(&rest, model.faces()).ok();
    let together: Vec<Vec<[f32; 3]>> = setup.groups().par_iter().map(|group| among(group, &tracks, rest.as_ref())).collect();
    for (i, figures) in setup.groups().iter().flatten().zip(together.into_iter().flatten()) {
        [measured[*i].inside_frames, measured[*i].inside_vertices, measured[*i].occupancy] = figures;
    }
    played.iter_mut().zip(measured).for_each(|(p, m)| p.measured = Some(m));
}

fn alone(setup: &Setup, i: usize, track: &Track) -> Measured {
    let (film, path) = (track.film, track.path());
    let (goal, walkable) = (film.setting.goal, &film.setting.scene.walkable);
    let mut markers = vec![0.0; track.len() * MARKER_DIM];
    track.shaped.markers_batch(&film.frames, &mut markers);
    let near = least_distance(&path, goal) < NEAR;
    let shortest = Ways::over(walkable).plan(path[0], goal).length();
    let [obstacle_frames, obstacle_depth, most_inside] = obstacles(setup, i, track, &path);
    let middle = film.setting.scene.obstacles.first().map(|b| b.centre);
    Measured {
        seconds: time_to_reach(&path, goal, AT).unwrap_or(f32::NAN),
        near: f32::from(near),
        last: final_distance(&path, goal),
        least: least_distance(&path, goal),
        contact: contact_score(&markers),
        detour: if near { path_length(&path) / shortest } else { f32::NAN },
        obstacle_frames,
        obstacle_depth,
        most_inside,
        left: middle.and_then(|middle| passes_left(&path, goal, middle)),
        path,
        ..Measured::default()
    }
}

/// Share of frames over an obstacle's outline, mean depth of the deepest vertex, and most vertices inside.
fn obstacles(setup: &Setup, i: usize, track: &Track, path: &[Vec2]) -> [f32; 3] {
    let scene = &track.film.setting.scene;
    let place = setup.place[i];
    let movers: &[Mover] = setup.env.cast().map_or(&[], |cast| &cast.places[place].movers);
    let solids = setup.solids[place].as_ref();
    if scene.obstacles.is_empty() && movers.is_empty() && solids.is_none() {
        return [f32::NAN; 3];
    }
    let (mut over, mut depth, mut most, mut count) = (0.0, 0.0, 0.0, 0.0);
    for t in (0..track.len()).step_by(EVERY) {
        let boxes: Vec<BoxObstacle> = movers.iter().map(|m| m.at(t as f32 / FPS)).chain(scene.obstacles.iter().copied()).collect();
        let moving = boxes[..movers.len()].iter().map(|b| b.corners().to_vec());
        let floor = if movers.is_empty() { None } else { Some(scene.walkable.less(moving)) };
        let floor = floor.as_ref().unwrap_or(&scene.walkable);
        count += 1.0;
        if clear(floor, path[t]) {
            continue;
        }
        let vertices = track.vertices(t);
        over += f32::from(meets_outline(&vertices, floor));
        let distances: Vec<f32> =
            vertices.iter().map(|&v| boxes.iter().map(|b| box_distance(b, v)).fold(room(solids, v), f32::min)).collect();
        depth += deepest(&distances);
        let weights = track.weights.iter().zip(&distances);
        most = f32::max(most, weights.filter(|(_, d)| **d < 0.0).map(|(w, _)| w).sum());
    }
    [over / count, depth / count, most]
}

/// Whether nothing is in reach of a person here.
fn clear(floor: &Polygon, pelvis: Vec2) -> bool {
    floor.contains(pelvis.as_dvec2()) && floor.border_distance(pelvis.as_dvec2()) > REACH
}

fn room(solids: Option<&Solids>, v: Vec3) -> f32 {
    solids.map_or(f32::INFINITY, |s| s.sdf.at(v))
}

/// Of each person of a scene: share of its frames inside others, vertices inside them and occupancy, means over the frames. `rest`: the body
/// at rest.
fn among(group: &[usize], tracks: &[Track], rest: Option<&Solid>) -> Vec<[f32; 3]> {
    if group.len() < 2 {
        return vec![[f32::NAN; 3]; group.len()];
    }
    let tracks: Vec<&Track> = group.iter().map(|&i| &tracks[i]).collect();
    let longest = tracks.iter().map(|t| t.len()).max().unwrap_or(0);
    let times: Vec<usize> = (0..longest).step_by(EVERY).collect();
    let frames: Vec<Vec<[f32; 2]>> = times.par_iter().map(|&t| overlaps(&tracks, t, rest)).collect();
    let of = |(i, track): (usize, &&Track)| {
        let own = frames.iter().zip(&times).filter(|(_, t)| **t < track.len()).map(|(frame, _)| frame[i]);
        let add = |[frames, inside, occupied, n]: [f32; 4], [vertices, occupancy]: [f32; 2]| {
            [frames + f32::from(vertices > 0.0), inside + vertices, occupied + occupancy, n + 1.0]
        };
        let [frames, inside, occupied, n] = own.fold([0.0; 4], add);
        [frames / n, inside / n, occupied / n]
    };
    tracks.iter().enumerate().map(of).collect()
}

/// Of each person in frame `t`: vertices inside others, and occupancy there; of who has ended nothing.
fn overlaps(tracks: &[&Track], t: usize, rest: Option<&Solid>) -> Vec<[f32; 2]> {
    let bodies: Vec<Body> = tracks.iter().map(|track| Body::new(track.vertices(t))).collect();
    let of = |i: usize| {
        let others = bodies.iter().enumerate().filter(|(j, other)| *j != i && t < tracks[i].len() && other.near(&bodies[i]));
        let shared = others.filter_map(|(_, other)| Some(overlap(&bodies[i].vertices, other.solid(rest)?)));
        shared.fold([0.0; 2], |[vertices, occupancy], o| [vertices + o.vertices as f32, occupancy + o.occupancy])
    };
    (0..tracks.len()).map(of).collect()
}

/// A body of one frame.
struct Body {
    vertices: Vec<Vec3>,
    low: Vec3,
    high: Vec3,
    solid: OnceCell<Option<Solid>>,
}

impl Body {
    fn new(vertices: Vec<Vec3>) -> Self {
        let (low, high) = vertices.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        Self { vertices, low, high, solid: OnceCell::new() }
    }

    fn near(&self, other: &Self) -> bool {
        (self.low - APART).cmple(other.high).all() && other.low.cmple(self.high + APART).all()
    }

    /// What the body encloses; made when first asked for.
    fn solid(&self, rest: Option<&Solid>) -> Option<&Solid> {
        self.solid.get_or_init(|| rest?.moved(&self.vertices).ok()).as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Actor, Scenario, play};
    use super::*;
    use egogen::sim::World;
    use egogen_envs::motion::MotionTask;

    fn setup(name: &str, episodes: usize) -> Setup {
        let world = World::embedded().unwrap();
        Setup::new(Scenario::find(name).unwrap().with_episodes(episodes), &MotionTask::default(), &world, 3).unwrap()
    }

    #[test]
    fn bodies_that_stand_in_each_other_are_found() {
        let mut s = setup("circle-2", 2);
        let mut played = play(&mut s.env, &Actor::Zero, 0, true).unwrap();
        played.iter_mut().filter_map(|p| p.film.as_mut()).for_each(|film| film.frames.truncate(PARAMS * 3));
        measure(&s, &mut played);
        let apart = played[0].measured.clone().unwrap();
        assert_eq!((apart.inside_frames, apart.inside_vertices, apart.occupancy), (0.0, 0.0, 0.0));
        assert!(apart.obstacle_frames.is_nan() && apart.left.is_none() && (apart.last - 4.0).abs() < 0.2);
        // The second does what the first does, a hand's breadth beside it.
        let mut copy = played[0].film.clone().unwrap();
        copy.frames.chunks_exact_mut(PARAMS).for_each(|p| p[0] += 0.1);
        played[1].film = Some(copy);
        measure(&s, &mut played);
        let [a, b] = [0, 1].map(|i| played[i].measured.clone().unwrap());
        assert!(a.inside_frames == 1.0 && a.inside_vertices > 800.0 && a.occupancy > 0.05 && a.occupancy < 1.0, "{a:?}");
        assert!(b.inside_frames == 1.0 && b.inside_vertices > 100.0, "{b:?}");
    }

    #[test]
    fn who_stands_in_a_box_is_found() {
        let mut s = setup("midpoint", 10);
        let mut played = play(&mut s.env, &Actor::Zero, 0, true).unwrap();
        measure(&s, &mut played);
        let before = played[0].measured.clone().unwrap();
        // Moved so that the first frame's pelvis stands in the middle of the box, whose least half side is 25 cm.
        let shift = -before.path[0];
        let film = played[0].film.as_mut().unwrap();
        film.frames.chunks_exact_mut(PARAMS).for_each(|p| (p[0], p[1]) = (p[0] + shift.x, p[1] + shift.y));
        film.frames.truncate(PARAMS * 3);
        measure(&s, &mut played);
        let after = played[0].measured.clone().unwrap();
        assert!(
            after.obstacle_frames == 1.0 && (0.2..0.6).contains(&after.obstacle_depth),
            "{} {}",
            after.obstacle_frames,
            after.obstacle_depth
        );
        assert!(before.obstacle_depth < 0.3 && after.inside_frames.is_nan() && after.seconds.is_nan() && after.near == 0.0);
        assert!((after.last - 2.0).abs() < 0.1 && after.contact > 0.5);
    }
}
