//! The loss with burn's automatic gradients.

use super::{Batch, Losses};
use crate::policy::floats;
use crate::ppo::PriorForm;
use crate::{PpoConfig, Result};
use burn::tensor::{Tensor, TensorData};
use egogen::agent::{Network, categorical, entropy, kl_to_prior, log_prob};
use std::ops::Range;

/// One shard's share of the minibatch's loss, with burn's automatic gradients.
pub(super) fn shard(network: &Network, batch: &Batch, rows: Range<usize>, ppo: &PpoConfig) -> Result<(Vec<f32>, Losses, f64)> {
    let net = network.with_gradients();
    let spec = net.spec();
    let (dim, width) = (spec.layout.dim(), spec.action.width());
    let vector = |v: &[f32]| Tensor::<1>::from_data(TensorData::new(v[rows.clone()].to_vec(), [rows.len()]), net.device());
    let actions = &batch.actions[rows.start * width..rows.end * width];
    let out = net.forward(&batch.obs[rows.start * dim..rows.end * dim]);

    let Terms { log_prob, bonus, prior, penalty } = match out.logvar {
        None => choices(out.mu, actions),
        Some(logvar) => gaussian(out.mu, logvar, actions, ppo.kl_prior_form),
    };
    let log_ratio = log_prob - vector(&batch.old_log_prob);
    let ratio = log_ratio.clone().exp();
    let advantage = vector(&batch.advantage);
    let clipped = ratio.clone().clamp(1.0 - ppo.clip, 1.0 + ppo.clip);
    let mut gain = (ratio * advantage.clone()).min_pair(clipped * advantage.clone());
    if let Some(c) = ppo.dual_clip {
        let floored = gain.clone().max_pair(advantage.clone() * c);
        gain = gain.mask_where(advantage.lower_elem(0.0), floored);
    }
    let policy = gain.neg();
    let wanted = vector(&batch.returns);
    let mut value = (wanted.clone() - out.value.clone()).powf_scalar(2.0);
    if ppo.value_clip {
        let old = vector(&batch.old_value);
        let near = old.clone() + (out.value - old).clamp(-ppo.clip, ppo.clip);
        value = value.max_pair((wanted - near).powf_scalar(2.0));
    }
    let loss = policy.clone() + value.clone() * ppo.value - bonus.clone() * ppo.entropy + penalty * ppo.kl_prior;
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

/// Per row: log density of the action, entropy, divergence from the prior as reported and as penalised.
struct Terms {
    log_prob: Tensor<1>,
    bonus: Tensor<1>,
    prior: Tensor<1>,
    penalty: Tensor<1>,
}

fn gaussian(mu: Tensor<2>, logvar: Tensor<2>, actions: &[f32], form: PriorForm) -> Terms {
    let actions = Tensor::from_data(TensorData::new(actions.to_vec(), mu.dims()), &mu.device());
    let mean = |t: Tensor<2>| t.mean_dim(1).squeeze_dim::<1>(1);
    let prior = mean(kl_to_prior(mu.clone(), logvar.clone()));
    let penalty = match form {
        PriorForm::Full => prior.clone(),
        PriorForm::Mean => mean(mu.clone().powf_scalar(2.0) * 0.5),
    };
    Terms { log_prob: log_prob(mu, logvar.clone(), actions), bonus: entropy(logvar), prior, penalty }
}

/// Choices have no prior.
fn choices(logits: Tensor<2>, actions: &[f32]) -> Terms {
    let (log_prob, bonus) = categorical(logits, actions);
    let none = log_prob.zeros_like();
    Terms { log_prob, bonus, prior: none.clone(), penalty: none }
}
