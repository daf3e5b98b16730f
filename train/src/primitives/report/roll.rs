//! Roll-outs of the prior through the simulation, person by person.

use super::measure::{Measured, Ruler, Sums};
use crate::Result;
use crate::primitives::gait::{Drift, State, displacement, place_people};
use crate::primitives::sample::normals;
use egogen::motion::primitive::ClipMarkers;
use egogen::motion::{FPS, FUTURE, LATENT, MotionSet};
use egogen::rng::stream;
use egogen::sim::{Primitives, SeedMotion, Sim};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// People who walk at a time, which bounds the memory; figures do not depend on it.
const GROUP: usize = 50;
/// Primitives after which the state of the people is looked at, the last one apart.
const LOOK: [usize; 6] = [1, 5, 11, 20, 50, 100];

/// What people did whom the prior led.
pub struct Walked {
    pub measured: Measured,
    pub drift: Vec<Drift>,
    /// How many people collapsed, by the first reason.
    pub collapsed: BTreeMap<String, usize>,
    /// Displacement of every primitive, see [`displacement`].
    pub ways: Vec<[f32; 3]>,
    /// The first people's motion.
    pub films: MotionSet,
}

/// Lets one person per start walk through `primitives` primitives.
pub fn walk(sim: &Sim, ruler: &Ruler, starts: &[SeedMotion], primitives: usize, seed: u64) -> Result<Walked> {
    let mut sums: Vec<Sums> = Vec::new();
    let mut looks: BTreeMap<usize, Vec<State>> = BTreeMap::new();
    let (mut collapsed, mut ways, mut films) = (BTreeMap::new(), Vec::new(), MotionSet::default());
    for (g, group) in starts.chunks(GROUP).enumerate() {
        let made = walk_group(sim, ruler, group, g * GROUP, primitives, seed)?;
        sums.extend((0..group.len()).into_par_iter().map(|i| ruler.measure(&made.set, i, true)).collect::<Vec<_>>());
        made.looks.into_iter().for_each(|(k, states)| looks.entry(k).or_default().extend(states));
        made.reasons.into_iter().flatten().for_each(|why| *collapsed.entry(why).or_insert(0) += 1);
        ways.extend(made.ways);
        if g == 0 {
            films = made.set;
        }
    }
    let seconds = (starts.len() * primitives * FUTURE) as f32 / FPS;
    Ok(Walked {
        measured: Measured::new("model", starts.len(), seconds, &sums),
        drift: looks.iter().map(|(k, states)| Drift::of(*k, states)).collect(),
        collapsed,
        ways,
        films,
    })
}

/// Displacements of one primitive from each of `starts`.
pub fn first_steps(sim: &Sim, starts: &[SeedMotion], seed: u64) -> Result<Vec<[f32; 3]>> {
    let mut ways = Vec::new();
    let mut out = Primitives::default();
    for (g, group) in starts.chunks(GROUP).enumerate() {
        let mut people = place_people(sim, group)?;
        sim.step(&mut people, &latents(seed, "coverage latents", g * GROUP, group.len(), 0), &mut out)?;
        ways.extend(out.frames.iter().zip(&people.frames).map(|(from, to)| displacement(from, to)));
    }
    Ok(ways)
}

struct Group {
    set: MotionSet,
    looks: Vec<(usize, Vec<State>)>,
    reasons: Vec<Option<String>>,
    ways: Vec<[f32; 3]>,
}

fn walk_group(sim: &Sim, ruler: &Ruler, starts: &[SeedMotion], first: usize, primitives: usize, seed: u64) -> Result<Group> {
    let n = starts.len();
    let mut people = place_people(sim, starts)?;
    let mut films: Vec<Vec<f32>> = vec![Vec::new(); n];
    let mut collapse = vec![None; n];
    let (mut looks, mut ways, mut out) = (Vec::new(), Vec::new(), Primitives::default());
    for k in 1..=primitives {
        sim.step(&mut people, &latents(seed, "report latents", first, n, k), &mut out)?;
        films.par_iter_mut().enumerate().for_each(|(i, film)| out.record(i, ruler.body, film));
        let mut states: Vec<State> = (0..n).into_par_iter().map(|i| State::of(&out, i, ruler.body)).collect();
        for (state, before) in states.iter_mut().zip(&mut collapse) {
            // Who has once collapsed stays so.
            *before = before.or(state.collapse);
            state.collapse = *before;
        }
        if LOOK.contains(&k) || k == primitives {
            looks.push((k, states));
        }
        ways.extend(out.frames.iter().zip(&people.frames).map(|(from, to)| displacement(from, to)));
    }
    let clips = films.into_par_iter().enumerate().map(|(i, f)| ClipMarkers::from_params(format!("person {}", first + i), ruler.body, f));
    let reasons = collapse.into_iter().map(|c| c.map(|why| format!("{why:?}").to_lowercase())).collect();
    Ok(Group { set: MotionSet { clips: clips.collect() }, looks, reasons, ways })
}

/// n x 128 normal numbers; every person and primitive has a stream of its own, however people are grouped.
fn latents(seed: u64, purpose: &str, first: usize, n: usize, k: usize) -> Vec<f32> {
    (0..n).flat_map(|i| normals(&mut stream(seed, purpose, (k as u64) << 32 | (first + i) as u64), LATENT)).collect()
}
