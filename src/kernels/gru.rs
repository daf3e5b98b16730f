//! The gated recurrent unit, in torch's formula.

use super::linear::{Activation, Linear, Source, View, ViewMut};
use super::simd::{self, Isa};
use crate::Result;
use std::ops::Range;

/// r = s(W_ir x + b_ir + W_hr h + b_hr), z = s(W_iz x + b_iz + W_hz h + b_hz),
/// n = tanh(W_in x + b_in + r (W_hn h + b_hn)), h' = (1 - z) n + z h, with s the logistic function.
#[derive(Clone, Debug)]
pub struct GruCell {
    input: Linear,
    hidden: Linear,
}

impl GruCell {
    /// `weight_ih`: 3 H x inputs, `weight_hh`: 3 H x H, biases 3 H, gates in the order r, z, n as torch stores them.
    ///
    /// # Errors
    /// If the weights do not fill the shapes.
    pub fn new(weight_ih: &[f32], weight_hh: &[f32], bias_ih: &[f32], bias_hh: &[f32], inputs: usize) -> Result<Self> {
        Self::from_columns(weight_ih, weight_hh, [bias_ih, bias_hh], inputs, 0..inputs)
    }

    /// The cell that multiplies only the inputs `columns`; the rest's product arrives through `step`'s `constant`.
    ///
    /// # Errors
    /// If the weights do not fill the shapes.
    pub fn from_columns(weight_ih: &[f32], weight_hh: &[f32], bias: [&[f32]; 2], inputs: usize, columns: Range<usize>) -> Result<Self> {
        let size = bias[1].len() / 3;
        let cell =
            Self { input: Linear::from_columns(weight_ih, bias[0], inputs, columns)?, hidden: Linear::new(weight_hh, bias[1], size)? };
        if cell.input.outputs() != 3 * size || cell.hidden.outputs() != 3 * size || bias[1].len() != 3 * size {
            return Err(crate::Error::invalid(format!(
                "a GRU of {size} hidden values needs {} gate rows; the input weights have {}, the hidden weights {}",
                3 * size,
                cell.input.outputs(),
                cell.hidden.outputs()
            )));
        }
        Ok(cell)
    }

    /// Hidden values.
    pub fn size(&self) -> usize {
        self.hidden.inputs()
    }

    /// Floats of an input row.
    pub fn inputs(&self) -> usize {
        self.input.inputs()
    }

    /// Floats of scratch that `step` needs for `rows` rows.
    pub fn scratch(&self, rows: usize) -> usize {
        6 * self.size() * rows
    }

    /// One step of `rows` rows. `h`: rows x H, contiguous, updated; `constant`: rows x 3 H added to the input's product.
    ///
    /// # Panics
    /// If a slice is too short.
    pub fn step(&self, rows: usize, x: View, constant: Source, h: &mut [f32], scratch: &mut [f32]) {
        let (input, hidden) = scratch.split_at_mut(3 * self.size() * rows);
        self.hidden.forward(rows, View::new(h, self.size()), ViewMut::new(hidden, 3 * self.size()), Source::Fresh, Activation::None);
        self.input.forward(rows, x, ViewMut::new(input, 3 * self.size()), constant, Activation::None);
        self.gates(rows, input, hidden, h);
    }

    /// The last state after `frames` frames that follow one another in each row of `x`, from state zero. `h`: rows x H.
    ///
    /// # Panics
    /// If a slice is too short.
    pub fn encode(&self, rows: usize, frames: usize, x: View, h: &mut [f32], scratch: &mut [f32]) {
        h.fill(0.0);
        for frame in 0..frames {
            let x = View::new(&x.data[frame * self.inputs()..], x.stride);
            if frame > 0 {
                self.step(rows, x, Source::Fresh, h, scratch);
                continue;
            }
            // The product with a zero state is known: it is the bias.
            let (input, hidden) = scratch.split_at_mut(3 * self.size() * rows);
            hidden.chunks_exact_mut(3 * self.size()).take(rows).for_each(|row| self.hidden.copy_bias(row));
            self.input.forward(rows, x, ViewMut::new(input, 3 * self.size()), Source::Fresh, Activation::None);
            self.gates(rows, input, hidden, h);
        }
    }

    fn gates(&self, rows: usize, input: &[f32], hidden: &[f32], h: &mut [f32]) {
        let gates = 3 * self.size();
        let products = input.chunks_exact(gates).zip(hidden.chunks_exact(gates));
        let isa = Isa::best();
        for (h, (input, hidden)) in h.chunks_exact_mut(self.size()).zip(products).take(rows) {
            simd::gates(isa, input, hidden, h);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Tensors;

    #[test]
    fn matches_torch_over_a_sequence() {
        let t = Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/gru.safetensors")).unwrap();
        let (rows, frames, inputs, size) = (5, 3, 21, 18);
        let get = |name: &str, shape: &[usize]| t.f32s(name, shape).unwrap();
        let (w_ih, w_hh) = (get("weight_ih", &[3 * size, inputs]), get("weight_hh", &[3 * size, size]));
        let (b_ih, b_hh) = (get("bias_ih", &[3 * size]), get("bias_hh", &[3 * size]));
        let (x, want) = (get("x", &[rows, frames, inputs]), get("y", &[rows, frames, size]));
        let cell = GruCell::new(&w_ih, &w_hh, &b_ih, &b_hh, inputs).unwrap();
        let (mut h, mut scratch) = (vec![0.0; rows * size], vec![f32::NAN; cell.scratch(rows)]);
        for f in 0..frames {
            cell.step(rows, View::new(&x[f * inputs..], frames * inputs), Source::Fresh, &mut h, &mut scratch);
            for (r, h) in h.chunks_exact(size).enumerate() {
                let want = &want[(r * frames + f) * size..][..size];
                h.iter().zip(want).for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "row {r} frame {f}: {a} {b}"));
            }
        }
        let mut encoded = vec![f32::NAN; rows * size];
        cell.encode(rows, frames, View::new(&x, frames * inputs), &mut encoded, &mut scratch);
        assert_eq!(encoded, h);
    }

    #[test]
    fn one_step_by_hand() {
        // One value: r = s(0.5), z = s(-1), n = tanh(0.25 + r 2 (0.5)), h' = (1 - z) n + z 0.5.
        let cell = GruCell::new(&[0.5, -1.0, 0.25], &[0.0, 0.0, 2.0], &[0.0; 3], &[0.0; 3], 1).unwrap();
        let mut h = [0.5];
        cell.step(1, View::new(&[1.0], 1), Source::Fresh, &mut h, &mut [0.0; 6]);
        assert!((h[0] - 0.648_128_2).abs() < 1e-6, "{}", h[0]);
    }

    #[test]
    fn shapes_that_do_not_agree_are_refused() {
        assert!(GruCell::new(&[0.0; 9], &[0.0; 3], &[0.0; 3], &[0.0; 3], 3).is_ok());
        assert!(GruCell::new(&[0.0; 9], &[0.0; 3], &[0.0; 3], &[0.0; 4], 3).is_err());
        assert!(GruCell::new(&[0.0; 6], &[0.0; 3], &[0.0; 2], &[0.0; 3], 3).is_err());
        assert!(GruCell::new(&[0.0; 9], &[0.0; 6], &[0.0; 3], &[0.0; 3], 3).is_err());
    }
}
