//! What a policy says of some observations, and the actions drawn from it.

use egogen::agent::{choice_at, likeliest, log_prob_of, log_softmax_of};
use egogen::metrics::{kl_mean_only, kl_to_standard};
use egogen::rng::stream;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Distributions of n actions, and values (n).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Acts {
    /// n x A means, or n x K logits of discrete actions.
    pub mu: Vec<f32>,
    /// n x A log variances; empty for discrete actions.
    pub logvar: Vec<f32>,
    pub value: Vec<f32>,
    /// What noise that depends on the state is made of, where there is such.
    pub held: Option<Held>,
}

/// Noise h E whose E each row keeps for some steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Held {
    /// n x L activations h.
    pub latent: Vec<f32>,
    /// L x A standard deviations of the entries of E.
    pub deviations: Vec<f32>,
    /// Steps for which E stays.
    pub steps: u64,
}

impl Acts {
    /// Floats of each row of `mu`.
    fn width(&self) -> usize {
        (self.mu.len() / self.value.len().max(1)).max(1)
    }

    fn discrete(&self) -> bool {
        self.logvar.is_empty()
    }

    /// Of each row its divergences from N(0, I): the mean per-dimension KL, nats, and the authors' 0.5 mean(mu^2). None of discrete actions.
    pub fn divergences(&self) -> Vec<[f32; 2]> {
        let width = self.width();
        let rows = self.mu.chunks_exact(width).zip(self.logvar.chunks_exact(width));
        rows.map(|(mu, logvar)| [kl_to_standard(mu, logvar) / width as f32, kl_mean_only(mu)]).collect()
    }

    /// Drawn actions: mean + sigma x noise, or a choice; the draws of row i come from stream (seed, purpose, step x rows + i), with
    /// the number of draws of E in place of the step where noise is held.
    pub fn sample(&self, seed: u64, purpose: &str, step: u64) -> Vec<f32> {
        let (rows, width) = (self.value.len(), self.width());
        let stream_of = |i: usize| stream(seed, purpose, step * rows as u64 + i as u64);
        if self.discrete() {
            let draw = |(i, logits): (usize, &[f32])| choice_at(logits, stream_of(i).random_range(0.0..1.0)) as f32;
            return self.mu.chunks_exact(width).enumerate().map(draw).collect();
        }
        let mut out = self.mu.clone();
        if let Some(Held { latent, deviations, steps }) = &self.held {
            let stream_of = |i: usize| stream(seed, purpose, step / steps * rows as u64 + i as u64);
            let latent = latent.par_chunks_exact(latent.len() / rows);
            out.par_chunks_exact_mut(width).zip(latent).enumerate().for_each(|(i, (row, latent))| {
                let mut noise = StandardNormal.sample_iter(stream_of(i));
                for (h, deviations) in latent.iter().zip(deviations.chunks_exact(width)) {
                    row.iter_mut().zip(deviations).zip(&mut noise).for_each(|((a, s), e): (_, f32)| *a += h * s * e);
                }
            });
            return out;
        }
        out.par_chunks_exact_mut(width).zip(self.logvar.par_chunks_exact(width)).enumerate().for_each(|(i, (row, logvar))| {
            let noise = StandardNormal.sample_iter(stream_of(i));
            row.iter_mut().zip(logvar).zip(noise).for_each(|((a, v), e): (_, f32)| *a += (0.5 * v).exp() * e);
        });
        out
    }

    /// The actions without noise: means, or the likeliest choices.
    pub fn best(&self) -> Vec<f32> {
        match self.discrete() {
            true => self.mu.chunks_exact(self.width()).map(|logits| likeliest(logits) as f32).collect(),
            false => self.mu.clone(),
        }
    }

    /// Log density, or log probability, of one action in each row.
    pub fn log_prob(&self, actions: &[f32]) -> Vec<f32> {
        let width = self.width();
        let rows = self.mu.chunks_exact(width);
        match self.discrete() {
            true => rows.zip(actions).map(|(logits, &a)| log_softmax_of(logits)[a as usize]).collect(),
            false => {
                let rows = rows.zip(self.logvar.chunks_exact(width)).zip(actions.chunks_exact(width));
                rows.map(|((m, v), a)| log_prob_of(m, v, a)).collect()
            }
        }
    }
}

/// Rows of standard normal noise, n x `width`; row i comes from stream (seed, purpose, step x n + i).
pub fn normal_rows(n: usize, width: usize, seed: u64, purpose: &str, step: u64) -> Vec<f32> {
    let row = |i: usize| StandardNormal.sample_iter(stream(seed, purpose, step * n as u64 + i as u64)).take(width);
    (0..n).flat_map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_come_as_often_as_they_should() {
        let rows = 20_000;
        let p = [0.125f32, 0.5, 0.375];
        let acts = Acts { mu: p.map(f32::ln).repeat(rows), logvar: vec![], value: vec![0.0; rows], held: None };
        let drawn = acts.sample(1, "test", 0);
        for (choice, p) in p.into_iter().enumerate() {
            let share = drawn.iter().filter(|&&a| a == choice as f32).count() as f32 / rows as f32;
            // Four standard deviations.
            assert!((share - p).abs() < 4.0 * (p * (1.0 - p) / rows as f32).sqrt(), "{choice}: {share}");
        }
        assert!(acts.best().iter().all(|&a| a == 1.0));
        assert!((acts.log_prob(&drawn)[0] - p[drawn[0] as usize].ln()).abs() < 1e-6);
        assert_ne!(drawn, acts.sample(1, "test", 1));
    }

    /// h = (1, 2), deviations 0.5 and 0.25: the noise has variance 0.25 + 4/16, and stays as long as E and h do.
    #[test]
    fn held_noise_by_hand() {
        let rows = 20_000;
        let held = Held { latent: [1.0, 2.0].repeat(rows), deviations: vec![0.5, 0.25], steps: 3 };
        let mut acts = Acts { mu: vec![0.1; rows], logvar: vec![0.5f32.ln(); rows], value: vec![0.0; rows], held: Some(held) };
        let [first, same, other] = [3, 5, 6].map(|step| acts.sample(1, "test", step));
        assert_eq!(first, same);
        assert_ne!(first, other);
        let variance = first.iter().map(|a| (a - 0.1).powi(2)).sum::<f32>() / rows as f32;
        // Four standard deviations of a variance's estimate.
        assert!((variance - 0.5).abs() < 4.0 * 0.5 * (2.0 / rows as f32).sqrt(), "{variance}");
        acts.held.as_mut().unwrap().latent = [2.0, 4.0].repeat(rows);
        let twice = acts.sample(1, "test", 4);
        assert!(first.iter().zip(&twice).all(|(a, b)| (2.0 * (a - 0.1) - (b - 0.1)).abs() < 1e-5), "the noise follows the state");
    }
}
