//! Many people stepped together: latent actions in, 20 frames and the next state out. No reward, no learning.

use crate::body::Frame;
use serde::{Deserialize, Serialize};

/// State of n people between two primitives. Flat arrays, person outermost; local = the person's canonical frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct People {
    /// n; canonical-to-world frame of each person's seed.
    pub frames: Vec<Frame>,
    /// n x 10 shape coefficients.
    pub betas: Vec<f32>,
    /// n x 2 x 201 seed markers, local, metres.
    pub markers: Vec<f32>,
    /// n x 2 x 93 seed bodies, local.
    pub params: Vec<f32>,
    /// n x 2 x 24 x 3 seed joints (eyes last), local, metres.
    pub joints: Vec<f32>,
    /// n x 2 x 3 unit viewing directions of the head, local.
    pub views: Vec<f32>,
}

/// The 20 frames of one primitive of n people, in the canonical frames they started from.
#[derive(Clone, Debug, Default)]
pub struct Primitives {
    /// n; canonical-to-world frame of each primitive.
    pub frames: Vec<Frame>,
    /// n x 20 x 201 markers fed back to the model (seed markers first, then blended ones), local.
    pub markers: Vec<f32>,
    /// n x 20 x 93 bodies, local.
    pub params: Vec<f32>,
    /// n x 20 x 24 x 3 joints of the bodies, local.
    pub joints: Vec<f32>,
    /// n x 20 x 3 unit viewing directions of the head, local.
    pub views: Vec<f32>,
}
