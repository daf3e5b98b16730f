//! Motion: clips, canonical primitives, the motion-primitive model.

pub mod amass;
pub mod asf;
pub mod augment;
pub mod authors;
pub mod bvh;
pub mod canonical;
pub mod clean;
pub mod clip;
pub mod cmu;
mod config;
pub mod dataset;
pub mod footlock;
#[cfg(test)]
pub(crate) mod fuzz;
pub mod ik;
mod import;
mod layers;
mod mend;
mod named;
mod net;
pub mod pose_prior;
pub mod poses;
mod predictor;
pub mod primitive;
mod regressor;
pub mod resample;
pub mod retarget;
pub mod samp;
mod weights;

pub use config::{CONTINUOUS, MotionConfig, Origin, PredictorSizes, RegressorSizes};
pub use dataset::{BuildReport, build};
pub use import::{ImportOptions, Recorded, import};
pub use layers::{Dense, Gru, Named, Parameters};
pub use pose_prior::PosePrior;
pub use predictor::Predictor;
pub use primitive::{ClipMarkers, MotionSet};
pub use regressor::Regressor;
pub use weights::{CONFIG_FILE, MotionWeights, PREDICTOR_FILE, PredictorWeights, REGRESSOR_FILE, RegressorWeights};

use crate::Result;

/// Frames per second of all motion.
pub const FPS: f32 = 40.0;
/// Frames of a primitive.
pub const FRAMES: usize = 20;
/// Seed (history) frames of a primitive.
pub const SEED: usize = 2;
/// Predicted frames of a primitive; one environment step, 0.45 s.
pub const FUTURE: usize = FRAMES - SEED;
/// Latent dimensions of the paper's predictor.
pub const LATENT: usize = 128;

/// A generative motion-primitive model as the simulation sees it: flat arrays, person outermost.
pub trait MotionModel: Send + Sync {
    /// Dimensions of the latent.
    fn latent_dim(&self) -> usize;

    /// Future markers. `seed`: n x 2 x 201 metres in the canonical frame; `latent`: n x latent_dim; `out`: n x 18 x 201.
    fn decode(&self, seed: &[f32], latent: &[f32], out: &mut [f32]) -> Result<()>;

    /// Body parameters from markers. `markers`: m x 201; `betas`: m x 10; `out`: m x 93, in the frame of the markers.
    fn regress(&self, markers: &[f32], betas: &[f32], out: &mut [f32]) -> Result<()>;

    /// Content hash of the weights, which a policy trained on this model names.
    fn hash(&self) -> &str;

    /// Where the canonical frames of what [`MotionModel::decode`] and [`MotionModel::regress`] read and write have their origin. The
    /// simulation's own are above the floor; it lowers and lifts what it exchanges with a model of the other kind.
    fn origin(&self) -> Origin {
        Origin::Floor
    }

    /// The latent's dimensions, those that move people most first.
    fn active(&self) -> Vec<usize> {
        (0..self.latent_dim()).collect()
    }

    /// Whether the simulation carries the bodies it makes by the foot that bears them, see [`crate::sim::Sim::step`].
    fn planted(&self) -> bool {
        false
    }
}
