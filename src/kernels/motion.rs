//! The networks of the frozen motion model: decoder of marker primitives and body regressor.

use super::linear::dense;
use super::pool::{Pool, check, take};
use super::{Activation, GruCell, Linear, Source, View};
use crate::Result;
use crate::body::rotation::{from_6d, to_axis_angle};
use crate::body::{BETAS, BODY_JOINTS, HANDS, MARKER_DIM, ORIENT, PARAMS, POSE, TRANSL};
use crate::motion::{CONTINUOUS, Dense, FUTURE, PredictorWeights, RegressorWeights, SEED};
use glam::Vec3;
use std::ops::Range;

/// People of one decoder task: their states stay in the second-level cache while the weights stream by.
const DECODER_ROWS: usize = 64;
/// Bodies of one regressor task.
const REGRESSOR_ROWS: usize = 128;

fn linear(d: &Dense) -> Result<Linear> {
    Linear::new(&d.weight, &d.bias, d.input)
}

/// The decoder of the marker predictor: seed frames and latent to future frames.
pub struct Decoder {
    x_enc: GruCell,
    /// The part of the cell's input product that stays the same over all frames: from the encoded seed, from the latent.
    constant: [Linear; 2],
    drnn_mlp: [Linear; 3],
    d_rnn: GruCell,
    d_mlp: [Linear; 2],
    d_out: Linear,
    pool: Pool,
}

impl Decoder {
    /// Packs the weights.
    ///
    /// # Errors
    /// If a layer's arrays do not fill its shape.
    pub fn new(w: &PredictorWeights) -> Result<Self> {
        let (hidden, cell) = (w.x_enc.hidden, &w.d_rnn);
        check("a frame of the predictor", w.d_out.output, MARKER_DIM)?;
        check("the previous frame of d_rnn", cell.input.saturating_sub(hidden + w.e_mu.output), MARKER_DIM)?;
        let frame = cell.input - MARKER_DIM;
        let part = |bias, columns| Linear::from_columns(&cell.weight_ih, bias, cell.input, columns);
        let [a, b, c] = &w.drnn_mlp;
        Ok(Self {
            x_enc: GruCell::new(&w.x_enc.weight_ih, &w.x_enc.weight_hh, &w.x_enc.bias_ih, &w.x_enc.bias_hh, w.x_enc.input)?,
            constant: [part(&cell.bias_ih[..], 0..hidden)?, part(&[], hidden..frame)?],
            drnn_mlp: [linear(a)?, linear(b)?, linear(c)?],
            d_rnn: GruCell::from_columns(&cell.weight_ih, &cell.weight_hh, [&[], &cell.bias_hh], cell.input, frame..cell.input)?,
            d_mlp: [linear(&w.d_mlp[0])?, linear(&w.d_mlp[1])?],
            d_out: linear(&w.d_out)?,
            pool: Pool::default(),
        })
    }

    /// Dimensions of the latent.
    pub fn latent_dim(&self) -> usize {
        self.constant[1].inputs()
    }

    /// Future frames. `seed`: n x 2 x 201, `latent`: n x latent_dim, `out`: n x 18 x 201.
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn decode(&self, seed: &[f32], latent: &[f32], out: &mut [f32]) -> Result<()> {
        let (people, width) = (seed.len() / (SEED * MARKER_DIM), self.latent_dim());
        check("the seed", seed.len(), people * SEED * MARKER_DIM)?;
        check("the latent", latent.len(), people * width)?;
        check("the decoder's output", out.len(), people * FUTURE * MARKER_DIM)?;
        let (hidden, wide) = (self.d_rnn.size(), self.d_mlp[0].outputs());
        let scratch = 3 * hidden + 3 * hidden + MARKER_DIM + wide.max(self.drnn_mlp[0].outputs()) + self.d_rnn.scratch(1);
        self.pool.blocks(out, FUTURE * MARKER_DIM, DECODER_ROWS, scratch, |first, rows, out, scratch| {
            let seed = &seed[first * SEED * MARKER_DIM..];
            self.block(rows, seed, &latent[first * width..], out, scratch);
        });
        Ok(())
    }

