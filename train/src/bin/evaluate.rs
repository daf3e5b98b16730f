//! The program `evaluate`: policies and baselines on the same held-out starts.

use clap::Parser;
use egogen::agent::bundle::Bundle;
use egogen::io::write_atomic;
use egogen_envs::motion::MotionEnv;
use egogen_train::evaluate::{Actor, Greedy, Row, play, table};
use egogen_train::program::{self, Given};
use egogen_train::{Error, Result};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

/// Plays policies and baselines from the same held-out starts and reports figures with 95 % intervals.
#[derive(Debug, Parser)]
#[command(
    name = "evaluate",
    version,
    after_help = "Examples:
  evaluate checkpoints/policy/quick --out runs/evaluation     a policy beside the three baselines
  evaluate runs/quick/policy runs/other/policy --episodes 500
  evaluate --set scene.kind=open --set scene.min_distance=2     baselines where nothing is in the way

Exit codes: 0 done, 1 failed while running, 2 bad usage, task, model or policy."
)]
struct Args {
    /// Policy bundles; each is played with its noise and with its mean action
    policies: Vec<PathBuf>,
    /// Starts, the same for everyone
    #[arg(long, default_value = "200")]
    episodes: NonZeroUsize,
    /// Seed of the starts and of all noise
    #[arg(long, default_value_t = 2024)]
    seed: u64,
    /// Folder of a motion model instead of the shipped one
    #[arg(long, value_name = "DIR")]
    model: Option<PathBuf>,
    /// Change a value of the walking task, e.g. scene.kind=open; repeatable
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    set: Vec<String>,
    /// Leave the baselines out
    #[arg(long)]
    no_baselines: bool,
    /// Folder for report.json and report.md
    #[arg(long, value_name = "DIR", default_value = "runs/evaluation")]
    out: PathBuf,
}

fn main() -> ExitCode {
    program::exit(run(&Args::parse()))
}

fn run(args: &Args) -> Result<u8> {
    let episodes = args.episodes.get();
    let world = program::world(args.model.as_deref())?;
    let task = program::task(&args.set)?;
    let mut env = MotionEnv::evaluation(task, world.sim.clone(), world.held_out.clone(), episodes, args.seed).given()?;
    let mut actors: Vec<(String, Actor)> = Vec::new();
    if !args.no_baselines {
        actors.push(("latents 0".into(), Actor::Zero));
        actors.push(("latents N(0, I)".into(), Actor::Prior));
        let greedy = Greedy::default();
        actors.push((format!("greedy, best of {}", greedy.candidates), Actor::Greedy(greedy)));
    }
    for dir in &args.policies {
        let bundle = Bundle::read(dir).given()?;
        let name = if bundle.trained.recipe.is_empty() { dir.display().to_string() } else { bundle.trained.recipe.clone() };
        for (noise, how) in [(true, "stochastic"), (false, "deterministic")] {
            let actor = Actor::policy(&bundle, &env, noise).map_err(|e| Error::config(format!("policy {}: {e}", dir.display())))?;
            actors.push((format!("{name}, {how}"), actor));
        }
    }
    let mut rows = Vec::new();
    for (name, actor) in &actors {
        eprintln!("{name}: {episodes} episodes");
        rows.push(Row::new(name, &play(&mut env, actor, args.seed, false)?));
    }
    let text = table(&rows);
    println!("{text}");
    let json = serde_json::json!({
        "episodes": episodes, "seed": args.seed, "task": env.task(), "origin": world.origin(), "rows": rows,
    });
    write_atomic(args.out.join("report.json"), format!("{json:#}").as_bytes())?;
    write_atomic(args.out.join("report.md"), text.as_bytes())?;
    Ok(0)
}
