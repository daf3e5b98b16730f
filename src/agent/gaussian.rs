//! The diagonal Gaussian from which actions are drawn. Standard deviation = exp(logvar / 2).

use burn::tensor::Tensor;
use std::f32::consts::{PI, TAU};

/// Log density of `action` under N(mu, exp(logvar)), summed over dimensions: (n, A) each to (n).
pub fn log_prob(mu: Tensor<2>, logvar: Tensor<2>, action: Tensor<2>) -> Tensor<1> {
    let [_, dims] = mu.dims();
    let square = (action - mu).powf_scalar(2.0) * (-logvar.clone()).exp();
    (square + logvar).sum_dim(1).squeeze_dim::<1>(1) * -0.5 - 0.5 * dims as f32 * TAU.ln()
}

/// [`log_prob`] of one action on plain slices.
pub fn log_prob_of(mu: &[f32], logvar: &[f32], action: &[f32]) -> f32 {
    let terms = mu.iter().zip(logvar).zip(action).map(|((m, v), a)| (a - m).powi(2) * (-v).exp() + v + TAU.ln());
    -0.5 * terms.sum::<f32>()
}

/// Entropy of the whole action, summed over dimensions: (n, A) to (n).
pub fn entropy(logvar: Tensor<2>) -> Tensor<1> {
    let [_, dims] = logvar.dims();
    logvar.sum_dim(1).squeeze_dim::<1>(1) * 0.5 + 0.5 * dims as f32 * (1.0 + (2.0 * PI).ln())
}

/// KL(N(mu, exp(logvar)) || N(0, 1)) of every dimension: (n, A).
pub fn kl_to_prior(mu: Tensor<2>, logvar: Tensor<2>) -> Tensor<2> {
    (mu.powf_scalar(2.0) + logvar.clone().exp() - logvar - 1.0) * 0.5
}
