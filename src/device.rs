//! Where the networks compute: one choice, made by configuration.

use crate::{Error, Result};
use burn::tensor::Device;
use serde::{Deserialize, Serialize};

/// A compute device for burn's networks. Others than [`DeviceChoice::Flex`] need the Cargo feature of the same name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceChoice {
    /// burn's CPU back end; the default.
    #[default]
    Flex,
    /// burn's older CPU back end over the ndarray crate.
    NdArray,
    /// The first NVIDIA GPU.
    Cuda,
    /// The default GPU through wgpu.
    Wgpu,
}

impl DeviceChoice {
    /// The device, without autodiff; refused when this build lacks its feature.
    ///
    /// Never burn's `Device::default()`: that picks whatever the build holds, so a feature would change results.
    pub fn device(self) -> Result<Device> {
        match self {
            Self::Flex => Ok(Device::flex()),
            #[cfg(feature = "ndarray")]
            #[allow(deprecated)] // burn prefers flex; ndarray stays as an independent check of it
            Self::NdArray => Ok(Device::ndarray()),
            #[cfg(feature = "cuda")]
            Self::Cuda => Ok(Device::cuda(0)),
            #[cfg(feature = "wgpu")]
            Self::Wgpu => Ok(Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)),
            #[allow(unreachable_patterns)] // reachable whenever a feature is off
            other => {
                let name = format!("{other:?}").to_lowercase();
                Err(Error::invalid(format!("device '{name}' is not in this build: add --features {name}")))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_lower_case_and_flex_is_there() {
        assert_eq!(serde_json::to_string(&DeviceChoice::NdArray).unwrap(), "\"ndarray\"");
        assert!(DeviceChoice::default().device().is_ok());
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_missing_device_says_which_feature_to_add() {
        let message = DeviceChoice::Cuda.device().unwrap_err().to_string();
        assert!(message.contains("--features cuda"), "{message}");
    }
}
