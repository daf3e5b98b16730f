//! How the step size changes over a run.

use serde::{Deserialize, Serialize};

/// Rule for the step size; the base is `adam.lr`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Schedule {
    /// The base throughout.
    #[default]
    Constant,
    /// From the base linearly to zero at the end of the run, the same within an update.
    Linear,
    /// After each minibatch but an update's first: divided by `factor` where the minibatch's `approx_kl` is above twice `target_kl`,
    /// multiplied by it where it is below half, within \[min, max\]. Starts at the base and goes on from update to update.
    Adaptive {
        /// Wanted KL between the policy that collected and the one that learns.
        target_kl: f32,
        /// What the step size changes by.
        #[serde(default = "factor")]
        factor: f32,
        /// Smallest step size.
        #[serde(default = "min")]
        min: f32,
        /// Largest step size.
        #[serde(default = "max")]
        max: f32,
    },
}

fn factor() -> f32 {
    1.5
}

fn min() -> f32 {
    1e-5
}

fn max() -> f32 {
    1e-2
}

impl Schedule {
    /// The step size an update begins with. `last`: what the update before ended with; `progress`: share of the run that is done.
    pub fn begin(&self, base: f32, last: Option<f32>, progress: f32) -> f32 {
        match self {
            Self::Constant => base,
            Self::Linear => base * (1.0 - progress),
            Self::Adaptive { .. } => last.unwrap_or(base),
        }
    }

    /// The step size after a minibatch with that `approx_kl`.
    pub fn adapt(&self, lr: f32, kl: f64) -> f32 {
        match *self {
            Self::Adaptive { target_kl, factor, min, .. } if kl > 2.0 * f64::from(target_kl) => (lr / factor).max(min),
            Self::Adaptive { target_kl, factor, max, .. } if kl < 0.5 * f64::from(target_kl) => (lr * factor).min(max),
            _ => lr,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_hand() {
        assert_eq!(Schedule::Constant.begin(0.3, Some(0.1), 0.5), 0.3);
        assert_eq!(Schedule::Constant.adapt(0.3, 100.0), 0.3);
        assert_eq!([0.0, 0.25, 1.0].map(|p| Schedule::Linear.begin(0.4, Some(0.1), p)), [0.4, 0.3, 0.0]);
        let adaptive: Schedule =
            serde_json::from_str(r#"{"adaptive": {"target_kl": 0.01, "factor": 2.0, "min": 0.1, "max": 0.5}}"#).unwrap();
        assert_eq!(adaptive.begin(0.3, None, 0.5), 0.3);
        assert_eq!(adaptive.begin(0.3, Some(0.2), 0.5), 0.2);
        // Above 0.02 halved, below 0.005 doubled, between as it was; within 0.1 to 0.5.
        assert_eq!([0.021, 0.019, 0.006, 0.004].map(|kl| adaptive.adapt(0.2, kl)), [0.1, 0.2, 0.2, 0.4]);
        assert_eq!((adaptive.adapt(0.1, 1.0), adaptive.adapt(0.3, 0.0)), (0.1, 0.5));
    }
}
