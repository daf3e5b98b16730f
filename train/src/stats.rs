//! Figures of an epoch: gathered, averaged, named.

use crate::collector::{Episode, Rollout};
use crate::loss::Losses;
use crate::ppo::UpdateStats;
use egogen::rng::Stream;
use egogen_envs::EnvSpec;
use rand::RngExt;
use serde::{Deserialize, Serialize};

/// Mean of what is left without the lowest and the highest quarter, each rounded down (Agarwal et al. 2021, as `rliable`'s).
pub fn inter_quartile_mean(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cut = sorted.len() / 4;
    let middle = &sorted[cut..sorted.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Ends of the 95 % percentile interval of the inter-quartile mean over all strata together: each resample draws as many numbers
/// from every stratum (the runs of one task) as it has, with replacement.
pub fn bootstrap_interval(strata: &[Vec<f64>], resamples: usize, rng: &mut Stream) -> [f64; 2] {
    let mut means: Vec<f64> = (0..resamples)
        .map(|_| {
            let mut draws = Vec::new();
            for runs in strata {
                draws.extend(runs.iter().map(|_| runs[rng.random_range(0..runs.len())]));
            }
            inter_quartile_mean(&draws)
        })
        .collect();
    means.sort_by(f64::total_cmp);
    [0.025, 0.975].map(|p| {
        let at = p * (means.len() - 1) as f64;
        let (low, high) = (means[at.floor() as usize], means[at.ceil() as usize]);
        low + (high - low) * at.fract()
    })
}

/// Quantile of Student's t for a two-sided 95 % interval with these degrees of freedom: tables up to 9, then the expansion in their
/// inverse (Abramowitz & Stegun 26.7.5).
fn student(freedom: usize) -> f64 {
    const FIRST: [f64; 9] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262];
    let (z, n) = (1.959_964f64, freedom as f64);
    let terms = [
        (z.powi(3) + z) / 4.0,
        (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0,
        (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / 384.0,
    ];
    let expansion = z + terms[0] / n + terms[1] / n.powi(2) + terms[2] / n.powi(3);
    freedom.checked_sub(1).map_or(0.0, |i| FIRST.get(i).copied().unwrap_or(expansion))
}

/// Mean, and half its 95 % interval by Student's t, which is 0 for one value; none without values.
pub fn mean_and_half(values: &[f64]) -> Option<[f64; 2]> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (!values.is_empty()).then(|| [mean, student(values.len() - 1) * (square / n).sqrt()])
}

/// Named figures in the order of the columns; `None` where an epoch has none.
pub type Row = Vec<(String, Option<f64>)>;

/// Sums over the part of an epoch that is done; saved with checkpoints.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpochStats {
    pub updates: u64,
    steps: u64,
    info: Vec<f64>,
    episodes: Episodes,
    losses: Losses,
    explained_variance: f64,
    first_ratio_error: f64,
    learning_rate: f64,
    gradient_steps: f64,
}

/// Sums over finished episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Episodes {
    count: u64,
    total: f64,
    square: f64,
    length: f64,
    figures: Vec<f64>,
}

impl Episodes {
    /// Adds finished episodes.
    pub fn add(&mut self, episodes: &[Episode]) {
        for e in episodes {
            let total = f64::from(e.total);
            self.count += 1;
            self.total += total;
            self.square += total * total;
            self.length += f64::from(e.length);
            self.figures.resize(e.figures.len(), 0.0);
            self.figures.iter_mut().zip(&e.figures).for_each(|(s, &x)| *s += f64::from(x));
        }
    }

    fn mean(&self, sum: f64) -> Option<f64> {
        (self.count > 0).then(|| sum / self.count as f64)
    }

    /// Mean return, its standard deviation, mean length.
    fn basics(&self) -> [(&'static str, Option<f64>); 3] {
        let mean = self.mean(self.total);
        let std = mean.map(|m| (self.square / self.count as f64 - m * m).max(0.0).sqrt());
        [("return", mean), ("return_std", std), ("length", self.mean(self.length))]
    }

    fn figure(&self, i: usize) -> Option<f64> {
        self.mean(self.figures.get(i).copied().unwrap_or(0.0))
    }

    /// All figures under `prefix`.
    pub fn row(&self, prefix: &str, spec: &EnvSpec) -> Row {
        let named = |name: &str, value| (format!("{prefix}/{name}"), value);
        let mut row: Row = self.basics().into_iter().map(|(n, v)| named(n, v)).collect();
        row.extend(spec.episode.iter().enumerate().filter(|(_, n)| *n != "return").map(|(i, n)| named(n, self.figure(i))));
        row
    }
}

impl EpochStats {
    /// Adds one collection and its update.
    pub fn add(&mut self, rollout: &Rollout, update: &UpdateStats) {
        self.updates += 1;
        self.steps += rollout.reward.len() as u64;
        self.info.resize(rollout.info.len(), 0.0);
        self.info.iter_mut().zip(&rollout.info).for_each(|(s, x)| *s += x);
        self.episodes.add(&rollout.episodes);
        self.losses.add(&update.losses, 1.0);
        self.explained_variance += update.explained_variance;
        self.learning_rate += update.learning_rate;
        self.gradient_steps += update.gradient_steps;
        self.first_ratio_error = self.first_ratio_error.max(update.first_ratio_error);
    }

