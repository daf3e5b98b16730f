//! Packs the policy of a checkpoint into a bundle that other programs load.

use clap::Parser;
use egogen::agent::authors::read_policy;
use egogen::agent::bundle::{Bundle, Trained};
use egogen::io::Precision;
use egogen::motion::MotionWeights;
use egogen::torch::is_checkpoint;
use egogen_train::checkpoint::list;
use egogen_train::program::{self, Given};
use egogen_train::trainer::export;
use egogen_train::{Error, Result};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Checks a checkpoint and packs its policy: policy.json and policy.safetensors (half precision, means and standard deviations of observations single).
#[derive(Debug, Parser)]
#[command(
    name = "export",
    version,
    after_help = "Examples:
  export runs/quick --out policies/quick                          the newest checkpoint of a run
  export runs/quick/checkpoints/epoch-0020 --out policies/early   a chosen one
  export checkpoint_87.pth --model models/authors --out policies/authors   the authors' own"
)]
struct Args {
    /// A run folder, one of its checkpoints, or a checkpoint of the authors' program (.pth)
    from: PathBuf,
    /// The authors' checkpoint only: folder of the motion model that it was trained on
    #[arg(long, value_name = "DIR")]
    model: Option<PathBuf>,
    /// Folder of the bundle
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

fn main() -> ExitCode {
    program::exit(run(Args::parse()))
}

fn run(args: Args) -> Result<u8> {
    let root = args.from.join("checkpoints");
    let from = match list(&root).pop() {
        Some(newest) => root.join(newest),
        None => args.from,
    };
    match (is_checkpoint(&from) && !from.is_dir(), &args.model) {
        (true, Some(model)) => import(&from, model, &args.out).given()?,
        (true, None) => return Err(Error::config("--model is missing: a checkpoint of the authors does not name its motion model")),
        (false, Some(_)) => return Err(Error::config("--model is for checkpoints of the authors; a run names its motion model itself")),
        (false, None) => export(&from, &args.out)?,
    }
    eprintln!("{} packed into {}", from.display(), args.out.display());
    Ok(0)
}

/// Packs the authors' policy in the checkpoint `from`, trained on the motion model in the folder `model`, in single precision.
fn import(from: &Path, model: &Path, to: &Path) -> egogen::Result<()> {
    let (spec, params) = read_policy(from)?;
    let weights = MotionWeights::load(model)?;
    let origin = [("motion", weights.hash), ("body", weights.config.body)].map(|(what, hash)| (what.to_string(), hash)).into();
    Bundle::with_precision(spec, &params, origin, Trained::default(), Precision::Full)?.write(to)
}
