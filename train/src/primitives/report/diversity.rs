//! How different the motions are that follow on one beginning.

use super::measure::family;
use crate::Result;
use crate::evaluate::{Estimate, mean};
use crate::primitives::gait::place_people;
use crate::primitives::sample::normals;
use egogen::body::MARKER_DIM;
use egogen::metrics::average_pairwise_distance;
use egogen::motion::{FRAMES, LATENT, MotionSet, SEED};
use egogen::rng::stream;
use egogen::sim::{Primitives, SeedMotion, Sim};
use glam::Vec3;
use rand::RngExt;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// Most beginnings that are looked at.
pub const QUERIES: usize = 100;
/// Continuations of each.
pub const SAMPLES: usize = 16;
/// Frames between the beginnings that are compared in recordings.
const STRIDE: usize = 2;
const SEED_DIM: usize = SEED * MARKER_DIM;

/// Average pairwise distance, mm per marker, of continuations of a beginning; mean over beginnings with a 95 % interval.
#[derive(Clone, Debug, Serialize)]
pub struct Diversity {
    pub name: String,
    /// Over the 18 frames, and in the last.
    pub frames: Option<Estimate>,
    pub last: Option<Estimate>,
    /// The same of the two frames that the continuations follow on: 0 for the model, which continues one and the same.
    pub beginnings: Option<Estimate>,
}

/// [Over all frames, in the last, of the beginnings] of n x 20 x 201 markers.
fn distances(windows: &[f32], n: usize) -> [f32; 3] {
    let part = |range: std::ops::Range<usize>| -> f32 {
        let cut = |w: &[f32]| w[range.start * MARKER_DIM..range.end * MARKER_DIM].to_vec();
        let samples: Vec<f32> = windows.chunks_exact(FRAMES * MARKER_DIM).flat_map(cut).collect();
        1000.0 * average_pairwise_distance(&samples, n)
    };
    [part(SEED..FRAMES), part(FRAMES - 1..FRAMES), part(0..SEED)]
}

impl Diversity {
    fn new(name: &str, each: &[[f32; 3]]) -> Self {
        let column = |k: usize| mean(&each.iter().map(|d| d[k]).collect::<Vec<_>>());
        Self { name: name.into(), frames: column(0), last: column(1), beginnings: column(2) }
    }

    /// Of the model: [`SAMPLES`] latents of the prior from each of `starts`.
    pub fn sampled(name: &str, sim: &Sim, starts: &[SeedMotion], seed: u64) -> Result<Self> {
        let mut out = Primitives::default();
        let mut each = Vec::new();
        for (i, start) in starts.iter().enumerate() {
            let mut people = place_people(sim, std::slice::from_ref(start))?.select(&[0; SAMPLES]);
            sim.step(&mut people, &normals(&mut stream(seed, "diversity latents", i as u64), SAMPLES * LATENT), &mut out)?;
            each.push(distances(&out.markers, SAMPLES));
        }
        Ok(Self::new(name, &each))
    }

    /// Of recordings: `count` primitives are drawn from `queries`; the recordings in `set`, the query's own one apart, give the
    /// window each that begins most alike (mean distance of the markers), and the [`SAMPLES`] nearest of them are its continuations.
    pub fn recorded(name: &str, queries: &MotionSet, count: usize, set: &MotionSet, seed: u64) -> Self {
        let windows = set.windows(FRAMES, STRIDE);
        let mut seeds = vec![0.0; windows.len() * SEED_DIM];
        seeds.par_chunks_mut(SEED_DIM).zip(&windows).for_each(|(to, &(clip, t))| set.canonical_window(clip, t, SEED, to));
        let from = queries.windows(FRAMES, 1);
        if from.is_empty() || windows.is_empty() {
            return Self::new(name, &[]);
        }
        let each = (0..count).into_par_iter().filter_map(|i| {
            let (clip, t) = from[stream(seed, "diversity queries", i as u64).random_range(0..from.len())];
            let mut query = [0.0; SEED_DIM];
            queries.canonical_window(clip, t, SEED, &mut query);
            let near = nearest(set, &windows, &seeds, &query, family(&queries.clips[clip].name));
            let mut found = vec![0.0; near.len() * FRAMES * MARKER_DIM];
            for (to, (clip, t)) in found.chunks_exact_mut(FRAMES * MARKER_DIM).zip(&near) {
                set.canonical_window(*clip, *t, FRAMES, to);
            }
            (near.len() > 1).then(|| distances(&found, near.len()))
        });
        Self::new(name, &each.collect::<Vec<_>>())
    }
}

/// The windows that begin most like `query`, one per recording other than `own`.
fn nearest(set: &MotionSet, windows: &[(usize, usize)], seeds: &[f32], query: &[f32], own: &str) -> Vec<(usize, usize)> {
    let mut best: BTreeMap<&str, (f32, (usize, usize))> = BTreeMap::new();
    for (seed, &(clip, t)) in seeds.chunks_exact(SEED_DIM).zip(windows) {
        let recording = family(&set.clips[clip].name);
        if recording == own {
            continue;
        }
        let points = seed.chunks_exact(3).zip(query.chunks_exact(3));
        let distance: f32 = points.map(|(a, b)| Vec3::from_slice(a).distance(Vec3::from_slice(b))).sum();
        let entry = best.entry(recording).or_insert((f32::INFINITY, (clip, t)));
        if distance < entry.0 {
            *entry = (distance, (clip, t));
        }
    }
    let mut found: Vec<_> = best.into_values().collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.into_iter().take(SAMPLES).map(|(_, window)| window).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::motion::primitive::{ClipMarkers, JOINT_DIM};

    /// A clip of 20 frames whose markers all stand at `x` in the first two frames and at `end` then; its canonical frame is the world.
    fn clip(name: &str, x: f32, end: f32) -> ClipMarkers {
        let markers = (0..FRAMES).flat_map(|t| [if t < SEED { x } else { end }, 0.0, 1.0].repeat(MARKER_DIM / 3)).collect();
        let mut frame = vec![0.0; JOINT_DIM];
        frame[2] = 0.9;
        frame[3..6].copy_from_slice(&[-0.1, 0.0, 0.8]);
        frame[6..9].copy_from_slice(&[0.1, 0.0, 0.8]);
        ClipMarkers { name: name.into(), markers, params: vec![0.0; FRAMES * egogen::body::PARAMS], joints: frame.repeat(FRAMES) }
    }

    #[test]
    fn neighbours_are_other_recordings_that_begin_alike() {
        let set = MotionSet {
            clips: vec![clip("a", 0.0, 0.0), clip("a~bent", 0.0, 9.0), clip("b", 0.01, 0.3), clip("b~x", 0.5, 7.0), clip("c", 0.03, 0.1)],
        };
        let query = MotionSet { clips: vec![clip("a~mirror", 0.0, 0.0)] };
        // Of b the first window, of c its only one: 20 cm apart, after beginnings 2 cm apart.
        let d = Diversity::recorded("data", &query, 3, &set, 0);
        let value = |e: Option<Estimate>| e.unwrap().value;
        assert!(
            (value(d.frames) - 200.0).abs() < 1e-2 && (value(d.last) - 200.0).abs() < 1e-2 && (value(d.beginnings) - 20.0).abs() < 1e-2
        );
        assert!(Diversity::recorded("none", &query, 3, &query, 0).frames.is_none());
    }
}
