//! The policy network in burn.
//!
//! Parameters live in one flat vector outside (see [`PolicySpec`]): the optimiser, the gradient norm and files work on that, and a
//! [`Network`] is built from it for each update.

use super::{ActionSpace, Dense, NOISE_EPS, Nonlinearity, Part, PolicySpec};
use burn::tensor::activation::{relu, sigmoid, tanh};
use burn::tensor::module::linear;
use burn::tensor::{Device, Gradients, Tensor, TensorData};

/// Slope of the leaky ReLU below zero.
pub const SLOPE: f32 = 0.01;

/// What the network says about n observations.
pub struct Output {
    /// (n, A) mean of the actions, or (n, K) logits of discrete ones.
    pub mu: Tensor<2>,
    /// (n, A) clamped log variance; none for discrete actions.
    pub logvar: Option<Tensor<2>>,
    /// (n) value.
    pub value: Tensor<1>,
    /// (n, L) the actor's last hidden activations.
    pub latent: Tensor<2>,
}

struct Layer {
    weight: Tensor<2>,
    bias: Tensor<1>,
}

/// A policy's weights on a device.
pub struct Network {
    spec: PolicySpec,
    layers: Vec<Layer>,
    /// (1, A), or (L, A) where noise depends on the state.
    log_std: Option<Tensor<2>>,
    /// Means and standard deviations of observations.
    obs_norm: Vec<f32>,
    device: Device,
}

impl Network {
    /// Copies the flat parameters to `device`; on an autodiff device they are the leaves of gradients.
    ///
    /// # Panics
    /// When `flat` is not `spec.params()` long.
    pub fn new(spec: &PolicySpec, flat: &[f32], device: &Device) -> Self {
        assert_eq!(flat.len(), spec.params(), "parameters of another policy");
        let inner = device.clone().without_autodiff();
        let layer = |d: &Dense| Layer {
            weight: Tensor::from_data(TensorData::new(d.weight_of(flat).to_vec(), [d.output, d.input]), &inner),
            bias: Tensor::from_data(TensorData::new(d.bias_of(flat).to_vec(), [d.output]), &inner),
        };
        let log_std = || {
            Tensor::from_data(
                TensorData::new(
                    flat[spec.log_std_range()].to_vec(),
                    [spec.log_std_range().len() / spec.action.count(), spec.action.count()],
                ),
                &inner,
            )
        };
        let (log_std, obs_norm) = (spec.log_std.map(|_| log_std()), flat[spec.obs_norm_range()].to_vec());
        let network = Self { spec: spec.clone(), layers: spec.layers.iter().map(layer).collect(), log_std, obs_norm, device: inner };
        if device.is_autodiff() { network.with_gradients() } else { network }
    }

    /// The same weights as leaves of a gradient graph of their own.
    pub fn with_gradients(&self) -> Self {
        let leaf = |l: &Layer| Layer { weight: l.weight.clone().autodiff().require_grad(), bias: l.bias.clone().autodiff().require_grad() };
        Self {
            spec: self.spec.clone(),
            layers: self.layers.iter().map(leaf).collect(),
            log_std: self.log_std.clone().map(|s| s.autodiff().require_grad()),
            obs_norm: self.obs_norm.clone(),
            device: self.device.clone().autodiff(),
        }
    }

    /// The policy's sizes.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// The device the weights are on.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Actions and values for observation rows (n x layout.dim()).
    pub fn forward(&self, obs: &[f32]) -> Output {
        let trunk = self.trunk(obs);
        let (latent, out) = self.head(&self.spec.actor, trunk.clone());
        let value = self.head(&self.spec.critic, trunk).1.squeeze_dim(1);
        let [low, high] = self.spec.config.logvar;
        let ActionSpace::Continuous(width) = self.spec.action else { return Output { mu: out, logvar: None, value, latent } };
        let (mu, logvar) = match &self.log_std {
            Some(log_std) if self.spec.config.state_noise.is_some() => {
                let variance = latent.clone().detach().powf_scalar(2.0).matmul((log_std.clone() * 2.0).exp());
                return Output { mu: out, logvar: Some((variance + NOISE_EPS).log()), value, latent };
            }
            Some(log_std) => {
                let rows = out.dims()[0];
                (out, log_std.clone().repeat_dim(0, rows) * 2.0)
            }
            None => (out.clone().narrow(1, 0, width), out.narrow(1, width, width)),
        };
        Output { mu, logvar: Some(logvar.clamp(low, high)), value, latent }
    }

    /// Values only, (n).
    pub fn value(&self, obs: &[f32]) -> Tensor<1> {
        let trunk = self.trunk(obs);
        self.head(&self.spec.critic, trunk).1.squeeze_dim(1)
    }

