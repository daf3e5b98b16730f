//! Recipes: what a person can train, as TOML; checked once into a [`Plan`].

use crate::course::{Curriculum, Goal};
use crate::select::SelectConfig;
use crate::stages::Stage;
use crate::{AdamConfig, Error, PpoConfig, Result, Schedule};
use egogen::agent::PolicyConfig;
use egogen::device::DeviceChoice;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// The recipes that come with the program: file stem and content.
pub const EMBEDDED: [(&str, &str); 10] = [
    ("quick", include_str!("../recipes/quick.toml")),
    ("sparse", include_str!("../recipes/sparse.toml")),
    ("crowded", include_str!("../recipes/crowded.toml")),
    ("paper", include_str!("../recipes/paper.toml")),
    ("point", include_str!("../recipes/point.toml")),
    ("cartpole", include_str!("../recipes/cartpole.toml")),
    ("acrobot", include_str!("../recipes/acrobot.toml")),
    ("pendulum", include_str!("../recipes/pendulum.toml")),
    ("mountaincar", include_str!("../recipes/mountaincar.toml")),
    ("mountaincar_continuous", include_str!("../recipes/mountaincar_continuous.toml")),
];

/// A recipe as written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Names the run folder.
    pub name: String,
    /// One line for `train --list`.
    pub about: String,
    /// Name of a registered environment.
    pub env: String,
    /// Seeds weights, environments, noise and shuffles.
    pub seed: u64,
    /// Where the networks compute.
    #[serde(default)]
    pub device: DeviceChoice,
    /// How much is trained.
    pub run: RunConfig,
    /// Sizes of the policy.
    pub policy: PolicyConfig,
    /// The loss.
    pub ppo: PpoConfig,
    /// The optimiser.
    pub adam: AdamConfig,
    /// Test episodes between epochs.
    pub test: TestConfig,
    /// What is kept.
    pub checkpoint: CheckpointConfig,
    /// How the run's policy is selected; absent: by `checkpoint.best`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub select: Option<SelectConfig>,
    /// What ends the run before `run.epochs`; looked at in tests.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until: Option<Goal>,
    /// Options of the environment, checked by its factory.
    #[serde(default)]
    pub env_options: toml::Table,
    /// Options of the environment that change while training goes on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub curriculum: Vec<Curriculum>,
    /// What is trained one after the other; absent: the recipe as it is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<Stage>,
}

/// How much is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Epochs; metrics are reported once in each.
    pub epochs: u64,
    /// Environment steps per epoch, rounded up to whole collections.
    pub epoch_steps: usize,
    /// Environments stepped together.
    pub envs: usize,
    /// Environment steps per collection, over all environments; an update follows each.
    pub collect_steps: usize,
    /// Pieces into which batches are split, one thread each; results depend on it, so it does not follow the machine.
    pub shards: usize,
}

/// Test episodes: the same starts every time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TestConfig {
    /// Episodes with the policy's noise, and as many with its mean action.
    pub episodes: usize,
    /// Epochs between tests; the last epoch is always tested.
    pub every: u64,
    /// Seed of the starts.
    pub seed: u64,
}

/// What is kept of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointConfig {
    /// Epochs between checkpoints; tested epochs should have one.
    pub every: u64,
    /// Newest checkpoints kept beside the best one.
    pub keep: usize,
    /// Checkpoints of epochs that this divides are kept as well, for good.
    #[serde(default)]
    pub keep_every: Option<u64>,
    /// The figure of metrics.csv that makes a checkpoint the best; larger is better.
    pub best: String,
    /// Checkpoints whose loss/kl_prior is above this cannot be the best: their actions left what the motion model knows.
    #[serde(default)]
    pub max_kl_prior: Option<f64>,
}

/// A checked recipe.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The recipe it came from.
    pub recipe: Recipe,
    /// Steps of every environment per collection.
    pub horizon: usize,
    /// Collections (and updates) per epoch.
    pub updates_per_epoch: u64,
}

impl Recipe {
    /// The embedded recipe `name` or the file at that path, with `key.path=value` changes.
    pub fn load(name: &str, changes: &[String]) -> Result<Self> {
        let embedded = EMBEDDED.iter().find(|(n, _)| *n == name);
        let (origin, text) = match embedded {
            Some((_, text)) => (format!("recipe '{name}'"), text.to_string()),
            None if name.ends_with(".toml") => {
                (name.to_string(), std::fs::read_to_string(name).map_err(|e| Error::config(format!("{name}: {e}")))?)
            }
            None => {
                let known: Vec<_> = EMBEDDED.iter().map(|(n, _)| *n).collect();
                return Err(Error::config(format!("no recipe '{name}': expected {} or a path ending in .toml", known.join(", "))));
            }
        };
        Self::parse(&origin, &text, changes)
    }

