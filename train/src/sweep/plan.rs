//! A sweep as written, and the tasks that it comes to.

use crate::job::check_stages;
use crate::recipe::{Recipe, put};
use crate::registry::Registry;
use crate::stages::Scheme;
use crate::{Error, Result};
use egogen::io::content_hash;
use egogen::rng::{Stream, stream};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Keys of a recipe, with the values that they get.
pub type Changes = BTreeMap<String, toml::Value>;

/// A sweep as written.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sweep {
    /// An embedded recipe or a path ending in .toml.
    pub recipe: String,
    /// Every setting is trained with each of them.
    pub seeds: Vec<u64>,
    /// The column of metrics.csv that ranks settings by its last value; larger is better.
    pub figure: String,
    /// Named settings of several keys; none: the recipe alone.
    #[serde(default)]
    pub variants: Vec<Variant>,
    /// Keys of the recipe with values; all combinations are trained, with each variant.
    #[serde(default)]
    pub grid: BTreeMap<String, Vec<toml::Value>>,
    /// Keys whose values are drawn, anew for every combination of variants and grid.
    #[serde(default)]
    pub random: Option<Random>,
    /// Ends early what does badly early.
    #[serde(default)]
    pub halving: Option<Halving>,
}

/// Values of several keys under one name.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// What tables and pages call it.
    pub name: String,
    /// Keys with values, as `"ppo.clip" = 0.1`, `ppo.clip = 0.1` or `ppo = { clip = 0.1 }`; none: the recipe as it is.
    #[serde(default)]
    pub set: toml::Table,
}

/// Random search.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Random {
    /// Draws per combination of variants and grid.
    pub count: usize,
    #[serde(default)]
    pub seed: u64,
    /// How each key's value is drawn.
    pub keys: BTreeMap<String, Draw>,
}

/// How a value is drawn.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Draw {
    /// Evenly between two numbers.
    Uniform([f64; 2]),
    /// Between two positive numbers, evenly in the logarithm.
    Log([f64; 2]),
    /// One of these.
    Choice(Vec<toml::Value>),
}

/// Successive halving: all settings train for the first number of epochs, the best share of them for the second, and so on. Of a
/// recipe with stages these are epochs of the last one; those before are trained whole in the first rung.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Halving {
    /// `run.epochs` of each rung, each more than the one before; those of the last stage, where there are stages.
    pub epochs: Vec<u64>,
    /// Share of settings that goes on; at least one does.
    #[serde(default = "half")]
    pub keep: f64,
}

fn half() -> f64 {
    0.5
}

/// One line of a manifest: all that a task needs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Task {
    pub id: String,
    /// Number of the setting, from 1.
    pub setting: usize,
    /// The name of its variant; empty where the sweep has none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub variant: String,
    /// What makes the setting, the variant's keys included.
    pub changes: Changes,
    pub seed: u64,
    /// Where it trains, from the manifest's folder.
    pub folder: String,
    /// The resolved recipe as TOML, and its content hash.
    pub recipe: String,
    pub hash: String,
}

impl Variant {
    /// Every key with its value. A table under a plain key is gone into; one under a key with dots, which had to be quoted, is the value.
    pub fn changes(&self) -> Changes {
        fn walk(prefix: &str, table: &toml::Table, out: &mut Changes) {
            for (key, value) in table {
                let path = format!("{prefix}{key}");
                match value {
                    toml::Value::Table(inner) if !key.contains('.') => walk(&format!("{path}."), inner, out),
                    value => _ = out.insert(path, value.clone()),
                }
            }
        }
        let mut changes = Changes::new();
        walk("", &self.set, &mut changes);
        changes
    }
}

impl Sweep {
    /// Reads and checks a sweep file.
    pub fn read(path: &Path) -> Result<Self> {
        let bad = |e: String| Error::config(format!("{}: {}", path.display(), e.trim_end()));
        let text = std::fs::read_to_string(path).map_err(|e| bad(e.to_string()))?;
        let sweep: Self = toml::from_str(&text).map_err(|e| bad(e.to_string()))?;
        sweep.check().map_err(|e| bad(e.to_string()))?;
        Ok(sweep)
    }

