//! Loops written with intrinsics.

use super::linear::Activation;
use super::simd::{Ahead, Finish, Lane, TANH_END, TANH_P, TANH_Q};
use std::arch::x86_64::*;

/// # Safety
/// The processor has AVX-512F; `out` has at most 12 rows; `x` holds every input of them at the strides (row, input), one of which is 1.
#[target_feature(enable = "avx512f")]
pub unsafe fn product_512(x: *const f32, [row, input]: [usize; 2], panel: &[Lane], ahead: Ahead, out: &mut [Lane]) {
    macro_rules! rows {
        ($across:literal, $stride:expr, $($n:literal)*) => {
            // SAFETY: the caller's promise, with exactly `$n` rows.
            match out.len() { $($n => unsafe { tile_512::<$n, $across>(x, $stride, panel, 0, ahead, out) },)* _ => {} }
        };
    }
    match input {
        1 => rows!(false, row, 1 2 3 4 5 6 7 8 9 10 11 12),
        _ => rows!(true, input, 1 2 3 4 5 6 7 8 9 10 11 12),
    }
}

/// Makes `$name::<R, ACROSS>(x, stride, panel, first, ahead, out)`, the tile of `R` rows and two vectors from output `first` of the panel on.
/// `stride` is that of the rows, or of the inputs if `ACROSS`; the other one is 1.
macro_rules! tile {
    ($name:ident, $feature:literal, $floats:literal, $thirds:literal, $zero:ident, $load:ident, $broadcast:ident, $fmadd:ident, $store:ident) => {
        /// # Safety
        /// The processor has the features; `out` has `R` rows; `x` holds every input of them.
        #[target_feature(enable = $feature)]
        unsafe fn $name<const R: usize, const ACROSS: bool>(
            x: *const f32,
            stride: usize,
            panel: &[Lane],
            first: usize,
            ahead: Ahead,
            out: &mut [Lane],
        ) {
            let (row, input) = if ACROSS { (1, stride) } else { (stride, 1) };
            let mut sum = [[$zero(); 2]; R];
            // Every third row, hidden from the compiler, which would work out all rows' addresses from the first one each time and run
            // short of registers: the processor adds none, one or two rows while it loads.
            let mut thirds: [_; $thirds] = std::array::from_fn(|i| std::hint::black_box(x.wrapping_add(3 * i * row)));
            macro_rules! add {
                ($k:expr, $lane:expr) => {
                    // SAFETY: a lane is 32 floats on a cache line; row and input are within `x`.
                    unsafe {
                        let w = $lane.0.as_ptr().add(first);
                        let w = [$load(w), $load(w.add($floats))];
                        for (r, sum) in sum.iter_mut().enumerate() {
                            let v = $broadcast(*thirds[r / 3].add(r % 3 * row + $k * input));
                            sum[0] = $fmadd(v, w[0], sum[0]);
                            sum[1] = $fmadd(v, w[1], sum[1]);
                        }
                    }
                };
            }
            let (fours, rest) = panel.as_chunks::<4>();
            let (mut at, step) = (ahead.start, ahead.bytes / (2 * fours.len()).max(1));
            for four in fours {
                // Four inputs share the steps of all addresses, which would otherwise keep the multipliers waiting.
                _mm_prefetch::<_MM_HINT_T1>(at.cast());
                add!(0, four[0]);
                add!(1, four[1]);
                _mm_prefetch::<_MM_HINT_T1>(at.wrapping_add(step).cast());
                add!(2, four[2]);
                add!(3, four[3]);
                at = at.wrapping_add(2 * step);
                thirds = thirds.map(|x| x.wrapping_add(4 * input));
            }
            for (k, lane) in rest.iter().enumerate() {
                add!(k, lane);
            }
            for (sum, out) in sum.iter().zip(out) {
                // SAFETY: as above.
                unsafe {
                    let out = out.0.as_mut_ptr().add(first);
                    $store(out, sum[0]);
                    $store(out.add($floats), sum[1]);
                }
            }
        }
    };
}

tile!(tile_512, "avx512f", 16, 4, _mm512_setzero_ps, _mm512_load_ps, _mm512_set1_ps, _mm512_fmadd_ps, _mm512_store_ps);
tile!(tile_256, "avx2,fma", 8, 2, _mm256_setzero_ps, _mm256_load_ps, _mm256_set1_ps, _mm256_fmadd_ps, _mm256_store_ps);

