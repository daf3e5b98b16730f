//! Distance of a latent distribution from the prior N(0, I).

/// KL divergence of a diagonal Gaussian from N(0, I) in nats: 0.5 sum (mu^2 + exp(logvar) - 1 - logvar).
pub fn kl_to_standard(mu: &[f32], logvar: &[f32]) -> f32 {
    assert_eq!(mu.len(), logvar.len(), "one log-variance per mean");
    0.5 * mu.iter().zip(logvar).map(|(m, l)| m * m + l.exp() - 1.0 - l).sum::<f32>()
}

/// The authors' selection figure 0.5 mean(mu^2): the mean's part of the divergence, per dimension.
pub fn kl_mean_only(mu: &[f32]) -> f32 {
    0.5 * mu.iter().map(|m| m * m).sum::<f32>() / mu.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_hand() {
        assert_eq!(kl_to_standard(&[0.0; 4], &[0.0; 4]), 0.0);
        // mu 1, 2; variances 1 and 4: 0.5 (1 + (4 + 4 - 1 - ln 4)).
        let want = 0.5 * (1.0 + 7.0 - 4f32.ln());
        assert!((kl_to_standard(&[1.0, 2.0], &[0.0, 4f32.ln()]) - want).abs() < 1e-6);
        assert_eq!(kl_mean_only(&[1.0, -2.0]), 1.25);
    }
}
