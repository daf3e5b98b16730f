//! Starting weights.

use egogen::body::MARKER_DIM;
use egogen::motion::{CONTINUOUS, Dense, Gru, PredictorSizes, PredictorWeights, RegressorSizes, RegressorWeights};
use egogen::rng::{Stream, stream};
use rand::RngExt;

/// Uniform in +-bound.
fn uniform(rng: &mut Stream, n: usize, bound: f32) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-bound..bound)).collect()
}

/// torch's default: +- 1 / sqrt(inputs).
pub fn dense(rng: &mut Stream, input: usize, output: usize) -> Dense {
    let bound = 1.0 / (input as f32).sqrt();
    Dense { input, output, weight: uniform(rng, input * output, bound), bias: uniform(rng, output, bound) }
}

/// torch's default: +- 1 / sqrt(hidden).
fn gru(rng: &mut Stream, input: usize, hidden: usize) -> Gru {
    let bound = 1.0 / (hidden as f32).sqrt();
    let mut draw = |n| uniform(rng, n, bound);
    Gru {
        input,
        hidden,
        weight_ih: draw(3 * hidden * input),
        weight_hh: draw(3 * hidden * hidden),
        bias_ih: draw(3 * hidden),
        bias_hh: draw(3 * hidden),
    }
}

/// Makes rows of `weight` (rows of `stride`, columns from `first`) see (x - mean) * gain by scaling them and moving the bias:
/// markers spread by about a quarter metre around a mean that is far larger, which would saturate a plain start.
fn normalise(weight: &mut [f32], bias: &mut [f32], stride: usize, first: usize, mean: &[f32], gain: f32) {
    for (row, b) in weight.chunks_exact_mut(stride).zip(bias) {
        for (w, m) in row[first..].iter_mut().zip(mean) {
            *w *= gain;
            *b -= *w * m;
        }
    }
}

/// Gain of markers at the start.
const GAIN: f32 = 3.0;

/// Fresh predictor weights; `mean` is the mean frame of markers.
pub fn predictor(s: PredictorSizes, seed: u64, mean: &[f32]) -> PredictorWeights {
    let rng = &mut stream(seed, "predictor weights", 0);
    let (f, h, w) = (s.frame, s.hidden, s.wide);
    let mut p = PredictorWeights {
        x_enc: gru(rng, f, h),
        e_rnn: gru(rng, f, h),
        e_mlp: [dense(rng, 2 * h, w), dense(rng, w, h)],
        e_mu: dense(rng, h, s.latent),
        e_logvar: dense(rng, h, s.latent),
        drnn_mlp: [dense(rng, h, w), dense(rng, w, h), dense(rng, h, h)],
        d_rnn: gru(rng, h + s.latent + f, h),
        d_mlp: [dense(rng, h, w), dense(rng, w, h)],
        d_out: dense(rng, h, f),
    };
    for g in [&mut p.x_enc, &mut p.e_rnn] {
        normalise(&mut g.weight_ih, &mut g.bias_ih, f, 0, mean, GAIN);
    }
    let inputs = p.d_rnn.input;
    normalise(&mut p.d_rnn.weight_ih, &mut p.d_rnn.bias_ih, inputs, h + s.latent, mean, GAIN);
    // Start near standing still.
    p.d_out.weight.iter_mut().chain(&mut p.d_out.bias).for_each(|v| *v *= 0.1);
    p
}

/// Fresh regressor weights; `mean` is the mean frame of markers, `body` the mean body in continuous form.
pub fn regressor(s: RegressorSizes, seed: u64, mean: &[f32], body: &[f32; CONTINUOUS]) -> RegressorWeights {
    let rng = &mut stream(seed, "regressor weights", 0);
    let mut r = RegressorWeights {
        passes: s.passes,
        in_fc: dense(rng, RegressorSizes::INPUT, s.width),
        blocks: (0..s.blocks).map(|_| [dense(rng, s.width, s.width), dense(rng, s.width, s.width)]).collect(),
        out_fc: dense(rng, s.width, CONTINUOUS),
    };
    debug_assert_eq!(mean.len(), MARKER_DIM);
    normalise(&mut r.in_fc.weight, &mut r.in_fc.bias, RegressorSizes::INPUT, 0, mean, GAIN);
    // Residual blocks start small, and the passes together start at the mean body.
    r.blocks.iter_mut().for_each(|b| b[1].weight.iter_mut().for_each(|v| *v *= 0.3));
    r.out_fc.weight.iter_mut().for_each(|v| *v *= 0.1);
    for (b, m) in r.out_fc.bias.iter_mut().zip(body) {
        *b = m / s.passes as f32;
    }
    r
}
