//! Fully connected layers over packed weights.

use super::simd::{self, Ahead, Finish, Isa, Lane, PANEL};
use crate::{Error, Result};
use rayon::prelude::*;

/// Activation applied to every output of a layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    None,
    Tanh,
    Sigmoid,
    Relu,
    /// Slope for negative values.
    LeakyRelu(f32),
}

impl Activation {
    /// Applies the activation to every value in place.
    pub fn apply(self, values: &mut [f32]) {
        simd::apply(Isa::best(), values, self);
    }
}

/// Rows that lie `stride` floats apart; a stride of 0 repeats one row.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    pub data: &'a [f32],
    pub stride: usize,
}

impl<'a> View<'a> {
    pub fn new(data: &'a [f32], stride: usize) -> Self {
        Self { data, stride }
    }
}

/// Rows to write, `stride` floats apart.
#[derive(Debug)]
pub struct ViewMut<'a> {
    pub data: &'a mut [f32],
    pub stride: usize,
}

impl<'a> ViewMut<'a> {
    pub fn new(data: &'a mut [f32], stride: usize) -> Self {
        Self { data, stride }
    }
}

/// What a layer's output is combined with.
#[derive(Clone, Copy, Debug)]
pub enum Source<'a> {
    /// y = f(x W^T + b)
    Fresh,
    /// y = f(x W^T + b + v)
    Plus(View<'a>),
    /// y = y + f(x W^T + b): a residual connection in place.
    Residual,
}

/// y = f(x W^T + b), weights packed once into panels of 32 outputs.
#[derive(Clone, Debug)]
pub struct Linear {
    inputs: usize,
    outputs: usize,
    /// Panel outermost, then input.
    weight: Vec<Lane>,
    bias: Vec<Lane>,
}

impl Linear {
    /// `weight`: outputs x inputs as torch stores it; `bias`: outputs, or empty for none.
    ///
    /// # Errors
    /// If the weights do not fill the shape.
    pub fn new(weight: &[f32], bias: &[f32], inputs: usize) -> Result<Self> {
        if inputs == 0 || weight.is_empty() || !weight.len().is_multiple_of(inputs) {
            return Err(Error::invalid(format!("{} weights do not make rows of {inputs} inputs", weight.len())));
        }
        Self::from_columns(weight, bias, inputs, 0..inputs)
    }

    /// The layer that sees only the inputs `columns` of a larger one whose `weight` has rows of `row` floats.
    ///
    /// # Errors
    /// If the weights do not fill the shape.
    pub fn from_columns(weight: &[f32], bias: &[f32], row: usize, columns: std::ops::Range<usize>) -> Result<Self> {
        let outputs = weight.len().checked_div(row).unwrap_or(0);
        if outputs * row != weight.len() || columns.is_empty() || columns.end > row || !(bias.is_empty() || bias.len() == outputs) {
            return Err(Error::invalid(format!(
                "a layer of {} weights in rows of {row}, {} biases, inputs {columns:?}: the shapes do not agree",
                weight.len(),
                bias.len()
            )));
        }
        let (inputs, panels) = (columns.len(), outputs.div_ceil(PANEL));
        let mut layer = Self { inputs, outputs, weight: vec![Lane([0.0; PANEL]); panels * inputs], bias: vec![Lane([0.0; PANEL]); panels] };
        // The policy's 50 MB are packed anew after every update.
        let isa = Isa::best();
        layer.weight.par_chunks_exact_mut(inputs).zip(weight.par_chunks(PANEL * row)).for_each(|(panel, rows)| {
            simd::transpose(isa, &rows[columns.start..], row, rows.len() / row, panel);
        });
        for (o, b) in bias.iter().enumerate() {
            layer.bias[o / PANEL].0[o % PANEL] = *b;
        }
        Ok(layer)
    }

    /// Floats of an input row.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Floats of an output row.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Copies the bias to `row`.
    pub(super) fn copy_bias(&self, row: &mut [f32]) {
        row.chunks_mut(PANEL).zip(&self.bias).for_each(|(row, bias)| row.copy_from_slice(&bias.0[..row.len()]));
    }

    /// Computes `rows` rows on this thread. `x`: rows of `inputs`; `y`: rows of `outputs`.
    ///
    /// # Panics
    /// If a view is shorter than its rows.
    pub fn forward(&self, rows: usize, x: View, y: ViewMut, source: Source, activation: Activation) {
        self.forward_with(Isa::best(), rows, x, y, source, activation);
    }

    fn forward_with(&self, isa: Isa, rows: usize, x: View, y: ViewMut, source: Source, activation: Activation) {
        if rows == 0 {
            return;
        }
        for (p, (panel, bias)) in self.weight.chunks_exact(self.inputs).zip(&self.bias).enumerate() {
            let ahead = Ahead::new(self.weight.chunks_exact(self.inputs).nth(p + 1).unwrap_or(&[]));
            let (first, width) = (p * PANEL, PANEL.min(self.outputs - p * PANEL));
            let plus = if let Source::Plus(v) = source { Some((&v.data[first..], v.stride)) } else { None };
            let how = Finish { bias, plus, activation, residual: matches!(source, Source::Residual), width };
            simd::panel_rows(isa, rows, (x.data, [x.stride, 1]), panel, ahead, &how, (&mut y.data[first..], y.stride));
        }
    }
}

