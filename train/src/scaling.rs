//! Rewards on a running scale, as Stable-Baselines3's `VecNormalize` and Gymnasium's `NormalizeReward` put them.

use crate::collector::Rollout;
use crate::running::Running;
use serde::{Deserialize, Serialize};

/// Added to the variance.
const EPS: f64 = 1e-8;
/// Scaled rewards are cut to plus and minus this.
const MOST: f64 = 10.0;

/// What the scale goes on from; saved with checkpoints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RewardScaling {
    /// Discounted sum of the rewards of each environment's episode so far: G <- gamma G + r.
    sums: Vec<f64>,
    /// All those sums so far.
    seen: Running,
}

impl Default for RewardScaling {
    fn default() -> Self {
        Self { sums: Vec::new(), seen: Running { count: 1e-4, ..Running::default() } }
    }
}

impl RewardScaling {
    /// The same scale for episodes that all begin anew.
    pub fn anew(self) -> Self {
        Self { sums: Vec::new(), ..self }
    }

    /// Divides the rewards of a rollout by the standard deviation of the sums seen up to each step, that step included.
    pub fn apply(&mut self, rollout: &mut Rollout, envs: usize, gamma: f32) {
        self.sums.resize(envs, 0.0);
        let ends = rollout.terminated.chunks_exact(envs).zip(rollout.truncated.chunks_exact(envs));
        for (rewards, (terminated, truncated)) in rollout.reward.chunks_exact_mut(envs).zip(ends) {
            self.sums.iter_mut().zip(&*rewards).for_each(|(sum, &r)| *sum = *sum * f64::from(gamma) + f64::from(r));
            self.seen.add(self.sums.iter().copied());
            let std = (self.seen.variance + EPS).sqrt();
            for (i, (sum, reward)) in self.sums.iter_mut().zip(rewards).enumerate() {
                *reward = (f64::from(*reward) / std).clamp(-MOST, MOST) as f32;
                *sum = if terminated[i] || truncated[i] { 0.0 } else { *sum };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::io::Tensors;

    /// Rewards of 3 environments over 40 steps by Stable-Baselines3's own code, in two collections.
    #[test]
    fn agrees_with_stable_baselines() {
        let t = Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/fixtures/sb3.safetensors")).unwrap();
        let get = |name: &str| t.f32s(&format!("scaling.{name}"), &[40, 3]).unwrap();
        let (reward, done, want) = (get("reward"), get("done"), get("scaled"));
        assert!(want.contains(&10.0) && done.contains(&1.0), "the cut and the ends are not tested");
        let (mut scaling, mut have) = (RewardScaling::default(), vec![]);
        for rows in [0..45, 45..120] {
            let ended = done[rows.clone()].iter().map(|&d| d != 0.0);
            // Both kinds of ends count.
            let (terminated, truncated) = ended.enumerate().map(|(k, end)| (end && k % 2 == 0, end && k % 2 == 1)).unzip();
            let mut rollout = Rollout { reward: reward[rows].to_vec(), terminated, truncated, ..Rollout::default() };
            scaling.apply(&mut rollout, 3, 0.9);
            have.extend(rollout.reward);
        }
        for (k, (have, want)) in have.iter().zip(&want).enumerate() {
            assert!((have - want).abs() < 1e-5 * want.abs().max(1.0), "reward {k}: {have} against {want}");
        }
    }
}
