//! Initial weights.

use super::spec::{ActorScale, Dense, Part, PolicySpec};
use crate::rng::{Stream, stream};
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// The smaller start of actor layers, so that the first actions follow the prior N(0, I).
const SMALL: f32 = 0.01;

impl PolicySpec {
    /// Initial parameters: orthogonal with gain sqrt 2 and zero biases, the chosen actor layers x 0.01; GRUs as in torch,
    /// uniform in +-1/sqrt(hidden). Every layer draws from a stream of its own.
    pub fn init(&self, seed: u64) -> Vec<f32> {
        let mut flat = vec![0.0; self.params()];
        let mut recurrent = vec![None; self.layers.len()];
        for encoder in &self.encoders {
            if let Part::Gru { ih, hh, .. } = encoder.part {
                (recurrent[ih], recurrent[hh]) = (Some(encoder.output), Some(encoder.output));
            }
        }
        for (i, layer) in self.layers.iter().enumerate() {
            let mut rng = stream(seed, "policy weights", i as u64);
            let block = &mut flat[layer.offset..layer.offset + layer.params()];
            match recurrent[i] {
                Some(hidden) => block.fill_with(|| rng.random_range(-1.0..1.0) / (hidden as f32).sqrt()),
                None => orthogonal(layer, std::f32::consts::SQRT_2 * self.scale(i), &mut rng, block),
            }
        }
        flat
    }

    fn scale(&self, layer: usize) -> f32 {
        let scaled = match self.config.actor_scale {
            ActorScale::Last => self.actor.last() == Some(&layer),
            ActorScale::Code => self.actor.contains(&layer),
        };
        if scaled { SMALL } else { 1.0 }
    }
}

/// Fills the weight with `gain` times orthonormal rows (or columns, whichever are fewer).
fn orthogonal(layer: &Dense, gain: f32, rng: &mut Stream, out: &mut [f32]) {
    let (few, many) = (layer.output.min(layer.input), layer.output.max(layer.input));
    let basis = orthonormal(few, many, rng);
    for row in 0..layer.output {
        for col in 0..layer.input {
            let entry = if layer.output <= layer.input { basis[row * many + col] } else { basis[col * many + row] };
            out[row * layer.input + col] = gain * entry;
        }
    }
}

/// `count` orthonormal vectors of `dim` floats: normal draws through modified Gram-Schmidt.
fn orthonormal(count: usize, dim: usize, rng: &mut impl Rng) -> Vec<f32> {
    let mut v: Vec<f32> = StandardNormal.sample_iter(rng).take(count * dim).collect();
    for i in 0..count {
        let (head, rest) = v.split_at_mut((i + 1) * dim);
        let unit = &mut head[i * dim..];
        let norm = unit.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt() as f32;
        unit.iter_mut().for_each(|x| *x /= norm);
        let unit = &*unit;
        rest.par_chunks_exact_mut(dim).with_min_len(64).for_each(|other| {
            let dot = dot(unit, other);
            other.iter_mut().zip(unit).for_each(|(o, u)| *o -= dot * u);
        });
    }
    v
}

/// A dot product in 16 partial sums, which the compiler can vectorise.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 16];
    for (a, b) in a.chunks(16).zip(b.chunks(16)) {
        for ((s, x), y) in sums.iter_mut().zip(a).zip(b) {
            *s += x * y;
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_are_orthonormal() {
        let (n, dim) = (40, 70);
        let v = orthonormal(n, dim, &mut stream(1, "test", 0));
        for i in 0..n {
            for j in 0..n {
                let want = if i == j { 1.0 } else { 0.0 };
                assert!((dot(&v[i * dim..(i + 1) * dim], &v[j * dim..(j + 1) * dim]) - want).abs() < 1e-5);
            }
        }
    }
}
