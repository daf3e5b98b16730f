//! The program `train` as a person uses it.

use egogen::body::{BETAS, BodyModel, MARKER_DIM, ORIENT, PARAMS, rotation};
use egogen::motion::{CONTINUOUS, MotionConfig, MotionWeights, PredictorSizes, RegressorSizes};
use egogen::sim::{SeedBank, SeedMotion};
use egogen_train::primitives::init;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Few, short epochs.
const SHORT: [&str; 6] = ["--set", "run.epoch_steps=4096", "--set", "test.episodes=8", "--set", "checkpoint.every=1"];

fn train(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_train")).args(args).output().expect("the program starts")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn run(epochs: u32, out: &Path, more: &[&str]) {
    let (epochs, out) = (format!("run.epochs={epochs}"), out.to_str().unwrap());
    let output = train(&[&["point", "--out", out, "--set", &epochs], SHORT.as_slice(), more].concat());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
}

fn read(dir: &Path, file: &str) -> Vec<u8> {
    fs::read(dir.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

fn assert_same_run(a: &Path, b: &Path, checkpoint: &str) {
    assert_eq!(String::from_utf8(read(a, "metrics.csv")), String::from_utf8(read(b, "metrics.csv")));
    for file in ["model.safetensors", "optimizer.safetensors", "state.bin"] {
        let file = format!("checkpoints/{checkpoint}/{file}");
        assert!(read(a, &file) == read(b, &file), "{file} differs");
    }
    assert_eq!(read(a, "policy/policy.json"), read(b, "policy/policy.json"));
    assert_eq!(read(a, "summary.json"), read(b, "summary.json"));
}

fn column(dir: &Path, name: &str) -> Vec<f64> {
    let text = String::from_utf8(read(dir, "metrics.csv")).unwrap();
    let mut lines = text.lines();
    let at = lines.next().unwrap().split(',').position(|n| n == name).unwrap_or_else(|| panic!("no column {name}"));
    lines.filter_map(|l| l.split(',').nth(at)?.parse().ok()).collect()
}

#[test]
fn a_point_learns_to_reach_its_goal() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let output = train(&["point", "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let (noisy, mean) = (column(&out, "test_sto/success"), column(&out, "test_det/success"));
    assert!(*noisy.last().unwrap() >= 0.95, "with noise {noisy:?}");
    assert!(mean.iter().any(|&s| s >= 0.9), "with the mean action {mean:?}");
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

#[test]
fn a_resumed_run_and_another_thread_count_give_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let [whole, parts, single] = ["whole", "parts", "single"].map(|n| dir.path().join(n));
    run(4, &whole, &[]);
    run(4, &single, &["--threads", "1"]);
    assert_same_run(&whole, &single, "epoch-0004");
    run(2, &parts, &[]);
    let output = train(&["--resume", parts.to_str().unwrap(), "--set", "run.epochs=4"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_same_run(&whole, &parts, "epoch-0004");
}

/// Options whose state outlives an update.
#[test]
fn schedules_and_normalisers_resume() {
    let dir = tempfile::tempdir().unwrap();
    let [whole, parts] = ["whole", "parts"].map(|n| dir.path().join(n));
    let options = [
        "adam.schedule={ adaptive = { target_kl = 0.02 } }",
        "ppo.reward_normalization=true",
        "policy.obs_norm=true",
        "ppo.recompute_advantage=true",
        "ppo.value_clip=true",
        "ppo.dual_clip=2.0",
        "ppo.target_kl=0.5",
    ];
    let sets: Vec<&str> = options.iter().flat_map(|s| ["--set", s]).collect();
    run(4, &whole, &sets);
    run(2, &parts, &sets);
    let output = train(&["--resume", parts.to_str().unwrap(), "--set", "run.epochs=4"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_same_run(&whole, &parts, "epoch-0004");
    let rates = column(&whole, "loss/learning_rate");
    assert!(rates.iter().any(|r| (r - 1e-3).abs() > 1e-6), "the step size adapts: {rates:?}");
}

#[test]
fn damaged_checkpoints_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [whole, hurt] = ["whole", "hurt"].map(|n| dir.path().join(n));
    run(3, &whole, &[]);
    run(2, &hurt, &[]);
    let cut = |epoch: &str| {
        let model = hurt.join("checkpoints").join(epoch).join("model.safetensors");
        let bytes = fs::read(&model).unwrap();
        fs::write(&model, &bytes[..bytes.len() / 2]).unwrap();
    };
    cut("epoch-0002");
    // The one before serves, and the run ends where it would have.
    let resume = ["--resume", hurt.to_str().unwrap(), "--set", "run.epochs=3"];
    let output = train(&resume);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(stderr(&output).contains("epoch-0002") && stderr(&output).contains("damaged"), "{}", stderr(&output));
    assert_same_run(&whole, &hurt, "epoch-0003");
    for epoch in fs::read_dir(hurt.join("checkpoints")).unwrap() {
        cut(epoch.unwrap().file_name().to_str().unwrap());
    }
    let output = train(&resume);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("no whole checkpoint"), "{}", stderr(&output));
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
    let plan = show(&["point", "--dry-run", "--set", "ppo.clip=0.25"]);
    // Trunk 64 over 4 floats; a block and an output layer each for 4 and for 1.
    let parameters = 64 * 5 + 2 * (2 * 64 * 65) + 65 * 4 + 65;
    assert!(plan.contains("clip = 0.25") && plan.contains(&format!("parameters: {parameters}")), "{plan}");
    assert_eq!(fs::read_dir(&dir).unwrap().count(), 0);
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_saves_and_continues() {
    let dir = tempfile::tempdir().unwrap();
    let [whole, cut] = ["whole", "cut"].map(|n| dir.path().join(n));
    let common = [SHORT.as_slice(), &["--set", "run.epoch_steps=65536", "--set", "run.epochs=2"]].concat();
    let start = |out: &Path| {
        let args = [&["point", "--out", out.to_str().unwrap()], common.as_slice()].concat();
        Command::new(env!("CARGO_BIN_EXE_train")).args(args).stderr(Stdio::null()).spawn().unwrap()
    };
    let mut child = start(&cut);
    let begun = Instant::now();
    while !cut.join("metrics.csv").exists() && begun.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(150));
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let code = child.wait().unwrap().code();
    assert_eq!(code, Some(130), "interrupted runs exit with 130");
    let output = train(&["--resume", cut.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(start(&whole).wait().unwrap().code(), Some(0));
    assert_same_run(&whole, &cut, "epoch-0002");
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
        "test.episodes=4",
        "test.every=1",
        "checkpoint.every=1",
    ];
    let sizes = ["policy.gru={ state = 16, egosensing = 8 }", "policy.trunk=16"];
    let sets: Vec<&str> = small.iter().chain(&sizes).chain([&motion.as_str()]).flat_map(|s| ["--set", s]).collect();
    let [whole, parts] = ["whole", "parts"].map(|n| dir.path().join(n));
    let start = |out: &Path, epochs: &str| {
        let output = train(&[&["quick", "--out", out.to_str().unwrap(), "--set", epochs], sets.as_slice()].concat());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    };
    start(&whole, "run.epochs=2");
    start(&parts, "run.epochs=1");
    let output = train(&["--resume", parts.to_str().unwrap(), "--set", "run.epochs=2"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_same_run(&whole, &parts, "epoch-0002");
    let bundle = egogen::agent::bundle::Bundle::read(&whole.join("policy")).unwrap();
    bundle.require("body", BodyModel::embedded().hash()).unwrap();
    assert!(bundle.require("motion", "another").unwrap_err().to_string().contains("motion another"));
}
