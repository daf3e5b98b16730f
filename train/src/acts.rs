//! What a policy says of some observations, and the actions drawn from it.

use egogen::agent::{choice_at, likeliest, log_prob_of, log_softmax_of};
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
}

impl Acts {
    /// Floats of each row of `mu`.
    fn width(&self) -> usize {
        (self.mu.len() / self.value.len().max(1)).max(1)
    }

    fn discrete(&self) -> bool {
        self.logvar.is_empty()
    }

    /// Drawn actions: mean + sigma x noise, or a choice; the draws of row i come from stream (seed, purpose, step x rows + i).
    pub fn sample(&self, seed: u64, purpose: &str, step: u64) -> Vec<f32> {
        let (rows, width) = (self.value.len(), self.width());
        let stream_of = |i: usize| stream(seed, purpose, step * rows as u64 + i as u64);
        if self.discrete() {
            let draw = |(i, logits): (usize, &[f32])| choice_at(logits, stream_of(i).random_range(0.0..1.0)) as f32;
            return self.mu.chunks_exact(width).enumerate().map(draw).collect();
        }
        let mut out = self.mu.clone();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_come_as_often_as_they_should() {
        let rows = 20_000;
        let p = [0.125f32, 0.5, 0.375];
        let acts = Acts { mu: p.map(f32::ln).repeat(rows), logvar: vec![], value: vec![0.0; rows] };
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
}
