//! Stages, curricula and selection, as a person uses them.

#[path = "common/altered.rs"]
mod altered;
mod common;

use altered::Altered;
use common::{assert_same_run, column, program, read, stderr, succeed, train};
use egogen_envs::StepResult;
use egogen_envs::point::PointGoal;
use egogen_train::checkpoint::Checkpoint;
use egogen_train::recipe::Recipe;
use egogen_train::registry::{Made, Registry};
use egogen_train::select::Selection;
use egogen_train::trainer::{Outcome, Trainer};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Two stages of the point: short epochs, each with a checkpoint; the first is selected from.
const STAGES: &str = "
[select]
starts = 20
finalists = 2
finalist_starts = 30
[[stages]]
name = 'walk'
run = { epochs = 4 }
until = { figure = 'test_det/return', patience = 3 }
[[stages]]
name = 'turn'
from = 'best'
optimiser = true
run = { epochs = 5 }
adam = { lr = 5e-4, schedule = 'linear' }
ppo = { gamma = 0.9, reward_normalization = true, reward_scaling = true }
";

fn recipe(dir: &Path, stages: &str) -> PathBuf {
    let path = dir.join("staged.toml");
    let short = include_str!("../train/recipes/point.toml")
        .replace("epoch_steps = 16384", "epoch_steps = 4096")
        .replace("every = 2\nkeep = 2", "every = 1\nkeep = 2\nkeep_every = 1")
        .replace("episodes = 64\nevery = 2", "episodes = 8\nevery = 1");
    fs::write(&path, format!("{short}\n{stages}")).unwrap();
    path
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are plain")
}

