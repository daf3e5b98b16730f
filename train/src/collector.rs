//! Steps environments with the current policy and records what learning needs.

use crate::acts::Acts;
use crate::policy::Policy;
use crate::{Error, Result};
use egogen::kernels::first_not_finite;
use egogen_envs::{EnvSpec, StepResult, VecEnv};
use serde::{Deserialize, Serialize};

/// One finished episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Episode {
    /// Sum of rewards.
    pub total: f32,
    /// Steps.
    pub length: u32,
    /// The environment's own figures, in the order of `EnvSpec::episode`.
    pub figures: Vec<f32>,
}

/// What was recorded, time outermost: entry t x envs + i.
#[derive(Clone, Debug, Default)]
pub struct Rollout {
    pub obs: Vec<f32>,
    pub actions: Vec<f32>,
    /// Log density of the actions at collection.
    pub log_prob: Vec<f32>,
    pub value: Vec<f32>,
    /// Value after the step (of the final observation where truncated); 0 where terminated.
    pub next_value: Vec<f32>,
    /// Entries where the next entry of the same environment is not what the step led to: truncations and the last steps.
    pub ends: Vec<usize>,
    /// What those steps led to.
    pub end_obs: Vec<f32>,
    pub reward: Vec<f32>,
    pub terminated: Vec<bool>,
    pub truncated: Vec<bool>,
    /// Sums over all steps of the environment's per-step figures.
    pub info: Vec<f64>,
    /// Episodes that ended.
    pub episodes: Vec<Episode>,
}

impl Rollout {
    /// Value after each step, given `policy`'s value before each.
    pub(crate) fn next_values(&self, envs: usize, value: &[f32], policy: &Policy) -> Result<Vec<f32>> {
        let mut next = value[envs.min(value.len())..].to_vec();
        next.resize(value.len(), 0.0);
        let ends = policy.values(&self.end_obs)?;
        self.ends.iter().zip(ends).for_each(|(&k, v)| next[k] = v);
        next.iter_mut().zip(&self.terminated).filter(|(_, end)| **end).for_each(|(v, _)| *v = 0.0);
        Ok(next)
    }
}

/// The environments with their current observations and running episodes.
pub struct Collector {
    env: Box<dyn VecEnv>,
    seed: u64,
    obs: Vec<f32>,
    result: StepResult,
    progress: Progress,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Progress {
    /// Vector steps so far; names the noise of the next.
    steps: u64,
    /// Return and length of each running episode.
    running: Vec<(f32, u32)>,
}

impl Collector {
    /// Resets the environments from `seed`, which also seeds the action noise.
    pub fn new(mut env: Box<dyn VecEnv>, seed: u64) -> Result<Self> {
        let mut obs = Vec::new();
        env.reset(seed, &mut obs)?;
        check_obs(env.spec(), &obs)?;
        let progress = Progress { steps: 0, running: vec![(0.0, 0); env.num_envs()] };
        Ok(Self { env, seed, obs, result: StepResult::default(), progress })
    }

    /// Goes on in as many other environments of the same kind, reset from `seed`; the running episodes are left.
    pub fn change(&mut self, mut env: Box<dyn VecEnv>, seed: u64) -> Result<()> {
        env.reset(seed, &mut self.obs)?;
        check_obs(env.spec(), &self.obs)?;
        self.progress.running = vec![(0.0, 0); env.num_envs()];
        self.env = env;
        Ok(())
    }

    /// The environments.
    pub fn env(&self) -> &dyn VecEnv {
        self.env.as_ref()
    }

    /// Steps all environments `steps` times.
    pub fn collect(&mut self, policy: &Policy, steps: usize) -> Result<Rollout> {
        let envs = self.env.num_envs();
        let mut out = Rollout { info: vec![0.0; self.env.spec().info.len()], ..Rollout::default() };
        for t in 0..steps {
            let acts = policy.act(&self.obs)?;
            let first = out.reward.len();
            self.record(&acts, &mut out);
            let actions = out.actions.len() - envs * self.env.spec().action.width()..;
            self.env.step(&out.actions[actions], &mut self.result)?;
            self.take_result(&mut out)?;
            let width = self.obs.len() / envs;
            for i in 0..envs {
                let cut = self.result.truncated[i] && !self.result.terminated[i];
                let last = t + 1 == steps && !self.result.terminated[i];
                if cut || last {
                    out.ends.push(first + i);
                    out.end_obs.extend_from_slice(&self.result.final_obs[i * width..(i + 1) * width]);
                }
            }
            std::mem::swap(&mut self.obs, &mut self.result.obs);
        }
        out.next_value = out.next_values(envs, &out.value, policy)?;
        Ok(out)
    }

    /// Draws and records the actions for the current observations.
    fn record(&mut self, acts: &Acts, out: &mut Rollout) {
        let actions = acts.sample(self.seed, "actions", self.progress.steps);
        out.log_prob.extend(acts.log_prob(&actions));
        out.obs.extend_from_slice(&self.obs);
        out.actions.extend_from_slice(&actions);
        out.value.extend_from_slice(&acts.value);
    }

