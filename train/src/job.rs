//! A whole run in its folder: one trainer, or one for each stage after the other.

use crate::checkpoint::{self, list};
use crate::registry::Registry;
use crate::stages::{From, Part, Scheme};
use crate::start::{Carried, Start};
use crate::trainer::{Outcome, Trainer, export};
use crate::{Error, Result};
use egogen::agent::PolicySpec;
use egogen::agent::bundle::Bundle;
use egogen::io::write_atomic;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Content hashes by name.
type Origin = BTreeMap<String, String>;

/// What is trained, and where.
pub(crate) struct Job<'a> {
    pub scheme: &'a Scheme,
    pub registry: &'a Registry,
    pub dir: &'a Path,
    pub threads: usize,
    /// What the first stage begins with, where it is not the seed.
    pub init: Option<&'a Bundle>,
}

/// What is read of a run's `summary.json`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Summary {
    pub epochs: u64,
    pub env_steps: u64,
    /// The chosen checkpoint.
    pub policy: String,
    pub origin: Origin,
    /// Figures of the last epoch.
    pub last_epoch: BTreeMap<String, f64>,
    /// A rule `until` has ended it.
    #[serde(default)]
    pub converged: bool,
}

/// What a stage came to, in the summary of its run.
#[derive(Clone, Debug, Serialize)]
struct StageSummary {
    name: String,
    folder: String,
    epochs: u64,
    env_steps: u64,
    policy: String,
}

impl Summary {
    /// The summary of the run in `dir`; none before its end.
    pub fn read(dir: &Path) -> Result<Option<Self>> {
        let path = dir.join("summary.json");
        match std::fs::read_to_string(&path) {
            Ok(text) => Ok(Some(serde_json::from_str(&text).map_err(|e| egogen::Error::file(&path, e.to_string()))?)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(egogen::Error::io(&path, e).into()),
        }
    }
}

/// The folder of stage `i` in the run's.
pub(crate) fn stage_folder(i: usize, name: &str) -> String {
    format!("stages/{}-{name}", i + 1)
}

/// Refuses, before anything is trained, what a later stage would stop at.
pub(crate) fn check_stages(scheme: &Scheme, registry: &Registry) -> Result<()> {
    let mut before: Option<(&str, PolicySpec)> = None;
    for part in &scheme.parts {
        let named = |e: &dyn std::fmt::Display| match part.name.as_str() {
            "" => Error::config(e.to_string()),
            name => Error::config(format!("stage '{name}': {e}")),
        };
        let spec = Trainer::check(&part.plan, registry).map_err(|e| named(&e))?;
        if let Some((name, other)) = before.filter(|_| part.from != From::Nothing)
            && (&other.layout, other.action) != (&spec.layout, spec.action)
        {
            return Err(named(&format!("observations or actions differ from those of stage '{name}', whose weights it begins with")));
        }
        before = Some((&part.name, spec));
    }
    Ok(())
}

impl Job<'_> {
    /// Trains what is left to do; `resume`: the folder holds a run that was begun. `check` hears what the first stage stands on.
    pub fn run(&self, resume: bool, stop: &AtomicBool, check: &dyn Fn(&Origin) -> Result<()>) -> Result<Outcome> {
        if !self.scheme.staged() {
            let mut trainer = self.trainer(0, self.dir, resume)?;
            check(trainer.origin())?;
            return trainer.run(stop);
        }
        if !resume {
            check_stages(self.scheme, self.registry)?;
        }
        write_atomic(self.dir.join("recipe.toml"), self.scheme.recipe.to_toml()?.as_bytes())?;
        [self.dir.to_path_buf(), self.dir.join("policy")].iter().try_for_each(|dir| checkpoint::sweep(dir))?;
        for (i, part) in self.scheme.parts.iter().enumerate() {
            let dir = self.folder(i);
            match self.finished(i)? {
                Some(summary) if i == 0 => check(&summary.origin)?,
                Some(_) => {}
                None => {
                    eprintln!("stage {} of {}, {}, in {}", i + 1, self.scheme.parts.len(), part.name, dir.display());
                    let mut trainer = self.trainer(i, &dir, dir.join("recipe.toml").exists())?;
                    if i == 0 {
                        check(trainer.origin())?;
                    }
                    if trainer.run(stop)? == Outcome::Interrupted {
                        return Ok(Outcome::Interrupted);
                    }
                }
            }
        }
        self.sum_up()?;
        Ok(Outcome::Finished)
    }

