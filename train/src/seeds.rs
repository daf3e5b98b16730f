//! Several seeds of one recipe: a run each, and what they came to together.

use crate::cli::run_folder;
use crate::job::{Job, Summary, stage_folder};
use crate::recipe::{Recipe, difference, of_run};
use crate::registry::Registry;
use crate::stages::Scheme;
use crate::start::INIT;
use crate::stats::{bootstrap_interval, inter_quartile_mean};
use crate::trainer::Outcome;
use crate::{Error, Result};
use egogen::agent::bundle::Bundle;
use egogen::io::write_atomic;
use egogen::rng::stream;
use std::collections::BTreeMap;
use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Resamples of an interval.
const RESAMPLES: usize = 10_000;

/// Figures of a run's last epoch by name.
type Figures = BTreeMap<String, f64>;

/// Runs of one recipe that differ in their seeds alone.
pub struct Seeds<'a> {
    /// The recipe with the first seed.
    pub recipe: Recipe,
    pub registry: &'a Registry,
    /// Holds a folder for each run.
    pub dir: PathBuf,
    pub threads: usize,
    /// What every run begins with, where it is not the seed.
    pub init: Option<Bundle>,
}

impl Seeds<'_> {
    /// Trains `count` seeds one after another, going on where an earlier call stopped, and writes `seeds.csv`.
    pub fn run(&self, count: NonZeroU64, stop: &AtomicBool) -> Result<Outcome> {
        let mut runs = Vec::new();
        for seed in (self.recipe.seed..).take(count.get() as usize) {
            match self.one(seed, stop)? {
                Some(figures) => runs.push(figures),
                None => return Ok(Outcome::Interrupted),
            }
        }
        let table = table(&runs);
        write_atomic(self.dir.join("seeds.csv"), table.as_bytes())?;
        print!("{table}");
        Ok(Outcome::Finished)
    }

    /// The figures of the run of one seed, trained as far as that is left to do; `None` where it was interrupted.
    fn one(&self, seed: u64, stop: &AtomicBool) -> Result<Option<Figures>> {
        let scheme = Scheme::new(Recipe { seed, ..self.recipe.clone() })?;
        let dir = self.dir.join(format!("seed-{seed}"));
        let noted = dir.join("recipe.toml").exists();
        if noted && let Some(figures) = self.finished(&scheme, &dir)? {
            eprintln!("{}: is finished", dir.display());
            return Ok(Some(figures));
        }
        let dir = if noted { dir } else { run_folder(Some(&dir), "")? };
        eprintln!("{}: {}", dir.display(), if noted { "goes on" } else { "begins" });
        let job = Job { scheme: &scheme, registry: self.registry, dir: &dir, threads: self.threads, init: self.init.as_ref() };
        match job.run(noted, stop, &|origin| self.check_init(&dir, origin))? {
            Outcome::Interrupted => Ok(None),
            Outcome::Finished => Ok(Summary::read(&dir)?.map(|s| s.last_epoch)),
        }
    }

    /// The figures of a run that has come to its end. Refuses one of another recipe.
    fn finished(&self, scheme: &Scheme, dir: &Path) -> Result<Option<Figures>> {
        let theirs = of_run(dir, &[])?;
        let other = |file: &str, key: &str, was: &str, is: &str| {
            let path = dir.join(file);
            Err(Error::config(format!("{}: {key} is {was}, expected {is}; give another --out", path.display())))
        };
        if let Some((key, [was, is])) = difference(&theirs, &scheme.recipe)? {
            return other("recipe.toml", &key, &was, &is);
        }
        let Some(summary) = Summary::read(dir)? else { return Ok(None) };
        let epochs = scheme.epochs();
        if summary.epochs < epochs && !summary.converged {
            return Ok(None);
        }
        if summary.epochs > epochs {
            return other("summary.json", "epochs", &summary.epochs.to_string(), &epochs.to_string());
        }
        if theirs.test != scheme.recipe.test {
            return other("recipe.toml", "[test]", &format!("{:?}", theirs.test), &format!("{:?}", scheme.recipe.test));
        }
        let begin = scheme.staged().then(|| Summary::read(&dir.join(stage_folder(0, &scheme.parts[0].name)))).transpose()?.flatten();
        self.check_init(dir, begin.as_ref().map_or(&summary.origin, |first| &first.origin))?;
        Ok(Some(summary.last_epoch))
    }

    /// A run in `dir` must have begun with what this one is to begin with.
    fn check_init(&self, dir: &Path, origin: &BTreeMap<String, String>) -> Result<()> {
        let (was, is) = (origin.get(INIT), self.init.as_ref().map(Bundle::weights_hash));
        if was == is.as_ref() {
            return Ok(());
        }
        let name = |hash: Option<&String>| hash.map_or("a seed".into(), |h| format!("weights {h}"));
        let what = format!("began with {}, expected {}; give another --out", name(was), name(is.as_ref()));
        Err(Error::config(format!("{}: {what}", dir.display())))
    }
}

/// Every figure of the last test over the runs that have it, as CSV: inter-quartile mean with its bootstrap interval, mean, smallest
/// and largest.
fn table(runs: &[Figures]) -> String {
    let mut figures: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (name, &value) in runs.iter().flatten().filter(|(name, _)| name.starts_with("test_")) {
        figures.entry(name).or_default().push(value);
    }
    let mut out = String::from("figure,iqm,low95,high95,mean,min,max,runs\n");
    for (name, values) in figures {
        let [low, high] = bootstrap_interval(std::slice::from_ref(&values), RESAMPLES, &mut stream(0, "seeds", 0));
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let (min, max) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
        let iqm = inter_quartile_mean(&values);
        out += &format!("{name},{iqm:.4},{low:.4},{high:.4},{mean:.4},{min:.4},{max:.4},{}\n", values.len());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tests_are_tabulated() {
        let run = |value: f64| Figures::from([("test_det/return".to_string(), value), ("train/return".to_string(), 7.0)]);
        // Of four runs, one goes at each end.
        let text = table(&[1.0, 2.0, 3.0, 10.0].map(run));
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 2, "{text}");
        let cells: Vec<&str> = lines[1].split(',').collect();
        assert_eq!(
            [cells[0], cells[1], cells[4], cells[5], cells[6], cells[7]],
            ["test_det/return", "2.5000", "4.0000", "1.0000", "10.0000", "4"]
        );
        let [low, high] = [cells[2], cells[3]].map(|c| c.parse::<f64>().unwrap());
        assert!((1.0..2.5).contains(&low) && (2.5..=10.0).contains(&high), "{text}");
    }
}
