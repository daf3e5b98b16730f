//! Layers as plain arrays, in torch's layouts; see `weights` for the GRU's equations.

use crate::Result;
use crate::io::Tensors;

/// A dense layer, y = W x + b.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dense {
    pub input: usize,
    pub output: usize,
    /// (output, input) row-major.
    pub weight: Vec<f32>,
    /// (output).
    pub bias: Vec<f32>,
}

/// One GRU layer or cell; gates in the order r, z, n.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gru {
    pub input: usize,
    pub hidden: usize,
    /// (3 hidden, input) row-major.
    pub weight_ih: Vec<f32>,
    /// (3 hidden, hidden) row-major.
    pub weight_hh: Vec<f32>,
    /// (3 hidden).
    pub bias_ih: Vec<f32>,
    /// (3 hidden).
    pub bias_hh: Vec<f32>,
}

/// Access to all numbers of a network in the order of its named tensors.
pub trait Parameters: Clone {
    /// All tensors.
    fn tensors_mut(&mut self) -> Vec<&mut Vec<f32>>;

    /// The same shapes, all zero: room for gradients.
    fn zeros(&self) -> Self {
        let mut zeros = self.clone();
        zeros.tensors_mut().into_iter().for_each(|t| t.fill(0.0));
        zeros
    }
}

/// One named tensor: name, shape, row-major data.
pub type Named = (String, Vec<usize>, Vec<f32>);

impl Dense {
    pub(super) fn read(t: &Tensors, name: &str, input: usize, output: usize) -> Result<Self> {
        let weight = t.f32s(&format!("{name}.weight"), &[output, input])?;
        Ok(Self { input, output, weight, bias: t.f32s(&format!("{name}.bias"), &[output])? })
    }

    pub(super) fn put(&self, name: &str, out: &mut Vec<Named>) {
        out.push((format!("{name}.weight"), vec![self.output, self.input], self.weight.clone()));
        out.push((format!("{name}.bias"), vec![self.output], self.bias.clone()));
    }

    pub(super) fn tensors_mut(&mut self) -> [&mut Vec<f32>; 2] {
        [&mut self.weight, &mut self.bias]
    }
}

impl Gru {
    /// `suffix` is "_l0" for torch's `GRU` and "" for its `GRUCell`.
    pub(super) fn read(t: &Tensors, name: &str, suffix: &str, input: usize, hidden: usize) -> Result<Self> {
        let get = |part: &str, shape: &[usize]| t.f32s(&format!("{name}.{part}{suffix}"), shape);
        Ok(Self {
            input,
            hidden,
            weight_ih: get("weight_ih", &[3 * hidden, input])?,
            weight_hh: get("weight_hh", &[3 * hidden, hidden])?,
            bias_ih: get("bias_ih", &[3 * hidden])?,
            bias_hh: get("bias_hh", &[3 * hidden])?,
        })
    }

    pub(super) fn put(&self, name: &str, suffix: &str, out: &mut Vec<Named>) {
        let gates = 3 * self.hidden;
        out.push((format!("{name}.weight_ih{suffix}"), vec![gates, self.input], self.weight_ih.clone()));
        out.push((format!("{name}.weight_hh{suffix}"), vec![gates, self.hidden], self.weight_hh.clone()));
        out.push((format!("{name}.bias_ih{suffix}"), vec![gates], self.bias_ih.clone()));
        out.push((format!("{name}.bias_hh{suffix}"), vec![gates], self.bias_hh.clone()));
    }

    pub(super) fn tensors_mut(&mut self) -> [&mut Vec<f32>; 4] {
        [&mut self.weight_ih, &mut self.weight_hh, &mut self.bias_ih, &mut self.bias_hh]
    }
}
