//! A recorded episode in pictures: people walking among boxes or in a room as a filmstrip, as ghosts and from above.

use super::colour::PEOPLE;
use super::room::{CutAway, by_colour};
use super::top_view::PATH_WIDTH;
use super::{Camera, Image, Mesh, Rgb, Shading, Stage, TopView, colour, film, ramp};
use crate::body::{BodyModel, FOOT_MARKERS, MARKER_DIM, PARAMS, ShapedBody, check_motion, joint};
use crate::motion::FPS;
use crate::scene::{Scene, TriMesh};
use crate::{Error, Result};
use glam::{Vec2, Vec3};

/// A foot marker counts as standing below this height, metres, ...
const STANCE_HEIGHT: f32 = 0.08;
/// ... and below this speed, metres per second.
const STANCE_SPEED: f32 = 0.2;
/// Height of the person that the camera makes room for, metres.
const HEAD_ROOM: f32 = 1.9;
/// How much the camera rises for each metre away; steeper among furniture, over which it looks.
const FLAT: f32 = 0.62;
const STEEP: f32 = 1.1;

/// One person's part of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Walker<'a> {
    /// T x 93 body parameters in the world, 40 frames per second.
    pub frames: &'a [f32],
    /// 10 shape coefficients.
    pub betas: &'a [f32],
    /// Where the person wants to go.
    pub goal: Option<Vec2>,
}

/// A recorded episode in its scene.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    pub walkers: &'a [Walker<'a>],
    /// Where it happens; for a changing scene, how it stood at one moment.
    pub scene: &'a Scene,
    /// What stands there, for a room.
    pub room: Option<&'a TriMesh>,
    /// Distance within which a goal counts as reached, metres.
    pub reach: f32,
}

/// A walker's recovered joints: its body and the way of its pelvis.
struct Track<'a> {
    walker: &'a Walker<'a>,
    body: ShapedBody,
    pelvis: Vec<Vec3>,
}

impl<'a> Episode<'a> {
    /// `count` panels of `width` x `height` pixels at even times from the first to the last frame, in rows of `columns`.
    ///
    /// Errors: frames or betas of a wrong length, no walker, non-finite values.
    pub fn panels(&self, model: &BodyModel, count: usize, columns: usize, width: usize, height: usize) -> Result<Image> {
        let tracks = self.tracks(model)?;
        let camera = self.camera(&tracks, width, height)?;
        let scene = self.stage(&camera)?;
        let frames: Vec<_> = (0..count)
            .map(|i| {
                let mut stage = scene.clone();
                let mut seconds = 0.0f32;
                for (w, track) in tracks.iter().enumerate() {
                    let frame = moment(i, count, track.pelvis.len());
                    seconds = seconds.max(frame as f32 / FPS);
                    track.add_body(model, frame, PEOPLE[w % PEOPLE.len()], &mut stage);
                    stage.add(&track.way(frame), PEOPLE[w % PEOPLE.len()], Shading::Smooth);
                }
                (stage, camera.clone(), format!("{seconds:.1} s"))
            })
            .collect();
        Ok(film(&frames, columns))
    }

    /// All of `count` moments in one picture of `width` x `height` pixels; a single person's colour runs from dark to light with time.
    ///
    /// Errors as in [`Episode::panels`].
    pub fn ghosts(&self, model: &BodyModel, count: usize, width: usize, height: usize) -> Result<Image> {
        let tracks = self.tracks(model)?;
        let camera = self.camera(&tracks, width, height)?;
        let mut stage = self.stage(&camera)?;
        for (w, track) in tracks.iter().enumerate() {
            for i in 0..count {
                let shade =
                    if tracks.len() == 1 { ramp(0.12 + 0.88 * i as f32 / (count - 1).max(1) as f32) } else { PEOPLE[w % PEOPLE.len()] };
                track.add_body(model, moment(i, count, track.pelvis.len()), shade, &mut stage);
            }
            stage.add(&track.way(track.pelvis.len()), colour::INK, Shading::Smooth);
        }
        Ok(stage.render(&camera))
    }

