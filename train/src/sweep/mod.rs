//! Sweeps over recipes: many settings and seeds as tasks that any engine can run, and what they came to.

mod plan;
mod results;
mod task;

pub use plan::{Changes, Draw, Halving, Random, Sweep, Task, Variant, survivors};
pub use results::{Setting, ranked};
pub use task::{Done, Manifest, State};

use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// How often the pool looks at its tasks.
const LOOK: Duration = Duration::from_millis(100);

/// A sweep in its folder.
pub struct Folder<'a> {
    pub sweep: &'a Sweep,
    pub dir: &'a Path,
}

/// How a rung, or the sweep, stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Every task is done, or has failed and was tried.
    Finished { failed: usize },
    /// Stopped from outside.
    Interrupted,
}

impl Folder<'_> {
    /// The manifest of a rung, from 0.
    fn manifest(&self, rung: usize, settings: &[usize]) -> Result<Manifest> {
        let name = if rung == 0 { "manifest.jsonl".into() } else { format!("manifest-{}.jsonl", rung + 1) };
        Ok(Manifest { path: self.dir.join(name), tasks: self.sweep.tasks(rung, settings)? })
    }

    /// Rungs of the sweep.
    fn rungs(&self) -> usize {
        self.sweep.halving.as_ref().map_or(1, |h| h.epochs.len())
    }

    /// The manifests of all rungs that can be known, each written where it is not there yet. A rung is known when no task of the one
    /// before is open.
    pub fn manifests(&self) -> Result<Vec<Manifest>> {
        let mut known = vec![self.manifest(0, &(1..=self.sweep.settings().len()).collect::<Vec<_>>())?];
        known[0].keep()?;
        for rung in 1..self.rungs() {
            let before = &known[rung - 1];
            let path = self.manifest(rung, &[])?.path;
            if path.exists() {
                // Who went on stays, even if a task that had failed is done since.
                known.push(Manifest::read(&path)?);
                continue;
            }
            if before.tasks.iter().any(|t| before.state(t) == State::Open) {
                break;
            }
            let means: Vec<_> = ranked(before, &self.sweep.figure).iter().map(|s| (s.number, s.mean.map(|m| m[0]))).collect();
            let keep = self.sweep.halving.as_ref().map_or(1.0, |h| h.keep);
            let next = self.manifest(rung, &survivors(&means, keep))?;
            next.keep()?;
            known.push(next);
        }
        Ok(known)
    }

    /// Does everything that is left to do, `jobs` tasks at a time, each in a process of its own with so many threads.
    pub fn run(&self, jobs: usize, threads: usize, stop: &AtomicBool) -> Result<Standing> {
        for rung in 0..self.rungs() {
            let Some(manifest) = self.manifests()?.into_iter().nth(rung) else { break };
            if self.pool(&manifest, jobs, threads, stop)? == Standing::Interrupted {
                return Ok(Standing::Interrupted);
            }
        }
        let states: Vec<State> = self.manifests()?.iter().flat_map(|m| m.tasks.iter().map(|t| m.state(t))).collect();
        let failed = states.iter().filter(|s| !matches!(s, State::Done(_))).count();
        Ok(Standing::Finished { failed })
    }

    /// Does the tasks of one manifest. Once `stop` is set, or a task cannot be started, those under way save and stop.
    fn pool(&self, manifest: &Manifest, jobs: usize, threads: usize, stop: &AtomicBool) -> Result<Standing> {
        let left = |i: &usize| !matches!(manifest.state(&manifest.tasks[*i]), State::Done(_));
        let mut open: Vec<usize> = (0..manifest.tasks.len()).filter(left).rev().collect();
        let mut running: Vec<(usize, Child)> = Vec::new();
        let mut error = None;
        let ending = |error: &Option<Error>| error.is_some() || stop.load(Ordering::SeqCst);
        while !running.is_empty() || !open.is_empty() && !ending(&error) {
            while running.len() < jobs && !ending(&error) {
                let Some(index) = open.pop() else { break };
                match self.spawn(manifest, index, threads) {
                    Ok(child) => running.push((index, child)),
                    Err(e) => error = Some(e),
                }
            }
            if ending(&error) {
                // Closes their input.
                running.iter_mut().for_each(|(_, child)| drop(child.stdin.take()));
            }
            std::thread::sleep(LOOK);
            let mut still = Vec::new();
            for (index, mut child) in running {
                match child.try_wait().map_err(|e| Error::run(format!("cannot wait for a task: {e}")))? {
                    None => still.push((index, child)),
                    Some(status) => {
                        let id = &manifest.tasks[index].id;
                        match manifest.state(&manifest.tasks[index]) {
                            State::Done(_) => eprintln!("task {id}: done, {} to go", open.len() + still.len()),
                            State::Failed(why) => eprintln!("task {id}: failed: {why}"),
                            State::Open => eprintln!("task {id}: stopped ({status}); see {}", self.log(id).display()),
                        }
                    }
                }
            }
            running = still;
        }
        error.map_or(Ok(()), Err)?;
        Ok(if stop.load(Ordering::SeqCst) { Standing::Interrupted } else { Standing::Finished { failed: 0 } })
    }

    fn log(&self, id: &str) -> PathBuf {
        self.dir.join("logs").join(format!("{id}.txt"))
    }

    /// This program again, for one task. It watches its input, which ends when this process closes it or is gone in whatever way.
    fn spawn(&self, manifest: &Manifest, index: usize, threads: usize) -> Result<Child> {
        let log = self.log(&manifest.tasks[index].id);
        let io = |e| Error::Core(egogen::Error::io(&log, e));
        std::fs::create_dir_all(self.dir.join("logs")).map_err(io)?;
        let file = std::fs::OpenOptions::new().create(true).append(true).open(&log).map_err(io)?;
        let program = std::env::current_exe().map_err(|e| Error::run(format!("cannot find this program: {e}")))?;
        let mut command = Command::new(program);
        command.arg("--task").arg(&manifest.path).args(["--index", &index.to_string(), "--threads", &threads.to_string(), "--until-eof"]);
        let command = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(file);
        command.spawn().map_err(|e| Error::run(format!("cannot start a task: {e}")))
    }
}
