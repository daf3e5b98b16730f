//! The loss and its gradients by hand, on plain slices.

use super::{Batch, Losses};
use crate::PpoConfig;
use crate::backward::Tape;
use crate::ppo::PriorForm;
use egogen::agent::{PolicySpec, log_prob_of};
use std::f64::consts::TAU;
use std::ops::Range;

/// One shard's share of the minibatch's loss, with gradients by hand.
pub(super) fn shard(spec: &PolicySpec, params: &[f32], batch: &Batch, rows: Range<usize>, ppo: &PpoConfig) -> (Vec<f32>, Losses, f64) {
    let (dim, width, count) = (spec.layout.dim(), spec.action, batch.returns.len() as f32);
    let tape = Tape::forward(spec, params, &batch.obs[rows.start * dim..rows.end * dim]);
    let mut d_action = vec![0.0; rows.len() * 2 * width];
    let mut d_value = Vec::with_capacity(rows.len());
    let (mut losses, mut ratio_error) = (Losses::default(), 0.0f64);
    let outputs = tape.action().chunks_exact(2 * width).zip(tape.value());
    for ((i, (out, &value)), d) in rows.zip(outputs).zip(d_action.chunks_exact_mut(2 * width)) {
        let action = &batch.actions[i * width..(i + 1) * width];
        let row = Row { out, action, old_log_prob: batch.old_log_prob[i], advantage: batch.advantage[i], clamp: spec.config.logvar };
        let (error, moves) = value_error(value, batch.old_value[i], batch.returns[i], ppo);
        losses.value += error * error / f64::from(count);
        d_value.push(if moves { ppo.value * 2.0 * error as f32 / count } else { 0.0 });
        let beyond = row.gradient(ppo, count, d, &mut losses);
        ratio_error = ratio_error.max(beyond.abs());
    }
    (tape.backward(d_action, d_value), losses, ratio_error)
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
        let pessimist = plain.min(clipped);
        let floor = ppo.dual_clip.filter(|_| advantage < 0.0).map_or(f64::NEG_INFINITY, |c| f64::from(c) * advantage);
        losses.policy -= pessimist.max(floor) * share;
        losses.approx_kl += (beyond - log_ratio) * share;
        losses.clip_fraction += if beyond.abs() > clip { share } else { 0.0 };
        // Where the clipped term is the smaller one, or both are below the floor, the ratio's gradient is zero.
        let d_log_prob = if plain <= clipped && pessimist >= floor { -(plain * share) as f32 } else { 0.0 };
        let prior = ppo.kl_prior / width as f32 / count;
        let spread = if ppo.kl_prior_form == PriorForm::Full { prior } else { 0.0 };
        let (d_mu, d_logvar) = d.split_at_mut(width);
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
        losses.entropy += bits * share;
        losses.kl_prior += kl / width as f64 * share;
        beyond
    }
}