    fn check(&self) -> Result<()> {
        let need = |ok: bool, what: String| if ok { Ok(()) } else { Err(Error::config(what)) };
        need(!self.seeds.is_empty(), "seeds is empty, expected at least one".into())?;
        let twice = self.seeds.iter().enumerate().find(|(i, seed)| self.seeds[..*i].contains(seed));
        need(twice.is_none(), format!("seeds has {} twice", twice.map_or(0, |(_, s)| *s)))?;
        self.check_variants()?;
        for (key, values) in &self.grid {
            need(!values.is_empty(), format!("grid.{key} is empty, expected at least one value"))?;
        }
        if let Some(random) = &self.random {
            need(random.count > 0, "random.count is 0, expected at least 1".into())?;
            for (key, draw) in &random.keys {
                let ok = match draw {
                    Draw::Uniform([low, high]) => low < high && (high - low).is_finite(),
                    Draw::Log([low, high]) => 0.0 < *low && low < high && high.is_finite(),
                    Draw::Choice(values) => !values.is_empty(),
                };
                need(ok, format!("random.keys.{key} is {draw:?}, expected low < high (log: above 0), or at least one choice"))?;
                need(!self.grid.contains_key(key), format!("random.keys.{key}: the key is in the grid, too"))?;
            }
        }
        if let Some(Halving { epochs, keep }) = &self.halving {
            let rising = !epochs.is_empty() && epochs[0] > 0 && epochs.is_sorted_by(|a, b| a < b);
            need(rising, format!("halving.epochs is {epochs:?}, expected numbers from 1 up, each more than the one before"))?;
            need(*keep > 0.0 && *keep < 1.0, format!("halving.keep is {keep}, expected between 0 and 1"))?;
        }
        Ok(())
    }

    fn check_variants(&self) -> Result<()> {
        let keys = self.keys();
        for (i, variant) in self.variants.iter().enumerate() {
            let bad = |what: String| Err(Error::config(format!("variants: '{}' {what}", variant.name)));
            if variant.name.trim().is_empty() || self.variants[..i].iter().any(|other| other.name == variant.name) {
                return bad(format!("is the name of variant {}, expected one that no other has", i + 1));
            }
            if let Some(key) = variant.changes().keys().find(|key| keys.contains(&key.as_str())) {
                return bad(format!("sets {key}, which grid or random sets, too"));
            }
        }
        Ok(())
    }

    /// Keys that are swept one by one: those of grid and random.
    pub fn keys(&self) -> Vec<&str> {
        let random = self.random.iter().flat_map(|r| r.keys.keys());
        let mut keys: Vec<&str> = self.grid.keys().chain(random).map(String::as_str).collect();
        keys.sort_unstable();
        keys
    }

    /// Every setting in a fixed order: the name of its variant, and what makes it.
    pub fn settings(&self) -> Vec<(String, Changes)> {
        let mut all: Vec<_> = self.variants.iter().map(|v| (v.name.clone(), v.changes())).collect();
        if all.is_empty() {
            all.push((String::new(), Changes::new()));
        }
        for (key, values) in &self.grid {
            let with = |(name, base): &(String, Changes), value: &toml::Value| {
                let mut changes = base.clone();
                changes.insert(key.clone(), value.clone());
                (name.clone(), changes)
            };
            all = all.iter().flat_map(|base| values.iter().map(move |v| with(base, v)).collect::<Vec<_>>()).collect();
        }
        let Some(random) = &self.random else { return all };
        let count = random.count as u64;
        let drawn = |(k, (name, base)): (u64, (String, Changes))| {
            (0..count).map(move |i| {
                let mut rng = stream(random.seed, "sweep", k * count + i);
                let mut changes = base.clone();
                changes.extend(random.keys.iter().map(|(key, draw)| (key.clone(), draw.value(&mut rng))));
                (name.clone(), changes)
            })
        };
        (0..).zip(all).flat_map(drawn).collect()
    }