    /// The plan, `width` pixels wide: scene, pelvis paths, starts, goals and where the foot markers stand.
    ///
    /// Errors as in [`Episode::panels`].
    pub fn top_view(&self, model: &BodyModel, width: usize) -> Result<Image> {
        let tracks = self.tracks(model)?;
        let (rings, boxes) = (self.rings(), self.boxes());
        let mut view = match self.room {
            Some(_) => {
                let (low, high) = self.scene.walkable.bounds();
                TopView::around([low.as_vec2(), high.as_vec2()], 0.3, width)?
            }
            None => {
                // What matters is near the boxes and the way; a far wall would only make it small.
                let ways = self.points(&tracks).map(|p| p.truncate());
                TopView::around(boxes.iter().flatten().copied().chain(ways), 0.3, width)?
            }
        };
        match self.room {
            Some(_) => view.room(self.room, &self.scene.walkable)?,
            None => view.polygon(&rings, [226, 232, 224], colour::STONE),
        }
        boxes.iter().for_each(|b| view.polygon(std::slice::from_ref(b), colour::STONE, colour::INK));
        for (w, track) in tracks.iter().enumerate() {
            let line: Vec<Vec2> = track.pelvis.iter().map(|p| p.truncate()).collect();
            track.stances().for_each(|(p, left)| view.dot(p, 2.0, if left { colour::BLUE } else { colour::RED }));
            match tracks.len() {
                1 => view.timed_path(&line, PATH_WIDTH),
                _ => view.path(&line, PATH_WIDTH, PEOPLE[w % PEOPLE.len()]),
            }
            view.start(line[0], PEOPLE[w % PEOPLE.len()]);
            if let Some(goal) = track.walker.goal {
                view.goal(goal, self.reach, colour::GREEN);
            }
        }
        Ok(view.finish())
    }

    fn tracks(&self, model: &BodyModel) -> Result<Vec<Track<'a>>> {
        if self.walkers.is_empty() {
            return Err(Error::invalid("an episode without walkers cannot be drawn"));
        }
        self.walkers.iter().enumerate().map(|(i, w)| Track::new(model, w).map_err(|e| Error::invalid(format!("walker {i}: {e}")))).collect()
    }

    /// Rings of the walkable polygon.
    fn rings(&self) -> Vec<Vec<Vec2>> {
        self.scene.walkable.rings().map(|r| r.iter().map(|p| p.as_vec2()).collect()).collect()
    }

    /// Floor corners of the boxes.
    fn boxes(&self) -> Vec<Vec<Vec2>> {
        self.scene.obstacles.iter().map(|b| b.corners().map(|p| p.as_vec2()).to_vec()).collect()
    }

    /// The goals and what stands in the scene: the room as far as it does not hide it from the camera, or boxes and the border of the
    /// walkable polygon.
    fn stage(&self, camera: &Camera) -> Result<Stage> {
        let mut stage = Stage::new();
        if let Some(room) = self.room {
            let cut = CutAway::new(&self.scene.walkable, camera.eye())?;
            for (mesh, colour) in by_colour(room, |t| cut.shows(t)) {
                stage.add(&mesh, colour, Shading::Flat);
            }
        } else {
            for b in &self.scene.obstacles {
                stage.add(&Mesh::cuboid(b.centre, b.size / 2.0, b.yaw, b.height), colour::STONE, Shading::Flat);
            }
            for ring in self.rings() {
                let border: Vec<Vec3> = ring.iter().chain(ring.first()).map(|p| p.extend(0.01)).collect();
                stage.add(&Mesh::tube(&border, 0.015), colour::INK, Shading::Smooth);
            }
        }
        for goal in self.walkers.iter().filter_map(|w| w.goal) {
            stage.add(&Mesh::sphere(goal.extend(0.0), self.reach.max(0.05), 3), colour::GREEN, Shading::Smooth);
        }
        Ok(stage)
    }

    /// Every point of the floor that a picture should show: the ways, the goals and the boxes.
    fn points<'b>(&'b self, tracks: &'b [Track]) -> impl Iterator<Item = Vec3> + 'b {
        let goals = self.walkers.iter().filter_map(|w| w.goal);
        let floor = goals.chain(self.boxes().into_iter().flatten()).map(|p| p.extend(0.0));
        tracks.iter().flat_map(|t| t.pelvis.iter().map(|p| p.with_z(0.0))).chain(floor)
    }

    /// A three-quarter view from above, across the way of the first walker, that shows all of it.
    fn camera(&self, tracks: &[Track], width: usize, height: usize) -> Result<Camera> {
        let way = &tracks[0].pelvis;
        let along = (way[way.len() - 1] - way[0]).truncate().try_normalize().unwrap_or(Vec2::X);
        let aside = along.perp() * -0.9 - along * 0.45;
        let (low, high) = self.points(tracks).fold((Vec3::MAX, Vec3::MIN), |(l, h), p| (l.min(p), h.max(p)));
        let target = 0.5 * (low + high).with_z(HEAD_ROOM);
        let rise = if self.room.is_some() { STEEP } else { FLAT };
        let size = Vec2::new(width as f32, height as f32);
        let shown = |camera: &Camera| {
            self.points(tracks)
                .flat_map(|p| [p, p.with_z(HEAD_ROOM)])
                .all(|p| camera.project(p).is_some_and(|(uv, _)| (uv / size - 0.5).abs().max_element() < 0.45))
        };
        let mut distance = 3.0;
        loop {
            let camera = Camera::look_at(target + distance * aside.extend(rise), target, width, height, 0.6)?;
            if distance > 500.0 || shown(&camera) {
                return Ok(camera);
            }
            distance *= 1.08;
        }
    }
}

