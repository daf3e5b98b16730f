//! What the tests of the program `train` share.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// The program `train`.
pub fn program(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_train"));
    command.args(args);
    command
}

/// What `train` gives with these arguments.
pub fn train(args: &[&str]) -> Output {
    program(args).output().expect("the program starts")
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Runs `train` and wants success; gives what it told.
pub fn succeed(args: &[&str]) -> String {
    let output = train(args);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
    stderr(&output)
}

pub fn read(dir: &Path, file: &str) -> Vec<u8> {
    fs::read(dir.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Both runs must have written the same bytes, wall-clock figures apart.
pub fn assert_same_run(a: &Path, b: &Path, checkpoint: &str) {
    assert_eq!(String::from_utf8(read(a, "metrics.csv")), String::from_utf8(read(b, "metrics.csv")));
    for file in ["model.safetensors", "optimizer.safetensors", "state.bin", "recipe.toml", "checkpoint.json"] {
        let file = format!("checkpoints/{checkpoint}/{file}");
        assert!(read(a, &file) == read(b, &file), "{file} differs");
    }
    assert_eq!(read(a, "policy/policy.json"), read(b, "policy/policy.json"));
    assert!(read(a, "policy/policy.safetensors") == read(b, "policy/policy.safetensors"), "the policies differ");
    assert_eq!(String::from_utf8(read(a, "summary.json")), String::from_utf8(read(b, "summary.json")));
}

/// A column of `metrics.csv`.
pub fn column(dir: &Path, name: &str) -> Vec<f64> {
    let text = String::from_utf8(read(dir, "metrics.csv")).unwrap();
    let mut lines = text.lines();
    let at = lines.next().unwrap().split(',').position(|n| n == name).unwrap_or_else(|| panic!("no column {name}"));
    lines.filter_map(|l| l.split(',').nth(at)?.parse().ok()).collect()
}
