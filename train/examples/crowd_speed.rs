//! Steps of people per second against how many there are, in one scene and in many, acting by the shipped policy.
//!
//! `cargo run --release --example crowd_speed`

use egogen::agent::bundle::Bundle;
use egogen::sim::World;
use egogen_envs::motion::MotionTask;
use egogen_envs::{StepResult, VecEnv};
use egogen_train::evaluate::{Actor, Layout, Scenario, Setup};
use std::path::Path;
use std::time::Instant;

/// Steps of everyone that are timed, after one that is not.
const STEPS: u64 = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let world = World::embedded()?;
    let bundle = Bundle::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../checkpoints/policy/quick"))?;
    println!(
        "{} threads\n\n| scenes | people each | people | steps of people per second |\n|---|---|---|---|",
        rayon::current_num_threads()
    );
    for (scenes, people) in [(1, 2), (1, 4), (1, 8), (1, 16), (16, 16), (256, 2), (256, 4), (256, 16)] {
        let layout = Layout::Circle { people, radius: 2.0, wall: 4.0 };
        let scenario = Scenario { scenes, layout, ..Scenario::find("circle-2")? };
        let mut env = Setup::new(scenario, &MotionTask::default(), &world, 0)?.env;
        let actor = Actor::policy(&bundle, &env, true)?;
        let n = env.num_envs();
        let (mut obs, mut out, mut begun) = (Vec::new(), StepResult::default(), Instant::now());
        env.reset(0, &mut obs)?;
        for step in 0..=STEPS {
            if step == 1 {
                begun = Instant::now();
            }
            let choice = actor.choose(&env, &obs, &vec![true; n], 0, step)?;
            env.step(&choice.latents, &mut out)?;
            std::mem::swap(&mut obs, &mut out.obs);
        }
        println!("| {scenes} | {people} | {n} | {:.0} |", (STEPS * n as u64) as f64 / begun.elapsed().as_secs_f64());
    }
    Ok(())
}