/// `layer` on contiguous rows.
pub(super) fn dense(layer: &Linear, rows: usize, x: &[f32], y: &mut [f32], source: Source, activation: Activation) {
    layer.forward(rows, View::new(x, layer.inputs), ViewMut::new(y, layer.outputs), source, activation);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::RngExt;

    /// `n` values in [-1, 1].
    fn noise(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = crate::rng::stream(seed, "kernels", 0);
        (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    /// The product in double precision.
    fn reference(x: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let row = |w: &[f32]| x.iter().zip(w).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        weight.chunks_exact(x.len()).zip(bias).map(|(w, b)| (row(w) + f64::from(*b)) as f32).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn ragged_shapes_match_double_precision(rows in 1usize..40, inputs in 1usize..70, outputs in 1usize..80,
                                                gap in 0usize..5, seed in 0u64..1000) {
            let (xs, ys) = (inputs + gap, outputs + gap);
            let (x, weight, bias) = (noise(rows * xs, seed), noise(outputs * inputs, seed + 1), noise(outputs, seed + 2));
            let layer = Linear::new(&weight, &bias, inputs).unwrap();
            for source in 0..3 {
                let before = noise(rows * ys, seed + 3);
                let other = noise(rows * ys, seed + 4);
                let run = |isa, activation| {
                    let mut y = before.clone();
                    let source = match source {
                        0 => Source::Fresh,
                        1 => Source::Plus(View::new(&other, ys)),
                        _ => Source::Residual,
                    };
                    layer.forward_with(isa, rows, View::new(&x, xs), ViewMut::new(&mut y, ys), source, activation);
                    y
                };
                for activation in [Activation::None, Activation::Tanh, Activation::Sigmoid, Activation::Relu, Activation::LeakyRelu(0.1)] {
                    let y = run(Isa::best(), activation);
                    for isa in Isa::available() {
                        prop_assert_eq!(&y, &run(isa, activation), "{:?} gives other bits for {:?}", isa, activation);
                    }
                }
                let y = run(Isa::best(), Activation::Relu);
                for r in 0..rows {
                    let want = reference(&x[r * xs..r * xs + inputs], &weight, &bias);
                    for (o, want) in want.iter().enumerate() {
                        let i = r * ys + o;
                        let want = match source {
                            0 => want.max(0.0),
                            1 => (want + other[i]).max(0.0),
                            _ => want.max(0.0) + before[i],
                        };
                        prop_assert!((y[i] - want).abs() < 2e-5, "source {} row {} output {}: {} {}", source, r, o, y[i], want);
                    }
                    // Nothing is written between the rows.
                    let gap = r * ys + outputs..(r + 1) * ys;
                    prop_assert_eq!(&y[gap.clone()], &before[gap]);
                }
            }
        }

        #[test]
        fn a_row_does_not_depend_on_its_batch(rows in 1usize..60, row in 0usize..60, seed in 0u64..100) {
            let row = row % rows;
            let (inputs, outputs) = (51, 37);
            let x = noise(rows * inputs, seed);
            let layer = Linear::new(&noise(outputs * inputs, 1), &noise(outputs, 2), inputs).unwrap();
            let (mut all, mut one) = (vec![0.0; rows * outputs], vec![0.0; outputs]);
            let view = View::new(&x, inputs);
            layer.forward(rows, view, ViewMut::new(&mut all, outputs), Source::Fresh, Activation::Tanh);
            let view = View::new(&x[row * inputs..], inputs);
            layer.forward(1, view, ViewMut::new(&mut one, outputs), Source::Fresh, Activation::Tanh);
            prop_assert_eq!(&all[row * outputs..(row + 1) * outputs], &one[..]);
        }
    }

    #[test]
    fn nobody_is_no_work() {
        let layer = Linear::new(&noise(40 * 2, 1), &[], 2).unwrap();
        layer.forward(0, View::new(&[], 2), ViewMut::new(&mut [], 40), Source::Plus(View::new(&[], 40)), Activation::Tanh);
    }

    #[test]
    fn columns_split_a_layer() {
        let (weight, bias, x) = (noise(7 * 10, 1), noise(7, 2), noise(3 * 10, 3));
        let whole = Linear::new(&weight, &bias, 10).unwrap();
        let left = Linear::from_columns(&weight, &bias, 10, 0..4).unwrap();
        let right = Linear::from_columns(&weight, &[], 10, 4..10).unwrap();
        let (mut want, mut part, mut sum) = ([0.0; 21], [0.0; 21], [0.0; 21]);
        whole.forward(3, View::new(&x, 10), ViewMut::new(&mut want, 7), Source::Fresh, Activation::None);
        left.forward(3, View::new(&x, 10), ViewMut::new(&mut part, 7), Source::Fresh, Activation::None);
        right.forward(3, View::new(&x[4..], 10), ViewMut::new(&mut sum, 7), Source::Plus(View::new(&part, 7)), Activation::None);
        want.iter().zip(sum).for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "{a} {b}"));
    }

    #[test]
    fn shapes_that_do_not_agree_are_refused() {
        assert!(Linear::new(&[0.0; 6], &[0.0; 3], 2).is_ok());
        assert!(Linear::new(&[0.0; 6], &[0.0; 2], 2).is_err());
        assert!(Linear::new(&[0.0; 7], &[], 2).is_err());
        assert!(Linear::new(&[0.0; 6], &[], 0).is_err());
        assert!(Linear::from_columns(&[0.0; 6], &[], 3, 2..4).is_err());
    }
}
