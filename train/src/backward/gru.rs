//! The GRU over a sequence group and its backward pass through time.

use super::{Delta, dense, rows_of, weight};
use egogen::agent::{Encoder, Part, PolicySpec};
use egogen::kernels::{Activation, product};

/// A GRU run from the zero state: r, z = s(x W + b + h U + c), n = tanh(x W + b + r (h U + c)), h' = n + z (h - n).
pub(super) struct Gru {
    rows: usize,
    hidden: usize,
    /// frames x rows x width.
    x: Vec<f32>,
    /// frames x rows x 4H: r, z, n, and the state's share of n's input.
    gates: Vec<f32>,
    /// frames x rows x H: the state after each frame.
    states: Vec<f32>,
}

impl Gru {
    pub fn of(spec: &PolicySpec, flat: &[f32], encoder: &Encoder, obs: &[f32]) -> Option<Self> {
        let Part::Gru { frames, width, ih, hh } = encoder.part else { return None };
        let dim = spec.layout.dim();
        let (rows, hidden) = (obs.len() / dim, encoder.output);
        let mut x = Vec::with_capacity(frames * rows * width);
        for at in (0..frames).map(|t| encoder.start + t * width) {
            obs.chunks_exact(dim).for_each(|row| x.extend_from_slice(&row[at..at + width]));
        }
        let n = rows * hidden;
        let input = dense(&spec.layers[ih], flat, &x, Activation::None);
        let mut gru = Self { rows, hidden, x, gates: vec![0.0; frames * 4 * n], states: vec![0.0; frames * n] };
        for t in 0..frames {
            let (past, states) = gru.states.split_at_mut(t * n);
            // The first state is zero: its share is the bias alone.
            let (before, share) = match t {
                0 => (vec![0.0; n], spec.layers[hh].bias_of(flat).repeat(rows)),
                _ => (past[(t - 1) * n..].to_vec(), dense(&spec.layers[hh], flat, &past[(t - 1) * n..], Activation::None)),
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
    pub fn last(&self) -> impl Iterator<Item = &[f32]> {
        self.states[self.states.len() - self.rows * self.hidden..].chunks_exact(self.hidden)
    }

    /// What the layers `ih` and `hh` learn from `d`, the gradient of the last state.
    pub fn backward(mut self, spec: &PolicySpec, flat: &[f32], [ih, hh]: [usize; 2], mut d: Vec<f32>) -> [Delta; 2] {
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
                product(rows_of(&share[t * 3 * n..(t + 1) * 3 * n], 3 * h), weight(&spec.layers[hh], flat), &mut d, h, true);
            }
        }
        // Only later frames have a state before them; the bias acts in all.
        self.states.truncate(self.states.len() - n);
        [Delta { layer: ih, x: self.x, dy: input }, Delta { layer: hh, x: self.states, dy: share }]
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