fn wait_for(path: &Path) {
    let begun = Instant::now();
    while !path.exists() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{} does not come", path.display());
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Both runs in stages must have written the same bytes.
fn assert_same_stages(a: &Path, b: &Path) {
    for (stage, last) in [("stages/1-walk", "epoch-0004"), ("stages/2-turn", "epoch-0005")] {
        assert_same_run(&a.join(stage), &b.join(stage), last);
        assert_eq!(read(&a.join(stage), "selection.json"), read(&b.join(stage), "selection.json"));
    }
    for file in ["recipe.toml", "summary.json", "policy/policy.json", "policy/policy.safetensors"] {
        assert!(read(a, file) == read(b, file), "{file} differs");
    }
}

#[test]
fn stages_follow_each_other_through_kills() {
    let dir = tempfile::tempdir().unwrap();
    let file = recipe(dir.path(), STAGES);
    let whole = dir.path().join("whole");
    let told = succeed(&[text(&file), "--out", text(&whole)]);
    assert!(told.contains("stage 1 of 2, walk") && told.contains("stage 2 of 2, turn"), "{told}");
    let [walk, turn] = ["stages/1-walk", "stages/2-turn"].map(|s| whole.join(s));
    assert_eq!((column(&walk, "env_steps").len(), column(&turn, "env_steps").len()), (4, 5));
    let summary: serde_json::Value = serde_json::from_slice(&read(&whole, "summary.json")).unwrap();
    assert_eq!((&summary["epochs"], &summary["stages"][1]["folder"]), (&9.into(), &"stages/2-turn".into()));
    assert_eq!(read(&whole, "policy/policy.safetensors"), read(&turn, "policy/policy.safetensors"));

    // The second begins with what was selected in the first: its weights, its moments.
    let chosen = Selection::read(&walk).unwrap().unwrap().chosen;
    let first = Checkpoint::read(&walk.join("checkpoints").join(&chosen)).unwrap();
    let begun = Checkpoint::read(&turn.join("checkpoints/epoch-0000")).unwrap_or_else(|e| panic!("the begin is kept: {e}"));
    assert_eq!((&begun.params, &begun.adam), (&first.params, &first.adam));
    assert_eq!((begun.description.seed, begun.state.learning.updates), (1_000_000, 0));
    assert!(begun.description.origin.contains_key("init"));

    // Killed within the second stage, within the first, and before the second's first checkpoint.
    for (kill, at) in ["stages/2-turn/checkpoints/epoch-0002", "stages/1-walk/checkpoints/epoch-0002"].into_iter().enumerate() {
        let cut = dir.path().join(format!("cut-{kill}"));
        let mut child = program(&[text(&file), "--out", text(&cut)]).stderr(Stdio::null()).spawn().unwrap();
        wait_for(&cut.join(at));
        child.kill().unwrap();
        assert_eq!(child.wait().unwrap().code(), None, "killed before its end");
        succeed(&["--resume", text(&cut)]);
        assert_same_stages(&whole, &cut);
    }
    let cut = dir.path().join("cut-0");
    fs::remove_dir_all(cut.join("stages/2-turn/checkpoints")).unwrap();
    fs::remove_file(cut.join("stages/2-turn/metrics.csv")).unwrap();
    fs::remove_file(cut.join("stages/2-turn/summary.json")).unwrap();
    succeed(&["--resume", text(&cut)]);
    assert_same_stages(&whole, &cut);

    // What has been built upon cannot be made longer; the last stage can.
    let output = train(&["--resume", text(&cut), "--set", "stages.walk.run.epochs=5"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("stage 'walk' has ended after 4 epochs"), "{}", stderr(&output));
    let output = train(&["--resume", text(&cut), "--set", "stages.turn.ppo.gamma=0.5"]);
    assert!(output.status.code() == Some(2) && stderr(&output).contains("can change only"), "{}", stderr(&output));
    succeed(&["--resume", text(&cut), "--set", "stages.walk.run.epochs=4", "--set", "stages.turn.run.epochs=6"]);
    assert_eq!(column(&cut.join("stages/2-turn"), "env_steps").len(), 6);
}

#[test]
fn seeds_and_dry_runs_take_stages() {
    let dir = tempfile::tempdir().unwrap();
    let file = recipe(dir.path(), STAGES);
    let out = dir.path().join("seeds");
    let command = ["--seeds", "2", "--set", "stages.walk.run.epochs=1", "--set", "stages.2.run.epochs=1", "--out", text(&out)];
    succeed(&[&[text(&file)], command.as_slice()].concat());
    let again = succeed(&[&[text(&file)], command.as_slice()].concat());
    assert_eq!(again.matches("is finished").count(), 2, "{again}");
    assert!(fs::read_to_string(out.join("seeds.csv")).unwrap().contains("test_det/success"));
    let output = train(&[&[text(&file), "--dry-run"], &command[2..6]].concat());
    let shown = String::from_utf8(output.stdout).unwrap();
    for word in ["# stage 1, walk", "# stage 2, turn", "# time: about", "[[stages]]"] {
        assert!(shown.contains(word), "{word}: {shown} {}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn what_a_later_stage_would_stop_at_is_told_first() {
    let dir = tempfile::tempdir().unwrap();
    let first = "[[stages]]\nname = 'walk'\n[[stages]]\nname = 'turn'\n";
    let out = dir.path().join("run");
    for (change, words) in [
        ("env_options.speed = 2", ["turn", "env_options.speed"]),
        ("env = 'pendulum'\ncheckpoint.best = 'test_det/return'", ["turn", "differ from those of stage 'walk'"]),
        ("until = { figure = 'glory', over = 1.0 }", ["until.figure is 'glory'", "test_det/success"]),
        ("ppo.clipp = 0.3", ["turn", "clipp"]),
    ] {
        let file = recipe(dir.path(), &format!("{first}{change}"));
        let output = train(&[text(&file), "--out", text(&out)]);
        let told = stderr(&output);
        assert!(output.status.code() == Some(2) && words.iter().all(|w| told.contains(w)), "{change}: {told}");
        assert!(!out.exists(), "{change} left a run folder");
    }
}

#[test]
fn a_run_without_a_rule_can_be_selected_from() {
    let dir = tempfile::tempdir().unwrap();
    let file = recipe(dir.path(), "");
    let out = dir.path().join("run");
    succeed(&[text(&file), "--out", text(&out), "--set", "run.epochs=4"]);
    assert!(!out.join("selection.json").exists());
    let sets = ["--set", "select.starts=20", "--set", "select.finalist_starts=20", "--set", "select.finalists=3"];
    let output = train(&[&["select", text(&out)], sets.as_slice()].concat());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let s = Selection::read(&out).unwrap().unwrap();
    let epochs = |entries: &[egogen_train::select::Entry]| entries.iter().map(|e| e.epoch).collect::<Vec<_>>();
    assert_eq!(epochs(&s.candidates.entries), [1, 2, 3, 4]);
    assert!(s.prior.is_none() && s.candidates.entries.iter().all(|e| e.figures.kl.is_some() && e.figures.quality.is_none()));
    // The rule again, by the table alone.
    let best = s.finalists.entries.iter().map(|e| e.figures.reward.value).fold(f64::MIN, f64::max);
    let winner = s.finalists.entries.iter().find(|e| e.name == s.chosen).unwrap();
    assert!(winner.place == Some(1) && winner.reasons.is_empty() && winner.figures.reward.value >= best - 0.02 * best.abs());
    let bundle = egogen::agent::bundle::Bundle::read(&out.join("policy")).unwrap();
    assert_eq!(bundle.trained.epoch, s.epoch);

    let refused = |args: &[&str], word: &str| {
        let output = train(&[&["select", text(&out)], args].concat());
        assert!(output.status.code() == Some(2) && stderr(&output).contains(word), "{args:?}: {}", stderr(&output));
    };
    refused(&["--set", "ppo.clip=0.1"], "select.KEY");
    refused(&["--set", "select.starts=0"], "select.starts is 0");
    refused(&["--set", "select.start=9"], "start");
}

/// A page of two seeds of a run in stages beside another run.
#[test]
fn runs_are_reported_on_one_page() {
    let dir = tempfile::tempdir().unwrap();
    let [staged, plain] = [STAGES, ""].map(|stages| fs::read_to_string(recipe(dir.path(), stages)).unwrap());
    let (file, seeds, other) = (dir.path().join("a.toml"), dir.path().join("staged"), dir.path().join("plain"));
    fs::write(&file, staged).unwrap();
    succeed(&[text(&file), "--seeds", "2", "--out", text(&seeds)]);
    fs::write(&file, plain).unwrap();
    succeed(&[text(&file), "--out", text(&other), "--set", "run.epochs=2"]);
    succeed(&["report", text(&seeds)]);
    let page = fs::read_to_string(seeds.join("report.html")).unwrap();
    let chosen = Selection::read(&seeds.join("seed-1/stages/2-turn")).unwrap().unwrap();
    let words = [
        "Stages of staged: walk in epochs 1 to 4, turn in epochs 5 to 9.",
        "Selection: seed-1, stage turn",
        &format!("Chosen: epoch {}: {}.", chosen.epoch, chosen.why),
        "success rate",
        "arrival",
        "approx_kl",
        "steps_per_second",
    ];
    words.iter().for_each(|w| assert!(page.contains(w), "{w}"));
    // A border in every panel over epochs, bands over both seeds, rings at what was chosen.
    assert!(page.matches("stroke-dasharray").count() + page.matches("<polygon").count() > 20);
    assert!(page.matches("<circle").count() >= 4 * 6);
    // Nothing that a browser would fetch.
    let outside = ["<script", "<link", "@import", "url(http", "src=\"http", "href="];
    outside.iter().for_each(|w| assert!(!page.contains(w), "{w}"));

    let out = dir.path().join("both.html");
    succeed(&["report", text(&seeds), text(&other), "--out", text(&out)]);
    let page = fs::read_to_string(&out).unwrap();
    assert!(["success rate (test, mean action)", ">\nstaged\n<", ">\nplain\n<"].iter().all(|w| page.contains(w)));
    let output = train(&["report", text(dir.path())]);
    assert!(output.status.code() == Some(2) && stderr(&output).contains("seed-K"), "{}", stderr(&output));
}

/// The point with an option `bonus`, which is paid in every step.
fn paid() -> Registry {
    let mut registry = Registry::default();
    registry.add("point", |options, n, _| {
        let bonus = options.get("bonus").and_then(toml::Value::as_float).unwrap_or(0.0);
        if bonus > 100.0 {
            return Err(egogen_train::Error::config(format!("env_options.bonus is {bonus}, expected at most 100")));
        }
        let change = move |result: &mut StepResult| result.reward.iter_mut().for_each(|r| *r += bonus as f32);
        Ok(Made { env: Box::new(Altered { point: PointGoal::new(n, 0), change }), origin: BTreeMap::new() })
    });
    registry
}

/// Trains in `dir`, resuming where `resume`; gives the run's metrics and last state.
fn follow(dir: &Path, rules: &str, epochs: u64, resume: bool) -> Outcome {
    let text = fs::read_to_string(recipe(dir, rules)).unwrap();
    let changes = [format!("run.epochs={epochs}"), "ppo.reward_scaling=true".into()];
    let plan = Recipe::parse("test", &text, &changes).unwrap().plan().unwrap();
    let registry = paid();
    let run = dir.join("run");
    let mut trainer = match resume {
        true => Trainer::resume(plan, &registry, &run, 2, |what| panic!("{what}")).unwrap(),
        false => Trainer::start(plan, &registry, &run, 2, None).unwrap(),
    };
    trainer.run(&AtomicBool::new(false)).unwrap()
}

const BONUS: &str = "
[[curriculum]]
key = 'bonus'
values = [0.0, 10.0, 20.0]
";

#[test]
fn a_curriculum_changes_what_is_trained_and_is_resumed() {
    let [whole, parts] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let rules = format!("{BONUS}at = [1, 3]");
    follow(whole.path(), &rules, 5, false);
    follow(parts.path(), &rules, 3, false);
    follow(parts.path(), &rules, 4, true);
    follow(parts.path(), &rules, 5, true);
    let [whole, parts] = [whole.path().join("run"), parts.path().join("run")];
    assert_same_run(&whole, &parts, "epoch-0005");
    assert_eq!(column(&whole, "curriculum/bonus"), [1.0, 2.0, 2.0, 3.0, 3.0]);
    let pay: Vec<f64> = ["train/return", "train/length", "test_det/return", "test_det/length"]
        .chunks(2)
        .flat_map(|c| column(&whole, c[0]).into_iter().zip(column(&whole, c[1])).map(|(r, n)| r / n).collect::<Vec<_>>())
        .collect();
    // A step of the point itself is worth less than 1. Tests always have the last value.
    let near = [0.0, 10.0, 10.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0, 20.0];
    assert!(pay.iter().zip(near).all(|(p, want)| (p - want).abs() < 1.0), "{pay:?}");
}

#[test]
fn a_curriculum_advances_and_a_run_ends_by_its_figures() {
    let dir = tempfile::tempdir().unwrap();
    let rules = format!(
        "[until]\nfigure = 'test_det/success'\nover = -1.0\ntimes = 2
         {BONUS}advance = {{ figure = 'train/return', over = -1000.0, times = 2 }}"
    );
    assert_eq!(follow(dir.path(), &rules, 9, false), Outcome::Finished);
    let run = dir.path().join("run");
    assert_eq!(column(&run, "curriculum/bonus"), [1.0, 1.0, 2.0, 2.0, 3.0, 3.0], "two tests at the last value end it");
    let summary: serde_json::Value = serde_json::from_slice(&read(&run, "summary.json")).unwrap();
    assert_eq!((&summary["converged"], &summary["epochs"]), (&true.into(), &6.into()));
    let metrics = read(&run, "metrics.csv");
    follow(dir.path(), &rules, 9, true);
    assert_eq!(read(&run, "metrics.csv"), metrics, "resuming does not begin it again");
}

#[test]
fn a_wrong_value_of_a_curriculum_is_told_at_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(recipe(dir.path(), "[[curriculum]]\nkey = 'bonus'\nvalues = [0.0, 200.0]\nat = [7]")).unwrap();
    let plan = Recipe::parse("test", &text, &[]).unwrap().plan().unwrap();
    let error = Trainer::start(plan, &paid(), &dir.path().join("run"), 2, None).err().unwrap();
    let told = error.to_string();
    assert!(error.exit_code() == 2 && ["bonus", "200", "at most 100"].iter().all(|w| told.contains(w)), "{told}");
}
