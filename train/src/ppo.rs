//! Proximal policy optimisation (Schulman et al. 2017): the loss and one update from a rollout.

use crate::actor::{Actor, floats};
use crate::collector::Rollout;
use crate::gae::{Steps, gae};
use crate::optim::{AdamConfig, AdamW, clip_scale, global_norm};
use crate::shards::Shards;
use crate::{Error, Result};
use burn::tensor::{Device, Tensor, TensorData};
use egogen::agent::{Network, PolicySpec, entropy, kl_to_prior, log_prob};
use egogen::rng::stream;
use rand::seq::SliceRandom;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;

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

/// Everything that learns: parameters, moments, and the network built from the parameters.
pub struct Learner {
    spec: Arc<PolicySpec>,
    device: Device,
    shards: Shards,
    network: Network,
    params: Vec<f32>,
    adam: AdamW,
    updates: u64,
}

impl Learner {
    /// A learner that starts from `params` and the state `adam`, after `updates` updates.
    pub fn new(spec: Arc<PolicySpec>, device: Device, shards: Shards, params: Vec<f32>, adam: AdamW, updates: u64) -> Self {
        let network = Network::new(spec.clone(), &params, &device);
        Self { spec, device, shards, network, params, adam, updates }
    }

    /// The policy as it is now.
    pub fn actor(&self) -> Actor<'_> {
        Actor { network: &self.network, shards: &self.shards }
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
    pub fn spec(&self) -> &Arc<PolicySpec> {
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
        Ok(stats)
    }

    /// One gradient step. Returns the losses and the largest |ratio - 1|.
    fn step(&mut self, batch: &Batch, ppo: &PpoConfig, adam: &AdamConfig) -> Result<(Losses, f64)> {
        let (grads, mut losses, ratio_error) = gradients(&self.network, &self.shards, batch, ppo);
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
        self.network = Network::new(self.spec.clone(), &self.params, &self.device);
        Ok((losses, ratio_error))
    }
}

/// Gradients of the loss over all parameters, mean losses, and the largest |ratio - 1|.
pub fn gradients(network: &Network, shards: &Shards, batch: &Batch, ppo: &PpoConfig) -> (Vec<f32>, Losses, f64) {
    let advantage = normalise(&batch.advantage);
    let parts = shards.map(batch.returns.len(), |rows| shard(network, batch, &advantage, rows, ppo));
    let (mut losses, mut ratio_error) = (Losses::default(), 0.0f64);
    let mut sum: Option<Vec<f32>> = None;
    for (grads, part, error) in parts {
        losses.add(&part, 1.0);
        ratio_error = ratio_error.max(error);
        match &mut sum {
            None => sum = Some(grads),
            Some(sum) => sum.par_iter_mut().with_min_len(1 << 14).zip(&grads).for_each(|(s, g)| *s += g),
        }
    }
    (sum.unwrap_or_default(), losses, ratio_error)
}

/// One shard's share of the minibatch's loss: L = L_clip + c1 L_VF - c2 H + w KL(policy || prior), means over the whole minibatch.
fn shard(network: &Network, batch: &Batch, advantage: &[f32], rows: Range<usize>, ppo: &PpoConfig) -> (Vec<f32>, Losses, f64) {
    let net = network.with_gradients();
    let spec = net.spec();
    let (dim, width) = (spec.layout.dim(), spec.action);
    let vector = |v: &[f32]| Tensor::<1>::from_data(TensorData::new(v[rows.clone()].to_vec(), [rows.len()]), net.device());
    let actions = batch.actions[rows.start * width..rows.end * width].to_vec();
    let actions = Tensor::from_data(TensorData::new(actions, [rows.len(), width]), net.device());
    let out = net.forward(&batch.obs[rows.start * dim..rows.end * dim]);

    let log_ratio = log_prob(out.mu.clone(), out.logvar.clone(), actions) - vector(&batch.old_log_prob);
    let ratio = log_ratio.clone().exp();
    let advantage = vector(advantage);
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

    let mean = |t: Tensor<1>| floats(t).iter().map(|&x| f64::from(x)).sum::<f64>() / count as f64;
    let mut losses = Losses { policy: mean(policy), value: mean(value), entropy: mean(bonus), kl_prior: mean(prior), ..Default::default() };
    let mut error = 0.0f64;
    for log_ratio in floats(log_ratio).into_iter().map(f64::from) {
        let beyond = log_ratio.exp_m1();
        losses.approx_kl += (beyond - log_ratio) / count as f64;
        losses.clip_fraction += f64::from(u8::from(beyond.abs() > f64::from(ppo.clip))) / count as f64;
        error = error.max(beyond.abs());
    }
    (flat, losses, error)
}

impl Batch {
    fn gather(rollout: &Rollout, advantage: &[f32], returns: &[f32], chosen: &[usize]) -> Self {
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

/// Zero mean, unit (sample) standard deviation.
fn normalise(values: &[f32]) -> Vec<f32> {
    let n = values.len() as f64;
    let mean = values.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
    let square = values.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>();
    let std = (square / (n - 1.0).max(1.0)).sqrt();
    values.iter().map(|&x| ((f64::from(x) - mean) / (std + 1e-8)) as f32).collect()
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
