//! General matrix products for training, where no operand is worth packing ahead.

use super::Activation;
use super::simd::{self, Ahead, Finish, Isa, Lane, PANEL};
use gemm::Parallelism;
use std::cell::RefCell;

/// Most inner indices of a panel, 128 bytes each: the second-level cache holds it beside the rows it meets.
const BLOCK: usize = 1536;

thread_local! {
    static PANEL_MEMORY: RefCell<Vec<Lane>> = const { RefCell::new(vec![]) };
}

/// A matrix seen in a slice.
#[derive(Clone, Copy, Debug)]
pub struct Mat<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Mat<'a> {
    /// A row-major matrix without gaps.
    pub fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        Self::strided(data, rows, cols, cols)
    }

    /// Rows of `cols` floats that lie `stride` apart.
    ///
    /// # Panics
    /// If the last row does not fit.
    pub fn strided(data: &'a [f32], rows: usize, cols: usize, stride: usize) -> Self {
        assert!(rows == 0 || data.len() >= (rows - 1) * stride + cols, "{rows} rows of {cols} at {stride} in {} floats", data.len());
        Self { data, rows, cols, row_stride: stride, col_stride: 1 }
    }

    /// The transpose.
    pub fn t(self) -> Self {
        Self { rows: self.cols, cols: self.rows, row_stride: self.col_stride, col_stride: self.row_stride, ..self }
    }

    /// The floats from an element on; none where there is no such element.
    fn from(&self, row: usize, col: usize) -> &'a [f32] {
        self.data.get(row * self.row_stride + col * self.col_stride..).unwrap_or(&[])
    }
}

