//! The program `evaluate`: policies and baselines on the same held-out starts.

use clap::Parser;
use egogen::agent::bundle::Bundle;
use egogen::io::write_atomic;
use egogen_train::evaluate::{
    Actor, Greedy, Outcome, Played, Row, Scenario, Setup, add_meanings, add_scenario, differences, shipped, table, write_motions,
};
use egogen_train::html::Page;
use egogen_train::program::{self, Given};
use egogen_train::{Error, Result};
use serde_json::{Value, json};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

/// Layout of report.json; counts up when it changes.
const FORMAT: u32 = 2;

/// Plays policies and baselines from the same held-out starts and reports figures with 95 % intervals.
#[derive(Debug, Parser)]
#[command(
    name = "evaluate",
    version,
    after_help = "Examples:
  evaluate checkpoints/policy/quick --out runs/evaluation     a policy beside the three baselines
  evaluate checkpoints/policy/quick --scenario circle-4 --scenario moving
  evaluate checkpoints/policy/quick --scenario all --scenario mine.toml --scenario scenes/office
  evaluate runs/quick/policy runs/other/policy --episodes 500
  evaluate --set scene.kind=open --set scene.min_distance=2     baselines where nothing is in the way

Exit codes: 0 done, 1 failed while running, 2 bad usage, task, model or policy."
)]
struct Args {
    /// Policy bundles; each is played with its noise and with its mean action
    policies: Vec<PathBuf>,
    /// What is played: box (the walking task, without any other the only one), midpoint, moving, circle-2, circle-4, circle-8,
    /// circle-16, rooms, rooms-two, all (these nine), a TOML file of one's own or the folder of a scene bundle; repeatable
    #[arg(long = "scenario", value_name = "NAME|FILE|DIR", default_values = ["box"])]
    scenarios: Vec<String>,
    /// Episodes of each scenario, the same for everyone, instead of as many as it says
    #[arg(long)]
    episodes: Option<NonZeroUsize>,
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
    /// Each policy once more without egosensing: every ray at its full length
    #[arg(long)]
    blind: bool,
    /// Write the motion of the first N scenes of every scenario and policy to OUT/motions: npz in AMASS's layout of each person, glTF of
    /// each scene
    #[arg(long, value_name = "N", default_value_t = 0)]
    motions: usize,
    /// Folder for report.html, report.json and report.md
    #[arg(long, value_name = "DIR", default_value = "runs/evaluation")]
    out: PathBuf,
}

fn main() -> ExitCode {
    program::exit(run(&Args::parse()))
}

fn run(args: &Args) -> Result<u8> {
    let world = program::world(args.model.as_deref())?;
    let task = program::task(&args.set)?;
    let mut setups = scenarios(args)?.into_iter().map(|s| Setup::new(s, &task, &world, args.seed)).collect::<Result<Vec<_>>>()?;
    let actors = actors(args, &setups)?;
    // Policies are compared with the first of them, baselines alone with the first baseline.
    let reference = actors.iter().position(|(_, a)| matches!(a, Actor::Policy { .. })).unwrap_or(0);
    let mut page = Page::new("Evaluation");
    page.code(&std::env::args().collect::<Vec<_>>().join(" "));
    let (mut text, mut told) = (String::new(), Vec::new());
    for setup in &mut setups {
        let played = play_all(args, setup, &actors)?;
        let rows: Vec<Row> = actors.iter().zip(&played).map(|((name, _), p)| Row::new(name, p)).collect();
        let differences: Vec<_> = played.iter().map(|p| differences(p, &played[reference])).collect();
        let outcome = Outcome { setup, rows: &rows, played: &played, differences: &differences, reference };
        add_scenario(&mut page, &outcome)?;
        let s = &setup.scenario;
        text += &format!("## {}\n\n{}. {} episodes.\n\n{}", s.name, s.about, setup.place.len(), table(&rows));
        let others = rows.iter().zip(differences).filter(|(row, _)| row.name != rows[reference].name);
        let others: Vec<_> = others.map(|(row, d)| json!({"name": row.name, "less": rows[reference].name, "figures": d})).collect();
        let head =
            json!({"name": s.name, "scenario": s, "task": setup.env.task(), "scenes": setup.solids.len(), "episodes": setup.place.len()});
        told.push(merged(head, json!({"rows": rows, "differences": others})));
        // What is known so far, for what comes may take long.
        let report = json!({"format": FORMAT, "seed": args.seed, "origin": world.origin(), "scenarios": told});
        write_atomic(args.out.join("report.json"), format!("{report:#}").as_bytes())?;
        write_atomic(args.out.join("report.md"), text.as_bytes())?;
    }
    println!("{text}");
    add_meanings(&mut page);
    write_atomic(args.out.join("report.html"), page.finish().as_bytes())?;
    Ok(0)
}