    /// Refuses what a task would stop at when it begins, be it in the environment that its recipe makes.
    pub fn check_tasks(&self, registry: &Registry) -> Result<()> {
        let settings = self.settings();
        for task in self.tasks(0, &(1..=settings.len()).collect::<Vec<_>>())?.iter().step_by(self.seeds.len()) {
            let named = |e: Error| Error::config(format!("setting {} {}: {e}", task.setting, task.variant));
            let scheme = Scheme::new(Recipe::parse(&task.id, &task.recipe, &[])?)?;
            check_stages(&scheme, registry).map_err(named)?;
        }
        Ok(())
    }

    /// The tasks of a rung (from 0) for these settings (numbers from 1), all checked. Without halving there is one rung.
    pub fn tasks(&self, rung: usize, settings: &[usize]) -> Result<Vec<Task>> {
        let all = self.settings();
        let mut tasks = Vec::new();
        for &setting in settings {
            let (variant, changes) = all.get(setting - 1).ok_or_else(|| Error::run(format!("the sweep has no setting {setting}")))?;
            let sets: Vec<String> = changes.iter().map(|(key, value)| format!("{key}={value}")).collect();
            let named = |e: Error| if variant.is_empty() { e } else { Error::config(format!("variant '{variant}': {e}")) };
            let mut base = Recipe::load(&self.recipe, &sets).map_err(named)?;
            if let Some(halving) = &self.halving {
                let epochs = *halving.epochs.get(rung).ok_or_else(|| Error::run(format!("the sweep has no rung {rung}")))?;
                let key = set_epochs(&mut base, epochs)?;
                if changes.contains_key(&key) {
                    return Err(named(Error::config(format!("{key} cannot be swept beside halving, which sets it"))));
                }
            }
            for &seed in &self.seeds {
                let recipe = Scheme::new(Recipe { seed, ..base.clone() }).map_err(named)?.recipe.to_toml()?;
                let folder = format!("settings/{setting:03}/seed-{seed}");
                let (id, hash) = (format!("{setting:03}-seed-{seed}"), content_hash(recipe.as_bytes()));
                let (variant, changes) = (variant.clone(), changes.clone());
                tasks.push(Task { id, setting, variant, changes, seed, folder, recipe, hash });
            }
        }
        Ok(tasks)
    }
}

/// Sets the epochs of a recipe, or of its last stage; gives the key.
fn set_epochs(recipe: &mut Recipe, epochs: u64) -> Result<String> {
    let Some(last) = recipe.stages.last_mut() else {
        recipe.run.epochs = epochs;
        return Ok("run.epochs".into());
    };
    let key = format!("stages.{}.run.epochs", last.name);
    let value = toml::Value::try_from(epochs).map_err(|e| Error::config(format!("{key}: {e}")))?;
    put(&mut last.changes, "run.epochs", value).map_err(|e| Error::config(format!("{key}: {e}")))?;
    Ok(key)
}

impl Draw {
    fn value(&self, rng: &mut Stream) -> toml::Value {
        match self {
            Self::Uniform([low, high]) => rng.random_range(*low..*high).into(),
            Self::Log([low, high]) => rng.random_range(low.ln()..high.ln()).exp().into(),
            Self::Choice(values) => values[rng.random_range(0..values.len())].clone(),
        }
    }
}