    /// Parses TOML; `origin` names it in errors.
    pub fn parse(origin: &str, text: &str, changes: &[String]) -> Result<Self> {
        let bad = |e: toml::de::Error| Error::config(format!("{origin}: {}", e.to_string().trim_end()));
        let recipe: Self = toml::from_str(text).map_err(bad)?;
        if changes.is_empty() {
            return Ok(recipe);
        }
        let mut table: toml::Table = toml::from_str(text).map_err(bad)?;
        for change in changes {
            set(&mut table, change)?;
        }
        let text = toml::to_string(&table).map_err(|e| Error::config(format!("{origin}: {e}")))?;
        toml::from_str(&text)
            .map_err(|e| Error::config(format!("{origin} with --set {}: {}", changes.join(" --set "), e.to_string().trim_end())))
    }

    /// The recipe as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| Error::run(format!("cannot write the recipe: {e}")))
    }

    /// Checks every value of a recipe without stages; see [`crate::stages::Scheme`] for the others.
    pub fn plan(self) -> Result<Plan> {
        if let Some(stage) = self.stages.first() {
            return Err(Error::config(format!("recipe '{}': stages begin with '{}', expected none here", self.name, stage.name)));
        }
        self.check_rules()?;
        let run = &self.run;
        let positive = [
            ("run.epoch_steps", run.epoch_steps),
            ("run.envs", run.envs),
            ("run.collect_steps", run.collect_steps),
            ("run.shards", run.shards),
            ("ppo.batch", self.ppo.batch),
            ("ppo.passes", self.ppo.passes),
            ("test.episodes", self.test.episodes),
            ("test.every", self.test.every as usize),
            ("checkpoint.every", self.checkpoint.every as usize),
            ("checkpoint.keep", self.checkpoint.keep),
        ];
        for (key, value) in positive {
            self.expect(key, value, value > 0, "at least 1")?;
        }
        self.expect("run.shards", run.shards, run.shards <= 64, "at most 64")?;
        let whole = run.collect_steps.is_multiple_of(run.envs);
        self.expect("run.collect_steps", run.collect_steps, whole, &format!("a multiple of run.envs = {}", run.envs))?;
        let whole = run.collect_steps.is_multiple_of(self.ppo.batch);
        self.expect("ppo.batch", self.ppo.batch, whole, &format!("a divisor of run.collect_steps = {}", run.collect_steps))?;
        let (every, keep_every) = (self.checkpoint.every, self.checkpoint.keep_every.unwrap_or(self.checkpoint.every));
        let whole = keep_every > 0 && keep_every.is_multiple_of(every);
        self.expect("checkpoint.keep_every", keep_every, whole, &format!("a multiple of checkpoint.every = {every}"))?;
        let (ppo, adam) = (&self.ppo, &self.adam);
        for (key, value) in [("ppo.gamma", ppo.gamma), ("ppo.lambda", ppo.lambda)] {
            self.expect(key, value, (0.0..=1.0).contains(&value), "0 to 1")?;
        }
        self.expect("ppo.clip", ppo.clip, ppo.clip > 0.0 && ppo.clip < 1.0, "between 0 and 1")?;
        for (key, value) in [("ppo.max_grad_norm", ppo.max_grad_norm), ("adam.lr", adam.lr), ("adam.eps", adam.eps)] {
            self.expect(key, value, value > 0.0 && value.is_finite(), "a number above 0")?;
        }
        let weights = [("ppo.value", ppo.value), ("ppo.entropy", ppo.entropy), ("ppo.kl_prior", ppo.kl_prior)];
        for (key, value) in weights.into_iter().chain([("adam.weight_decay", adam.weight_decay)]) {
            self.expect(key, value, value >= 0.0 && value.is_finite(), "0 or more")?;
        }
        let above = |least: f32| move |v: f32| v > least && v.is_finite();
        if let Some(value) = ppo.dual_clip {
            self.expect("ppo.dual_clip", value, above(1.0)(value), "a number above 1")?;
        }
        if let Some(value) = ppo.target_kl {
            self.expect("ppo.target_kl", value, above(0.0)(value), "a number above 0")?;
        }
        if let Schedule::Adaptive { target_kl, factor, min, max } = adam.schedule {
            let key = |name: &str| format!("adam.schedule.adaptive.{name}");
            self.expect(&key("target_kl"), target_kl, above(0.0)(target_kl), "a number above 0")?;
            self.expect(&key("factor"), factor, above(1.0)(factor), "a number above 1")?;
            self.expect(&key("min"), min, above(0.0)(min), "a number above 0")?;
            self.expect(&key("max"), max, max >= min && max.is_finite(), &format!("at least min = {min}"))?;
        }
        for beta in adam.betas {
            self.expect("adam.betas", beta, (0.0..1.0).contains(&beta), "0 to below 1")?;
        }
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
        self.expect("name", &self.name, !self.name.is_empty() && self.name.chars().all(plain), "letters, digits, - and _")?;
        let horizon = run.collect_steps / run.envs;
        let updates_per_epoch = run.epoch_steps.div_ceil(run.collect_steps) as u64;
        Ok(Plan { horizon, updates_per_epoch, recipe: self })
    }

    /// Checks what looks at figures and options: selection, convergence, curricula.
    fn check_rules(&self) -> Result<()> {
        let named = |e: Error| Error::config(format!("recipe '{}': {e}", self.name));
        if let Some(rule) = &self.select {
            rule.check().map_err(named)?;
            self.expect("checkpoint.keep_every", "not set", self.checkpoint.keep_every.is_some(), "a number, for [select] to choose from")?;
        }
        self.until.iter().try_for_each(|goal| goal.check("until")).map_err(named)?;
        for (i, entry) in self.curriculum.iter().enumerate() {
            entry.check(&format!("curriculum {}", i + 1)).map_err(named)?;
            let again = self.curriculum[..i].iter().any(|other| other.key == entry.key);
            self.expect(&format!("curriculum {}.key", i + 1), &entry.key, !again, "a key that no other curriculum has")?;
        }
        Ok(())
    }

    fn expect(&self, key: &str, value: impl std::fmt::Display, holds: bool, want: &str) -> Result<()> {
        if holds { Ok(()) } else { Err(Error::config(format!("recipe '{}': {key} is {value}, expected {want}", self.name))) }
    }
}

