//! Forward and backward pass of the marker predictor.

use super::layers::{GruTape, Packed, add_rows, dense, dense_back, dense_grad, fill_rows, tanh, tanh_back};
use egogen::Result;
use egogen::kernels::{Activation, Mat, product};
use egogen::motion::PredictorWeights;
use rayon::join;

/// Weights, with those that are used at every frame packed for both directions.
pub struct Ready<'a> {
    w: &'a PredictorWeights,
    x_enc: Packed,
    e_rnn: Packed,
    d_rnn: Packed,
    /// The part of the cell's input that is the previous frame.
    frame: Packed,
    d_mlp: [Packed; 2],
    d_out: Packed,
}

impl<'a> Ready<'a> {
    pub fn new(w: &'a PredictorWeights) -> Result<Self> {
        let cell = &w.d_rnn;
        let f = w.d_out.output;
        let frame = || Packed::new(&cell.weight_ih, &[], cell.input, cell.input - f, f);
        let ((x_enc, d_out), (e_rnn, frame)) =
            join(|| join(|| Packed::hidden(&w.x_enc), || Packed::dense(&w.d_out)), || join(|| Packed::hidden(&w.e_rnn), frame));
        let (d_rnn, (first, second)) = join(|| Packed::hidden(cell), || join(|| Packed::dense(&w.d_mlp[0]), || Packed::dense(&w.d_mlp[1])));
        Ok(Self { w, x_enc: x_enc?, e_rnn: e_rnn?, d_rnn: d_rnn?, frame: frame?, d_mlp: [first?, second?], d_out: d_out? })
    }

    /// Width of the states.
    pub fn hidden(&self) -> usize {
        self.w.d_rnn.hidden
    }
}

/// Everything one forward pass leaves behind; reused from batch to batch. Time outermost, then people.
#[derive(Default)]
pub struct Tape {
    x: GruTape,
    y: GruTape,
    cell: GruTape,
    encoded: Vec<f32>,
    e: [Vec<f32>; 2],
    /// rows x latent.
    pub mu: Vec<f32>,
    /// rows x latent.
    pub logvar: Vec<f32>,
    start: [Vec<f32>; 3],
    /// rows x (hidden + latent): the decoder's constant input [h_x, z].
    constant: Vec<f32>,
    share: Vec<f32>,
    d: [Vec<f32>; 2],
    /// (steps + 1) x rows x frame: the last seed frame, then the predicted ones.
    pub frames: Vec<f32>,
    room: [Vec<f32>; 4],
}

impl Tape {
    /// Encodes seed `x` (2 x rows x frame) and future `y` (steps x rows x frame) to `mu` and `logvar`.
    pub fn encode(&mut self, p: &Ready, x: &[f32], y: &[f32], rows: usize) {
        let w = p.w;
        let h = w.x_enc.hidden;
        let hx = self.x.run(&w.x_enc, &p.x_enc, x, rows);
        let hy = self.y.run(&w.e_rnn, &p.e_rnn, y, rows);
        self.encoded.clear();
        for i in 0..rows {
            self.encoded.extend_from_slice(&hx[i * h..(i + 1) * h]);
            self.encoded.extend_from_slice(&hy[i * h..(i + 1) * h]);
        }
        let [e0, e1] = &mut self.e;
        dense(&w.e_mlp[0], &self.encoded, e0);
        tanh(e0);
        dense(&w.e_mlp[1], e0, e1);
        tanh(e1);
        dense(&w.e_mu, e1, &mut self.mu);
        dense(&w.e_logvar, e1, &mut self.logvar);
    }

