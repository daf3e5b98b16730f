//! Layers of the motion model on burn tensors: the reference and the way to other devices.

use super::{Dense, Gru};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Gradients, Tensor, TensorData};

/// A tensor from row-major data; a leaf of gradients if the device is an autodiff one.
fn leaf<const D: usize>(data: &[f32], shape: [usize; D], device: &Device) -> Tensor<D> {
    let t = Tensor::from_data(TensorData::new(data.to_vec(), shape), device);
    if device.is_autodiff() { t.require_grad() } else { t }
}

fn add_grad<const D: usize>(t: &Tensor<D>, grads: &mut Gradients, out: &mut [f32]) {
    let Some(data) = t.grad_remove(grads).map(Tensor::into_data) else { return };
    let values = data.as_slice::<f32>().expect("gradients are f32");
    out.iter_mut().zip(values).for_each(|(o, g)| *o += g);
}

/// y = x W^T + b on (n, in).
pub(super) struct DenseNet {
    weight: Tensor<2>,
    bias: Tensor<1>,
}

impl DenseNet {
    pub fn new(d: &Dense, device: &Device) -> Self {
        Self { weight: leaf(&d.weight, [d.output, d.input], device), bias: leaf(&d.bias, [d.output], device) }
    }

    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.weight.clone().transpose()) + self.bias.clone().unsqueeze()
    }

    pub fn add_gradients(&self, grads: &mut Gradients, out: &mut Dense) {
        add_grad(&self.weight, grads, &mut out.weight);
        add_grad(&self.bias, grads, &mut out.bias);
    }
}

/// Several dense layers, tanh after each.
pub(super) fn tanh_layers(layers: &[DenseNet], x: Tensor<2>) -> Tensor<2> {
    layers.iter().fold(x, |x, l| l.forward(x).tanh())
}

/// One GRU layer or cell.
pub(super) struct GruNet {
    weight_ih: Tensor<2>,
    weight_hh: Tensor<2>,
    bias_ih: Tensor<1>,
    bias_hh: Tensor<1>,
    hidden: usize,
}

impl GruNet {
    pub fn new(g: &Gru, device: &Device) -> Self {
        let gates = 3 * g.hidden;
        Self {
            weight_ih: leaf(&g.weight_ih, [gates, g.input], device),
            weight_hh: leaf(&g.weight_hh, [gates, g.hidden], device),
            bias_ih: leaf(&g.bias_ih, [gates], device),
            bias_hh: leaf(&g.bias_hh, [gates], device),
            hidden: g.hidden,
        }
    }

    /// The gates' share (n, 3 H) of the input columns that start at `first`, without bias.
    pub fn share(&self, x: Tensor<2>, first: usize) -> Tensor<2> {
        let width = x.dims()[1];
        x.matmul(self.weight_ih.clone().narrow(1, first, width).transpose())
    }

    /// The next state (n, H) from the input's share of the gates, without bias.
    pub fn step(&self, share: Tensor<2>, h: Tensor<2>) -> Tensor<2> {
        let n = self.hidden;
        let x = share + self.bias_ih.clone().unsqueeze();
        let u = h.clone().matmul(self.weight_hh.clone().transpose()) + self.bias_hh.clone().unsqueeze();
        let rz = sigmoid(x.clone().narrow(1, 0, 2 * n) + u.clone().narrow(1, 0, 2 * n));
        let (r, z) = (rz.clone().narrow(1, 0, n), rz.narrow(1, n, n));
        let new = (x.narrow(1, 2 * n, n) + r * u.narrow(1, 2 * n, n)).tanh();
        new.clone() + z * (h - new)
    }

    /// The last state (n, H) of a sequence (n, T, I) from zero.
    pub fn run(&self, x: Tensor<3>) -> Tensor<2> {
        let [n, steps, _] = x.dims();
        let h = Tensor::zeros([n, self.hidden], &x.device());
        (0..steps).fold(h, |h, t| self.step(self.share(x.clone().narrow(1, t, 1).squeeze_dim(1), 0), h))
    }

    pub fn add_gradients(&self, grads: &mut Gradients, out: &mut Gru) {
        add_grad(&self.weight_ih, grads, &mut out.weight_ih);
        add_grad(&self.weight_hh, grads, &mut out.weight_hh);
        add_grad(&self.bias_ih, grads, &mut out.bias_ih);
        add_grad(&self.bias_hh, grads, &mut out.bias_hh);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Tensors;
    use crate::motion::{Predictor, PredictorSizes, PredictorWeights, Regressor, RegressorSizes, RegressorWeights};

    /// Weights in the authors' layout, inputs and outputs, made by torch at reduced width.
    fn fixture() -> Tensors {
        Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/motion_model.safetensors")).unwrap()
    }

    fn input<const D: usize>(t: &Tensors, name: &str) -> Tensor<D> {
        let shape: [usize; D] = t.shape(name).unwrap().try_into().unwrap();
        Tensor::from_data(TensorData::new(t.f32s(name, &shape).unwrap(), shape), &Device::flex())
    }

    fn close<const D: usize>(have: Tensor<D>, t: &Tensors, name: &str) {
        let want: Tensor<D> = input(t, name);
        assert_eq!(have.dims(), want.dims());
        let worst = (have - want).abs().max().into_scalar::<f32>();
        assert!(worst < 1e-5, "{name} is off by {worst}");
    }

    #[test]
    fn predictor_matches_torch() {
        let t = fixture();
        let w = PredictorWeights::read(&t, PredictorSizes { frame: 9, hidden: 8, wide: 12, latent: 5 }).unwrap();
        let net = Predictor::new(&w, &Device::flex());
        let (mu, logvar) = net.encode(input(&t, "seed"), input(&t, "future"));
        close(mu, &t, "mu");
        close(logvar, &t, "logvar");
        close(net.decode(input(&t, "seed"), input(&t, "latent"), 6), &t, "decoded");
    }

    #[test]
    fn regressor_matches_torch() {
        let t = fixture();
        let w = RegressorWeights::read(&t, RegressorSizes { width: 6, blocks: 2, passes: 3 }).unwrap();
        close(Regressor::new(&w, &Device::flex()).forward(input(&t, "markers"), input(&t, "betas")), &t, "body");
    }
}
