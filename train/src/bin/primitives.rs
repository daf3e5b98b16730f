//! Trains, judges and imports the motion-primitive model.

use clap::{Args, Parser, Subcommand};
use egogen::body::BodyModel;
use egogen::io::{Tensors, write_atomic};
use egogen::kernels::MotionEngine;
use egogen::motion::{self, MotionSet, MotionWeights, PosePrior, authors};
use egogen::sim::Sim;
use egogen_train::primitives::bodies;
use egogen_train::primitives::eval::{Effort, evaluate};
use egogen_train::primitives::export::Export;
use egogen_train::primitives::fit::{Outcome, Run};
use egogen_train::primitives::pose;
use egogen_train::primitives::report::Command as Report;
use egogen_train::primitives::seeds::make_seeds;
use egogen_train::primitives::settings::Settings;
use egogen_train::program::{self, Given, INTERRUPTED};
use egogen_train::{Error, Result};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Trains, judges and imports the motion-primitive model.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train the marker predictor and the body regressor, judge them, and write seeds for the walking task.
    Train(Train),
    /// Judge a motion model again and write metrics.json into its folder.
    Eval(Eval),
    /// Measure a motion model beside recordings: report.json and report.html.
    Report(Report),
    /// Write a motion as animated glTF (.glb), in AMASS's layout (.npz) and as a filmstrip (.png).
    Export(Export),
    /// Train a pose prior (VPoser's form) on the recorded poses, choose its threshold, and judge it.
    Pose(Pose),
    /// Compare a regressor that is told the body's shape with regressors of one body each.
    Bodies(Bodies),
    /// Write seeds.safetensors, seeds for the walking task made by the model, into its folder.
    Seeds(Seeds),
    /// Make a motion-model folder of the authors' own networks (PyTorch checkpoints) and the body they were trained on.
    Import(Import),
}

#[derive(Args)]
struct Import {
    /// Checkpoint of the marker predictor, e.g. epoch-400.ckp.
    #[arg(long, value_name = "FILE")]
    predictor: PathBuf,
    /// Checkpoint of the body regressor of the body's gender, e.g. epoch-100.ckp.
    #[arg(long, value_name = "FILE")]
    regressor: PathBuf,
    /// The body whose markers they have learned: SMPLX_{MALE,FEMALE,NEUTRAL}.npz.
    #[arg(long, value_name = "FILE")]
    body: PathBuf,
    /// Folder for motion.json, both networks and the body; `primitives seeds` then adds seeds.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Args)]
struct Eval {
    #[command(flatten)]
    data: Data,
    /// Motion-model folder.
    #[arg(long, value_name = "DIR")]
    model: PathBuf,
    /// People of the prior roll-outs.
    #[arg(long, default_value_t = EFFORT.people)]
    people: usize,
    /// Episodes of the greedy walk.
    #[arg(long, default_value_t = EFFORT.episodes)]
    episodes: usize,
}

#[derive(Args)]
struct Seeds {
    #[command(flatten)]
    data: Data,
    /// Motion-model folder.
    #[arg(long, value_name = "DIR")]
    model: PathBuf,
}

#[derive(Args)]
struct Pose {
    #[command(flatten)]
    data: Data,
    /// Folder for pose.safetensors and metrics.json.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Updates.
    #[arg(long, default_value_t = 6000)]
    steps: u64,
    /// Root of all random streams.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

#[derive(Args)]
struct Bodies {
    #[command(flatten)]
    data: Data,
    /// Updates of each regressor.
    #[arg(long, default_value_t = 3000)]
    steps: u64,
}

const EFFORT: Effort = Effort { people: 1000, episodes: 200 };

#[derive(Args)]
struct Data {
    /// Folder with the unpacked mocap-cmu and mocap-idle archives.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Seed of the data's augmentation.
    #[arg(long, default_value_t = 0)]
    data_seed: u64,
}

#[derive(Args)]
struct Train {
    #[command(flatten)]
    data: Data,
    /// Folder for weights, training state, curves and figures.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// `default` or a path ending in .toml.
    #[arg(long, default_value = "default", conflicts_with = "resume")]
    recipe: String,
    /// Change a value of the recipe; may be given several times.
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "resume")]
    set: Vec<String>,
    /// Body to train on, an asset or SMPL-X's own .npz, copied into --out; the shipped one when left out.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    body: Option<PathBuf>,
    /// Start with the networks of this motion-model folder.
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    start_from: Option<PathBuf>,
    /// Go on from the state in --out, with its settings.
    #[arg(long)]
    resume: bool,
}

fn main() -> ExitCode {
    program::exit(run(Cli::parse().command))
}

