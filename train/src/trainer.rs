//! The run: collect, update, report, test, save; from the start or from a checkpoint.

use crate::checkpoint::{self, Best, Checkpoint, Description, State};
use crate::clock::Clock;
use crate::collector::{Collector, test_episodes};
use crate::course::{Course, check_levels, columns, last_levels, options, training_env};
use crate::logger::{Console, Csv, Logger};
use crate::policy::Compute;
use crate::ppo::{Learner, Progress, Rules};
use crate::recipe::Plan;
use crate::registry::{Purpose, Registry};
use crate::select::select;
use crate::shards::Shards;
use crate::start::{Carried, INIT, Start, check_figures, find, initial, policy_spec, seen};
use crate::stats::{Episodes, EpochStats, Row};
use crate::tensorboard::TensorBoard;
use crate::{AdamW, Error, Result, RewardScaling};
use egogen::agent::PolicySpec;
use egogen::agent::bundle::{Bundle, Trained};
use egogen::io::write_atomic;
use egogen::rng::stream;
use egogen_envs::{EnvSpec, VecEnv};
use rand::RngExt;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All epochs are done.
    Finished,
    /// Stopped from outside, after saving.
    Interrupted,
}

/// Seconds of updates that an estimate measures.
const MEASURED: f64 = 0.5;

/// A run in its folder.
pub struct Trainer<'a> {
    plan: Plan,
    registry: &'a Registry,
    dir: PathBuf,
    origin: BTreeMap<String, String>,
    env_spec: EnvSpec,
    collector: Collector,
    test_env: Box<dyn VecEnv>,
    learner: Learner,
    scaling: RewardScaling,
    epoch: u64,
    env_steps: u64,
    stats: EpochStats,
    best: Option<Best>,
    last_test: BTreeMap<String, f64>,
    last_epoch: BTreeMap<String, f64>,
    course: Course,
}

impl<'a> Trainer<'a> {
    /// Starts a run in the new folder `dir`; from the weights of the policy `init`, where one is given.
    pub fn start(plan: Plan, registry: &'a Registry, dir: &Path, threads: usize, init: Option<&Bundle>) -> Result<Self> {
        Self::begin(plan, registry, dir, threads, init.map_or(Start::Seed, Start::Policy))
    }

    /// Starts a run in the new folder `dir`.
    pub(crate) fn begin(plan: Plan, registry: &'a Registry, dir: &Path, threads: usize, start: Start) -> Result<Self> {
        let fresh = matches!(start, Start::Seed);
        let run = Self::build(plan, registry, dir, threads, start)?.note_recipe()?;
        // Resuming knows no other way to weights that do not come from the seed.
        if !fresh {
            run.save()?;
        }
        Ok(run)
    }

    /// Continues the run in `dir` from its newest usable checkpoint, or from the start where it was killed before the first.
    pub fn resume(plan: Plan, registry: &'a Registry, dir: &Path, threads: usize, mut warn: impl FnMut(String)) -> Result<Self> {
        Self::build(plan, registry, dir, threads, Start::Resume(&mut warn))?.note_recipe()
    }

    /// Whether the plan fits its environment; the policy that it trains there.
    pub(crate) fn check(plan: &Plan, registry: &Registry) -> Result<PolicySpec> {
        let recipe = &plan.recipe;
        let made = registry.make(&recipe.env, &options(recipe, &last_levels(recipe))?, 1, Purpose::Test)?;
        check_figures(recipe, made.env.spec())?;
        check_levels(recipe, registry, made.env.spec())?;
        policy_spec(plan, made.env.spec())
    }

    /// Seconds that a whole run of this plan takes here, from some updates and one test of an untrained policy. Writes nothing.
    pub fn estimate(plan: Plan, registry: &'a Registry, threads: usize) -> Result<f64> {
        let run = plan.recipe.run;
        let every = plan.recipe.test.every;
        let (updates, tests) = (run.epochs * plan.updates_per_epoch, run.epochs.div_ceil(every));
        let mut trainer = Self::build(plan, registry, Path::new(""), threads, Start::Seed)?;
        // The first one also pays for memory and threads.
        trainer.update(&mut Clock::default())?;
        let (mut clock, mut done) = (Clock::default(), 0.0);
        while done == 0.0 || clock.total() < MEASURED {
            trainer.update(&mut clock)?;
            done += 1.0;
        }
        let each = clock.total() / done;
        let start = Instant::now();
        trainer.test(true)?;
        Ok(updates as f64 * each + tests as f64 * start.elapsed().as_secs_f64())
    }

