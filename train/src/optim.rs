//! Global gradient-norm clipping and AdamW over flat memory.

use crate::schedule::Schedule;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Floats per piece of work. Fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 1 << 15;

/// Settings of AdamW; the defaults are torch's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamConfig {
    /// Step size.
    pub lr: f32,
    /// Decay of the first and second moment.
    #[serde(default = "betas")]
    pub betas: [f32; 2],
    /// Added to the root of the second moment.
    #[serde(default = "eps")]
    pub eps: f32,
    /// Decoupled weight decay.
    #[serde(default = "weight_decay")]
    pub weight_decay: f32,
    /// How the step size changes over the run.
    #[serde(default)]
    pub schedule: Schedule,
}

fn betas() -> [f32; 2] {
    [0.9, 0.999]
}

fn eps() -> f32 {
    1e-8
}

fn weight_decay() -> f32 {
    1e-2
}

/// AdamW's moments (Loshchilov & Hutter 2019).
#[derive(Clone, Debug, PartialEq)]
pub struct AdamW {
    /// Steps done.
    pub steps: u64,
    /// First moment.
    pub first: Vec<f32>,
    /// Second moment.
    pub second: Vec<f32>,
}

impl AdamW {
    /// Moments of `params` parameters, at zero.
    pub fn new(params: usize) -> Self {
        Self { steps: 0, first: vec![0.0; params], second: vec![0.0; params] }
    }

    /// One step on `params` with `grads` times `scale`.
    pub fn step(&mut self, config: &AdamConfig, params: &mut [f32], grads: &[f32], scale: f32) {
        self.steps += 1;
        let [b1, b2] = config.betas;
        let power = |b: f32| 1.0 - f64::from(b).powf(self.steps as f64);
        let rate = (f64::from(config.lr) / power(b1)) as f32;
        let root = power(b2).sqrt() as f32;
        let keep = 1.0 - config.lr * config.weight_decay;
        let work = params.par_chunks_mut(CHUNK).zip(grads.par_chunks(CHUNK));
        let moments = self.first.par_chunks_mut(CHUNK).zip(self.second.par_chunks_mut(CHUNK));
        work.zip(moments).for_each(|((p, g), (m, v))| {
            for (((p, g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
                let g = g * scale;
                *m = b1 * *m + (1.0 - b1) * g;
                *v = b2 * *v + (1.0 - b2) * g * g;
                *p = *p * keep - rate * *m / (v.sqrt() / root + config.eps);
            }
        });
    }
}

/// Euclidean norm of all gradients together.
pub fn global_norm(grads: &[f32]) -> f32 {
    // Several sums side by side: one alone would wait for each addition.
    let square = |chunk: &[f32]| {
        let mut sums = [0.0f64; 16];
        for part in chunk.chunks(sums.len()) {
            sums.iter_mut().zip(part).for_each(|(s, &g)| *s += f64::from(g) * f64::from(g));
        }
        sums.iter().sum::<f64>()
    };
    let parts: Vec<f64> = grads.par_chunks(CHUNK).map(square).collect();
    parts.iter().sum::<f64>().sqrt() as f32
}

/// The factor that brings gradients of norm `norm` down to at most `max` (torch's `clip_grad_norm_`).
pub fn clip_scale(norm: f32, max: f32) -> f32 {
    (max / (norm + 1e-6)).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_torch() {
        let t = crate::fixture();
        let config = AdamConfig { lr: 1e-2, betas: betas(), eps: eps(), weight_decay: weight_decay(), schedule: Schedule::Constant };
        let mut params = t.f32s("adam.start", &[11]).unwrap();
        let mut adam = AdamW::new(11);
        let (grads, path) = (t.f32s("adam.grads", &[5, 11]).unwrap(), t.f32s("adam.path", &[5, 11]).unwrap());
        let norms = t.f32s("adam.norms", &[5]).unwrap();
        assert!(norms[0] < 0.5 && norms[1] > 0.5, "both sides of the clip are wanted");
        for (step, grads) in grads.chunks(11).enumerate() {
            let norm = global_norm(grads);
            assert!((norm - norms[step]).abs() < 1e-5 * norm);
            adam.step(&config, &mut params, grads, clip_scale(norm, 0.5));
            for (p, want) in params.iter().zip(&path[step * 11..]) {
                assert!((p - want).abs() < 2e-6, "step {step}: {p} against {want}");
            }
        }
    }

    #[test]
    fn one_norm_over_everything() {
        // |(3, 4, 12)| = 13, scaled down to 1.
        let norm = global_norm(&[3.0, 4.0, 12.0]);
        assert_eq!(norm, 13.0);
        assert!((13.0 * clip_scale(norm, 1.0) - 1.0).abs() < 1e-6);
        assert_eq!(clip_scale(0.5, 1.0), 1.0);
    }
}
