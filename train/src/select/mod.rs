//! Which of a run's checkpoints becomes its policy: by return, success, pose quality and the divergence of its actions from N(0, I).

mod measure;
mod rule;

pub use measure::{Figures, Measured, measure, of_prior};
pub use rule::{Quality, Tried, Verdict, judge};

use crate::checkpoint::{self, Checkpoint};
use crate::course::{last_levels, options};
use crate::policy::Compute;
use crate::recipe::Recipe;
use crate::registry::{Purpose, Registry};
use crate::{Error, Policy, Result};
use egogen::io::write_atomic;
use egogen_envs::VecEnv;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Name of the file in a run's folder.
pub const FILE: &str = "selection.json";
const FORMAT: u32 = 1;

/// The rule with its thresholds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelectConfig {
    /// Test episodes of every candidate, the same starts for all.
    pub starts: usize,
    /// Seed of those starts; the finalists' is the next.
    pub seed: u64,
    /// Whether policies act with their noise, or with their mean action.
    pub noise: bool,
    /// Candidates have at least this share of the best return.
    pub return_share: f64,
    /// Their success is below the best by at most this many standard errors of the paired difference.
    pub success_errors: f64,
    /// Neither ||VP|| nor bone error exceed those of actions from N(0, I) by more than this share.
    pub quality: f64,
    /// Which divergence has to be small.
    pub by: Divergence,
    /// The best so many are played again.
    pub finalists: usize,
    /// On so many fresh starts.
    pub finalist_starts: usize,
}

/// Divergences of actions from N(0, I).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Divergence {
    /// The whole, KL(policy || N(0, I)).
    #[default]
    Kl,
    /// 0.5 mean(mu^2), the authors'.
    KlMean,
}

impl Default for SelectConfig {
    fn default() -> Self {
        Self {
            starts: 200,
            seed: 3000,
            noise: false,
            return_share: 0.98,
            success_errors: 1.96,
            quality: 0.2,
            by: Divergence::Kl,
            finalists: 5,
            finalist_starts: 500,
        }
    }
}

impl SelectConfig {
    /// Refuses values that select nothing.
    pub fn check(&self) -> Result<()> {
        let need = |ok: bool, key: &str, value: &dyn std::fmt::Display, want: &str| match ok {
            true => Ok(()),
            false => Err(Error::config(format!("select.{key} is {value}, expected {want}"))),
        };
        for (key, value) in [("starts", self.starts), ("finalists", self.finalists), ("finalist_starts", self.finalist_starts)] {
            need(value > 0, key, &value, "at least 1")?;
        }
        need((0.0..=1.0).contains(&self.return_share), "return_share", &self.return_share, "0 to 1")?;
        for (key, value) in [("success_errors", self.success_errors), ("quality", self.quality)] {
            need(value >= 0.0 && value.is_finite(), key, &value, "0 or more")?;
        }
        Ok(())
    }
}

/// What was selected and why: `selection.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Selection {
    pub format: u32,
    pub rule: SelectConfig,
    /// What pose quality is compared with.
    pub prior: Option<Quality>,
    pub candidates: Round,
    pub finalists: Round,
    /// The checkpoint, and its epoch.
    pub chosen: String,
    pub epoch: u64,
    pub why: String,
}

/// Candidates on one set of starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Round {
    pub starts: usize,
    pub seed: u64,
    pub entries: Vec<Entry>,
    /// Criteria left out, as they would have left nobody.
    pub left_out: Vec<String>,
}

/// One candidate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// The checkpoint's folder.
    pub name: String,
    pub epoch: u64,
    pub figures: Figures,
    /// Why it is not admitted; empty where it is.
    pub reasons: Vec<String>,
    /// Place among the admitted, from 1.
    pub place: Option<usize>,
}

impl Selection {
    /// Reads the selection of the run in `dir`; none where it has none.
    pub fn read(dir: &Path) -> Result<Option<Self>> {
        let path = dir.join(FILE);
        match std::fs::read_to_string(&path) {
            Ok(text) => Ok(Some(serde_json::from_str(&text).map_err(|e| egogen::Error::file(&path, e.to_string()))?)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(egogen::Error::io(&path, e).into()),
        }
    }

    /// Writes it into the run's folder.
    pub fn write(&self, dir: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).map_err(|e| Error::run(format!("cannot write the selection: {e}")))?;
        Ok(write_atomic(dir.join(FILE), text.as_bytes())?)
    }
}

/// The checkpoints that selection chooses from, oldest first: of whole epochs that `keep_every` divides (`every` without), and the
/// last. What a run keeps for being interrupted is not among them, so that an uninterrupted run chooses the same.
pub fn candidates(root: &Path, recipe: &Recipe) -> Vec<String> {
    let every = recipe.checkpoint.keep_every.unwrap_or(recipe.checkpoint.every);
    let epoch = |name: &str| name.strip_prefix("epoch-").and_then(|n| n.parse::<u64>().ok());
    let names = checkpoint::list(root);
    let last = names.last().cloned();
    let kept = |name: &String| epoch(name).is_some_and(|e| e > 0 && (e.is_multiple_of(every) || Some(name) == last.as_ref()));
    names.into_iter().filter(kept).collect()
}

