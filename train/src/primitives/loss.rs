//! The predictor's loss and its gradient.

use super::predictor::{Batch, Ready, Tape};
use egogen::body::FOOT_MARKERS;
use egogen::metrics::kl_to_standard;
use egogen::motion::PredictorWeights;
use serde::{Deserialize, Serialize};

/// Weights of the predictor's loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossWeights {
    /// Mean absolute error of the frame differences, the step from the seed included (A2: 3).
    pub velocity: f32,
    /// Divergence from the prior (A2: 1). Smaller weights reconstruct better, but then samples of the prior cover less of what
    /// people do: see the results page.
    pub kl: f32,
    /// Use sqrt(1 + KL^2) - 1 (A2) instead of KL.
    pub robust: bool,
    /// Mean absolute velocity of predicted foot markers while the true one stands still; ours, against sliding.
    pub skate: f32,
    /// Speed of the slowest foot marker over 0.075 m/s (eq. 12), in frames decoded from latents of the PRIOR, which nothing else
    /// trains; ours, against sliding. What also punishes feet that roll, such as the way of the bearing marker, makes the prior stand
    /// still, for nothing but this holds it.
    pub contact: f32,
}

/// Means over a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossParts {
    pub reconstruction: f32,
    pub velocity: f32,
    /// Mean per latent dimension, nats.
    pub kl: f32,
    pub skate: f32,
    /// Metres per frame.
    pub contact: f32,
}

/// True speed, metres per frame, below which a foot marker stands: 0.15 m/s.
const STANCE: f32 = 0.15 / egogen::motion::FPS;
/// Speed, metres per frame, up to which eq. 12 counts a foot as standing.
const STANDING: f32 = 0.075 / egogen::motion::FPS;