/// The settings that go on from a rung, by the mean of the figure over seeds, larger first and earlier of equals; at least one.
/// `None`: it has no value.
pub fn survivors(ranked: &[(usize, Option<f64>)], keep: f64) -> Vec<usize> {
    let mut order: Vec<_> = ranked.iter().filter_map(|(setting, value)| Some((*setting, (*value)?))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let count = ((ranked.len() as f64 * keep).ceil() as usize).max(1);
    let mut chosen: Vec<usize> = order.into_iter().take(count).map(|(setting, _)| setting).collect();
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(text: &str) -> Result<Sweep> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sweep.toml");
        std::fs::write(&path, format!("recipe = 'point'\nseeds = [0, 4]\nfigure = 'test_det/success'\n{text}")).unwrap();
        Sweep::read(&path)
    }

    #[test]
    fn grids_are_all_combinations() {
        let sweep = sweep("[grid]\n'ppo.clip' = [0.1, 0.2]\n'adam.schedule' = ['linear', 'constant', 'linear']").unwrap();
        let all: Vec<Changes> = sweep.settings().into_iter().map(|(_, changes)| changes).collect();
        let pair = |c: &Changes| (c["adam.schedule"].as_str().unwrap().to_string(), c["ppo.clip"].as_float().unwrap());
        assert_eq!(
            (all.len(), pair(&all[0]), pair(&all[1]), pair(&all[2])),
            (6, ("linear".into(), 0.1), ("linear".into(), 0.2), ("constant".into(), 0.1))
        );
        let tasks = sweep.tasks(0, &[2, 3]).unwrap();
        let ids: Vec<&str> = tasks.iter().map(|t| t.id.as_str()).collect();
        assert_eq!(ids, ["002-seed-0", "002-seed-4", "003-seed-0", "003-seed-4"]);
        let recipe = Recipe::parse("task", &tasks[3].recipe, &[]).unwrap();
        assert_eq!((recipe.seed, recipe.ppo.clip, recipe.adam.schedule), (4, 0.1, crate::Schedule::Constant));
        assert_eq!(tasks[3].folder, "settings/003/seed-4");
        let again = sweep.tasks(0, &[2, 3]).unwrap();
        assert!(again == tasks && tasks[0].hash != tasks[1].hash);
    }

    #[test]
    fn draws_stay_within_their_bounds_and_the_same() {
        let text = "[grid]\n'ppo.batch' = [256, 512]\n[random]\ncount = 200\nseed = 3\n[random.keys]\n'adam.lr' = { log = [1e-4, 1e-2] }
            'ppo.clip' = { uniform = [0.1, 0.3] }\n'ppo.passes' = { choice = [1, 2] }";
        let sweep = sweep(text).unwrap();
        assert_eq!(sweep.settings(), sweep.settings());
        let all: Vec<Changes> = sweep.settings().into_iter().map(|(_, changes)| changes).collect();
        assert_eq!(all.len(), 400);
        let below = |key: &str, x: f64| all.iter().filter(|c| c[key].as_float().unwrap() < x).count() as f64 / 400.0;
        assert_eq!((below("adam.lr", 1e-4), below("adam.lr", 1e-2), below("ppo.clip", 0.1), below("ppo.clip", 0.3)), (0.0, 1.0, 0.0, 1.0));
        // Half lies below the middle, geometric or not: within four standard deviations, 0.025 each.
        assert!((below("adam.lr", 1e-3) - 0.5).abs() < 0.1 && (below("ppo.clip", 0.2) - 0.5).abs() < 0.1);
        assert!(all.iter().all(|c| [1, 2].contains(&c["ppo.passes"].as_integer().unwrap())));
        assert_ne!(all[0]["adam.lr"], all[200]["adam.lr"], "every combination has draws of its own");
    }

    #[test]
    fn variants_are_crossed_with_the_grid() {
        let variants = "[[variants]]
            name = 'as it is'
            [[variants]]
            name = 'entropy, slow'
            set = { ppo.entropy = 0.5, ppo.kl_prior = 0.0, 'adam.schedule' = { adaptive = { target_kl = 0.02 } } }";
        let sweep = sweep(&format!("{variants}\n[grid]\n'ppo.clip' = [0.1, 0.2]")).unwrap();
        let tasks = sweep.tasks(0, &[1, 2, 3, 4]).unwrap();
        let names: Vec<&str> = tasks.iter().step_by(2).map(|t| t.variant.as_str()).collect();
        assert_eq!(names, ["as it is", "as it is", "entropy, slow", "entropy, slow"]);
        let recipe = |task: &Task| Recipe::parse("task", &task.recipe, &[]).unwrap();
        let (plain, other) = (recipe(&tasks[2]), recipe(&tasks[7]));
        assert_eq!((plain.ppo.clip, other.ppo.clip, other.seed), (0.2, 0.2, 4));
        assert_eq!((other.ppo.entropy, other.ppo.kl_prior), (0.5, 0.0));
        assert!(plain.ppo.entropy != 0.5 && matches!(other.adam.schedule, crate::Schedule::Adaptive { target_kl: 0.02, .. }));
        // Quoted keys, tables and dotted keys come to the same.
        let set = |text: &str| Variant { name: String::new(), set: toml::from_str(text).unwrap() }.changes();
        assert_eq!(set("'a.b' = 1\n'a.c' = 2"), set("a = { b = 1, c = 2 }"));
        assert_eq!(set("a.b = 1").keys().collect::<Vec<_>>(), ["a.b"]);
    }

    #[test]
    fn the_best_share_goes_on() {
        let ranked = [(1, Some(0.5)), (2, None), (3, Some(0.9)), (4, Some(0.5)), (5, Some(0.1))];
        assert_eq!(survivors(&ranked, 0.5), [1, 3, 4], "half of five, rounded up");
        assert_eq!(survivors(&ranked, 0.4), [1, 3], "of equals the earlier");
        assert_eq!(survivors(&ranked, 0.01), [3]);
        assert!(survivors(&[(1, None)], 0.5).is_empty());
        let sweep = sweep("[halving]\nepochs = [2, 4]\n[grid]\n'ppo.clip' = [0.1, 0.2]").unwrap();
        let epochs = |rung| Recipe::parse("task", &sweep.tasks(rung, &[1]).unwrap()[0].recipe, &[]).unwrap().run.epochs;
        assert_eq!((epochs(0), epochs(1), sweep.tasks(2, &[1]).is_err()), (2, 4, true));
    }

    #[test]
    fn wrong_sweeps_are_told() {
        for (text, word) in [
            ("[grid]\n'ppo.clip' = []", "grid.ppo.clip"),
            ("grids = 1", "grids"),
            ("[random]\ncount = 0\nkeys = {}", "random.count"),
            ("[random]\ncount = 1\nkeys = { a = { log = [0.0, 1.0] } }", "random.keys.a"),
            ("[halving]\nepochs = [4, 4]", "halving.epochs"),
            ("[halving]\nepochs = [4]\nkeep = 1.0", "halving.keep"),
            ("[[variants]]\nname = 'a'\n[[variants]]\nname = 'a'", "'a' is the name of variant 2"),
            ("[[variants]]\nname = ' '", "variant 1"),
            ("[[variants]]\nname = 'a'\nset = { ppo.clip = 0.1 }\n[grid]\n'ppo.clip' = [0.2]", "'a' sets ppo.clip"),
        ] {
            let e = sweep(text).unwrap_err().to_string();
            assert!(e.contains("sweep.toml") && e.contains(word), "{text}: {e}");
        }
        for (text, words) in [
            ("[grid]\n'ppo.clipp' = [0.1]", ["clipp", "clip"]),
            ("[[variants]]\nname = 'odd'\nset.ppo.clip = 1.5", ["variant 'odd'", "ppo.clip is 1.5"]),
            ("[halving]\nepochs = [4]\n[grid]\n'run.epochs' = [1]", ["run.epochs", "halving"]),
            ("[halving]\nepochs = [4]\n[[variants]]\nname = 'a'\nset = { run.epochs = 1 }", ["variant 'a'", "halving"]),
            ("[grid]\n'env_options.sise' = [1]", ["setting 1", "sise"]),
        ] {
            let e = sweep(text).unwrap().check_tasks(&Registry::standard()).unwrap_err().to_string();
            assert!(words.iter().all(|w| e.contains(w)), "{text}: {e}");
        }
    }
}
