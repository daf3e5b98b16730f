//! The program `train` as a person uses it.

mod common;

use common::{assert_same_run, column, stderr, succeed, train};
use egogen::body::{BETAS, BodyModel, MARKER_DIM, ORIENT, PARAMS, rotation};
use egogen::motion::{CONTINUOUS, MotionConfig, MotionWeights, PredictorSizes, RegressorSizes};
use egogen::sim::{SeedBank, SeedMotion};
use egogen_train::primitives::init;
use egogen_train::select::{Quality, Selection};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

#[test]
fn a_point_learns_to_reach_its_goal() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    succeed(&["point", "--out", out.to_str().unwrap()]);
    let (noisy, mean) = (column(&out, "test_sto/success"), column(&out, "test_det/success"));
    assert!(*noisy.last().unwrap() >= 0.95, "with noise {noisy:?}");
    assert!(*mean.last().unwrap() >= 0.9, "with the mean action {mean:?}");
    // The first minibatch sees the policy that collected: its ratios differ from 1 by rounding only.
    assert!(column(&out, "loss/first_ratio_error").iter().all(|&e| e < 1e-4));
    assert!(*column(&out, "loss/explained_variance").last().unwrap() > 0.5);
    for file in ["recipe.toml", "timing.csv", "summary.json", "policy/policy.json", "policy/policy.safetensors"] {
        assert!(out.join(file).is_file(), "{file} is missing");
    }
    assert!(fs::read_dir(out.join("tensorboard")).unwrap().count() > 0);
    assert!(fs::read_dir(out.join("checkpoints")).unwrap().count() <= 3, "the last two and the best are kept");
    egogen::agent::bundle::Bundle::read(&out.join("policy")).expect("the bundle is whole");
}

