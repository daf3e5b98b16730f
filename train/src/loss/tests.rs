//! The loss against PyTorch and Tianshou.

use super::*;
use crate::{Policy, PriorForm};
use egogen::DeviceChoice;
use egogen::agent::{ActionSpace, ObsGroup, ObsLayout};
use egogen::io::{Precision, Tensors, pack_tensors};
use std::collections::BTreeMap;

const ROWS: usize = 13;

/// The fixture's tensors `prefix`/... as this policy's flat vector.
fn flat(spec: &PolicySpec, prefix: &str) -> Vec<f32> {
    let t = crate::fixture();
    let prefix = format!("{prefix}/");
    let named = |n: String| {
        let shape = t.shape(&n).unwrap();
        (n[prefix.len()..].to_string(), shape.clone(), t.f32s(&n, &shape).unwrap())
    };
    let tensors: Vec<_> = t.names().into_iter().filter(|n| n.starts_with(&prefix)).map(|n| named(n.to_string())).collect();
    let bytes = pack_tensors(&tensors, &BTreeMap::new(), Precision::Full).unwrap();
    spec.from_tensors(&Tensors::from_bytes(&prefix, bytes).unwrap()).unwrap()
}

/// The network of the cases "sum", "project" and "paper".
fn paper(trunk: Option<usize>) -> PolicySpec {
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
    let layout = ObsLayout::new(vec![group("state", &[2, 7]), group("rays", &[3, 4]), group("dist", &[1]), group("plain", &[3])]);
    let config = serde_json::json!({"gru": {"state": 6, "rays": 5}, "octaves": 3, "trunk": trunk, "logvar": [-0.15, 0.15]});
    PolicySpec::new(serde_json::from_value(config).unwrap(), layout, 4).unwrap()
}

fn batch(name: &str, dim: usize) -> Batch {
    let t = crate::fixture();
    let actions = format!("{name}.action");
    let shape = t.shape(&actions).unwrap();
    let get = |what: &str, shape: &[usize]| t.f32s(&format!("{name}.{what}"), shape).unwrap();
    let values = if t.names().iter().any(|n| *n == format!("{name}.old_value")) { "old_value" } else { "value" };
    Batch {
        obs: get("obs", &[ROWS, dim]),
        actions: t.f32s(&actions, &shape).unwrap(),
        old_log_prob: get("old", &[ROWS]),
        old_value: get(values, &[ROWS]),
        advantage: get("advantage", &[ROWS]),
        returns: get("returns", &[ROWS]),
    }
}

fn ppo(changes: serde_json::Value) -> PpoConfig {
    let mut config = serde_json::json!({
        "gamma": 0.0, "lambda": 0.0, "clip": 0.2, "value": 0.7, "entropy": 0.05, "max_grad_norm": 1.0, "passes": 1, "batch": ROWS
    });
    config.as_object_mut().unwrap().extend(changes.as_object().unwrap().clone());
    serde_json::from_value(config).unwrap()
}

fn gradients(
    spec: &PolicySpec,
    params: &[f32],
    compute: &Compute,
    shards: &Shards,
    batch: &Batch,
    ppo: &PpoConfig,
) -> Result<(Vec<f32>, Losses, f64)> {
    // What the buffer held before must not matter.
    let mut grads = vec![f32::NAN; spec.params()];
    let (losses, ratio_error) = super::gradients(spec, params, (compute, shards), batch, ppo, &mut grads)?;
    Ok((grads, losses, ratio_error))
}

fn assert_close(have: &[f32], want: &[f32], what: &str) {
    assert_eq!(have.len(), want.len());
    let scale = want.iter().fold(1.0f32, |m, x| m.max(x.abs()));
    for (i, (h, w)) in have.iter().zip(want).enumerate() {
        assert!((h - w).abs() < 1e-5 * scale, "{what} {i}: {h} against {w}");
    }
}

/// Every tensor's gradient to 1e-4 of its largest entry.
fn assert_gradients(spec: &PolicySpec, have: &[f32], want: &[f32], what: &str) {
    for ((name, _, have), (_, _, want)) in spec.to_tensors(have).into_iter().zip(spec.to_tensors(want)) {
        let scale = want.iter().fold(1e-6f32, |m, x| m.max(x.abs()));
        for (i, (h, w)) in have.iter().zip(&want).enumerate() {
            assert!((h - w).abs() < 1e-4 * scale, "{what} {name} {i}: {h} against {w} at a scale of {scale}");
        }
    }
}