    fn block(&self, rows: usize, seed: &[f32], latent: &[f32], out: &mut [f32], mut scratch: &mut [f32]) {
        let (hidden, gates) = (self.d_rnn.size(), 3 * self.d_rnn.size());
        let h_x = take(&mut scratch, rows * hidden);
        let h = take(&mut scratch, rows * hidden);
        let narrow = take(&mut scratch, rows * hidden);
        let constant = take(&mut scratch, rows * gates);
        let frame = take(&mut scratch, rows * MARKER_DIM);
        let cell = take(&mut scratch, self.d_rnn.scratch(rows));
        let wide = scratch;

        self.x_enc.encode(rows, SEED, View::new(seed, SEED * MARKER_DIM), h_x, cell);
        // The two parts share one buffer: the second adds to the first in place, both being linear.
        dense(&self.constant[0], rows, h_x, constant, Source::Fresh, Activation::None);
        dense(&self.constant[1], rows, latent, constant, Source::Residual, Activation::None);
        dense(&self.drnn_mlp[0], rows, h_x, wide, Source::Fresh, Activation::Tanh);
        dense(&self.drnn_mlp[1], rows, wide, narrow, Source::Fresh, Activation::Tanh);
        dense(&self.drnn_mlp[2], rows, narrow, h, Source::Fresh, Activation::Tanh);
        for (frame, seed) in frame.chunks_exact_mut(MARKER_DIM).zip(seed.chunks_exact(SEED * MARKER_DIM)) {
            frame.copy_from_slice(&seed[(SEED - 1) * MARKER_DIM..]);
        }
        for t in 0..FUTURE {
            let constant = Source::Plus(View::new(constant, gates));
            self.d_rnn.step(rows, View::new(frame, MARKER_DIM), constant, h, cell);
            dense(&self.d_mlp[0], rows, h, wide, Source::Fresh, Activation::Tanh);
            dense(&self.d_mlp[1], rows, wide, narrow, Source::Fresh, Activation::Tanh);
            dense(&self.d_out, rows, narrow, frame, Source::Residual, Activation::None);
            for (out, frame) in out.chunks_exact_mut(FUTURE * MARKER_DIM).zip(frame.chunks_exact(MARKER_DIM)) {
                out[t * MARKER_DIM..(t + 1) * MARKER_DIM].copy_from_slice(frame);
            }
        }
    }
}

/// The body regressor: markers and betas to body parameters.
pub struct Regressor {
    passes: usize,
    /// The first layer's parts for markers, betas and the current estimate; only the last changes between passes.
    input: [Linear; 3],
    blocks: Vec<[Linear; 2]>,
    out_fc: Linear,
    pool: Pool,
}

impl Regressor {
    /// Packs the weights.
    ///
    /// # Errors
    /// If a layer's arrays do not fill its shape.
    pub fn new(w: &RegressorWeights) -> Result<Self> {
        let fc = &w.in_fc;
        check("an input row of pnet.in_fc", fc.input, MARKER_DIM + BETAS + CONTINUOUS)?;
        check("an output row of pnet.out_fc", w.out_fc.output, CONTINUOUS)?;
        let part = |bias, columns: Range<usize>| Linear::from_columns(&fc.weight, bias, fc.input, columns);
        let betas = MARKER_DIM + BETAS;
        Ok(Self {
            passes: w.passes,
            input: [part(&fc.bias[..], 0..MARKER_DIM)?, part(&[], MARKER_DIM..betas)?, part(&[], betas..fc.input)?],
            blocks: w.blocks.iter().map(|[a, b]| Ok([linear(a)?, linear(b)?])).collect::<Result<_>>()?,
            out_fc: linear(&w.out_fc)?,
            pool: Pool::default(),
        })
    }

    /// Body parameters. `markers`: m x 201, `betas`: m x 10, `out`: m x 93.
    ///
    /// # Errors
    /// If the lengths do not agree.
    pub fn regress(&self, markers: &[f32], betas: &[f32], out: &mut [f32]) -> Result<()> {
        let bodies = markers.len() / MARKER_DIM;
        check("the markers", markers.len(), bodies * MARKER_DIM)?;
        check("betas", betas.len(), bodies * BETAS)?;
        check("the regressor's output", out.len(), bodies * PARAMS)?;
        let scratch = 3 * self.out_fc.inputs() + CONTINUOUS;
        self.pool.blocks(out, PARAMS, REGRESSOR_ROWS, scratch, |first, rows, out, scratch| {
            self.block(rows, &markers[first * MARKER_DIM..], &betas[first * BETAS..], out, scratch);
        });
        Ok(())
    }

