//! Figures with intervals, as JSON and as a table.

use super::Played;
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
    let (p, n) = (hits as f64 / n as f64, n as f64);
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

/// One policy or baseline.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub name: String,
    pub episodes: usize,
    /// Arrived within the success distance at the end of a step, without a penetration.
    pub success: Estimate,
    /// Ended by a penetration.
    pub penetration: Estimate,
    /// Spent more than two steps within 0.3 m of the goal without arriving.
    pub hover: Estimate,
    /// Sum of rewards.
    pub reward: Option<Estimate>,
    /// Pelvis to goal at the end, metres.
    pub final_dist: Option<Estimate>,
    /// Steps of 0.45 s.
    pub steps: Option<Estimate>,
    /// Distance between predicted and skinned markers, millimetres.
    pub body_error_mm: Option<Estimate>,
    /// ||VP|| under the shipped pose prior (eq. 9).
    pub pose_norm: Option<Estimate>,
    /// Foot contact score (eq. 12).
    pub contact: Option<Estimate>,
    /// Slide per stance, centimetres.
    pub slide_cm: Option<Estimate>,
    /// Mean per-dimension KL of the actions to N(0, I), nats.
    pub kl: Option<Estimate>,
    /// 0.5 mean(mu^2) of the actions, the authors' figure.
    pub kl_mean: Option<Estimate>,
}

impl Row {
    /// Sums up the episodes of `name`.
    pub fn new(name: &str, played: &[Played]) -> Self {
        let share = |figure: &str| proportion(played.iter().filter(|p| p.figure(figure) > 0.5).count(), played.len());
        let average = |of: &dyn Fn(&Played) -> f32| mean(&played.iter().map(of).collect::<Vec<_>>());
        Self {
            name: name.into(),
            episodes: played.len(),
            success: share("success"),
            penetration: share("penetration"),
            hover: share("hover"),
            reward: average(&|p| p.figure("return")),
            final_dist: average(&|p| p.figure("final_dist")),
            steps: average(&|p| p.figure("steps")),
            body_error_mm: average(&|p| 1000.0 * p.body_error),
            pose_norm: average(&|p| p.pose_norm),
            contact: average(&|p| p.contact),
            slide_cm: average(&|p| 100.0 * p.slide),
            kl: average(&|p| p.kl),
            kl_mean: average(&|p| p.kl_mean),
        }
    }
}

/// The rows as a Markdown table.
pub fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| policy | success % | hit % | hover % | return | final m | steps | body error mm | VP norm | contact | slide cm | KL | 0.5 mean mu^2 |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let percent = |e: Estimate| format!("{:.1} ({:.0}-{:.0})", 100.0 * e.value, 100.0 * e.low, 100.0 * e.high);
        let number = |e: Option<Estimate>, digits: usize| e.map_or("-".into(), |e| format!("{:.digits$}", e.value));
        text += &format!(
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |\n",
            r.name,
            percent(r.success),
            percent(r.penetration),
            percent(r.hover),
            number(r.reward, 2),
            number(r.final_dist, 2),
            number(r.steps, 1),
            number(r.body_error_mm, 1),
            number(r.pose_norm, 2),
            number(r.contact, 3),
            number(r.slide_cm, 2),
            number(r.kl, 3),
            number(r.kl_mean, 3)
        );
    }
    text
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
