//! Virtual humans that walk through scenes guided by what they see.
//!
//! World: metres, seconds, radians, z up, right-handed. See `ARCHITECTURE.md` for the parts and what each may know.

pub mod agent;
pub mod body;
pub mod device;
pub mod error;
pub mod export;
pub mod io;
pub mod kernels;
pub mod metrics;
pub mod motion;
pub mod render;
pub mod rng;
pub mod scene;
pub mod sensing;
pub mod sim;
pub mod torch;

pub use device::DeviceChoice;

pub use error::{Error, Result};
