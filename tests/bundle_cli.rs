//! Policies as bundles: exported from runs, checked when read, and trained on.

use egogen::agent::bundle::Bundle;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn start(program: &str, args: &[&str]) -> Output {
    Command::new(program).args(args).output().expect("the program starts")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn train(out: &Path, more: &[&str]) -> Output {
    let short = ["--set", "run.epochs=1", "--set", "run.epoch_steps=4096", "--set", "test.episodes=8"];
    start(env!("CARGO_BIN_EXE_train"), &[&["point", "--out", out.to_str().unwrap()], short.as_slice(), more].concat())
}

fn assert_ok(output: &Output) {
    assert_eq!(output.status.code(), Some(0), "{}", stderr(output));
}

fn description(dir: &Path) -> Value {
    serde_json::from_slice(&fs::read(dir.join("policy.json")).unwrap()).unwrap()
}

#[test]
fn the_shipped_policies_are_whole() {
    for name in ["quick", "sparse", "crowded"] {
        Bundle::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../checkpoints/policy").join(name)).unwrap();
    }
}

#[test]
fn runs_are_exported_and_what_does_not_fit_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [run, out] = ["run", "out"].map(|n| dir.path().join(n));
    assert_ok(&train(&run, &["--set", "policy.obs_norm=true"]));
    assert_ok(&start(env!("CARGO_BIN_EXE_export"), &[run.to_str().unwrap(), "--out", out.to_str().unwrap()]));
    for file in ["policy.json", "policy.safetensors"] {
        assert!(fs::read(run.join("policy").join(file)).unwrap() == fs::read(out.join(file)).unwrap(), "{file} differs");
    }
    let whole = description(&out);
    let golden = &whole["golden"];
    assert_eq!(["obs", "mu", "logvar"].map(|k| golden[k].as_array().unwrap().len()), [4, 2, 2]);
    let refused = |change: &dyn Fn(&mut Value), words: &[&str]| {
        let mut d = whole.clone();
        change(&mut d);
        fs::write(out.join("policy.json"), d.to_string()).unwrap();
        let output = train(&dir.path().join("never"), &["--init", out.to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        assert!(words.iter().all(|w| stderr(&output).contains(w)), "{words:?}: {}", stderr(&output));
    };
    refused(&|d| d["golden"]["mu"][1] = 0.5.into(), &["policy.json", "golden.mu[1] is 0.5", "does not fit"]);
    refused(&|d| d["golden"]["value"] = 9.0.into(), &["golden.value[0] is 9"]);
    refused(&|d| d["format"] = 1.into(), &["policy.json", "format is 1, expected 2", "export it again"]);
    assert!(!dir.path().join("never").exists());
}

#[test]
fn training_begins_from_a_policy() {
    let dir = tempfile::tempdir().unwrap();
    let [first, second, still] = ["first", "second", "still"].map(|n| dir.path().join(n));
    assert_ok(&train(&first, &[]));
    let policy = first.join("policy");
    let init = ["--init", policy.to_str().unwrap()];
    // With steps of size next to nothing the weights stay what they were.
    assert_ok(&train(&still, &[&init[..], &["--seed", "7", "--set", "adam.lr=1e-12"]].concat()));
    let [from, to] = [&policy, &still.join("policy")].map(|d| Bundle::read(d).unwrap());
    assert!(from.params.iter().zip(&to.params).all(|(a, b)| (a - b).abs() < 1e-6), "the weights are not the bundle's");
    assert_eq!(to.origin["init"], from.weights_hash());
    assert_eq!(to.trained.env_steps, 4096, "steps are counted anew");
    assert!(!from.origin.contains_key("init"));
    // A continued run remembers.
    assert_ok(&train(&second, &init));
    assert_ok(&start(env!("CARGO_BIN_EXE_train"), &["--resume", second.to_str().unwrap(), "--set", "run.epochs=2"]));
    assert_eq!(Bundle::read(&second.join("policy")).unwrap().origin["init"], from.weights_hash());
    for (set, words) in [
        ("policy.trunk=32", &["--init", "policy.trunk is 32 here, 64 in the bundle"][..]),
        ("policy.blocks=2", &["policy.blocks is 2 here, 1 in the bundle"]),
        ("env=pendulum", &["action is 1 here, 2 in the bundle"]),
    ] {
        let never = dir.path().join("never");
        for look in [&[][..], &["--dry-run"]] {
            let best = "checkpoint.best=test_det/return";
            let output = train(&never, &[&init[..], &["--set", set, "--set", best], look].concat());
            assert_eq!(output.status.code(), Some(2), "{set}: {}", stderr(&output));
            assert!(words.iter().all(|w| stderr(&output).contains(w)), "{set}: {}", stderr(&output));
        }
        assert!(!never.exists());
    }
}

#[test]
fn a_run_that_explodes_says_what_did() {
    let dir = tempfile::tempdir().unwrap();
    let output = train(&dir.path().join("run"), &["--set", "adam.lr=1e30"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let text = stderr(&output);
    assert!(text.contains("became") && text.contains("adam.lr") && text.contains("no checkpoint was written before"), "{text}");
}
