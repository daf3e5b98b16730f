//! The motion model as the simulation runs it on the processor.

use super::motion::{Decoder, Regressor};
use crate::Result;
use crate::motion::{MotionModel, MotionWeights, Origin, PredictorWeights};
use std::path::Path;

/// The frozen motion model for simulation on the processor.
pub struct MotionEngine {
    decoder: Decoder,
    regressor: Regressor,
    hash: String,
    origin: Origin,
    planted: bool,
    active: Vec<usize>,
}

impl MotionEngine {
    /// Packs the weights.
    ///
    /// # Errors
    /// If a layer's arrays do not fill its shape.
    pub fn new(weights: &MotionWeights) -> Result<Self> {
        let decoder = Decoder::new(&weights.predictor)?;
        let regressor = Regressor::new(&weights.regressor)?;
        let config = &weights.config;
        let active = active(&weights.predictor);
        Ok(Self { decoder, regressor, hash: weights.hash.clone(), origin: config.canonical, planted: config.planted, active })
    }

    /// Reads a motion-model folder.
    ///
    /// # Errors
    /// As [`MotionWeights::load`].
    pub fn load(dir: impl AsRef<Path>) -> Result<Self> {
        Self::new(&MotionWeights::load(dir)?)
    }
}

/// The latent's dimensions by the length of their columns in the decoder's cell: training leaves those alone that it finds no use for.
fn active(w: &PredictorWeights) -> Vec<usize> {
    let (cell, first, latent) = (&w.d_rnn, w.x_enc.hidden, w.e_mu.output);
    let square = |k: usize| cell.weight_ih.chunks_exact(cell.input).map(|row| row[first + k].powi(2)).sum::<f32>();
    let squares: Vec<f32> = (0..latent).map(square).collect();
    let mut order: Vec<usize> = (0..latent).collect();
    order.sort_by(|&a, &b| squares[b].total_cmp(&squares[a]));
    order
}

impl MotionModel for MotionEngine {
    fn latent_dim(&self) -> usize {
        self.decoder.latent_dim()
    }

    fn decode(&self, seed: &[f32], latent: &[f32], out: &mut [f32]) -> Result<()> {
        self.decoder.decode(seed, latent, out)
    }

    fn regress(&self, markers: &[f32], betas: &[f32], out: &mut [f32]) -> Result<()> {
        self.regressor.regress(markers, betas, out)
    }

    fn hash(&self) -> &str {
        &self.hash
    }

    fn origin(&self) -> Origin {
        self.origin
    }

    fn active(&self) -> Vec<usize> {
        self.active.clone()
    }

    fn planted(&self) -> bool {
        self.planted
    }
}
