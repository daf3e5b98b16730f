//! What a motion model is: sizes, conventions, and the body it has learned.

use crate::body::{BETAS, BODY_JOINTS, MARKER_DIM};
use crate::io::Tensors;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Floats of a body in the regressor's continuous form: translation 3, rotations 22 x 6, hands 24.
pub const CONTINUOUS: usize = 3 + BODY_JOINTS * 6 + 24;

/// Sizes of the marker predictor; the defaults are the authors'.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictorSizes {
    /// Floats of a frame of markers.
    pub frame: usize,
    /// GRU states and the narrow layers.
    pub hidden: usize,
    /// The first layer of each MLP.
    pub wide: usize,
    /// Latent dimensions.
    pub latent: usize,
}

impl PredictorSizes {
    /// The sizes of a predictor whose tensors are `t`; [`PredictorWeights::read`] then checks every tensor against them.
    ///
    /// # Errors
    /// Names the tensor that is missing.
    pub fn of(t: &Tensors) -> Result<Self> {
        let input = t.shape("x_enc.weight_ih_l0")?;
        Ok(Self {
            frame: input.get(1).copied().unwrap_or(0),
            hidden: input.first().copied().unwrap_or(0) / 3,
            wide: outputs(t, "e_mlp.layers.0")?,
            latent: outputs(t, "e_mu")?,
        })
    }
}

/// Outputs of the dense layer `name`.
fn outputs(t: &Tensors, name: &str) -> Result<usize> {
    Ok(t.shape(&format!("{name}.bias"))?.first().copied().unwrap_or(0))
}

impl Default for PredictorSizes {
    fn default() -> Self {
        Self { frame: MARKER_DIM, hidden: 256, wide: 512, latent: super::LATENT }
    }
}

/// Sizes of the body regressor; the defaults are the authors'.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegressorSizes {
    /// Width of the residual network.
    pub width: usize,
    /// Residual blocks of two layers.
    pub blocks: usize,
    /// Passes, each refining the estimate of the one before.
    pub passes: usize,
}

impl Default for RegressorSizes {
    fn default() -> Self {
        Self { width: 128, blocks: 10, passes: 3 }
    }
}

impl RegressorSizes {
    /// Floats of the network's input: markers, betas, the current estimate.
    pub const INPUT: usize = MARKER_DIM + BETAS + CONTINUOUS;

    /// The sizes of a regressor whose tensors are `t`; its passes, which no tensor tells, are the authors'.
    ///
    /// # Errors
    /// Names the tensor that is missing.
    pub fn of(t: &Tensors) -> Result<Self> {
        let names = t.names();
        let has = |i: &usize| names.contains(&format!("pnet.layers.{i}.layers.0.weight"));
        Ok(Self { width: outputs(t, "pnet.in_fc")?, blocks: (0..).take_while(has).count(), ..Self::default() })
    }
}

/// Where canonical frames have their origin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// On the floor below the pelvis of the first frame, so that heights are absolute.
    #[default]
    Floor,
    /// At that pelvis itself, as in the authors' code.
    Pelvis,
}

/// Content of `motion.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionConfig {
    /// Frames per second; 40.
    pub fps: f32,
    /// Frames of a primitive, seed included; 20.
    pub frames: usize,
    /// Where the canonical frames that the model has learned have their origin.
    pub canonical: Origin,
    /// Carry the body by the foot that bears it: see [`crate::sim::Sim::step`]. Not in the authors' code.
    #[serde(default)]
    pub planted: bool,
    /// Sizes of the predictor.
    pub predictor: PredictorSizes,
    /// Sizes of the regressor.
    pub regressor: RegressorSizes,
    /// Content hash of the body asset whose markers were learned.
    pub body: String,
}

impl MotionConfig {
    /// The paper's sizes on the body with content hash `body`.
    pub fn new(body: impl Into<String>) -> Self {
        Self {
            fps: super::FPS,
            frames: super::FRAMES,
            canonical: Origin::Floor,
            planted: false,
            predictor: PredictorSizes::default(),
            regressor: RegressorSizes::default(),
            body: body.into(),
        }
    }

    /// Whether the simulation can use such a model; `path` names the file in errors.
    pub(super) fn check(&self, path: &Path) -> Result<()> {
        let bad = |key: &str, value: String, want: String| Err(Error::file(path, format!("{key} is {value}, expected {want}")));
        if self.fps != super::FPS {
            return bad("fps", self.fps.to_string(), super::FPS.to_string());
        }
        if self.frames != super::FRAMES {
            return bad("frames", self.frames.to_string(), super::FRAMES.to_string());
        }
        if self.predictor.frame != MARKER_DIM {
            return bad("predictor.frame", self.predictor.frame.to_string(), MARKER_DIM.to_string());
        }
        Ok(())
    }
}
