//! Steps of the reference tasks per second, resets included, on one thread.
//!
//! Cases take turns and the best of several rounds counts, so that the ratios hold on a busy machine.

use egogen_envs::control::{Acrobot, CartPole, Control, Dynamics, MountainCar, MountainCarContinuous, Pendulum};
use egogen_envs::{ActionSpace, StepResult, VecEnv};
use rand::RngExt;
use std::time::Instant;

const ROUNDS: usize = 15;
/// Steps of one round, over all environments.
const STEPS: usize = 1 << 17;
/// Batches of actions that take turns.
const BATCHES: usize = 64;

/// Something to time: name and one round.
type Case = (String, Box<dyn FnMut()>);

fn case<D: Dynamics + 'static>(n: usize) -> Case {
    let mut rng = egogen::rng::stream(1, "bench", n as u64);
    let mut draw = || match D::ACTION {
        ActionSpace::Discrete(k) => rng.random_range(0..k) as f32,
        ActionSpace::Continuous(_) => rng.random_range(-1.0..1.0),
    };
    let actions: Vec<Vec<f32>> = (0..BATCHES).map(|_| (0..n).map(|_| draw()).collect()).collect();
    let (mut env, mut out) = (Control::<D>::new(n, 0), StepResult::default());
    let run = move || {
        for actions in actions.iter().cycle().take(STEPS / n) {
            env.step(actions, &mut out).expect("valid actions");
        }
    };
    (format!("{}, n = {n}", D::NAME), Box::new(run))
}

fn main() {
    let mut cases = [
        case::<CartPole>(256),
        case::<CartPole>(8),
        case::<CartPole>(1),
        case::<Acrobot>(256),
        case::<Pendulum>(256),
        case::<MountainCar>(256),
        case::<MountainCarContinuous>(256),
    ];
    let mut best = vec![f64::INFINITY; cases.len()];
    for _ in 0..ROUNDS {
        for ((_, run), best) in cases.iter_mut().zip(&mut best) {
            let start = Instant::now();
            run();
            *best = best.min(start.elapsed().as_secs_f64());
        }
    }
    println!("{:<36}{:>12}{:>16}", "", "steps/s", "of the first");
    for ((name, _), seconds) in cases.iter().zip(&best) {
        println!("{name:<36}{:>10.2} M{:>15.0}%", STEPS as f64 / seconds * 1e-6, 100.0 * best[0] / seconds);
    }
}
