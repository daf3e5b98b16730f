//! Measures of motion: one small pure function each, used by rewards, tests and evaluation alike.

mod collapse;
mod diversity;
mod feet;
mod prior;
mod proportions;
mod smoothness;

pub use collapse::{Collapse, collapse};
pub use diversity::average_pairwise_distance;
pub use feet::{contact_score, floor_penetration, foot_heights, foot_speeds, stance_moves, stance_slide, stance_slides};
pub use prior::{kl_mean_only, kl_to_standard};
pub use proportions::{bone_length_error, rigid_marker_error};
pub use smoothness::{accelerations, jerks};
