//! Recorded motion as files for other programs.

mod buffer;
mod gltf;

pub use gltf::{glb, write_glb};
