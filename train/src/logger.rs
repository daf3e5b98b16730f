//! Where figures go: CSV files and the terminal; [`crate::tensorboard`] has a module of its own.

use crate::stats::Row;
use crate::{Error, Result};
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};

/// Receives the figures of every epoch.
pub trait Logger {
    /// `epoch` counts from 1; `row` has the same names in every call.
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()>;
}

/// A CSV file, one line per epoch, on disk at once.
pub struct Csv {
    path: PathBuf,
    file: File,
    header: bool,
}

impl Csv {
    /// Opens `path`, keeping the lines of epochs up to `epoch` (those after the checkpoint that a run continues from are dropped).
    pub fn open(path: &Path, epoch: u64) -> Result<Self> {
        let io = |e| Error::Core(egogen::Error::io(path, e));
        let kept = Rows::of(&read(path)?).up_to(epoch);
        let kept = if epoch == 0 { String::new() } else { kept };
        egogen::io::write_atomic(path, kept.as_bytes())?;
        let file = OpenOptions::new().append(true).open(path).map_err(io)?;
        Ok(Self { path: path.into(), file, header: kept.is_empty() })
    }

    /// The last epoch that the file `path` reports; 0 without one.
    pub fn epochs(path: &Path) -> Result<u64> {
        Ok(Rows::of(&read(path)?).lines.last().map_or(0, |(epoch, _)| *epoch))
    }
}

/// The columns of a CSV file that [`Csv`] wrote.
#[derive(Clone, Debug, Default)]
pub struct Columns {
    /// In the order of the file, without the first, which counts epochs from 1.
    pub names: Vec<String>,
    values: BTreeMap<String, Vec<Option<f64>>>,
    rows: usize,
}

impl Columns {
    /// Reads the whole rows of the file `path`; none where there is no such file.
    pub fn read(path: &Path) -> Result<Self> {
        let text = read(path)?;
        let rows = Rows::of(&text);
        let names: Vec<String> = rows.header.trim_end().split(',').skip(1).map(String::from).collect();
        let column = |k: usize| rows.lines.iter().map(|(_, line)| line.trim_end().split(',').nth(k + 1)?.parse().ok()).collect();
        let values = names.iter().enumerate().map(|(k, name)| (name.clone(), column(k))).collect();
        Ok(Self { rows: rows.lines.len(), names, values })
    }

    /// Rows, one for each epoch.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The value of a column in row `row`, if it has one.
    pub fn get(&self, name: &str, row: usize) -> Option<f64> {
        self.values.get(name)?.get(row).copied().flatten()
    }
}

/// The text of the file `path`, which need not exist.
fn read(path: &Path) -> Result<String> {
    match std::fs::read_to_string(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(egogen::Error::io(path, e).into()),
        text => Ok(text.unwrap_or_default()),
    }
}

/// The header and the whole lines of a CSV file, with their epochs; the last may have been cut off, by a full disk or a kill.
struct Rows<'a> {
    header: &'a str,
    lines: Vec<(u64, &'a str)>,
}

impl<'a> Rows<'a> {
    fn of(text: &'a str) -> Self {
        let mut lines = text.split_inclusive('\n').filter(|l| l.ends_with('\n'));
        let header = lines.next().unwrap_or_default();
        let width = |line: &str| line.split(',').count();
        let lines = lines.filter(|l| width(l) == width(header));
        let lines = lines.filter_map(|l| Some((l.split(',').next()?.parse().ok()?, l))).collect();
        Self { header, lines }
    }

    fn up_to(&self, epoch: u64) -> String {
        let kept = self.lines.iter().filter(|(n, _)| *n <= epoch).map(|(_, line)| *line);
        std::iter::once(self.header).chain(kept).collect()
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
        let written = self.file.write_all(text.as_bytes()).and_then(|()| self.file.sync_data());
        written.map_err(|e| Error::Core(egogen::Error::io(&self.path, e)))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_rows_up_to_the_checkpoint_stay() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.csv");
        let row: Row = vec![("a".into(), Some(0.5)), ("b".into(), None)];
        assert_eq!(Csv::epochs(&path).unwrap(), 0);
        let mut csv = Csv::open(&path, 0).unwrap();
        (1..=12).for_each(|epoch| csv.log(epoch, &row).unwrap());
        assert_eq!(Csv::epochs(&path).unwrap(), 12);
        // Row 13 cut to "1,0.5," would pass for row 1, but for its missing end of line.
        let whole = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, format!("{whole}1\n1,0.5,")).unwrap();
        Csv::open(&path, 2).unwrap().log(3, &row).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "epoch,a,b\n1,0.5,\n2,0.5,\n3,0.5,\n");
        let columns = Columns::read(&path).unwrap();
        assert_eq!((columns.names.join(" ").as_str(), columns.rows()), ("a b", 3));
        assert_eq!((columns.get("a", 2), columns.get("b", 2), columns.get("a", 3), columns.get("c", 0)), (Some(0.5), None, None, None));
        Csv::open(&path, 0).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "");
        std::fs::write(&path, [0xff]).unwrap();
        assert!(Csv::open(&path, 2).err().unwrap().to_string().contains("metrics.csv"));
    }
}
