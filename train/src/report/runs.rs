//! Run folders as the report reads them: seeds side by side, stages one after the other.

use crate::job::{Summary, stage_folder};
use crate::logger::Columns;
use crate::plot::{Band, Marks, Series};
use crate::recipe::{Recipe, of_run};
use crate::select::Selection;
use crate::stages::Scheme;
use crate::stats::mean_and_half;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Runs that differ in their seeds alone.
pub struct Group {
    /// The folder's name.
    pub name: String,
    pub runs: Vec<Run>,
}

/// One run.
pub struct Run {
    pub dir: PathBuf,
    /// The folder's name.
    pub name: String,
    pub seed: u64,
    /// Stages that have begun; one without a name where the recipe has none.
    pub stages: Vec<Stage>,
}

/// One stage, or a whole run without stages.
pub struct Stage {
    pub name: String,
    pub dir: PathBuf,
    pub recipe: Recipe,
    pub metrics: Columns,
    pub timing: Columns,
    /// What was selected; before its end, and without `[select]`, none.
    pub selection: Option<Selection>,
    pub(crate) summary: Option<Summary>,
}

/// Which of a stage's files a column stands in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum From {
    Metrics,
    Timing,
}

impl Group {
    /// Reads a run's folder, or one of `train --seeds` with a run for each seed.
    pub fn read(dir: &Path) -> Result<Self> {
        if dir.join("recipe.toml").is_file() {
            return Ok(Self { name: name_of(dir), runs: vec![Run::read(dir)?] });
        }
        let seed = |name: &str| name.strip_prefix("seed-").and_then(|n| n.parse::<u64>().ok());
        let entries = std::fs::read_dir(dir).map_err(|e| Error::config(format!("{}: {e}", dir.display())))?;
        // A run that stopped before it began has no recipe.
        let begun = entries.flatten().filter(|e| e.path().join("recipe.toml").is_file());
        let mut seeds: Vec<u64> = begun.filter_map(|e| seed(e.file_name().to_str()?)).collect();
        seeds.sort_unstable();
        if seeds.is_empty() {
            let what = "holds neither recipe.toml nor folders seed-K; expected a run's folder, or one of `train --seeds`";
            return Err(Error::config(format!("{}: {what}", dir.display())));
        }
        let runs = seeds.iter().map(|k| Run::read(&dir.join(format!("seed-{k}")))).collect::<Result<_>>()?;
        Ok(Self { name: name_of(dir), runs })
    }

    /// Where every stage begins on the axis of epochs, and where the last ends: after the longest run of each.
    pub fn borders(&self) -> Vec<f64> {
        let stages = self.runs.iter().map(|r| r.stages.len()).max().unwrap_or(0);
        let longest = |k: usize| self.runs.iter().filter_map(|r| Some(r.stages.get(k)?.metrics.rows())).max().unwrap_or(0);
        (0..stages).fold(vec![0.0], |mut all, k| {
            all.push(all[k] + longest(k) as f64);
            all
        })
    }

    /// Names of the stages.
    pub fn stage_names(&self) -> Vec<String> {
        let longest = self.runs.iter().max_by_key(|r| r.stages.len());
        longest.map_or(vec![], |r| r.stages.iter().map(|s| s.name.clone()).collect())
    }

    /// The column over epochs: mean over the runs that have a value, and half the 95 % interval of that mean.
    pub fn curve(&self, name: &str, from: From, column: &str) -> Series {
        let (mut points, mut band) = (Vec::new(), Vec::new());
        for (k, ends) in self.borders().windows(2).enumerate() {
            for row in 0..(ends[1] - ends[0]) as usize {
                let values: Vec<f64> = self.runs.iter().filter_map(|r| r.stages.get(k)?.of(from).get(column, row)).collect();
                if let Some([mean, half]) = mean_and_half(&values) {
                    points.push((ends[0] + row as f64 + 1.0, mean));
                    band.push(half);
                }
            }
        }
        // A band of no height is none.
        let band = band.iter().any(|d| *d > 0.0).then_some(Band { half: band, what: "95 % interval over seeds" });
        Series { name: name.into(), points, band }
    }

    /// Borders between stages, and where the chosen policies lie on a column.
    pub fn marks(&self, column: &str) -> Marks {
        let borders = self.borders();
        let inner = if borders.len() > 2 { borders[1..borders.len() - 1].to_vec() } else { vec![] };
        let stages = self.runs.iter().flat_map(|r| r.stages.iter().zip(&borders));
        let point = |(stage, begin): (&Stage, &f64)| {
            let epoch = stage.chosen()?;
            Some((begin + epoch as f64, stage.metrics.get(column, (epoch as usize).checked_sub(1)?)?))
        };
        Marks { borders: inner, chosen: stages.filter_map(point).collect() }
    }
}

impl Run {
    fn read(dir: &Path) -> Result<Self> {
        let recipe = of_run(dir, &[])?;
        let scheme = Scheme::new(recipe)?;
        let mut stages = Vec::new();
        for (i, part) in scheme.parts.iter().enumerate() {
            let dir = if scheme.staged() { dir.join(stage_folder(i, &part.name)) } else { dir.into() };
            let metrics = Columns::read(&dir.join("metrics.csv"))?;
            if i == 0 || metrics.rows() > 0 {
                let (timing, selection) = (Columns::read(&dir.join("timing.csv"))?, Selection::read(&dir)?);
                let summary = Summary::read(&dir)?;
                stages.push(Stage { name: part.name.clone(), recipe: part.plan.recipe.clone(), dir, metrics, timing, selection, summary });
            }
        }
        Ok(Self { dir: dir.into(), name: name_of(dir), seed: scheme.recipe.seed, stages })
    }

    /// Epochs, environment steps and hours by the clock.
    pub fn effort(&self) -> (usize, f64, f64) {
        let last = |s: &Stage, name: &str| s.metrics.rows().checked_sub(1).and_then(|row| s.metrics.get(name, row)).unwrap_or(0.0);
        let seconds = |s: &Stage| {
            let parts = ["collect_seconds", "learn_seconds", "test_seconds"];
            (0..s.timing.rows()).flat_map(|row| parts.map(|p| s.timing.get(p, row).unwrap_or(0.0))).sum::<f64>()
        };
        let sum = |of: &dyn Fn(&Stage) -> f64| self.stages.iter().map(of).sum::<f64>();
        let epochs = self.stages.iter().map(|s| s.metrics.rows()).sum();
        (epochs, sum(&|s| last(s, "env_steps")), sum(&seconds) / 3600.0)
    }
}

impl Stage {
    /// The table of a file.
    fn of(&self, from: From) -> &Columns {
        match from {
            From::Metrics => &self.metrics,
            From::Timing => &self.timing,
        }
    }

    /// The epoch of the chosen policy.
    pub fn chosen(&self) -> Option<u64> {
        self.summary.as_ref()?.policy.strip_prefix("epoch-")?.parse().ok()
    }
}

fn name_of(dir: &Path) -> String {
    dir.file_name().map_or_else(|| dir.display().to_string(), |n| n.to_string_lossy().into_owned())
}
