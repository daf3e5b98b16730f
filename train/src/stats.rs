//! Figures of an epoch: gathered, averaged, named.

use crate::collector::{Episode, Rollout};
use crate::loss::Losses;
use crate::ppo::UpdateStats;
use egogen_envs::EnvSpec;
use serde::{Deserialize, Serialize};

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