impl LossParts {
    pub fn total(&self, w: &LossWeights) -> f32 {
        let kl = kl_term(self.kl, w.robust).0;
        self.reconstruction + w.velocity * self.velocity + w.kl * kl + w.skate * self.skate + w.contact * self.contact
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

/// Forward and backward of a shard that is `share` of its batch; adds the gradients. `tape.frames` holds the reconstruction.
pub fn step(w: &Ready, grad: &mut PredictorWeights, tape: &mut Tape, batch: &Batch, weights: &LossWeights, share: f32) -> LossParts {
    tape.encode(w, &batch.seed, batch.future(), batch.rows);
    let frame = batch.seed.len() / (2 * batch.rows);
    let steps = batch.target.len() / (batch.rows * frame) - 1;
    let mut d_frames = Vec::new();
    let (mut contact, mut d_hx) = (0.0, vec![0.0; batch.rows * w.hidden()]);
    if weights.contact > 0.0 {
        tape.decode(w, &batch.seed, &batch.eps, batch.rows, steps);
        contact = contact_loss(&tape.frames, batch.rows, frame, share * weights.contact, &mut d_frames);
        d_hx = tape.backward_prior(w, grad, &mut d_frames, batch.rows);
    }
    // z = mu + exp(logvar / 2) eps
    let z: Vec<f32> = tape.mu.iter().zip(&tape.logvar).zip(&batch.eps).map(|((m, v), e)| m + (0.5 * v).exp() * e).collect();
    tape.decode(w, &batch.seed, &z, batch.rows, steps);
    let mut parts = frame_loss(&tape.frames, batch, weights, share, &mut d_frames);
    parts.contact = contact;
    parts.kl = kl_to_standard(&tape.mu, &tape.logvar) / tape.mu.len() as f32;
    // The robust form couples all people of a batch; taking each shard's own mean keeps shards independent.
    let slope = share * weights.kl * kl_term(parts.kl, weights.robust).1 / tape.mu.len() as f32;
    let mut d_mu: Vec<f32> = tape.mu.iter().map(|m| slope * m).collect();
    let mut d_logvar: Vec<f32> = tape.logvar.iter().map(|v| 0.5 * slope * (v.exp() - 1.0)).collect();
    tape.backward(w, grad, batch, &mut d_frames, [&mut d_mu, &mut d_logvar], d_hx);
    parts
}

/// Mean over people and steps of how much faster than standing the slowest foot marker moves, metres per frame. `frames`:
/// (1 + steps) x rows x width; `d` becomes the gradient with respect to all but the first, scaled by `scale`.
fn contact_loss(frames: &[f32], rows: usize, width: usize, scale: f32, d: &mut Vec<f32>) -> f32 {
    let row = rows * width;
    let moves = frames.len() / width - rows;
    d.clear();
    d.resize(moves * width, 0.0);
    let velocity = |i: usize| -> [f32; 3] { std::array::from_fn(|k| frames[row + i + k] - frames[i + k]) };
    let speed = |i: usize| velocity(i).iter().map(|v| v * v).sum::<f32>().sqrt();
    let mut sum = 0.0f64;
    for person in 0..moves {
        let feet = FOOT_MARKERS.iter().map(|m| person * width + 3 * m).filter(|i| i + 3 <= (person + 1) * width);
        let Some((i, v)) = feet.map(|i| (i, speed(i))).min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        if v <= STANDING {
            continue;
        }
        sum += (v - STANDING) as f64;
        for (k, component) in velocity(i).into_iter().enumerate() {
            let g = scale * component / (v * moves as f32);
            d[i + k] += g;
            if i >= row {
                d[i + k - row] -= g;
            }
        }
    }
    (sum / moves as f64) as f32
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
    LossParts { reconstruction: reconstruction as f32 * inverse, velocity: velocity as f32 * inverse, kl: 0.0, skate, contact: 0.0 }
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
    use egogen::body::MARKER_DIM;
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
            let weights = LossWeights { velocity: 3.0, kl: 0.7, robust, skate: 0.0, contact: 0.0 };
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
        let w = LossWeights { velocity: 0.0, kl: 0.0, robust: true, skate: 1.0, contact: 0.0 };
        let parts = frame_loss(&frames, &b, &w, 1.0, &mut d);
        assert!((parts.skate - 0.02 / 18.0).abs() < 1e-8);
        assert!((parts.reconstruction - 0.12 / 201.0).abs() < 1e-7);
        assert!((d[3 * 16] - 1.0 / 18.0 - 1.0 / 201.0).abs() < 1e-7);
        assert!((d[3 * 30] - 1.0 / 201.0).abs() < 1e-7);
    }

    #[test]
    fn contact_by_hand_and_by_differences() {
        // Two steps of one person. All markers run; LHEE is slowest in the first step, RTOE stands in the second.
        let width = MARKER_DIM;
        let mut frames: Vec<f32> = (0..3 * width).map(|i| (i / width) as f32).collect();
        let (heel, toe) = (3 * 16, 3 * 60);
        frames[heel..heel + 3].fill(0.0);
        frames[width + heel..][..3].copy_from_slice(&[0.03, 0.04, 0.0]);
        let still: [f32; 3] = std::array::from_fn(|k| frames[width + toe + k]);
        frames[2 * width + toe..][..3].copy_from_slice(&still);
        let mut d = Vec::new();
        let loss = contact_loss(&frames, 1, width, 2.0, &mut d);
        assert!((loss - (0.05 - STANDING) / 2.0).abs() < 1e-7);
        assert!((d[heel] - 0.6).abs() < 1e-6 && (d[heel + 1] - 0.8).abs() < 1e-6);
        assert_eq!(d.iter().filter(|v| **v != 0.0).count(), 2);
    }

    #[test]
    fn prior_gradients_match_differences() {
        let sizes = PredictorSizes { frame: MARKER_DIM, hidden: 6, wide: 7, latent: 3 };
        let mut w = init::predictor(sizes, 5, &[0.0; MARKER_DIM]);
        w.d_out.weight.iter_mut().for_each(|v| *v *= 3.0);
        let b = batch(2, MARKER_DIM, 3, 4);
        let only = LossWeights { velocity: 0.0, kl: 0.0, robust: true, skate: 0.0, contact: 1.0 };
        let loss = |w: &PredictorWeights| {
            let mut tape = Tape::default();
            step(&Ready::new(w).unwrap(), &mut w.zeros(), &mut tape, &b, &only, 1.0).contact
        };
        let gradient = |contact: f32| {
            let mut g = w.zeros();
            let weights = LossWeights { contact, ..only };
            step(&Ready::new(&w).unwrap(), &mut g, &mut Tape::default(), &b, &weights, 1.0);
            g
        };
        // The reconstruction's gradient, which both hold, drops out.
        let (both, other) = (gradient(1.0), gradient(0.0));
        for at in [3, 100, 555] {
            let pick = |w: &PredictorWeights| w.x_enc.weight_ih[at];
            let (mut up, mut down) = (w.clone(), w.clone());
            up.x_enc.weight_ih[at] += 1e-2;
            down.x_enc.weight_ih[at] -= 1e-2;
            let want = (loss(&up) - loss(&down)) / 2e-2;
            let got = pick(&both) - pick(&other);
            assert!((got - want).abs() < 0.03 * want.abs() + 2e-6, "{at}: {got} {want}");
        }
    }
}
