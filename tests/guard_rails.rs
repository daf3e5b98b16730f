//! Numbers that are not finite stop a run, which says what they are of and what is left.

#[path = "common/altered.rs"]
mod altered;

use altered::Altered;
use egogen_envs::StepResult;
use egogen_envs::point::PointGoal;
use egogen_train::recipe::Recipe;
use egogen_train::registry::{Made, Purpose, Registry};
use egogen_train::trainer::Trainer;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Spoils the result of a step.
type Spoil = fn(&mut StepResult);

/// How a run of two epochs, 64 steps each, ends where the steps from `at` of the environments for `purpose` are spoilt.
fn stopped(dir: &Path, purpose: Purpose, at: u32, spoil: Spoil) -> String {
    let mut registry = Registry::default();
    registry.add("point", move |_, n, made_for| {
        let at = if made_for == purpose { at } else { 0 };
        let mut step = 0;
        let change = move |result: &mut StepResult| {
            step += 1;
            if at > 0 && step >= at {
                spoil(result);
            }
        };
        let env = Box::new(Altered { point: PointGoal::new(n, 0), change });
        Ok(Made { env, origin: BTreeMap::new() })
    });
    let sets = ["run.epochs=2", "run.epoch_steps=4096", "test.episodes=8", "test.every=1", "checkpoint.every=1"].map(String::from);
    let plan = Recipe::load("point", &sets).unwrap().plan().unwrap();
    let mut trainer = Trainer::start(plan, &registry, dir, 2, None).unwrap();
    let error = trainer.run(&AtomicBool::new(false)).unwrap_err();
    assert_eq!(error.exit_code(), 1);
    error.to_string()
}

#[test]
fn spoilt_steps_are_named() {
    let cases: [(Spoil, &[&str]); 5] = [
        (|r| r.reward[3] = f32::NAN, &["environment 3", "NaN", "reward", "step 70 of collection"]),
        (|r| r.info[3 * 5 + 1] = f32::INFINITY, &["environment 5", "inf", "'arrival'"]),
        (|r| r.obs[4 * 2 + 3] = f32::NAN, &["environment 2", "NaN", "observation '", "entry 1"]),
        (|r| r.final_obs[0] = f32::NEG_INFINITY, &["environment 0", "-inf", "observation '"]),
        (|r| r.episode[4 * 7] = f32::NAN, &["environment 7", "NaN", "'success'"]),
    ];
    for (spoil, words) in cases {
        let dir = tempfile::tempdir().unwrap();
        let error = stopped(dir.path(), Purpose::Train, 70, spoil);
        let left = dir.path().join("checkpoints/epoch-0001");
        assert!(words.iter().all(|w| error.contains(w)), "{words:?}: {error}");
        assert!(error.contains("stops in epoch 2") && error.contains(&format!("last good checkpoint is {}", left.display())), "{error}");
        assert!(left.join("checkpoint.json").is_file());
    }
}

#[test]
fn without_a_checkpoint_it_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let error = stopped(dir.path(), Purpose::Train, 2, |r| r.reward[0] = f32::NAN);
    assert!(error.contains("stops in epoch 1") && error.contains("no checkpoint was written"), "{error}");
    let dir = tempfile::tempdir().unwrap();
    let error = stopped(dir.path(), Purpose::Test, 2, |r| r.info[0] = f32::NAN);
    assert!(error.contains("step 2 of the test") && error.contains("'progress'"), "{error}");
}

/// Finite rewards whose sums are not.
#[test]
fn losses_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let error = stopped(dir.path(), Purpose::Train, 70, |r| r.reward.fill(f32::MAX));
    assert!(error.contains(" became ") && error.contains("in update 3") && error.contains("epoch-0001"), "{error}");
    let name = ["value_loss", "policy_loss", "return", "advantage", "grad_norm"].into_iter().find(|n| error.contains(n));
    assert!(name.is_some(), "{error}");
}
