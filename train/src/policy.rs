//! The policy as it acts: no gradients, a batch of observations in, plain floats out.

use crate::acts::{Acts, Held};
use crate::{Error, Result};
use burn::tensor::{Device, Tensor};
use egogen::agent::{Network, PolicySpec};
use egogen::device::DeviceChoice;
use egogen::kernels::PolicyEngine;

/// Who computes: the project's own layers on the processor, or burn on a device.
#[derive(Clone, Debug)]
pub enum Compute {
    Own,
    Burn(Device),
}

impl Compute {
    /// Own layers for the default device, burn for every other.
    pub fn new(device: DeviceChoice) -> Result<Self> {
        Ok(if device == DeviceChoice::Flex { Self::Own } else { Self::Burn(device.device()?) })
    }
}

/// A policy that acts with fixed parameters.
pub struct Policy {
    spec: PolicySpec,
    acting: Acting,
    /// Standard deviations of the entries of E, where noise depends on the state.
    deviations: Vec<f32>,
}

enum Acting {
    Own(Box<PolicyEngine>),
    Burn(Box<Network>),
}

impl Policy {
    /// Numbers of an action.
    pub fn actions(&self) -> usize {
        self.spec.action.count()
    }

    /// The policy with these flat parameters.
    pub fn new(spec: &PolicySpec, params: &[f32], compute: &Compute) -> Result<Self> {
        let acting = match compute {
            Compute::Own => Acting::Own(Box::new(PolicyEngine::new(spec, params)?)),
            Compute::Burn(device) => Acting::Burn(Box::new(Network::new(spec, params, device))),
        };
        let deviations = spec.noise_variances(params).iter().map(|v| v.sqrt()).collect();
        Ok(Self { spec: spec.clone(), acting, deviations })
    }

    /// What the policy says of observation rows.
    pub fn act(&self, obs: &[f32]) -> Result<Acts> {
        match &self.acting {
            Acting::Own(engine) => {
                let (a, at, width) = (self.spec.action.count(), engine.value_at(), engine.output_dim());
                let mut out = vec![0.0; obs.len() / self.spec.layout.dim() * width];
                engine.forward(obs, &mut out)?;
                let columns = |from: usize, to: usize| out.chunks_exact(width).flat_map(|row| &row[from..to]).copied().collect();
                Ok(Acts {
                    mu: columns(0, a),
                    logvar: columns(a, at),
                    value: columns(at, at + 1),
                    held: self.held(|| Ok(columns(at + 1, width)))?,
                })
            }
            Acting::Burn(network) => {
                let out = network.forward(obs);
                let logvar = out.logvar.map(floats).transpose()?.unwrap_or_default();
                let held = self.held(|| floats(out.latent))?;
                Ok(Acts { mu: floats(out.mu)?, logvar, value: floats(out.value)?, held })
            }
        }
    }

    fn held(&self, latent: impl FnOnce() -> Result<Vec<f32>>) -> Result<Option<Held>> {
        let Some(noise) = self.spec.config.state_noise else { return Ok(None) };
        Ok(Some(Held { latent: latent()?, deviations: self.deviations.clone(), steps: noise.steps }))
    }

    /// Values alone.
    pub fn values(&self, obs: &[f32]) -> Result<Vec<f32>> {
        let mut out = vec![0.0; obs.len() / self.spec.layout.dim()];
        match &self.acting {
            Acting::Own(engine) => engine.values(obs, &mut out)?,
            Acting::Burn(network) if !out.is_empty() => out = floats(network.value(obs))?,
            Acting::Burn(_) => {}
        }
        Ok(out)
    }
}

/// The tensor's floats, row-major.
pub(crate) fn floats<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>> {
    tensor.into_data().try_to_vec::<f32>().map_err(|e| Error::run(format!("the device returned no 32-bit floats: {e:?}")))
}
