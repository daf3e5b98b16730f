//! Runs of `train` that are cut off, killed, damaged or out of space continue as if nothing had happened.
#![cfg(unix)]

mod common;

use common::{assert_same_run, column, program, read, stderr, succeed, train};
use egogen_train::checkpoint::list;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Short epochs of the recipe `point`, each with a checkpoint.
const POINT: &[&str] = &["point", "run.epoch_steps=4096", "test.episodes=8", "test.every=1", "checkpoint.every=1"];
/// Epochs so short that most of the time goes into files.
const TINY: &[&str] = &[
    "point",
    "run.envs=8",
    "run.collect_steps=64",
    "run.epoch_steps=128",
    "ppo.batch=32",
    "policy.trunk=16",
    "test.episodes=4",
    "test.every=1",
    "checkpoint.every=1",
];
const CARTPOLE: &[&str] = &["cartpole", "run.epoch_steps=512", "ppo.passes=4", "test.episodes=2", "test.every=1", "checkpoint.every=1"];
/// Options whose state outlives an update.
const STATE: &[&str] = &[
    "adam.schedule={ adaptive = { target_kl = 0.02 } }",
    "ppo.reward_normalization=true",
    "ppo.reward_scaling=true",
    "policy.obs_norm=true",
    "ppo.recompute_advantage=true",
    "ppo.value_clip=true",
    "ppo.dual_clip=2.0",
    "ppo.target_kl=0.5",
];

/// Arguments for a run: the recipe and its changes.
fn args<'a>(recipe: &[&'a str], out: &'a Path) -> Vec<&'a str> {
    let sets = recipe[1..].iter().flat_map(|change| ["--set", *change]);
    [recipe[0], "--out", text(out)].into_iter().chain(sets).collect()
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are plain")
}

/// Runs that many epochs in `dir/name`.
fn run(dir: &Path, name: &str, recipe: &[&str], epochs: u32) -> PathBuf {
    let (out, epochs) = (dir.join(name), format!("run.epochs={epochs}"));
    succeed(&args(&[recipe, &[epochs.as_str()]].concat(), &out));
    out
}

/// A copy of a run's folder.
fn copy(from: &Path, to: PathBuf) -> PathBuf {
    let done = Command::new("cp").arg("-r").args([from, to.as_path()]).status().unwrap();
    assert!(done.success());
    to
}

fn begin(args: &[&str]) -> Child {
    program(args).stderr(Stdio::null()).spawn().unwrap()
}

fn wait_for(path: &Path) {
    let begun = Instant::now();
    while !path.exists() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{} does not come", path.display());
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_resumed_run_and_another_thread_count_give_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let whole = run(dir, "whole", POINT, 4);
    let single = dir.join("single");
    succeed(&[args(&[POINT, &["run.epochs=4"]].concat(), &single), vec!["--threads", "1"]].concat());
    assert_same_run(&whole, &single, "epoch-0004");
    let parts = run(dir, "parts", POINT, 2);
    succeed(&["--resume", text(&parts), "--set", "run.epochs=4"]);
    assert_same_run(&whole, &parts, "epoch-0004");
    // Nothing is left to do, and that changes nothing.
    succeed(&["--resume", text(&parts)]);
    assert_same_run(&whole, &parts, "epoch-0004");
}

/// The motion task with the network of `quick`, which learns on all threads.
#[test]
fn people_learn_the_same_bytes_on_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let small = ["run.epochs=2", "run.envs=24", "run.collect_steps=96", "run.epoch_steps=192", "ppo.batch=48"];
    let recipe = [&["quick"], &small[..], &["test.episodes=4", "test.every=1", "checkpoint.every=1"]].concat();
    let [one, two] = ["1", "2"].map(|threads| {
        let out = dir.path().join(threads);
        succeed(&[args(&recipe, &out), vec!["--threads", threads]].concat());
        out
    });
    assert_same_run(&one, &two, "epoch-0002");
}

#[test]
fn a_killed_run_resumes_with_everything_that_has_state() {
    let dir = tempfile::tempdir().unwrap();
    let held: &[&str] = &["policy.state_noise={ log_std = -1.0, steps = 3 }"];
    for (recipe, rate, own) in [(POINT, 1e-3, held), (CARTPOLE, 1e-3, &[])] {
        let recipe = [recipe, STATE, own, &["run.epochs=12"]].concat();
        let whole = dir.path().join(recipe[0]);
        succeed(&args(&recipe, &whole));
        let rates = column(&whole, "loss/learning_rate");
        assert!(rates.iter().any(|r| (r - rate).abs() > 1e-6), "the step size adapts: {rates:?}");
        for threads in ["1", "2"] {
            let killed = dir.path().join(format!("{}-{threads}", recipe[0]));
            let mut child = begin(&[args(&recipe, &killed), vec!["--threads", threads]].concat());
            wait_for(&killed.join("checkpoints/epoch-0003"));
            child.kill().unwrap();
            assert_eq!(child.wait().unwrap().code(), None, "killed before its end");
            succeed(&["--resume", text(&killed), "--threads", threads]);
            assert_same_run(&whole, &killed, "epoch-0012");
        }
    }
}

