//! Steps per second of acting and learning on an environment that costs nothing, with the motion task's shapes.
//!
//! `cargo run --release -p egogen-train --example learning_speed [quick|paper] [own|burn]`

use egogen::DeviceChoice;
use egogen::agent::{ObsGroup, ObsLayout, PolicyConfig, PolicySpec};
use egogen::rng::stream;
use egogen_train::{AdamConfig, AdamW, Compute, Learner, PpoConfig, Progress, Rollout, Rules, Shards};
use rand_distr::{Distribution, StandardNormal};
use std::time::Instant;

const ENVS: usize = 256;
const STEPS: usize = 4;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let paper = std::env::args().nth(1).as_deref() == Some("paper");
    let sizes = if paper { "gru = { state = 512, egosensing = 512 }" } else { "gru = { state = 256, egosensing = 128 }\ntrunk = 512" };
    let config: PolicyConfig = toml::from_str(sizes)?;
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.to_vec() };
    let groups = vec![group("state", &[2, 402]), group("egosensing", &[2, 32]), group("dist", &[1]), group("time", &[1])];
    let spec = PolicySpec::new(config, ObsLayout::new(groups), 128)?;
    let threads = rayon::current_num_threads();
    let params = spec.init(0);
    println!("{} parameters, {threads} threads", params.len());
    let compute = match std::env::args().nth(2).as_deref() {
        Some("burn") => Compute::Burn(DeviceChoice::Flex.device()?),
        _ => Compute::Own,
    };
    let adam = AdamW::new(params.len());
    let mut learner = Learner::new(spec.clone(), compute, Shards::new(2, threads)?, params, adam, Progress::default())?;
    let ppo: PpoConfig = toml::from_str(
        "gamma = 0.99\nlambda = 0.95\nclip = 0.1\nvalue = 1.0\nentropy = 0.0\nkl_prior = 1.0\nmax_grad_norm = 0.1\npasses = 1\nbatch = 256",
    )?;
    let config: AdamConfig = toml::from_str("lr = 3e-4")?;
    for round in 0..4 {
        let obs: Vec<f32> = StandardNormal.sample_iter(stream(0, "speed", round)).take(ENVS * STEPS * spec.layout.dim()).collect();
        let start = Instant::now();
        let mut rollout = Rollout::default();
        for rows in obs.chunks(ENVS * spec.layout.dim()) {
            let acts = learner.policy().act(rows)?;
            rollout.actions.extend(acts.sample(0, "speed actions", round));
            rollout.value.extend(acts.value);
        }
        learner.policy().values(&obs[..ENVS * spec.layout.dim()])?;
        let acted = start.elapsed().as_secs_f64();
        let total = ENVS * STEPS;
        rollout.log_prob = vec![-180.0; total];
        rollout.next_value = rollout.value.clone();
        rollout.reward = (0..total).map(|i| (i % 7) as f32).collect();
        rollout.terminated = vec![false; total];
        rollout.truncated = vec![false; total];
        rollout.obs = obs;
        learner.update(&rollout, &Rules { envs: ENVS, ppo: &ppo, adam: &config, seed: 0, updates: 4 })?;
        let all = start.elapsed().as_secs_f64();
        let ms = |s: f64| 1e3 * s / total as f64;
        println!("{:.3} ms/step acting, {:.3} ms/step learning: {:.0} steps/s", ms(acted), ms(all - acted), total as f64 / all);
    }
    Ok(())
}