    fn take_result(&mut self, out: &mut Rollout) -> Result<()> {
        let result = &self.result;
        let at = self.progress.steps + 1;
        check_result(self.env.spec(), result).map_err(|e| Error::run(format!("in step {at} of collection: {e}")))?;
        out.reward.extend_from_slice(&result.reward);
        out.terminated.extend_from_slice(&result.terminated);
        out.truncated.extend_from_slice(&result.truncated);
        for row in result.info.chunks_exact(out.info.len().max(1)) {
            out.info.iter_mut().zip(row).for_each(|(sum, &x)| *sum += f64::from(x));
        }
        let figures = self.env.spec().episode.len();
        for (i, running) in self.progress.running.iter_mut().enumerate() {
            running.0 += result.reward[i];
            running.1 += 1;
            if result.terminated[i] || result.truncated[i] {
                let (total, length) = std::mem::take(running);
                out.episodes.push(Episode { total, length, figures: result.episode[i * figures..(i + 1) * figures].to_vec() });
            }
        }
        self.progress.steps += 1;
        Ok(())
    }

    /// The whole state: environments, running episodes, position in the noise.
    pub fn save(&self) -> Result<Vec<u8>> {
        let state = (self.env.save_state()?, &self.progress);
        postcard::to_stdvec(&state).map_err(|e| Error::run(format!("cannot save the environments: {e}")))
    }

    /// Restores what `save` wrote for environments of the same kind and number.
    pub fn load(&mut self, bytes: &[u8]) -> Result<()> {
        let (env, progress): (Vec<u8>, Progress) =
            postcard::from_bytes(bytes).map_err(|e| Error::run(format!("not a saved state of environments: {e}")))?;
        if progress.running.len() != self.env.num_envs() {
            return Err(Error::run(format!("saved {} environments, this run has {}", progress.running.len(), self.env.num_envs())));
        }
        self.env.load_state(&env)?;
        self.env.observe(&mut self.obs)?;
        self.progress = progress;
        Ok(())
    }
}

/// Refuses a step's results that are not finite, naming the figure and the environment. Terms come before the reward that they
/// add up to.
fn check_result(spec: &EnvSpec, result: &StepResult) -> Result<()> {
    let named = |kind: &str, names: &[String], values: &[f32]| check_finite(names.len(), values, |k| format!("{kind} '{}'", names[k]));
    named("the figure", &spec.info, &result.info)?;
    check_finite(1, &result.reward, |_| "reward".into())?;
    check_obs(spec, &result.final_obs)?;
    check_obs(spec, &result.obs)?;
    named("the episode's figure", &spec.episode, &result.episode)
}

/// [`check_result`] of observations alone.
fn check_obs(spec: &EnvSpec, obs: &[f32]) -> Result<()> {
    check_finite(spec.obs_dim(), obs, |k| {
        let mut at = k;
        let group = spec.obs.iter().find(|g| {
            let inside = at < g.len();
            at -= if inside { 0 } else { g.len() };
            inside
        });
        group.map_or_else(|| format!("observation {k}"), |g| format!("observation '{}' (entry {at})", g.name))
    })
}

/// `width` numbers of each environment; `name` says what the k-th is.
fn check_finite(width: usize, values: &[f32], name: impl Fn(usize) -> String) -> Result<()> {
    match first_not_finite(values) {
        Some(i) => {
            let (env, k) = (i / width.max(1), i % width.max(1));
            Err(Error::run(format!("environment {env} returned {} for {}", values[i], name(k))))
        }
        None => Ok(()),
    }
}

/// Who plays the first episode of every environment.
pub(crate) trait Player {
    /// The episodes are about to begin.
    fn begin(&mut self, _env: &dyn VecEnv) {}
    /// Actions for everyone.
    fn act(&mut self, obs: &[f32], step: u64) -> Result<Vec<f32>>;
    /// The environments `playing`, whose episodes had not ended before it, have made a step.
    fn look(&mut self, _env: &dyn VecEnv, _playing: &[usize]) {}
}

/// A policy in its tests.
struct Tested<'a> {
    policy: &'a Policy,
    seed: u64,
    noise: bool,
}

impl Player for Tested<'_> {
    fn act(&mut self, obs: &[f32], step: u64) -> Result<Vec<f32>> {
        let acts = self.policy.act(obs)?;
        Ok(if self.noise { acts.sample(self.seed, "test actions", step) } else { acts.best() })
    }
}

/// The first episode of every environment after a reset from `seed`; with the policy's noise or without.
pub fn test_episodes(env: &mut dyn VecEnv, policy: &Policy, seed: u64, noise: bool) -> Result<Vec<Episode>> {
    Ok(first_episodes(env, seed, &mut Tested { policy, seed, noise })?.into_iter().flatten().collect())
}

