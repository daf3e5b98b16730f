//! Where figures go: CSV files, TensorBoard, the terminal.

use crate::stats::Row;
use crate::{Error, Result};
use indicatif::{ProgressBar, ProgressStyle};
use std::fs::{File, OpenOptions};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use tensorboard_rs::summary_writer::SummaryWriter;

/// Receives the figures of every epoch.
pub trait Logger {
    /// `epoch` counts from 1; `row` has the same names in every call.
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()>;
}

/// A CSV file, one line per epoch, flushed at once.
pub struct Csv {
    path: PathBuf,
    file: File,
    header: bool,
}

impl Csv {
    /// Opens `path`, keeping the lines of epochs up to `epoch` (those after the checkpoint that a run continues from are dropped).
    pub fn open(path: &Path, epoch: u64) -> Result<Self> {
        let io = |e| Error::Core(egogen::Error::io(path, e));
        let old = std::fs::read_to_string(path).unwrap_or_default();
        let line_epoch = |line: &str| line.split(',').next().and_then(|n| n.parse::<u64>().ok());
        let kept: String = old.lines().filter(|l| line_epoch(l).is_none_or(|n| n <= epoch)).flat_map(|l| [l, "\n"]).collect();
        let kept = if epoch == 0 { String::new() } else { kept };
        egogen::io::write_atomic(path, kept.as_bytes())?;
        let file = OpenOptions::new().append(true).open(path).map_err(io)?;
        Ok(Self { path: path.into(), file, header: kept.is_empty() })
    }
}

impl Logger for Csv {
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()> {
        let mut text = String::new();
        if std::mem::take(&mut self.header) {
            text += "epoch";
            row.iter().for_each(|(name, _)| text += &format!(",{name}"));
            text += "\n";
        }
        text += &epoch.to_string();
        for (_, value) in row {
            text += &value.map_or(",".into(), |v| format!(",{v}"));
        }
        text += "\n";
        self.file.write_all(text.as_bytes()).map_err(|e| Error::Core(egogen::Error::io(&self.path, e)))
    }
}

/// TensorBoard event files; scalars only.
pub struct TensorBoard {
    writer: SummaryWriter,
}

impl TensorBoard {
    /// Event files in `dir`.
    pub fn new(dir: &Path) -> Self {
        Self { writer: SummaryWriter::new(dir) }
    }
}

impl Logger for TensorBoard {
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()> {
        for (name, value) in row {
            if let Some(value) = value {
                self.writer.add_scalar(name, *value as f32, epoch as usize);
            }
        }
        self.writer.flush();
        Ok(())
    }
}

/// What the person at the terminal sees: a bar on a terminal, lines elsewhere.
pub struct Console {
    bar: Option<ProgressBar>,
    epochs: u64,
}

impl Console {
    /// `updates` is the length of the whole run, `done` what lies behind.
    pub fn new(epochs: u64, updates: u64, done: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(updates).with_position(done);
            let style = ProgressStyle::with_template("{bar:30} {percent:>3}% {msg} ETA {eta}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.reset_eta();
            bar
        });
        Self { bar, epochs }
    }

    /// One update more is done.
    pub fn tick(&self) {
        if let Some(bar) = &self.bar {
            bar.inc(1);
        }
    }

    /// A line that stays.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => eprintln!("{text}"),
        }
    }

    /// The line of an epoch.
    pub fn epoch(&self, epoch: u64, row: &Row, steps_per_second: f64, left_seconds: f64) {
        let get = |name: &str| row.iter().find(|(n, _)| n == name).and_then(|(_, v)| *v);
        let mut line = format!("epoch {epoch:>3}/{}  steps {:>9}", self.epochs, get("env_steps").unwrap_or(0.0));
        let shown = [
            ("return", "train/return"),
            ("success", "train/success"),
            ("hover", "train/hover"),
            ("KL", "loss/kl_prior"),
            ("test sto", "test_sto/success"),
            ("det", "test_det/success"),
        ];
        for (label, name) in shown {
            if let Some(value) = get(name) {
                line += &format!("  {label} {value:.3}");
            }
        }
        line += &format!("  {steps_per_second:.0} steps/s");
        if self.bar.is_none() {
            line += &format!("  ETA {:.0} s", left_seconds);
        }
        self.say(&line);
    }
}
