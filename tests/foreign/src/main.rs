//! The program `train` with an environment and a reward term of one's own.

mod carts;

use egogen_train::registry::{Made, Registry};

fn main() -> std::process::ExitCode {
    let mut registry = Registry::standard();
    registry.add("carts", |_, n, _| Ok(Made { env: Box::new(carts::Carts::new(n, 0)), origin: Default::default() }));
    // Walking upright: the head above the pelvis, metres.
    registry.add_motion("motion", &[("upright", |outcome| outcome.head.z - outcome.pelvis.z)]);
    egogen_train::cli::run(&registry)
}