    /// Decodes `steps` frames from seed `x` (2 x rows x frame) and `z` (rows x latent) into `frames`. The seed's state must be
    /// there from [`Tape::encode`].
    pub fn decode(&mut self, p: &Ready, x: &[f32], z: &[f32], rows: usize, steps: usize) {
        let w = p.w;
        let (h, f, latent) = (w.d_rnn.hidden, w.d_out.output, w.e_mu.output);
        let (wide, inputs) = (h + latent, w.d_rnn.input);
        let hx = &self.x.states[2 * rows * h..];
        let [s0, s1, s2] = &mut self.start;
        dense(&w.drnn_mlp[0], hx, s0);
        tanh(s0);
        dense(&w.drnn_mlp[1], s0, s1);
        tanh(s1);
        dense(&w.drnn_mlp[2], s1, s2);
        tanh(s2);
        self.constant.clear();
        for i in 0..rows {
            self.constant.extend_from_slice(&hx[i * h..(i + 1) * h]);
            self.constant.extend_from_slice(&z[i * latent..(i + 1) * latent]);
        }
        self.share.resize(rows * 3 * h, 0.0);
        fill_rows(&w.d_rnn.bias_ih, &mut self.share);
        let from_constant = Mat::strided(&w.d_rnn.weight_ih, 3 * h, wide, inputs).t();
        product(Mat::new(&self.constant, rows, wide), from_constant, &mut self.share, 3 * h, true);

        self.cell.reset(h, rows, steps);
        self.cell.states[..rows * h].copy_from_slice(s2);
        self.frames.resize((steps + 1) * rows * f, 0.0);
        self.frames[..rows * f].copy_from_slice(&x[rows * f..]);
        let [d0, d1] = &mut self.d;
        d0.resize(steps * rows * w.d_mlp[0].output, 0.0);
        d1.resize(steps * rows * h, 0.0);
        for t in 0..steps {
            let (done, next) = self.frames.split_at_mut((t + 1) * rows * f);
            let frame = &done[t * rows * f..];
            let input = &mut self.cell.input[t * rows * 3 * h..(t + 1) * rows * 3 * h];
            input.copy_from_slice(&self.share);
            p.frame.apply(frame, input, true, Activation::None);
            self.cell.step(&p.d_rnn, rows, t);
            let n0 = rows * w.d_mlp[0].output;
            let (d0, d1) = (&mut d0[t * n0..(t + 1) * n0], &mut d1[t * rows * h..(t + 1) * rows * h]);
            p.d_mlp[0].apply(&self.cell.states[(t + 1) * rows * h..(t + 2) * rows * h], d0, false, Activation::Tanh);
            p.d_mlp[1].apply(d0, d1, false, Activation::Tanh);
            let next = &mut next[..rows * f];
            next.copy_from_slice(frame);
            p.d_out.apply(d1, next, true, Activation::None);
        }
    }

    /// Adds all weight gradients. `d_frames` (steps x rows x frame) is the loss's gradient with respect to the predicted
    /// frames, used up; `d_mu`, `d_logvar` its direct gradients with respect to those; `eps` the noise that made the latent. `d_hx` (rows x hidden): gradients of the seed's state from elsewhere.
    pub fn backward(
        &mut self,
        p: &Ready,
        g: &mut PredictorWeights,
        batch: &Batch,
        d_frames: &mut [f32],
        [d_mu, d_logvar]: [&mut [f32]; 2],
        mut d_hx: Vec<f32>,
    ) {
        let w = p.w;
        let (h, rows, latent) = (w.d_rnn.hidden, batch.rows, w.e_mu.output);
        let d_constant = self.decoder_back(p, g, d_frames, rows, &mut d_hx);
        for (i, row) in d_constant.chunks_exact(h + latent).enumerate() {
            add_rows(&row[..h], &mut d_hx[i * h..(i + 1) * h]);
            for (k, dz) in row[h..].iter().enumerate() {
                let j = i * latent + k;
                d_mu[j] += dz;
                d_logvar[j] += 0.5 * dz * batch.eps[j] * (0.5 * self.logvar[j]).exp();
            }
        }
        self.encoder_back(p, g, batch, d_mu, d_logvar, d_hx);
    }

    /// Backward through a decoding whose latent came from outside; returns the gradient of the seed's state.
    pub fn backward_prior(&mut self, p: &Ready, g: &mut PredictorWeights, d_frames: &mut [f32], rows: usize) -> Vec<f32> {
        let h = p.w.d_rnn.hidden;
        let mut d_hx = vec![0.0; rows * h];
        let d_constant = self.decoder_back(p, g, d_frames, rows, &mut d_hx);
        for (d, row) in d_hx.chunks_exact_mut(h).zip(d_constant.chunks_exact(h + p.w.e_mu.output)) {
            add_rows(&row[..h], d);
        }
        d_hx
    }

