//! What measuring penetration takes of a step in rooms, the motion model included: the same people in the same rooms step with it and
//! without it in turns. They walk by the shipped policy, or wander by the motion model's prior, also through walls.
//!
//! The best of several rounds counts; all threads work.

use egogen::agent::bundle::Bundle;
use egogen::kernels::PolicyEngine;
use egogen::rng::stream;
use egogen::scene::{CrowdedScenes, PairOptions};
use egogen::sim::World;
use egogen_envs::motion::{MotionEnv, MotionTask, Penetration, Weights};
use egogen_envs::{StepResult, VecEnv};
use rand_distr::{Distribution, StandardNormal};
use std::path::Path;
use std::time::Instant;

const PEOPLE: usize = 256;
const ROUNDS: usize = 3;
/// Steps of one round: an episode.
const STEPS: u64 = 13;
/// How penetration is measured: name, points, weight.
const CASES: [(&str, usize, f32); 3] = [("not measured", 2000, 0.0), ("2,000 points", 2000, 1.0), ("all vertices", 0, 1.0)];

fn env(world: &World, points: usize, weight: f32, latents: Option<usize>) -> MotionEnv {
    let rooms = CrowdedScenes { count: 16, pairs: PairOptions { count: 32, ..Default::default() }, ..Default::default() };
    let task = MotionTask {
        rooms: Some(rooms),
        weights: Weights { penetration: weight, pose: 0.0, ..Default::default() },
        penetration: Penetration { points, ..Default::default() },
        max_depth: STEPS as u32,
        latents,
        ..Default::default()
    };
    MotionEnv::new(task, world.sim.clone(), world.train.clone(), PEOPLE, 1).expect("a valid task")
}

/// Times the cases under actions that `act` chooses from observations at a step.
fn time(name: &str, mut envs: [MotionEnv; 3], act: impl Fn(&[f32], u64) -> Vec<f32>) {
    let (mut best, mut out, mut obs) = ([f64::INFINITY; 3], StepResult::default(), Vec::new());
    for _ in 0..ROUNDS {
        let mut seconds = [0.0; 3];
        for step in 0..STEPS {
            envs[0].observe(&mut obs).expect("observations");
            let actions = act(&obs, step);
            for (env, seconds) in envs.iter_mut().zip(&mut seconds) {
                let start = Instant::now();
                env.step(&actions, &mut out).expect("a step");
                *seconds += start.elapsed().as_secs_f64();
            }
        }
        best.iter_mut().zip(seconds).for_each(|(best, s)| *best = best.min(s));
    }
    println!("{name:<24}{:>12}{:>14}", "ms a step", "of it");
    for ((case, ..), seconds) in CASES.iter().zip(best) {
        println!("  {case:<22}{:>12.1}{:>13.1}%", 1e3 * seconds / STEPS as f64, 100.0 * (seconds - best[0]) / seconds);
    }
}

fn main() {
    let world = World::embedded().expect("the shipped model");
    let bundle = Bundle::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/policy/quick"))).expect("the shipped policy");
    let (engine, k) = (PolicyEngine::new(&bundle.spec, &bundle.params).expect("shapes"), bundle.spec.action.count());
    println!("{PEOPLE} people, {} threads", rayon::current_num_threads());
    time("the shipped policy", CASES.map(|(_, points, weight)| env(&world, points, weight, Some(k))), |obs, _| {
        let mut out = vec![0.0; PEOPLE * engine.output_dim()];
        engine.forward(obs, &mut out).expect("lengths");
        out.chunks_exact(engine.output_dim()).flat_map(|row| &row[..k]).copied().collect()
    });
    let dim = world.sim.model().latent_dim();
    time("the prior", CASES.map(|(_, points, weight)| env(&world, points, weight, None)), |_, step| {
        StandardNormal.sample_iter(stream(2, "bench", step)).take(PEOPLE * dim).collect()
    });
}