/// Both ways of computing, with different numbers of shards.
fn everywhere(run: impl Fn(&Compute, &Shards, &str)) {
    let burn = Compute::Burn(DeviceChoice::Flex.device().unwrap());
    for (compute, shards) in [(&Compute::Own, 1), (&Compute::Own, 3), (&burn, 1), (&burn, 2)] {
        run(compute, &Shards::new(shards, 2).unwrap(), &format!("{compute:?} {shards}"));
    }
}

#[test]
fn losses_and_gradients_agree_with_torch() {
    let t = crate::fixture();
    for (name, trunk) in [("sum", None), ("project", Some(10))] {
        let (spec, batch) = (paper(trunk), batch(name, 30));
        let (params, grads) = (flat(&spec, &format!("{name}.param")), flat(&spec, &format!("{name}.grad")));
        let ppo = ppo(serde_json::json!({"kl_prior": 0.4}));
        everywhere(|compute, shards, what| {
            let acts = Policy::new(&spec, &params, compute).unwrap().act(&batch.obs).unwrap();
            let get = |what: &str, shape: &[usize]| t.f32s(&format!("{name}.{what}"), shape).unwrap();
            assert_close(&acts.mu, &get("mu", &[ROWS, 4]), what);
            assert_close(&acts.logvar, &get("logvar", &[ROWS, 4]), what);
            assert_close(&acts.value, &get("value", &[ROWS]), what);
            let (have, losses, _) = gradients(&spec, &params, compute, shards, &batch, &ppo).unwrap();
            assert_gradients(&spec, &have, &grads, what);
            let l = [losses.policy, losses.value, losses.entropy, losses.kl_prior, losses.approx_kl, losses.clip_fraction];
            assert_close(&l.map(|x| x as f32), &get("figures", &[6]), what);
        });
    }
}

/// A row in four shards is that row in one.
#[test]
fn fewer_rows_than_shards() {
    let (spec, mut one) = (paper(None), batch("sum", 30));
    let params = flat(&spec, "sum.param");
    for values in [&mut one.obs, &mut one.actions, &mut one.old_log_prob, &mut one.old_value, &mut one.advantage, &mut one.returns] {
        values.truncate(values.len() / ROWS);
    }
    let ppo = ppo(serde_json::json!({"advantage_normalization": false}));
    for compute in [Compute::Own, Compute::Burn(DeviceChoice::Flex.device().unwrap())] {
        let run = |shards| gradients(&spec, &params, &compute, &Shards::new(shards, 2).unwrap(), &one, &ppo).unwrap();
        let ((four, losses, _), (want, same, _)) = (run(4), run(1));
        assert_gradients(&spec, &four, &want, &format!("{compute:?}"));
        losses.named().iter().zip(same.named()).for_each(|((name, a), (_, b))| assert!((a - b).abs() < 1e-5, "{name}: {a} {b}"));
        assert!(losses.value > 0.0 && want.iter().any(|g| *g != 0.0));
    }
}

#[test]
fn the_penalty_on_means_agrees_with_torch() {
    let (spec, batch) = (paper(None), batch("sum", 30));
    let (params, grads) = (flat(&spec, "sum.param"), flat(&spec, "sum.grad_mean"));
    let mean = ppo(serde_json::json!({"kl_prior": 0.4, "kl_prior_form": "mean"}));
    let figures = crate::fixture().f32s("sum.figures", &[6]).unwrap();
    everywhere(|compute, shards, what| {
        let (have, losses, _) = gradients(&spec, &params, compute, shards, &batch, &mean).unwrap();
        assert_gradients(&spec, &have, &grads, what);
        assert!((losses.kl_prior - f64::from(figures[3])).abs() < 1e-5, "the whole divergence is reported");
    });
    assert_eq!(mean.kl_prior_form, PriorForm::Mean);
}