    /// Backward through the decoder; returns the gradient of its constant input and adds to that of the seed's state.
    fn decoder_back(&mut self, p: &Ready, g: &mut PredictorWeights, d_frames: &mut [f32], rows: usize, d_hx: &mut [f32]) -> Vec<f32> {
        let w = p.w;
        let (h, f) = (w.d_rnn.hidden, w.d_out.output);
        let (wide, inputs, steps) = (h + w.e_mu.output, w.d_rnn.input, d_frames.len() / (rows * f));
        let n0 = w.d_mlp[0].output;
        let [carry, d0, d1, d_state] = &mut self.room;
        carry.resize(rows * f, 0.0);
        carry.fill(0.0);
        d0.resize(steps * rows * n0, 0.0);
        d1.resize(steps * rows * h, 0.0);
        d_state.resize(rows * h, 0.0);
        d_state.fill(0.0);
        for t in (0..steps).rev() {
            let d = &mut d_frames[t * rows * f..(t + 1) * rows * f];
            add_rows(carry, d);
            let (d0, d1) = (&mut d0[t * rows * n0..(t + 1) * rows * n0], &mut d1[t * rows * h..(t + 1) * rows * h]);
            p.d_out.back(d, d1, false);
            tanh_back(&self.d[1][t * rows * h..(t + 1) * rows * h], d1);
            p.d_mlp[1].back(d1, d0, false);
            tanh_back(&self.d[0][t * rows * n0..(t + 1) * rows * n0], d0);
            p.d_mlp[0].back(d0, d_state, true);
            self.cell.step_back(&p.d_rnn, rows, t, d_state);
            carry.copy_from_slice(d);
            p.frame.back(&self.cell.input[t * rows * 3 * h..(t + 1) * rows * 3 * h], carry, true);
        }
        dense_grad(&mut g.d_out, d_frames, &self.d[1]);
        dense_grad(&mut g.d_mlp[1], d1, &self.d[0]);
        dense_grad(&mut g.d_mlp[0], d0, &self.cell.states[rows * h..]);
        self.cell.hidden_grad(&mut g.d_rnn, rows, steps);
        let d_gates = Mat::new(&self.cell.input, steps * rows, 3 * h);
        product(d_gates.t(), Mat::new(&self.frames, steps * rows, f), &mut g.d_rnn.weight_ih[wide..], inputs, true);
        let mut d_share = vec![0.0; rows * 3 * h];
        add_rows(&self.cell.input, &mut d_share);
        product(Mat::new(&d_share, rows, 3 * h).t(), Mat::new(&self.constant, rows, wide), &mut g.d_rnn.weight_ih, inputs, true);
        add_rows(&d_share, &mut g.d_rnn.bias_ih);

        let mut d = std::mem::take(d_state);
        for k in (0..3).rev() {
            tanh_back(&self.start[k], &mut d);
            let x = if k == 0 { &self.x.states[2 * rows * h..] } else { &self.start[k - 1] };
            dense_grad(&mut g.drnn_mlp[k], &d, x);
            let mut dx = vec![0.0; rows * w.drnn_mlp[k].input];
            dense_back(&w.drnn_mlp[k], &d, &mut dx, false);
            d = dx;
        }
        add_rows(&d, d_hx);
        let mut d_constant = vec![0.0; rows * wide];
        product(Mat::new(&d_share, rows, 3 * h), Mat::strided(&w.d_rnn.weight_ih, 3 * h, wide, inputs), &mut d_constant, wide, false);
        d_constant
    }

    fn encoder_back(&mut self, p: &Ready, g: &mut PredictorWeights, batch: &Batch, d_mu: &[f32], d_logvar: &[f32], mut d_hx: Vec<f32>) {
        let w = p.w;
        let (h, rows) = (w.d_rnn.hidden, batch.rows);
        dense_grad(&mut g.e_mu, d_mu, &self.e[1]);
        dense_grad(&mut g.e_logvar, d_logvar, &self.e[1]);
        let mut d1 = vec![0.0; rows * h];
        dense_back(&w.e_mu, d_mu, &mut d1, false);
        dense_back(&w.e_logvar, d_logvar, &mut d1, true);
        tanh_back(&self.e[1], &mut d1);
        dense_grad(&mut g.e_mlp[1], &d1, &self.e[0]);
        let mut d0 = vec![0.0; rows * w.e_mlp[0].output];
        dense_back(&w.e_mlp[1], &d1, &mut d0, false);
        tanh_back(&self.e[0], &mut d0);
        dense_grad(&mut g.e_mlp[0], &d0, &self.encoded);
        let mut d = vec![0.0; rows * 2 * h];
        dense_back(&w.e_mlp[0], &d0, &mut d, false);
        let mut d_hy = vec![0.0; rows * h];
        for (i, row) in d.chunks_exact(2 * h).enumerate() {
            add_rows(&row[..h], &mut d_hx[i * h..(i + 1) * h]);
            d_hy[i * h..(i + 1) * h].copy_from_slice(&row[h..]);
        }
        self.y.run_back(&p.e_rnn, &mut g.e_rnn, batch.future(), rows, &mut d_hy);
        self.x.run_back(&p.x_enc, &mut g.x_enc, &batch.seed, rows, &mut d_hx);
    }
}

/// One batch of primitives, time outermost.
#[derive(Clone, Default)]
pub struct Batch {
    pub rows: usize,
    /// 2 x rows x frame: what the model is given.
    pub seed: Vec<f32>,
    /// (1 + steps) x rows x frame: the true last seed frame, then the true future.
    pub target: Vec<f32>,
    /// rows x latent: standard normal noise.
    pub eps: Vec<f32>,
}

impl Batch {
    /// The true future, steps x rows x frame.
    pub fn future(&self) -> &[f32] {
        &self.target[self.seed.len() / 2..]
    }
}
