//! Where the time of an environment step goes, collection and update, for the recipes `paper` and `quick`.
//!
//!     cargo bench --bench budget                       # all threads
//!     RAYON_NUM_THREADS=1 cargo bench --bench budget
//!
//! Parts and wholes take turns and the best of several rounds counts, so that shares hold on a busy machine. What lies between a whole
//! and its parts is shown as a difference.

use egogen::agent::{ObsLayout, PolicySpec};
use egogen::kernels::PolicyEngine;
use egogen::motion::FUTURE;
use egogen::sensing::{RAYS, look_all};
use egogen::sim::{Primitives, Sim, World};
use egogen_envs::motion::{MotionEnv, MotionTask};
use egogen_envs::{StepResult, VecEnv};
use egogen_train::recipe::{Plan, Recipe};
use egogen_train::registry::{Purpose, Registry};
use egogen_train::{
    AdamW, Batch, Collector, Compute, Learner, Policy, Progress, Rollout, Rules, Shards, clip_scale, global_norm, gradients,
};
use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

const ROUNDS: usize = 9;

type Outcome<T = ()> = Result<T, Box<dyn Error>>;
/// Something to time: name, and one run.
type Case<'a> = (&'static str, Box<dyn FnMut() -> Outcome + 'a>);

/// Success, after the compiler was kept from leaving out what made `value`.
fn done<T>(value: T) -> Outcome {
    black_box(value);
    Ok(())
}

/// Seconds of the best of some rounds in which all cases take turns.
fn best(cases: &mut [Case]) -> Outcome<Vec<f64>> {
    let mut best = vec![f64::INFINITY; cases.len()];
    for _ in 0..ROUNDS {
        for ((_, run), best) in cases.iter_mut().zip(&mut best) {
            let start = Instant::now();
            run()?;
            *best = best.min(start.elapsed().as_secs_f64());
        }
    }
    Ok(best)
}

/// The first `rows` steps of a rollout.
fn minibatch(rollout: &Rollout, rows: usize) -> Batch {
    let first = |from: &[f32]| from[..from.len() / rollout.reward.len() * rows].to_vec();
    Batch {
        obs: first(&rollout.obs),
        actions: first(&rollout.actions),
        old_log_prob: first(&rollout.log_prob),
        old_value: first(&rollout.value),
        advantage: first(&rollout.reward),
        returns: first(&rollout.reward),
    }
}

