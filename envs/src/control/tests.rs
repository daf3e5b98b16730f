//! The tasks against Gymnasium's own episodes, steps worked by hand, and limits that hold everywhere.

use super::mountain_car::Car;
use super::{Acrobot, CartPole, Control, Dynamics, Member, MountainCar, MountainCarContinuous, Pendulum};
use crate::conformance::{Effort, check};
use crate::{ActionSpace, StepResult, VecEnv};
use egogen::io::Tensors;
use egogen::rng::stream;
use proptest::prelude::*;
use rand::RngExt;
use std::f64::consts::{FRAC_PI_2, PI};

fn cartpole(s: &[f64]) -> CartPole {
    CartPole { x: [s[0], s[1]], theta: [s[2], s[3]] }
}

fn acrobot(s: &[f64]) -> Acrobot {
    Acrobot { angle: [s[0], s[1]], speed: [s[2], s[3]] }
}

fn pendulum(s: &[f64]) -> Pendulum {
    Pendulum { angle: s[0], speed: s[1] }
}

fn car(s: &[f64]) -> Car {
    Car { position: s[0], speed: s[1] }
}

/// One environment in that state, `steps` steps into its episode.
fn placed<D: Dynamics>(state: D, steps: u32) -> Control<D> {
    let mut env = Control::new(1, 0);
    env.members[0] = Member { rng: stream(0, "placed", 0), state, steps };
    env
}

/// Runs a recorded episode (tests/tools/gymnasium/make.py) through [`Control`] and compares everything.
fn replay<D: Dynamics>(name: &str, place: impl Fn(&[f64]) -> D) {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/fixtures/gymnasium/control.safetensors");
    let t = Tensors::read(file).unwrap();
    let floats = |key: &str, shape: &[usize]| t.f32s(&format!("{name}.{key}"), shape).unwrap();
    let start: Vec<f64> = floats("start", &[0]).into_iter().map(f64::from).collect();
    let action = floats("action", &[0]);
    let reward = floats("reward", &[action.len()]);
    let wanted = floats("obs", &[action.len() + 1, D::OBS]);
    let elapsed = t.ints(&format!("{name}.elapsed"), &[1]).unwrap()[0] as u32;
    let end = t.ints(&format!("{name}.end"), &[2]).unwrap();
    let near = |a: &[f32], b: &[f32]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-5);
    let mut env = placed(place(&start), elapsed);
    let (mut obs, mut out) = (Vec::new(), StepResult::default());
    env.observe(&mut obs).unwrap();
    assert!(near(&obs, &wanted[..D::OBS]), "{name}: first observation {obs:?}");
    for (t, (a, row)) in action.iter().zip(wanted.chunks_exact(D::OBS).skip(1)).enumerate() {
        env.step(&[*a], &mut out).unwrap();
        assert!(near(&out.final_obs, row), "{name}, step {t}: {:?}, Gymnasium has {row:?}", out.final_obs);
        assert!(near(&out.reward, &reward[t..=t]), "{name}, step {t}: reward {:?}, Gymnasium's {}", out.reward, reward[t]);
        let last = t + 1 == action.len();
        assert_eq!([out.terminated[0], out.truncated[0]], [last && end[0] == 1, last && end[1] == 1], "{name}, step {t}: ends");
    }
}

#[test]
fn episodes_are_gymnasiums() {
    for case in ["fall", "leave", "hold"] {
        replay(&format!("cartpole.{case}"), cartpole);
    }
    for case in ["pump", "whirl", "idle"] {
        replay(&format!("acrobot.{case}"), acrobot);
    }
    for case in ["random", "spin"] {
        replay(&format!("pendulum.{case}"), pendulum);
    }
    for case in ["swing", "random"] {
        replay(&format!("mountaincar.{case}"), |s| MountainCar(car(s)));
        replay(&format!("mountaincar_continuous.{case}"), |s| MountainCarContinuous(car(s)));
    }
}

#[test]
fn tasks_conform() {
    let steps = |steps| Effort { steps, ..Effort::default() };
    check(|n, seed| Box::new(Control::<CartPole>::new(n, seed)), steps(60));
    check(|n, seed| Box::new(Control::<Acrobot>::new(n, seed)), steps(510));
    check(|n, seed| Box::new(Control::<Pendulum>::new(n, seed)), steps(210));
    check(|n, seed| Box::new(Control::<MountainCar>::new(n, seed)), steps(210));
    check(|n, seed| Box::new(Control::<MountainCarContinuous>::new(n, seed)), steps(1010));
}

