//! Dense and GRU layers with hand-written backward passes. Rows are people; time, where there is any, is outermost.
//!
//! Weight gradients of a layer used at every frame are taken once, as one product over all frames and people: several times
//! less work than an autodiff graph over the frames, which the tests compare with.

use egogen::Result;
use egogen::kernels::{self, Activation, Linear, Mat, Source, View, ViewMut, product};
use egogen::motion::{Dense, Gru};

/// Applies tanh to every value.
pub fn tanh(values: &mut [f32]) {
    Activation::Tanh.apply(values);
}

/// Turns gradients with respect to tanh's outputs `y` into gradients with respect to its inputs.
pub fn tanh_back(y: &[f32], d: &mut [f32]) {
    for (d, y) in d.iter_mut().zip(y) {
        *d *= 1.0 - y * y;
    }
}

/// Sets every row of `y` to `row`.
pub fn fill_rows(row: &[f32], y: &mut [f32]) {
    for chunk in y.chunks_exact_mut(row.len()) {
        chunk.copy_from_slice(row);
    }
}

/// Adds the rows of `d` into `sum`.
pub fn add_rows(d: &[f32], sum: &mut [f32]) {
    for row in d.chunks_exact(sum.len()) {
        for (s, v) in sum.iter_mut().zip(row) {
            *s += v;
        }
    }
}

/// y = x W^T + b for all rows of `x`; `y` is resized.
pub fn dense(layer: &Dense, x: &[f32], y: &mut Vec<f32>) {
    let rows = x.len() / layer.input;
    y.resize(rows * layer.output, 0.0);
    dense_into(layer, x, y);
}

/// y = x W^T + b into `y`.
pub fn dense_into(layer: &Dense, x: &[f32], y: &mut [f32]) {
    let rows = x.len() / layer.input;
    let weight = Mat::new(&layer.weight, layer.output, layer.input);
    kernels::dense(Mat::new(x, rows, layer.input), weight, &layer.bias, Activation::None, y);
}

/// dx = dy W, or dx += dy W if `add`.
pub fn dense_back(layer: &Dense, dy: &[f32], dx: &mut [f32], add: bool) {
    let rows = dy.len() / layer.output;
    product(Mat::new(dy, rows, layer.output), Mat::new(&layer.weight, layer.output, layer.input), dx, layer.input, add);
}

/// Adds the weight gradients dW += dy^T x, db += sum of dy.
pub fn dense_grad(grad: &mut Dense, dy: &[f32], x: &[f32]) {
    let rows = dy.len() / grad.output;
    product(Mat::new(dy, rows, grad.output).t(), Mat::new(x, rows, grad.input), &mut grad.weight, grad.input, true);
    add_rows(dy, &mut grad.bias);
}

/// A product used at every frame, packed once per update for both directions.
pub struct Packed {
    forward: Linear,
    backward: Linear,
}

impl Packed {
    /// y = x W^T + b with the columns `first..first + width` of `weight` (rows of `stride`).
    pub fn new(weight: &[f32], bias: &[f32], stride: usize, first: usize, width: usize) -> Result<Self> {
        let rows = weight.len() / stride;
        let mut transposed = vec![0.0; rows * width];
        for (o, row) in weight.chunks_exact(stride).enumerate() {
            for (i, w) in row[first..first + width].iter().enumerate() {
                transposed[i * rows + o] = *w;
            }
        }
        Ok(Self {
            forward: Linear::from_columns(weight, bias, stride, first..first + width)?,
            backward: Linear::new(&transposed, &[], rows)?,
        })
    }

    pub fn dense(layer: &Dense) -> Result<Self> {
        Self::new(&layer.weight, &layer.bias, layer.input, 0, layer.input)
    }

    /// The state's part of a GRU.
    pub fn hidden(gru: &Gru) -> Result<Self> {
        Self::new(&gru.weight_hh, &gru.bias_hh, gru.hidden, 0, gru.hidden)
    }

    /// y = f(x W^T + b), or y += that.
    pub fn apply(&self, x: &[f32], y: &mut [f32], add: bool, activation: Activation) {
        run(&self.forward, x, y, add, activation);
    }

    /// dx = dy W, or dx += dy W.
    pub fn back(&self, dy: &[f32], dx: &mut [f32], add: bool) {
        run(&self.backward, dy, dx, add, Activation::None);
    }
}

fn run(layer: &Linear, x: &[f32], y: &mut [f32], add: bool, activation: Activation) {
    let source = if add { Source::Residual } else { Source::Fresh };
    let rows = x.len() / layer.inputs();
    layer.forward(rows, View::new(x, layer.inputs()), ViewMut::new(y, layer.outputs()), source, activation);
}

/// What a GRU keeps of `steps` steps of `rows` people for its backward pass.
#[derive(Default)]
pub struct GruTape {
    /// steps x rows x 4 H: r, z, n and the hidden state's share of n's input.
    gates: Vec<f32>,
    /// (steps + 1) x rows x H; the first is the initial state.
    pub states: Vec<f32>,
    /// steps x rows x 3 H: the input's share of the gates (forward), its gradient (backward).
    pub input: Vec<f32>,
    /// steps x rows x 3 H: gradient of the state's share of the gates; in the forward pass, room.
    pub hidden: Vec<f32>,
}

impl GruTape {
    /// Makes room; the initial state is left for the caller to set.
    pub fn reset(&mut self, h: usize, rows: usize, steps: usize) {
        self.gates.resize(steps * rows * 4 * h, 0.0);
        self.states.resize((steps + 1) * rows * h, 0.0);
        self.input.resize(steps * rows * 3 * h, 0.0);
        self.hidden.resize(steps * rows * 3 * h, 0.0);
    }

