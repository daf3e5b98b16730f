//! Recipes of several stages: what each of them trains, and from where it begins.

use crate::recipe::{Plan, Recipe};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Seeds of stages are this far apart, so that each has starts and noise of its own.
const SEEDS: u64 = 1_000_000;

/// A stage as written: what differs from the recipe that it stands in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stage {
    /// Names its folder.
    pub name: String,
    /// What it begins with; absent: the best policy of the stage before, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<From>,
    /// Whether the optimiser's moments and step size come along.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optimiser: bool,
    /// Keys of the recipe with their values here.
    #[serde(flatten)]
    pub changes: toml::Table,
}

/// What a stage begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum From {
    /// The policy that was chosen in the stage before.
    Best,
    /// The last policy of the stage before.
    Last,
    /// Fresh weights; in the first stage those of `--init`, where it is given.
    Nothing,
}

/// A checked recipe with its stages; one of itself alone where it has none.
#[derive(Clone, Debug, PartialEq)]
pub struct Scheme {
    /// The recipe as it was given.
    pub recipe: Recipe,
    /// What is trained, in this order.
    pub parts: Vec<Part>,
}

/// One stage, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Its name; empty for a recipe without stages.
    pub name: String,
    pub from: From,
    pub optimiser: bool,
    pub plan: Plan,
}

impl Scheme {
    /// Checks every value of every stage.
    pub fn new(recipe: Recipe) -> Result<Self> {
        if recipe.stages.is_empty() {
            let part = Part { name: String::new(), from: From::Nothing, optimiser: false, plan: recipe.clone().plan()? };
            return Ok(Self { recipe, parts: vec![part] });
        }
        let mut parts: Vec<Part> = Vec::new();
        for (i, stage) in recipe.stages.iter().enumerate() {
            let named = |e: Error| Error::config(format!("stage '{}': {e}", stage.name));
            let part = part(&recipe, i, stage, parts.last()).map_err(named)?;
            if parts.iter().any(|p| p.name == part.name) {
                return Err(named(Error::config("another stage has the same name")));
            }
            parts.push(part);
        }
        Ok(Self { recipe, parts })
    }

    /// Whether the recipe has stages.
    pub fn staged(&self) -> bool {
        !self.recipe.stages.is_empty()
    }

    /// Epochs of all stages together.
    pub fn epochs(&self) -> u64 {
        self.parts.iter().map(|p| p.plan.recipe.run.epochs).sum()
    }
}

/// Stage `i`, which follows `before`.
fn part(recipe: &Recipe, i: usize, stage: &Stage, before: Option<&Part>) -> Result<Part> {
    let bad = |what: String| Err(Error::config(what));
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    if stage.name.is_empty() || !stage.name.chars().all(plain) {
        return bad(format!("name is '{}', expected letters, digits, - and _", stage.name));
    }
    if let Some(key) = ["seed", "stages"].into_iter().find(|key| stage.changes.contains_key(*key)) {
        return bad(format!("{key} cannot be given in a stage"));
    }
    let own = resolve(recipe, i, stage)?;
    let from = stage.from.unwrap_or(if before.is_some() { From::Best } else { From::Nothing });
    match before {
        None if from != From::Nothing => return bad("from: the first stage has none before it; give a policy by --init".into()),
        Some(b) if from != From::Nothing && b.plan.recipe.policy != own.policy => {
            return bad(format!("policy differs from that of stage '{}', whose weights it begins with", b.name));
        }
        _ => {}
    }
    if stage.optimiser && from == From::Nothing {
        return bad("optimiser is true, expected false where the stage begins from nothing".into());
    }
    Ok(Part { name: stage.name.clone(), from, optimiser: stage.optimiser, plan: own.plan()? })
}

/// The recipe with the changes of stage `i`.
fn resolve(recipe: &Recipe, i: usize, stage: &Stage) -> Result<Recipe> {
    let bad = |e: &dyn std::fmt::Display| Error::config(e.to_string().trim_end().to_string());
    let mut table = toml::Table::try_from(recipe).map_err(|e| bad(&e))?;
    table.remove("stages");
    merge(&mut table, &stage.changes);
    // As text, so that errors show the line.
    let text = toml::to_string(&table).map_err(|e| bad(&e))?;
    let mut own: Recipe = toml::from_str(&text).map_err(|e| bad(&e))?;
    own.name = format!("{}-{}", recipe.name, stage.name);
    own.seed = recipe.seed.wrapping_add(SEEDS * i as u64);
    Ok(own)
}

