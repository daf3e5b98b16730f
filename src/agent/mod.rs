//! How a policy sees and acts: observation layout, network, action distribution.

mod action;
pub mod authors;
pub mod bundle;
mod categorical;
mod config;
mod gaussian;
mod init;
mod network;
mod spec;

pub use action::ActionSpace;
pub use categorical::{categorical, choice_at, likeliest, log_softmax_of};
pub use config::{ActorScale, Init, LAYOUT_VERSION, Nonlinearity, ObsGroup, ObsLayout, PolicyConfig, StateNoise};
pub use gaussian::{NOISE_EPS, entropy, kl_to_prior, log_prob, log_prob_of, state_logvar};
pub use network::{Network, Output, SLOPE};
pub use spec::{Dense, Encoder, Part, PolicySpec};