    fn note_recipe(self) -> Result<Self> {
        write_atomic(self.dir.join("recipe.toml"), self.plan.recipe.to_toml()?.as_bytes())?;
        Ok(self)
    }

    fn build(plan: Plan, registry: &'a Registry, dir: &Path, threads: usize, start: Start) -> Result<Self> {
        let recipe = &plan.recipe;
        let goal = options(recipe, &last_levels(recipe))?;
        let made = registry.make(&recipe.env, &goal, recipe.test.episodes, Purpose::Test)?;
        let (test_env, mut origin) = (made.env, made.origin);
        let env_spec = test_env.spec().clone();
        let spec = policy_spec(&plan, &env_spec)?;
        check_figures(recipe, &env_spec)?;
        let make = |levels: &[usize]| Collector::new(training_env(recipe, registry, levels, &env_spec)?, recipe.seed);
        let (start, from) = match start {
            Start::Resume(warn) => (Start::Seed, find(dir, recipe, &spec, &origin, &make, warn)?),
            start => (start, None),
        };
        let fresh = |params| (params, AdamW::new(spec.learned()), State::default());
        let (collector, (params, adam, state)) = match from {
            Some((c, collector)) => {
                origin = c.description.origin;
                (collector, (c.params, c.adam, c.state))
            }
            None => {
                let collector = make(&[])?;
                check_levels(recipe, registry, &env_spec)?;
                let begun = match start {
                    Start::Policy(bundle) => {
                        let params = initial("--init", bundle, &spec, &origin)?;
                        origin.insert(INIT.into(), bundle.weights_hash());
                        let learning = Progress { obs: seen(bundle), ..Progress::default() };
                        (params, AdamW::new(spec.learned()), State { learning, ..State::default() })
                    }
                    Start::Stage(carried) => {
                        let Carried { bundle, learning, scaling, adam } = *carried;
                        let params = initial("the stage before", &bundle, &spec, &origin)?;
                        origin.insert(INIT.into(), bundle.weights_hash());
                        (params, adam.unwrap_or_else(|| AdamW::new(spec.learned())), State { learning, scaling, ..State::default() })
                    }
                    _ => fresh(spec.init(recipe.seed)),
                };
                (collector, begun)
            }
        };
        let compute = Compute::new(recipe.device)?;
        let shards = Shards::new(recipe.run.shards, threads)?;
        Ok(Self {
            learner: Learner::new(spec, compute, shards, params, adam, state.learning)?,
            registry,
            dir: dir.into(),
            origin,
            env_spec,
            collector,
            test_env,
            scaling: state.scaling,
            epoch: state.epoch,
            env_steps: state.env_steps,
            stats: state.stats,
            best: state.best,
            last_test: state.last_test,
            last_epoch: state.last_epoch,
            course: state.course,
            plan,
        })
    }

    /// Content hashes of what the policy stands on and, where its training began with a policy's weights, of those.
    pub fn origin(&self) -> &BTreeMap<String, String> {
        &self.origin
    }

    /// Figures of the last whole epoch.
    pub fn last_epoch(&self) -> &BTreeMap<String, f64> {
        &self.last_epoch
    }

    /// Trains until all epochs are done, `until` ends it or `stop` is set; saves either way. A finished run leaves `policy/` and `summary.json`.
    pub fn run(&mut self, stop: &AtomicBool) -> Result<Outcome> {
        let epochs = self.plan.recipe.run.epochs;
        let per_epoch = self.plan.updates_per_epoch;
        let console = Console::new(epochs, epochs * per_epoch, self.learner.progress().updates);
        let mut metrics: [Box<dyn Logger>; 2] =
            [Box::new(Csv::open(&self.dir.join("metrics.csv"), self.epoch)?), Box::new(TensorBoard::new(&self.dir.join("tensorboard"))?)];
        let mut timing = Csv::open(&self.dir.join("timing.csv"), self.epoch)?;
        while self.epoch < epochs && !self.course.ended {
            let mut clock = Clock::default();
            let begun = self.stats.updates;
            while self.stats.updates < per_epoch {
                self.update(&mut clock).map_err(|e| self.stopped(e))?;
                console.tick();
                if stop.load(Ordering::SeqCst) && self.stats.updates < per_epoch {
                    self.save()?;
                    return Ok(Outcome::Interrupted);
                }
            }
            let steps = (per_epoch - begun) * self.plan.recipe.run.collect_steps as u64;
            let row = self.finish_epoch(&mut clock).map_err(|e| self.stopped(e))?;
            metrics.iter_mut().try_for_each(|m| m.log(self.epoch, &row))?;
            timing.log(self.epoch, &clock.row(steps))?;
            let rate = steps as f64 / clock.total();
            let left = (epochs - self.epoch) as f64 * per_epoch as f64 * self.plan.recipe.run.collect_steps as f64 / rate;
            console.epoch(self.epoch, &row, rate, left);
            // An interruption's own checkpoint cannot be the best: a run that is not interrupted would not have it.
            self.follow(&row)?;
            let done = self.epoch == epochs || self.course.ended;
            let due = self.epoch.is_multiple_of(self.plan.recipe.checkpoint.every) || done;
            if due {
                self.select(&row);
            }
            if due || stop.load(Ordering::SeqCst) {
                self.save()?;
            }
            if stop.load(Ordering::SeqCst) && !done {
                return Ok(Outcome::Interrupted);
            }
        }
        self.finish(stop)
    }

