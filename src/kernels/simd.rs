//! Instruction-set dependent loops, chosen at run time: AVX-512, AVX2 with FMA, portable.
//!
//! Only the inner product of a tile is written with intrinsics. The element-wise loops are plain Rust that is inlined into
//! a function with the right target features and vectorised there.

use super::linear::Activation;

/// Outputs of a weight panel.
pub const PANEL: usize = 32;
/// Most rows of a tile: 12 x 2 AVX-512 accumulators leave registers for the weights and one input.
pub const GROUP: usize = 12;

/// One input's weights for the outputs of a panel, or one row of a tile; aligned to a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Lane(pub [f32; PANEL]);

/// Instruction set of the loops. Only `Isa::available` makes values, so the processor has what a value names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Portable,
}

impl Isa {
    /// Instruction sets that this processor has, best first.
    pub fn available() -> impl Iterator<Item = Isa> {
        [
            #[cfg(target_arch = "x86_64")]
            is_x86_feature_detected!("avx512f").then_some(Isa::Avx512),
            #[cfg(target_arch = "x86_64")]
            (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Isa::Avx2),
            Some(Isa::Portable),
        ]
        .into_iter()
        .flatten()
    }

    /// The best instruction set of this processor.
    pub fn best() -> Isa {
        Self::available().next().unwrap_or(Isa::Portable)
    }
}

