//! The authors' own files through the programs: networks of their layouts at reduced width become a motion model that people walk on.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

fn start(program: &str, args: &[&str]) -> Output {
    Command::new(program).args(args).output().expect("the program starts")
}

fn done(program: &str, args: &[&str]) -> String {
    let output = start(program, args);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{args:?}: {message}");
    message
}

fn refused(program: &str, args: &[&str], words: &[&str]) {
    let output = start(program, args);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert!(words.iter().all(|w| message.contains(w)), "{words:?}: {message}");
}

fn asset(name: &str) -> String {
    Path::new(ROOT).join("tests/fixtures/assets").join(name).display().to_string()
}

/// Imports both networks onto `body`.
fn import(body: &str, out: &Path) -> Vec<String> {
    let args = ["import", "--predictor", &asset("predictor.ckp"), "--regressor", &asset("regressor.ckp"), "--body", body, "--out"];
    args.iter().map(|s| s.to_string()).chain([out.display().to_string()]).collect()
}

fn texts(args: &[String]) -> Vec<&str> {
    args.iter().map(String::as_str).collect()
}

#[test]
fn the_authors_networks_walk() {
    let dir = tempfile::tempdir().unwrap();
    let [model, policy, out] = ["model", "policy", "out"].map(|n| dir.path().join(n));
    let body = Path::new(ROOT).join("checkpoints/body/body.safetensors");
    done(env!("CARGO_BIN_EXE_primitives"), &texts(&import(body.to_str().unwrap(), &model)));
    fs::copy(Path::new(ROOT).join("checkpoints/motion/seeds.safetensors"), model.join("seeds.safetensors")).unwrap();
    let [model, policy, out]: [PathBuf; 3] = [model, policy, out];
    let [model, policy, out] = [&model, &policy, &out].map(|p| p.to_str().unwrap());
    let checkpoint = asset("policy.pth");
    done(env!("CARGO_BIN_EXE_export"), &[&checkpoint, "--model", model, "--out", policy]);
    done(env!("CARGO_BIN_EXE_evaluate"), &[policy, "--model", model, "--episodes", "3", "--no-baselines", "--out", out]);
    let report = fs::read_to_string(Path::new(out).join("report.json")).unwrap();
    assert!(report.contains("deterministic"), "{report}");
    // The policy belongs to this motion model.
    refused(env!("CARGO_BIN_EXE_evaluate"), &[policy, "--episodes", "3", "--out", out], &["the policy was trained on motion"]);
}

#[test]
fn wrong_files_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let (primitives, export) = (env!("CARGO_BIN_EXE_primitives"), env!("CARGO_BIN_EXE_export"));
    let out = dir.path().join("out");
    refused(primitives, &texts(&import(&asset("policy.pth"), &out)), &["policy.pth"]);
    let mut swapped = import("nowhere", &out);
    swapped[2] = asset("regressor.ckp");
    refused(primitives, &texts(&swapped), &["regressor.ckp", "none of the tensors looked for"]);
    let (policy, out) = (asset("policy.pth"), out.display().to_string());
    refused(export, &[&policy, "--out", &out], &["--model is missing"]);
    refused(export, &[&asset("predictor.ckp"), "--model", &out, "--out", &out], &["predictor.ckp"]);
    let garbage = dir.path().join("garbage.pth");
    fs::write(&garbage, b"\x80\x02cos\nsystem\nU\x08echo bad\x85R.").unwrap();
    refused(export, &[garbage.to_str().unwrap(), "--model", &out, "--out", &out], &["garbage.pth", "is no checkpoint of PyTorch"]);
    assert!(!Path::new(&out).exists(), "nothing is left behind");
}
