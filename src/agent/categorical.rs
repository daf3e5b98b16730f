//! The softmax distribution from which discrete actions are drawn.

use burn::tensor::activation::log_softmax;
use burn::tensor::{Tensor, TensorData};

/// Log probabilities of all choices: (n, K) logits to (n, K).
pub fn log_softmax_of(logits: &[f32]) -> Vec<f32> {
    let top = logits.iter().fold(f32::NEG_INFINITY, |m, &x| m.max(x));
    let sum = logits.iter().map(|x| (x - top).exp()).sum::<f32>().ln();
    logits.iter().map(|x| x - top - sum).collect()
}

/// Log probabilities of the chosen actions and entropies of whole distributions: (n, K) logits and n choices to (n), (n).
pub fn categorical(logits: Tensor<2>, choices: &[f32]) -> (Tensor<1>, Tensor<1>) {
    let [rows, count] = logits.dims();
    let mut chosen = vec![0.0f32; rows * count];
    chosen.chunks_exact_mut(count).zip(choices).for_each(|(row, &c)| row[c as usize] = 1.0);
    let log_p = log_softmax(logits, 1);
    let chosen = Tensor::<2>::from_data(TensorData::new(chosen, [rows, count]), &log_p.device());
    let sum = |t: Tensor<2>| t.sum_dim(1).squeeze_dim::<1>(1);
    (sum(log_p.clone() * chosen), sum(log_p.clone().exp() * log_p).neg())
}

/// The choice that a uniform draw u from \[0, 1) falls on.
pub fn choice_at(logits: &[f32], u: f32) -> usize {
    let mut left = u;
    let last = logits.len() - 1;
    log_softmax_of(logits)[..last]
        .iter()
        .position(|p| {
            left -= p.exp();
            left < 0.0
        })
        .unwrap_or(last)
}

/// The likeliest choice, the first of equals.
pub fn likeliest(logits: &[f32]) -> usize {
    (1..logits.len()).fold(0, |best, i| if logits[i] > logits[best] { i } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_hand() {
        // Probabilities 1/8, 1/2, 3/8.
        let logits = [0.0f32, 4f32.ln(), 3f32.ln()];
        let p: Vec<f32> = log_softmax_of(&logits).iter().map(|x| x.exp()).collect();
        assert!(p.iter().zip([0.125, 0.5, 0.375]).all(|(p, w)| (p - w).abs() < 1e-6), "{p:?}");
        assert_eq!([0.0, 0.124, 0.126, 0.624, 0.626, 0.999_999].map(|u| choice_at(&logits, u)), [0, 0, 1, 1, 2, 2]);
        assert_eq!((likeliest(&logits), likeliest(&[2.0, 2.0]), likeliest(&[1e4, -1e4])), (1, 0, 0));
        // Large logits do not overflow.
        assert_eq!(log_softmax_of(&[1e4, 0.0])[0], 0.0);
    }
}