/// # Safety
/// The processor has AVX-512F; the rows of `y` and those to add, `how.width` floats each, are there.
#[target_feature(enable = "avx512f")]
pub unsafe fn finish_512(tile: &[Lane], how: &Finish, y: *mut f32, stride: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        match how.activation {
            Activation::None => finish_rows(tile, how, y, stride, |v| v),
            Activation::Tanh => finish_rows(tile, how, y, stride, |v| tanh_512(v)),
            Activation::Sigmoid => {
                let half = _mm512_set1_ps(0.5);
                finish_rows(tile, how, y, stride, |v| _mm512_fmadd_ps(tanh_512(_mm512_mul_ps(half, v)), half, half));
            }
            // The second operand is what comes out where one is not a number.
            Activation::Relu => finish_rows(tile, how, y, stride, |v| _mm512_max_ps(_mm512_setzero_ps(), v)),
            Activation::LeakyRelu(slope) => finish_rows(tile, how, y, stride, |v| {
                let negative = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(v, _mm512_setzero_ps());
                _mm512_mask_mul_ps(v, negative, v, _mm512_set1_ps(slope))
            }),
        }
    }
}

/// # Safety
/// As `finish_512`.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn finish_rows(tile: &[Lane], how: &Finish, y: *mut f32, stride: usize, activate: impl Fn(__m512) -> __m512) {
    for half in [0, 16].into_iter().filter(|&half| half < how.width) {
        let mask = first_512(how.width - half);
        // SAFETY: lanes are 32 floats; only the first `how.width` of a row are touched.
        unsafe {
            let bias = _mm512_load_ps(how.bias.0.as_ptr().add(half));
            for (r, lane) in tile.iter().enumerate() {
                let mut v = _mm512_add_ps(_mm512_load_ps(lane.0.as_ptr().add(half)), bias);
                if let Some((rows, stride)) = how.plus {
                    v = _mm512_add_ps(v, _mm512_maskz_loadu_ps(mask, rows.as_ptr().add(r * stride + half)));
                }
                v = activate(v);
                let y = y.add(r * stride + half);
                if how.residual {
                    v = _mm512_add_ps(v, _mm512_maskz_loadu_ps(mask, y));
                }
                _mm512_mask_storeu_ps(y, mask, v);
            }
        }
    }
}

/// A mask of the first `n` of 16.
fn first_512(n: usize) -> __mmask16 {
    if n < 16 { (1 << n) - 1 } else { !0 }
}

/// tanh as `simd::tanh` has it.
#[inline]
#[target_feature(enable = "avx512f")]
fn tanh_512(x: __m512) -> __m512 {
    let x = _mm512_min_ps(_mm512_set1_ps(TANH_END), _mm512_max_ps(_mm512_set1_ps(-TANH_END), x));
    let x2 = _mm512_mul_ps(x, x);
    let (mut p, mut q) = (_mm512_set1_ps(TANH_P[0]), _mm512_set1_ps(TANH_Q[0]));
    for c in &TANH_P[1..] {
        p = _mm512_fmadd_ps(p, x2, _mm512_set1_ps(*c));
    }
    for c in &TANH_Q[1..] {
        q = _mm512_fmadd_ps(q, x2, _mm512_set1_ps(*c));
    }
    _mm512_div_ps(_mm512_mul_ps(x, p), q)
}

/// # Safety
/// The processor has AVX-512F; `rows` points to `count` (at most 32) rows of `panel.len()` floats, `stride` apart.
#[target_feature(enable = "avx512f")]
pub unsafe fn transpose_512(rows: *const f32, stride: usize, count: usize, panel: &mut [Lane]) {
    for (block, lanes) in panel.chunks_mut(16).enumerate() {
        let mask = first_512(lanes.len());
        for half in [0, 16] {
            let mut block_16 = [_mm512_setzero_ps(); 16];
            for (r, row) in block_16.iter_mut().enumerate().take(count.saturating_sub(half)) {
                // SAFETY: row and columns are there, the mask leaves out those that are not.
                *row = unsafe { _mm512_maskz_loadu_ps(mask, rows.add((half + r) * stride + 16 * block)) };
            }
            for (lane, column) in lanes.iter_mut().zip(transpose_16(block_16)) {
                // SAFETY: a lane is 32 floats on a cache line.
                unsafe { _mm512_store_ps(lane.0.as_mut_ptr().add(half), column) };
            }
        }
    }
}

