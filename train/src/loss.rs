//! PPO's loss and its gradients (Schulman et al. 2017): L = L_clip + c1 L_VF - c2 H + w KL(policy || prior), means over a minibatch.

use crate::backward::Tape;
use crate::collector::Rollout;
use crate::policy::{Compute, floats};
use crate::shards::Shards;
use crate::{PpoConfig, Result};
use burn::tensor::{Tensor, TensorData};
use egogen::agent::{Network, PolicySpec, entropy, kl_to_prior, log_prob, log_prob_of};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::ops::Range;

/// One minibatch on plain slices.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    pub obs: Vec<f32>,
    pub actions: Vec<f32>,
    pub old_log_prob: Vec<f32>,
    pub advantage: Vec<f32>,
    pub returns: Vec<f32>,
}

/// Means over minibatches (sums while they are gathered).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Losses {
    pub policy: f64,
    pub value: f64,
    pub entropy: f64,
    pub kl_prior: f64,
    /// Mean of (r - 1) - log r, r the ratio of densities (Schulman's k3).
    pub approx_kl: f64,
    /// Share of ratios outside the clip range.
    pub clip_fraction: f64,
    /// Norm of all gradients before clipping.
    pub grad_norm: f64,
}

impl Losses {
    /// All figures with their names, as metrics report them.
    pub fn named(&self) -> [(&'static str, f64); 7] {
        [
            ("policy_loss", self.policy),
            ("value_loss", self.value),
            ("entropy", self.entropy),
            ("kl_prior", self.kl_prior),
            ("approx_kl", self.approx_kl),
            ("clip_fraction", self.clip_fraction),
            ("grad_norm", self.grad_norm),
        ]
    }

    /// Adds `weight` times `other`.
    pub fn add(&mut self, other: &Self, weight: f64) {
        self.policy += weight * other.policy;
        self.value += weight * other.value;
        self.entropy += weight * other.entropy;
        self.kl_prior += weight * other.kl_prior;
        self.approx_kl += weight * other.approx_kl;
        self.clip_fraction += weight * other.clip_fraction;
        self.grad_norm += weight * other.grad_norm;
    }
}

/// Gradients of the loss over all parameters, mean losses, and the largest |ratio - 1|.
pub fn gradients(
    spec: &PolicySpec,
    params: &[f32],
    compute: &Compute,
    shards: &Shards,
    batch: &Batch,
    ppo: &PpoConfig,
) -> Result<(Vec<f32>, Losses, f64)> {
    let batch = &Batch { advantage: normalise(&batch.advantage), ..batch.clone() };
    let parts = match compute {
        Compute::Own => shards.map(batch.returns.len(), |rows| Ok(shard_own(spec, params, batch, rows, ppo))),
        Compute::Burn(device) => {
            let network = Network::new(spec, params, device);
            shards.map(batch.returns.len(), |rows| shard_burn(&network, batch, rows, ppo))
        }
    };
    let (mut losses, mut ratio_error) = (Losses::default(), 0.0f64);
    let mut sum: Vec<f32> = vec![];
    for part in parts {
        let (grads, part, error) = part?;
        losses.add(&part, 1.0);
        ratio_error = ratio_error.max(error);
        match sum.is_empty() {
            true => sum = grads,
            false => sum.par_iter_mut().with_min_len(1 << 14).zip(&grads).for_each(|(s, g)| *s += g),
        }
    }
    Ok((sum, losses, ratio_error))
}

/// One shard's share of the minibatch's loss, with gradients by hand.
fn shard_own(spec: &PolicySpec, params: &[f32], batch: &Batch, rows: Range<usize>, ppo: &PpoConfig) -> (Vec<f32>, Losses, f64) {
    let (dim, width, count) = (spec.layout.dim(), spec.action, batch.returns.len() as f32);
    let tape = Tape::forward(spec, params, &batch.obs[rows.start * dim..rows.end * dim]);
    let mut d_action = vec![0.0; rows.len() * 2 * width];
    let mut d_value = Vec::with_capacity(rows.len());
    let (mut losses, mut ratio_error) = (Losses::default(), 0.0f64);
    let outputs = tape.action().chunks_exact(2 * width).zip(tape.value());
    for ((i, (out, &value)), d) in rows.zip(outputs).zip(d_action.chunks_exact_mut(2 * width)) {
        let action = &batch.actions[i * width..(i + 1) * width];
        let row = Row { out, action, old_log_prob: batch.old_log_prob[i], advantage: batch.advantage[i], clamp: spec.config.logvar };
        let error = f64::from(value - batch.returns[i]);
        losses.value += error * error / f64::from(count);
        d_value.push(ppo.value * 2.0 * error as f32 / count);
        let beyond = row.gradient(ppo, count, d, &mut losses);
        ratio_error = ratio_error.max(beyond.abs());
    }
    (tape.backward(d_action, d_value), losses, ratio_error)
}

/// One person's action within a minibatch.
struct Row<'a> {
    /// Means, then log variances before the clamp.
    out: &'a [f32],
    action: &'a [f32],
    old_log_prob: f32,
    /// Normalised.
    advantage: f32,
    clamp: [f32; 2],
}

