//! `primitives report` and `primitives export` as a user runs them, on the shipped motion model.

use egogen::motion::amass::read_amass;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/motion");

fn run(arguments: &[&str], dir: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_primitives")).args(arguments).current_dir(dir).output().expect("the program starts")
}

fn succeed(arguments: &[&str], dir: &Path) -> String {
    let done = run(arguments, dir);
    assert!(done.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&done.stderr));
    String::from_utf8_lossy(&done.stdout).into_owned()
}

/// Frames of a motion as .glb and as .npz, which must be equally many.
fn frames(path: &Path) -> usize {
    let bytes = fs::read(path.with_extension("glb")).unwrap();
    let size = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json: Value = serde_json::from_slice(&bytes[20..20 + size]).unwrap();
    let times = json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
    let frames = read_amass(path.with_extension("npz"), "motion", None).unwrap().frames.len();
    assert_eq!(json["accessors"][times]["count"], frames);
    assert!(fs::read(path.with_extension("png")).unwrap().starts_with(b"\x89PNG"));
    frames
}

#[test]
fn motions_are_exported_and_recordings_reported_beside_the_model() {
    let dir = tempfile::tempdir().unwrap();
    // What the model does serves as recordings.
    for seed in ["0", "1", "2"] {
        let out = format!("data/{seed}");
        let arguments = ["export", "--kind", "prior", "--seed", seed, "--primitives", "8", "--panels", "2", "--out", &out];
        assert!(succeed(&arguments, dir.path()).contains("146 frames"));
        assert_eq!(frames(&dir.path().join(out)), 2 + 8 * 18);
    }
    succeed(&["export", "--kind", "turn", "--candidates", "2", "--panels", "2", "--out", "turn"], dir.path());
    assert_eq!(frames(&dir.path().join("turn")), 2 + 11 * 18);
    succeed(&["export", "--file", "data/0.npz", "--panels", "2", "--out", "again"], dir.path());
    assert_eq!(frames(&dir.path().join("again")), 146);
    succeed(&["export", "--clip", "0~mirror", "--data", "data", "--panels", "2", "--out", "clip"], dir.path());
    assert_eq!(frames(&dir.path().join("clip")), 146);

    let told =
        succeed(&["report", "--model", MODEL, "--data", "data", "--people", "4", "--primitives", "3", "--out", "report"], dir.path());
    assert!(told.contains("people who collapsed in the roll-out: 0.000, at most 0: met"), "{told}");
    let report: Value = serde_json::from_slice(&fs::read(dir.path().join("report/report.json")).unwrap()).unwrap();
    let names: Vec<&str> = report["motions"].as_array().unwrap().iter().map(|m| m["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["recordings", "held out", "training set", "model"]);
    assert_eq!(report["motions"][0]["clips"], 2);
    assert_eq!(report["reconstruction"]["clips"][0]["clip"], "1");
    assert_eq!(report["recordings"], true);
    for m in report["motions"].as_array().unwrap() {
        assert!(m["figures"]["contact"]["value"].as_f64().unwrap() > 0.9, "{m}");
    }
    let html = fs::read_to_string(dir.path().join("report/report.html")).unwrap();
    assert!(!html.contains("Made without recordings") && html.contains("Reconstruction of held-out recordings"));
    // Nothing is fetched from anywhere.
    assert!(!html.contains("src=\"http") && !html.contains("href=") && !html.contains("<script"));
}

#[test]
fn a_report_without_recordings_says_so_and_is_the_same_every_time() {
    let dir = tempfile::tempdir().unwrap();
    let report = |out: &str, threads: &str| {
        let arguments = ["report", "--model", MODEL, "--people", "3", "--primitives", "2", "--out", out];
        let done = Command::new(env!("CARGO_BIN_EXE_primitives"))
            .args(arguments)
            .env("RAYON_NUM_THREADS", threads)
            .current_dir(dir.path())
            .output();
        assert!(done.unwrap().status.success());
        ["report.json", "report.html"].map(|file| fs::read_to_string(dir.path().join(out).join(file)).unwrap())
    };
    let [json, html] = report("a", "1");
    assert!(html.contains("Made without recordings"));
    assert!([json, html] == report("b", "2"), "the reports differ");
}

#[test]
fn mistakes_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let fails = |arguments: &[&str], expected: &str| {
        let done = run(arguments, dir.path());
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.code() == Some(2) && message.contains(expected), "{arguments:?}: {message}");
    };
    fails(&["report", "--model", "nowhere"], "nowhere");
    fails(&["report", "--model", MODEL, "--data", "nowhere"], "nowhere");
    fails(&["report", "--model", MODEL, "--people", "0"], "--people");
    fails(&["export"], "--kind");
    fails(&["export", "--kind", "hop"], "hop");
    fails(&["export", "--kind", "side", "--file", "walk.npz"], "--file");
    fails(&["export", "--kind", "side", "--candidates", "0"], "--candidates");
    fails(&["export", "--clip", "walk"], "--data");
    fails(&["export", "--file", "walk.npz"], "walk.npz");
    fails(&["export", "--file", "walk.fbx"], "is of no known kind");
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left behind");
}
