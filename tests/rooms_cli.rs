//! Rooms and scene bundles as the scenes of the walking task, through the programs.

use egogen::scene::SceneBundle;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn run(program: &str, args: &[&str], dir: &Path) -> Output {
    Command::new(program).args(args).current_dir(dir).output().expect("the program starts")
}

fn done(program: &str, args: &[&str], dir: &Path) -> String {
    let output = run(program, args, dir);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn refused(program: &str, args: &[&str], dir: &Path, words: &[&str]) {
    let output = run(program, args, dir);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    let named = words.iter().all(|w| message.contains(w));
    assert!(output.status.code() == Some(2) && named, "{args:?}: {words:?}: {:?} {message}", output.status.code());
}

fn scene(seed: &str, out: &str, dir: &Path) {
    let args = ["room", "--kind", "corridor", "--seed", seed, "--voxel", "0.1", "--pairs-count", "20", "--out", out];
    done(env!("CARGO_BIN_EXE_scene"), &args, dir);
}

#[test]
fn scenes_of_ones_own_are_trained_evaluated_and_played_in() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    scene("3", "scenes/a", dir);
    scene("4", "scenes/b", dir);
    let task = ["--set", "rooms.bundles.train=[\"scenes/a\"]", "--set", "rooms.bundles.validation=[\"scenes/b\"]", "--set", "max_depth=5"];
    let of_run: Vec<String> = task.iter().map(|t| if *t == "--set" { (*t).into() } else { format!("env_options.task.{t}") }).collect();
    let small =
        ["run.epochs=1", "run.epoch_steps=128", "run.envs=16", "run.collect_steps=128", "run.shards=1", "ppo.batch=64", "test.episodes=4"];
    let mut args = vec!["quick", "--out", "run"];
    args.extend(small.iter().flat_map(|s| ["--set", s]));
    args.extend(of_run.iter().map(String::as_str));
    done(env!("CARGO_BIN_EXE_train"), &args, dir);
    let with_task = |args: &[&'static str]| [args, &task].concat();
    let table = done(env!("CARGO_BIN_EXE_evaluate"), &with_task(&["run/policy", "--no-baselines", "--episodes", "3"]), dir);
    assert!(table.contains("quick, deterministic"), "{table}");
    done(env!("CARGO_BIN_EXE_play"), &with_task(&["run/policy", "--starts", "1", "--films", "1", "--out", "play"]), dir);
    for name in ["paths.png", "start-000-film.png", "start-000-ghosts.png"] {
        assert!(fs::read(dir.join("play").join(name)).unwrap().len() > 5000, "{name}");
    }
    // The room itself is in the file of the motion.
    let bytes = fs::read(dir.join("play/start-000.glb")).unwrap();
    let size = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + size]).unwrap();
    assert!(json["meshes"].as_array().unwrap().iter().filter(|m| m["name"] == "room").count() > 2);
}

#[test]
fn scenes_that_cannot_be_played_in_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    scene("3", "good", dir);
    let mut bundle = SceneBundle::read(&dir.join("good")).unwrap();
    bundle.pairs.clear();
    bundle.write(&dir.join("no-pairs"), b"").unwrap();
    let play = env!("CARGO_BIN_EXE_play");
    let train = |set: &'static str| ["zero", "--starts", "1", "--set", set];
    refused(play, &train("rooms.bundles.train=[\"no-pairs\"]"), dir, &["no-pairs", "holds no pairs"]);
    refused(play, &train("rooms.bundles.train=[\"good\", \"gone\"]"), dir, &["gone", "scene.json"]);
    refused(play, &train("rooms.bundles.train=[]"), dir, &["rooms.bundles.train"]);
    refused(play, &train("rooms.bundles.trains=[\"good\"]"), dir, &["trains"]);
    fs::write(dir.join("good/scene.safetensors"), "no").unwrap();
    refused(play, &train("rooms.bundles.train=[\"good\"]"), dir, &["scene.safetensors"]);
    let args = ["quick", "--out", "run", "--set", "env_options.task.rooms.bundles.train=[\"gone\"]"];
    refused(env!("CARGO_BIN_EXE_train"), &args, dir, &["gone"]);
}