impl Row<'_> {
    /// Adds this row's terms, divided by `count`, to `losses`, and writes the gradient with respect to `out`. Returns ratio - 1.
    fn gradient(&self, ppo: &PpoConfig, count: f32, d: &mut [f32], losses: &mut Losses) -> f64 {
        let width = self.action.len();
        let (mu, raw) = self.out.split_at(width);
        let [low, high] = self.clamp;
        let logvar: Vec<f32> = raw.iter().map(|v| v.clamp(low, high)).collect();
        let log_ratio = f64::from(log_prob_of(mu, &logvar, self.action) - self.old_log_prob);
        let (ratio, beyond) = (log_ratio.exp(), log_ratio.exp_m1());
        let (clip, advantage, share) = (f64::from(ppo.clip), f64::from(self.advantage), 1.0 / f64::from(count));
        let (plain, clipped) = (ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
        losses.policy -= plain.min(clipped) * share;
        losses.approx_kl += (beyond - log_ratio) * share;
        losses.clip_fraction += if beyond.abs() > clip { share } else { 0.0 };
        // Where the clipped term is the smaller one, the ratio's gradient is zero.
        let d_log_prob = if plain <= clipped { -(plain * share) as f32 } else { 0.0 };
        let prior = ppo.kl_prior / width as f32 / count;
        let (d_mu, d_logvar) = d.split_at_mut(width);
        let (mut bits, mut kl) = (0.0f64, 0.0f64);
        for k in 0..width {
            let (off, precision, variance) = (self.action[k] - mu[k], (-logvar[k]).exp(), logvar[k].exp());
            d_mu[k] = d_log_prob * off * precision + prior * mu[k];
            let free = (low..=high).contains(&raw[k]);
            let along = d_log_prob * 0.5 * (off * off * precision - 1.0) - 0.5 * ppo.entropy / count + 0.5 * prior * (variance - 1.0);
            d_logvar[k] = if free { along } else { 0.0 };
            bits += 0.5 * (f64::from(logvar[k]) + 1.0 + TAU.ln());
            kl += 0.5 * f64::from(mu[k] * mu[k] + variance - logvar[k] - 1.0);
        }
        losses.entropy += bits * share;
        losses.kl_prior += kl / width as f64 * share;
        beyond
    }
}

/// One shard's share of the minibatch's loss, with burn's automatic gradients.
fn shard_burn(network: &Network, batch: &Batch, rows: Range<usize>, ppo: &PpoConfig) -> Result<(Vec<f32>, Losses, f64)> {
    let net = network.with_gradients();
    let spec = net.spec();
    let (dim, width) = (spec.layout.dim(), spec.action);
    let vector = |v: &[f32]| Tensor::<1>::from_data(TensorData::new(v[rows.clone()].to_vec(), [rows.len()]), net.device());
    let actions = batch.actions[rows.start * width..rows.end * width].to_vec();
    let actions = Tensor::from_data(TensorData::new(actions, [rows.len(), width]), net.device());
    let out = net.forward(&batch.obs[rows.start * dim..rows.end * dim]);

    let log_ratio = log_prob(out.mu.clone(), out.logvar.clone(), actions) - vector(&batch.old_log_prob);
    let ratio = log_ratio.clone().exp();
    let advantage = vector(&batch.advantage);
    let clipped = ratio.clone().clamp(1.0 - ppo.clip, 1.0 + ppo.clip);
    let policy = (ratio * advantage.clone()).min_pair(clipped * advantage).neg();
    let value = (vector(&batch.returns) - out.value).powf_scalar(2.0);
    let bonus = entropy(out.logvar.clone());
    let prior = kl_to_prior(out.mu, out.logvar).mean_dim(1).squeeze_dim::<1>(1);
    let loss = policy.clone() + value.clone() * ppo.value - bonus.clone() * ppo.entropy + prior.clone() * ppo.kl_prior;
    let count = batch.returns.len();
    let mut grads = (loss.sum() / count as f32).backward();
    let mut flat = vec![0.0; spec.params()];
    net.add_gradients(&mut grads, &mut flat);

    let mean = |t: Tensor<1>| -> Result<f64> { Ok(floats(t)?.iter().map(|&x| f64::from(x)).sum::<f64>() / count as f64) };
    let mut losses =
        Losses { policy: mean(policy)?, value: mean(value)?, entropy: mean(bonus)?, kl_prior: mean(prior)?, ..Default::default() };
    let mut error = 0.0f64;
    for log_ratio in floats(log_ratio)?.into_iter().map(f64::from) {
        let beyond = log_ratio.exp_m1();
        losses.approx_kl += (beyond - log_ratio) / count as f64;
        losses.clip_fraction += if beyond.abs() > f64::from(ppo.clip) { 1.0 / count as f64 } else { 0.0 };
        error = error.max(beyond.abs());
    }
    Ok((flat, losses, error))
}

