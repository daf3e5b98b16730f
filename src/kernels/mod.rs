//! Fast f32 inference on the processor, for the frozen networks and for acting.
//!
//! A product runs over weights packed once into column panels; bias, activation and residual are applied while a tile is
//! in the first-level cache. Every element is one chain of fused multiply-adds over the inputs in their order, so a row's
//! result is the same bits on every instruction set, in every batch and on any number of threads.
//! Training uses general products instead (`product`). This is the only module with `unsafe`: in `simd`, `product` and `memory`.

mod engine;
mod gru;
mod linear;
mod memory;
mod motion;
mod policy;
mod pool;
mod product;
mod simd;

pub use engine::MotionEngine;
pub use gru::GruCell;
pub use linear::{Activation, Linear, Source, View, ViewMut};
pub use memory::keep_memory;
pub use motion::{Decoder, Regressor};
pub use policy::PolicyEngine;
pub use product::{Mat, product};
