//! Training and evaluation of the motion-primitive model.

pub mod init;
pub mod layers;
pub mod loss;
pub mod predictor;
