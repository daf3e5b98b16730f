//! The loss and its gradients by hand, on plain slices.

use super::{Batch, Losses};
use crate::PpoConfig;
use crate::backward::{Delta, Head, Stem, weigh};
use crate::ppo::PriorForm;
use egogen::agent::{ActionSpace, PolicySpec, log_prob_of, log_softmax_of, state_logvar};
use rayon::prelude::*;
use std::f64::consts::TAU;
use std::ops::Range;

/// What some people leave in one of the heads.
#[derive(Default)]
struct Part {
    /// rows x W: the gradient of the trunk.
    d: Vec<f32>,
    deltas: Vec<Delta>,
    /// The gradient of what log standard deviations give that are parameters.
    d_free: Vec<f32>,
    losses: Losses,
    /// Largest |ratio - 1|.
    ratio_error: f64,
}

/// The minibatch's loss with gradients by hand, which are written to `grads`. `shards` are ranges of its rows: as many threads are put to use, at
/// most, and sums depend on their number alone.
pub(super) fn learn(
    spec: &PolicySpec,
    params: &[f32],
    batch: &Batch,
    shards: Vec<Range<usize>>,
    ppo: &PpoConfig,
    grads: &mut [f32],
) -> (Losses, f64) {
    let (dim, count, parallel) = (spec.layout.dim(), batch.returns.len(), shards.len() > 1);
    let stems = each(parallel, shards.clone(), |rows| Stem::forward(spec, params, &batch.obs[rows.start * dim..rows.end * dim]));
    let trunk = stems.iter().map(|s| &*s.trunk).collect::<Vec<_>>().concat();
    let width = trunk.len() / count.max(1);
    // A head's layers meet all people at once if there are two threads: reading and packing weights costs much beside their products.
    let blocks = shards.len().div_ceil(2);
    let rows = |k: usize| (k % blocks) * count / blocks..(k % blocks + 1) * count / blocks;
    let heads = each(parallel, (0..2 * blocks).collect(), |k: usize| {
        let rows = rows(k);
        let trunk = trunk[rows.start * width..rows.end * width].to_vec();
        if k < blocks { actor(spec, params, batch, rows, trunk, ppo) } else { critic(spec, params, batch, rows, trunk, ppo) }
    });
    let join = |parts: &[Part]| parts.iter().map(|p| &*p.d).collect::<Vec<_>>().concat();
    let d = [join(&heads[..blocks]), join(&heads[blocks..])];
    let stems = each(parallel, stems.into_iter().zip(shards).collect(), |(stem, rows): (Stem, Range<usize>)| {
        let [actor, critic] = d.each_ref().map(|d| &d[rows.start * width..rows.end * width]);
        stem.backward(actor.iter().zip(critic).map(|(a, c)| a + c).collect())
    });
    let (mut losses, mut ratio_error, mut deltas) = (Losses::default(), 0.0f64, vec![]);
    let log_std = spec.log_std_range();
    grads[log_std.clone()].fill(0.0);
    for part in heads {
        losses.add(&part.losses, 1.0);
        ratio_error = ratio_error.max(part.ratio_error);
        grads[log_std.clone()].iter_mut().zip(part.d_free).for_each(|(g, d)| *g += 2.0 * d);
        deltas.extend(part.deltas);
    }
    deltas.extend(stems.into_iter().flatten());
    weigh(spec, count, &deltas, grads);
    (losses, ratio_error)
}

/// `work` on all `items`, side by side if `parallel`: the way to another thread takes longer than a small network. Results in order.
fn each<T: Send, U: Send>(parallel: bool, items: Vec<T>, work: impl Fn(T) -> U + Sync + Send) -> Vec<U> {
    if parallel { items.into_par_iter().map(work).collect() } else { items.into_iter().map(work).collect() }
}

