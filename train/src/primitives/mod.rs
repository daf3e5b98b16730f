//! Training and evaluation of the motion-primitive model.

pub mod adam;
pub mod bodies;
pub mod eval;
pub mod export;
pub mod fit;
pub mod gait;
pub mod init;
pub mod layers;
pub mod loss;
pub mod pose;
pub mod predictor;
pub mod progress;
pub mod regressor;
pub mod report;
pub mod sample;
pub mod seeds;
pub mod settings;
pub mod steer;
