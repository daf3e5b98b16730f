//! The predictor's loss and its gradient.

use super::predictor::{Batch, Ready, Tape};
use egogen::body::FOOT_MARKERS;
use egogen::metrics::kl_to_standard;
use egogen::motion::PredictorWeights;
use serde::{Deserialize, Serialize};

/// Weights of the predictor's loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LossWeights {
    /// Mean absolute error of the frame differences, the step from the seed included (A2: 3).
    pub velocity: f32,
    /// Divergence from the prior (A2: 1; that keeps 3 useful dimensions of 128, this 70 to 110).
    pub kl: f32,
    /// Use sqrt(1 + KL^2) - 1 (A2) instead of KL.
    pub robust: bool,
    /// Mean absolute velocity of predicted foot markers while the true one stands still; ours, against sliding.
    pub skate: f32,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self { velocity: 3.0, kl: 0.03, robust: true, skate: 2.0 }
    }
}

/// Means over a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossParts {
    pub reconstruction: f32,
    pub velocity: f32,
    /// Mean per latent dimension, nats.
    pub kl: f32,
    pub skate: f32,
}

/// True speed, metres per frame, below which a foot marker stands: 0.15 m/s.
const STANCE: f32 = 0.15 / egogen::motion::FPS;

impl LossParts {
    pub fn total(&self, w: &LossWeights) -> f32 {
        self.reconstruction + w.velocity * self.velocity + w.kl * kl_term(self.kl, w.robust).0 + w.skate * self.skate
    }
}

/// The KL term and its derivative with respect to the mean KL.
fn kl_term(kl: f32, robust: bool) -> (f32, f32) {
    if !robust {
        return (kl, 1.0);
    }
    let root = (1.0 + kl * kl).sqrt();
    (root - 1.0, kl / root)
}

/// Loss of a whole batch, run as one: forward, then (if `grad`) backward with gradients added to it.
pub fn step(w: &Ready, grad: &mut PredictorWeights, tape: &mut Tape, batch: &Batch, weights: &LossWeights, share: f32) -> LossParts {
    forward(w, tape, batch);
    let mut d_frames = Vec::new();
    let mut parts = frame_loss(&tape.frames, batch, weights, share, &mut d_frames);
    parts.kl = kl_to_standard(&tape.mu, &tape.logvar) / tape.mu.len() as f32;
    // The robust form couples all people of a batch; taking each shard's own mean keeps shards independent.
    let slope = share * weights.kl * kl_term(parts.kl, weights.robust).1 / tape.mu.len() as f32;
    let mut d_mu: Vec<f32> = tape.mu.iter().map(|m| slope * m).collect();
    let mut d_logvar: Vec<f32> = tape.logvar.iter().map(|v| 0.5 * slope * (v.exp() - 1.0)).collect();
    tape.backward(w, grad, batch, &mut d_frames, &mut d_mu, &mut d_logvar);
    parts
}

/// Encodes, draws the latent mu + exp(logvar / 2) eps, decodes.
pub fn forward(w: &Ready, tape: &mut Tape, batch: &Batch) {
    tape.encode(w, &batch.seed, batch.future(), batch.rows);
    let z: Vec<f32> = tape.mu.iter().zip(&tape.logvar).zip(&batch.eps).map(|((m, v), e)| m + (0.5 * v).exp() * e).collect();
    let frame = batch.seed.len() / (2 * batch.rows);
    tape.decode(w, &batch.seed, &z, batch.rows, batch.target.len() / (batch.rows * frame) - 1);
}

/// The terms on the predicted frames; `d` becomes their gradient (steps x rows x frame), scaled by `share`.
fn frame_loss(frames: &[f32], batch: &Batch, weights: &LossWeights, share: f32, d: &mut Vec<f32>) -> LossParts {
    let row = batch.seed.len() / 2;
    let n = batch.target.len() - row;
    let width = row / batch.rows;
    d.clear();
    d.resize(n, 0.0);
    let inverse = 1.0 / n as f32;
    let (rec, vel) = (share * inverse, share * weights.velocity * inverse);
    let (mut reconstruction, mut velocity) = (0.0f64, 0.0f64);
    for i in 0..n {
        let (e1, e0) = (frames[row + i] - batch.target[row + i], frames[i] - batch.target[i]);
        reconstruction += e1.abs() as f64;
        velocity += (e1 - e0).abs() as f64;
        let s = vel * sign(e1 - e0);
        d[i] += rec * sign(e1) + s;
        if i >= row {
            d[i - row] -= s;
        }
    }
    let skate = skate_loss(frames, batch, width, share * weights.skate, d);
    LossParts { reconstruction: reconstruction as f32 * inverse, velocity: velocity as f32 * inverse, kl: 0.0, skate }
}

fn skate_loss(frames: &[f32], batch: &Batch, width: usize, scale: f32, d: &mut [f32]) -> f32 {
    let row = width * batch.rows;
    let steps = d.len() / row;
    let feet: Vec<usize> = FOOT_MARKERS.iter().map(|m| 3 * m).filter(|k| k + 3 <= width).collect();
    let inverse = 1.0 / (steps * batch.rows * feet.len() * 3).max(1) as f32;
    let mut sum = 0.0f64;
    for (person, k) in (0..steps * batch.rows).flat_map(|p| feet.iter().map(move |&k| (p, k))) {
        let i = person * width + k;
        let moved: f32 = (i..i + 3).map(|j| (batch.target[row + j] - batch.target[j]).powi(2)).sum();
        if moved > STANCE * STANCE {
            continue;
        }
        for j in i..i + 3 {
            let v = frames[row + j] - frames[j];
            sum += v.abs() as f64;
            let s = scale * inverse * sign(v);
            d[j] += s;
            if j >= row {
                d[j - row] -= s;
            }
        }
    }
    sum as f32 * inverse
}