#[test]
fn a_push_from_rest_by_hand() {
    let mut s = cartpole(&[0.0; 4]);
    assert_eq!(s.step(1.0), (1.0, false));
    // 10 / 1.1 over 0.5 (4/3 - 0.1 / 1.1) turns the pole back; the cart gets 10 / 1.1 + 0.05 / 1.1 of that.
    let (turn, slide) = (-14.634_146, 9.756_098);
    assert!((s.theta[1] - 0.02 * turn).abs() < 1e-8 && (s.x[1] - 0.02 * slide).abs() < 1e-8);
    assert_eq!([s.x[0], s.theta[0]], [0.0; 2]);

    // Hanging at rest: d1 = 4.5, d2 = 1.75, no gravity torque; 1 / (1.25 - 1.75^2 / 4.5), and -1.75 / 4.5 of it.
    let [first, second] = Acrobot::acceleration([0.0; 2], [0.0; 2], 1.0);
    assert!((second - 1.756_097_6).abs() < 1e-7 && (first + 0.682_926_8).abs() < 1e-7);

    // Level: gravity turns by 15, torque 1 by 3, for 0.05 s.
    let mut s = pendulum(&[FRAC_PI_2, 0.0]);
    let (reward, _) = s.step(1.0);
    assert!((reward + FRAC_PI_2 * FRAC_PI_2 + 0.001).abs() < 1e-12);
    assert!((s.speed - 0.9).abs() < 1e-12 && (s.angle - FRAC_PI_2 - 0.045).abs() < 1e-12);

    // 0.001 - 0.0025 cos(-1.5).
    let mut s = MountainCar(car(&[-0.5, 0.0]));
    assert_eq!(s.step(2.0), (-1.0, false));
    assert!((s.0.speed - 0.000_823_157).abs() < 1e-9);
}

#[test]
fn an_end_on_the_last_step_is_no_truncation() {
    let mut out = StepResult::default();
    placed(cartpole(&[0.0; 4]), 499).step(&[0.0], &mut out).unwrap();
    assert_eq!((out.terminated[0], out.truncated[0], out.episode[0]), (false, true, 0.0));
    placed(cartpole(&[0.0, 0.0, 0.208, 3.0]), 499).step(&[0.0], &mut out).unwrap();
    assert_eq!((out.terminated[0], out.truncated[0], out.episode[0]), (true, false, 1.0));
    assert!(out.obs.iter().all(|x| x.abs() <= 0.05) && out.final_obs[2] > 0.2095);
}

#[test]
fn a_state_of_another_task_is_refused() {
    let state = Control::<MountainCar>::new(3, 0).save_state().unwrap();
    let error = Control::<MountainCarContinuous>::new(3, 0).load_state(&state).unwrap_err().to_string();
    assert!(error.contains("MountainCarContinuous-v0") && error.contains("'control 1 MountainCar-v0'"), "{error}");
}

/// Random actions for some steps: observations and rewards stay inside `limits` (of |observation|) and `rewards`.
fn stays_inside<D: Dynamics>(seed: u64, limits: &[f32], rewards: [f32; 2]) -> Result<(), TestCaseError> {
    let mut env = Control::<D>::new(4, seed);
    let mut rng = stream(seed, "actions", 0);
    let mut out = StepResult::default();
    for _ in 0..300 {
        let draw = |_| match D::ACTION {
            ActionSpace::Discrete(k) => rng.random_range(0..k) as f32,
            ActionSpace::Continuous(_) => rng.random_range(-4.0..4.0),
        };
        env.step(&(0..4).map(draw).collect::<Vec<f32>>(), &mut out).unwrap();
        for row in out.obs.chunks_exact(D::OBS).chain(out.final_obs.chunks_exact(D::OBS)) {
            prop_assert!(row.iter().zip(limits).all(|(x, limit)| x.abs() <= *limit), "{} observes {row:?}", D::NAME);
        }
        prop_assert!(out.reward.iter().all(|r| (rewards[0]..=rewards[1]).contains(r)), "{} rewards {:?}", D::NAME, out.reward);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn limits_hold(seed: u64) {
        let (free, pi) = (f32::INFINITY, PI as f32);
        stays_inside::<CartPole>(seed, &[4.8, free, 0.4189, free], [1.0, 1.0])?;
        stays_inside::<Acrobot>(seed, &[1.0, 1.0, 1.0, 1.0, 4.0 * pi, 9.0 * pi], [-1.0, 0.0])?;
        stays_inside::<Pendulum>(seed, &[1.0, 1.0, 8.0], [-16.273_605, 0.0])?;
        stays_inside::<MountainCar>(seed, &[1.2, 0.07], [-1.0, -1.0])?;
        stays_inside::<MountainCarContinuous>(seed, &[1.2, 0.07], [-0.1, 100.0])?;
    }

    #[test]
    fn angles_are_wrapped(a in -50.0..50.0f64, b in -PI..PI, v in -8.0..8.0f64, w in -20.0..20.0f64, u in -3.0..3.0f32) {
        let mut swing = acrobot(&[b, -b, v, w]);
        swing.step(u.clamp(-1.0, 1.0).round() + 1.0);
        prop_assert!(swing.angle.iter().all(|x| x.abs() <= PI), "{swing:?}");
        // The reward must not notice whole turns; the same angle by another function.
        let u = u.clamp(-2.0, 2.0);
        let nearest = a.sin().atan2(a.cos());
        let want = -(nearest * nearest + 0.1 * v * v + 0.001 * f64::from(u) * f64::from(u));
        prop_assert!((pendulum(&[a, v]).step(u).0 - want).abs() < 1e-9);
    }
}
