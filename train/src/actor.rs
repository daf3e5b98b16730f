//! The policy as it acts: no gradients, a batch of observations in, plain floats out.

use crate::shards::Shards;
use burn::tensor::Tensor;
use egogen::agent::Network;

/// Mean, log variance (n x A each) and value (n) for n observations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Acts {
    pub mu: Vec<f32>,
    pub logvar: Vec<f32>,
    pub value: Vec<f32>,
}

/// A network that acts, its batch split over shards.
pub struct Actor<'a> {
    pub network: &'a Network,
    pub shards: &'a Shards,
}

impl Actor<'_> {
    /// Means, log variances and values of observation rows.
    pub fn act(&self, obs: &[f32]) -> Acts {
        let dim = self.network.spec().layout.dim();
        let mut acts = Acts::default();
        for part in self.shards.map(obs.len() / dim, |rows| {
            let out = self.network.forward(&obs[rows.start * dim..rows.end * dim]);
            Acts { mu: floats(out.mu), logvar: floats(out.logvar), value: floats(out.value) }
        }) {
            acts.mu.extend(part.mu);
            acts.logvar.extend(part.logvar);
            acts.value.extend(part.value);
        }
        acts
    }

    /// Values alone.
    pub fn values(&self, obs: &[f32]) -> Vec<f32> {
        let dim = self.network.spec().layout.dim();
        let part = |rows: std::ops::Range<usize>| {
            if rows.is_empty() { vec![] } else { floats(self.network.value(&obs[rows.start * dim..rows.end * dim])) }
        };
        self.shards.map(obs.len() / dim, part).concat()
    }
}

/// The tensor's floats, row-major.
pub(crate) fn floats<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec::<f32>().expect("the networks compute in f32")
}