    /// Step `t` of `rows` people. `self.input` at `t` must hold W x + b.
    pub fn step(&mut self, weights: &Packed, rows: usize, t: usize) {
        let h = weights.forward.inputs();
        let n = rows * h;
        let (before, after) = self.states.split_at_mut((t + 1) * n);
        let before = &before[t * n..];
        let hidden = &mut self.hidden[t * 3 * n..(t + 1) * 3 * n];
        weights.apply(before, hidden, false, Activation::None);
        let input = &self.input[t * 3 * n..(t + 1) * 3 * n];
        let gates = &mut self.gates[t * 4 * n..(t + 1) * 4 * n];
        for (i, gates) in gates.chunks_exact_mut(4 * h).enumerate() {
            let (input, hidden) = (&input[i * 3 * h..(i + 1) * 3 * h], &hidden[i * 3 * h..(i + 1) * 3 * h]);
            let (rz, rest) = gates.split_at_mut(2 * h);
            let (new, share) = rest.split_at_mut(h);
            share.copy_from_slice(&hidden[2 * h..]);
            for (k, v) in rz.iter_mut().enumerate() {
                *v = input[k] + hidden[k];
            }
            Activation::Sigmoid.apply(rz);
            for (k, v) in new.iter_mut().enumerate() {
                *v = input[2 * h + k] + rz[k] * share[k];
            }
            tanh(new);
            let (before, after) = (&before[i * h..(i + 1) * h], &mut after[i * h..(i + 1) * h]);
            for k in 0..h {
                after[k] = new[k] + rz[h + k] * (before[k] - new[k]);
            }
        }
    }

    /// Backward through step `t`: `d` (rows x H) goes from the gradient of the state after to that of the state before.
    /// Leaves the gradients of both shares of the gates in `input` and `hidden` at `t`.
    pub fn step_back(&mut self, weights: &Packed, rows: usize, t: usize, d: &mut [f32]) {
        let h = weights.forward.inputs();
        let n = rows * h;
        let before = &self.states[t * n..(t + 1) * n];
        let gates = &self.gates[t * 4 * n..(t + 1) * 4 * n];
        let input = &mut self.input[t * 3 * n..(t + 1) * 3 * n];
        let hidden = &mut self.hidden[t * 3 * n..(t + 1) * 3 * n];
        for (i, d) in d.chunks_exact_mut(h).enumerate() {
            let gates = &gates[i * 4 * h..(i + 1) * 4 * h];
            let (r, z, new, share) = (&gates[..h], &gates[h..2 * h], &gates[2 * h..3 * h], &gates[3 * h..]);
            let (dr, rest) = input[i * 3 * h..(i + 1) * 3 * h].split_at_mut(h);
            let (dz, dn) = rest.split_at_mut(h);
            let before = &before[i * h..(i + 1) * h];
            let dhn = &mut hidden[i * 3 * h..(i + 1) * 3 * h];
            for k in 0..h {
                dn[k] = d[k] * (1.0 - z[k]) * (1.0 - new[k] * new[k]);
                dz[k] = d[k] * (before[k] - new[k]) * z[k] * (1.0 - z[k]);
                dr[k] = dn[k] * share[k] * r[k] * (1.0 - r[k]);
                dhn[2 * h + k] = dn[k] * r[k];
                d[k] *= z[k];
            }
            dhn[..h].copy_from_slice(dr);
            dhn[h..2 * h].copy_from_slice(dz);
        }
        weights.back(hidden, d, true);
    }

    /// Adds the gradients of the state's weights over all steps.
    pub fn hidden_grad(&self, grad: &mut Gru, rows: usize, steps: usize) {
        let h = grad.hidden;
        let before = Mat::new(&self.states[..steps * rows * h], steps * rows, h);
        product(Mat::new(&self.hidden, steps * rows, 3 * h).t(), before, &mut grad.weight_hh, h, true);
        add_rows(&self.hidden, &mut grad.bias_hh);
    }

    /// Runs a whole sequence `x` (steps x rows x I) from the zero state; returns the last state.
    pub fn run(&mut self, gru: &Gru, packed: &Packed, x: &[f32], rows: usize) -> &[f32] {
        let (h, steps) = (gru.hidden, x.len() / (rows * gru.input));
        self.reset(h, rows, steps);
        self.states[..rows * h].fill(0.0);
        let weight = Mat::new(&gru.weight_ih, 3 * h, gru.input);
        kernels::dense(Mat::new(x, steps * rows, gru.input), weight, &gru.bias_ih, Activation::None, &mut self.input);
        for t in 0..steps {
            self.step(packed, rows, t);
        }
        &self.states[steps * rows * h..]
    }

    /// Backward through [`GruTape::run`]; `d` is the gradient of the last state and is used up.
    pub fn run_back(&mut self, packed: &Packed, grad: &mut Gru, x: &[f32], rows: usize, d: &mut [f32]) {
        let (h, width) = (grad.hidden, grad.input);
        let steps = x.len() / (rows * width);
        for t in (0..steps).rev() {
            self.step_back(packed, rows, t, d);
        }
        self.hidden_grad(grad, rows, steps);
        let x = Mat::new(x, steps * rows, width);
        product(Mat::new(&self.input, steps * rows, 3 * h).t(), x, &mut grad.weight_ih, width, true);
        add_rows(&self.input, &mut grad.bias_ih);
    }
}