impl<'a> Track<'a> {
    fn new(model: &BodyModel, walker: &'a Walker<'a>) -> Result<Self> {
        let (frames, betas) = (walker.frames, walker.betas);
        check_motion(frames, betas)?;
        let body = model.shape(betas);
        let pelvis = frames.chunks_exact(PARAMS).map(|f| body.pose(f).pos[joint::PELVIS]).collect();
        Ok(Self { walker, body, pelvis })
    }

    fn add_body(&self, model: &BodyModel, frame: usize, shade: Rgb, stage: &mut Stage) {
        let mut vertices = Vec::new();
        let params = &self.walker.frames[frame * PARAMS..(frame + 1) * PARAMS];
        model.skin(&self.body, &self.body.pose(params), &mut vertices);
        stage.add(&Mesh { vertices, faces: model.faces().to_vec() }, shade, Shading::Smooth);
    }

    /// The pelvis' way up to `frame`, laid on the floor.
    fn way(&self, frame: usize) -> Mesh {
        let points: Vec<Vec3> = self.pelvis.iter().take(frame + 1).map(|p| p.with_z(0.012)).collect();
        Mesh::tube(&points, 0.015)
    }

    /// Standing foot markers of all frames: place and whether it is the left foot.
    fn stances(&self) -> impl Iterator<Item = (Vec2, bool)> {
        let mut markers = vec![0.0; self.pelvis.len() * MARKER_DIM];
        self.body.markers_batch(self.walker.frames, &mut markers);
        let at = move |t: usize, m: usize| Vec3::from_slice(&markers[t * MARKER_DIM + 3 * m..]);
        let inner = 1..self.pelvis.len().saturating_sub(1).max(1);
        inner.flat_map(|t| FOOT_MARKERS.into_iter().enumerate().map(move |(k, m)| (t, k, m))).filter_map(move |(t, k, m)| {
            let (p, speed) = (at(t, m), (at(t + 1, m) - at(t - 1, m)).length() * 0.5 * FPS);
            (p.z < STANCE_HEIGHT && speed < STANCE_SPEED).then(|| (p.truncate(), k >= FOOT_MARKERS.len() / 2))
        })
    }
}

