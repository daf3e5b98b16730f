//! Seeds for the walking task, made by the model itself.

use super::gait::start_people;
use super::sample::normals;
use egogen::Result;
use egogen::body::{BETAS, JOINTS, MARKER_DIM, PARAMS, joint};
use egogen::metrics::foot_heights;
use egogen::motion::{FPS, LATENT, MotionSet, SEED};
use egogen::rng::stream;
use egogen::sim::{Primitives, SeedBank, SeedMotion, Sim};

/// Seeds in a bank; the first half is for training, the second for evaluation.
const SEEDS: usize = 512;
/// Primitives before a seed is taken: each person one of these counts.
const PRIMITIVES: std::ops::Range<usize> = 2..7;
/// A seed's lowest foot marker stands within this of the floor, metres.
const FLOOR: f32 = 0.05;
/// Nobody starts by walking backwards: least advance between the two frames, metres.
const ADVANCE: f32 = -0.1 / FPS;

/// Seeds from prior roll-outs that started in recorded motion of `set`.
pub fn make_seeds(sim: &Sim, set: &MotionSet) -> Result<SeedBank> {
    // More people than seeds, for some walk backwards or do not stand on the floor.
    let n = 2 * SEEDS;
    let mut people = start_people(sim, set, n, "seed starts")?;
    let mut out = Primitives::default();
    let mut made: Vec<Option<SeedMotion>> = vec![None; n];
    for k in 1..PRIMITIVES.end {
        sim.step(&mut people, &normals(&mut stream(0, "seed latents", k as u64), n * LATENT), &mut out)?;
        for i in (0..n).filter(|i| PRIMITIVES.start + i % PRIMITIVES.len() == k) {
            let markers = &people.markers[i * SEED * MARKER_DIM..(i + 1) * SEED * MARKER_DIM];
            let joints = &people.joints[i * SEED * 3 * JOINTS..(i + 1) * SEED * 3 * JOINTS];
            let advance = joints[3 * (JOINTS + joint::PELVIS) + 1] - joints[3 * joint::PELVIS + 1];
            if advance > ADVANCE && foot_heights(markers).all(|z| z.abs() < FLOOR) {
                let params = people.params[i * SEED * PARAMS..(i + 1) * SEED * PARAMS].to_vec();
                made[i] = Some(SeedMotion { params, betas: [0.0; BETAS] });
            }
        }
    }
    Ok(SeedBank { seeds: made.into_iter().flatten().take(SEEDS).collect() })
}
