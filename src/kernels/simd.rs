//! Instruction-set dependent loops, chosen at run time: AVX-512, AVX2 with FMA, portable.
//!
//! Products of tiles, transposes and, for AVX-512, what follows the tiles are written with intrinsics (`x86.rs`). The other element-wise loops are plain
//! Rust that is inlined into a function with the right target features and vectorised there.

use super::linear::Activation;
#[cfg(target_arch = "x86_64")]
use super::x86;

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
    /// Applies `activation` to every value.
    apply = activate(values: &mut [f32], activation: Activation)
}

#[inline(always)]
fn activate(values: &mut [f32], activation: Activation) {
    let (blocks, rest) = values.as_chunks_mut::<16>();
    for block in blocks {
        *block = activated(*block, activation);
    }
    for v in rest {
        [*v] = activated([*v], activation);
    }
}

/// Loops, since what a closure does may be compiled apart, without the processor's instructions.
#[inline(always)]
fn activated<const N: usize>(mut x: [f32; N], activation: Activation) -> [f32; N] {
    match activation {
        Activation::None => {}
        Activation::Tanh => {
            for x in &mut x {
                *x = tanh(*x);
            }
        }
        Activation::Sigmoid => {
            for x in &mut x {
                *x = sigmoid(*x);
            }
        }
        // Not in place: to change some of the values would become a store of some lanes, which many processors are slow at.
        Activation::Relu => return std::array::from_fn(|i| if x[i] < 0.0 { 0.0 } else { x[i] }),
        Activation::LeakyRelu(slope) => return std::array::from_fn(|i| if x[i] < 0.0 { slope * x[i] } else { x[i] }),
    }
    x
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

/// tanh as an odd rational function of degree 13 over 6: coefficients from the highest power down.
pub const TANH_P: [f32; 7] =
    [-2.760_768_5e-16, 2.000_188e-13, -8.604_672e-11, 5.122_297_3e-8, 1.485_722_4e-5, 6.372_619_4e-4, 4.893_524_6e-3];
pub const TANH_Q: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_7e-3, 4.893_525_3e-3];
/// Beyond this tanh is one to the last bit, and the fraction would leave [-1, 1].
pub const TANH_END: f32 = 7.905_311;

/// Hyperbolic tangent, error below 4e-7; not a number stays so.
#[inline(always)]
fn tanh(x: f32) -> f32 {
    let x = x.clamp(-TANH_END, TANH_END);
    let x2 = x * x;
    let p = TANH_P[1..].iter().fold(TANH_P[0], |s, &c| s.mul_add(x2, c));
    let q = TANH_Q[1..].iter().fold(TANH_Q[0], |s, &c| s.mul_add(x2, c));
    x * p / q
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    tanh(0.5 * x).mul_add(0.5, 0.5)
}

/// Memory that is wanted soon. It is fetched into the second-level cache while tiles are worked on, since weights come from further away
/// than a tile can wait for.
#[derive(Clone, Copy)]
pub struct Ahead {
    /// Where it lies; only asked for, never read.
    pub start: *const u8,
    pub bytes: usize,
}

impl Ahead {
    pub fn new<T>(memory: &[T]) -> Self {
        Self { start: memory.as_ptr().cast(), bytes: size_of_val(memory) }
    }

    /// The k-th of `n` equal parts.
    pub fn part(self, k: usize, n: usize) -> Self {
        let bytes = self.bytes / n;
        Self { start: self.start.wrapping_add(k * bytes), bytes }
    }
}

/// `out[r] = x[r] W` for `out.len()` rows (at most `GROUP`); `panel` has one lane per input. Input k of row r is
/// `x[r * row + k * input]`, and one of the strides `[row, input]` is 1.
///
/// # Panics
/// If `x` is too short or no stride is 1.
fn product(isa: Isa, x: &[f32], [row, input]: [usize; 2], panel: &[Lane], ahead: Ahead, out: &mut [Lane]) {
    let Some((rows, inputs)) = out.len().checked_sub(1).zip(panel.len().checked_sub(1)) else {
        return out.fill(Lane([0.0; PANEL]));
    };
    assert!(rows < GROUP && x.len() > rows * row + inputs * input && (row == 1 || input == 1));
    match isa {
        // SAFETY: the processor has the features; the length of `x` was checked.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => unsafe { x86::product_512(x.as_ptr(), [row, input], panel, ahead, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => unsafe { x86::product_256(x.as_ptr(), [row, input], panel, ahead, out) },
        Isa::Portable => product_portable(x, [row, input], panel, out),
    }
}

fn product_portable(x: &[f32], [row, input]: [usize; 2], panel: &[Lane], out: &mut [Lane]) {
    for (r, out) in out.iter_mut().enumerate() {
        let mut sum = [0.0; PANEL];
        for (x, lane) in x[r * row..].iter().step_by(input).zip(panel) {
            for (s, w) in sum.iter_mut().zip(&lane.0) {
                *s = x.mul_add(*w, *s);
            }
        }
        out.0 = sum;
    }
}

/// How a tile's sums become outputs: f(sum + bias + plus), added to what is there if `residual`.
#[derive(Clone, Copy)]
pub struct Finish<'a> {
    pub bias: &'a Lane,
    /// Rows of `width` floats, and how far they lie apart.
    pub plus: Option<(&'a [f32], usize)>,
    pub activation: Activation,
    pub residual: bool,
    /// Outputs in use, at most `PANEL`.
    pub width: usize,
}

