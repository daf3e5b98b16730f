//! Sweeps, as a person and as an engine runs them.

mod common;

use common::{assert_same_run, column, program, read, stderr, succeed, train};
use egogen_train::sweep::{Manifest, State};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// The point in epochs so short that most of the time goes into files.
fn files(dir: &Path, sweep: &str) -> PathBuf {
    let point = include_str!("../train/recipes/point.toml")
        .replace(
            "epochs = 20\nepoch_steps = 16384\nenvs = 64\ncollect_steps = 2048",
            "epochs = 2\nepoch_steps = 128\nenvs = 8\ncollect_steps = 64",
        )
        .replace("batch = 512", "batch = 32")
        .replace("episodes = 64\nevery = 2", "episodes = 4\nevery = 1")
        .replace("every = 2\nkeep", "every = 1\nkeep");
    let (recipe, path) = (dir.join("small.toml"), dir.join("sweep.toml"));
    fs::write(&recipe, point).unwrap();
    fs::write(&path, format!("recipe = '{}'\nseeds = [0, 1]\nfigure = 'test_det/return'\n{sweep}", recipe.display())).unwrap();
    path
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are plain")
}

fn sweep(file: &Path, out: &Path, more: &[&str]) -> Output {
    train(&[&["sweep", text(file), "--out", text(out)], more].concat())
}

fn table(output: &Output) -> Vec<Vec<String>> {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    text.lines().map(|line| line.split(',').map(String::from).collect()).collect()
}

#[test]
fn the_examples_can_be_run() {
    let (dir, examples) = (tempfile::tempdir().unwrap(), Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples"));
    let out = dir.path().join("out");
    let planned = sweep(&examples.join("sweep/loss_and_reward.toml"), &out, &["--plan"]);
    assert_eq!(planned.status.code(), Some(0), "{}", stderr(&planned));
    assert_eq!(fs::read_to_string(out.join("manifest.jsonl")).unwrap().lines().count(), 4 * 3);
    succeed(&[text(&examples.join("strict.toml")), "--dry-run"]);
}

#[test]
fn a_grid_is_trained_once_and_tabulated() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let file = files(dir.path(), "[grid]\n'ppo.clip' = [0.1, 0.2]\n'ppo.gamma' = [0.9, 0.95]");
    let first = sweep(&file, &out, &["--jobs", "2"]);
    assert_eq!(first.status.code(), Some(0), "{}", stderr(&first));
    let rows = table(&first);
    assert_eq!(rows[0].join(","), "setting,rung,epochs,ppo.clip,ppo.gamma,test_det/return,half95,done,tasks");
    assert_eq!(rows.len(), 5);
    let means: Vec<f64> = rows[1..].iter().map(|r| r[5].parse().unwrap()).collect();
    assert!(means.is_sorted_by(|a, b| a >= b) && rows[1..].iter().all(|r| r[7..] == ["2", "2"]), "{rows:?}");
    // A row is what its two runs came to.
    let runs = [0, 1].map(|seed| out.join(format!("settings/{:0>3}/seed-{seed}", rows[1][0])));
    let [a, b] = runs.each_ref().map(|run| *column(run, "test_det/return").last().unwrap());
    assert!((means[0] - (a + b) / 2.0).abs() < 1e-4, "{rows:?}: {a} and {b}");
    let page = fs::read_to_string(out.join("sweep.html")).unwrap();
    assert!(
        ["4 settings", "ppo.clip", "The first settings over epochs"].iter().all(|w| page.contains(w)) && !page.contains("Failed tasks")
    );
    // Again: nothing is trained, and all is the same.
    let stamp = |run: &Path| fs::metadata(run.join("metrics.csv")).unwrap().modified().unwrap();
    let before = runs.each_ref().map(|run| stamp(run));
    let again = sweep(&file, &out, &[]);
    assert_eq!((again.stdout, runs.each_ref().map(|run| stamp(run))), (first.stdout, before));
    // Another sweep does not get into its folder.
    let other = sweep(&files(dir.path(), "[grid]\n'ppo.clip' = [0.3]"), &out, &[]);
    assert!(other.status.code() == Some(2) && stderr(&other).contains("another sweep"), "{}", stderr(&other));
}

