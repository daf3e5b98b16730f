//! What changes or ends a run by its own figures: curricula, and rules of convergence.

use crate::recipe::{Recipe, RunConfig, put};
use crate::registry::{Purpose, Registry};
use crate::stats::Row;
use crate::{Error, Result};
use egogen_envs::{EnvSpec, VecEnv};
use serde::{Deserialize, Serialize};

/// What a figure of metrics.csv has to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Goal {
    /// The column.
    pub figure: String,
    /// It is above this.
    #[serde(default)]
    pub over: Option<f64>,
    /// It is below this.
    #[serde(default)]
    pub under: Option<f64>,
    /// That many times in a row.
    #[serde(default = "once")]
    pub times: u64,
    /// In place of `over` and `under`: that many times in a row it has not risen above the best so far by more than `least`.
    #[serde(default)]
    pub patience: Option<u64>,
    /// See `patience`.
    #[serde(default)]
    pub least: f64,
}

/// An option of the environment that changes while training goes on; tests always have its last value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curriculum {
    /// Its key below `env_options`, e.g. `task.rooms.difficulty`.
    pub key: String,
    /// What it is, one after the other.
    pub values: Vec<toml::Value>,
    /// Epochs after which the next value comes; one fewer than values.
    #[serde(default)]
    pub at: Vec<u64>,
    /// In place of `at`: what brings the next value.
    #[serde(default)]
    pub advance: Option<Goal>,
}

fn once() -> u64 {
    1
}

impl Goal {
    /// Refuses goals that say nothing or too much; `key` names it.
    pub fn check(&self, key: &str) -> Result<()> {
        let bad = |what: &str| Err(Error::config(format!("{key}{what}")));
        let kinds = [self.over.is_some(), self.under.is_some(), self.patience.is_some()];
        if kinds.iter().filter(|k| **k).count() != 1 {
            return bad(": expected one of over, under and patience");
        }
        if [self.over, self.under].into_iter().flatten().any(|v| !v.is_finite()) {
            return bad(": expected a finite number for over or under");
        }
        if self.patience.is_none() && self.least != 0.0 || !(self.least >= 0.0 && self.least.is_finite()) {
            return bad(&format!(".least is {}, expected 0 or more, beside patience", self.least));
        }
        if self.times == 0 || self.patience.is_some() && self.times != 1 {
            return bad(&format!(".times is {}, expected at least 1, beside over or under", self.times));
        }
        if self.patience == Some(0) {
            return bad(".patience is 0, expected at least 1");
        }
        Ok(())
    }
}

impl Curriculum {
    /// Refuses one that never comes to its last value; `key` names it.
    pub fn check(&self, key: &str) -> Result<()> {
        let bad = |what: String| Err(Error::config(format!("{key} of '{}': {what}", self.key)));
        let (n, at) = (self.values.len(), &self.at);
        if n < 2 {
            return bad(format!("values has {n}, expected at least 2"));
        }
        match &self.advance {
            Some(_) if !at.is_empty() => bad("expected one of at and advance".into()),
            Some(goal) => goal.check(&format!("{key}.advance")),
            None if at.len() + 1 != n => bad(format!("at has {} epochs, expected {} for {n} values, or give advance", at.len(), n - 1)),
            None if at.first() == Some(&0) || !at.is_sorted_by(|a, b| a < b) => {
                bad(format!("at is {at:?}, expected epochs from 1 up, each later than the one before"))
            }
            None => Ok(()),
        }
    }
}

/// How often a goal was met, and what a figure has been.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Watch {
    /// Times in a row until now.
    met: u64,
    /// The largest that counted as a rise.
    best: Option<f64>,
}

impl Watch {
    /// Whether the goal is reached now that its figure is `value`.
    fn note(&mut self, goal: &Goal, value: f64) -> bool {
        let counts = match goal.patience {
            Some(_) => {
                let risen = self.best.is_none_or(|best| value > best + goal.least);
                self.best = if risen { Some(value) } else { self.best };
                !risen
            }
            None => goal.over.is_some_and(|v| value > v) || goal.under.is_some_and(|v| value < v),
        };
        self.met = if counts { self.met + 1 } else { 0 };
        self.met >= goal.patience.unwrap_or(goal.times)
    }
}

/// How far a run's curricula and its rule of convergence have come; saved with checkpoints.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Course {
    /// Which value each curriculum has, from 0; shorter than their list while the rest are at their first.
    pub levels: Vec<usize>,
    watches: Vec<Watch>,
    until: Watch,
    /// The rule `until` has ended the run.
    pub ended: bool,
}