/// Selects among the checkpoints of the run in `dir`; `None` where `stop` is set meanwhile.
pub fn select(dir: &Path, recipe: &Recipe, rule: &SelectConfig, registry: &Registry, stop: &AtomicBool) -> Result<Option<Selection>> {
    let names = candidates(&dir.join("checkpoints"), recipe);
    let task = options(recipe, &last_levels(recipe))?;
    let make = |starts: usize| registry.make(&recipe.env, &task, starts, Purpose::Test).map(|made| made.env);
    let jury = Jury { dir, recipe, rule, stop };
    let mut env = make(rule.starts)?;
    let prior = of_prior(env.as_mut(), rule.seed)?;
    let Some((candidates, ranking)) = jury.round(&names, env.as_mut(), rule.seed, prior)? else { return Ok(None) };
    let finalists: Vec<String> = ranking.iter().take(rule.finalists).map(|&i| names[i].clone()).collect();
    let Some((finalists, ranking)) = jury.round(&finalists, make(rule.finalist_starts)?.as_mut(), rule.seed + 1, prior)? else {
        return Ok(None);
    };
    let winner = ranking.first().and_then(|&i| finalists.entries.get(i));
    let winner = winner.ok_or_else(|| Error::run(format!("{}: no checkpoint to select from", dir.display())))?;
    let by = match winner.figures.kl.zip(winner.figures.kl_mean) {
        Some((kl, mean)) => {
            let kl = if rule.by == Divergence::Kl { kl } else { mean };
            format!("smallest divergence from N(0, I), {:.4} nats per dimension,", kl.value)
        }
        None => format!("largest return, {:.3},", winner.figures.reward.value),
    };
    let why = format!(
        "{by} of the {} admitted among {} finalists on {} fresh starts; {} candidates in all",
        ranking.len(),
        finalists.entries.len(),
        finalists.starts,
        candidates.entries.len()
    );
    let (chosen, epoch, rule) = (winner.name.clone(), winner.epoch, rule.clone());
    Ok(Some(Selection { format: FORMAT, rule, prior, candidates, finalists, chosen, epoch, why }))
}

/// Who plays candidates and judges them.
struct Jury<'a> {
    dir: &'a Path,
    recipe: &'a Recipe,
    rule: &'a SelectConfig,
    stop: &'a AtomicBool,
}

impl Jury<'_> {
    /// The candidates on the starts of `env`, and who is admitted, best first; `None` where it was stopped.
    fn round(&self, names: &[String], env: &mut dyn VecEnv, seed: u64, prior: Option<Quality>) -> Result<Option<(Round, Vec<usize>)>> {
        let (mut entries, mut tried) = (Vec::new(), Vec::new());
        for name in names {
            if self.stop.load(Ordering::SeqCst) {
                return Ok(None);
            }
            let (entry, row) = self.one(name, env, seed)?;
            entries.push(entry);
            tried.push(row);
        }
        let verdict = judge(&tried, self.rule, prior);
        entries.iter_mut().zip(verdict.reasons).for_each(|(entry, reasons)| entry.reasons = reasons);
        verdict.ranking.iter().zip(1..).for_each(|(&i, place)| entries[i].place = Some(place));
        let left_out = verdict.left_out.iter().map(|c| c.to_string()).collect();
        Ok(Some((Round { starts: env.num_envs(), seed, entries, left_out }, verdict.ranking)))
    }

    fn one(&self, name: &str, env: &mut dyn VecEnv, seed: u64) -> Result<(Entry, Tried)> {
        let (description, spec, params) = Checkpoint::read_policy(&self.dir.join("checkpoints").join(name))?;
        let policy = Policy::new(&spec, &params, &Compute::new(self.recipe.device)?)?;
        let Measured { figures, success } = measure(env, &policy, seed, self.rule.noise)?;
        let kl = if self.rule.by == Divergence::Kl { figures.kl } else { figures.kl_mean };
        let shown = |label: &str, e: Option<crate::evaluate::Estimate>| e.map_or(String::new(), |e| format!("  {label} {:.3}", e.value));
        let all = [("return", Some(figures.reward)), ("success", figures.success), ("hover", figures.hover), ("KL", figures.kl)];
        eprintln!("{name} on {} starts:{}", env.num_envs(), all.map(|(label, e)| shown(label, e)).concat());
        let epoch = description.epoch;
        let tried = Tried { epoch, reward: figures.reward.value, success, kl: kl.map(|e| e.value), quality: figures.quality };
        Ok((Entry { name: name.into(), epoch, figures, reasons: Vec::new(), place: None }, tried))
    }
}
