use super::*;
use crate::Collector;
use egogen::agent::{ObsGroup, ObsLayout};
use egogen_envs::VecEnv;
use egogen_envs::point::PointGoal;

fn point(envs: usize) -> (Collector, Learner) {
    let env = PointGoal::new(envs, 0);
    let layout = ObsLayout::new(env.spec().obs.clone());
    let spec = PolicySpec::new(serde_json::from_str(r#"{"trunk": 8, "blocks": 1}"#).unwrap(), layout, 2).unwrap();
    let (params, adam) = (spec.init(1), AdamW::new(spec.params()));
    let learner = Learner::new(spec, Compute::Own, Shards::new(1, 1).unwrap(), params, adam, Progress::default()).unwrap();
    (Collector::new(Box::new(env), 3).unwrap(), learner)
}

fn config(changes: serde_json::Value) -> PpoConfig {
    let mut config = serde_json::json!({
        "gamma": 0.9, "lambda": 0.7, "clip": 0.2, "value": 0.5, "entropy": 0.0, "max_grad_norm": 1.0, "passes": 3, "batch": 64
    });
    config.as_object_mut().unwrap().extend(changes.as_object().unwrap().clone());
    serde_json::from_value(config).unwrap()
}

fn adam(schedule: serde_json::Value) -> AdamConfig {
    serde_json::from_value(serde_json::json!({"lr": 1e-2, "schedule": schedule})).unwrap()
}

/// Three collections with Tianshou's `reward_normalization`.
#[test]
fn returns_are_scaled_as_in_tianshou() {
    let t = crate::fixture();
    let (_, mut learner) = point(1);
    let ppo = config(serde_json::json!({"reward_normalization": true}));
    let rules = Rules { envs: 1, ppo: &ppo, adam: &adam("constant".into()), seed: 0, updates: 1 };
    for c in 0..3 {
        let get = |name: &str| t.f32s(&format!("tianshou.returns.{c}.{name}"), &[12]).unwrap();
        let flags = |name: &str| -> Vec<bool> { get(name).iter().map(|&x| x != 0.0).collect() };
        let (reward, terminated, truncated) = (get("reward"), flags("terminated"), flags("truncated"));
        let rollout = Rollout { reward, terminated, truncated, ..Default::default() };
        let targets = learner.targets(&rollout, get("value"), &get("next_value"), &rules);
        let pairs = [(targets.advantage, get("advantage")), (targets.returns, get("returns"))];
        for (have, want) in pairs.iter().flat_map(|(h, w)| h.iter().zip(w)) {
            assert!((have - want).abs() < 1e-4 * want.abs().max(1.0), "collection {c}: {have} against {want}");
        }
    }
}

/// Three batches through Tianshou's `RunningMeanStd`, then some rows normalised, far ones among them.
#[test]
fn observations_are_normalised_as_in_tianshou() {
    let t = crate::fixture();
    let layout = ObsLayout::new(vec![ObsGroup { name: "a".into(), shape: vec![3] }, ObsGroup { name: "b".into(), shape: vec![2] }]);
    let config = r#"{"hidden": [4], "obs_norm": true}"#;
    let spec = PolicySpec::new(serde_json::from_str(config).unwrap(), layout, 2).unwrap();
    let (params, adam) = (spec.init(1), AdamW::new(spec.learned()));
    let mut learner = Learner::new(spec, Compute::Own, Shards::new(1, 1).unwrap(), params, adam, Progress::default()).unwrap();
    for batch in ["0", "1", "2"] {
        let name = format!("obs.{batch}");
        learner.observe(&t.f32s(&name, &t.shape(&name).unwrap()).unwrap());
    }
    let (probe, want) = (t.f32s("obs.probe", &[6, 5]).unwrap(), t.f32s("obs.normalised", &[6, 5]).unwrap());
    let have = learner.spec.normalised(&learner.params[learner.spec.obs_norm_range()], &probe);
    assert!(have.iter().zip(&want).all(|(h, w)| (h - w).abs() < 2e-5 * w.abs().max(1.0)), "{have:?} against {want:?}");
    assert!(want.contains(&10.0) && want.contains(&-10.0), "the cut is tested");
}

#[test]
fn recomputing_without_learning_changes_nothing() {
    let (mut collector, mut learner) = point(8);
    let rollout = collector.collect(learner.policy(), 45).unwrap();
    assert!(rollout.truncated.contains(&true) && rollout.terminated.contains(&true));
    let ppo = config(serde_json::json!({}));
    let rules = Rules { envs: 8, ppo: &ppo, adam: &adam("constant".into()), seed: 0, updates: 1 };
    let first = learner.targets(&rollout, rollout.value.clone(), &rollout.next_value, &rules);
    let again = learner.recompute(&rollout, &rules).unwrap();
    assert_eq!((first.value, first.advantage, first.returns), (again.value, again.advantage, again.returns));
    // While learning it does.
    let with = |recompute: bool| {
        let (_, mut learner) = point(8);
        let ppo = config(serde_json::json!({"recompute_advantage": recompute}));
        learner.update(&rollout, &Rules { ppo: &ppo, ..rules }).unwrap();
        learner.params().to_vec()
    };
    assert_ne!(with(true), with(false));
}

#[test]
fn a_large_divergence_ends_the_update() {
    let steps = |target: serde_json::Value| {
        let (mut collector, mut learner) = point(8);
        let rollout = collector.collect(learner.policy(), 40).unwrap();
        let ppo = config(serde_json::json!({"target_kl": target}));
        let rules = Rules { envs: 8, ppo: &ppo, adam: &adam("constant".into()), seed: 0, updates: 1 };
        learner.update(&rollout, &rules).unwrap()
    };
    // 320 steps in minibatches of 64, three passes.
    assert_eq!(steps(serde_json::Value::Null).gradient_steps, 15.0);
    let stopped = steps(1e-6.into());
    assert_eq!(stopped.gradient_steps, 1.0);
    // The one minibatch had the policy that collected: no divergence, and its mean is not diluted.
    assert!(stopped.losses.approx_kl.abs() < 1e-9 && stopped.losses.grad_norm > 0.0);
}

#[test]
fn step_sizes_follow_the_schedule() {
    let after = |schedule: serde_json::Value| {
        let (mut collector, mut learner) = point(8);
        let ppo = config(serde_json::json!({}));
        let adam = adam(schedule);
        let mut step = || {
            let rollout = collector.collect(learner.policy(), 8).unwrap();
            let rules = Rules { envs: 8, ppo: &ppo, adam: &adam, seed: 0, updates: 4 };
            learner.update(&rollout, &rules).unwrap().learning_rate
        };
        [step(), step(), step()]
    };
    let close = |have: [f64; 3], want: [f64; 3]| assert!(have.iter().zip(want).all(|(h, w)| (h - w).abs() < 1e-8), "{have:?}");
    close(after("constant".into()), [1e-2, 1e-2, 1e-2]);
    close(after("linear".into()), [1e-2, 7.5e-3, 5e-3]);
    // One minibatch a pass: two of three adapt, always upwards here, and the next update goes on from there.
    let rising = serde_json::json!({"adaptive": {"target_kl": 1e3, "factor": 1.1, "max": 1.0}});
    close(after(rising), [1e-2 * 1.21, 1e-2 * 1.21f64.powi(2), 1e-2 * 1.21f64.powi(3)]);
}
