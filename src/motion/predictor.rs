//! The marker predictor on burn tensors: a conditional VAE over primitives. See `weights` for its layers.

use super::PredictorWeights;
use super::net::{DenseNet, GruNet, tanh_layers};
use burn::tensor::{Device, Gradients, Tensor};

/// The predictor's weights on a device; leaves of gradients on an autodiff device.
pub struct Predictor {
    x_enc: GruNet,
    e_rnn: GruNet,
    e_mlp: [DenseNet; 2],
    e_mu: DenseNet,
    e_logvar: DenseNet,
    drnn_mlp: [DenseNet; 3],
    d_rnn: GruNet,
    d_mlp: [DenseNet; 2],
    d_out: DenseNet,
}

impl Predictor {
    /// Copies the weights to `device`.
    pub fn new(w: &PredictorWeights, device: &Device) -> Self {
        let dense = |d| DenseNet::new(d, device);
        let gru = |g| GruNet::new(g, device);
        Self {
            x_enc: gru(&w.x_enc),
            e_rnn: gru(&w.e_rnn),
            e_mlp: w.e_mlp.each_ref().map(dense),
            e_mu: dense(&w.e_mu),
            e_logvar: dense(&w.e_logvar),
            drnn_mlp: w.drnn_mlp.each_ref().map(dense),
            d_rnn: gru(&w.d_rnn),
            d_mlp: w.d_mlp.each_ref().map(dense),
            d_out: dense(&w.d_out),
        }
    }

    /// Mean and log variance (n, latent) of the latent of primitives. `seed`: (n, 2, frame); `future`: (n, T, frame).
    pub fn encode(&self, seed: Tensor<3>, future: Tensor<3>) -> (Tensor<2>, Tensor<2>) {
        let h = Tensor::cat(vec![self.x_enc.run(seed), self.e_rnn.run(future)], 1);
        let e = tanh_layers(&self.e_mlp, h);
        (self.e_mu.forward(e.clone()), self.e_logvar.forward(e))
    }

    /// `steps` future frames (n, steps, frame). `seed`: (n, 2, frame); `z`: (n, latent).
    pub fn decode(&self, seed: Tensor<3>, z: Tensor<2>, steps: usize) -> Tensor<3> {
        let mut frame: Tensor<2> = seed.clone().narrow(1, 1, 1).squeeze_dim(1);
        let h_x = self.x_enc.run(seed);
        let mut h = tanh_layers(&self.drnn_mlp, h_x.clone());
        let constant = Tensor::cat(vec![h_x, z], 1);
        let first = constant.dims()[1];
        let constant = self.d_rnn.share(constant, 0);
        let mut frames = Vec::with_capacity(steps);
        for _ in 0..steps {
            h = self.d_rnn.step(constant.clone() + self.d_rnn.share(frame.clone(), first), h);
            frame = frame + self.d_out.forward(tanh_layers(&self.d_mlp, h.clone()));
            frames.push(frame.clone());
        }
        Tensor::stack(frames, 1)
    }

    /// Adds the gradients of all weights to `out`.
    pub fn add_gradients(&self, grads: &mut Gradients, out: &mut PredictorWeights) {
        self.x_enc.add_gradients(grads, &mut out.x_enc);
        self.e_rnn.add_gradients(grads, &mut out.e_rnn);
        self.d_rnn.add_gradients(grads, &mut out.d_rnn);
        let nets = self.e_mlp.iter().chain([&self.e_mu, &self.e_logvar]).chain(&self.drnn_mlp).chain(&self.d_mlp).chain([&self.d_out]);
        let layers = out.e_mlp.iter_mut().chain([&mut out.e_mu, &mut out.e_logvar]).chain(&mut out.drnn_mlp);
        let layers = layers.chain(&mut out.d_mlp).chain([&mut out.d_out]);
        nets.zip(layers).for_each(|(net, layer)| net.add_gradients(grads, layer));
    }
}
