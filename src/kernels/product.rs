//! General matrix products for training, where no operand is worth packing ahead.

use gemm::Parallelism;

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

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    #[should_panic(expected = "inner sizes differ")]
    fn wrong_shapes_are_refused() {
        product(Mat::new(&[0.0; 2], 1, 2), Mat::new(&[0.0; 3], 3, 1), &mut [0.0], 1, false);
    }
}