impl Batch {
    /// The steps of a rollout with these indices.
    pub fn gather(rollout: &Rollout, advantage: &[f32], returns: &[f32], chosen: &[usize]) -> Self {
        let rows = |from: &[f32]| {
            let width = from.len() / returns.len();
            chosen.iter().flat_map(|&k| from[k * width..(k + 1) * width].iter().copied()).collect()
        };
        Self {
            obs: rows(&rollout.obs),
            actions: rows(&rollout.actions),
            old_log_prob: rows(&rollout.log_prob),
            advantage: rows(advantage),
            returns: rows(returns),
        }
    }
}

/// Zero mean, unit (sample) standard deviation.
fn normalise(values: &[f32]) -> Vec<f32> {
    let n = values.len() as f64;
    let mean = values.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
    let square = values.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>();
    let std = (square / (n - 1.0).max(1.0)).sqrt();
    values.iter().map(|&x| ((f64::from(x) - mean) / (std + 1e-8)) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Policy;
    use egogen::DeviceChoice;
    use egogen::agent::{ObsGroup, ObsLayout};
    use egogen::io::{Precision, Tensors, pack_tensors};
    use std::collections::BTreeMap;

    struct Case {
        spec: PolicySpec,
        params: Vec<f32>,
        grads: Vec<f32>,
        batch: Batch,
        /// policy, value, entropy, KL to the prior, approximate KL, clip fraction
        figures: Vec<f32>,
        outputs: [Vec<f32>; 3],
    }

    const ROWS: usize = 13;

    fn case(name: &str, trunk: Option<usize>) -> Case {
        let t = crate::fixture();
        let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
        let layout = ObsLayout::new(vec![group("state", &[2, 7]), group("rays", &[3, 4]), group("dist", &[1]), group("plain", &[3])]);
        let config = serde_json::json!({"gru": {"state": 6, "rays": 5}, "octaves": 3, "trunk": trunk, "logvar": [-0.15, 0.15]});
        let spec = PolicySpec::new(serde_json::from_value(config).unwrap(), layout, 4).unwrap();
        let flat = |what: &str| {
            let prefix = format!("{name}.{what}/");
            let names: Vec<_> = t.names().into_iter().filter(|n| n.starts_with(&prefix)).collect();
            let tensors: Vec<_> = names
                .iter()
                .map(|n| {
                    let shape = t.shape(n).unwrap();
                    (n[prefix.len()..].to_string(), shape.clone(), t.f32s(n, &shape).unwrap())
                })
                .collect();
            let bytes = pack_tensors(&tensors, &BTreeMap::new(), Precision::Full).unwrap();
            spec.from_tensors(&Tensors::from_bytes(what, bytes).unwrap()).unwrap()
        };
        let get = |what: &str, shape: &[usize]| t.f32s(&format!("{name}.{what}"), shape).unwrap();
        let batch = Batch {
            obs: get("obs", &[ROWS, 30]),
            actions: get("action", &[ROWS, 4]),
            old_log_prob: get("old", &[ROWS]),
            advantage: get("advantage", &[ROWS]),
            returns: get("returns", &[ROWS]),
        };
        let outputs = [get("mu", &[ROWS, 4]), get("logvar", &[ROWS, 4]), get("value", &[ROWS])];
        Case { params: flat("param"), grads: flat("grad"), batch, figures: get("figures", &[6]), outputs, spec }
    }

    fn assert_close(have: &[f32], want: &[f32], what: &str) {
        assert_eq!(have.len(), want.len());
        let scale = want.iter().fold(1.0f32, |m, x| m.max(x.abs()));
        for (i, (h, w)) in have.iter().zip(want).enumerate() {
            assert!((h - w).abs() < 1e-5 * scale, "{what} {i}: {h} against {w}");
        }
    }

    #[test]
    fn losses_and_gradients_agree_with_torch() {
        let burn = Compute::Burn(DeviceChoice::Flex.device().unwrap());
        let ppo: PpoConfig = serde_json::from_value(serde_json::json!({
            "gamma": 0.0, "lambda": 0.0, "clip": 0.2, "value": 0.7, "entropy": 0.05, "kl_prior": 0.4, "max_grad_norm": 1.0,
            "passes": 1, "batch": ROWS
        }))
        .unwrap();
        for (name, trunk) in [("sum", None), ("project", Some(10))] {
            let c = case(name, trunk);
            for (compute, shards) in [(&Compute::Own, 1), (&Compute::Own, 3), (&burn, 1), (&burn, 2)] {
                let what = format!("{name} {compute:?} {shards}");
                let acts = Policy::new(&c.spec, &c.params, compute).unwrap().act(&c.batch.obs).unwrap();
                assert_close(&acts.mu, &c.outputs[0], &what);
                assert_close(&acts.logvar, &c.outputs[1], &what);
                assert_close(&acts.value, &c.outputs[2], &what);
                let shards = Shards::new(shards, 2).unwrap();
                let (grads, losses, _) = gradients(&c.spec, &c.params, compute, &shards, &c.batch, &ppo).unwrap();
                assert_close(&grads, &c.grads, &what);
                let l = [losses.policy, losses.value, losses.entropy, losses.kl_prior, losses.approx_kl, losses.clip_fraction];
                assert_close(&l.map(|x| x as f32), &c.figures, &what);
            }
        }
    }
}