/// Applies one `key.path=value`; the value is TOML, or a plain string where it is not.
fn set(table: &mut toml::Table, change: &str) -> Result<()> {
    let Some((path, value)) = change.split_once('=') else {
        return Err(Error::config(format!("--set {change}: expected key.path=value")));
    };
    let parsed = toml::from_str::<toml::Table>(&format!("v = {value}")).ok().and_then(|mut t| t.remove("v"));
    let value = parsed.unwrap_or_else(|| toml::Value::String(value.into()));
    put(table, path.trim(), value).map_err(|e| Error::config(format!("--set {change}: {e}")))
}

/// Puts a value under a dotted path. An entry of a list of tables goes by its `name`, or by its number from 1.
pub(crate) fn put(table: &mut toml::Table, path: &str, value: toml::Value) -> std::result::Result<(), String> {
    let (parents, last) = path.rsplit_once('.').map_or((None, path), |(parents, last)| (Some(parents), last));
    let mut keys = parents.into_iter().flat_map(|p| p.split('.'));
    let mut at = table;
    while let Some(key) = keys.next() {
        at = match at.entry(key).or_insert_with(|| toml::Value::Table(toml::Table::new())) {
            toml::Value::Table(inner) => inner,
            toml::Value::Array(list) => {
                let names: Vec<String> = list.iter().enumerate().map(|(i, entry)| name_of(i, entry)).collect();
                let which = keys.next().ok_or_else(|| format!("'{key}' is a list: name an entry and a key of it"))?;
                let found = names.iter().position(|n| n == which);
                let found = found.or_else(|| which.parse::<usize>().ok()?.checked_sub(1));
                let entry = found.and_then(|i| list.get_mut(i)).and_then(toml::Value::as_table_mut);
                entry.ok_or_else(|| format!("'{key}' is a list, which has no '{which}', expected one of: {}", names.join(", ")))?
            }
            _ => return Err(format!("'{key}' is a value, not a table")),
        };
    }
    at.insert(last.to_string(), value);
    Ok(())
}

/// What entry `i` of a list of tables is called: its `name`, or its number from 1.
fn name_of(i: usize, entry: &toml::Value) -> String {
    entry.get("name").and_then(toml::Value::as_str).map_or_else(|| (i + 1).to_string(), String::from)
}

/// `base` with `key.path=value` changes; `what` names it in errors.
pub fn changed<T: Serialize + serde::de::DeserializeOwned>(what: &str, base: T, changes: &[String]) -> Result<T> {
    if changes.is_empty() {
        return Ok(base);
    }
    let bad = |e: String| Error::config(format!("{what} with --set {}: {}", changes.join(" --set "), e.trim_end()));
    let mut table = toml::Table::try_from(&base).map_err(|e| bad(e.to_string()))?;
    for change in changes {
        set(&mut table, change)?;
    }
    table.try_into().map_err(|e: toml::de::Error| bad(e.to_string()))
}

/// What a continued run may change.
const MAY: [&str; 4] = ["run.epochs", "checkpoint.", "test.", "select."];

/// Whether a continued run may change `key`, be it of a stage.
fn may(key: &str) -> bool {
    let own = key.strip_prefix("stages.").and_then(|rest| rest.split_once('.')).map_or(key, |(_, own)| own);
    MAY.iter().any(|m| own.starts_with(m))
}

