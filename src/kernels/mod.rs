//! Fast f32 loops on the processor: inference, for the frozen networks and for acting, and points of bodies among obstacles.
//!
//! A product runs over weights packed once into column panels; bias, activation and residual are applied while a tile is
//! in the first-level cache. Every element is one chain of fused multiply-adds over the inputs in their order, so a row's
//! result is the same bits on every instruction set, in every batch and on any number of threads.
//! Training uses general products and layers over plain weights instead (`product`). This is the only module with `unsafe`: in `simd`, `x86`, `points`, `product` and
//! `memory`.

mod engine;
mod gru;
mod linear;
mod memory;
mod motion;
mod points;
mod policy;
mod pool;
mod product;
mod simd;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use engine::MotionEngine;
pub use gru::GruCell;
pub use linear::{Activation, Linear, Source, View, ViewMut};
pub use memory::keep_memory;
pub use motion::{Decoder, Regressor};
pub use points::{Bone, Group, LANES, Lanes, Probe, Pulls};
pub use policy::PolicyEngine;
pub use product::{Mat, dense, product};

/// Where the first value lies that is infinite or not a number. Looks at whole slices at once, which nearly always have none.
pub fn first_not_finite(values: &[f32]) -> Option<usize> {
    let all = values.iter().fold(true, |all, v| all & v.is_finite());
    if all { None } else { values.iter().position(|v| !v.is_finite()) }
}
