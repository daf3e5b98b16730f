//! The program `train` with an environment and a reward term of one's own.

mod carts;

use egogen_envs::motion::Outcome;
use egogen_train::registry::{Made, Registry};
use std::process::ExitCode;

/// Walking upright: the head above the pelvis, metres.
fn upright(outcome: &Outcome) -> f32 {
    outcome.head.z - outcome.pelvis.z
}

fn main() -> ExitCode {
    let mut registry = Registry::standard();
    registry.add("carts", |_, n, _| Ok(Made { env: Box::new(carts::Carts::new(n, 0)), origin: Default::default() }));
    registry.add_motion("motion", &[("upright", upright)]);
    egogen_train::cli::run(&registry)
}