/// `dst = a b`, or `dst += a b` if `add`; rows of `dst` lie `stride` floats apart. One thread; always the same bits.
///
/// # Panics
/// If the shapes do not fit.
pub fn product(a: Mat, b: Mat, dst: &mut [f32], stride: usize, add: bool) {
    assert_eq!(a.cols, b.rows, "inner sizes differ");
    let (m, n) = (a.rows, b.cols);
    if m == 0 || n == 0 {
        return;
    }
    assert!(stride >= n && dst.len() >= (m - 1) * stride + n, "{m} x {n} at {stride} in {} floats", dst.len());
    if b.col_stride != 1 {
        return by_panels(a, b, dst, stride, &Ending { bias: &[], activation: Activation::None, add });
    }
    // SAFETY: all three matrices lie within their slices (checked above and when `a` and `b` were made); `dst` overlaps neither.
    unsafe {
        gemm::gemm(
            m,
            n,
            a.cols,
            dst.as_mut_ptr(),
            1,
            stride as isize,
            add,
            a.data.as_ptr(),
            a.col_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.col_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// `dst = f(x W^T + bias)`, rows without gaps. `x`: rows x inputs; `weight`: outputs x inputs; `bias`: outputs. One thread; always the
/// same bits.
///
/// # Panics
/// If the shapes do not fit.
pub fn dense(x: Mat, weight: Mat, bias: &[f32], activation: Activation, dst: &mut [f32]) {
    assert_eq!((x.cols, bias.len(), dst.len()), (weight.cols, weight.rows, x.rows * weight.rows), "inputs, outputs, rows x outputs");
    // Sums of several blocks are whole only at the end.
    let fused = if x.cols <= BLOCK { activation } else { Activation::None };
    by_panels(x, weight.t(), dst, weight.rows, &Ending { bias, activation: fused, add: false });
    if fused != activation {
        activation.apply(dst);
    }
}

/// What becomes of a product.
struct Ending<'a> {
    /// One per column, or none at all.
    bias: &'a [f32],
    /// Of sums of one block.
    activation: Activation,
    /// To what is there.
    add: bool,
}

/// [`product`] with a transposed matrix: the library would gather its columns element by element, so they are turned here, a panel of
/// them at a time, and meet all rows of `a` while they are in the cache.
fn by_panels(a: Mat, b: Mat, dst: &mut [f32], stride: usize, ending: &Ending) {
    if a.rows == 0 {
        return;
    }
    let isa = Isa::best();
    // Blocks of nearly equal length; one of length 0 still writes its zeros.
    let blocks = a.cols.div_ceil(BLOCK).max(1);
    PANEL_MEMORY.with_borrow_mut(|panel| {
        for (first, k) in (0..b.cols).step_by(PANEL).flat_map(|first| (0..blocks).map(move |k| (first, k))) {
            let (inner, end) = (k * a.cols / blocks, (k + 1) * a.cols / blocks);
            let width = PANEL.min(b.cols - first);
            panel.resize(end - inner, Lane([0.0; PANEL]));
            simd::transpose(isa, b.from(inner, first), b.col_stride, width, panel);
            let mut bias = Lane([0.0; PANEL]);
            if k == 0 && !ending.bias.is_empty() {
                bias.0[..width].copy_from_slice(&ending.bias[first..first + width]);
            }
            let how = Finish { bias: &bias, plus: None, activation: ending.activation, residual: ending.add || k > 0, width };
            let x = (a.from(0, inner), [a.row_stride, a.col_stride]);
            let next = b.from(0, first + PANEL);
            let ahead = Ahead::new(&next[..next.len().min(PANEL * b.col_stride)]);
            simd::panel_rows(isa, a.rows, x, panel, ahead, &how, (&mut dst[first..], stride));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::RngExt;

    #[test]
    fn products_by_hand() {
        let a = [1.0, 2.0, 9.0, 3.0, 4.0, 9.0];
        let b = [5.0, 6.0, 7.0, 8.0];
        let mut dst = [1.0; 5];
        product(Mat::strided(&a, 2, 2, 3), Mat::new(&b, 2, 2), &mut dst, 3, false);
        assert_eq!(dst, [19.0, 22.0, 1.0, 43.0, 50.0]);
        product(Mat::strided(&a, 2, 2, 3).t(), Mat::new(&b, 2, 2).t(), &mut dst, 3, true);
        assert_eq!(dst, [19.0 + 23.0, 22.0 + 31.0, 1.0, 43.0 + 34.0, 50.0 + 46.0]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        /// Against double precision, in all four orders of storage, whole and in gaps, fresh and added to.
        #[test]
        fn ragged_shapes_match_double_precision(m in 0usize..40, inner in 0usize..60, n in 0usize..80, gap in 0usize..4, seed in 0u64..1000) {
            let noise = |rows: usize, cols: usize, seed: u64| -> Vec<f32> {
                let mut rng = crate::rng::stream(seed, "products", 0);
                (0..rows * (cols + gap)).map(|_| rng.random_range(-1.0..1.0)).collect()
            };
            for (across, down) in [(false, false), (false, true), (true, false), (true, true)] {
                let (rows, cols) = if across { (inner, m) } else { (m, inner) };
                let a = noise(rows, cols, seed);
                let left = Mat::strided(&a, rows, cols, cols + gap);
                let (height, width) = if down { (n, inner) } else { (inner, n) };
                let b = noise(height, width, seed + 1);
                let right = Mat::strided(&b, height, width, width + gap);
                let (left, right) = (if across { left.t() } else { left }, if down { right.t() } else { right });
                let at = |m: Mat, r: usize, c: usize| f64::from(m.data[r * m.row_stride + c * m.col_stride]);
                let (mut fresh, before) = (vec![9.0; m * (n + gap)], noise(m, n, seed + 2));
                let mut added = before.clone();
                product(left, right, &mut fresh, n + gap, false);
                product(left, right, &mut added, n + gap, true);
                for (r, c) in (0..m).flat_map(|r| (0..n).map(move |c| (r, c))) {
                    let want: f64 = (0..inner).map(|k| at(left, r, k) * at(right, k, c)).sum();
                    let i = r * (n + gap) + c;
                    prop_assert!((f64::from(fresh[i]) - want).abs() < 1e-5, "{r} {c}: {} {want}", fresh[i]);
                    prop_assert!((f64::from(added[i]) - want - f64::from(before[i])).abs() < 1e-5);
                }
                prop_assert!(m * gap == 0 || fresh[n..n + gap] == vec![9.0; gap], "wrote between the rows");
            }
        }
    }

    #[test]
    fn long_sums_are_taken_in_blocks() {
        let n = 2 * BLOCK + 3;
        let (ones, mut dst) = (vec![1.0; n], [0.0; 1]);
        product(Mat::new(&ones, 1, n), Mat::new(&ones, 1, n).t(), &mut dst, 1, false);
        assert_eq!(dst, [n as f32]);
        dense(Mat::new(&ones, 1, n), Mat::new(&ones, 1, n), &[-4.0 - n as f32], Activation::LeakyRelu(0.5), &mut dst);
        assert_eq!(dst, [-2.0]);
    }

    /// x W^T = (3 7 -11; 2 4 -6).
    #[test]
    fn layers_by_hand() {
        let (x, weight, mut y) = ([1.0, 1.0, 0.0, 1.0], [1.0, 2.0, 3.0, 4.0, -5.0, -6.0], [9.0; 6]);
        dense(Mat::new(&x, 2, 2), Mat::new(&weight, 3, 2), &[-10.0, 0.0, 10.0], Activation::Relu, &mut y);
        assert_eq!(y, [0.0, 7.0, 0.0, 0.0, 4.0, 4.0]);
        dense(Mat::new(&[], 0, 2), Mat::new(&weight, 3, 2), &[0.0; 3], Activation::None, &mut []);
    }

    #[test]
    #[should_panic(expected = "inner sizes differ")]
    fn wrong_shapes_are_refused() {
        product(Mat::new(&[0.0; 2], 1, 2), Mat::new(&[0.0; 3], 3, 1), &mut [0.0], 1, false);
    }
}
