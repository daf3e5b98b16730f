//! The policy's forward and backward passes on plain slices, for learning on the processor: several times faster than burn's
//! autodiff there, which the tests compare with. Rows are people; frames of a sequence are outermost.

mod gru;
mod head;

use egogen::agent::{Dense, Encoder, Part, PolicySpec};
use egogen::kernels::{self, Activation, Mat, product};
use gru::Gru;
use head::Chain;
pub use head::Head;
use rayon::prelude::*;

/// Outputs of a layer whose weights one thread works on at a time.
const OUTPUTS: usize = 384;
/// Products smaller than this, multiplications, are not worth a second thread.
const SMALL: usize = 1 << 21;

/// What both heads see of some people, and all that its backward pass needs.
pub struct Stem<'a> {
    spec: &'a PolicySpec,
    flat: &'a [f32],
    /// One per encoder; `None` where it is no GRU.
    grus: Vec<Option<Gru>>,
    /// rows x E: what the projection saw, if there is one.
    encoded: Vec<f32>,
    shared: Chain,
    /// rows x W.
    pub trunk: Vec<f32>,
}

impl<'a> Stem<'a> {
    /// Runs the encoders with parameters `flat` on observation rows (n x layout.dim()).
    pub fn forward(spec: &'a PolicySpec, flat: &'a [f32], obs: &[f32]) -> Self {
        let (dim, width) = (spec.layout.dim(), spec.encoded());
        let rows = obs.len() / dim;
        let obs = &*spec.normalised(&flat[spec.obs_norm_range()], obs);
        let mut encoded = vec![0.0; rows * width];
        let (mut grus, mut at) = (vec![], 0);
        for encoder in &spec.encoders {
            let gru = Gru::of(spec, flat, encoder, obs);
            let mut states = gru.iter().flat_map(Gru::last);
            for (out, obs) in encoded.chunks_exact_mut(width).zip(obs.chunks_exact(dim)) {
                encode(spec, encoder, states.next(), &obs[encoder.start..], &mut out[at..at + encoder.output]);
            }
            drop(states);
            grus.push(gru);
            at += encoder.output;
        }
        let trunk = match spec.project {
            Some(i) => dense(&spec.layers[i], flat, &encoded, Activation::None),
            None => std::mem::take(&mut encoded),
        };
        let (shared, trunk) = Chain::forward(spec, flat, &spec.shared, trunk);
        Self { spec, flat, grus, encoded, shared, trunk }
    }

    /// What every layer learns from the gradient of [`Stem::trunk`].
    pub fn backward(self, d: Vec<f32>) -> Vec<Delta> {
        let (spec, flat, mut out) = (self.spec, self.flat, vec![]);
        let mut d = self.shared.backward(spec, flat, &spec.shared, &self.trunk, d, &mut out);
        if let Some(layer) = spec.project {
            let before = dense_back(&spec.layers[layer], flat, &d);
            out.push(Delta { layer, x: self.encoded, dy: std::mem::replace(&mut d, before) });
        }
        let mut at = 0;
        for (encoder, gru) in spec.encoders.iter().zip(self.grus) {
            if let (Some(gru), Part::Gru { ih, hh, .. }) = (gru, &encoder.part) {
                let mut columns = Vec::with_capacity(d.len() / spec.encoded() * encoder.output);
                d.chunks_exact(spec.encoded()).for_each(|row| columns.extend_from_slice(&row[at..at + encoder.output]));
                out.extend(gru.backward(spec, flat, [*ih, *hh], columns));
            }
            at += encoder.output;
        }
        out
    }
}

/// What a layer learns from.
pub struct Delta {
    layer: usize,
    /// rows x input: what it saw.
    x: Vec<f32>,
    /// rows x output: the gradient of what it said. Rows before those of `x` saw zeros.
    dy: Vec<f32>,
}

/// Writes the gradients of all layers' weights and biases to `grads`, in the flat layout: the sums over `deltas` of a batch of `rows`.
///
/// Every number is summed by one thread over the deltas in their order.
pub fn weigh(spec: &PolicySpec, rows: usize, deltas: &[Delta], grads: &mut [f32]) {
    let (mut pieces, mut rest, mut at) = (vec![], grads, 0);
    for (i, layer) in spec.layers.iter().enumerate() {
        let (own, behind) = rest[layer.offset - at..].split_at_mut(layer.params());
        (rest, at) = (behind, layer.offset + layer.params());
        let (weight, bias) = own.split_at_mut(layer.output * layer.input);
        let chunks = weight.chunks_mut(OUTPUTS * layer.input).zip(bias.chunks_mut(OUTPUTS));
        pieces.extend(chunks.enumerate().map(|(k, (weight, bias))| (i, k * OUTPUTS, weight, bias)));
    }
    let work = |(i, first, weight, bias): (usize, usize, &mut [f32], &mut [f32])| {
        let (layer, seen) = (&spec.layers[i], deltas.iter().filter(|d| d.layer == i));
        bias.fill(0.0);
        for (k, delta) in seen.enumerate() {
            weigh_piece(layer, first, delta, weight, k > 0);
            for row in delta.dy.chunks_exact(layer.output) {
                bias.iter_mut().zip(&row[first..]).for_each(|(b, d)| *b += d);
            }
        }
    };
    match rows * spec.params() < SMALL {
        true => pieces.into_iter().for_each(work),
        false => pieces.into_par_iter().for_each(work),
    }
}

/// dW = dy^T x, or dW += dy^T x if `add`, for some outputs from `first` on.
fn weigh_piece(layer: &Dense, first: usize, delta: &Delta, weight: &mut [f32], add: bool) {
    let rows = delta.x.len() / layer.input;
    if rows == 0 {
        // A GRU over one frame, whose state is zero.
        return weight.fill(0.0);
    }
    let dy = &delta.dy[delta.dy.len() - rows * layer.output..];
    let dy = Mat::strided(&dy[first..], rows, weight.len() / layer.input, layer.output);
    product(dy.t(), rows_of(&delta.x, layer.input), weight, layer.input, add);
}

/// One person's encoding; `state` is the GRU's last, `obs` starts at the group.
fn encode(spec: &PolicySpec, encoder: &Encoder, state: Option<&[f32]>, obs: &[f32], out: &mut [f32]) {
    match (&encoder.part, state) {
        (Part::Sine, _) => {
            let mut waves = Vec::with_capacity(out.len());
            spec.sine(obs[0], &mut waves);
            out.copy_from_slice(&waves);
        }
        (_, Some(state)) => out.copy_from_slice(state),
        _ => out.copy_from_slice(&obs[..out.len()]),
    }
}

fn rows_of(data: &[f32], width: usize) -> Mat<'_> {
    Mat::new(data, data.len() / width, width)
}

fn weight<'a>(layer: &Dense, flat: &'a [f32]) -> Mat<'a> {
    Mat::new(layer.weight_of(flat), layer.output, layer.input)
}

/// y = f(x W^T + b).
fn dense(layer: &Dense, flat: &[f32], x: &[f32], activation: Activation) -> Vec<f32> {
    let mut y = vec![0.0; x.len() / layer.input * layer.output];
    kernels::dense(rows_of(x, layer.input), weight(layer, flat), layer.bias_of(flat), activation, &mut y);
    y
}

/// dx = dy W.
fn dense_back(layer: &Dense, flat: &[f32], dy: &[f32]) -> Vec<f32> {
    let mut dx = vec![0.0; dy.len() / layer.output * layer.input];
    product(rows_of(dy, layer.output), weight(layer, flat), &mut dx, layer.input, false);
    dx
}