impl Course {
    /// Looks at the figures of the whole epoch `epoch`; whether a curriculum went on to another value. `until` counts tests alone, and
    /// only those at every curriculum's last value.
    pub fn note(&mut self, recipe: &Recipe, epoch: u64, tested: bool, row: &Row) -> bool {
        let get = |name: &str| row.iter().find(|(n, _)| n == name).and_then(|(_, v)| *v);
        let n = recipe.curriculum.len();
        self.levels.resize(n, 0);
        self.watches.resize(n, Watch::default());
        let before = self.levels.clone();
        for ((entry, level), watch) in recipe.curriculum.iter().zip(&mut self.levels).zip(&mut self.watches) {
            let Some(goal) = &entry.advance else {
                *level = entry.at.iter().filter(|at| **at <= epoch).count();
                continue;
            };
            if *level + 1 < entry.values.len() && get(&goal.figure).is_some_and(|value| watch.note(goal, value)) {
                *level += 1;
                *watch = Watch::default();
            }
        }
        let at_last = before == last_levels(recipe);
        if let (Some(goal), true, true) = (&recipe.until, tested, at_last) {
            self.ended |= get(&goal.figure).is_some_and(|value| self.until.note(goal, value));
        }
        before != self.levels
    }
}

/// The levels that curricula lead to.
pub fn last_levels(recipe: &Recipe) -> Vec<usize> {
    recipe.curriculum.iter().map(|c| c.values.len().saturating_sub(1)).collect()
}

/// The environment's options at these levels; curricula beyond their end are at their first value.
pub fn options(recipe: &Recipe, levels: &[usize]) -> Result<toml::Table> {
    let mut options = recipe.env_options.clone();
    let levels = levels.iter().copied().chain(std::iter::repeat(0));
    for (entry, level) in recipe.curriculum.iter().zip(levels) {
        let value = entry.values.get(level).ok_or_else(|| Error::run(format!("curriculum of '{}': no value {level}", entry.key)))?;
        put(&mut options, &entry.key, value.clone()).map_err(|e| Error::config(format!("curriculum of '{}': {e}", entry.key)))?;
    }
    Ok(options)
}

/// The columns that say which value every curriculum has, counted from 1.
pub fn columns(recipe: &Recipe, levels: &[usize]) -> Row {
    let levels = levels.iter().copied().chain(std::iter::repeat(0));
    recipe.curriculum.iter().zip(levels).map(|(c, level)| (format!("curriculum/{}", c.key), Some(level as f64 + 1.0))).collect()
}

/// The environments for training at these levels of the curricula; they must be such as tests have.
pub(crate) fn training_env(recipe: &Recipe, registry: &Registry, levels: &[usize], spec: &EnvSpec) -> Result<Box<dyn VecEnv>> {
    let made = registry.make(&recipe.env, &options(recipe, levels)?, recipe.run.envs, Purpose::Train)?;
    let own = made.env.spec();
    if (&own.obs, own.action) == (&spec.obs, spec.action) {
        return Ok(made.env);
    }
    let keys: Vec<&str> = recipe.curriculum.iter().map(|c| c.key.as_str()).collect();
    let what = "changes what is observed or what an action is, which must stay as it is";
    Err(Error::config(format!("recipe '{}': a curriculum of {} {what}", recipe.name, keys.join(", "))))
}

