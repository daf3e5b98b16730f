//! PPO's loss and its gradients (Schulman et al. 2017): L = L_clip + c1 L_VF - c2 H + w KL(policy || prior), means over a minibatch.

mod autodiff;
mod own;

use crate::collector::Rollout;
use crate::policy::Compute;
use crate::ppo::Targets;
use crate::shards::Shards;
use crate::{PpoConfig, Result};
use egogen::agent::{Network, PolicySpec};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// One minibatch on plain slices.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    pub obs: Vec<f32>,
    pub actions: Vec<f32>,
    /// Log density and value at collection; the value on the critic's scale.
    pub old_log_prob: Vec<f32>,
    pub old_value: Vec<f32>,
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

    /// All figures times `by`.
    pub fn scaled(&self, by: f64) -> Self {
        let mut out = Self::default();
        out.add(self, by);
        out
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

/// Mean losses, and the largest |ratio - 1|. `grads` becomes the gradients over all parameters; what it holds before does not matter, but
/// its memory is used again.
pub fn gradients(
    spec: &PolicySpec,
    params: &[f32],
    (compute, shards): (&Compute, &Shards),
    batch: &Batch,
    ppo: &PpoConfig,
    grads: &mut Vec<f32>,
) -> Result<(Losses, f64)> {
    let normalised = ppo.advantage_normalization.then(|| Batch { advantage: normalise(&batch.advantage), ..batch.clone() });
    let batch = normalised.as_ref().unwrap_or(batch);
    let rows = batch.returns.len();
    let device = match compute {
        Compute::Own => {
            // Every layer is written anew; what no gradient moves stays 0.
            grads.resize(spec.params(), 0.0);
            grads[spec.obs_norm_range()].fill(0.0);
            return Ok(own::learn(spec, params, batch, shards.ranges(rows).collect(), ppo, grads));
        }
        Compute::Burn(device) => device,
    };
    let network = Network::new(spec, params, device);
    let (mut losses, mut ratio_error) = (Losses::default(), 0.0f64);
    grads.clear();
    grads.resize(spec.params(), 0.0);
    for part in shards.map(rows, |rows| autodiff::shard(&network, batch, rows, ppo)) {
        let (part_grads, part, error) = part?;
        losses.add(&part, 1.0);
        ratio_error = ratio_error.max(error);
        grads.par_iter_mut().with_min_len(1 << 14).zip(&part_grads).for_each(|(s, g)| *s += g);
    }
    Ok((losses, ratio_error))
}

impl Batch {
    /// The steps of a rollout with these indices.
    pub(crate) fn gather(rollout: &Rollout, targets: &Targets, chosen: &[usize]) -> Self {
        let rows = |from: &[f32]| {
            let width = from.len() / targets.returns.len();
            let mut rows = Vec::with_capacity(chosen.len() * width);
            chosen.iter().for_each(|&k| rows.extend_from_slice(&from[k * width..(k + 1) * width]));
            rows
        };
        Self {
            obs: rows(&rollout.obs),
            actions: rows(&rollout.actions),
            old_log_prob: rows(&rollout.log_prob),
            old_value: rows(&targets.value),
            advantage: rows(&targets.advantage),
            returns: rows(&targets.returns),
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
mod tests;