/// `EGOGEN_KILLS` says how many.
#[test]
fn a_run_survives_being_killed_at_any_moment() {
    let kills: u64 = std::env::var("EGOGEN_KILLS").map_or(25, |n| n.parse().expect("EGOGEN_KILLS is a number"));
    let dir = tempfile::tempdir().unwrap();
    let recipe = [TINY, STATE, &["run.epochs=60", "checkpoint.keep_every=25"]].concat();
    let whole = dir.path().join("whole");
    let begun = Instant::now();
    succeed(&args(&recipe, &whole));
    let (longest, mut finished) = ((begun.elapsed().as_micros() as u64 / 2).min(1_500_000), 0);
    let mut killed = dir.path().join("killed-0");
    for kill in 0..kills {
        // Before the recipe is there, nothing is lost, and the same command begins again.
        let start = if killed.join("recipe.toml").exists() { vec!["--resume", text(&killed)] } else { args(&recipe, &killed) };
        let mut child = program(&start).stderr(Stdio::piped()).spawn().unwrap();
        // Spread over the time by the golden ratio; where exactly a kill falls is up to the machine.
        std::thread::sleep(Duration::from_micros((kill * 618_034 % 1_000_000) * longest / 1_000_000));
        child.kill().unwrap();
        let output = child.wait_with_output().unwrap();
        assert!(matches!(output.status.code(), None | Some(0)), "after {kill} kills: {}", stderr(&output));
        assert!(!stderr(&output).contains("refused"), "a kill alone damages nothing: {}", stderr(&output));
        if output.status.success() {
            assert_same_run(&whole, &killed, "epoch-0060");
            finished += 1;
            killed = dir.path().join(format!("killed-{finished}"));
        }
    }
    match killed.join("recipe.toml").exists() {
        true => succeed(&["--resume", text(&killed)]),
        false => succeed(&args(&recipe, &killed)),
    };
    assert_same_run(&whole, &killed, "epoch-0060");
    let names = |run: &Path, folder: &str| {
        let mut names: Vec<_> = fs::read_dir(run.join(folder)).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        names
    };
    for folder in ["", "checkpoints", "policy"] {
        assert_eq!(names(&whole, folder), names(&killed, folder), "nothing half done stays");
    }
    assert!(whole.join("checkpoints/epoch-0025").exists() && whole.join("checkpoints/epoch-0050").exists());
}

#[test]
fn an_interrupted_run_saves_and_continues() {
    let dir = tempfile::tempdir().unwrap();
    let [whole, cut] = ["whole", "cut"].map(|n| dir.path().join(n));
    // The interruption falls into an epoch that has no checkpoint of its own, or into the second.
    let recipe = [POINT, &["run.epoch_steps=65536", "run.epochs=2", "checkpoint.every=2"]].concat();
    let mut child = begin(&args(&recipe, &cut));
    wait_for(&cut.join("metrics.csv"));
    std::thread::sleep(Duration::from_millis(150));
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130), "interrupted runs exit with 130");
    succeed(&["--resume", text(&cut)]);
    succeed(&args(&recipe, &whole));
    assert_same_run(&whole, &cut, "epoch-0002");
}

#[test]
fn rows_after_the_checkpoint_are_dropped() {
    let dir = tempfile::tempdir().unwrap();
    let whole = run(dir.path(), "whole", TINY, 4);
    let cut = run(dir.path(), "cut", TINY, 2);
    let metrics = fs::read_to_string(whole.join("metrics.csv")).unwrap();
    let third = metrics.lines().nth(3).unwrap().replace(',', ",9");
    fs::write(cut.join("metrics.csv"), String::from_utf8(read(&cut, "metrics.csv")).unwrap() + &third + "\n4,0.5").unwrap();
    succeed(&["--resume", text(&cut), "--set", "run.epochs=4"]);
    assert_same_run(&whole, &cut, "epoch-0004");
}

