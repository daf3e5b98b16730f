//! Seeds for the walking task, made by the model itself.

use super::eval::start_people;
use super::sample::normals;
use egogen::Result;
use egogen::body::{BETAS, MARKER_DIM, PARAMS};
use egogen::metrics::foot_heights;
use egogen::motion::{LATENT, MotionSet, SEED};
use egogen::rng::stream;
use egogen::sim::{Primitives, SeedBank, SeedMotion, Sim};

/// Seeds in a bank; the first half is for training, the second for evaluation.
const SEEDS: usize = 512;
/// Primitives before a seed is taken: each person one of these counts.
const PRIMITIVES: std::ops::Range<usize> = 2..7;
/// A seed's lowest foot marker stands within this of the floor, metres.
const FLOOR: f32 = 0.04;

/// Seeds from prior roll-outs that started in recorded motion of `set`.
pub fn make_seeds(sim: &Sim, set: &MotionSet) -> Result<SeedBank> {
    // More people than seeds, for some may not stand on the floor.
    let n = SEEDS + SEEDS / 2;
    let mut people = start_people(sim, set, n, "seed starts", |_| 0.0)?;
    let mut out = Primitives::default();
    let mut made: Vec<Option<SeedMotion>> = vec![None; n];
    for k in 1..PRIMITIVES.end {
        sim.step(&mut people, &normals(&mut stream(0, "seed latents", k as u64), n * LATENT), &mut out)?;
        for i in (0..n).filter(|i| PRIMITIVES.start + i % PRIMITIVES.len() == k) {
            let markers = &people.markers[i * SEED * MARKER_DIM..(i + 1) * SEED * MARKER_DIM];
            if foot_heights(markers).all(|z| z.abs() < FLOOR) {
                let params = people.params[i * SEED * PARAMS..(i + 1) * SEED * PARAMS].to_vec();
                made[i] = Some(SeedMotion { params, betas: [0.0; BETAS] });
            }
        }
    }
    Ok(SeedBank { seeds: made.into_iter().flatten().take(SEEDS).collect() })
}
