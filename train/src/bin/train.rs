//! Trains a recipe. See `train --help`.

use egogen_train::{cli, registry::Registry};
use std::process::ExitCode;

fn main() -> ExitCode {
    cli::run(&Registry::standard())
}