    /// Lets curricula and the rule of convergence go on by the figures of the epoch just done.
    fn follow(&mut self, row: &Row) -> Result<()> {
        let recipe = &self.plan.recipe;
        let tested = self.test_is_due();
        if self.course.note(recipe, self.epoch, tested, row) {
            let env = training_env(recipe, self.registry, &self.course.levels, &self.env_spec)?;
            // From the same seed, every level would begin with the same episodes.
            let seed = stream(recipe.seed, "curriculum", self.epoch).random();
            self.collector.change(env, seed)?;
            self.scaling = std::mem::take(&mut self.scaling).anew();
        }
        Ok(())
    }

    /// Whether the epoch just done is one that is tested.
    fn test_is_due(&self) -> bool {
        self.epoch.is_multiple_of(self.plan.recipe.test.every) || self.epoch == self.plan.recipe.run.epochs
    }

    /// What stopped the run, and what is left of it.
    fn stopped(&self, error: Error) -> Error {
        let root = self.dir.join("checkpoints");
        let left = match checkpoint::list(&root).pop() {
            Some(name) => format!("the last good checkpoint is {}", root.join(name).display()),
            None => "no checkpoint was written before".into(),
        };
        Error::run(format!("the run stops in epoch {}: {error}; {left}", self.epoch + 1))
    }

    /// One collection and one update.
    fn update(&mut self, clock: &mut Clock) -> Result<()> {
        let recipe = &self.plan.recipe;
        let start = Instant::now();
        let mut rollout = self.collector.collect(self.learner.policy(), self.plan.horizon)?;
        if recipe.ppo.reward_scaling {
            self.scaling.apply(&mut rollout, recipe.run.envs, recipe.ppo.gamma);
        }
        clock.collect += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let updates = recipe.run.epochs * self.plan.updates_per_epoch;
        let rules = Rules { envs: recipe.run.envs, ppo: &recipe.ppo, adam: &recipe.adam, seed: recipe.seed, updates };
        let update = self.learner.update(&rollout, &rules)?;
        clock.learn += start.elapsed().as_secs_f64();
        self.env_steps += rollout.reward.len() as u64;
        self.stats.add(&rollout, &update);
        Ok(())
    }

    /// Counts the epoch, tests where it is due, and gives its figures.
    fn finish_epoch(&mut self, clock: &mut Clock) -> Result<Row> {
        self.epoch += 1;
        let mut row: Row =
            vec![("updates".into(), Some(self.learner.progress().updates as f64)), ("env_steps".into(), Some(self.env_steps as f64))];
        row.extend(std::mem::take(&mut self.stats).row(&self.env_spec));
        let due = self.test_is_due();
        let start = Instant::now();
        row.extend(self.test(due)?);
        row.extend(columns(&self.plan.recipe, &self.course.levels));
        clock.test = start.elapsed().as_secs_f64();
        if due {
            let tested = row.iter().filter(|(n, _)| n.starts_with("test_"));
            self.last_test = tested.filter_map(|(n, v)| v.map(|v| (n.clone(), v))).collect();
        }
        self.last_epoch = row.iter().filter_map(|(n, v)| v.map(|v| (n.clone(), v))).collect();
        Ok(row)
    }