#[test]
fn variants_go_by_their_names() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let variants = "[[variants]]\nname = 'as it is'\n[[variants]]\nname = 'short, bold'\nset = { ppo.clip = 0.4, ppo.gamma = 0.5 }";
    let output = sweep(&files(dir.path(), variants), &out, &["--jobs", "2"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.starts_with("setting,rung,epochs,variant,test_det/return,half95,done,tasks\n"), "{text}");
    assert!(text.contains("1,1,2,as it is,") && text.contains("2,1,2,\"short, bold\","), "{text}");
    let recipe = fs::read_to_string(out.join("settings/002/seed-1/recipe.toml")).unwrap();
    assert!(recipe.contains("clip = 0.4") && recipe.contains("gamma = 0.5"), "{recipe}");
    let page = fs::read_to_string(out.join("sweep.html")).unwrap();
    let told = ["<td class=\"text\">short, bold</td>", "ppo.clip = 0.4, ppo.gamma = 0.5", "002 short, bold"];
    assert!(told.iter().all(|w| page.contains(w)), "{page}");
}

#[test]
fn tasks_are_done_by_number_and_go_on_after_a_kill() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let file = files(dir.path(), "[grid]\n'run.epochs' = [2, 80]");
    let planned = sweep(&file, &out, &["--plan"]);
    assert_eq!(planned.status.code(), Some(0), "{}", stderr(&planned));
    assert!(stderr(&planned).contains("4 tasks") && !out.join("settings").exists(), "{}", stderr(&planned));
    let path = out.join("manifest.jsonl");
    let manifest = Manifest::read(&path).unwrap();
    let task = ["--task", text(&path), "--index", "2"];
    let run = out.join("settings/002/seed-0");
    let mut child = program(&task).stderr(Stdio::null()).spawn().unwrap();
    wait_for(|| run.join("metrics.csv").exists());
    child.kill().unwrap();
    assert_eq!(child.wait().unwrap().code(), None, "killed before its end");
    assert_eq!(manifest.state(&manifest.tasks[2]), State::Open);
    succeed(&task);
    assert!(matches!(manifest.state(&manifest.tasks[2]), State::Done(done) if done.epochs == 80));
    let (recipe, alone) = (dir.path().join("small.toml"), dir.path().join("alone"));
    succeed(&[text(&recipe), "--set", "run.epochs=80", "--out", text(&alone)]);
    assert_same_run(&alone, &run, "epoch-0080");
    let metrics = read(&run, "metrics.csv");
    assert!(succeed(&task).contains("is done"));
    assert_eq!(read(&run, "metrics.csv"), metrics);
    let beyond = train(&["--task", text(&path), "--index", "4"]);
    assert!(beyond.status.code() == Some(2) && stderr(&beyond).contains("has 4 tasks"), "{}", stderr(&beyond));
    let line = fs::read_to_string(&path).unwrap().replacen("epochs = 2", "epochs = 3", 1);
    fs::write(&path, line).unwrap();
    let changed = train(&task);
    assert!(changed.status.code() == Some(2) && stderr(&changed).contains("does not have its hash"), "{}", stderr(&changed));
}

#[test]
fn what_fails_is_told_and_the_rest_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let file = files(dir.path(), "[grid]\n'ppo.clip' = [0.2, 0.1]");
    sweep(&file, &out, &["--plan"]);
    // What stands in the way of two tasks.
    for seed in [0, 1] {
        let run = out.join(format!("settings/002/seed-{seed}"));
        fs::create_dir_all(&run).unwrap();
        fs::copy(dir.path().join("small.toml"), run.join("recipe.toml")).unwrap();
    }
    for _ in 0..2 {
        let output = sweep(&file, &out, &[]);
        let told = stderr(&output);
        assert!(output.status.code() == Some(1) && told.contains("2 tasks failed") && told.contains("is of another task"), "{told}");
        let rows = table(&output);
        assert_eq!((rows[1][0].as_str(), rows[1][6].as_str(), rows[2][0].as_str(), rows[2][6].as_str()), ("1", "2", "2", "0"), "{rows:?}");
    }
    let page = fs::read_to_string(out.join("sweep.html")).unwrap();
    assert!(page.contains("Failed tasks") && page.contains("002-seed-1"));
}

#[test]
fn what_no_task_could_do_is_refused_before_any_begins() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let output = sweep(&files(dir.path(), "[grid]\n'checkpoint.best' = ['test_det/return', 'test_det/glory']"), &out, &[]);
    let told = stderr(&output);
    assert!(output.status.code() == Some(2) && told.contains("setting 2") && told.contains("test_det/glory"), "{told}");
    assert!(!out.exists());
}

/// A sweep with more epochs than can be trained here, two tasks of which are under way.
fn endless(dir: &Path, out: &Path) -> Child {
    let file = files(dir, "[grid]\n'run.epochs' = [1000000, 1000001]");
    let child = program(&["sweep", text(&file), "--out", text(out), "--jobs", "2"]).stderr(Stdio::null()).stdout(Stdio::null()).spawn();
    let rows = |seed| fs::read_to_string(out.join(format!("settings/001/seed-{seed}/metrics.csv"))).map_or(0, |t| t.lines().count());
    (0..2).for_each(|seed| wait_for(|| rows(seed) > 1));
    child.unwrap()
}

