//! Figures with intervals.

use egogen::rng::stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;
/// Standard normal quantile of a two-sided 95 % interval.
const Z: f64 = 1.959_964;

/// A figure with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    pub value: f64,
    pub low: f64,
    pub high: f64,
}

/// A share of n with Wilson's score interval.
pub fn proportion(hits: usize, n: usize) -> Estimate {
    wilson(hits as f64 / n as f64, n as f64)
}

fn wilson(p: f64, n: f64) -> Estimate {
    let scale = 1.0 + Z * Z / n;
    let centre = (p + Z * Z / (2.0 * n)) / scale;
    let half = Z / scale * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    Estimate { value: p, low: (centre - half).max(0.0), high: (centre + half).min(1.0) }
}

/// A mean with its percentile-bootstrap interval; the resampling is fixed. None without values or where one is not finite.
pub fn mean(values: &[f32]) -> Option<Estimate> {
    ratio(&values.iter().map(|&v| [f64::from(v), 1.0]).collect::<Vec<_>>())
}

/// The sum of the first over the sum of the second number, with its percentile-bootstrap interval over the pairs: a mean of groups
/// of unequal size, whose members are not independent. None where the second sum is 0 or a number is not finite.
pub fn ratio(pairs: &[[f64; 2]]) -> Option<Estimate> {
    let over = |pairs: &mut dyn Iterator<Item = &[f64; 2]>| {
        let [a, b] = pairs.fold([0.0, 0.0], |[a, b], [x, y]| [a + x, b + y]);
        a / b
    };
    let value = over(&mut pairs.iter());
    if !value.is_finite() {
        return None;
    }
    let mut rng = stream(0, "bootstrap", 0);
    let n = pairs.len();
    let mut draws: Vec<f64> = (0..RESAMPLES).map(|_| over(&mut (0..n).map(|_| &pairs[rng.random_range(0..n)]))).collect();
    // A draw of groups that all lack the figure says nothing.
    draws.retain(|v| v.is_finite());
    draws.sort_by(f64::total_cmp);
    let at = |q: f64| draws.get(((draws.len().max(1) - 1) as f64 * q).round() as usize).copied().unwrap_or(value);
    Some(Estimate { value, low: at(0.025), high: at(0.975) })
}

/// A share of members of groups, whose members may resemble each other: [hits, members] of each group. None without members.
///
/// Wilson's interval for n / deff members, where the design effect deff is the ratio (at least 1) of the variance of the share between
/// groups to that of as many independent members.
pub fn share(groups: &[[f64; 2]]) -> Option<Estimate> {
    let [hits, n] = groups.iter().fold([0.0, 0.0], |[a, b], [x, y]| [a + x, b + y]);
    if n == 0.0 {
        return None;
    }
    let (p, count) = (hits / n, groups.len() as f64);
    let between = groups.iter().map(|[h, m]| (h - p * m).powi(2)).sum::<f64>() * count / (count - 1.0) / (n * n);
    let effect = between / (p * (1.0 - p) / n);
    let effect = if effect.is_finite() { effect.max(1.0) } else { 1.0 };
    Some(wilson(p, n / effect))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_by_hand() {
        // 8 of 10: centre (0.8 + 0.19207) / 1.38415 = 0.71674, half 1.95996 / 1.38415 sqrt(0.016 + 0.009604) = 0.22658.
        let e = proportion(8, 10);
        assert!((e.value - 0.8).abs() < 1e-12 && (e.low - 0.490_16).abs() < 2e-4 && (e.high - 0.943_32).abs() < 2e-4, "{e:?}");
        assert_eq!(proportion(5, 5).high, 1.0);
    }

    #[test]
    fn groups_that_agree_count_as_less() {
        // Everyone alone: Wilson's own. In pairs that always agree, 4 of 5 pairs: twice the variance and 5/4 for few groups.
        let alone: Vec<[f64; 2]> = (0..10).map(|i| [f64::from(u8::from(i < 8)), 1.0]).collect();
        let (a, b) = (share(&alone).unwrap(), wilson(0.8, 9.0));
        assert!((a.low - b.low).abs() < 1e-12, "{a:?} {b:?}");
        let pairs: Vec<[f64; 2]> = (0..5).map(|i| [if i < 4 { 2.0 } else { 0.0 }, 2.0]).collect();
        let (a, b) = (share(&pairs).unwrap(), wilson(0.8, 4.0));
        assert!((a.low - b.low).abs() < 1e-12 && (a.high - b.high).abs() < 1e-12, "{a:?} {b:?}");
        // None at all: as of independent members. One group: no variance between groups is known.
        assert_eq!(share(&[[0.0, 2.0]; 50]), Some(proportion(0, 100)));
        assert_eq!((share(&[[1.0, 2.0]]), share(&[])), (Some(proportion(1, 2)), None));
    }

    #[test]
    fn bootstrap_covers_the_standard_error() {
        // 200 values, half 0 and half 1: standard error 0.0354, so about 0.43 to 0.57.
        let values: Vec<f32> = (0..200).map(|i| (i % 2) as f32).collect();
        let e = mean(&values).unwrap();
        assert!(e.value == 0.5 && (e.low - 0.431).abs() < 0.01 && (e.high - 0.569).abs() < 0.01, "{e:?}");
        assert_eq!(mean(&[1.0, f32::NAN]), None);
    }

    #[test]
    fn groups_weigh_by_their_size() {
        // 1 of 1 and 3 of 9: 4 of 10, between the one and the other.
        let e = ratio(&[[1.0, 1.0], [3.0, 9.0]]).unwrap();
        assert!(e.value == 0.4 && e.low == 1.0 / 3.0 && e.high == 1.0, "{e:?}");
        assert_eq!((ratio(&[]), ratio(&[[0.0, 0.0]])), (None, None));
        assert_eq!(ratio(&[[0.0, 0.0], [2.0, 4.0]]).map(|e| e.value), Some(0.5));
    }
}