/// The policy's share of the loss of some rows.
fn actor(spec: &PolicySpec, params: &[f32], batch: &Batch, rows: Range<usize>, trunk: Vec<f32>, ppo: &PpoConfig) -> Part {
    let (width, outputs) = (spec.action.width(), spec.outputs());
    let count = batch.returns.len() as f32;
    let head = Head::forward(spec, params, &spec.actor, trunk);
    let mut d_action = vec![0.0; rows.len() * outputs];
    // Log variances that the network does not give, before the clamp: their gradient in a row, and that of what they come from in all.
    let (noise, log_std) = (spec.noise_variances(params), &params[spec.log_std_range()]);
    let mut free: Vec<f32> = log_std.iter().take(width).map(|s| 2.0 * s).collect();
    let mut d_row = free.clone();
    let mut part = Part { d_free: vec![0.0; log_std.len()], ..Part::default() };
    let said = head.out.chunks_exact(outputs).zip(head.latent().chunks_exact(spec.latent()));
    for ((i, (out, latent)), d) in rows.zip(said).zip(d_action.chunks_exact_mut(outputs)) {
        let action = &batch.actions[i * width..(i + 1) * width];
        let row = Row { action, old_log_prob: batch.old_log_prob[i], advantage: batch.advantage[i], ppo, count };
        let beyond = match spec.action {
            ActionSpace::Discrete(_) => row.choice(out, d, &mut part.losses),
            ActionSpace::Continuous(_) if free.is_empty() => {
                let (out, d) = (out.split_at(width), d.split_at_mut(width));
                row.gaussian(out, spec.config.logvar, d, &mut part.losses)
            }
            ActionSpace::Continuous(_) if !noise.is_empty() => {
                state_logvar(latent, &noise, &mut free);
                let beyond = row.gaussian((out, &free), [f32::NEG_INFINITY, f32::INFINITY], (d, &mut d_row), &mut part.losses);
                for ((h, v), sum) in latent.iter().zip(noise.chunks_exact(width)).zip(part.d_free.chunks_exact_mut(width)) {
                    (0..width).for_each(|k| sum[k] += d_row[k] * h * h * v[k] * (-free[k]).exp());
                }
                beyond
            }
            ActionSpace::Continuous(_) => {
                let beyond = row.gaussian((out, &free), spec.config.logvar, (d, &mut d_row), &mut part.losses);
                part.d_free.iter_mut().zip(&d_row).for_each(|(sum, d)| *sum += d);
                beyond
            }
        };
        part.ratio_error = part.ratio_error.max(beyond.abs());
    }
    part.d = head.backward(spec, params, &spec.actor, d_action, &mut part.deltas);
    part
}

/// The value's share of the loss of some rows.
fn critic(spec: &PolicySpec, params: &[f32], batch: &Batch, rows: Range<usize>, trunk: Vec<f32>, ppo: &PpoConfig) -> Part {
    let count = batch.returns.len() as f32;
    let head = Head::forward(spec, params, &spec.critic, trunk);
    let mut part = Part::default();
    let d_value = rows.zip(&head.out).map(|(i, &value)| {
        let (error, moves) = value_error(value, batch.old_value[i], batch.returns[i], ppo);
        part.losses.value += error * error / f64::from(count);
        if moves { ppo.value * 2.0 * error as f32 / count } else { 0.0 }
    });
    let d_value = d_value.collect();
    part.d = head.backward(spec, params, &spec.critic, d_value, &mut part.deltas);
    part
}

/// The error that counts, and whether it moves with the value. With `value_clip` the value may leave the old one by at most the clip
/// range, and the larger of both errors counts.
fn value_error(value: f32, old: f32, wanted: f32, ppo: &PpoConfig) -> (f64, bool) {
    let error = f64::from(value - wanted);
    let moved = value - old;
    if !ppo.value_clip || moved.abs() <= ppo.clip {
        return (error, true);
    }
    let clipped = f64::from(old + moved.clamp(-ppo.clip, ppo.clip) - wanted);
    if clipped.abs() > error.abs() { (clipped, false) } else { (error, true) }
}

/// One person's action within a minibatch of `count`.
struct Row<'a> {
    action: &'a [f32],
    old_log_prob: f32,
    /// Normalised.
    advantage: f32,
    ppo: &'a PpoConfig,
    count: f32,
}

