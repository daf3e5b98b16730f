//! Manifests, and one task of them.

use super::plan::Task;
use crate::job::{Job, Summary};
use crate::recipe::{Recipe, difference, of_run};
use crate::registry::Registry;
use crate::stages::Scheme;
use crate::trainer::Outcome;
use crate::{Error, Result};
use egogen::io::{content_hash, write_atomic};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Digits of a task's hash in the names of its marks: tasks of several rungs share a folder.
const DIGITS: usize = 16;

/// What a done task leaves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Done {
    /// That of the task.
    pub hash: String,
    pub epochs: u64,
    /// Figures of the last epoch.
    pub figures: BTreeMap<String, f64>,
}

/// How far a task is.
#[derive(Clone, Debug, PartialEq)]
pub enum State {
    Open,
    /// Stopped by an error; it is tried again.
    Failed(String),
    Done(Done),
}

/// A manifest: tasks, one a line, in JSON.
#[derive(Clone, Debug, PartialEq)]
pub struct Manifest {
    pub path: PathBuf,
    pub tasks: Vec<Task>,
}

/// What is written into a task's folder when it is done.
fn done_file(task: &Task) -> String {
    format!("done-{}.json", task.hash.get(..DIGITS).unwrap_or(&task.hash))
}

/// What is written there when it fails.
fn failed_file(task: &Task) -> String {
    format!("failed-{}.txt", task.hash.get(..DIGITS).unwrap_or(&task.hash))
}

impl Manifest {
    /// Reads the manifest at `path`; recipes must have their hashes.
    pub fn read(path: &Path) -> Result<Self> {
        let bad = |what: String| Error::config(format!("{}: {what}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|e| bad(e.to_string()))?;
        let parse = |(i, line): (usize, &str)| {
            let task: Task = serde_json::from_str(line).map_err(|e| bad(format!("line {}: {e}", i + 1)))?;
            match content_hash(task.recipe.as_bytes()) == task.hash {
                true => Ok(task),
                false => Err(bad(format!("line {}: the recipe of task {} does not have its hash", i + 1, task.id))),
            }
        };
        let tasks = text.lines().enumerate().map(parse).collect::<Result<_>>()?;
        Ok(Self { path: path.into(), tasks })
    }

    /// Writes the manifest, unless the same is there; another is refused.
    pub fn keep(&self) -> Result<()> {
        if self.path.exists() {
            let known = |m: &Self| m.tasks.iter().map(|t| (t.id.clone(), t.hash.clone())).collect::<Vec<_>>();
            return match known(&Self::read(&self.path)?) == known(self) {
                true => Ok(()),
                false => Err(Error::config(format!("{}: is that of another sweep; give another --out", self.path.display()))),
            };
        }
        let line = |t: &Task| serde_json::to_string(t).map_err(|e| Error::run(format!("cannot write the manifest: {e}")));
        let lines = self.tasks.iter().map(line).collect::<Result<Vec<_>>>()?;
        Ok(write_atomic(&self.path, (lines.join("\n") + "\n").as_bytes())?)
    }

    /// The folder of a task.
    pub fn folder(&self, task: &Task) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).join(&task.folder)
    }

    /// How far a task is.
    pub fn state(&self, task: &Task) -> State {
        let dir = self.folder(task);
        let done = std::fs::read_to_string(dir.join(done_file(task))).ok().and_then(|text| serde_json::from_str::<Done>(&text).ok());
        match (done.filter(|d| d.hash == task.hash), std::fs::read_to_string(dir.join(failed_file(task)))) {
            (Some(done), _) => State::Done(done),
            (None, Ok(why)) => State::Failed(why.trim_end().into()),
            (None, Err(_)) => State::Open,
        }
    }

    /// Does task `index`, counted from 0: nothing where it is done, the rest where it was begun.
    pub fn run(&self, index: usize, registry: &Registry, threads: usize, stop: &AtomicBool) -> Result<Outcome> {
        let task = self.tasks.get(index).ok_or_else(|| {
            Error::config(format!("--index {index}: {} has {} tasks, counted from 0", self.path.display(), self.tasks.len()))
        })?;
        let dir = self.folder(task);
        if let State::Done(_) = self.state(task) {
            eprintln!("task {}: is done", task.id);
            return Ok(Outcome::Finished);
        }
        let result = train(task, &dir, registry, threads, stop);
        let failed = dir.join(failed_file(task));
        match &result {
            // Where even this cannot be written, the error itself is still told.
            Err(e) => drop(write_atomic(&failed, format!("{e}\n").as_bytes())),
            Ok(_) if failed.exists() => std::fs::remove_file(&failed).map_err(|e| egogen::Error::io(&failed, e))?,
            Ok(_) => {}
        }
        result
    }
}

/// Trains what is left of a task in its folder.
fn train(task: &Task, dir: &Path, registry: &Registry, threads: usize, stop: &AtomicBool) -> Result<Outcome> {
    let recipe = Recipe::parse(&format!("task {}", task.id), &task.recipe, &[])?;
    let scheme = Scheme::new(recipe)?;
    let begun = dir.join("recipe.toml").exists();
    if begun && let Some((key, [was, is])) = difference(&of_run(dir, &[])?, &scheme.recipe)? {
        return Err(Error::config(format!("{}: is of another task: {key} is {was}, expected {is}", dir.display())));
    }
    let job = Job { scheme: &scheme, registry, dir, threads, init: None };
    let outcome = job.run(begun, stop, &|_| Ok(()))?;
    if outcome == Outcome::Finished {
        let summary = Summary::read(dir)?.ok_or_else(|| Error::run(format!("{}: the summary is lost", dir.display())))?;
        let done = Done { hash: task.hash.clone(), epochs: summary.epochs, figures: summary.last_epoch };
        let text = serde_json::to_string_pretty(&done).map_err(|e| Error::run(format!("cannot mark the task: {e}")))?;
        write_atomic(dir.join(done_file(task)), text.as_bytes())?;
    }
    Ok(outcome)
}