/// -1, 0 or 1.
pub fn sign(v: f32) -> f32 {
    if v > 0.0 {
        1.0
    } else if v < 0.0 {
        -1.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::super::init;
    use super::*;
    use burn::tensor::{Device, Tensor, TensorData};
    use egogen::motion::{Parameters, Predictor, PredictorSizes};
    use egogen::rng::stream;
    use rand::RngExt;

    fn batch(rows: usize, frame: usize, latent: usize, steps: usize) -> Batch {
        let rng = &mut stream(1, "test batch", 0);
        let mut draw = |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-1.0..1.0)).collect() };
        Batch { rows, seed: draw(2 * rows * frame), target: draw((1 + steps) * rows * frame), eps: draw(rows * latent) }
    }

    /// The loss in burn, with autodiff.
    fn reference(w: &PredictorWeights, b: &Batch, weights: &LossWeights, steps: usize) -> (f32, PredictorWeights) {
        let (frame, latent) = (w.d_out.output, w.e_mu.output);
        let device = Device::flex().autodiff();
        let tensor =
            |data: &[f32], shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(data.to_vec(), shape), &device).swap_dims(0, 1);
        let seed = tensor(&b.seed, [2, b.rows, frame]);
        let target = tensor(&b.target, [steps + 1, b.rows, frame]);
        let eps = Tensor::<2>::from_data(TensorData::new(b.eps.clone(), [b.rows, latent]), &device);
        let net = Predictor::new(w, &device);
        let (mu, logvar) = net.encode(seed.clone(), target.clone().narrow(1, 1, steps));
        let z = mu.clone() + (logvar.clone() * 0.5).exp() * eps;
        let y = net.decode(seed.clone(), z, steps);
        let all = Tensor::cat(vec![seed.narrow(1, 1, 1), y.clone()], 1);
        let diff = |t: Tensor<3>| t.clone().narrow(1, 1, steps) - t.narrow(1, 0, steps);
        let rec = (y - target.clone().narrow(1, 1, steps)).abs().mean();
        let vel = (diff(all) - diff(target)).abs().mean();
        let kl = ((mu.clone() * mu + logvar.clone().exp() - logvar - 1.0) * 0.5).mean();
        let kl = if weights.robust { (kl.clone() * kl + 1.0).sqrt() - 1.0 } else { kl };
        let loss = rec + vel * weights.velocity + kl * weights.kl;
        let mut grads = loss.backward();
        let mut g = w.zeros();
        net.add_gradients(&mut grads, &mut g);
        (loss.into_scalar::<f32>(), g)
    }

    #[test]
    fn gradients_match_burn() {
        let sizes = PredictorSizes { frame: 9, hidden: 8, wide: 12, latent: 5 };
        let (rows, steps) = (3, 6);
        let mut w = init::predictor(sizes, 3, &[0.3; 9]);
        w.d_out.weight.iter_mut().for_each(|v| *v *= 10.0);
        let b = batch(rows, 9, 5, steps);
        for robust in [false, true] {
            let weights = LossWeights { kl: 0.7, robust, skate: 0.0, ..Default::default() };
            let (want, mut want_g) = reference(&w, &b, &weights, steps);
            let mut g = w.zeros();
            let mut tape = Tape::default();
            let parts = step(&Ready::new(&w).unwrap(), &mut g, &mut tape, &b, &weights, 1.0);
            assert!((parts.total(&weights) - want).abs() < 1e-5, "{parts:?} {want}");
            for ((name, _, _), (a, b)) in w.named().iter().zip(g.tensors_mut().into_iter().zip(want_g.tensors_mut())) {
                let scale = b.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                assert!(scale > 0.0, "{name} has no gradient");
                let worst = a.iter().zip(b.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(worst < 1e-4 * scale.max(1e-3), "{name}: {worst} of {scale}");
            }
        }
    }

    #[test]
    fn skate_by_hand() {
        // One person, one step, 67 markers; LHEE stands in truth but moves 0.02 in x; LTOE moves in truth: not counted.
        let mut b = Batch { rows: 1, seed: vec![0.0; 402], target: vec![0.0; 402], eps: vec![] };
        let mut frames = vec![0.0; 402];
        frames[201 + 3 * 16] = 0.02;
        frames[201 + 3 * 30] = 0.5;
        b.target[201 + 3 * 30] = 0.4;
        let mut d = Vec::new();
        let w = LossWeights { velocity: 0.0, kl: 0.0, robust: true, skate: 1.0 };
        let parts = frame_loss(&frames, &b, &w, 1.0, &mut d);
        assert!((parts.skate - 0.02 / 18.0).abs() < 1e-8);
        assert!((parts.reconstruction - 0.12 / 201.0).abs() < 1e-7);
        assert!((d[3 * 16] - 1.0 / 18.0 - 1.0 / 201.0).abs() < 1e-7);
        assert!((d[3 * 30] - 1.0 / 201.0).abs() < 1e-7);
    }
}
