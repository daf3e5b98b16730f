//! Measures of motion: one small pure function each, used by rewards, tests and evaluation alike.

mod collapse;
mod contact;
mod diversity;
mod feet;
mod prior;
mod proportions;
mod reach;
mod smoothness;
mod ways;

pub use collapse::{Collapse, collapse};
pub use contact::{Overlap, box_distance, deepest, meets_outline, overlap};
pub use diversity::average_pairwise_distance;
pub use feet::{contact_score, floor_penetration, foot_heights, foot_speeds, stance_moves, stance_slide, stance_slides};
pub use prior::{kl_mean_only, kl_to_standard};
pub use proportions::{bone_length_error, rigid_marker_error};
pub use reach::{final_distance, least_distance, path_length, time_to_reach};
pub use smoothness::{accelerations, jerks};
pub use ways::{entropy, pairwise_path_distance, passes_left, resample};