/// Each way to spoil the newest checkpoint: what is done, and what the message must name.
#[test]
fn spoiled_checkpoints_are_refused_for_the_one_before() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let recipe = [TINY, &["checkpoint.keep=3"]].concat();
    let whole = run(dir, "whole", &recipe, 4);
    let base = run(dir, "base", &recipe, 3);
    let gamma = run(dir, "gamma", &[&recipe, ["ppo.gamma=0.9"].as_slice()].concat(), 3);
    let cartpole = run(dir, "cartpole", CARTPOLE, 3);
    let wide = run(dir, "wide", &[&recipe, ["policy.trunk=24"].as_slice()].concat(), 3);
    let cut = |file: &'static str, keep: fn(usize) -> usize| {
        move |newest: &Path| {
            let bytes = read(newest, file);
            fs::write(newest.join(file), &bytes[..keep(bytes.len())]).unwrap();
        }
    };
    let lost = |file: &'static str| move |newest: &Path| fs::remove_file(newest.join(file)).unwrap();
    let from = |run: &Path, epoch: &str, file: &str| {
        let (from, file) = (run.join("checkpoints").join(epoch).join(file), file.to_string());
        move |newest: &Path| _ = fs::copy(&from, newest.join(&file)).unwrap()
    };
    let folder = |run: &Path, epoch: &str| {
        let from = run.join("checkpoints").join(epoch);
        move |newest: &Path| {
            fs::remove_dir_all(newest).unwrap();
            copy(&from, newest.into());
        }
    };
    let edit = |old: &'static str, new: &'static str| {
        move |newest: &Path| {
            let text = String::from_utf8(read(newest, "checkpoint.json")).unwrap();
            assert!(text.contains(old), "{text}");
            fs::write(newest.join("checkpoint.json"), text.replacen(old, new, 1)).unwrap();
        }
    };
    type Spoil<'a> = Box<dyn Fn(&Path) + 'a>;
    let cases: Vec<(Spoil, [&str; 2])> = vec![
        (Box::new(cut("model.safetensors", |n| n / 2)), ["model.safetensors", "damaged"]),
        (Box::new(cut("optimizer.safetensors", |n| n - 1)), ["optimizer.safetensors", "damaged"]),
        (Box::new(cut("state.bin", |_| 0)), ["state.bin", "damaged"]),
        (Box::new(cut("recipe.toml", |_| 0)), ["recipe.toml", "damaged"]),
        (Box::new(cut("checkpoint.json", |_| 0)), ["checkpoint.json", "EOF"]),
        (Box::new(cut("checkpoint.json", |n| n / 2)), ["checkpoint.json", "EOF"]),
        (Box::new(lost("model.safetensors")), ["model.safetensors", "No such file"]),
        (Box::new(lost("state.bin")), ["state.bin", "No such file"]),
        (Box::new(lost("checkpoint.json")), ["checkpoint.json", "No such file"]),
        (Box::new(from(&base, "epoch-0002", "optimizer.safetensors")), ["optimizer.safetensors", "damaged"]),
        (Box::new(from(&base, "epoch-0002", "state.bin")), ["state.bin", "damaged"]),
        (Box::new(folder(&base, "epoch-0002")), ["checkpoint.json", "is epoch-0002, in a folder of another name"]),
        (Box::new(folder(&gamma, "epoch-0003")), ["recipe.toml", "ppo.gamma is 0.9, expected 0.95"]),
        (Box::new(folder(&cartpole, "epoch-0003")), ["recipe.toml", "env is \"cartpole\", expected \"point\""]),
        (Box::new(folder(&wide, "epoch-0003")), ["recipe.toml", "policy.trunk is 24, expected 16"]),
        (Box::new(edit("\"format\": 5", "\"format\": 6, \"more\": 1")), ["checkpoint.json", "format is 6, from a newer version"]),
        (Box::new(edit("\"format\": 5", "\"format\": 1")), ["checkpoint.json", "format is 1, which can no longer be read"]),
        (Box::new(edit("\"epoch\": 3", "\"epoch\": 2")), ["checkpoint.json", "is of epoch 2, but state.bin is of epoch 3"]),
    ];
    for (i, (spoil, words)) in cases.iter().enumerate() {
        let hurt = copy(&base, dir.join(format!("hurt-{i}")));
        spoil(&hurt.join("checkpoints/epoch-0003"));
        let told = succeed(&["--resume", text(&hurt), "--set", "run.epochs=4"]);
        let warning = told.lines().find(|l| l.starts_with("warning: ")).unwrap_or_else(|| panic!("{words:?} without a warning: {told}"));
        let all = ["epoch-0003", "continues from epoch-0002"].iter().chain(words);
        all.for_each(|w| assert!(warning.contains(w), "should name '{w}': {warning}"));
        assert!(hurt.join("checkpoints/refused-epoch-0003").is_dir(), "{words:?}");
        assert_same_run(&whole, &hurt, "epoch-0004");
    }
}