    /// Figures of test episodes with the policy's noise and without; `due`: play them, else their names alone.
    fn test(&mut self, due: bool) -> Result<Row> {
        let mut row = Row::new();
        for (prefix, noise) in [("test_sto", true), ("test_det", false)] {
            let mut episodes = Episodes::default();
            if due {
                episodes.add(&test_episodes(self.test_env.as_mut(), self.learner.policy(), self.plan.recipe.test.seed, noise)?);
            }
            row.extend(episodes.row(prefix, &self.env_spec));
        }
        Ok(row)
    }

    /// Notes the checkpoint about to be written when it is the best so far.
    fn select(&mut self, row: &Row) {
        let rule = &self.plan.recipe.checkpoint;
        let get = |name: &str| row.iter().find(|(n, _)| n == name).and_then(|(_, v)| *v);
        let allowed = rule.max_kl_prior.is_none_or(|max| get("loss/kl_prior").is_some_and(|kl| kl <= max));
        let Some(value) = get(&rule.best).filter(|_| allowed) else { return };
        if self.best.as_ref().is_none_or(|b| value >= b.value) {
            self.best = Some(Best { name: format!("epoch-{:04}", self.epoch), value });
        }
    }

    fn save(&self) -> Result<()> {
        let spec = self.learner.spec();
        let checkpoint = Checkpoint {
            description: Description {
                format: Description::FORMAT,
                recipe: self.plan.recipe.name.clone(),
                seed: self.plan.recipe.seed,
                epoch: self.epoch,
                env_steps: self.env_steps,
                layout: spec.layout.clone(),
                policy: spec.config.clone(),
                action: spec.action,
                origin: self.origin.clone(),
                test: self.last_test.clone(),
                files: BTreeMap::new(),
            },
            recipe: Some(self.plan.recipe.to_toml()?),
            params: self.learner.params().to_vec(),
            adam: self.learner.adam().clone(),
            state: State {
                epoch: self.epoch,
                env_steps: self.env_steps,
                adam_steps: self.learner.adam().steps,
                best: self.best.clone(),
                last_test: self.last_test.clone(),
                learning: self.learner.progress().clone(),
                stats: self.stats.clone(),
                collector: self.collector.save()?,
                last_epoch: self.last_epoch.clone(),
                scaling: self.scaling.clone(),
                course: self.course.clone(),
            },
        };
        let root = self.dir.join("checkpoints");
        checkpoint.write(&root, spec)?;
        checkpoint::prune(&root, &self.plan.recipe.checkpoint, self.best.as_ref())
    }

    /// Packs the selected policy, or without `[select]` the best (the last one where no test chose any), and sums the run up.
    fn finish(&self, stop: &AtomicBool) -> Result<Outcome> {
        let root = self.dir.join("checkpoints");
        let recipe = &self.plan.recipe;
        let last = checkpoint::list(&root).pop().ok_or_else(|| Error::run("the run wrote no checkpoint"))?;
        let chosen = match &recipe.select {
            Some(rule) => {
                let Some(selection) = select(&self.dir, recipe, rule, self.registry, stop)? else { return Ok(Outcome::Interrupted) };
                selection.write(&self.dir)?;
                selection.chosen
            }
            None => self.best.as_ref().map_or(last, |b| b.name.clone()),
        };
        export(&root.join(&chosen), &self.dir.join("policy"))?;
        let mut summary = serde_json::json!({
            "recipe": self.plan.recipe.name,
            "seed": self.plan.recipe.seed,
            "version": env!("CARGO_PKG_VERSION"),
            "epochs": self.epoch,
            "env_steps": self.env_steps,
            "parameters": self.learner.params().len(),
            "policy": chosen,
            "best": self.best,
            "origin": self.origin,
            "last_epoch": self.last_epoch,
        });
        if recipe.until.is_some() {
            summary["converged"] = self.course.ended.into();
        }
        let text = serde_json::to_string_pretty(&summary).map_err(|e| Error::run(format!("cannot write the summary: {e}")))?;
        write_atomic(self.dir.join("summary.json"), text.as_bytes())?;
        Ok(Outcome::Finished)
    }
}

/// Packs the policy of the checkpoint folder `from` into the bundle folder `to`.
pub fn export(from: &Path, to: &Path) -> Result<()> {
    let (d, spec, params) = Checkpoint::read_policy(from)?;
    let trained = Trained { recipe: d.recipe, seed: d.seed, epoch: d.epoch, env_steps: d.env_steps, test: d.test };
    Ok(Bundle::new(spec, &params, d.origin, trained)?.write(to)?)
}