/// The first key, of those that a continued run may not change, in which recipes differ, with both values.
pub fn difference(a: &Recipe, b: &Recipe) -> Result<Option<(String, [String; 2])>> {
    let [a, b] = [a, b].map(|recipe| -> Result<BTreeMap<_, _>> {
        let table = toml::from_str(&recipe.to_toml()?).map_err(|e| Error::run(format!("cannot read back the recipe: {e}")))?;
        let mut values = BTreeMap::new();
        flatten("", &table, &mut values);
        // Keys outside tables first: a foreign recipe is known by its name.
        Ok(values.into_iter().map(|(key, value)| ((key.contains('.'), key), value)).collect())
    });
    let (a, b) = (a?, b?);
    let binding = |key: &str| key != "about" && !may(key);
    let keys = a.keys().chain(b.keys()).filter(|(_, key)| binding(key));
    let shown = |of: &BTreeMap<(bool, String), String>, key| of.get(key).cloned().unwrap_or_else(|| "not set".into());
    let first = keys.filter(|key| a.get(*key) != b.get(*key)).min();
    Ok(first.map(|key| (key.1.clone(), [shown(&a, key), shown(&b, key)])))
}

/// Every value under its whole key.
fn flatten(prefix: &str, table: &toml::Table, out: &mut BTreeMap<String, String>) {
    for (key, value) in table {
        match value {
            toml::Value::Table(inner) => flatten(&format!("{prefix}{key}."), inner, out),
            toml::Value::Array(list) if !list.is_empty() && list.iter().all(toml::Value::is_table) => {
                let entries = list.iter().enumerate().filter_map(|(i, entry)| Some((name_of(i, entry), entry.as_table()?)));
                entries.for_each(|(name, entry)| flatten(&format!("{prefix}{key}.{name}."), entry, out));
            }
            value => _ = out.insert(format!("{prefix}{key}"), value.to_string()),
        }
    }
}

/// Reads the resolved recipe of the run in `dir`, with changes that a continued run may make.
pub fn of_run(dir: &Path, changes: &[String]) -> Result<Recipe> {
    if let Some(change) = changes.iter().find(|c| !may(c)) {
        let what = "a continued run can change only run.epochs, checkpoint.*, test.* and select.*, also of its stages";
        return Err(Error::config(format!("--set {change}: {what}")));
    }
    let path = dir.join("recipe.toml");
    let origin = path.display().to_string();
    let text = std::fs::read_to_string(&path).map_err(|e| Error::config(format!("{origin}: {e}: not a run folder")))?;
    Recipe::parse(&origin, &text, changes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::{Purpose, Registry};

    #[test]
    fn differences_are_named() {
        let point = |changes: &[&str]| Recipe::load("point", &changes.iter().map(|c| c.to_string()).collect::<Vec<_>>()).unwrap();
        let of = |a: &[&str], b: &[&str]| difference(&point(a), &point(b)).unwrap();
        let found = |key: &str, a: &str, b: &str| Some((key.to_string(), [a.to_string(), b.to_string()]));
        assert_eq!(of(&[], &["run.epochs=99", "test.every=3", "checkpoint.keep=9", "about=other"]), None);
        assert_eq!(of(&[], &["ppo.gamma=0.5", "adam.lr=1e-3"]), found("ppo.gamma", "0.95", "0.5"));
        assert_eq!(of(&["ppo.dual_clip=3.0"], &[]), found("ppo.dual_clip", "3.0", "not set"));
        assert_eq!(of(&["adam.lr=1.0", "seed=3"], &[]), found("seed", "3", "0"), "keys outside tables come first");
    }

    #[test]
    fn what_is_kept_must_be_written() {
        let keep_every = |n: u64| Recipe::load("point", &[format!("checkpoint.keep_every={n}")]).unwrap().plan();
        assert!(keep_every(4).is_ok());
        for n in [0, 3] {
            let e = keep_every(n).unwrap_err().to_string();
            assert!(e.contains("checkpoint.keep_every") && e.contains("multiple of checkpoint.every = 2"), "{e}");
        }
    }

    #[test]
    fn every_recipe_of_a_reference_task_is_valid() {
        let registry = Registry::standard();
        for name in ["cartpole", "acrobot", "pendulum", "mountaincar", "mountaincar_continuous"] {
            let path = format!("{}/recipes/{name}.toml", env!("CARGO_MANIFEST_DIR"));
            let recipe = Recipe::load(&path, &[]).unwrap();
            assert_eq!([&recipe.name, &recipe.env], [name; 2]);
            registry.make(&recipe.env, &recipe.env_options, 1, Purpose::Train).unwrap();
            recipe.plan().unwrap();
        }
    }
}