    fn folder(&self, i: usize) -> PathBuf {
        self.dir.join(stage_folder(i, &self.scheme.parts[i].name))
    }

    /// The trainer of stage `i`, in its folder; where that holds a checkpoint, it continues.
    fn trainer(&self, i: usize, dir: &Path, begun: bool) -> Result<Trainer<'_>> {
        let part = &self.scheme.parts[i];
        let (plan, registry, threads) = (part.plan.clone(), self.registry, self.threads);
        let given = part.from != From::Nothing || i == 0 && self.init.is_some();
        let lost = given && list(&dir.join("checkpoints")).is_empty();
        if begun && !lost {
            return Trainer::resume(plan, registry, dir, threads, |what| eprintln!("warning: {what}"));
        }
        let start = match self.init {
            _ if part.from != From::Nothing => Start::Stage(Box::new(self.carried(i, part)?)),
            Some(bundle) if i == 0 => Start::Policy(bundle),
            _ => Start::Seed,
        };
        Trainer::begin(plan, registry, dir, threads, start)
    }

    /// What stage `i` takes from the one before.
    fn carried(&self, i: usize, part: &Part) -> Result<Carried> {
        let before = self.folder(i - 1);
        let root = before.join("checkpoints");
        let name = match part.from {
            From::Best => Summary::read(&before)?.map(|s| s.policy),
            From::Last | From::Nothing => list(&root).pop(),
        };
        let name = name.ok_or_else(|| Error::run(format!("{}: holds no finished stage to begin from", before.display())))?;
        Carried::read(&root.join(name), part.optimiser)
    }

    /// The summary of stage `i` where it has come to its end.
    fn finished(&self, i: usize) -> Result<Option<Summary>> {
        let part = &self.scheme.parts[i];
        let Some(summary) = Summary::read(&self.folder(i))? else { return Ok(None) };
        let (done, epochs) = (summary.epochs, part.plan.recipe.run.epochs);
        if summary.converged || done == epochs {
            return Ok(Some(summary));
        }
        if i + 1 < self.scheme.parts.len() && self.folder(i + 1).exists() {
            let what = format!("stage '{}' has ended after {done} epochs, and the next has begun", part.name);
            return Err(Error::config(format!("{}: {what}; its run.epochs can no longer become {epochs}", self.dir.display())));
        }
        Ok((done > epochs).then_some(summary))
    }

    /// Packs the last stage's policy and sums all of them up.
    fn sum_up(&self) -> Result<()> {
        let mut stages = Vec::new();
        let mut end: Option<(PathBuf, Summary)> = None;
        let mut converged = false;
        for (i, part) in self.scheme.parts.iter().enumerate() {
            let dir = self.folder(i);
            let summary = Summary::read(&dir)?.ok_or_else(|| Error::run(format!("{}: the summary is lost", dir.display())))?;
            let Summary { epochs, env_steps, policy, .. } = summary.clone();
            stages.push(StageSummary { name: part.name.clone(), folder: stage_folder(i, &part.name), epochs, env_steps, policy });
            converged |= summary.converged;
            end = Some((dir, summary));
        }
        let Some((dir, last)) = end else { return Ok(()) };
        export(&dir.join("checkpoints").join(&last.policy), &self.dir.join("policy"))?;
        let recipe = &self.scheme.recipe;
        let summary = serde_json::json!({
            "recipe": recipe.name,
            "seed": recipe.seed,
            "version": env!("CARGO_PKG_VERSION"),
            "epochs": stages.iter().map(|s| s.epochs).sum::<u64>(),
            "env_steps": stages.iter().map(|s| s.env_steps).sum::<u64>(),
            "policy": last.policy,
            "origin": last.origin,
            "last_epoch": last.last_epoch,
            "converged": converged,
            "stages": stages,
        });
        let text = serde_json::to_string_pretty(&summary).map_err(|e| Error::run(format!("cannot write the summary: {e}")))?;
        Ok(write_atomic(self.dir.join("summary.json"), text.as_bytes())?)
    }
}