/// Makes `$name(isa, args)` from the inlined `$body(args)`, compiled once for each instruction set.
macro_rules! multiversion {
    ($(#[$doc:meta])* $name:ident = $body:ident($($arg:ident: $ty:ty),*)) => {
        $(#[$doc])*
        pub fn $name(isa: Isa, $($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f")]
            fn avx512($($arg: $ty),*) {
                $body($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $ty),*) {
                $body($($arg),*)
            }
            match isa {
                // SAFETY: the processor has the features, the value of `isa` says so.
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => unsafe { avx2($($arg),*) },
                Isa::Portable => $body($($arg),*),
            }
        }
    };
}
pub(super) use multiversion;

multiversion! {
    /// Adds `bias` to the rows of a tile and applies the activation.
    finish = finish_body(rows: &mut [Lane], bias: &Lane, activation: Activation)
}

#[inline(always)]
fn finish_body(rows: &mut [Lane], bias: &Lane, activation: Activation) {
    for row in rows {
        for (v, b) in row.0.iter_mut().zip(&bias.0) {
            *v += b;
        }
        activate(&mut row.0, activation);
    }
}

multiversion! {
    /// Applies `activation` to every value.
    apply = activate(values: &mut [f32], activation: Activation)
}

#[inline(always)]
fn activate(values: &mut [f32], activation: Activation) {
    match activation {
        Activation::None => {}
        Activation::Tanh => values.iter_mut().for_each(|v| *v = tanh(*v)),
        Activation::Sigmoid => values.iter_mut().for_each(|v| *v = sigmoid(*v)),
        Activation::Relu => values.iter_mut().for_each(|v| *v = if *v < 0.0 { 0.0 } else { *v }),
        Activation::LeakyRelu(slope) => values.iter_mut().for_each(|v| *v = if *v < 0.0 { slope * *v } else { *v }),
    }
}

multiversion! {
    /// Gates of a GRU for one row. `input`, `hidden`: the products with bias, 3 H in the order r, z, n; `h`: H, updated.
    gates = gates_body(input: &[f32], hidden: &[f32], h: &mut [f32])
}

#[inline(always)]
fn gates_body(input: &[f32], hidden: &[f32], h: &mut [f32]) {
    let n = h.len();
    let (ir, iz, in_) = (&input[..n], &input[n..2 * n], &input[2 * n..3 * n]);
    let (hr, hz, hn) = (&hidden[..n], &hidden[n..2 * n], &hidden[2 * n..3 * n]);
    for i in 0..n {
        let r = sigmoid(ir[i] + hr[i]);
        let z = sigmoid(iz[i] + hz[i]);
        let new = tanh(r.mul_add(hn[i], in_[i]));
        h[i] = z.mul_add(h[i] - new, new);
    }
}

/// Hyperbolic tangent as an odd rational function of degree 13 over 6, error below 4e-7; not a number stays so.
#[inline(always)]
fn tanh(x: f32) -> f32 {
    const P: [f32; 7] = [-2.760_768_5e-16, 2.000_188e-13, -8.604_672e-11, 5.122_297_3e-8, 1.485_722_4e-5, 6.372_619_4e-4, 4.893_524_6e-3];
    const Q: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_7e-3, 4.893_525_3e-3];
    // Beyond this the function is one to the last bit, and the fraction would leave [-1, 1].
    let x = x.clamp(-7.905_311, 7.905_311);
    let x2 = x * x;
    let p = P[1..].iter().fold(P[0], |s, &c| s.mul_add(x2, c));
    let q = Q[1..].iter().fold(Q[0], |s, &c| s.mul_add(x2, c));
    x * p / q
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    tanh(0.5 * x).mul_add(0.5, 0.5)
}

/// `out[r] = x[r] W` for `out.len()` rows (at most `GROUP`) that lie `stride` apart in `x`; `panel` has one lane per input.
///
/// # Panics
/// If `x` is too short.
pub fn product(isa: Isa, x: &[f32], stride: usize, panel: &[Lane], out: &mut [Lane]) {
    assert!(out.len() <= GROUP && (out.is_empty() || x.len() >= (out.len() - 1) * stride + panel.len()));
    match isa {
        // SAFETY: the processor has the features; the length of `x` was checked.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => unsafe { x86::product_512(x.as_ptr(), stride, panel, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => unsafe { x86::product_256(x.as_ptr(), stride, panel, out) },
        Isa::Portable => product_portable(x, stride, panel, out),
    }
}

fn product_portable(x: &[f32], stride: usize, panel: &[Lane], out: &mut [Lane]) {
    for (row, out) in out.iter_mut().enumerate() {
        let mut sum = [0.0; PANEL];
        for (x, lane) in x[row * stride..].iter().zip(panel) {
            for (s, w) in sum.iter_mut().zip(&lane.0) {
                *s = x.mul_add(*w, *s);
            }
        }
        out.0 = sum;
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Lane;
    use std::arch::x86_64::*;

    /// # Safety
    /// The processor has AVX-512F; `x` points to `(out.len() - 1) * stride + panel.len()` floats; `out` has at most 12 rows.
    #[target_feature(enable = "avx512f")]
    pub unsafe fn product_512(x: *const f32, stride: usize, panel: &[Lane], out: &mut [Lane]) {
        macro_rules! rows {
            ($($n:literal)*) => {
                // SAFETY: the caller's promise, with exactly `$n` rows.
                match out.len() { $($n => unsafe { tile_512::<$n>(x, stride, panel, out) },)* _ => {} }
            };
        }
        rows!(1 2 3 4 5 6 7 8 9 10 11 12)
    }

    /// # Safety
    /// As `product_512`, and `out` has `R` rows.
    #[target_feature(enable = "avx512f")]
    unsafe fn tile_512<const R: usize>(x: *const f32, stride: usize, panel: &[Lane], out: &mut [Lane]) {
        let mut sum = [[_mm512_setzero_ps(); 2]; R];
        for (k, lane) in panel.iter().enumerate() {
            // SAFETY: a lane is 32 floats on a cache line; row and input are within `x`.
            unsafe {
                let w = [_mm512_load_ps(lane.0.as_ptr()), _mm512_load_ps(lane.0.as_ptr().add(16))];
                for (row, sum) in sum.iter_mut().enumerate() {
                    let v = _mm512_set1_ps(*x.add(row * stride + k));
                    sum[0] = _mm512_fmadd_ps(v, w[0], sum[0]);
                    sum[1] = _mm512_fmadd_ps(v, w[1], sum[1]);
                }
            }
        }
        for (sum, out) in sum.iter().zip(out) {
            // SAFETY: as above.
            unsafe {
                _mm512_store_ps(out.0.as_mut_ptr(), sum[0]);
                _mm512_store_ps(out.0.as_mut_ptr().add(16), sum[1]);
            }
        }
    }

    /// # Safety
    /// The processor has AVX2 and FMA; otherwise as `product_512`.
    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn product_256(x: *const f32, stride: usize, panel: &[Lane], out: &mut [Lane]) {
        // Sixteen registers: tiles of 6 rows x 16 outputs.
        for (group, out) in out.chunks_mut(6).enumerate() {
            for half in 0..2 {
                macro_rules! rows {
                    ($($n:literal)*) => {
                        // SAFETY: the caller's promise, with exactly `$n` rows.
                        match out.len() { $($n => unsafe { tile_256::<$n>(x.add(group * 6 * stride), stride, panel, half, out) },)* _ => {} }
                    };
                }
                rows!(1 2 3 4 5 6)
            }
        }
    }

    /// # Safety
    /// As `product_256`; `out` has `R` rows; `half` is 0 or 1.
    #[target_feature(enable = "avx2,fma")]
    unsafe fn tile_256<const R: usize>(x: *const f32, stride: usize, panel: &[Lane], half: usize, out: &mut [Lane]) {
        let mut sum = [[_mm256_setzero_ps(); 2]; R];
        for (k, lane) in panel.iter().enumerate() {
            // SAFETY: a lane is 32 floats on a cache line; row and input are within `x`.
            unsafe {
                let w = lane.0.as_ptr().add(16 * half);
                let w = [_mm256_load_ps(w), _mm256_load_ps(w.add(8))];
                for (row, sum) in sum.iter_mut().enumerate() {
                    let v = _mm256_set1_ps(*x.add(row * stride + k));
                    sum[0] = _mm256_fmadd_ps(v, w[0], sum[0]);
                    sum[1] = _mm256_fmadd_ps(v, w[1], sum[1]);
                }
            }
        }
        for (sum, out) in sum.iter().zip(out) {
            // SAFETY: as above.
            unsafe {
                let out = out.0.as_mut_ptr().add(16 * half);
                _mm256_store_ps(out, sum[0]);
                _mm256_store_ps(out.add(8), sum[1]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Vec<f32> {
        (-200_000..=200_000).map(|i| i as f32 * 6e-5).chain([-1e30, 1e30, f32::INFINITY, f32::NEG_INFINITY, 1e-20, -0.0]).collect()
    }

    #[test]
    fn tanh_and_sigmoid_match_double_precision() {
        for isa in Isa::available() {
            let (mut t, mut s) = (grid(), grid());
            apply(isa, &mut t, Activation::Tanh);
            apply(isa, &mut s, Activation::Sigmoid);
            for ((x, t), s) in grid().into_iter().zip(t).zip(s) {
                let x = f64::from(x);
                assert!((f64::from(t) - x.tanh()).abs() < 4e-7, "{isa:?} tanh {x}: {t}");
                assert!((f64::from(s) - 1.0 / (1.0 + (-x).exp())).abs() < 4e-7, "{isa:?} sigmoid {x}: {s}");
                assert!(t.abs() <= 1.0 && (0.0..=1.0).contains(&s), "{isa:?} range at {x}: {t} {s}");
            }
        }
    }

    #[test]
    fn rectifiers_by_hand() {
        for isa in Isa::available() {
            let (mut relu, mut leaky) = ([-2.0, 0.0, 3.0], [-2.0, 0.0, 3.0]);
            apply(isa, &mut relu, Activation::Relu);
            apply(isa, &mut leaky, Activation::LeakyRelu(0.25));
            assert_eq!(relu, [0.0, 0.0, 3.0]);
            assert_eq!(leaky, [-0.5, 0.0, 3.0]);
        }
    }

    #[test]
    fn not_a_number_stays_visible() {
        let all = [Activation::Tanh, Activation::Sigmoid, Activation::Relu, Activation::LeakyRelu(0.1), Activation::None];
        for (isa, activation) in Isa::available().flat_map(|i| all.map(|a| (i, a))) {
            let mut x = [f32::NAN; 19];
            apply(isa, &mut x, activation);
            assert!(x.iter().all(|v| v.is_nan()), "{isa:?} {activation:?}");
        }
    }
}