    fn block(&self, rows: usize, markers: &[f32], betas: &[f32], out: &mut [f32], mut scratch: &mut [f32]) {
        let width = self.out_fc.inputs();
        let constant = take(&mut scratch, rows * width);
        let h = take(&mut scratch, rows * width);
        let inner = take(&mut scratch, rows * width);
        let body = scratch;
        dense(&self.input[0], rows, markers, constant, Source::Fresh, Activation::None);
        dense(&self.input[1], rows, betas, constant, Source::Residual, Activation::None);
        body.fill(0.0);
        for pass in 0..self.passes {
            if pass == 0 {
                h.copy_from_slice(constant);
            } else {
                dense(&self.input[2], rows, body, h, Source::Plus(View::new(constant, width)), Activation::None);
            }
            for [first, second] in &self.blocks {
                dense(first, rows, h, inner, Source::Fresh, Activation::Relu);
                dense(second, rows, inner, h, Source::Residual, Activation::Relu);
            }
            dense(&self.out_fc, rows, h, body, Source::Residual, Activation::None);
        }
        for (body, out) in body.chunks_exact(CONTINUOUS).zip(out.chunks_exact_mut(PARAMS)) {
            to_params(body, out);
        }
    }
}

/// Body parameters of a body in the regressor's continuous form.
fn to_params(body: &[f32], out: &mut [f32]) {
    let (six, hands) = body[TRANSL.end..].split_at(6 * BODY_JOINTS);
    out[TRANSL].copy_from_slice(&body[TRANSL]);
    for (six, out) in six.as_chunks::<6>().0.iter().zip(out[ORIENT.start..POSE.end].chunks_exact_mut(3)) {
        // A network that diverged must not look like a body, so its not-a-numbers pass through.
        let turn = if six.iter().all(|v| v.is_finite()) { to_axis_angle(&from_6d(six)) } else { Vec3::NAN };
        out.copy_from_slice(&turn.to_array());
    }
    out[HANDS].copy_from_slice(hands);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Tensors;
    use crate::motion::{Gru, PredictorSizes, RegressorSizes};

    fn fixture() -> Tensors {
        Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/motion_engine.safetensors")).unwrap()
    }

    fn layer(t: &Tensors, name: &str) -> Dense {
        let shape = t.shape(&format!("{name}.weight")).unwrap();
        let get = |part: &str, shape: &[usize]| t.f32s(&format!("{name}.{part}"), shape).unwrap();
        Dense { input: shape[1], output: shape[0], weight: get("weight", &shape), bias: get("bias", &shape[..1]) }
    }

    fn gru(t: &Tensors, name: &str, suffix: &str) -> Gru {
        let get = |part: &str, shape: &[usize]| t.f32s(&format!("{name}.{part}{suffix}"), shape).unwrap();
        let shape = t.shape(&format!("{name}.weight_ih{suffix}")).unwrap();
        Gru {
            input: shape[1],
            hidden: shape[0] / 3,
            weight_ih: get("weight_ih", &[0, 0]),
            weight_hh: get("weight_hh", &[0, 0]),
            bias_ih: get("bias_ih", &[0]),
            bias_hh: get("bias_hh", &[0]),
        }
    }

    /// The fixture's decoder; it holds no encoder, of which only the latent's width matters here.
    fn decoder() -> Decoder {
        let t = fixture();
        let mlp = |name: &str, i: usize| layer(&t, &format!("{name}.layers.{i}"));
        let weights = PredictorWeights {
            x_enc: gru(&t, "x_enc", "_l0"),
            e_mu: Dense { output: 5, ..Dense::default() },
            drnn_mlp: [0, 1, 2].map(|i| mlp("drnn_mlp", i)),
            d_rnn: gru(&t, "d_rnn", ""),
            d_mlp: [0, 1].map(|i| mlp("d_mlp", i)),
            d_out: layer(&t, "d_out"),
            ..PredictorWeights::default()
        };
        Decoder::new(&weights).unwrap()
    }

    fn regressor() -> Regressor {
        let sizes = RegressorSizes { width: 16, blocks: 2, passes: 3 };
        Regressor::new(&RegressorWeights::read(&fixture(), sizes).unwrap()).unwrap()
    }

    fn close(have: &[f32], want: &[f32], tolerance: f32) {
        assert_eq!(have.len(), want.len());
        for (i, (a, b)) in have.iter().zip(want).enumerate() {
            assert!((a - b).abs() < tolerance, "value {i}: {a}, torch says {b}");
        }
    }

    #[test]
    fn decoder_matches_torch() {
        let t = fixture();
        let mut out = vec![f32::NAN; 3 * FUTURE * MARKER_DIM];
        let (seed, latent) = (t.f32s("seed", &[3, SEED, MARKER_DIM]).unwrap(), t.f32s("latent", &[3, 5]).unwrap());
        decoder().decode(&seed, &latent, &mut out).unwrap();
        close(&out, &t.f32s("decoded", &[3, FUTURE, MARKER_DIM]).unwrap(), 5e-6);
    }

    #[test]
    fn regressor_matches_torch() {
        let t = fixture();
        let mut out = vec![f32::NAN; 4 * PARAMS];
        let (markers, betas) = (t.f32s("markers", &[4, MARKER_DIM]).unwrap(), t.f32s("betas", &[4, BETAS]).unwrap());
        regressor().regress(&markers, &betas, &mut out).unwrap();
        close(&out, &t.f32s("params", &[4, PARAMS]).unwrap(), 2e-5);
    }

    #[test]
    fn threads_and_batches_do_not_change_bits() {
        let t = fixture();
        let people = 150;
        let repeat = |name: &str| {
            let one = t.f32s(name, &[0, 0]).or_else(|_| t.f32s(name, &[0, 0, 0])).unwrap();
            let rows: Vec<f32> =
                one.iter().cycle().take(one.len() * people).enumerate().map(|(i, v)| v * (1.0 + i as f32 * 1e-7)).collect();
            rows
        };
        let (seed, latent) = (repeat("seed"), repeat("latent"));
        let (markers, betas) = (repeat("markers"), repeat("betas"));
        let (decoder, regressor) = (decoder(), regressor());
        let run = |threads: usize| {
            let mut frames = vec![0.0; 3 * people * FUTURE * MARKER_DIM];
            let mut params = vec![0.0; 4 * people * PARAMS];
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                decoder.decode(&seed, &latent, &mut frames).unwrap();
                regressor.regress(&markers, &betas, &mut params).unwrap();
            });
            (frames, params)
        };
        let (one, three) = (run(1), run(3));
        assert!(one == three, "the number of threads changes results");
        let mut last = vec![0.0; FUTURE * MARKER_DIM];
        decoder.decode(&seed[seed.len() - SEED * MARKER_DIM..], &latent[latent.len() - 5..], &mut last).unwrap();
        assert!(one.0.ends_with(&last), "the batch changes results");
    }

    #[test]
    fn wrong_lengths_are_refused() {
        let mut out = vec![0.0; FUTURE * MARKER_DIM];
        let error = decoder().decode(&[0.0; SEED * MARKER_DIM], &[0.0; 4], &mut out).unwrap_err().to_string();
        assert_eq!(error, "the latent has 4 floats, expected 5");
        assert!(regressor().regress(&[0.0; MARKER_DIM], &[0.0; 9], &mut [0.0; PARAMS]).is_err());
        assert!(regressor().regress(&[0.0; MARKER_DIM], &[0.0; 10], &mut [0.0; 92]).is_err());
    }

    #[test]
    fn nonsense_markers_do_not_become_a_body() {
        let mut out = [0.0; PARAMS];
        regressor().regress(&[f32::NAN; MARKER_DIM], &[0.0; BETAS], &mut out).unwrap();
        assert!(out[ORIENT].iter().all(|v| v.is_nan()));
    }

    #[test]
    fn the_papers_sizes_fit() {
        let s = PredictorSizes::default();
        let dense = |input, output| Dense { input, output, weight: vec![0.0; input * output], bias: vec![0.0; output] };
        let gru = |input, hidden: usize| Gru {
            input,
            hidden,
            weight_ih: vec![0.0; 3 * hidden * input],
            weight_hh: vec![0.0; 3 * hidden * hidden],
            bias_ih: vec![0.0; 3 * hidden],
            bias_hh: vec![0.0; 3 * hidden],
        };
        let weights = PredictorWeights {
            x_enc: gru(s.frame, s.hidden),
            e_mu: dense(s.hidden, s.latent),
            drnn_mlp: [dense(s.hidden, s.wide), dense(s.wide, s.hidden), dense(s.hidden, s.hidden)],
            d_rnn: gru(s.hidden + s.latent + s.frame, s.hidden),
            d_mlp: [dense(s.hidden, s.wide), dense(s.wide, s.hidden)],
            d_out: dense(s.hidden, s.frame),
            ..PredictorWeights::default()
        };
        let decoder = Decoder::new(&weights).unwrap();
        assert_eq!(decoder.latent_dim(), 128);
        // With all weights zero nothing moves: every frame is the last seed frame.
        let seed: Vec<f32> = (0..SEED * MARKER_DIM).map(|i| i as f32).collect();
        let mut out = vec![0.0; FUTURE * MARKER_DIM];
        decoder.decode(&seed, &[1.0; 128], &mut out).unwrap();
        assert!(out.chunks_exact(MARKER_DIM).all(|f| f == &seed[MARKER_DIM..]));
    }
}