/// Everybody's episodes of a scenario, by policy; writes the motion of as many scenes as is asked for.
fn play_all(args: &Args, setup: &mut Setup, actors: &[(String, Actor)]) -> Result<Vec<Vec<Played>>> {
    let mut all = Vec::new();
    for (name, actor) in actors {
        eprintln!("{}: {name}, {} episodes", setup.scenario.name, setup.place.len());
        let played = setup.play(actor, args.seed)?;
        let plain: String = name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '.' { c } else { '-' }).collect();
        let dir = args.out.join("motions").join(&setup.scenario.name).join(plain);
        write_motions(setup, &played, args.motions, &dir)?;
        all.push(played);
    }
    Ok(all)
}

/// Both objects' entries in one.
fn merged(mut a: Value, b: Value) -> Value {
    if let (Some(a), Value::Object(b)) = (a.as_object_mut(), b) {
        a.extend(b);
    }
    a
}

/// The scenarios asked for, each once.
fn scenarios(args: &Args) -> Result<Vec<Scenario>> {
    let mut found: Vec<Scenario> = Vec::new();
    for name in &args.scenarios {
        let names: Vec<&str> = if name == "all" { shipped().collect() } else { vec![name] };
        for scenario in names.into_iter().map(Scenario::find) {
            let scenario = match args.episodes {
                Some(n) => scenario?.with_episodes(n.get()),
                None => scenario?,
            };
            match found.iter().find(|s| s.name == scenario.name) {
                Some(same) if *same != scenario => return Err(Error::config(format!("two scenarios are called '{}'", scenario.name))),
                Some(_) => {}
                None => found.push(scenario),
            }
        }
    }
    Ok(found)
}

/// Baselines and policies by name.
fn actors(args: &Args, setups: &[Setup]) -> Result<Vec<(String, Actor)>> {
    let mut actors: Vec<(String, Actor)> = Vec::new();
    if !args.no_baselines {
        actors.push(("latents 0".into(), Actor::Zero));
        actors.push(("latents N(0, I)".into(), Actor::Prior));
        let greedy = Greedy::default();
        actors.push((format!("greedy, best of {}", greedy.candidates), Actor::Greedy(greedy)));
    }
    let bundles: Vec<Bundle> = args.policies.iter().map(|dir| Bundle::read(dir).given()).collect::<Result<_>>()?;
    for (dir, bundle) in args.policies.iter().zip(&bundles) {
        // By its recipe where that tells which one it is, else by its folder.
        let recipe = &bundle.trained.recipe;
        let unique = bundles.iter().filter(|b| b.trained.recipe == *recipe).count() == 1;
        let name = if unique && !recipe.is_empty() { recipe.clone() } else { dir.display().to_string() };
        let ways = [(true, false, "stochastic"), (false, false, "deterministic"), (false, true, "deterministic, no egosensing")];
        for (noise, blind, how) in ways.into_iter().filter(|way| args.blind || !way.1) {
            let refused = |e| Error::config(format!("policy {}: {e}", dir.display()));
            let mut actor = Actor::policy(bundle, &setups[0].env, noise).map_err(refused)?;
            if blind {
                actor = actor.blind();
            }
            actors.push((format!("{name}, {how}"), actor));
        }
    }
    Ok(actors)
}