fn budget(name: &str) -> Outcome {
    let Plan { recipe, horizon, .. } = Recipe::load(name, &[])?.plan()?;
    let (envs, ppo, adam) = (recipe.run.envs, recipe.ppo, recipe.adam);
    let world = World::embedded()?;
    let task: MotionTask = recipe.env_options.get("task").map_or_else(|| Ok(MotionTask::default()), |t| t.clone().try_into())?;
    let every = task.body_every;
    let mut env = MotionEnv::new(task, world.sim.clone(), world.train.clone(), envs, 0)?;
    let made = Registry::standard().make(&recipe.env, &recipe.env_options, envs, Purpose::Train)?;
    let spec = PolicySpec::new(recipe.policy.clone(), ObsLayout::new(made.env.spec().obs.clone()), made.env.spec().action)?;
    let (mut params, mut obs, mut result) = (spec.init(0), vec![], StepResult::default());
    let threads = rayon::current_num_threads();
    let shards = || Shards::new(recipe.run.shards, threads);
    let policy = Policy::new(&spec, &params, &Compute::Own)?;
    let mut collector = Collector::new(made.env, 0)?;
    let rollout = collector.collect(&policy, horizon)?;
    let batch = minibatch(&rollout, ppo.batch);
    let mut learner = Learner::new(spec.clone(), Compute::Own, shards()?, params.clone(), AdamW::new(spec.learned()), Progress::default())?;
    let rules = Rules { envs, ppo: &ppo, adam: &adam, seed: 0, updates: 1000 };
    env.reset(0, &mut obs)?;
    let acts = policy.act(&obs)?;
    let actions = acts.sample(0, "bench", 0);
    let latents = world.sim.widen(&actions, actions.len() / envs)?;
    let (model, mut moved, mut prims) = (world.sim.model().clone(), env.people().clone(), Primitives::default());
    let people = moved.clone();
    let fitted = Sim::fitted(every).len();
    let markers = vec![0.1; envs * fitted * egogen::body::MARKER_DIM];
    let betas = people.betas.repeat(fitted);
    let (mut decoded, mut bodies) = (vec![0.0; envs * FUTURE * egogen::body::MARKER_DIM], vec![0.0; envs * fitted * egogen::body::PARAMS]);
    let settings: Vec<_> = (0..envs).map(|i| env.setting(i).scene.walkable.clone()).collect();
    let mut rays = vec![0.0; envs * 2 * RAYS];
    let own_shards = shards()?;
    let flat = params.clone();
    let (mut grads, mut again) = (vec![], vec![]);
    gradients(&spec, &flat, (&Compute::Own, &own_shards), &batch, &ppo, &mut grads)?;
    let mut optimiser = AdamW::new(spec.learned());
    let learned = spec.learned();
    let mut cases: Vec<Case> = vec![
        ("policy: actions and values", Box::new(|| done(policy.act(&obs)?))),
        ("draws and their densities", Box::new(|| done(acts.log_prob(&acts.sample(0, "bench", 0))))),
        ("decoder", Box::new(|| Ok(model.decode(&people.markers, &latents, &mut decoded)?))),
        ("regressor", Box::new(|| Ok(model.regress(&markers, &betas, &mut bodies)?))),
        (
            "simulation",
            Box::new(|| {
                moved.clone_from(&people);
                Ok(world.sim.step_by(every, &mut moved, &latents, &mut prims)?)
            }),
        ),
        (
            "rays",
            Box::new(|| {
                look_all(&people, |i| &settings[i], &mut rays);
                Ok(())
            }),
        ),
        ("environment", Box::new(|| Ok(env.step(&actions, &mut result)?))),
        ("collection", Box::new(|| done(collector.collect(&policy, horizon)?))),
        ("forward and backward", Box::new(|| done(gradients(&spec, &flat, (&Compute::Own, &own_shards), &batch, &ppo, &mut again)?))),
        (
            "norm and AdamW",
            Box::new(|| {
                let scale = clip_scale(global_norm(&grads), ppo.max_grad_norm);
                optimiser.step(&adam, &mut params[..learned], &grads[..learned], scale);
                Ok(())
            }),
        ),
        ("packing the policy", Box::new(|| done(PolicyEngine::new(&spec, &flat)?))),
        ("update", Box::new(|| done(learner.update(&rollout, &rules)?))),
    ];
    let seconds = best(&mut cases)?;
    let [act, draw, decode, regress, sim, look, step, collect, backward, adamw, pack, update] = seconds[..] else { unreachable!() };
    let (t, batches) = (horizon as f64, (ppo.passes * horizon * envs / ppo.batch) as f64);
    let rows = [
        ("policy: actions and values", t * act),
        ("draws and their densities", t * draw),
        ("decoder", t * decode),
        ("regressor", t * regress),
        ("bodies, markers, next seeds", t * (sim - decode - regress)),
        ("rays", t * look),
        ("rewards, ends, new episodes", t * (step - sim - look)),
        ("records, last values", collect - t * (act + draw + step)),
        ("collection", collect),
        ("forward and backward", batches * backward),
        ("norm and AdamW", batches * adamw),
        ("packing the policy", pack),
        ("minibatches, advantages", update - batches * (backward + adamw) - pack),
        ("update", update),
    ];
    let (all, total) = (collect + update, t * envs as f64);
    println!(
        "\n{name}: {} parameters, {envs} environments x {horizon} steps, {threads} threads: {:.0} steps/s",
        spec.params(),
        total / all
    );
    println!("{:<30}{:>12}{:>9}", "", "us a step", "share");
    for (name, seconds) in rows {
        println!("{name:<30}{:>12.1}{:>8.1}%", 1e6 * seconds / total, 100.0 * seconds / all);
    }
    Ok(())
}

fn main() -> Outcome {
    egogen::kernels::keep_memory();
    ["paper", "quick"].into_iter().try_for_each(budget)
}
