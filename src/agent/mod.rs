//! How a policy sees and acts: observation layout, network, action distribution.

pub mod bundle;
mod gaussian;
mod init;
mod network;
mod spec;

pub use gaussian::{entropy, kl_to_prior, log_prob, log_prob_of};
pub use network::{Network, Output, SLOPE};
pub use spec::{ActorScale, Dense, Encoder, LAYOUT_VERSION, ObsGroup, ObsLayout, Part, PolicyConfig, PolicySpec};
