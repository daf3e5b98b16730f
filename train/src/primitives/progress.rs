//! What a run says while it runs: a bar (or lines, away from a terminal), CSV files and TensorBoard.

use super::fit::Stage;
use crate::Result;
use crate::logger::Logger;
use crate::tensorboard::TensorBoard;
use egogen::Error;
use egogen::io::write_atomic;
use indicatif::{ProgressBar, ProgressStyle};
use std::fs::{self, File, OpenOptions};
use std::io::{IsTerminal, Write, stderr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Time between lines away from a terminal.
const LINE_EVERY: Duration = Duration::from_secs(15);
/// Updates between CSV rows.
const ROW_EVERY: u64 = 20;

/// Progress of one stage.
pub struct Progress {
    stage: Stage,
    names: &'static [&'static str],
    bar: Option<ProgressBar>,
    path: PathBuf,
    file: File,
    start: Instant,
    first: f64,
    line: Instant,
    /// Running means of the figures.
    mean: Vec<f64>,
    board: TensorBoard,
}

impl Progress {
    /// Progress of `stage`; goes on with `<stage>.csv` in `out` if the stage goes on at `step` > 0.
    pub fn new(out: &Path, stage: Stage, step: u64) -> Result<Self> {
        let names: &[&str] = match stage {
            Stage::Body => &["loss", "marker_distance"],
            _ => &["reconstruction", "velocity", "kl", "skate", "contact"],
        };
        let path = out.join(format!("{}.csv", format!("{stage:?}").to_lowercase()));
        fs::create_dir_all(out).map_err(|e| Error::io(out, e))?;
        let header = format!("step,rate,{}\n", names.join(","));
        // Rows after the state that a continued stage goes on from will come again.
        let kept = if step > 0 { fs::read_to_string(&path).unwrap_or_default() } else { String::new() };
        let earlier = |row: &&str| row.split(',').next().and_then(|s| s.parse().ok()).is_some_and(|s: u64| s <= step);
        let rows: String = kept.lines().filter(earlier).flat_map(|row| [row, "\n"]).collect();
        write_atomic(&path, (header + &rows).as_bytes())?;
        let file = OpenOptions::new().append(true).open(&path).map_err(|e| Error::io(&path, e))?;
        let bar = stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{prefix:8} {wide_bar} {percent}% {msg}").unwrap_or(ProgressStyle::default_bar());
            ProgressBar::new(1000).with_style(style).with_prefix(format!("{stage:?}"))
        });
        let now = Instant::now();
        let board = TensorBoard::new(&out.join("tensorboard"))?;
        Ok(Self { stage, names, bar, path, file, start: now, first: f64::NAN, line: now, mean: Vec::new(), board })
    }

    /// Takes note of the distance from held-out motion after update `step`: of the posterior mean, mm, over all frames and in the last.
    pub fn held_out(&mut self, step: u64, distance: [f32; 2]) -> Result<()> {
        self.scalars(step, &["held_out_mm", "held_out_last_mm"], &distance.map(f64::from))
    }

    fn scalars(&mut self, step: u64, names: &[&str], values: &[f64]) -> Result<()> {
        let stage = format!("{:?}", self.stage).to_lowercase();
        let row = names.iter().zip(values).map(|(n, v)| (format!("{stage}/{n}"), Some(*v))).collect();
        self.board.log(step, &row)
    }

    /// Takes note of update `step`; `fraction` of the stage is done.
    pub fn step(&mut self, step: u64, fraction: f64, rate: f32, figures: &[f32]) -> Result<()> {
        if self.mean.is_empty() {
            self.mean = figures.iter().map(|&v| v as f64).collect();
            self.first = fraction;
        }
        self.mean.iter_mut().zip(figures).for_each(|(m, v)| *m += 0.03 * (*v as f64 - *m));
        if step.is_multiple_of(ROW_EVERY) {
            let figures: Vec<String> = self.mean.iter().map(|v| format!("{v:.6}")).collect();
            writeln!(self.file, "{step},{rate:.3e},{}", figures.join(",")).map_err(|e| Error::io(&self.path, e))?;
            self.scalars(step, self.names, &self.mean.clone())?;
        }
        if let Some(bar) = &self.bar {
            bar.set_position((1000.0 * fraction) as u64);
            bar.set_message(self.message(step, fraction));
        } else if self.line.elapsed() > LINE_EVERY {
            self.line = Instant::now();
            eprintln!("{:?} {:3.0}% {}", self.stage, 100.0 * fraction, self.message(step, fraction));
        }
        Ok(())
    }

    fn message(&self, step: u64, fraction: f64) -> String {
        let left = self.start.elapsed().as_secs_f64() * (1.0 - fraction) / (fraction - self.first).max(1e-9);
        let figures: Vec<String> = self.names.iter().zip(&self.mean).map(|(n, v)| format!("{n} {v:.5}")).collect();
        let left = if left < 360_000.0 { format!("{:.0} s", left) } else { "?".into() };
        format!("update {step}, {}, {left} left", figures.join(", "))
    }
}