    /// The epoch's averages.
    pub fn row(&self, spec: &EnvSpec) -> Row {
        let mut row = vec![("train/episodes".to_string(), Some(self.episodes.count as f64))];
        row.extend(self.episodes.row("train", spec));
        let per_step = |sum: f64| (self.steps > 0).then(|| sum / self.steps as f64);
        row.extend(spec.info.iter().enumerate().map(|(i, n)| (format!("step/{n}"), self.info.get(i).copied().and_then(per_step))));
        let per_update = |sum: f64| (self.updates > 0).then(|| sum / self.updates as f64);
        row.extend(self.losses.named().into_iter().map(|(n, sum)| (format!("loss/{n}"), per_update(sum))));
        let figures = [
            ("explained_variance", self.explained_variance),
            ("learning_rate", self.learning_rate),
            ("gradient_steps", self.gradient_steps),
        ];
        row.extend(figures.into_iter().map(|(n, sum)| (format!("loss/{n}"), per_update(sum))));
        row.push(("loss/first_ratio_error".into(), Some(self.first_ratio_error)));
        row
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::rng::stream;

    /// Scores of three tasks and nine runs, and what rliable says of them (tests/tools/stats/make.py).
    #[derive(Deserialize)]
    struct Wanted {
        scores: Vec<Vec<f64>>,
        task_means: Vec<f64>,
        mean: f64,
        interval: [f64; 2],
        task_intervals: Vec<[f64; 2]>,
    }

    #[test]
    fn agree_with_rliable() {
        let text = include_str!("../../tests/fixtures/stats.json");
        let want: Wanted = serde_json::from_str(text).unwrap();
        let all = want.scores.concat();
        assert!((inter_quartile_mean(&all) - want.mean).abs() < 1e-12);
        for (runs, mean) in want.scores.iter().zip(&want.task_means) {
            assert!((inter_quartile_mean(runs) - mean).abs() < 1e-12);
        }
        let mut rng = stream(0, "test", 0);
        let mut close = |strata: &[Vec<f64>], [low, high]: [f64; 2]| {
            let have = bootstrap_interval(strata, 20_000, &mut rng);
            // Four standard errors of the difference of two such quantiles under a normal, 0.027 standard deviations each, of an
            // interval 3.92 wide.
            let near = 0.03 * (high - low);
            assert!((have[0] - low).abs() < near && (have[1] - high).abs() < near, "{have:?} against {low} to {high}");
        };
        close(&want.scores, want.interval);
        want.scores.iter().zip(want.task_intervals).for_each(|(runs, ends)| close(std::slice::from_ref(runs), ends));
    }

    #[test]
    fn by_hand() {
        // Of five, one goes at each end; of three, none.
        assert_eq!(inter_quartile_mean(&[9.0, 100.0, 1.0, 3.0, -50.0]), 13.0 / 3.0);
        assert_eq!(inter_quartile_mean(&[1.0, 2.0, 6.0]), 3.0);
        assert_eq!(bootstrap_interval(&[vec![4.0]], 10, &mut stream(0, "test", 0)), [4.0, 4.0]);
        assert_eq!((mean_and_half(&[]), mean_and_half(&[3.0])), (None, Some([3.0, 0.0])));
        // Deviations -1, 0, 1: variance 1, standard error 1 / sqrt 3.
        let [mean, half] = mean_and_half(&[1.0, 2.0, 3.0]).unwrap();
        assert!(mean == 2.0 && (half - 4.303 / 3f64.sqrt()).abs() < 1e-12);
        // Tables of Student's t.
        for (freedom, want) in [(1, 12.706), (9, 2.262), (10, 2.228), (15, 2.131), (30, 2.042), (120, 1.980)] {
            assert!((student(freedom) - want).abs() < 6e-4, "{freedom}: {}", student(freedom));
        }
    }
}
