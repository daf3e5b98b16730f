//! What the programs share: one clear error on stderr and the exit code it stands for.

use crate::{Error, Result};
use egogen::sim::World;
use egogen_envs::motion::MotionTask;
use std::fmt::Display;
use std::path::Path;
use std::process::ExitCode;

/// Exit code of work that was interrupted and saved.
pub const INTERRUPTED: u8 = 130;

/// Prints the error of a program's work and turns the outcome into an exit code.
pub fn exit(outcome: Result<u8>) -> ExitCode {
    ExitCode::from(outcome.unwrap_or_else(|e| {
        eprintln!("error: {e}");
        e.exit_code()
    }))
}

/// Marks errors of preparing, which come from what the user gave: exit code 2 instead of 1.
pub trait Given<T> {
    /// The error as one of configuration.
    fn given(self) -> Result<T>;
}

impl<T, E: Display> Given<T> for std::result::Result<T, E> {
    fn given(self) -> Result<T> {
        self.map_err(|e| Error::config(e.to_string()))
    }
}

/// The motion model of a folder, or the shipped one.
pub fn world(model: Option<&Path>) -> Result<World> {
    model.map_or_else(World::embedded, World::load).given()
}

/// The walking task with `key.path=value` changes, checked.
pub fn task(changes: &[String]) -> Result<MotionTask> {
    let task = crate::recipe::changed("the walking task", MotionTask::default(), changes)?;
    task.validate().given()?;
    Ok(task)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_are_changed_and_checked() {
        let change = |c: &str| task(&[c.to_string()]);
        assert_eq!(change("scene.max_distance=3").unwrap().scene.max_distance, 3.0);
        for (bad, named) in
            [("scene.max_distanc=3", "max_distanc"), ("scene.kind=round", "round"), ("max_depth=0", "max_depth"), ("cell", "key.path")]
        {
            let e = change(bad).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().contains(named), "{bad}: {e}");
        }
    }
}