/// Tianshou's options by the fixture's names for them.
fn variants() -> [(&'static str, PpoConfig); 4] {
    [
        ("plain", ppo(serde_json::json!({}))),
        ("dual", ppo(serde_json::json!({"dual_clip": 1.3}))),
        ("value", ppo(serde_json::json!({"value_clip": true}))),
        ("raw", ppo(serde_json::json!({"dual_clip": 1.3, "value_clip": true, "advantage_normalization": false}))),
    ]
}

/// All variants of a case that went through Tianshou's `PPOPolicy.learn`.
fn agrees_with_tianshou(name: &str, spec: &PolicySpec, params: &[f32], batch: &Batch, ppo: &PpoConfig, variant: &str) {
    let want = flat(spec, &format!("{name}.{variant}"));
    let figures = crate::fixture().f32s(&format!("{name}.figures.{variant}"), &[3]).unwrap();
    everywhere(|compute, shards, what| {
        let what = &format!("{name} {variant} {what}");
        let (have, losses, _) = gradients(spec, params, compute, shards, batch, ppo).unwrap();
        assert_gradients(spec, &have, &want, what);
        assert_close(&[losses.policy, losses.value, losses.entropy].map(|x| x as f32), &figures, what);
    });
}

#[test]
fn the_papers_network_learns_as_with_tianshou() {
    let spec = paper(None);
    let (params, batch) = (flat(&spec, "sum.param"), batch("paper", 30));
    for (variant, ppo) in variants() {
        agrees_with_tianshou("paper", &spec, &params, &batch, &ppo, variant);
    }
}

/// Plain layers over a vector of five floats.
fn small(config: serde_json::Value, action: ActionSpace) -> PolicySpec {
    let layout = ObsLayout::new(vec![ObsGroup { name: "state".into(), shape: vec![5] }]);
    PolicySpec::new(serde_json::from_value(config).unwrap(), layout, action).unwrap()
}

#[test]
fn small_networks_learn_as_with_tianshou() {
    let free = small(serde_json::json!({"hidden": [8, 6], "log_std": -0.5}), ActionSpace::Continuous(3));
    let choice = small(serde_json::json!({"hidden": [8, 6], "activation": "relu", "shared": true}), ActionSpace::Discrete(4));
    for (name, spec) in [("free", free), ("choice", choice)] {
        let (params, batch) = (flat(&spec, &format!("{name}.param")), batch(name, 5));
        for (variant, ppo) in variants() {
            agrees_with_tianshou(name, &spec, &params, &batch, &ppo, variant);
        }
    }
}

/// Noise that depends on the state by Stable-Baselines3's own distribution (tests/tools/sb3/make.py). At ratio 1 the loss's gradient is
/// that of -mean (A log p + 0.3 H).
#[test]
fn state_dependent_noise_agrees_with_stable_baselines() {
    let t = Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/fixtures/sb3.safetensors")).unwrap();
    let get = |name: &str, shape: &[usize]| t.f32s(&format!("gsde.{name}"), shape).unwrap();
    let layout = ObsLayout::new(vec![ObsGroup { name: "state".into(), shape: vec![3] }]);
    let config = serde_json::json!({"hidden": [5], "state_noise": {"log_std": 0.0, "steps": 1}});
    let spec = PolicySpec::new(serde_json::from_value(config).unwrap(), layout, 2).unwrap();
    // The critic, which the fixture does not have, is zero, and so are its gradients.
    let flat = |prefix: &str| {
        let zeros = spec.to_tensors(&vec![0.0; spec.params()]);
        let named = |(name, shape, zero): (String, Vec<usize>, Vec<f32>)| t.f32s(&format!("{prefix}{name}"), &shape).unwrap_or(zero);
        zeros.into_iter().flat_map(named).collect::<Vec<f32>>()
    };
    let (params, mut grads) = (flat("gsde/"), flat("gsde/gradient/"));
    grads.iter_mut().for_each(|g| *g /= -11.0);
    let batch = Batch {
        obs: get("obs", &[11, 3]),
        actions: get("action", &[11, 2]),
        old_log_prob: get("log_prob", &[11]),
        old_value: vec![0.0; 11],
        advantage: get("weights", &[11]),
        returns: vec![0.0; 11],
    };
    let ppo = ppo(serde_json::json!({"entropy": 0.3, "advantage_normalization": false}));
    everywhere(|compute, shards, what| {
        let acts = Policy::new(&spec, &params, compute).unwrap().act(&batch.obs).unwrap();
        assert_close(&acts.mu, &get("mean", &[11, 2]), what);
        assert_close(&acts.logvar, &get("logvar", &[11, 2]), what);
        assert_close(&acts.log_prob(&batch.actions), &batch.old_log_prob, what);
        let (have, losses, error) = gradients(&spec, &params, compute, shards, &batch, &ppo).unwrap();
        assert!(error < 1e-5, "{what}: ratio off by {error}");
        assert_gradients(&spec, &have, &grads, what);
        let entropy = get("entropy", &[11]).iter().sum::<f32>() / 11.0;
        assert_close(&[losses.entropy as f32], &[entropy], what);
    });
}