/// Makes an environment with every value of every curriculum, so that a wrong one is told at the start.
pub(crate) fn check_levels(recipe: &Recipe, registry: &Registry, spec: &EnvSpec) -> Result<()> {
    let one = Recipe { run: RunConfig { envs: 1, ..recipe.run }, ..recipe.clone() };
    for (i, entry) in recipe.curriculum.iter().enumerate() {
        for value in 0..entry.values.len() {
            let mut levels = last_levels(recipe);
            levels[i] = value;
            let named = |e| Error::config(format!("recipe '{}': curriculum of '{}', value {}: {e}", recipe.name, entry.key, value + 1));
            training_env(&one, registry, &levels, spec).map_err(named)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe(text: &str) -> Recipe {
        Recipe::parse("test", &format!("{}\n{text}", include_str!("../recipes/point.toml")), &[]).unwrap()
    }

    fn row(success: f64) -> Row {
        vec![("train/success".into(), Some(success)), ("test_det/success".into(), None)]
    }

    #[test]
    fn schedules_follow_the_epochs() {
        let recipe = recipe("[[curriculum]]\nkey = 'a.b'\nvalues = [1, 2, 3]\nat = [2, 5]");
        let mut course = Course::default();
        let changed: Vec<bool> = (1..=6).map(|epoch| course.note(&recipe, epoch, false, &row(0.0))).collect();
        assert_eq!(changed, [false, true, false, false, true, false]);
        assert_eq!(course.levels, last_levels(&recipe));
        let b = |levels: &[usize]| options(&recipe, levels).unwrap()["a"]["b"].as_integer();
        assert_eq!([b(&[]), b(&[1]), b(&course.levels)], [Some(1), Some(2), Some(3)]);
        assert_eq!(columns(&recipe, &[1]), [("curriculum/a.b".to_string(), Some(2.0))]);
    }

    #[test]
    fn goals_advance_level_by_level() {
        let recipe = recipe(
            "[[curriculum]]\nkey = 'a'\nvalues = [1, 2, 3]\nadvance = { figure = 'train/success', over = 0.8, times = 2 }
             [[curriculum]]\nkey = 'b'\nvalues = [1, 2]\nadvance = { figure = 'test_det/success', over = 0.0 }",
        );
        let mut course = Course::default();
        // 0.8 is not above 0.8; a level has to be earned anew; beyond the last there is none; a figure that is missing does nothing.
        let seen = [0.9, 0.8, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9];
        let levels: Vec<_> = (1..)
            .zip(seen)
            .map(|(epoch, success)| {
                course.note(&recipe, epoch, true, &row(success));
                course.levels.clone()
            })
            .collect();
        assert_eq!(levels, [[0, 0], [0, 0], [0, 0], [1, 0], [1, 0], [2, 0], [2, 0], [2, 0]]);
    }

    #[test]
    fn a_run_ends_when_its_figure_stays() {
        let ends = |rule: &str, figures: &[f64]| {
            let recipe = recipe(&format!("[until]\nfigure = 'train/success'\n{rule}"));
            let mut course = Course::default();
            figures.iter().position(|&f| {
                course.note(&recipe, 1, true, &row(f));
                course.ended
            })
        };
        assert_eq!(ends("over = 0.5\ntimes = 2", &[0.6, 0.4, 0.6, 0.6, 0.0]), Some(3));
        assert_eq!(ends("under = 0.5", &[0.6, 0.5, 0.4]), Some(2));
        // Rises of 0.1 or less do not count, however many: 0.5 is the best until 0.7.
        assert_eq!(ends("patience = 3\nleast = 0.1", &[0.5, 0.55, 0.6, 0.7, 0.75, 0.1, 0.75]), Some(6));
        assert_eq!(ends("patience = 3", &[0.5, 0.55, 0.6, 0.7]), None);
    }

    #[test]
    fn tests_at_the_last_value_alone_end_a_run() {
        let recipe = recipe("[until]\nfigure = 'train/success'\nover = 0.5\n[[curriculum]]\nkey = 'a'\nvalues = [1, 2]\nat = [2]");
        let mut course = Course::default();
        let mut ended = |epoch, tested| {
            course.note(&recipe, epoch, tested, &row(1.0));
            course.ended
        };
        assert!(!ended(1, true) && !ended(2, true) && !ended(3, false) && ended(4, true));
    }

    #[test]
    fn what_makes_no_rule_is_named() {
        let goal = |text: &str| toml::from_str::<Goal>(&format!("figure = 'x'\n{text}")).unwrap().check("until").unwrap_err().to_string();
        for (text, word) in [
            ("", "one of over, under and patience"),
            ("over = 1.0\npatience = 2", "one of over, under and patience"),
            ("over = nan", "finite"),
            ("over = 1.0\nleast = 1.0", "until.least is 1"),
            ("patience = 2\ntimes = 2", "until.times is 2"),
            ("over = 1.0\ntimes = 0", "until.times is 0"),
            ("patience = 0", "until.patience is 0"),
        ] {
            assert!(goal(text).contains(word), "{text}: {}", goal(text));
        }
        let entry = |text: &str| toml::from_str::<Curriculum>(&format!("key = 'a.b'\n{text}")).unwrap().check("curriculum 1");
        for (text, word) in [
            ("values = [1]\nat = []", "values has 1"),
            ("values = [1, 2]", "at has 0 epochs, expected 1"),
            ("values = [1, 2, 3]\nat = [3, 3]", "at is [3, 3]"),
            ("values = [1, 2]\nat = [0]", "at is [0]"),
            ("values = [1, 2]\nat = [1]\nadvance = { figure = 'x', over = 1.0 }", "one of at and advance"),
            ("values = [1, 2]\nadvance = { figure = 'x' }", "curriculum 1.advance: expected one of"),
        ] {
            let e = entry(text).unwrap_err().to_string();
            assert!(e.contains(word), "{text}: {e}");
        }
    }
}
