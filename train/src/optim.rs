//! Global gradient-norm clipping and AdamW over flat memory.

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
    let square = |chunk: &[f32]| chunk.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>();
    let parts: Vec<f64> = grads.par_chunks(CHUNK).map(square).collect();
    parts.iter().sum::<f64>().sqrt() as f32
}

/// The factor that brings gradients of norm `norm` down to at most `max` (torch's `clip_grad_norm_`).
pub fn clip_scale(norm: f32, max: f32) -> f32 {
    (max / (norm + 1e-6)).min(1.0)
}