fn wait_for(what: impl Fn() -> bool) {
    let begun = Instant::now();
    while !what() {
        assert!(begun.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Whether the task has saved and stopped: its last epoch has a checkpoint.
fn has_saved(out: &Path, id: &str) -> bool {
    let (setting, seed) = id.split_once('-').unwrap();
    let run = out.join("settings").join(setting).join(seed);
    fs::read_to_string(out.join(format!("logs/{id}.txt"))).unwrap().contains("interrupted and saved")
        && run.join(format!("checkpoints/epoch-{:04}/checkpoint.json", column(&run, "env_steps").len())).exists()
}

#[cfg(unix)]
#[test]
fn what_stops_the_pool_makes_its_tasks_save() {
    for (signal, code) in [("-TERM", Some(130)), ("-INT", Some(130)), ("-KILL", None)] {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        let mut pool = endless(dir.path(), &out);
        assert!(Command::new("kill").args([signal, &pool.id().to_string()]).status().unwrap().success());
        assert_eq!(pool.wait().unwrap().code(), code);
        if code.is_none() {
            // Nobody waits for the tasks of a pool that was killed.
            wait_for(|| ["001-seed-0", "001-seed-1"].iter().all(|id| has_saved(&out, id)));
        }
        assert!(["001-seed-0", "001-seed-1"].iter().all(|id| has_saved(&out, id)), "{signal}");
        assert!(!out.join("settings/002").exists(), "{signal}: another task was begun");
    }
}

#[test]
fn a_task_that_cannot_start_makes_the_others_save() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    // A folder where the log of the second task would be.
    fs::create_dir_all(out.join("logs/001-seed-1.txt")).unwrap();
    let output = sweep(&files(dir.path(), "[grid]\n'run.epochs' = [1000000]"), &out, &["--jobs", "2"]);
    assert!(output.status.code() == Some(1) && stderr(&output).contains("001-seed-1.txt"), "{}", stderr(&output));
    assert!(fs::read_to_string(out.join("logs/001-seed-0.txt")).unwrap().contains("interrupted and saved"));
}

#[test]
fn halving_lengthens_the_last_stage() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let file = files(dir.path(), "[grid]\n'stages.turn.ppo.clip' = [0.1, 0.3]\n[halving]\nepochs = [2, 4]");
    let recipe = dir.path().join("small.toml");
    let stages = "[[stages]]\nname = 'walk'\nrun = { epochs = 3 }\n[[stages]]\nname = 'turn'\nrun = { epochs = 9 }\n";
    fs::write(&recipe, fs::read_to_string(&recipe).unwrap() + stages).unwrap();
    let output = sweep(&file, &out, &["--jobs", "2"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let rows = table(&output);
    let shape: Vec<[&str; 2]> = rows[1..].iter().map(|r| [r[1].as_str(), r[2].as_str()]).collect();
    assert_eq!(shape, [["2", "7"], ["1", "5"]], "rung and epochs of all stages: {rows:?}");
    let run = out.join(format!("settings/{:0>3}/seed-1", rows[1][0]));
    let epochs = ["1-walk", "2-turn"].map(|stage| column(&run.join("stages").join(stage), "env_steps").len());
    assert_eq!(epochs, [3, 4]);
    // The same as a run that was never halved.
    let (clip, alone) = (format!("stages.turn.ppo.clip={}", rows[1][3]), dir.path().join("alone"));
    succeed(&[text(&recipe), "--seed", "1", "--set", &clip, "--set", "stages.turn.run.epochs=4", "--out", text(&alone)]);
    assert_same_run(&alone.join("stages/2-turn"), &run.join("stages/2-turn"), "epoch-0004");
}

#[test]
fn halving_trains_the_better_settings_longer() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let random = "[random]\ncount = 3\nkeys = { 'adam.lr' = { log = [1e-4, 1e-2] } }\n[halving]\nepochs = [2, 3, 5]\nkeep = 0.5";
    let output = sweep(&files(dir.path(), random), &out, &["--jobs", "2"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let rows = table(&output);
    let shape: Vec<[&str; 2]> = rows[1..].iter().map(|r| [r[1].as_str(), r[2].as_str()]).collect();
    assert_eq!(shape, [["3", "5"], ["2", "3"], ["1", "2"]], "{rows:?}");
    for row in &rows[1..] {
        let epochs = column(&out.join(format!("settings/{:0>3}/seed-1", row[0])), "env_steps").len();
        assert_eq!(epochs.to_string(), row[2], "a rung goes on where the one before ended");
    }
    let again = sweep(&files(dir.path(), random), &out, &[]);
    assert_eq!(again.stdout, output.stdout);
}

#[cfg(unix)]
fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples/sweep")
}

/// `PATH` with this `train` before everything else.
#[cfg(unix)]
fn path_with_train(bin: &Path) -> String {
    fs::create_dir(bin).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_train"), bin.join("train")).unwrap();
    format!("{}:{}", bin.display(), std::env::var("PATH").unwrap())
}

/// The scripts for engines, with programs in their place that write down what they are asked and run one task.
#[cfg(unix)]
#[test]
fn engines_get_every_task() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    sweep(&files(dir.path(), ""), &out, &["--plan"]);
    let bin = dir.path().join("bin");
    let path = path_with_train(&bin);
    let place = |name: &str, script: &str| {
        fs::write(bin.join(name), format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(bin.join(name), fs::Permissions::from_mode(0o755)).unwrap();
    };
    // The last two arguments are script and manifest; the last five a shell's command, its words and the manifest.
    place("sbatch", "echo \"$@\" > sbatch.txt; while [ $# -gt 2 ]; do shift; done; SLURM_ARRAY_TASK_ID=1 exec sh \"$@\"");
    place("hq", "echo \"$@\" > hq.txt; while [ \"$1\" != -- ]; do shift; done; shift; HQ_TASK_ID=0 exec \"$@\"");
    for (script, told, option) in [("slurm.sh", "sbatch.txt", "--partition=long"), ("hyperqueue.sh", "hq.txt", "--crash-limit=5")] {
        let mut command = Command::new("sh");
        let command = command.arg(scripts().join(script)).arg("out/manifest.jsonl").arg(option).env("PATH", &path).current_dir(&dir);
        let output = command.output().unwrap();
        assert!(output.status.success(), "{script}: {}", stderr(&output));
        let asked = fs::read_to_string(dir.path().join(told)).unwrap();
        assert!(asked.contains("--array=0-1") && asked.contains(option), "{asked}");
    }
    let manifest = Manifest::read(&out.join("manifest.jsonl")).unwrap();
    assert!(manifest.tasks.iter().all(|t| matches!(manifest.state(t), State::Done(_))));
}

/// Runs four tasks by an engine, of which the first is killed, and runs them again: it goes on, and the others are not repeated.
#[cfg(unix)]
fn goes_on_after_a_kill(engine: &[&str], options: &[&str]) {
    let dir = tempfile::tempdir().unwrap();
    let (out, path) = (dir.path().join("out"), path_with_train(&dir.path().join("bin")));
    sweep(&files(dir.path(), "[grid]\n'run.epochs' = [150, 2]"), &out, &["--plan"]);
    let manifest = Manifest::read(&out.join("manifest.jsonl")).unwrap();
    let start = || {
        let mut command = Command::new(engine[0]);
        command.args(&engine[1..]).arg(&manifest.path).args(options).env("PATH", &path).current_dir(scripts());
        command.spawn().unwrap()
    };
    let mut first = start();
    let runs: Vec<PathBuf> = manifest.tasks.iter().map(|t| manifest.folder(t)).collect();
    wait_for(|| runs[0].join("checkpoints").exists());
    let task = format!("^train --task {} --index 0 ", manifest.path.display());
    assert!(Command::new("pkill").args(["-KILL", "-f", "--", &task]).status().unwrap().success());
    assert!(!first.wait().unwrap().success());
    let done: Vec<bool> = manifest.tasks.iter().map(|t| matches!(manifest.state(t), State::Done(_))).collect();
    assert_eq!(done, [false, true, true, true]);
    let stamps = || runs[1..].iter().map(|r| fs::metadata(r.join("metrics.csv")).unwrap().modified().unwrap()).collect::<Vec<_>>();
    let before = stamps();
    assert!(start().wait().unwrap().success());
    assert_eq!(stamps(), before);
    let alone = dir.path().join("alone");
    succeed(&[text(&dir.path().join("small.toml")), "--set", "run.epochs=150", "--out", text(&alone)]);
    assert_same_run(&alone, &runs[0], "epoch-0150");
}

#[cfg(unix)]
#[test]
#[ignore = "needs Slurm"]
fn slurm_goes_on_after_a_kill() {
    goes_on_after_a_kill(&["sh", "slurm_local.sh", "sh", "slurm.sh"], &["--cpus-per-task=1", "--wait"]);
}

#[cfg(unix)]
#[test]
#[ignore = "needs the Python package hyperqueue"]
fn hyperqueue_goes_on_after_a_kill() {
    goes_on_after_a_kill(&["python3", "hyperqueue_local.py"], &["2"]);
}
