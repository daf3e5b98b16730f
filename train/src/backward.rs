//! The policy's forward and backward passes on plain slices, for learning on the processor: several times faster than burn's
//! autodiff there, which the tests compare with. Rows are people; frames of a sequence are outermost.

use crate::primitives::layers::{add_rows, fill_rows};
use egogen::agent::{Dense, Encoder, Part, PolicySpec, SLOPE};
use egogen::kernels::{Activation, Mat, product};

/// What the network said of some observations, and all that its backward pass needs.
pub struct Tape<'a> {
    spec: &'a PolicySpec,
    flat: &'a [f32],
    /// One per encoder; `None` where it is no GRU.
    grus: Vec<Option<Gru>>,
    encoded: Vec<f32>,
    actor: Head,
    critic: Head,
}

/// A GRU run from the zero state: r, z = s(x W + b + h U + c), n = tanh(x W + b + r (h U + c)), h' = n + z (h - n).
struct Gru {
    rows: usize,
    hidden: usize,
    /// frames x rows x width.
    x: Vec<f32>,
    /// frames x rows x 4H: r, z, n, and the state's share of n's input.
    gates: Vec<f32>,
    /// frames x rows x H: the state after each frame.
    states: Vec<f32>,
}

/// A residual network's activations.
struct Head {
    /// rows x W: the input of each block, then that of the output layer.
    inputs: Vec<Vec<f32>>,
    /// rows x W: both layers of each block, after the leaky ReLU.
    inner: Vec<[Vec<f32>; 2]>,
    out: Vec<f32>,
}

impl<'a> Tape<'a> {
    /// Runs the network with parameters `flat` on observation rows (n x layout.dim()).
    pub fn forward(spec: &'a PolicySpec, flat: &'a [f32], obs: &[f32]) -> Self {
        let (dim, width) = (spec.layout.dim(), spec.encoded());
        let rows = obs.len() / dim;
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
            Some(i) => dense(&spec.layers[i], flat, &encoded),
            None => encoded.clone(),
        };
        let (actor, critic) = (Head::forward(spec, flat, &spec.actor, trunk.clone()), Head::forward(spec, flat, &spec.critic, trunk));
        Self { spec, flat, grus, encoded, actor, critic }
    }

    /// rows x 2A: means, then log variances before the clamp.
    pub fn action(&self) -> &[f32] {
        &self.actor.out
    }

    /// rows values.
    pub fn value(&self) -> &[f32] {
        &self.critic.out
    }

    /// Gradients of all parameters, in the flat layout, from those of [`Tape::action`] and [`Tape::value`].
    pub fn backward(&self, action: Vec<f32>, value: Vec<f32>) -> Vec<f32> {
        let (spec, flat) = (self.spec, self.flat);
        let mut grad = vec![0.0; spec.params()];
        let mut d = self.actor.backward(spec, flat, &spec.actor, action, &mut grad);
        let critic = self.critic.backward(spec, flat, &spec.critic, value, &mut grad);
        d.iter_mut().zip(critic).for_each(|(a, c)| *a += c);
        if let Some(i) = spec.project {
            dense_grad(&spec.layers[i], &d, &self.encoded, &mut grad);
            d = dense_back(&spec.layers[i], flat, &d);
        }
        let mut at = 0;
        for (encoder, gru) in spec.encoders.iter().zip(&self.grus) {
            if let (Some(gru), Part::Gru { ih, hh, .. }) = (gru, &encoder.part) {
                let columns = d.chunks_exact(spec.encoded()).flat_map(|row| &row[at..at + encoder.output]);
                gru.backward(&spec.layers[*ih], &spec.layers[*hh], flat, columns.copied().collect(), &mut grad);
            }
            at += encoder.output;
        }
        grad
    }
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

impl Head {
    fn forward(spec: &PolicySpec, flat: &[f32], layers: &[usize], trunk: Vec<f32>) -> Self {
        let (blocks, last) = layers.split_at(layers.len() - 1);
        let (mut inputs, mut inner) = (vec![trunk], vec![]);
        for pair in blocks.chunks_exact(2) {
            let h = &inputs[inputs.len() - 1];
            let first = leaky(dense(&spec.layers[pair[0]], flat, h));
            let second = leaky(dense(&spec.layers[pair[1]], flat, &first));
            let next = h.iter().zip(&second).map(|(h, s)| h + s).collect();
            inputs.push(next);
            inner.push([first, second]);
        }
        let out = dense(&spec.layers[last[0]], flat, &inputs[inputs.len() - 1]);
        Self { inputs, inner, out }
    }