/// Format 4 ends before the course: three empty or zero numbers, a missing one, and no end. Format 3 ends before the scale of rewards,
/// too: an empty list and three floats.
#[test]
fn checkpoints_of_the_formats_before_are_continued() {
    let dir = tempfile::tempdir().unwrap();
    let whole = run(dir.path(), "whole", POINT, 2);
    for (format, bytes) in [(4, 5), (3, 5 + 25)] {
        let parts = run(dir.path(), &format!("parts-{format}"), POINT, 1);
        let checkpoint = parts.join("checkpoints/epoch-0001");
        let mut state = read(&checkpoint, "state.bin");
        let new = egogen::io::content_hash(&state);
        state.truncate(state.len() - bytes);
        fs::write(checkpoint.join("state.bin"), &state).unwrap();
        let description = String::from_utf8(read(&checkpoint, "checkpoint.json")).unwrap();
        assert!(description.contains(&new));
        let format = format!("\"format\": {format}");
        let older = description.replace(&new, &egogen::io::content_hash(&state)).replace("\"format\": 5", &format);
        fs::write(checkpoint.join("checkpoint.json"), older).unwrap();
        succeed(&["--resume", text(&parts), "--set", "run.epochs=2"]);
        assert_same_run(&whole, &parts, "epoch-0002");
    }
}

#[test]
fn without_a_usable_checkpoint_all_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let run = run(dir.path(), "run", TINY, 3);
    let refused = |words: &[&str]| {
        let output = train(&["--resume", text(&run)]);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        let told = stderr(&output);
        words.iter().for_each(|w| assert!(told.contains(w), "should name '{w}': {told}"));
        assert_eq!(told.matches("error:").count(), 1, "{told}");
    };
    let recipe = fs::read_to_string(run.join("recipe.toml")).unwrap();
    fs::write(run.join("recipe.toml"), recipe.replace("lambda = 0.95", "lambda = 0.9")).unwrap();
    refused(&["epoch-0002/recipe.toml", "epoch-0003/recipe.toml", "ppo.lambda is 0.95, expected 0.9"]);
    fs::write(run.join("recipe.toml"), recipe).unwrap();
    succeed(&["--resume", text(&run)]);
    for name in list(&run.join("checkpoints")).iter().filter(|n| *n != "epoch-0003") {
        fs::write(run.join("checkpoints").join(name).join("state.bin"), "").unwrap();
    }
    fs::remove_file(run.join("checkpoints/epoch-0003/model.safetensors")).unwrap();
    refused(&["epoch-0002/state.bin", "damaged", "epoch-0003/model.safetensors", "No such file"]);
    assert!(run.join("checkpoints/epoch-0003").is_dir(), "nothing is set aside when nothing can be used");
    let metrics = read(&run, "metrics.csv");
    fs::remove_dir_all(run.join("checkpoints")).unwrap();
    refused(&["checkpoints", "metrics.csv reports 3 epochs"]);
    assert_eq!(read(&run, "metrics.csv"), metrics, "what was reported stays");
}

/// Runs `train` with files limited to that many blocks of the shell, as on a disk that is full.
fn train_on_full_disk(blocks: u32, args: &[&str]) -> std::process::Output {
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" \"$@\"");
    Command::new("sh").args(["-c", &script, env!("CARGO_BIN_EXE_train")]).args(args).output().unwrap()
}

#[test]
fn a_full_disk_is_told_and_costs_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let whole = run(dir.path(), "whole", POINT, 4);
    let full = run(dir.path(), "full", POINT, 2);
    let resume = ["--resume", text(&full), "--set", "run.epochs=4"];
    // No room at all, none for the figures, none for weights (69 KB) or moments (138 KB); shells count 512 or 1024 bytes.
    for (blocks, file) in [(0, "recipe.toml"), (2, ".csv"), (100, ".safetensors")] {
        let output = train_on_full_disk(blocks, &resume);
        let told = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{told}");
        let errors: Vec<_> = told.lines().filter(|l| !l.starts_with("epoch ")).collect();
        assert!(errors.len() == 1 && errors[0].starts_with("error: ") && errors[0].contains(file), "{blocks} blocks: {told}");
        let names = list(&full.join("checkpoints"));
        assert_eq!(names, ["epoch-0001", "epoch-0002"]);
        let hidden = fs::read_dir(full.join("checkpoints")).unwrap().count() - names.len();
        assert_eq!(hidden, 0, "what could not be finished does not take space");
    }
    succeed(&resume);
    assert_same_run(&whole, &full, "epoch-0004");
}
