//! Episodes of a scenario in pictures and as motion for other programs.

use super::{Fate, Played, Setup};
use crate::Result;
use egogen::body::PARAMS;
use egogen::export::write_glb;
use egogen::metrics::box_distance;
use egogen::motion::FPS;
use egogen::motion::amass::write_amass;
use egogen::render::{Episode, Image, Walker, tile};
use egogen::scene::Scene;
use glam::Vec2;
use std::path::Path;

/// Pixels of a plan, and panels of a filmstrip.
const PLAN: usize = 300;
const PANELS: usize = 6;
const PANEL: [usize; 2] = [260, 230];

/// A person's recording, its last frame repeated until the scene's last person has ended.
struct Part<'a> {
    frames: Vec<f32>,
    betas: &'a [f32],
    goal: Vec2,
}

/// Draws (or otherwise uses) the people `who` together in the scene of the first of them.
fn together<T>(setup: &Setup, played: &[Played], who: &[usize], then: impl FnOnce(&Episode) -> egogen::Result<T>) -> Result<Option<T>> {
    let films: Vec<_> = who.iter().filter_map(|&i| played[i].film.as_ref()).collect();
    let Some(first) = films.first() else { return Ok(None) };
    let longest = films.iter().map(|f| f.frames.len()).max().unwrap_or(0);
    let part = |film: &&'_ super::Film| {
        let mut frames = film.frames.clone();
        let last = frames[frames.len() - PARAMS..].to_vec();
        while frames.len() < longest {
            frames.extend_from_slice(&last);
        }
        frames
    };
    let parts: Vec<Part> = films.iter().map(|f| Part { frames: part(f), betas: &f.betas, goal: f.setting.goal }).collect();
    let walkers: Vec<Walker> = parts.iter().map(|p| Walker { frames: &p.frames, betas: p.betas, goal: Some(p.goal) }).collect();
    let scene = standing(setup, &played[who[0]], who[0], &first.setting.scene);
    let room = setup.solids[setup.place[who[0]]].as_ref().and_then(|s| s.mesh.as_deref());
    Ok(Some(then(&Episode { walkers: &walkers, scene: &scene, room, reach: setup.env.task().success_distance })?))
}

/// The scene with what moves in it as it stood when the person was nearest to it.
fn standing(setup: &Setup, played: &Played, i: usize, scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let path = played.measured.as_ref().map_or(&[][..], |m| &m.path);
    for mover in setup.env.cast().map_or(&[][..], |cast| &cast.places[setup.place[i]].movers) {
        let at = |t: usize| mover.at(t as f32 / FPS);
        let distance = |t: usize| box_distance(&at(t), path[t].extend(0.0));
        let nearest = (0..path.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
        scene.obstacles.push(at(nearest));
    }
    scene
}

/// Ways seen from above: of all people of the first scene, of all that left the first start, or of the first six starts.
pub fn plans(setup: &Setup, played: &[Played]) -> Result<Option<Image>> {
    let body = setup.env.sim().body();
    let draw = |who: &[usize]| together(setup, played, who, |e| e.top_view(body, PLAN));
    let people = || 0..setup.place.len();
    let sets: Vec<Vec<usize>> = if setup.scenario.repeats > 1 {
        (0..3).map(|s| people().filter(|&i| setup.start[i] == s).collect()).collect()
    } else {
        setup.groups().into_iter().take(if setup.scenario.people_per_scene() > 1 { 3 } else { 6 }).collect()
    };
    let images: Vec<Image> = sets.iter().filter(|s| !s.is_empty()).filter_map(|s| draw(s).transpose()).collect::<Result<_>>()?;
    Ok((!images.is_empty()).then(|| tile(&images, 3)))
}

/// How bad an episode was: not to arrive weighs most, then to be inside others or obstacles, then what was missing.
fn badness(p: &Played) -> f32 {
    let Some(m) = &p.measured else { return 0.0 };
    let or_0 = |x: f32| if x.is_finite() { x } else { 0.0 };
    let inside = or_0(m.inside_frames) + or_0(m.obstacle_frames).max(p.figure("penetration"));
    10.0 * (1.0 - p.figure("success")) + 5.0 * inside + m.last.min(5.0)
}

/// Filmstrips of the worst episodes with what went wrong, at most `most` and one of each scene.
pub fn worst(setup: &Setup, played: &[Played], most: usize) -> Result<Vec<(Image, String)>> {
    let mut order: Vec<usize> = (0..played.len()).collect();
    order.sort_by(|&a, &b| badness(&played[b]).total_cmp(&badness(&played[a])));
    let mut shown: Vec<usize> = Vec::new();
    let mut out = Vec::new();
    let groups = setup.groups();
    for i in order {
        if out.len() == most || shown.contains(&setup.place[i]) {
            continue;
        }
        shown.push(setup.place[i]);
        // The one in question leads, for the camera follows the first.
        let mut who = groups[setup.place[i]].clone();
        who.retain(|&j| j != i);
        who.insert(0, i);
        let body = setup.env.sim().body();
        if let Some(film) = together(setup, played, &who, |e| e.panels(body, PANELS, PANELS, PANEL[0], PANEL[1]))? {
            out.push((film, told(&played[i], setup.place[i])));
        }
    }
    Ok(out)
}

/// A contact sheet: from above the first `most` episodes that did not arrive, or only through something; and how each ended.
pub fn failures(setup: &Setup, played: &[Played], most: usize) -> Result<Option<(Image, String)>> {
    let body = setup.env.sim().body();
    let failed = |p: &&Played| Fate::of(p) != Fate::Arrived;
    let (mut images, mut captions) = (Vec::new(), Vec::new());
    for p in played.iter().filter(failed).take(most) {
        if let Some(image) = together(setup, played, &[p.person], |e| e.top_view(body, PLAN))? {
            images.push(image);
            captions.push(told(p, setup.place[p.person]));
        }
    }
    let all = played.iter().filter(failed).count();
    let caption = format!("{} of {all}, row by row. {}.", images.len(), captions.join(". "));
    Ok((!images.is_empty()).then(|| (tile(&images, 4), caption)))
}

fn told(p: &Played, place: usize) -> String {
    let mut text = format!("Scene {place}, person {}: {}", p.person, p.outcome());
    if let Some(m) = p.measured.as_ref().filter(|m| m.inside_frames > 0.0) {
        text += &format!(", inside others in {:.0} % of the frames", 100.0 * m.inside_frames);
    }
    text
}

/// Writes the motion of the first `scenes` scenes to `dir`: each person's as scene-NNN-person-K.npz in AMASS's layout, and all of a scene
/// as scene-NNN.glb.
pub fn write_motions(setup: &Setup, played: &[Played], scenes: usize, dir: &Path) -> Result<()> {
    let body = setup.env.sim().body();
    for (s, group) in setup.groups().iter().enumerate().take(scenes) {
        for (k, film) in group.iter().enumerate().filter_map(|(k, &i)| Some((k, played[i].film.as_ref()?))) {
            write_amass(dir.join(format!("scene-{s:03}-person-{k}.npz")), &film.frames, &film.betas)?;
        }
        together(setup, played, group, |e| write_glb(dir.join(format!("scene-{s:03}.glb")), body, e))?;
    }
    Ok(())
}
