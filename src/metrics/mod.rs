//! Measures of motion: one small pure function each, used by rewards, tests and evaluation alike.

mod feet;
mod prior;
mod proportions;

pub use feet::{contact_score, floor_penetration, foot_heights, foot_speeds, stance_slide};
pub use prior::{kl_mean_only, kl_to_standard};
pub use proportions::{bone_length_error, rigid_marker_error};
