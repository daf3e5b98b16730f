//! Initial weights.

use super::{ActorScale, Dense, Init, Part, PolicySpec};
use crate::rng::{Stream, stream};
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// The smaller start of actor layers, so that the first actions follow the prior N(0, I).
const SMALL: f32 = 0.01;

impl PolicySpec {
    /// Initial parameters: orthogonal with gain sqrt 2 and zero biases, the chosen actor layers x 0.01; GRUs as in torch,
    /// uniform in +-1/sqrt(hidden), as are, with [`Init::Uniform`], all layers in +-1/sqrt(inputs). Every layer draws from a stream of
    /// its own.
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
            match (recurrent[i], self.config.init) {
                (Some(hidden), _) => uniform(hidden, &mut rng, block),
                (None, Init::Uniform) => uniform(layer.input, &mut rng, block),
                (None, Init::Orthogonal) => orthogonal(layer, std::f32::consts::SQRT_2 * self.scale(i), &mut rng, block),
            }
        }
        let log_std = self.config.state_noise.map(|noise| noise.log_std).or(self.config.log_std);
        flat[self.log_std_range()].fill(log_std.unwrap_or(0.0));
        let std = self.obs_norm_range().skip(self.layout.dim());
        std.for_each(|i| flat[i] = 1.0);
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

/// Fills `out` with draws from +-1/sqrt(width).
fn uniform(width: usize, rng: &mut Stream, out: &mut [f32]) {
    out.fill_with(|| rng.random_range(-1.0..1.0) / (width as f32).sqrt());
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

    use crate::agent::{ObsGroup, ObsLayout};
    use crate::io::Tensors;

    /// Moments of many draws against those of torch's `orthogonal_`, within a few of their own standard errors.
    #[test]
    fn weights_are_spread_as_torchs() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/ppo.safetensors");
        let want = Tensors::read(path).unwrap().f32s("orthogonal.moments", &[4]).unwrap();
        let layer = Dense { weight: String::new(), bias: String::new(), input: 9, output: 6, offset: 0 };
        let (mut sums, draws, mut w) = ([0.0f64; 4], 4000, vec![0.0; 54]);
        for seed in 0..draws {
            orthogonal(&layer, std::f32::consts::SQRT_2, &mut stream(seed, "test", 0), &mut w);
            for (i, x) in w.iter().map(|&x| f64::from(x)).enumerate() {
                let diagonal = if i % 10 == 0 { 9.0 * x } else { 0.0 };
                [x, x * x, x.powi(4), diagonal].iter().zip(&mut sums).for_each(|(x, s)| *s += x / (54 * draws) as f64);
            }
        }
        for ((have, want), near) in sums.iter().zip(want).zip([0.005, 1e-4, 0.003, 0.015]) {
            assert!((have - f64::from(want)).abs() < near, "{sums:?}");
        }
    }

    #[test]
    fn layers_start_orthogonal() {
        let layout = ObsLayout::new(vec![ObsGroup { name: "state".into(), shape: vec![5] }]);
        let config = serde_json::json!({"hidden": [12, 7], "log_std": -0.5});
        let spec = PolicySpec::new(serde_json::from_value(config).unwrap(), layout, 3).unwrap();
        let flat = spec.init(3);
        for (i, layer) in spec.layers.iter().enumerate() {
            let (w, rows) = (layer.weight_of(&flat), layer.output);
            let gain = if spec.actor.last() == Some(&i) { 2e-4 } else { 2.0 };
            let at = |r: usize, c: usize| if rows <= layer.input { w[r * layer.input + c] } else { w[c * layer.input + r] };
            let (few, many) = (rows.min(layer.input), rows.max(layer.input));
            for (r, s) in (0..few).flat_map(|r| (0..few).map(move |s| (r, s))) {
                let dot: f32 = (0..many).map(|c| at(r, c) * at(s, c)).sum();
                assert!((dot / gain - f32::from(r == s)).abs() < 1e-5, "{}: rows {r} and {s}", layer.weight);
            }
            assert!(layer.bias_of(&flat).iter().all(|&b| b == 0.0));
        }
        assert_eq!(flat[spec.log_std_range()], [-0.5; 3]);
    }

    #[test]
    fn layers_start_as_torchs_when_told_to() {
        let layout = ObsLayout::new(vec![ObsGroup { name: "state".into(), shape: vec![5] }]);
        let config = serde_json::json!({"hidden": [400], "log_std": -0.5, "init": "uniform"});
        let spec = PolicySpec::new(serde_json::from_value(config).unwrap(), layout, 300).unwrap();
        let flat = spec.init(3);
        for layer in &spec.layers {
            // The whole block, biases too: mean 0, and the standard deviation and range of a uniform distribution.
            let block = &flat[layer.offset..layer.offset + layer.params()];
            let bound = 1.0 / (layer.input as f32).sqrt();
            let n = block.len() as f32;
            let std = (block.iter().map(|x| x * x).sum::<f32>() / n).sqrt();
            assert!((std - bound / 3f32.sqrt()).abs() < 0.6 * bound / n.sqrt(), "{}: {std}", layer.weight);
            assert!(block.iter().all(|x| x.abs() <= bound) && block.iter().any(|x| x.abs() > 0.97 * bound), "{}", layer.weight);
        }
    }

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