fn run(command: Command) -> Result<u8> {
    match command {
        Command::Train(args) => train(args),
        Command::Eval(args) => {
            let body = BodyModel::beside(&args.model).given()?;
            let (set, held_out, _) = motion::build(&args.data.data, args.data.data_seed, &body).given()?;
            judge(&args.model, &body, &set, &held_out, Effort { people: args.people, episodes: args.episodes })?;
            Ok(0)
        }
        Command::Report(args) => args.run(),
        Command::Export(args) => args.run(),
        Command::Pose(args) => train_pose(&args),
        Command::Bodies(args) => compare_bodies(&args),
        Command::Seeds(args) => {
            let body = BodyModel::beside(&args.model).given()?;
            let (set, ..) = motion::build(&args.data.data, args.data.data_seed, &body).given()?;
            write_seeds(&args.model, &body, &set)?;
            Ok(0)
        }
        Command::Import(args) => {
            let weights = authors::import(&args.predictor, &args.regressor, &args.body, &args.out).given()?;
            eprintln!("{}: motion model {} on body {}", args.out.display(), weights.hash, weights.config.body);
            Ok(0)
        }
    }
}

fn judge(model: &Path, body: &Arc<BodyModel>, set: &MotionSet, held_out: &MotionSet, effort: Effort) -> Result<()> {
    let report = evaluate(&MotionWeights::load(model).given()?, body, set, held_out, effort)?;
    println!("{report}");
    write_atomic(
        model.join("metrics.json"),
        format!("{}\n", serde_json::to_string_pretty(&report).map_err(|e| Error::run(e.to_string()))?).as_bytes(),
    )?;
    Ok(())
}

fn write_seeds(model: &Path, body: &Arc<BodyModel>, set: &MotionSet) -> Result<()> {
    let sim = Sim::new(body.clone(), Arc::new(MotionEngine::load(model).given()?));
    let bank = make_seeds(&sim, set)?;
    bank.write(model.join("seeds.safetensors"), body)?;
    eprintln!("{} seeds", bank.seeds.len());
    Ok(())
}

fn train(args: Train) -> Result<u8> {
    let settings = Settings::load(&args.recipe, &args.set)?;
    let body = match &args.body {
        Some(path) => Arc::new(BodyModel::load(path).given()?),
        None => BodyModel::beside(&args.out).given()?,
    };
    let (set, held_out, report) = motion::build(&args.data.data, args.data.data_seed, &body).given()?;
    if let Some(path) = &args.body {
        BodyModel::put_beside(path, &args.out).given()?;
    }
    eprintln!("{report}");
    let mut run = if args.resume {
        Run::resume(&set, &held_out, &body, &args.out).given()?
    } else {
        let fresh = Run::new(&set, &held_out, &body, settings, &args.out);
        match &args.start_from {
            Some(dir) => fresh.start_from(dir).given()?,
            None => fresh,
        }
    };
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).map_err(|e| Error::run(format!("cannot watch for Ctrl-C: {e}")))?;
    if run.train(&stop)? == Outcome::Interrupted {
        eprintln!("interrupted; state saved in {}, go on with --resume", run.folder().display());
        return Ok(INTERRUPTED);
    }
    write_seeds(run.folder(), &body, &set)?;
    judge(run.folder(), &body, &set, &held_out, EFFORT)?;
    Ok(0)
}

fn compare_bodies(args: &Bodies) -> Result<u8> {
    let body = BodyModel::embedded();
    let (set, held_out, _) = motion::build(&args.data.data, args.data.data_seed, &body).given()?;
    let settings = Settings::load("default", &[format!("steps=[1, {}, 1]", args.steps)])?;
    let bar = update_bar(args.steps);
    let compared = bodies::compare(&set, &held_out, &body, &settings, |name, step| {
        bar.set_position(step);
        bar.set_message(name.to_string());
    })?;
    bar.finish();
    println!("{}", serde_json::to_string_pretty(&compared).map_err(|e| Error::run(e.to_string()))?);
    Ok(0)
}

/// A bar over `steps` updates.
fn update_bar(steps: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {msg}, {eta} left").unwrap_or(ProgressStyle::default_bar());
    ProgressBar::new(steps).with_style(style)
}

fn train_pose(args: &Pose) -> Result<u8> {
    let body = BodyModel::embedded();
    let (set, held_out, _) = motion::build(&args.data.data, args.data.data_seed, &body).given()?;
    let bar = update_bar(args.steps);
    let tensors = pose::train(&set, args.steps, args.seed, |step, [error, divergence]| {
        bar.set_position(step);
        let text = format!("matrix error {error:.4}, {divergence:.1} nats");
        if bar.is_hidden() && step.is_multiple_of(500) {
            eprintln!("update {step}: {text}");
        }
        bar.set_message(text);
    })?;
    bar.finish();
    let unjudged = Tensors::from_bytes("the new pose prior", pose::pack(&tensors, 1.0)?)?;
    let report = pose::judge(&PosePrior::from_tensors(&unjudged)?, &held_out);
    let text = serde_json::to_string_pretty(&report).map_err(|e| Error::run(e.to_string()))?;
    println!("{text}");
    write_atomic(args.out.join("pose.safetensors"), &pose::pack(&tensors, report.threshold)?)?;
    write_atomic(args.out.join("metrics.json"), format!("{text}\n").as_bytes())?;
    Ok(0)
}
