//! Checks that every environment must pass; a test of each environment calls [`check`].

use crate::{ActionSpace, EnvSpec, StepResult, VecEnv};
use egogen::rng::{Stream, stream};
use rand::RngExt;
use rand_distr::StandardNormal;

/// Enough that work is spread over threads.
const ENVS: usize = 9;
const SEED: u64 = 5;

/// How hard an environment is tried.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Steps of each run; at least one episode must end within them.
    pub steps: usize,
    /// Standard deviation of the random continuous actions.
    pub action_scale: f32,
}

impl Default for Effort {
    fn default() -> Self {
        Self { steps: 60, action_scale: 1.0 }
    }
}

/// Runs every check on environments made by `make(n, seed)`.
///
/// # Panics
/// When a check fails; the message says which promise of [`VecEnv`] is broken.
pub fn check(make: impl Fn(usize, u64) -> Box<dyn VecEnv>, effort: Effort) {
    let actions = random_actions(make(ENVS, SEED).spec(), effort);
    let reference = run(make(ENVS, SEED), SEED, &actions);
    shapes_and_resets(make(ENVS, SEED), &actions);
    let again = run(make(ENVS, SEED), SEED, &actions);
    assert!(again == reference, "two runs of one seed differ");
    let mut used = make(ENVS, SEED);
    let mut out = StepResult::default();
    used.reset(SEED + 1, &mut Vec::new()).expect("reset");
    used.step(&actions[0], &mut out).expect("step");
    assert!(run(used, SEED, &actions) == reference, "reset does not forget what happened before");
    assert!(run(make(ENVS, SEED + 1), SEED + 1, &actions) != reference, "the seed has no influence");
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("thread pool");
        let env = make(ENVS, SEED);
        let trace = pool.install(|| run(env, SEED, &actions));
        assert!(trace == reference, "results with {threads} thread(s) differ");
    }
    independence(make(ENVS, SEED), &actions, &reference);
    saving(&make, &actions, &reference);
    refusals(make(ENVS, SEED), &actions[0]);
}

type Trace = (Vec<f32>, Vec<StepResult>);

fn random_actions(spec: &EnvSpec, effort: Effort) -> Vec<Vec<f32>> {
    let mut rng = stream(SEED, "conformance", 0);
    let draw = |rng: &mut Stream| match spec.action {
        ActionSpace::Continuous(_) => effort.action_scale * rng.sample::<f32, _>(StandardNormal),
        ActionSpace::Discrete(k) => rng.random_range(0..k) as f32,
    };
    let len = ENVS * spec.action.width();
    (0..effort.steps).map(|_| (0..len).map(|_| draw(&mut rng)).collect()).collect()
}

fn run(mut env: Box<dyn VecEnv>, seed: u64, actions: &[Vec<f32>]) -> Trace {
    let mut first = Vec::new();
    env.reset(seed, &mut first).expect("reset");
    (first, continue_run(env.as_mut(), actions))
}

fn continue_run(env: &mut dyn VecEnv, actions: &[Vec<f32>]) -> Vec<StepResult> {
    let step = |a: &Vec<f32>| {
        let mut out = StepResult::default();
        env.step(a, &mut out).expect("step");
        out
    };
    actions.iter().map(step).collect()
}

