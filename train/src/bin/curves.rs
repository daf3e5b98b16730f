//! The program `curves`: learning curves of runs as one SVG picture, baselines as horizontal lines.

use clap::Parser;
use egogen::io::write_atomic;
use egogen_train::curves::{Baseline, Run, draw};
use egogen_train::program::{self, Given};
use egogen_train::{Error, Result};
use std::path::PathBuf;
use std::process::ExitCode;

/// Draws return, success, hover rate, final distance and KL to the prior of one or several runs.
#[derive(Debug, Parser)]
#[command(
    name = "curves",
    version,
    after_help = "Example:
  curves runs/quick runs/entropy --baselines runs/evaluation/report.json --out curves.svg"
)]
struct Args {
    /// Run folders of `train`
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// A report.json of `evaluate`, whose baselines become horizontal lines
    #[arg(long, value_name = "FILE")]
    baselines: Option<PathBuf>,
    /// The picture
    #[arg(long, value_name = "FILE", default_value = "curves.svg")]
    out: PathBuf,
}

fn main() -> ExitCode {
    program::exit(run(&Args::parse()))
}

fn run(args: &Args) -> Result<u8> {
    let runs = args.runs.iter().map(|dir| Run::read(dir)).collect::<std::result::Result<Vec<_>, _>>().given()?;
    let baselines = match &args.baselines {
        Some(path) => Baseline::read(path).given()?,
        None => vec![],
    };
    if runs.iter().all(|r| r.rows() == 0) {
        return Err(Error::config("none of the runs has a finished epoch"));
    }
    write_atomic(&args.out, draw(&runs, &baselines)?.as_bytes())?;
    Ok(0)
}