/// Frame of moment `i` of `count`, spread evenly over `frames` frames with both ends.
fn moment(i: usize, count: usize, frames: usize) -> usize {
    i * (frames - 1) / (count - 1).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::BETAS;
    use crate::body::tests::toy;
    use crate::scene::BoxObstacle;

    const BETAS_ZERO: [f32; BETAS] = [0.0; BETAS];

    /// A straight walk of the pelvis from (0, 0) to (2, 1), 21 frames.
    fn straight(model: &BodyModel) -> Vec<f32> {
        let rest = model.shape(&BETAS_ZERO).joints()[joint::PELVIS];
        let at = |t: usize| Vec3::new(0.1 * t as f32, 0.05 * t as f32, 0.9) - rest;
        let frame = |t: usize| at(t).to_array().into_iter().chain([0.0; PARAMS - 3]);
        (0..21).flat_map(frame).collect()
    }

    #[test]
    fn the_plan_shows_way_box_and_goal() {
        let model = toy();
        let frames = straight(&model);
        let walkers = [Walker { frames: &frames, betas: &BETAS_ZERO, goal: Some(Vec2::new(3.0, 0.0)) }];
        let block = BoxObstacle { centre: Vec2::new(1.0, -1.0), size: Vec2::new(0.8, 0.4), yaw: 0.5, height: 1.0 };
        let scene = Scene::with_boxes(4.0, vec![block]).unwrap();
        let episode = Episode { walkers: &walkers, scene: &scene, room: None, reach: 0.1 };
        let image = episode.top_view(&model, 608).unwrap();
        // The box, the way and the goal are in the picture, the far walls are not.
        let seen = block.corners().map(|p| p.as_vec2()).into_iter().chain([Vec2::ZERO, Vec2::new(2.0, 1.0), Vec2::new(3.0, 0.0)]);
        let view = TopView::around(seen, 0.3, 608).unwrap();
        let pixel = |x: f32, y: f32| {
            let at = view.pixel(Vec2::new(x, y)).as_uvec2();
            image.pixel(at.x as usize, at.y as usize)
        };
        assert_eq!(pixel(1.0, -1.0), colour::STONE);
        assert_eq!(pixel(3.0, 0.0), colour::GREEN);
        assert_eq!(pixel(0.0, 0.0), PEOPLE[0]);
        // Halfway along, the path's colour is the middle of the ramp.
        let middle = pixel(1.0, 0.5);
        assert!(middle.iter().zip(ramp(0.5)).all(|(a, b)| a.abs_diff(b) < 8), "{middle:?}");
        assert_eq!(pixel(3.0, 0.9), [226, 232, 224]);
    }

    #[test]
    fn panels_cover_the_walk() {
        let model = toy();
        let frames = straight(&model);
        let walkers = [Walker { frames: &frames, betas: &BETAS_ZERO, goal: None }];
        let episode = Episode { walkers: &walkers, scene: &Scene::default(), room: None, reach: 0.1 };
        let sheet = episode.panels(&model, 3, 3, 60, 40).unwrap();
        assert_eq!((sheet.width, sheet.height), (3 * 60 + 2 * 4, 40));
        assert_eq!((moment(0, 3, 21), moment(1, 3, 21), moment(2, 3, 21), moment(0, 1, 1)), (0, 10, 20, 0));
        // Both ends of the walk stand inside the picture.
        let camera = episode.camera(&episode.tracks(&model).unwrap(), 60, 40).unwrap();
        for p in [Vec3::ZERO, Vec3::new(2.0, 1.0, HEAD_ROOM)] {
            let (uv, _) = camera.project(p).unwrap();
            assert!(uv.cmpge(Vec2::ZERO).all() && uv.cmple(Vec2::new(60.0, 40.0)).all());
        }
        assert!(episode.ghosts(&model, 1, 60, 40).is_ok());
    }

    #[test]
    fn standing_feet_are_found() {
        let model = toy();
        let body = model.shape(&BETAS_ZERO);
        let foot = body.rest_markers()[FOOT_MARKERS[3]];
        // The left heel rests on the floor; the person stands still for 5 frames and then slides at 4 m/s for 5.
        let xs = [0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5];
        let frames: Vec<f32> = xs.iter().flat_map(|&x| (Vec3::X * x - foot).to_array().into_iter().chain([0.0; PARAMS - 3])).collect();
        let walker = Walker { frames: &frames, betas: &BETAS_ZERO, goal: None };
        let track = Track::new(&model, &walker).unwrap();
        // Frames 1 to 3: the ends have no central difference, and that of frame 4 sees the slide.
        let heels = track.stances().filter(|(p, left)| *left && p.length() < 1e-4).count();
        assert_eq!(heels, 3);
        assert!(track.stances().all(|(p, _)| FOOT_MARKERS.iter().any(|&m| (body.rest_markers()[m] - foot).truncate().distance(p) < 1e-4)));
    }

    #[test]
    fn bad_recordings_are_refused() {
        let model = toy();
        let draw = |frames: &[f32], betas: &[f32]| {
            let walkers = [Walker { frames, betas, goal: None }];
            Episode { walkers: &walkers, scene: &Scene::default(), room: None, reach: 0.1 }.top_view(&model, 200).map_err(|e| e.to_string())
        };
        assert!(draw(&[0.0; 92], &BETAS_ZERO).unwrap_err().contains("93"));
        assert!(draw(&[], &BETAS_ZERO).is_err() && draw(&[0.0; 93], &[0.0; 9]).is_err());
        assert!(draw(&[f32::NAN; 93], &BETAS_ZERO).unwrap_err().contains("walker 0: frame 0"));
        assert!(Episode { walkers: &[], scene: &Scene::default(), room: None, reach: 0.1 }.ghosts(&model, 3, 60, 40).is_err());
    }
}
