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

/// Added to variances that depend on the state, as Stable-Baselines3 does.
pub const NOISE_EPS: f32 = 1e-6;

/// Log variances of actions whose noise is h E: ln(sum_j h_j^2 v_jk + 1e-6), with `variances` v (L, A) of the entries of E and the
/// activations `latent` h (L).
pub fn state_logvar(latent: &[f32], variances: &[f32], out: &mut [f32]) {
    out.fill(NOISE_EPS);
    for (h, row) in latent.iter().zip(variances.chunks_exact(out.len())) {
        out.iter_mut().zip(row).for_each(|(o, v)| *o += h * h * v);
    }
    out.iter_mut().for_each(|o| *o = o.ln());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::{categorical, log_softmax_of};
    use crate::io::Tensors;
    use crate::metrics::kl_to_standard;
    use burn::tensor::{Device, TensorData};

    /// Both distributions, on plain slices and in burn, against torch.distributions.
    #[test]
    fn agree_with_torch() {
        let t = Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/ppo.safetensors")).unwrap();
        let get = |name: &str, shape: &[usize]| t.f32s(&format!("dist.{name}"), shape).unwrap();
        let close = |have: &[f32], name: &str| {
            let want = get(name, &[7]);
            assert!(have.iter().zip(&want).all(|(h, w)| (h - w).abs() < 1e-5 * w.abs().max(1.0)), "{name}: {have:?}, torch {want:?}");
        };
        let (mu, logvar, action, choice) = (get("mu", &[7, 5]), get("logvar", &[7, 5]), get("action", &[7, 5]), get("choice", &[7]));
        let rows = || mu.chunks_exact(5).zip(logvar.chunks_exact(5));
        close(&rows().zip(action.chunks_exact(5)).map(|((m, v), a)| log_prob_of(m, v, a)).collect::<Vec<_>>(), "log_prob");
        close(&rows().map(|(m, v)| kl_to_standard(m, v)).collect::<Vec<_>>(), "kl");
        let choices = mu.chunks_exact(5).zip(&choice).map(|(logits, &c)| log_softmax_of(logits)[c as usize]);
        close(&choices.collect::<Vec<_>>(), "choice_log_prob");

        let tensor = |v: &[f32]| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [7, 5]), &Device::flex());
        let floats = |t: Tensor<1>| t.into_data().try_to_vec::<f32>().unwrap();
        close(&floats(log_prob(tensor(&mu), tensor(&logvar), tensor(&action))), "log_prob");
        close(&floats(entropy(tensor(&logvar))), "entropy");
        close(&floats(kl_to_prior(tensor(&mu), tensor(&logvar)).sum_dim(1).squeeze_dim::<1>(1)), "kl");
        let (log_p, bits) = categorical(tensor(&mu), &choice);
        close(&floats(log_p), "choice_log_prob");
        close(&floats(bits), "choice_entropy");
    }
}
