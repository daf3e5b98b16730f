//! Proximal policy optimisation: one update from a rollout.

use crate::collector::Rollout;
use crate::gae::{Steps, gae};
use crate::loss::{Batch, Losses, gradients};
use crate::optim::{AdamConfig, AdamW, clip_scale, global_norm};
use crate::policy::{Compute, Policy};
use crate::running::Running;
use crate::shards::Shards;
use crate::{Error, Result};
use egogen::agent::{Part, PolicySpec};
use egogen::rng::stream;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

/// Added to the variance of returns, as Tianshou does.
const EPS: f64 = 1e-8;

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
    /// What that penalty counts.
    #[serde(default)]
    pub kl_prior_form: PriorForm,
    /// Largest norm of all gradients together.
    pub max_grad_norm: f32,
    /// Passes over each rollout (Tianshou: `repeat_per_collect`).
    pub passes: usize,
    /// Steps per gradient step.
    pub batch: usize,
    /// Advantages are brought to mean 0 and standard deviation 1 in each minibatch.
    #[serde(default = "on")]
    pub advantage_normalization: bool,
    /// For negative advantages A the policy's gain is at least this times A (Ye et al. 2020); above 1.
    #[serde(default)]
    pub dual_clip: Option<f32>,
    /// The value counts as having moved by at most `clip` since collection wherever that makes its error larger.
    #[serde(default)]
    pub value_clip: bool,
    /// Values, advantages and returns are computed again before each pass but the first.
    #[serde(default)]
    pub recompute_advantage: bool,
    /// Rewards are divided by the running standard deviation of discounted sums of rewards and cut to +-10, before all else.
    #[serde(default)]
    pub reward_scaling: bool,
    /// The critic learns returns divided by their running standard deviation.
    #[serde(default)]
    pub reward_normalization: bool,
    /// The update ends before the gradient step whose minibatch has an `approx_kl` above 1.5 times this.
    #[serde(default)]
    pub target_kl: Option<f32>,
    /// `clip` falls linearly to zero over the run.
    #[serde(default)]
    pub linear_clip: bool,
}

/// What the penalty `kl_prior` counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PriorForm {
    /// The whole divergence, KL(policy || N(0, I)).
    #[default]
    Full,
    /// Its part from the means, mu^2 / 2, as in the authors' code (`weight_kld`).
    Mean,
}

fn on() -> bool {
    true
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
    /// Step size at the end.
    pub learning_rate: f64,
    /// Gradient steps done.
    pub gradient_steps: f64,
}

/// What stays the same for all updates of a run.
#[derive(Clone, Copy, Debug)]
pub struct Rules<'a> {
    /// Environments of a rollout.
    pub envs: usize,
    /// The loss.
    pub ppo: &'a PpoConfig,
    /// The optimiser.
    pub adam: &'a AdamConfig,
    /// Seeds the shuffles, together with the number of the update.
    pub seed: u64,
    /// Updates of the whole run, after which linear schedules reach zero.
    pub updates: u64,
}

/// What learning carries from update to update beside parameters and moments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Updates done.
    pub updates: u64,
    /// Step size that the last one ended with.
    pub learning_rate: Option<f32>,
    /// Returns so far, for `reward_normalization`.
    pub returns: Running,
    /// Every float of the observations so far, for `policy.obs_norm`; empty without.
    pub obs: Vec<Running>,
}

/// What the steps of a rollout are to teach; values and returns on the critic's scale.
pub(crate) struct Targets {
    pub value: Vec<f32>,
    pub advantage: Vec<f32>,
    pub returns: Vec<f32>,
}

impl Targets {
    /// Refuses numbers that are not finite, naming what they are of.
    fn check_finite(&self, update: u64) -> Result<()> {
        let all = [("value", &self.value), ("advantage", &self.advantage), ("return", &self.returns)];
        for (name, values) in all {
            if let Some(v) = values.iter().find(|v| !v.is_finite()) {
                return Err(Error::run(format!("{name} became {v} in update {update}, before it reached the weights")));
            }
        }
        Ok(())
    }
}

/// Everything that learns: parameters, moments, and the policy that acts with the parameters.
pub struct Learner {
    spec: PolicySpec,
    compute: Compute,
    shards: Shards,
    policy: Policy,
    params: Vec<f32>,
    adam: AdamW,
    progress: Progress,
    /// Gradients of the last minibatch.
    grads: Vec<f32>,
}

