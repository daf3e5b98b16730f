//! What a run begins from: a seed, a policy or its newest checkpoint.

use crate::checkpoint::{self, Checkpoint, DESCRIPTION, RECIPE, STATE};
use crate::collector::Collector;
use crate::logger::Csv;
use crate::ppo::Progress;
use crate::recipe::{Plan, Recipe, difference};
use crate::stats::{Episodes, EpochStats};
use crate::{AdamW, Error, Result, RewardScaling, Running};
use egogen::agent::bundle::{Bundle, Trained};
use egogen::agent::{ObsLayout, PolicySpec};
use egogen::io::Precision;
use egogen_envs::{ActionSpace, EnvSpec};
use std::collections::BTreeMap;
use std::path::Path;

/// Entry of a policy's origin: content hash of the weights that its training began with, where they came from a bundle.
pub(crate) const INIT: &str = "init";

/// What a run begins from.
pub(crate) enum Start<'a> {
    Seed,
    Policy(&'a Bundle),
    /// A checkpoint of the stage before.
    Stage(Box<Carried>),
    /// The run's newest checkpoint; the function hears of those that cannot be used.
    Resume(&'a mut dyn FnMut(String)),
}

/// What one stage hands to the next: weights, and what normalisers have come to.
pub(crate) struct Carried {
    /// The weights, in single precision.
    pub bundle: Bundle,
    pub learning: Progress,
    pub scaling: RewardScaling,
    /// The optimiser, where it comes along.
    pub adam: Option<AdamW>,
}

impl Carried {
    /// Takes the checkpoint in the folder `dir`.
    pub fn read(dir: &Path, optimiser: bool) -> Result<Self> {
        let c = Checkpoint::read(dir)?;
        let d = c.description;
        let spec = PolicySpec::new(d.policy, d.layout, d.action)?;
        let trained = Trained { recipe: d.recipe, seed: d.seed, epoch: d.epoch, env_steps: d.env_steps, test: d.test };
        let old = c.state.learning;
        let learning = Progress { updates: 0, learning_rate: old.learning_rate.filter(|_| optimiser), ..old };
        Ok(Self {
            bundle: Bundle::with_precision(spec, &c.params, d.origin, trained, Precision::Full)?,
            learning,
            scaling: c.state.scaling.anew(),
            adam: optimiser.then_some(c.adam),
        })
    }
}

/// The policy that a plan trains in these environments.
pub fn policy_spec(plan: &Plan, env: &EnvSpec) -> Result<PolicySpec> {
    let ppo = &plan.recipe.ppo;
    if matches!(env.action, ActionSpace::Discrete(_)) && ppo.kl_prior > 0.0 {
        let (name, kl) = (&plan.recipe.name, ppo.kl_prior);
        return Err(Error::config(format!(
            "recipe '{name}': ppo.kl_prior is {kl}, expected 0: the actions are discrete and have no prior"
        )));
    }
    PolicySpec::new(plan.recipe.policy.clone(), ObsLayout::new(env.obs.clone()), env.action)
        .map_err(|e| Error::config(format!("recipe '{}': {e}", plan.recipe.name)))
}

/// What a bundle knows of observations, as if counted here.
pub(crate) fn seen(bundle: &Bundle) -> Vec<Running> {
    let norm = &bundle.params[bundle.spec.obs_norm_range()];
    let (mean, std) = norm.split_at(norm.len() / 2);
    let count = bundle.trained.env_steps as f64;
    let one = |(&m, &s): (&f32, &f32)| Running { mean: f64::from(m), variance: f64::from(s).powi(2), count };
    mean.iter().zip(std).map(one).collect()
}

/// The weights of `bundle` for a policy of these sizes that stands on `origin`; `key` says in errors who gave it.
pub(crate) fn initial(key: &str, bundle: &Bundle, spec: &PolicySpec, origin: &BTreeMap<String, String>) -> Result<Vec<f32>> {
    let bad = |e: egogen::Error| Error::config(format!("{key}: {e}"));
    let params = bundle.weights_for(spec).map_err(bad)?;
    origin.iter().try_for_each(|(what, hash)| bundle.require(what, hash)).map_err(bad)?;
    Ok(params)
}

/// The checkpoint that the run in `dir` continues from, loaded into what `make` makes for its curricula's levels; clears up what a
/// kill left half done.
pub(crate) fn find(
    dir: &Path,
    recipe: &Recipe,
    spec: &PolicySpec,
    origin: &BTreeMap<String, String>,
    make: &dyn Fn(&[usize]) -> Result<Collector>,
    warn: &mut dyn FnMut(String),
) -> Result<Option<(Checkpoint, Collector)>> {
    let root = dir.join("checkpoints");
    let mut loaded = None;
    let accept = |c: &Checkpoint| {
        let folder = root.join(c.name());
        check_same(c, &folder, recipe, spec, origin)?;
        let mut collector = make(&c.state.course.levels)?;
        collector.load(&c.state.collector).map_err(|e| egogen::Error::file(folder.join(STATE), e.to_string()))?;
        loaded = Some(collector);
        Ok(())
    };
    let mut from = checkpoint::newest(&root, accept, &mut *warn)?;
    match &mut from {
        None => {
            let reported = Csv::epochs(&dir.join("metrics.csv"))?;
            if reported > recipe.checkpoint.every {
                let what = format!("holds no checkpoint, though metrics.csv reports {reported} epochs; nothing to continue from");
                return Err(Error::config(format!("{}: {what}", root.display())));
            }
            warn(format!("{}: holds no checkpoint yet; the run starts from the beginning", root.display()));
        }
        Some(c) => {
            let lost = c.state.best.take_if(|b| Checkpoint::read(&root.join(&b.name)).is_err());
            lost.inspect(|b| {
                warn(format!("{}: the best checkpoint so far is lost; only later ones can be the best", root.join(&b.name).display()))
            });
        }
    }
    [dir, &root, &dir.join("policy")].into_iter().try_for_each(checkpoint::sweep)?;
    Ok(from.zip(loaded))
}

/// A run goes on only with what it began with.
fn check_same(c: &Checkpoint, folder: &Path, recipe: &Recipe, spec: &PolicySpec, origin: &BTreeMap<String, String>) -> Result<()> {
    let bad = |file: &str, what: String| Err(egogen::Error::file(folder.join(file), what).into());
    if let Some(text) = &c.recipe {
        let theirs = Recipe::parse(&folder.join(RECIPE).display().to_string(), text, &[])?;
        if let Some((key, [was, is])) = difference(&theirs, recipe)? {
            return bad(RECIPE, format!("is of another run: {key} is {was}, expected {is}"));
        }
    }
    let d = &c.description;
    if (&d.recipe, d.seed) != (&recipe.name, recipe.seed) {
        let what = format!("is of another run: '{}' with seed {}, expected '{}' with seed {}", d.recipe, d.seed, recipe.name, recipe.seed);
        return bad(DESCRIPTION, what);
    }
    if d.layout != spec.layout || d.policy != spec.config || d.action != spec.action {
        return bad(DESCRIPTION, "holds a policy of other sizes than the recipe and its environment ask for".into());
    }
    match origin.iter().find(|(name, hash)| d.origin.get(*name) != Some(hash)) {
        Some((name, hash)) => {
            let was = d.origin.get(name).map_or("nothing", String::as_str);
            bad(DESCRIPTION, format!("was trained on {name} {was}, but {name} {hash} is here now"))
        }
        None => Ok(()),
    }
}

/// Figures that rules go by must be ones that are reported.
pub(crate) fn check_figures(recipe: &Recipe, env: &EnvSpec) -> Result<()> {
    let rows = [EpochStats::default().row(env), Episodes::default().row("test_sto", env), Episodes::default().row("test_det", env)];
    let names: Vec<String> = rows.into_iter().flatten().map(|(name, _)| name).collect();
    let mut wanted = vec![("checkpoint.best".to_string(), &recipe.checkpoint.best)];
    wanted.extend(recipe.until.iter().map(|goal| ("until.figure".into(), &goal.figure)));
    let goals = recipe.curriculum.iter().zip(1..).filter_map(|(c, i)| Some((i, c.advance.as_ref()?)));
    wanted.extend(goals.map(|(i, goal)| (format!("curriculum {i}.advance.figure"), &goal.figure)));
    match wanted.into_iter().find(|(_, figure)| !names.contains(figure)) {
        Some((key, figure)) => Err(Error::config(format!("{key} is '{figure}', expected one of: {}", names.join(", ")))),
        None => Ok(()),
    }
}
