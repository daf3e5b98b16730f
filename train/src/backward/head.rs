//! Actor and critic behind the encodings, forwards and backwards.

use super::{Delta, dense, dense_back, rows_of, weight};
use egogen::agent::{Nonlinearity, PolicySpec, SLOPE};
use egogen::kernels::{Activation, product};

/// Activations of plain layers in a row, each followed by the policy's nonlinearity.
pub(super) struct Chain {
    /// rows x W: the input of each layer; the last layer's activations go on to whoever comes next.
    inputs: Vec<Vec<f32>>,
}

impl Chain {
    /// Also gives what the last layer says.
    pub fn forward(spec: &PolicySpec, flat: &[f32], layers: &[usize], mut h: Vec<f32>) -> (Self, Vec<f32>) {
        let activation = match spec.config.activation {
            Nonlinearity::Tanh => Activation::Tanh,
            Nonlinearity::Relu => Activation::Relu,
        };
        let mut inputs = vec![];
        for &layer in layers {
            let next = dense(&spec.layers[layer], flat, &h, activation);
            inputs.push(std::mem::replace(&mut h, next));
        }
        (Self { inputs }, h)
    }

    /// From the gradient of the last layer's activations `y` to that of the first one's input.
    pub fn backward(self, spec: &PolicySpec, flat: &[f32], layers: &[usize], y: &[f32], mut d: Vec<f32>, out: &mut Vec<Delta>) -> Vec<f32> {
        let last = out.len();
        for (&layer, x) in layers.iter().zip(self.inputs).rev() {
            // What a layer said is what the next one saw.
            let y = out[last..].last().map_or(y, |next| &next.x);
            match spec.config.activation {
                Nonlinearity::Tanh => d.iter_mut().zip(y).for_each(|(d, y)| *d *= 1.0 - y * y),
                Nonlinearity::Relu => d.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > 0.0 { *d } else { 0.0 }),
            }
            let before = dense_back(&spec.layers[layer], flat, &d);
            out.push(Delta { layer, x, dy: std::mem::replace(&mut d, before) });
        }
        d
    }
}

/// Activations of an actor or critic: residual blocks or plain layers, then the output layer.
pub struct Head {
    plain: Chain,
    /// rows x W: the input of each block, then that of the output layer.
    inputs: Vec<Vec<f32>>,
    /// rows x W: both layers of each block, after the leaky ReLU.
    inner: Vec<[Vec<f32>; 2]>,
    /// rows x outputs: means and log variances before the clamp, means alone, logits, or the value.
    pub out: Vec<f32>,
}

impl Head {
    /// Runs the head's `layers` with parameters `flat` on rows of the trunk.
    pub fn forward(spec: &PolicySpec, flat: &[f32], layers: &[usize], trunk: Vec<f32>) -> Self {
        let (inner, last) = layers.split_at(layers.len() - 1);
        let (blocks, plain) = if spec.config.hidden.is_empty() { (inner, &[][..]) } else { (&[][..], inner) };
        let (plain, trunk) = Chain::forward(spec, flat, plain, trunk);
        let (mut inputs, mut inner) = (vec![trunk], vec![]);
        for pair in blocks.chunks_exact(2) {
            let h = &inputs[inputs.len() - 1];
            let first = dense(&spec.layers[pair[0]], flat, h, Activation::LeakyRelu(SLOPE));
            let second = dense(&spec.layers[pair[1]], flat, &first, Activation::LeakyRelu(SLOPE));
            let next = h.iter().zip(&second).map(|(h, s)| h + s).collect();
            inputs.push(next);
            inner.push([first, second]);
        }
        let out = dense(&spec.layers[last[0]], flat, &inputs[inputs.len() - 1], Activation::None);
        Self { plain, inputs, inner, out }
    }

    /// rows x `spec.latent()`: what the output layer sees.
    pub fn latent(&self) -> &[f32] {
        &self.inputs[self.inputs.len() - 1]
    }

    /// From the gradient of the output to that of the trunk.
    pub fn backward(mut self, spec: &PolicySpec, flat: &[f32], layers: &[usize], dy: Vec<f32>, out: &mut Vec<Delta>) -> Vec<f32> {
        let (blocks, last) = layers.split_at(layers.len() - 1);
        let x = self.inputs.split_off(self.inner.len()).remove(0);
        let mut d = dense_back(&spec.layers[last[0]], flat, &dy);
        if !spec.config.hidden.is_empty() {
            d = self.plain.backward(spec, flat, blocks, &x, d, out);
        }
        out.push(Delta { layer: last[0], x, dy });
        for ((pair, h), [first, second]) in blocks.chunks_exact(2).zip(self.inputs).zip(self.inner).rev() {
            let (a, b) = (&spec.layers[pair[0]], &spec.layers[pair[1]]);
            let inner: Vec<f32> = d.iter().zip(&second).map(|(d, &y)| leaky_back(y, *d)).collect();
            let mut outer = dense_back(b, flat, &inner);
            outer.iter_mut().zip(&first).for_each(|(d, &y)| *d = leaky_back(y, *d));
            product(rows_of(&outer, a.output), weight(a, flat), &mut d, a.input, true);
            out.push(Delta { layer: pair[1], x: first, dy: inner });
            out.push(Delta { layer: pair[0], x: h, dy: outer });
        }
        d
    }
}

/// From the gradient of an activation `y` to that of its input, which has its sign.
fn leaky_back(y: f32, d: f32) -> f32 {
    if y > 0.0 { d } else { SLOPE * d }
}
