//! Running mean and variance of a stream of batches (Chan et al. 1983), as Tianshou's `RunningMeanStd`.

use serde::{Deserialize, Serialize};

/// Mean and (population) variance of all numbers seen; 0 and 1 before the first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Running {
    pub mean: f64,
    pub variance: f64,
    pub count: f64,
}

impl Default for Running {
    fn default() -> Self {
        Self { mean: 0.0, variance: 1.0, count: 0.0 }
    }
}

impl Running {
    /// Adds a batch.
    pub fn add(&mut self, batch: impl Iterator<Item: Into<f64>> + Clone) {
        let (mut n, mut sum) = (0.0, 0.0);
        batch.clone().for_each(|x| (n, sum) = (n + 1.0, sum + x.into()));
        if n == 0.0 {
            return;
        }
        let mean = sum / n;
        let square: f64 = batch.map(|x| (x.into() - mean).powi(2)).sum();
        let (delta, total) = (mean - self.mean, self.count + n);
        self.variance = (self.variance * self.count + square + delta * delta * self.count * n / total) / total;
        self.mean += delta * n / total;
        self.count = total;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_add_up() {
        let all = [3.0f32, -1.0, 4.0, 1.0, -5.0, 9.0];
        let mut running = Running::default();
        [&all[..2], &[], &all[2..5], &all[5..]].iter().for_each(|part| running.add(part.iter().copied()));
        // Sum 11, squares 133: mean 11/6, variance 133/6 - (11/6)^2.
        assert!((running.mean - 11.0 / 6.0).abs() < 1e-12);
        assert!((running.variance - (133.0 / 6.0 - 121.0 / 36.0)).abs() < 1e-12);
        assert_eq!(running.count, 6.0);
    }
}