/// Writes the outputs of a tile to the rows of `y`, which lie `stride` floats apart.
///
/// # Panics
/// If `y` or the rows to add are too short.
fn finish(isa: Isa, tile: &[Lane], how: &Finish, y: &mut [f32], stride: usize) {
    let Some(last) = tile.len().checked_sub(1) else { return };
    assert!(how.width <= PANEL && y.len() >= last * stride + how.width);
    assert!(how.plus.is_none_or(|(rows, stride)| rows.len() >= last * stride + how.width));
    #[cfg(target_arch = "x86_64")]
    if isa == Isa::Avx512 {
        // SAFETY: the processor has the features; the lengths were checked.
        return unsafe { x86::finish_512(tile, how, y.as_mut_ptr(), stride) };
    }
    finish_lanes(isa, tile, how, y, stride);
}

multiversion! {
    /// [`finish`] where no intrinsics do it.
    finish_lanes = finish_lanes_body(tile: &[Lane], how: &Finish, y: &mut [f32], stride: usize)
}

#[inline(always)]
fn finish_lanes_body(tile: &[Lane], how: &Finish, y: &mut [f32], stride: usize) {
    let bias = how.bias.0;
    for (r, lane) in tile.iter().enumerate() {
        // Values of its own: to write to the tile could change bias and rows to add, for all the compiler knows.
        let mut v: [f32; PANEL] = std::array::from_fn(|i| lane.0[i] + bias[i]);
        if let Some((rows, stride)) = how.plus {
            add(&mut v, &rows[r * stride..][..how.width]);
        }
        v = activated(v, how.activation);
        let y = &mut y[r * stride..][..how.width];
        if how.residual {
            add(&mut v, y);
        }
        match <&mut [f32; PANEL]>::try_from(&mut *y) {
            Ok(whole) => *whole = v,
            Err(_) => y.copy_from_slice(&v[..how.width]),
        }
    }
}

/// Adds `more`, at most a panel's values, to the first of `v`.
#[inline(always)]
fn add(v: &mut [f32; PANEL], more: &[f32]) {
    match <&[f32; PANEL]>::try_from(more) {
        Ok(whole) => *v = std::array::from_fn(|i| v[i] + whole[i]),
        Err(_) => v.iter_mut().zip(more).for_each(|(v, m)| *v += m),
    }
}

/// Lane k of `panel` gets value k of every row; `count` (at most `PANEL`) rows lie `stride` floats apart, zeros stand for the others.
///
/// # Panics
/// If `rows` is too short.
pub fn transpose(isa: Isa, rows: &[f32], stride: usize, count: usize, panel: &mut [Lane]) {
    assert!(count <= PANEL && (count == 0 || rows.len() >= (count - 1) * stride + panel.len()));
    #[cfg(target_arch = "x86_64")]
    if isa == Isa::Avx512 {
        // SAFETY: the processor has the features; the length was checked.
        return unsafe { x86::transpose_512(rows.as_ptr(), stride, count, panel) };
    }
    #[cfg(target_arch = "x86_64")]
    if isa == Isa::Avx2 && count == PANEL {
        // SAFETY: as above.
        return unsafe { x86::transpose_256(rows.as_ptr(), stride, panel) };
    }
    for (k, lane) in panel.iter_mut().enumerate() {
        lane.0 = std::array::from_fn(|r| if r < count { rows[r * stride + k] } else { 0.0 });
    }
}

/// Outputs of one panel for `rows` rows: [`product`] and [`finish`], tile by tile. Inputs as for `product`, outputs as for `finish`;
/// meanwhile `ahead` is fetched.
///
/// # Panics
/// If a slice is too short.
pub fn panel_rows(
    isa: Isa,
    rows: usize,
    (x, strides): (&[f32], [usize; 2]),
    panel: &[Lane],
    ahead: Ahead,
    how: &Finish,
    (y, stride): (&mut [f32], usize),
) {
    let groups = rows.div_ceil(GROUP);
    let mut tile = [Lane([0.0; PANEL]); GROUP];
    // Groups of nearly equal size: a last group of one row would waste most of the arithmetic units.
    for g in 0..groups {
        let (start, end) = (g * rows / groups, (g + 1) * rows / groups);
        let tile = &mut tile[..end - start];
        product(isa, x.get(start * strides[0]..).unwrap_or(&[]), strides, panel, ahead.part(g, groups), tile);
        let plus = how.plus.map(|(rows, stride)| (&rows[start * stride..], stride));
        finish(isa, tile, &Finish { plus, ..*how }, &mut y[start * stride..], stride);
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
    fn transposes_and_tiles_are_the_same_on_every_instruction_set() {
        let data: Vec<f32> = (0..40 * 40).map(|i| ((i * 7919 % 1000) as f32 - 500.0) / 500.0).collect();
        for (isa, count, inputs) in
            Isa::available().flat_map(|isa| [(isa, 0, 5), (isa, 1, 33), (isa, 16, 16), (isa, 19, 37), (isa, 32, 40)])
        {
            let mut panel = vec![Lane([9.0; PANEL]); inputs];
            transpose(isa, &data, 40, count, &mut panel);
            for (k, lane) in panel.iter().enumerate() {
                let want: [f32; PANEL] = std::array::from_fn(|r| if r < count { data[40 * r + k] } else { 0.0 });
                assert_eq!(lane.0, want, "{isa:?} {count} x {inputs}");
            }
            // Rows apart, and rows side by side.
            for (strides, rows) in [[40, 1], [1, 40]].into_iter().flat_map(|s| (0..=GROUP).map(move |n| (s, n))) {
                let (mut out, mut want) = (vec![Lane([9.0; PANEL]); rows], vec![Lane([9.0; PANEL]); rows]);
                product(isa, &data, strides, &panel, Ahead::new(&data), &mut out);
                product_portable(&data, strides, &panel, &mut want);
                assert!(out.iter().zip(&want).all(|(a, b)| a.0 == b.0), "{isa:?} {rows} rows at {strides:?}");
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