/// Two seeds are the runs that each would be alone; the same command again does only what is missing.
#[test]
fn seeds_are_trained_once_and_tabulated() {
    let dir = tempfile::tempdir().unwrap();
    let [many, one] = ["many", "one"].map(|n| dir.path().join(n));
    let small = ["--set", "run.epochs=1", "--set", "run.epoch_steps=4096", "--set", "adam.schedule=constant"];
    let args = |rest: &[&'static str], out: &Path| {
        [&["point"], rest, &small, &["--out"]]
            .concat()
            .into_iter()
            .map(String::from)
            .chain([out.to_str().unwrap().into()])
            .collect::<Vec<_>>()
    };
    let run = |rest: &[&'static str], out: &Path| succeed(&args(rest, out).iter().map(String::as_str).collect::<Vec<_>>());
    run(&["--seeds", "1", "--seed", "4"], &many);
    let before = fs::metadata(many.join("seed-4/metrics.csv")).unwrap().modified().unwrap();
    // As if the second run had been killed at once.
    fs::create_dir_all(many.join("seed-5")).unwrap();
    fs::copy(many.join("seed-4/recipe.toml"), many.join("seed-5/recipe.toml")).unwrap();
    let noted = fs::read_to_string(many.join("seed-5/recipe.toml")).unwrap();
    fs::write(many.join("seed-5/recipe.toml"), noted.replace("seed = 4", "seed = 5")).unwrap();
    let told = run(&["--seeds", "2", "--seed", "4"], &many);
    assert!(told.contains("seed-4: is finished") && told.contains("seed-5: goes on"), "{told}");
    assert_eq!(fs::metadata(many.join("seed-4/metrics.csv")).unwrap().modified().unwrap(), before);
    run(&["--seed", "5"], &one);
    assert_same_run(&one, &many.join("seed-5"), "epoch-0001");

    let last = |seed: &str| *column(&many.join(seed), "test_sto/return").last().unwrap();
    let (a, b) = (last("seed-4"), last("seed-5"));
    assert_ne!(a, b);
    let table = fs::read_to_string(many.join("seeds.csv")).unwrap();
    let line = table.lines().find(|l| l.starts_with("test_sto/return,")).unwrap();
    let have: Vec<f64> = line.split(',').skip(1).map(|v| v.parse().unwrap()).collect();
    // With two runs nothing is cut, and resamples are both of the first, both of the second, or one of each.
    let mean = (a + b) / 2.0;
    for (have, want) in have.iter().zip([mean, a.min(b), a.max(b), mean, a.min(b), a.max(b), 2.0]) {
        assert!((have - want).abs() < 1e-3, "{line}: runs {a} and {b}");
    }
    let other = args(&["--seeds", "2", "--seed", "4", "--set", "ppo.gamma=0.5"], &many);
    let output = train(&other.iter().map(String::as_str).collect::<Vec<_>>());
    assert_eq!(output.status.code(), Some(2));
    let told = stderr(&output);
    assert!(["seed-4", "ppo.gamma", "0.95", "0.5"].iter().all(|w| told.contains(w)), "{told}");
}

#[test]
fn bad_input_is_told_and_nothing_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| -> PathBuf {
        let path = dir.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    let good = include_str!("../train/recipes/point.toml");
    let unknown = file("unknown.toml", &good.replace("[ppo]", "[ppo]\nclipp = 0.3"));
    let kind = file("kind.toml", &good.replace("lr = 1e-3", "lr = \"fast\""));
    let out = dir.path().join("run");
    let cases: [(&[&str], &[&str]); 12] = [
        (&["nothing"], &["'nothing'", "quick", ".toml"]),
        (&["absent.toml"], &["absent.toml"]),
        (&[unknown.to_str().unwrap()], &["unknown.toml", "clipp", "expected"]),
        (&[kind.to_str().unwrap()], &["kind.toml", "lr", "fast"]),
        (&["point", "--set", "ppo.clip=1.5"], &["ppo.clip", "1.5", "between 0 and 1"]),
        (&["point", "--set", "run.collect_steps=1000"], &["run.collect_steps", "1000", "multiple of run.envs"]),
        (&["point", "--set", "ppo.dual_clip=0.5"], &["ppo.dual_clip", "0.5", "above 1"]),
        (&["point", "--set", "adam.schedule={ adaptive = { target_kl = 0.0 } }"], &["adam.schedule.adaptive.target_kl", "0", "above 0"]),
        (&["point", "--set", "ppo.nonsense=1"], &["nonsense", "expected"]),
        (&["point", "--set", "env=moon"], &["moon", "point"]),
        (&["point", "--set", "checkpoint.best=glory"], &["checkpoint.best", "glory", "test_det/success"]),
        (&["point", "--threads", "0"], &["--threads", "at least 1"]),
    ];
    for (args, words) in cases {
        let output = train(&[args, &["--out", out.to_str().unwrap()]].concat());
        assert_eq!(output.status.code(), Some(2), "{args:?}: {}", stderr(&output));
        let text = stderr(&output);
        assert!(words.iter().all(|w| text.contains(w)), "{args:?} should name {words:?}: {text}");
        assert!(!out.exists(), "{args:?} left a run folder");
    }
    assert_eq!(train(&["--no-such-option"]).status.code(), Some(2));
    assert_eq!(train(&["--resume", dir.path().to_str().unwrap()]).status.code(), Some(2));
    let output = train(&["point", "--out", dir.path().to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("not empty"));
}

#[test]
fn looking_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let show = |args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_train")).args(args).current_dir(&dir).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let list = show(&["--list"]);
    assert!(["quick", "paper", "point"].iter().all(|n| list.contains(n)), "{list}");
    let plan = show(&["point", "--dry-run", "--seeds", "3", "--set", "ppo.clip=0.25"]);
    // Trunk 64 over 4 floats; a block and an output layer each for 4 and for 1.
    let parameters = 64 * 5 + 2 * (2 * 64 * 65) + 65 * 4 + 65;
    assert!(plan.contains("clip = 0.25") && plan.contains(&format!("parameters: {parameters}")), "{plan}");
    assert!(["# time: about", "minutes for 3 seeds"].iter().all(|w| plan.contains(w)), "{plan}");
    assert_eq!(fs::read_dir(&dir).unwrap().count(), 0);
}

/// A motion model that has learned nothing, and one upright seed, once to train and once to test from.
fn untrained_motion(dir: &Path) {
    let body = BodyModel::embedded();
    let shaped = body.shape(&[0.0; BETAS]);
    let mut params = [0.0; PARAMS];
    let up = glam::Mat3::from_rotation_z(std::f32::consts::PI) * glam::Mat3::from_rotation_x(std::f32::consts::FRAC_PI_2);
    rotation::to_axis_angle(&up).write_to_slice(&mut params[ORIENT]);
    params[2] = 0.95;
    let mut markers = vec![0.0; MARKER_DIM];
    shaped.markers(&shaped.pose(&params), &mut markers);
    let predictor = PredictorSizes { hidden: 16, wide: 16, latent: 8, ..Default::default() };
    let regressor = RegressorSizes { width: 16, blocks: 1, passes: 1 };
    let config = MotionConfig { predictor, regressor, ..MotionConfig::new(body.hash()) };
    let (p, r) = (init::predictor(predictor, 1, &markers), init::regressor(regressor, 1, &markers, &[0.0; CONTINUOUS]));
    MotionWeights::save(dir, &config, &p, &r).unwrap();
    let seed = SeedMotion { params: [params, params].concat(), betas: [0.0; BETAS] };
    SeedBank { seeds: vec![seed.clone(), seed] }.write(dir.join("seeds.safetensors"), &body).unwrap();
}

#[test]
fn the_motion_task_trains_and_resumes() {
    let dir = tempfile::tempdir().unwrap();
    let motion = dir.path().join("motion");
    untrained_motion(&motion);
    let motion = format!("env_options.motion={}", motion.display());
    let small = [
        "run.envs=8",
        "run.collect_steps=32",
        "run.epoch_steps=64",
        "ppo.batch=32",
        // A schedule over the whole run would differ between one epoch and two.
        "adam.schedule=constant",
        "test.episodes=4",
        "test.every=1",
        "checkpoint.every=1",
        "env_options.task.latents=4",
        "checkpoint.keep_every=1",
        "select={ starts = 5, finalist_starts = 6 }",
    ];
    let sizes = ["policy.gru={ state = 16, egosensing = 8 }", "policy.trunk=16"];
    let sets: Vec<&str> = small.iter().chain(&sizes).chain([&motion.as_str()]).flat_map(|s| ["--set", s]).collect();
    let [whole, parts] = ["whole", "parts"].map(|n| dir.path().join(n));
    let start = |out: &Path, epochs: &str| {
        succeed(&[&["quick", "--out", out.to_str().unwrap(), "--set", epochs], sets.as_slice()].concat());
    };
    start(&whole, "run.epochs=2");
    start(&parts, "run.epochs=1");
    succeed(&["--resume", parts.to_str().unwrap(), "--set", "run.epochs=2"]);
    assert_same_run(&whole, &parts, "epoch-0002");
    assert_eq!(common::read(&whole, "selection.json"), common::read(&parts, "selection.json"));
    let selection = Selection::read(&whole).unwrap().unwrap();
    assert_eq!((selection.candidates.entries.len(), selection.candidates.starts, selection.finalists.starts), (2, 5, 6));
    let quality = |q: Option<Quality>| q.is_some_and(|q| q.pose_norm > 0.0 && q.bone_error_mm > 0.0);
    assert!(quality(selection.prior) && selection.candidates.entries.iter().all(|e| quality(e.figures.quality)));
    succeed(&["report", whole.to_str().unwrap(), "--films", "2"]);
    let page = fs::read_to_string(whole.join("report.html")).unwrap();
    assert!(page.contains("The chosen policy: whole") && page.matches("data:image/png;base64,").count() == 2);
    let bundle = egogen::agent::bundle::Bundle::read(&whole.join("policy")).unwrap();
    bundle.require("body", BodyModel::embedded().hash()).unwrap();
    assert!(bundle.require("motion", "another").unwrap_err().to_string().contains("motion another"));
}
