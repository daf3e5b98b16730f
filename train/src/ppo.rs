//! Proximal policy optimisation: one update from a rollout.

use crate::collector::Rollout;
use crate::gae::{Steps, gae};
use crate::loss::{Batch, Losses, gradients};
use crate::optim::{AdamConfig, AdamW, clip_scale, global_norm};
use crate::policy::{Compute, Policy};
use crate::shards::Shards;
use crate::{Error, Result};
use egogen::agent::PolicySpec;
use egogen::rng::stream;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

/// Weights and ranges of the loss, and how a rollout is used.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PpoConfig {
    /// Discount per step.
    pub gamma: f32,
    /// Decay of advantage estimation.
    pub lambda: f32,
    /// The ratio of densities counts only within 1 +- this.
    pub clip: f32,
    /// Weight of the value loss, c1.
    pub value: f32,
    /// Weight of the entropy bonus, c2.
    pub entropy: f32,
    /// Weight of the mean over dimensions of KL(policy || N(0, I)); keeps latents where the motion model knows them.
    #[serde(default)]
    pub kl_prior: f32,
    /// Largest norm of all gradients together.
    pub max_grad_norm: f32,
    /// Passes over each rollout.
    pub passes: usize,
    /// Steps per gradient step.
    pub batch: usize,
}

/// What an update leaves behind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct UpdateStats {
    /// Means over the update's minibatches.
    pub losses: Losses,
    /// 1 - Var(R - V) / Var(R) of the rollout; 1 is a perfect critic.
    pub explained_variance: f64,
    /// Largest |ratio - 1| in the first minibatch of the first pass, where the policy has not changed yet: rounding only.
    pub first_ratio_error: f64,
}

/// Everything that learns: parameters, moments, and the policy that acts with the parameters.
pub struct Learner {
    spec: PolicySpec,
    compute: Compute,
    shards: Shards,
    policy: Policy,
    params: Vec<f32>,
    adam: AdamW,
    updates: u64,
}

impl Learner {
    /// A learner that starts from `params` and the state `adam`, after `updates` updates.
    pub fn new(spec: PolicySpec, compute: Compute, shards: Shards, params: Vec<f32>, adam: AdamW, updates: u64) -> Result<Self> {
        let policy = Policy::new(&spec, &params, &compute)?;
        Ok(Self { spec, compute, shards, policy, params, adam, updates })
    }

    /// The policy as it is now.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// The flat parameters.
    pub fn params(&self) -> &[f32] {
        &self.params
    }

    /// The optimiser's state.
    pub fn adam(&self) -> &AdamW {
        &self.adam
    }

    /// Updates done.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// The policy's sizes.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// One update: advantages, then `passes` passes over shuffled minibatches. `seed` and the number of the update name the shuffles.
    pub fn update(&mut self, rollout: &Rollout, envs: usize, ppo: &PpoConfig, adam: &AdamConfig, seed: u64) -> Result<UpdateStats> {
        let (advantage, returns) = gae(&rollout.steps(envs), ppo.gamma, ppo.lambda);
        let mut stats = UpdateStats { explained_variance: explained_variance(&returns, &rollout.value), ..Default::default() };
        let mut order: Vec<usize> = (0..returns.len()).collect();
        let mut rng = stream(seed, "minibatches", self.updates);
        let batches = returns.len().div_ceil(ppo.batch) * ppo.passes;
        for pass in 0..ppo.passes {
            order.shuffle(&mut rng);
            for (i, chosen) in order.chunks(ppo.batch).enumerate() {
                let batch = Batch::gather(rollout, &advantage, &returns, chosen);
                let (losses, ratio_error) = self.step(&batch, ppo, adam)?;
                stats.losses.add(&losses, 1.0 / batches as f64);
                if pass == 0 && i == 0 {
                    stats.first_ratio_error = ratio_error;
                }
            }
        }
        self.updates += 1;
        self.policy = Policy::new(&self.spec, &self.params, &self.compute)?;
        Ok(stats)
    }

    /// One gradient step. Returns the losses and the largest |ratio - 1|.
    fn step(&mut self, batch: &Batch, ppo: &PpoConfig, adam: &AdamConfig) -> Result<(Losses, f64)> {
        let (grads, mut losses, ratio_error) = gradients(&self.spec, &self.params, &self.compute, &self.shards, batch, ppo)?;
        let norm = global_norm(&grads);
        losses.grad_norm = f64::from(norm);
        if let Some((name, value)) = losses.named().iter().find(|(_, v)| !v.is_finite()) {
            return Err(Error::run(format!(
                "{name} became {value} in update {}: the run stops before it reaches the weights. A lower learning rate (adam.lr) or a \
                 tighter ppo.max_grad_norm may help; the last checkpoint is whole",
                self.updates
            )));
        }
        self.adam.step(adam, &mut self.params, &grads, clip_scale(norm, ppo.max_grad_norm));
        Ok((losses, ratio_error))
    }
}

impl Rollout {
    fn steps(&self, envs: usize) -> Steps<'_> {
        Steps {
            envs,
            reward: &self.reward,
            value: &self.value,
            next_value: &self.next_value,
            terminated: &self.terminated,
            truncated: &self.truncated,
        }
    }
}

fn explained_variance(returns: &[f32], values: &[f32]) -> f64 {
    let variance = |v: &mut dyn Iterator<Item = f64>| {
        let v: Vec<f64> = v.collect();
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        v.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / v.len() as f64
    };
    let residual = variance(&mut returns.iter().zip(values).map(|(r, v)| f64::from(r - v)));
    1.0 - residual / variance(&mut returns.iter().map(|&r| f64::from(r))).max(1e-12)
}