impl Learner {
    /// A learner that goes on from `params`, the moments `adam` and `progress`.
    pub fn new(spec: PolicySpec, compute: Compute, shards: Shards, params: Vec<f32>, adam: AdamW, progress: Progress) -> Result<Self> {
        let policy = Policy::new(&spec, &params, &compute)?;
        Ok(Self { spec, compute, shards, policy, params, adam, progress, grads: vec![] })
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

    /// What the next update goes on from.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// The policy's sizes.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// One update: advantages, then passes over shuffled minibatches.
    pub fn update(&mut self, rollout: &Rollout, rules: &Rules) -> Result<UpdateStats> {
        let done = (self.progress.updates as f64 / rules.updates.max(1) as f64).min(1.0) as f32;
        let clip = if rules.ppo.linear_clip { rules.ppo.clip * (1.0 - done) } else { rules.ppo.clip };
        let ppo = &PpoConfig { clip, ..*rules.ppo };
        let mut lr = rules.adam.schedule.begin(rules.adam.lr, self.progress.learning_rate, done);
        let mut targets = self.targets(rollout, rollout.value.clone(), &rollout.next_value, rules);
        targets.check_finite(self.progress.updates + 1)?;
        let mut stats = UpdateStats { explained_variance: explained_variance(&targets.returns, &targets.value), ..Default::default() };
        let mut order: Vec<usize> = (0..targets.returns.len()).collect();
        let mut rng = stream(rules.seed, "minibatches", self.progress.updates);
        let (batches, mut steps) = (order.len().div_ceil(ppo.batch) * ppo.passes, 0);
        'passes: for pass in 0..ppo.passes {
            if pass > 0 && ppo.recompute_advantage {
                targets = self.recompute(rollout, rules)?;
                targets.check_finite(self.progress.updates + 1)?;
            }
            order.shuffle(&mut rng);
            for chosen in order.chunks(ppo.batch) {
                let batch = Batch::gather(rollout, &targets, chosen);
                let (losses, ratio_error) = self.gradients(&batch, ppo)?;
                if steps == 0 {
                    stats.first_ratio_error = ratio_error;
                } else if ppo.target_kl.is_some_and(|kl| losses.approx_kl > 1.5 * f64::from(kl)) {
                    break 'passes;
                } else {
                    lr = rules.adam.schedule.adapt(lr, losses.approx_kl);
                }
                stats.losses.add(&losses, 1.0 / batches as f64);
                let (learned, scale) = (self.spec.learned(), clip_scale(losses.grad_norm as f32, ppo.max_grad_norm));
                self.adam.step(&AdamConfig { lr, ..*rules.adam }, &mut self.params[..learned], &self.grads[..learned], scale);
                steps += 1;
            }
        }
        if steps < batches {
            stats.losses = stats.losses.scaled(batches as f64 / f64::from(steps as u32));
        }
        (stats.learning_rate, stats.gradient_steps) = (f64::from(lr), steps as f64);
        self.progress.learning_rate = Some(lr);
        self.progress.updates += 1;
        self.observe(&rollout.obs);
        self.policy = Policy::new(&self.spec, &self.params, &self.compute)?;
        Ok(stats)
    }

    /// Counts observations towards their means and standard deviations, which the policy uses from the next collection on. Scalars
    /// that are encoded by waves stay as they are.
    fn observe(&mut self, obs: &[f32]) {
        let dim = self.spec.layout.dim();
        if self.spec.obs_norm.is_none() || obs.is_empty() {
            return;
        }
        self.progress.obs.resize(dim, Running::default());
        let (mean, std) = self.params[self.spec.obs_norm_range()].split_at_mut(dim);
        for encoder in self.spec.encoders.iter().filter(|e| e.part != Part::Sine) {
            let width = match encoder.part {
                Part::Gru { frames, width, .. } => frames * width,
                _ => encoder.output,
            };
            let columns = encoder.start..encoder.start + width;
            Running::add_columns(&mut self.progress.obs[columns.clone()], &obs[encoder.start..], dim);
            for k in columns {
                let seen = &self.progress.obs[k];
                (mean[k], std[k]) = (seen.mean as f32, (seen.variance + f64::from(f32::EPSILON)).sqrt() as f32);
            }
        }
    }

    /// Advantages and returns from values on the critic's scale; the returns then count towards its scale.
    fn targets(&mut self, rollout: &Rollout, value: Vec<f32>, next_value: &[f32], rules: &Rules) -> Targets {
        let scaled = rules.ppo.reward_normalization;
        let scale = if scaled { (self.progress.returns.variance + EPS).sqrt() as f32 } else { 1.0 };
        let times = |v: &[f32]| -> Vec<f32> { v.iter().map(|x| x * scale).collect() };
        let steps = Steps {
            envs: rules.envs,
            reward: &rollout.reward,
            value: &times(&value),
            next_value: &times(next_value),
            terminated: &rollout.terminated,
            truncated: &rollout.truncated,
        };
        let (advantage, mut returns) = gae(&steps, rules.ppo.gamma, rules.ppo.lambda);
        if scaled {
            self.progress.returns.add(returns.iter().copied());
            returns.iter_mut().for_each(|r| *r /= scale);
        }
        Targets { value, advantage, returns }
    }

    /// [`Learner::targets`] with the values of the current parameters.
    fn recompute(&mut self, rollout: &Rollout, rules: &Rules) -> Result<Targets> {
        let policy = Policy::new(&self.spec, &self.params, &self.compute)?;
        let value = policy.values(&rollout.obs)?;
        let next_value = rollout.next_values(rules.envs, &value, &policy)?;
        Ok(self.targets(rollout, value, &next_value, rules))
    }

    /// Losses of a minibatch, all finite like the gradients that are kept, and the largest |ratio - 1|.
    fn gradients(&mut self, batch: &Batch, ppo: &PpoConfig) -> Result<(Losses, f64)> {
        let computing = (&self.compute, &self.shards);
        let (mut losses, ratio_error) = gradients(&self.spec, &self.params, computing, batch, ppo, &mut self.grads)?;
        losses.grad_norm = f64::from(global_norm(&self.grads));
        match losses.named().iter().find(|(_, v)| !v.is_finite()) {
            Some((name, value)) => Err(Error::run(format!(
                "{name} became {value} in update {}, before it reached the weights. A lower learning rate (adam.lr) or a tighter \
                 ppo.max_grad_norm may help",
                self.progress.updates + 1
            ))),
            None => Ok((losses, ratio_error)),
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

#[cfg(test)]
mod tests;