/// The first episode of every environment after a reset from `seed`; none where it takes too long.
pub(crate) fn first_episodes(env: &mut dyn VecEnv, seed: u64, player: &mut dyn Player) -> Result<Vec<Option<Episode>>> {
    let (envs, figures) = (env.num_envs(), env.spec().episode.len());
    let (mut obs, mut result) = (Vec::new(), StepResult::default());
    let mut running = vec![(0.0, 0); envs];
    let mut done: Vec<Option<Episode>> = vec![None; envs];
    env.reset(seed, &mut obs)?;
    check_obs(env.spec(), &obs)?;
    player.begin(env);
    for step in 0.. {
        let actions = player.act(&obs, step)?;
        env.step(&actions, &mut result)?;
        check_result(env.spec(), &result).map_err(|e| Error::run(format!("in step {} of the test: {e}", step + 1)))?;
        let playing: Vec<usize> = (0..envs).filter(|&i| done[i].is_none()).collect();
        player.look(env, &playing);
        for i in playing {
            running[i].0 += result.reward[i];
            running[i].1 += 1;
            if result.terminated[i] || result.truncated[i] {
                let (total, length) = running[i];
                done[i] = Some(Episode { total, length, figures: result.episode[i * figures..(i + 1) * figures].to_vec() });
            }
        }
        if done.iter().all(Option::is_some) || step >= MAX_TEST_STEPS {
            break;
        }
        std::mem::swap(&mut obs, &mut result.obs);
    }
    Ok(done)
}

/// Episodes longer than this do not count in tests.
const MAX_TEST_STEPS: u64 = 10_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::Compute;
    use egogen::agent::{ObsGroup, ObsLayout, PolicySpec, log_prob_of};
    use egogen_envs::point::PointGoal;

    const ENVS: usize = 8;
    const STEPS: usize = 45;

    /// A stepped copy of the environments says what every value after a step must be a value of.
    #[test]
    fn values_after_steps_belong_to_the_right_observations() {
        let group = |name: &str| ObsGroup { name: name.into(), shape: vec![2] };
        let layout = ObsLayout::new(vec![group("position"), group("offset")]);
        let spec = PolicySpec::new(serde_json::from_str("{}").unwrap(), layout, 2).unwrap();
        let policy = Policy::new(&spec, &spec.init(5), &Compute::Own).unwrap();
        let mut collector = Collector::new(Box::new(PointGoal::new(ENVS, 0)), 7).unwrap();
        let rollout = collector.collect(&policy, STEPS).unwrap();
        let mut copy = PointGoal::new(ENVS, 0);
        let (mut obs, mut result) = (vec![], StepResult::default());
        copy.reset(7, &mut obs).unwrap();
        let (mut ended, mut cut) = (0, 0);
        for t in 0..STEPS {
            let rows = t * ENVS..(t + 1) * ENVS;
            assert_eq!(rollout.obs[rows.start * 4..rows.end * 4], obs);
            let acts = policy.act(&obs).unwrap();
            assert_eq!(rollout.value[rows.clone()], acts.value);
            copy.step(&rollout.actions[rows.start * 2..rows.end * 2], &mut result).unwrap();
            let after = policy.values(&result.final_obs).unwrap();
            for (i, k) in rows.enumerate() {
                let want = if result.terminated[i] { 0.0 } else { after[i] };
                assert_eq!(rollout.next_value[k], want, "step {t} of {i}");
                let (mu, logvar) = (&acts.mu[2 * i..2 * i + 2], &acts.logvar[2 * i..2 * i + 2]);
                assert_eq!(rollout.log_prob[k], log_prob_of(mu, logvar, &rollout.actions[2 * k..2 * k + 2]));
                ended += usize::from(result.terminated[i]);
                cut += usize::from(result.truncated[i]);
            }
            std::mem::swap(&mut obs, &mut result.obs);
        }
        assert!(ended > 0 && cut > 0, "{ended} terminations, {cut} truncations");
        assert_eq!(rollout.episodes.len(), ended + cut);
        // The environment counts returns and steps itself.
        for e in &rollout.episodes {
            assert!((e.total - e.figures[1]).abs() < 1e-5 && e.length as f32 == e.figures[2]);
        }
    }

    #[test]
    fn collecting_goes_on_from_a_saved_state() {
        let spec_of = |env: &dyn VecEnv| {
            let groups = env.spec().obs.iter().map(|g| ObsGroup { name: g.name.clone(), shape: g.shape.clone() }).collect();
            PolicySpec::new(serde_json::from_str("{}").unwrap(), ObsLayout::new(groups), 2).unwrap()
        };
        let make = || Collector::new(Box::new(PointGoal::new(ENVS, 0)), 7).unwrap();
        let mut a = make();
        let spec = spec_of(a.env());
        let policy = Policy::new(&spec, &spec.init(5), &Compute::Own).unwrap();
        a.collect(&policy, 13).unwrap();
        let mut b = make();
        b.load(&a.save().unwrap()).unwrap();
        let (x, y) = (a.collect(&policy, 9).unwrap(), b.collect(&policy, 9).unwrap());
        assert_eq!((x.actions, x.reward, x.episodes), (y.actions, y.reward, y.episodes));
        assert!(b.load(&[1, 2, 3]).is_err());
    }
}