    /// Adds the gradients of all parameters to `flat`, in its layout; parameters without one add nothing.
    pub fn add_gradients(&self, grads: &mut Gradients, flat: &mut [f32]) {
        for (d, layer) in self.spec.layers.iter().zip(&self.layers) {
            let weight = layer.weight.grad_remove(grads).map(Tensor::into_data);
            let bias = layer.bias.grad_remove(grads).map(Tensor::into_data);
            let split = d.offset + d.output * d.input;
            for (at, data) in [(d.offset, weight), (split, bias)] {
                let Some(data) = data else { continue };
                let values = data.as_slice::<f32>().expect("gradients are f32");
                flat[at..at + values.len()].iter_mut().zip(values).for_each(|(f, g)| *f += g);
            }
        }
        if let Some(data) = self.log_std.as_ref().and_then(|s| s.grad_remove(grads)).map(Tensor::into_data) {
            let values = data.as_slice::<f32>().expect("gradients are f32");
            flat[self.spec.log_std_range()].iter_mut().zip(values).for_each(|(f, g)| *f += g);
        }
    }

    fn trunk(&self, obs: &[f32]) -> Tensor<2> {
        let dim = self.spec.layout.dim();
        let rows = obs.len() / dim;
        let obs = &*self.spec.normalised(&self.obs_norm, obs);
        let mut parts = Vec::with_capacity(self.spec.encoders.len());
        for encoder in &self.spec.encoders {
            let group = |width: usize, frame: usize| {
                let at = encoder.start + frame * width;
                obs.chunks_exact(dim).flat_map(move |row| row[at..at + width].iter().copied())
            };
            parts.push(match encoder.part {
                Part::Gru { frames, width, ih, hh } => {
                    let frames_first = (0..frames).flat_map(|t| group(width, t)).collect();
                    self.gru(self.tensor(frames_first, frames * rows), frames, &self.layers[ih], &self.layers[hh])
                }
                Part::Sine => {
                    let mut encoded = Vec::with_capacity(rows * encoder.output);
                    group(1, 0).for_each(|x| self.spec.sine(x, &mut encoded));
                    self.tensor(encoded, rows)
                }
                Part::Plain { width } => self.tensor(group(width, 0).collect(), rows),
            });
        }
        let joined = Tensor::cat(parts, 1);
        let trunk = match self.spec.project {
            Some(i) => self.apply(i, joined),
            None => joined,
        };
        self.plain(&self.spec.shared, trunk)
    }

    fn plain(&self, layers: &[usize], mut h: Tensor<2>) -> Tensor<2> {
        for &layer in layers {
            h = self.apply(layer, h);
            h = match self.spec.config.activation {
                Nonlinearity::Tanh => tanh(h),
                Nonlinearity::Relu => relu(h),
            };
        }
        h
    }

    fn tensor(&self, data: Vec<f32>, rows: usize) -> Tensor<2> {
        let width = data.len() / rows.max(1);
        Tensor::from_data(TensorData::new(data, [rows, width]), &self.device)
    }

    /// Last hidden state (rows, H) of frames given frame-outermost (frames x rows, width):
    /// r, z = s(W x + b + U h + c), n = tanh(W x + b + r (U h + c)), h' = (1 - z) n + z h, starting at h = 0.
    fn gru(&self, frames_first: Tensor<2>, frames: usize, ih: &Layer, hh: &Layer) -> Tensor<2> {
        let rows = frames_first.dims()[0] / frames;
        let hidden = hh.weight.dims()[1];
        let inputs = dense(ih, frames_first);
        let mut state: Option<Tensor<2>> = None;
        for t in 0..frames {
            let input = inputs.clone().narrow(0, t * rows, rows);
            let recurrent = match &state {
                Some(h) => dense(hh, h.clone()),
                None => hh.bias.clone().unsqueeze::<2>(),
            };
            let gates = sigmoid(input.clone().narrow(1, 0, 2 * hidden) + recurrent.clone().narrow(1, 0, 2 * hidden));
            let (r, z) = (gates.clone().narrow(1, 0, hidden), gates.narrow(1, hidden, hidden));
            let new = tanh(input.narrow(1, 2 * hidden, hidden) + r * recurrent.narrow(1, 2 * hidden, hidden));
            state = Some(match state {
                Some(h) => new.clone() + z * (h - new),
                None => new.clone() - z * new,
            });
        }
        state.unwrap_or_else(|| Tensor::zeros([rows, hidden], &self.device))
    }

    /// Last hidden activations and output.
    fn head(&self, layers: &[usize], mut h: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let (output, blocks) = layers.split_last().expect("a head has an output layer");
        if !self.spec.config.hidden.is_empty() {
            h = self.plain(blocks, h);
            return (h.clone(), self.apply(*output, h));
        }
        for block in blocks.chunks_exact(2) {
            let inner = leaky(self.apply(block[0], h.clone()));
            h = leaky(self.apply(block[1], inner)) + h;
        }
        (h.clone(), self.apply(*output, h))
    }

    fn apply(&self, layer: usize, x: Tensor<2>) -> Tensor<2> {
        dense(&self.layers[layer], x)
    }
}

fn dense(layer: &Layer, x: Tensor<2>) -> Tensor<2> {
    linear(x, layer.weight.clone().transpose(), Some(layer.bias.clone()))
}

/// max(x, a x), written without the masks that make burn's own slow in the backward pass.
fn leaky(x: Tensor<2>) -> Tensor<2> {
    relu(x.clone()) * (1.0 - SLOPE) + x * SLOPE
}