/// Puts every value of `changes` in its place in `base`; of tables only what is named.
fn merge(base: &mut toml::Table, changes: &toml::Table) {
    for (key, value) in changes {
        match (base.get_mut(key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(changes)) => merge(inner, changes),
            _ => _ = base.insert(key.clone(), value.clone()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &str = "
[env_options.task]
latents = 4
[env_options.task.weights]
penetration = 1.0
dist = 2.0
[[stages]]
name = 'pretrain'
run = { epochs = 3 }
[[stages]]
name = 'finetune'
from = 'last'
optimiser = true
adam.schedule = 'linear'
[stages.env_options.task]
weights = { penetration = 0.1 }
penetration.most = 40
";

    fn scheme(stages: &str, changes: &[&str]) -> Result<Scheme> {
        let changes: Vec<String> = changes.iter().map(|c| c.to_string()).collect();
        Recipe::parse("test", &format!("{}\n{stages}", include_str!("../recipes/point.toml")), &changes).and_then(Scheme::new)
    }

    #[test]
    fn stages_are_the_recipe_but_for_what_they_name() {
        let scheme = scheme(TWO, &["seed=7"]).unwrap();
        let [a, b] = [0, 1].map(|i| &scheme.parts[i].plan.recipe);
        assert_eq!((a.name.as_str(), b.name.as_str(), a.seed, b.seed), ("point-pretrain", "point-finetune", 7, 1_000_007));
        assert_eq!((a.run.epochs, b.run.epochs, scheme.epochs()), (3, 20, 23));
        assert_eq!((a.adam.schedule, b.adam.schedule), (crate::Schedule::Constant, crate::Schedule::Linear));
        let task = |r: &Recipe| r.env_options["task"].as_table().unwrap().clone();
        assert_eq!(
            task(a),
            toml::toml! { latents = 4
            weights = { penetration = 1.0, dist = 2.0 } }
        );
        assert_eq!(
            task(b),
            toml::toml! { latents = 4
            weights = { penetration = 0.1, dist = 2.0 }
            penetration = { most = 40 } }
        );
        assert_eq!((scheme.parts[0].from, scheme.parts[1].from, scheme.parts[1].optimiser), (From::Nothing, From::Last, true));
        // The whole recipe survives being written and read.
        let again = Recipe::parse("again", &scheme.recipe.to_toml().unwrap(), &[]).unwrap();
        assert_eq!(Scheme::new(again).unwrap(), scheme);
    }

    #[test]
    fn stages_can_be_changed_by_name_and_by_number() {
        let epochs = |change: &str| scheme(TWO, &[change]).map(|s| s.parts.iter().map(|p| p.plan.recipe.run.epochs).collect::<Vec<_>>());
        assert_eq!(epochs("stages.finetune.run.epochs=5").unwrap(), [3, 5]);
        assert_eq!(epochs("stages.1.run.epochs=5").unwrap(), [5, 20]);
        assert_eq!(epochs("run.epochs=5").unwrap(), [3, 5], "what a stage says counts for it");
        for (change, word) in
            [("stages.3.run.epochs=5", "pretrain, finetune"), ("stages=5", "stages"), ("stages.pretrain=5", "a key of it")]
        {
            let e = epochs(change).unwrap_err().to_string();
            assert!(e.contains(word), "{change}: {e}");
        }
    }

    #[test]
    fn what_a_stage_cannot_be_is_told_with_its_name() {
        let first = "[[stages]]\nname = 'a'\n";
        for (stages, words) in [
            ("[[stages]]\nname = 'a'\nppo.clipp = 0.1", ["'a'", "clipp"]),
            ("[[stages]]\nname = 'a'\nfinetune = true", ["'a'", "finetune"]),
            ("[[stages]]\nname = 'a'\nppo.clip = 1.5", ["'a'", "ppo.clip is 1.5"]),
            ("[[stages]]\nname = 'a b'", ["'a b'", "letters, digits"]),
            ("[[stages]]\nname = 'a'\nseed = 3", ["'a'", "seed cannot"]),
            ("[[stages]]\nname = 'a'\nfrom = 'best'", ["'a'", "--init"]),
            (&format!("{first}{first}"), ["'a'", "same name"]),
            (&format!("{first}[[stages]]\nname = 'b'\npolicy.trunk = 8"), ["'b'", "policy differs from that of stage 'a'"]),
            (&format!("{first}[[stages]]\nname = 'b'\nfrom = 'nothing'\noptimiser = true"), ["'b'", "optimiser is true"]),
            (&format!("{first}[[stages]]\nname = 'b'\nselect = {{}}"), ["'b'", "checkpoint.keep_every is not set"]),
            (&format!("{first}[[stages]]\nname = 'b'\nfrom = 'first'"), ["from", "first"]),
        ] {
            let e = scheme(stages, &[]).unwrap_err().to_string();
            assert!(words.iter().all(|w| e.contains(w)), "{stages}: {e}");
        }
        assert!(scheme(TWO, &[]).unwrap().recipe.plan().unwrap_err().to_string().contains("pretrain"));
    }
}
