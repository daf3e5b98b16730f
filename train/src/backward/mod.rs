//! The policy's forward and backward passes on plain slices, for learning on the processor: several times faster than burn's
//! autodiff there, which the tests compare with. Rows are people; frames of a sequence are outermost.

mod gru;
mod head;

use crate::primitives::layers::{add_rows, fill_rows};
use egogen::agent::{Dense, Encoder, Part, PolicySpec};
use egogen::kernels::{Mat, product};
use gru::Gru;
use head::{Chain, Head};

/// What the network said of some observations, and all that its backward pass needs.
pub struct Tape<'a> {
    spec: &'a PolicySpec,
    flat: &'a [f32],
    /// One per encoder; `None` where it is no GRU.
    grus: Vec<Option<Gru>>,
    encoded: Vec<f32>,
    shared: Chain,
    /// rows x W: what the heads see.
    trunk: Vec<f32>,
    actor: Head,
    critic: Head,
}

impl<'a> Tape<'a> {
    /// Runs the network with parameters `flat` on observation rows (n x layout.dim()).
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
            Some(i) => dense(&spec.layers[i], flat, &encoded),
            None => encoded.clone(),
        };
        let (shared, trunk) = Chain::forward(spec, flat, &spec.shared, trunk);
        let head = |layers: &[usize]| Head::forward(spec, flat, layers, trunk.clone());
        let (actor, critic) = (head(&spec.actor), head(&spec.critic));
        Self { spec, flat, grus, encoded, shared, trunk, actor, critic }
    }

    /// rows x `spec.outputs()`: means and log variances before the clamp, means alone, or logits.
    pub fn action(&self) -> &[f32] {
        &self.actor.out
    }

    /// rows x `spec.latent()`: the actor's last hidden activations.
    pub fn latent(&self) -> &[f32] {
        self.actor.latent()
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
        d = self.shared.backward(spec, flat, &spec.shared, &self.trunk, d, &mut grad);
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
