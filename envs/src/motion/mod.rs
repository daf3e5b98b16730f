//! The motion task: people walk to a goal round an obstacle, acting through the latents of a motion-primitive model.

mod cast;
mod config;
mod crowd;
mod env;
mod member;
mod rewards;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod toy;

pub use cast::{Cast, Mover, Order, Place, Role};
pub use config::{MotionTask, PoseCheck, Weights};
pub use crowd::{Form, Penetration, Presence};
pub use env::{MotionEnv, Starts};
pub use member::blocked;
pub use rewards::{Outcome, OwnTerm, TERMS, Term};

/// Figures of an episode: whether it arrived (cleanly, where penetrations end episodes), whether it had a penetration, its steps, the sum of its rewards,
/// the final 3-D distance from pelvis to goal, the smallest one in the plane at any frame (metres), whether more than 2
/// steps ended within 0.3 m of the goal without arriving, the pelvis's walked path in the plane (metres), and in rooms the mean
/// number of vertices (of SMPL-X) inside what stands there.
pub const EPISODE: [&str; 9] = ["success", "penetration", "steps", "return", "final_dist", "min_dist", "hover", "path_len", "inside"];
