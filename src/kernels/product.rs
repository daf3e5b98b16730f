//! General matrix products for training, where no operand is worth packing ahead.

use super::Activation;
use super::simd::{self, Finish, GROUP, Isa, Lane, PANEL};
use gemm::Parallelism;
use std::cell::RefCell;
use std::ops::Range;

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
        return by_panels(a, b, dst, stride, add);
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

/// [`product`] with a transposed matrix: the library would gather its columns element by element, so they are turned here, a panel of
/// them at a time, and meet all rows of `a` while they are in the cache.
fn by_panels(a: Mat, b: Mat, dst: &mut [f32], stride: usize, add: bool) {
    let isa = Isa::best();
    let mut tile = [Lane([0.0; PANEL]); GROUP];
    PANEL_MEMORY.with_borrow_mut(|panel| {
        for (first, inner) in (0..b.cols).step_by(PANEL).flat_map(|first| parts(a.cols, BLOCK).map(move |inner| (first, inner))) {
            let width = PANEL.min(b.cols - first);
            panel.resize(inner.len(), Lane([0.0; PANEL]));
            simd::transpose(isa, b.from(inner.start, first), b.col_stride, width, panel);
            let residual = add || inner.start > 0;
            let how = Finish { bias: &Lane([0.0; PANEL]), plus: None, activation: Activation::None, residual, width };
            let ahead = parts(PANEL, PANEL.div_ceil(a.rows.div_ceil(GROUP)));
            for (group, ahead) in parts(a.rows, GROUP).zip(ahead.map(Some).chain(std::iter::repeat(None))) {
                // The next panel's columns come up from memory meanwhile.
                for column in ahead.into_iter().flatten().map(|i| first + PANEL + i).filter(|&i| i < b.cols) {
                    simd::prefetch(b.from(inner.start, column).get(..inner.len()).unwrap_or(&[]));
                }
                let tile = &mut tile[..group.len()];
                simd::product(isa, a.from(group.start, inner.start), [a.row_stride, a.col_stride], panel, tile);
                simd::finish(isa, tile, &how, &mut dst[group.start * stride + first..], stride);
            }
        }
    });
}

/// Ranges of nearly equal length that make up `0..all`, `most` at most; an empty one if there is nothing.
fn parts(all: usize, most: usize) -> impl Iterator<Item = Range<usize>> {
    let count = all.div_ceil(most).max(1);
    (0..count).map(move |i| i * all / count..(i + 1) * all / count)
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
    }

    #[test]
    #[should_panic(expected = "inner sizes differ")]
    fn wrong_shapes_are_refused() {
        product(Mat::new(&[0.0; 2], 1, 2), Mat::new(&[0.0; 3], 3, 1), &mut [0.0], 1, false);
    }
}
