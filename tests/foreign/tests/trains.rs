//! Another crate's environment and reward term in the program `train`.

#[path = "../src/carts.rs"]
mod carts;

use egogen_envs::conformance::{Effort, check};
use std::path::Path;
use std::process::Command;

/// Trains with this crate's program.
fn train(args: &[&str], out: &Path) {
    let output = Command::new(env!("CARGO_BIN_EXE_foreign")).args(args).args(["--threads", "1", "--out"]).arg(out).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The only value of a column of a run's metrics.
fn figure(out: &Path, name: &str) -> f64 {
    let text = std::fs::read_to_string(out.join("metrics.csv")).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let at = lines[0].split(',').position(|n| n == name).unwrap_or_else(|| panic!("no column {name}"));
    assert_eq!(lines.len(), 2);
    lines[1].split(',').nth(at).unwrap().parse().unwrap()
}

#[test]
fn carts_conform() {
    check(|n, seed| Box::new(carts::Carts::new(n, seed)), Effort { steps: 60, ..Effort::default() });
}

#[test]
fn carts_learn_within_an_epoch() {
    let dir = tempfile::tempdir().unwrap();
    let recipe = concat!(env!("CARGO_MANIFEST_DIR"), "/recipe.toml");
    let out = dir.path().join("run");
    train(&[recipe], &out);
    assert!(figure(&out, "step/effort") < 0.0);
    let last = figure(&out, "test_det/return");
    // A cart that is left alone stays 1/2 away on average: -25 over 50 steps.
    assert!(last > -20.0, "{last}");
}

#[test]
fn a_reward_term_of_ones_own_counts() {
    let dir = tempfile::tempdir().unwrap();
    let small = "run.epochs=1 run.envs=4 run.collect_steps=16 run.epoch_steps=16 ppo.batch=16 test.episodes=1 policy.trunk=16 \
                 policy.gru={state=16,egosensing=8} env_options.terms.upright=2.0";
    let args: Vec<&str> = ["quick"].into_iter().chain(small.split_whitespace().flat_map(|change| ["--set", change])).collect();
    let out = dir.path().join("run");
    train(&args, &out);
    // Twice the half metre from a standing person's pelvis to the head.
    let upright = figure(&out, "step/upright");
    assert!((0.6..1.6).contains(&upright), "{upright}");
    let output = Command::new(env!("CARGO_BIN_EXE_foreign")).args(["quick", "--dry-run", "--set", "env_options.terms.uprigt=1"]).output();
    let output = output.unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && told.contains("uprigt") && told.contains("\"upright\""), "{told}");
}
