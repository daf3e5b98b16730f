//! The program `curves`: learning curves of runs as one SVG picture, baselines as horizontal lines.

use anyhow::{Context, Result, bail};
use clap::Parser;
use egogen::io::write_atomic;
use egogen_train::curves::{Baseline, Run, draw};
use std::path::PathBuf;

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

fn main() -> Result<()> {
    let args = Args::parse();
    let runs = args.runs.iter().map(|dir| Run::read(dir)).collect::<Result<Vec<_>, _>>()?;
    let baselines = match &args.baselines {
        Some(path) => Baseline::read(path)?,
        None => vec![],
    };
    if runs.iter().all(|r| r.rows() == 0) {
        bail!("none of the runs has a finished epoch");
    }
    let svg = draw(&runs, &baselines).context("drawing")?;
    Ok(write_atomic(&args.out, svg.as_bytes())?)
}
