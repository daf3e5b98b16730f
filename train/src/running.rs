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
        self.merge(n, mean, batch.map(|x| (x.into() - mean).powi(2)).sum());
    }

    /// Adds to each of `columns` its entries of all `rows`, which lie `stride` floats apart: as `add` would, without running through memory
    /// once for each.
    pub fn add_columns(columns: &mut [Self], rows: &[f32], stride: usize) {
        let rows = rows.chunks(stride).map(|row| &row[..columns.len()]);
        let n = rows.len() as f64;
        if n == 0.0 {
            return;
        }
        let (mut means, mut squares) = (vec![0.0; columns.len()], vec![0.0; columns.len()]);
        for row in rows.clone() {
            means.iter_mut().zip(row).for_each(|(sum, &x)| *sum += f64::from(x));
        }
        means.iter_mut().for_each(|sum| *sum /= n);
        for row in rows {
            squares.iter_mut().zip(row.iter().zip(&means)).for_each(|(sum, (&x, mean))| *sum += (f64::from(x) - mean).powi(2));
        }
        columns.iter_mut().zip(means.iter().zip(squares)).for_each(|(column, (&mean, square))| column.merge(n, mean, square));
    }

    /// Adds `n` numbers of that mean, whose squared distances from it add up to `square`.
    fn merge(&mut self, n: f64, mean: f64, square: f64) {
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
        // Two columns of rows of three.
        let rows = [3.0, 7.0, 0.0, -1.0, 8.0, 0.0, 4.0, -2.5];
        let mut columns = [Running::default(); 2];
        Running::add_columns(&mut columns, &rows, 3);
        let mut alone = [Running::default(); 2];
        alone[0].add([3.0, -1.0, 4.0].into_iter());
        alone[1].add([7.0, 8.0, -2.5].into_iter());
        assert_eq!(columns, alone);
    }
}