    /// From the gradient of the output to that of the trunk.
    fn backward(&self, spec: &PolicySpec, flat: &[f32], layers: &[usize], d: Vec<f32>, grad: &mut [f32]) -> Vec<f32> {
        let (blocks, last) = layers.split_at(layers.len() - 1);
        let last = &spec.layers[last[0]];
        dense_grad(last, &d, &self.inputs[self.inputs.len() - 1], grad);
        let mut d = dense_back(last, flat, &d);
        for ((pair, h), [first, second]) in blocks.chunks_exact(2).zip(&self.inputs).zip(&self.inner).rev() {
            let (a, b) = (&spec.layers[pair[0]], &spec.layers[pair[1]]);
            let mut inner = d.clone();
            leaky_back(second, &mut inner);
            dense_grad(b, &inner, first, grad);
            inner = dense_back(b, flat, &inner);
            leaky_back(first, &mut inner);
            dense_grad(a, &inner, h, grad);
            product(rows_of(&inner, a.output), weight(a, flat), &mut d, a.input, true);
        }
        d
    }
}

impl Gru {
    fn of(spec: &PolicySpec, flat: &[f32], encoder: &Encoder, obs: &[f32]) -> Option<Self> {
        let Part::Gru { frames, width, ih, hh } = encoder.part else { return None };
        let dim = spec.layout.dim();
        let frame = |t: usize| {
            let at = encoder.start + t * width;
            obs.chunks_exact(dim).flat_map(move |row| &row[at..at + width])
        };
        let x: Vec<f32> = (0..frames).flat_map(frame).copied().collect();
        let (rows, hidden) = (obs.len() / dim, encoder.output);
        let n = rows * hidden;
        let input = dense(&spec.layers[ih], flat, &x);
        let mut gru = Self { rows, hidden, x, gates: vec![0.0; frames * 4 * n], states: vec![0.0; frames * n] };
        for t in 0..frames {
            let (past, states) = gru.states.split_at_mut(t * n);
            // The first state is zero: its share is the bias alone.
            let (before, share) = match t {
                0 => (vec![0.0; n], spec.layers[hh].bias_of(flat).repeat(rows)),
                _ => (past[(t - 1) * n..].to_vec(), dense(&spec.layers[hh], flat, &past[(t - 1) * n..])),
            };
            let people = input[t * 3 * n..].chunks_exact(3 * hidden).zip(share.chunks_exact(3 * hidden));
            let states = before.chunks_exact(hidden).zip(states.chunks_exact_mut(hidden));
            let gates = gru.gates[t * 4 * n..].chunks_exact_mut(4 * hidden);
            for (((input, share), (before, after)), gates) in people.zip(states).zip(gates) {
                step(input, share, before, gates, after);
            }
        }
        Some(gru)
    }

    /// Each person's last state.
    fn last(&self) -> impl Iterator<Item = &[f32]> {
        self.states[self.states.len() - self.rows * self.hidden..].chunks_exact(self.hidden)
    }

    /// Adds to `grad` from `d`, the gradient of the last state.
    fn backward(&self, ih: &Dense, hh: &Dense, flat: &[f32], mut d: Vec<f32>, grad: &mut [f32]) {
        let (h, n) = (self.hidden, self.rows * self.hidden);
        let mut input = vec![0.0; self.gates.len() / 4 * 3];
        let mut share = input.clone();
        for t in (0..self.states.len() / n).rev() {
            let before = if t > 0 { &self.states[(t - 1) * n..t * n] } else { &[] };
            let people = self.gates[t * 4 * n..].chunks_exact(4 * h).zip(d.chunks_exact_mut(h));
            let out = input[t * 3 * n..].chunks_exact_mut(3 * h).zip(share[t * 3 * n..].chunks_exact_mut(3 * h));
            for (i, ((gates, d), (input, share))) in people.zip(out).enumerate() {
                step_back(gates, before.get(i * h..(i + 1) * h), d, input, share);
            }
            if t > 0 {
                product(rows_of(&share[t * 3 * n..(t + 1) * 3 * n], 3 * h), weight(hh, flat), &mut d, h, true);
            }
        }
        dense_grad(ih, &input, &self.x, grad);
        // Only later frames have a state before them; the bias acts in all.
        let (weight, bias) = parts_mut(hh, grad);
        let later = &share[3 * n..];
        product(rows_of(later, 3 * h).t(), rows_of(&self.states[..later.len() / 3], h), weight, h, true);
        add_rows(&share, bias);
    }
}