/// The columns of 16 rows.
#[inline]
#[target_feature(enable = "avx512f")]
fn transpose_16(r: [__m512; 16]) -> [__m512; 16] {
    let mut a = [_mm512_setzero_pd(); 16];
    for i in 0..8 {
        a[2 * i] = _mm512_castps_pd(_mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]));
        a[2 * i + 1] = _mm512_castps_pd(_mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]));
    }
    // Within every quarter of a register: b[4 i + j] holds column j of the rows 4 i to 4 i + 3.
    let mut b = [_mm512_setzero_ps(); 16];
    for i in 0..4 {
        for j in 0..2 {
            b[4 * i + 2 * j] = _mm512_castpd_ps(_mm512_unpacklo_pd(a[4 * i + j], a[4 * i + 2 + j]));
            b[4 * i + 2 * j + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a[4 * i + j], a[4 * i + 2 + j]));
        }
    }
    let mut out = r;
    for j in 0..4 {
        let evens = [_mm512_shuffle_f32x4::<0x88>(b[j], b[4 + j]), _mm512_shuffle_f32x4::<0x88>(b[8 + j], b[12 + j])];
        let odds = [_mm512_shuffle_f32x4::<0xdd>(b[j], b[4 + j]), _mm512_shuffle_f32x4::<0xdd>(b[8 + j], b[12 + j])];
        out[j] = _mm512_shuffle_f32x4::<0x88>(evens[0], evens[1]);
        out[8 + j] = _mm512_shuffle_f32x4::<0xdd>(evens[0], evens[1]);
        out[4 + j] = _mm512_shuffle_f32x4::<0x88>(odds[0], odds[1]);
        out[12 + j] = _mm512_shuffle_f32x4::<0xdd>(odds[0], odds[1]);
    }
    out
}

/// # Safety
/// The processor has AVX2 and FMA; otherwise as `product_512`.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn product_256(x: *const f32, [row, input]: [usize; 2], panel: &[Lane], ahead: Ahead, out: &mut [Lane]) {
    // Sixteen registers: tiles of at most 6 rows x 16 outputs.
    let groups = out.len().div_ceil(6);
    let rows = out.len().div_ceil(groups);
    for (group, out) in out.chunks_mut(rows).enumerate() {
        for half in 0..2 {
            let ahead = ahead.part(2 * group + half, 2 * groups);
            macro_rules! rows {
                ($across:literal, $stride:expr, $($n:literal)*) => {
                    // SAFETY: the caller's promise, with exactly `$n` rows.
                    match out.len() { $($n => unsafe { tile_256::<$n, $across>(x.add(group * rows * row), $stride, panel, 16 * half, ahead, out) },)* _ => {} }
                };
            }
            match input {
                1 => rows!(false, row, 1 2 3 4 5 6),
                _ => rows!(true, input, 1 2 3 4 5 6),
            }
        }
    }
}

/// # Safety
/// The processor has AVX2; `rows` points to 8 rows of 8 floats, `stride` apart.
#[target_feature(enable = "avx2")]
unsafe fn columns_8(rows: *const f32, stride: usize) -> [__m256; 8] {
    // SAFETY: the caller's promise.
    let r: [__m256; 8] = std::array::from_fn(|r| unsafe { _mm256_loadu_ps(rows.add(r * stride)) });
    // Within either half of a register: b[4 i + j] holds column j of the rows 4 i to 4 i + 3.
    let mut b = r;
    for i in 0..2 {
        let [low, high] =
            [0, 2].map(|k| (_mm256_unpacklo_ps(r[4 * i + k], r[4 * i + k + 1]), _mm256_unpackhi_ps(r[4 * i + k], r[4 * i + k + 1])));
        b[4 * i] = _mm256_shuffle_ps::<0x44>(low.0, high.0);
        b[4 * i + 1] = _mm256_shuffle_ps::<0xee>(low.0, high.0);
        b[4 * i + 2] = _mm256_shuffle_ps::<0x44>(low.1, high.1);
        b[4 * i + 3] = _mm256_shuffle_ps::<0xee>(low.1, high.1);
    }
    std::array::from_fn(|j| match j {
        0..4 => _mm256_permute2f128_ps::<0x20>(b[j], b[4 + j]),
        _ => _mm256_permute2f128_ps::<0x31>(b[j - 4], b[j]),
    })
}

/// # Safety
/// The processor has AVX2; `rows` points to 32 rows of `panel.len()` floats, `stride` apart.
#[target_feature(enable = "avx2")]
pub unsafe fn transpose_256(rows: *const f32, stride: usize, panel: &mut [Lane]) {
    let (eights, rest) = panel.as_chunks_mut::<8>();
    let whole = 8 * eights.len();
    for (block, lanes) in eights.iter_mut().enumerate() {
        for first in [0, 8, 16, 24] {
            // SAFETY: eight of the rows, eight of their floats; a lane is 32 floats on a cache line.
            unsafe {
                for (lane, column) in lanes.iter_mut().zip(columns_8(rows.add(first * stride + 8 * block), stride)) {
                    _mm256_store_ps(lane.0.as_mut_ptr().add(first), column);
                }
            }
        }
    }
    for (k, lane) in rest.iter_mut().enumerate() {
        // SAFETY: the caller's promise.
        lane.0 = std::array::from_fn(|r| unsafe { *rows.add(r * stride + whole + k) });
    }
}
