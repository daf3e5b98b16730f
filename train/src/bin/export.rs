//! Packs the policy of a checkpoint into a bundle that other programs load.

use clap::Parser;
use egogen_train::checkpoint::list;
use egogen_train::program;
use egogen_train::trainer::export;
use std::path::PathBuf;
use std::process::ExitCode;

/// Checks a checkpoint and packs its policy: policy.json and policy.safetensors (half precision).
#[derive(Debug, Parser)]
#[command(
    name = "export",
    version,
    after_help = "Examples:
  export runs/quick --out policies/quick                          the newest checkpoint of a run
  export runs/quick/checkpoints/epoch-0020 --out policies/early   a chosen one"
)]
struct Args {
    /// A run folder or one of its checkpoints
    from: PathBuf,
    /// Folder of the bundle
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let root = args.from.join("checkpoints");
    let from = match list(&root).pop() {
        Some(newest) => root.join(newest),
        None => args.from,
    };
    program::exit(export(&from, &args.out).map(|()| {
        eprintln!("{} packed into {}", from.display(), args.out.display());
        0
    }))
}