/// One person's gates (r, z, n and the state's share of n) and next state.
fn step(input: &[f32], share: &[f32], before: &[f32], gates: &mut [f32], after: &mut [f32]) {
    let h = after.len();
    let (rz, rest) = gates.split_at_mut(2 * h);
    let (new, kept) = rest.split_at_mut(h);
    rz.iter_mut().zip(input).zip(share).for_each(|((g, i), s)| *g = i + s);
    Activation::Sigmoid.apply(rz);
    kept.copy_from_slice(&share[2 * h..]);
    for k in 0..h {
        new[k] = input[2 * h + k] + rz[k] * kept[k];
    }
    Activation::Tanh.apply(new);
    for k in 0..h {
        after[k] = new[k] + rz[h + k] * (before[k] - new[k]);
    }
}

/// Turns `d` from the gradient of the state after into that of the state before, but for the way through the share; writes the
/// gradients of both shares of the gates. `before` is `None` for zeros.
fn step_back(gates: &[f32], before: Option<&[f32]>, d: &mut [f32], input: &mut [f32], share: &mut [f32]) {
    let h = d.len();
    for k in 0..h {
        let (r, z, new, kept) = (gates[k], gates[h + k], gates[2 * h + k], gates[3 * h + k]);
        let before = before.map_or(0.0, |b| b[k]);
        let dn = d[k] * (1.0 - z) * (1.0 - new * new);
        input[k] = dn * kept * r * (1.0 - r);
        input[h + k] = d[k] * (before - new) * z * (1.0 - z);
        input[2 * h + k] = dn;
        share[2 * h + k] = dn * r;
        d[k] *= z;
    }
    share[..2 * h].copy_from_slice(&input[..2 * h]);
}

fn rows_of(data: &[f32], width: usize) -> Mat<'_> {
    Mat::new(data, data.len() / width, width)
}

fn weight<'a>(layer: &Dense, flat: &'a [f32]) -> Mat<'a> {
    Mat::new(layer.weight_of(flat), layer.output, layer.input)
}

/// Weight and bias of a layer within the flat vector.
fn parts_mut<'a>(layer: &Dense, flat: &'a mut [f32]) -> (&'a mut [f32], &'a mut [f32]) {
    flat[layer.offset..layer.offset + layer.params()].split_at_mut(layer.output * layer.input)
}

/// y = x W^T + b.
fn dense(layer: &Dense, flat: &[f32], x: &[f32]) -> Vec<f32> {
    let mut y = vec![0.0; x.len() / layer.input * layer.output];
    fill_rows(layer.bias_of(flat), &mut y);
    product(rows_of(x, layer.input), weight(layer, flat).t(), &mut y, layer.output, true);
    y
}

/// dx = dy W.
fn dense_back(layer: &Dense, flat: &[f32], dy: &[f32]) -> Vec<f32> {
    let mut dx = vec![0.0; dy.len() / layer.output * layer.input];
    product(rows_of(dy, layer.output), weight(layer, flat), &mut dx, layer.input, false);
    dx
}

/// dW = dy^T x, db = the sum of dy over rows.
fn dense_grad(layer: &Dense, dy: &[f32], x: &[f32], grad: &mut [f32]) {
    let (weight, bias) = parts_mut(layer, grad);
    product(rows_of(dy, layer.output).t(), rows_of(x, layer.input), weight, layer.input, false);
    add_rows(dy, bias);
}

fn leaky(mut x: Vec<f32>) -> Vec<f32> {
    x.iter_mut().for_each(|v| *v = v.max(SLOPE * *v));
    x
}

/// From gradients of the activations `y` to those of their inputs; y has the sign of its input.
fn leaky_back(y: &[f32], d: &mut [f32]) {
    d.iter_mut().zip(y).for_each(|(d, &y)| *d *= if y > 0.0 { 1.0 } else { SLOPE });
}