impl Row<'_> {
    /// Adds the clipped surrogate's terms to `losses`. Returns its gradient with respect to the log density, and ratio - 1.
    fn surrogate(&self, log_prob: f32, losses: &mut Losses) -> (f32, f64) {
        let log_ratio = f64::from(log_prob - self.old_log_prob);
        let (ratio, beyond) = (log_ratio.exp(), log_ratio.exp_m1());
        let (clip, advantage, share) = (f64::from(self.ppo.clip), f64::from(self.advantage), 1.0 / f64::from(self.count));
        let (plain, clipped) = (ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
        let pessimist = plain.min(clipped);
        let floor = self.ppo.dual_clip.filter(|_| advantage < 0.0).map_or(f64::NEG_INFINITY, |c| f64::from(c) * advantage);
        losses.policy -= pessimist.max(floor) * share;
        losses.approx_kl += (beyond - log_ratio) * share;
        losses.clip_fraction += if beyond.abs() > clip { share } else { 0.0 };
        // Where the clipped term is the smaller one, or both are below the floor, the ratio's gradient is zero.
        let moves = plain <= clipped && pessimist >= floor;
        (if moves { -(plain * share) as f32 } else { 0.0 }, beyond)
    }

    /// Adds a Gaussian's terms to `losses` and writes the gradients of mean and log variance before its clamp. Returns ratio - 1.
    fn gaussian(&self, (mu, raw): (&[f32], &[f32]), [low, high]: [f32; 2], d: (&mut [f32], &mut [f32]), losses: &mut Losses) -> f64 {
        let (width, ppo, count) = (self.action.len(), self.ppo, self.count);
        let logvar: Vec<f32> = raw.iter().map(|v| v.clamp(low, high)).collect();
        let (d_log_prob, beyond) = self.surrogate(log_prob_of(mu, &logvar, self.action), losses);
        let prior = ppo.kl_prior / width as f32 / count;
        let spread = if ppo.kl_prior_form == PriorForm::Full { prior } else { 0.0 };
        let (d_mu, d_logvar) = d;
        let (mut bits, mut kl) = (0.0f64, 0.0f64);
        for k in 0..width {
            let (off, precision, variance) = (self.action[k] - mu[k], (-logvar[k]).exp(), logvar[k].exp());
            d_mu[k] = d_log_prob * off * precision + prior * mu[k];
            let free = (low..=high).contains(&raw[k]);
            let along = d_log_prob * 0.5 * (off * off * precision - 1.0) - 0.5 * ppo.entropy / count + 0.5 * spread * (variance - 1.0);
            d_logvar[k] = if free { along } else { 0.0 };
            bits += 0.5 * (f64::from(logvar[k]) + 1.0 + TAU.ln());
            kl += 0.5 * f64::from(mu[k] * mu[k] + variance - logvar[k] - 1.0);
        }
        let share = 1.0 / f64::from(count);
        losses.entropy += bits * share;
        losses.kl_prior += kl / width as f64 * share;
        beyond
    }

    /// [`Row::gaussian`] for the softmax of `logits`, which has no prior: d log p_c / d logit_k = [k = c] - p_k, and
    /// dH / d logit_k = -p_k (log p_k + H).
    fn choice(&self, logits: &[f32], d: &mut [f32], losses: &mut Losses) -> f64 {
        let log_p = log_softmax_of(logits);
        let chosen = self.action[0] as usize;
        let (d_log_prob, beyond) = self.surrogate(log_p[chosen], losses);
        let entropy = -log_p.iter().map(|l| l.exp() * l).sum::<f32>();
        for (k, (d, l)) in d.iter_mut().zip(&log_p).enumerate() {
            let p = l.exp();
            *d = d_log_prob * (f32::from(k == chosen) - p) + self.ppo.entropy / self.count * p * (l + entropy);
        }
        losses.entropy += f64::from(entropy) / f64::from(self.count);
        beyond
    }
}
