//! The body regressor on burn tensors: markers to bodies in continuous form. See `weights` for its layers.

use super::net::DenseNet;
use super::{CONTINUOUS, RegressorWeights};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Gradients, Tensor};

/// The regressor's weights on a device; leaves of gradients on an autodiff device.
pub struct Regressor {
    in_fc: DenseNet,
    blocks: Vec<[DenseNet; 2]>,
    out_fc: DenseNet,
    passes: usize,
}

impl Regressor {
    /// Copies the weights to `device`.
    pub fn new(w: &RegressorWeights, device: &Device) -> Self {
        let dense = |d| DenseNet::new(d, device);
        Self {
            in_fc: dense(&w.in_fc),
            blocks: w.blocks.iter().map(|b| b.each_ref().map(dense)).collect(),
            out_fc: dense(&w.out_fc),
            passes: w.passes,
        }
    }

    /// Bodies (n, 159) in continuous form. `markers`: (n, 201), canonical; `betas`: (n, 10).
    pub fn forward(&self, markers: Tensor<2>, betas: Tensor<2>) -> Tensor<2> {
        let estimate = Tensor::zeros([markers.dims()[0], CONTINUOUS], &markers.device());
        (0..self.passes).fold(estimate, |estimate, _| {
            let h = self.in_fc.forward(Tensor::cat(vec![markers.clone(), betas.clone(), estimate.clone()], 1));
            let h = self.blocks.iter().fold(h, |h, [a, b]| relu(b.forward(relu(a.forward(h.clone())))) + h);
            estimate + self.out_fc.forward(h)
        })
    }

    /// Adds the gradients of all weights to `out`.
    pub fn add_gradients(&self, grads: &mut Gradients, out: &mut RegressorWeights) {
        self.in_fc.add_gradients(grads, &mut out.in_fc);
        self.out_fc.add_gradients(grads, &mut out.out_fc);
        for (net, layer) in self.blocks.iter().flatten().zip(out.blocks.iter_mut().flatten()) {
            net.add_gradients(grads, layer);
        }
    }
}