fn shapes_and_resets(mut env: Box<dyn VecEnv>, actions: &[Vec<f32>]) {
    let spec = env.spec().clone();
    let (n, dim) = (env.num_envs(), spec.obs_dim());
    assert_eq!(n, ENVS, "num_envs");
    let (mut obs, mut seen, mut out, mut ends) = (vec![7.0], vec![7.0], StepResult::default(), 0);
    env.reset(SEED, &mut obs).expect("reset");
    assert_eq!(obs.len(), n * dim, "first observations");
    for actions in actions {
        // One result is reused throughout, so that leftovers of the step before would show.
        env.step(actions, &mut out).expect("step");
        assert_eq!(out.obs.len(), n * dim, "obs");
        assert_eq!(out.final_obs.len(), n * dim, "final_obs");
        assert_eq!([out.reward.len(), out.terminated.len(), out.truncated.len()], [n; 3], "per-environment results");
        assert_eq!(out.info.len(), n * spec.info.len(), "info");
        assert_eq!(out.episode.len(), n * spec.episode.len(), "episode");
        let floats = [&out.obs, &out.final_obs, &out.reward, &out.info, &out.episode];
        assert!(floats.iter().all(|v| v.iter().all(|x| x.is_finite())), "a result is not finite");
        env.observe(&mut seen).expect("observe");
        assert_eq!(seen, out.obs, "observe differs from the step's obs");
        for i in 0..n {
            let row = i * dim..(i + 1) * dim;
            if out.terminated[i] || out.truncated[i] {
                ends += 1;
                assert_ne!(out.obs[row.clone()], out.final_obs[row], "environment {i} ended but was not reset at once");
            } else {
                assert_eq!(out.obs[row.clone()], out.final_obs[row], "obs and final_obs differ though nothing ended");
                let k = spec.episode.len();
                assert!(out.episode[i * k..(i + 1) * k].iter().all(|&x| x == 0.0), "episode figures without an end");
            }
        }
    }
    assert!(ends > 0, "no episode ended in {} steps: give the check more effort", actions.len());
}

/// Environment 0 must not notice what the others do.
fn independence(env: Box<dyn VecEnv>, actions: &[Vec<f32>], reference: &Trace) {
    let spec = env.spec().clone();
    let (width, dim) = (spec.action.width(), spec.obs_dim());
    let mut other: Vec<Vec<f32>> = actions.to_vec();
    for a in &mut other {
        let (_, rest) = a.split_at_mut(width);
        rest.iter_mut().for_each(|x| match spec.action {
            ActionSpace::Continuous(_) => *x = -*x,
            ActionSpace::Discrete(k) => *x = (*x + 1.0) % k as f32,
        });
    }
    let trace = run(env, SEED, &other);
    assert!(&trace != reference, "actions have no influence");
    for (a, b) in trace.1.iter().zip(&reference.1) {
        let same = a.obs[..dim] == b.obs[..dim] && a.reward[0] == b.reward[0] && a.terminated[0] == b.terminated[0];
        assert!(same, "environment 0 depends on the actions of the others");
    }
}

fn saving(make: impl Fn(usize, u64) -> Box<dyn VecEnv>, actions: &[Vec<f32>], reference: &Trace) {
    let half = actions.len() / 2;
    let mut env = make(ENVS, SEED);
    env.reset(SEED, &mut Vec::new()).expect("reset");
    continue_run(env.as_mut(), &actions[..half]);
    let state = env.save_state().expect("save");
    let mut restored = make(ENVS, SEED + 9);
    restored.load_state(&state).expect("load");
    assert!(restored.save_state().expect("save") == state, "loading and saving again changes the state");
    let mut obs = Vec::new();
    restored.observe(&mut obs).expect("observe");
    assert_eq!(obs, reference.1[half - 1].obs, "observe after load");
    let rest = continue_run(restored.as_mut(), &actions[half..]);
    assert!(rest == reference.1[half..], "a restored environment goes on differently");
    assert!(restored.load_state(&state[..state.len() / 2]).is_err(), "a torn state is accepted");
    assert!(make(ENVS + 1, SEED).load_state(&state).is_err(), "a state of another size is accepted");
}

fn refusals(mut env: Box<dyn VecEnv>, actions: &[f32]) {
    env.reset(SEED, &mut Vec::new()).expect("reset");
    let before = env.save_state().expect("save");
    let mut out = StepResult::default();
    let no_choice = match env.spec().action {
        ActionSpace::Continuous(_) => vec![],
        ActionSpace::Discrete(k) => vec![-1.0, 0.5, k as f32],
    };
    for bad in [f32::NAN, f32::INFINITY].into_iter().chain(no_choice) {
        let mut a = actions.to_vec();
        a[1] = bad;
        assert!(env.step(&a, &mut out).is_err(), "an action of {bad} is accepted");
    }
    assert!(env.step(&actions[1..], &mut out).is_err(), "too few actions are accepted");
    assert!(env.step(&[actions, &[0.0]].concat(), &mut out).is_err(), "too many actions are accepted");
    assert!(env.save_state().expect("save") == before, "a refused step changes the state");
}
