//! Whole episodes of a gliding figure whose rewards are known in advance.

use super::toy::Toy;
use super::{EPISODE, Form, MotionEnv, MotionTask, Penetration, TERMS};
use crate::conformance::{Effort, check};
use crate::{EnvError, StepResult, VecEnv};
use egogen::body::{BETAS, BodyModel, Frame, MARKER_DIM, joint};
use egogen::motion::Origin;
use egogen::scene::{CrowdedScenes, PairOptions, RoomKind, SparseKind, SparseScenes};
use egogen::sim::{SeedBank, SeedMotion, Sim, World};
use glam::{Vec2, Vec3};
use std::sync::Arc;

/// Seconds of one step.
const STEP: f32 = 0.45;

fn world() -> (Arc<Sim>, Arc<SeedBank>) {
    let toy = Toy::new();
    let seed = SeedMotion { params: toy.at(&Frame::IDENTITY).repeat(2), betas: [0.0; BETAS] };
    (Arc::new(Sim::new(BodyModel::embedded(), Arc::new(toy))), Arc::new(SeedBank { seeds: vec![seed] }))
}

fn env(task: MotionTask, n: usize, seed: u64) -> MotionEnv {
    let (sim, bank) = world();
    MotionEnv::new(task, sim, bank, n, seed).unwrap()
}

/// No turn at the start, so that gliding forward leads to the goal.
fn straight(kind: SparseKind) -> MotionTask {
    MotionTask { scene: SparseScenes { kind, ..Default::default() }, yaw_noise_deg: 0.0, ..Default::default() }
}

fn figure(out: &StepResult, name: &str) -> f32 {
    out.episode[EPISODE.iter().position(|&n| n == name).unwrap()]
}

fn term(out: &StepResult, name: &str) -> f32 {
    out.info[TERMS.iter().position(|t| t.name == name).unwrap()]
}

fn near(a: f32, b: f32) -> bool {
    (a - b).abs() < 2e-4
}

#[test]
fn conforms() {
    let effort = Effort { steps: 30, action_scale: 1.0 };
    check(|n, seed| Box::new(env(MotionTask::default(), n, seed)), effort);
    check(
        |n, seed| {
            let (sim, bank) = world();
            Box::new(MotionEnv::evaluation(MotionTask::default(), sim, bank, n, seed).unwrap())
        },
        effort,
    );
}

#[test]
fn few_latents_act_like_whole_ones_with_zeros() {
    let few = MotionTask { latents: Some(2), ..MotionTask::default() };
    check(|n, seed| Box::new(env(few.clone(), n, seed)), Effort { steps: 15, action_scale: 1.0 });
    let (mut a, mut b) = (env(few.clone(), 2, 5), env(MotionTask::default(), 2, 5));
    let (mut x, mut y) = (StepResult::default(), StepResult::default());
    a.step(&[1.0, 0.2, 0.5, -0.1], &mut x).unwrap();
    b.step(&[1.0, 0.2, 0.0, 0.0, 0.5, -0.1, 0.0, 0.0], &mut y).unwrap();
    assert_eq!((x.obs, x.reward), (y.obs, y.reward));
    let (sim, bank) = world();
    let error = MotionEnv::new(MotionTask { latents: Some(5), ..few }, sim, bank, 1, 0).err().unwrap().to_string();
    assert!(error.contains("latents is 5, expected at most the motion model's 4"), "{error}");
}

#[test]
fn the_spec_is_the_papers() {
    let env = env(MotionTask::default(), 1, 0);
    let groups: Vec<_> = env.spec().obs.iter().map(|g| (g.name.as_str(), g.shape.clone())).collect();
    assert_eq!(groups, [("state", vec![2, 402]), ("egosensing", vec![2, 32]), ("dist", vec![1]), ("time", vec![1])]);
    assert_eq!(env.spec().obs_dim(), 870);
}

#[test]
fn gliding_to_the_goal_arrives() {
    let mut task = straight(SparseKind::Open);
    task.weights.arrival = 0.7;
    let mut env = env(task, 1, 2);
    let (mut obs, mut out) = (vec![], StepResult::default());
    env.reset(2, &mut obs).unwrap();
    let goal = env.setting(0).goal;
    let d = env.setting(0).start.distance(goal);
    assert!(near(obs[868], 1.0 / (1.0 + d)) && obs[869] == 1.0);
    // Four steps whose last ends on the goal.
    let speed = d / (4.0 * STEP);
    for step in 1..=4u32 {
        env.step(&[speed, 0.0, 0.0, 0.0], &mut out).unwrap();
        assert!(near(term(&out, "dist"), d / 4.0));
        assert!(near(term(&out, "penetration"), 0.005));
        // Every marker glides at the same speed: 0.3 exp(-mean (v - 0.075)+). Frame 1 sees half of it, as it starts from rest.
        let excess = (17.0 * (speed - 0.075) + (speed / 2.0 - 0.075).max(0.0)) / 18.0;
        assert!(step > 1 || near(term(&out, "skate"), 0.3 * (-excess).exp()), "{}", term(&out, "skate"));
        assert!(step < 2 || near(term(&out, "skate"), 0.3 * (-(speed - 0.075)).exp()));
        if step < 4 {
            assert!(near(term(&out, "orient"), 0.1));
            // It looks straight ahead, the goal lies ahead and below: 0.3 (cos + 1) / 2 with cos = adjacent / hypotenuse.
            let rest = *BodyModel::embedded().joints_template();
            let (ahead, below) = (d * (1.0 - step as f32 / 4.0), rest[joint::HEAD].y - rest[joint::PELVIS].y);
            let cos = ahead / ahead.hypot(below);
            assert!((term(&out, "attention") - 0.15 * (cos + 1.0)).abs() < 3e-3, "{} {cos}", term(&out, "attention"));
            assert!(!out.terminated[0] && near(out.final_obs[868], 1.0 / (1.0 + d * (1.0 - step as f32 / 4.0))));
        }
        assert!(near(out.final_obs[869], 1.0 - step as f32 / 11.0));
    }
    assert!(out.terminated[0] && !out.truncated[0]);
    assert_eq!([figure(&out, "success"), figure(&out, "penetration"), figure(&out, "steps")], [1.0, 0.0, 4.0]);
    assert!(near(term(&out, "success"), 0.5) && near(term(&out, "arrival"), 0.7 * 7.0));
    assert!(figure(&out, "final_dist") < 1e-3 && figure(&out, "min_dist") < 1e-3 && figure(&out, "hover") == 0.0);
    assert!(near(figure(&out, "path_len"), d));
    assert_ne!(env.setting(0).goal, goal, "a new scene");
}

#[test]
fn gliding_into_the_box_penetrates() {
    let mut env = env(straight(SparseKind::Box), 8, 4);
    let mut out = StepResult::default();
    let mut hit = [false; 8];
    for _ in 0..8 {
        env.step(&[0.8, 0.0, 0.0, 0.0].repeat(8), &mut out).unwrap();
        for (i, hit) in hit.iter_mut().enumerate() {
            let info = &out.info[i * TERMS.len()..][..TERMS.len()];
            let kept = info[TERMS.iter().position(|t| t.name == "penetration").unwrap()];
            assert_eq!(kept == 0.0, out.terminated[i], "the term is lost exactly where the episode ends");
            *hit |= out.terminated[i];
            let figures = &out.episode[i * EPISODE.len()..][..EPISODE.len()];
            assert_eq!(figures[1] == 1.0, out.terminated[i]);
            assert_eq!(figures[0], 0.0);
        }
    }
    assert_eq!(hit, [true; 8]);
}

#[test]
fn standing_still_ends_at_the_step_limit() {
    let mut env = env(MotionTask::default(), 2, 4);
    let mut out = StepResult::default();
    for step in 0..11 {
        assert!(!out.terminated.contains(&true), "step {step}");
        env.step(&[0.0; 8], &mut out).unwrap();
        assert!(near(term(&out, "skate"), 0.3) && near(term(&out, "dist"), 0.0));
    }
    assert_eq!(out.terminated, [true; 2]);
    assert_eq!([out.final_obs[869], out.obs[869]], [0.0, 1.0]);
    assert_eq!([figure(&out, "success"), figure(&out, "penetration"), figure(&out, "steps")], [0.0, 0.0, 11.0]);
}

#[test]
fn hovering_is_noticed() {
    let mut env = env(straight(SparseKind::Open), 1, 5);
    let mut out = StepResult::default();
    let d = env.setting(0).start.distance(env.setting(0).goal);
    // To 0.2 m before the goal in one step, then wait there.
    env.step(&[(d - 0.2) / STEP, 0.0, 0.0, 0.0], &mut out).unwrap();
    for _ in 0..10 {
        env.step(&[0.0; 4], &mut out).unwrap();
    }
    assert!(out.terminated[0] && figure(&out, "hover") == 1.0 && figure(&out, "success") == 0.0);
    assert!((figure(&out, "final_dist") - 0.2).abs() < 1e-3);
}

#[test]
fn observations_point_to_the_goal() {
    let env = env(MotionTask::default(), 3, 9);
    let mut obs = vec![];
    env.observe(&mut obs).unwrap();
    for (i, row) in obs.chunks_exact(870).enumerate() {
        for frame in row[..804].chunks_exact(402) {
            let markers = frame[..MARKER_DIM].chunks_exact(3).map(Vec3::from_slice);
            for (m, to) in markers.zip(frame[MARKER_DIM..].chunks_exact(3).map(Vec3::from_slice)) {
                // Following the direction from the marker leads over the goal, in the world.
                let (m, to) = (env.people().frames[i].point(m), env.people().frames[i].dir(to));
                let away = env.setting(i).goal - m.truncate();
                let reached = m + to * (away.length() / to.truncate().length());
                assert!((to.length() - 1.0).abs() < 1e-5 && (reached.truncate() - env.setting(i).goal).length() < 1e-3);
            }
        }
        assert!(row[804..868].iter().all(|r| (-1.0..=1.0).contains(r)) && row[804..868].iter().any(|&r| r > -1.0));
    }
}

#[test]
fn markers_count_from_the_origin_of_the_motion_model() {
    let (sim, bank) = world();
    let mut toy = Toy::new();
    toy.origin = Origin::Pelvis;
    let lowered = Arc::new(Sim::new(sim.body().clone(), Arc::new(toy)));
    let [floor, pelvis] = [sim, lowered].map(|sim| MotionEnv::new(MotionTask::default(), sim, bank.clone(), 2, 9).unwrap());
    let height = floor.people().pelvis_height(0);
    assert!((0.8..1.1).contains(&height), "{height}");
    let (mut a, mut b) = (vec![], vec![]);
    floor.observe(&mut a).unwrap();
    pelvis.observe(&mut b).unwrap();
    for (k, (a, b)) in a.iter().zip(&b).enumerate() {
        let column = k % 870;
        let is_z = column < 804 && column % 402 < MARKER_DIM && column % 402 % 3 == 2;
        assert!((a - b - if is_z { height } else { 0.0 }).abs() < 1e-5, "number {column} is {a} and {b}");
    }
}

#[test]
fn evaluation_numbers_its_starts() {
    let (sim, bank) = world();
    let make = |n| MotionEnv::evaluation(MotionTask::default(), sim.clone(), bank.clone(), n, 7).unwrap();
    let starts = |n: usize, steps: usize, speed: f32| {
        let (mut env, mut out) = (make(n), StepResult::default());
        let mut seen: Vec<(u64, Vec2)> = (0..n).map(|i| (env.start_number(i), env.setting(i).start)).collect();
        for _ in 0..steps {
            env.step(&[speed, 0.0, 0.0, 0.0].repeat(n), &mut out).unwrap();
            seen.extend((0..n).filter(|&i| out.terminated[i]).map(|i| (env.start_number(i), env.setting(i).start)));
        }
        seen.sort_by_key(|s| s.0);
        seen
    };
    // Different numbers of environments and different policies meet the same 8 starts.
    let (a, b) = (starts(4, 11, 0.0), starts(2, 33, 0.0));
    assert_eq!(a[..8], b[..8]);
    assert_eq!(a.iter().map(|s| s.0).collect::<Vec<_>>(), (0..8).collect::<Vec<_>>());
    assert_eq!(starts(4, 11, 0.9)[..8], a[..8]);
    let fresh = env(MotionTask::default(), 4, 7);
    assert_ne!(fresh.setting(0).start, a[0].1, "training draws other starts");
}

#[test]
fn foreign_states_and_empty_banks_are_refused() {
    let state = env(MotionTask::default(), 2, 0).save_state().unwrap();
    let mut other = env(MotionTask { max_depth: 13, ..Default::default() }, 2, 0);
    assert!(other.load_state(&state).unwrap_err().to_string().contains("another task"));
    let (sim, _) = world();
    let empty = MotionEnv::new(MotionTask::default(), sim, Arc::default(), 2, 0);
    assert!(matches!(empty, Err(EnvError::Invalid(what)) if what.contains("seed bank")));
}

/// Two small rooms.
fn rooms() -> MotionTask {
    let pairs = PairOptions { count: 8, ..Default::default() };
    let rooms = CrowdedScenes { kind: RoomKind::Hall, difficulty: [0.5, 0.5], count: 2, pairs, voxel: 0.1, ..Default::default() };
    MotionTask { rooms: Some(rooms), max_depth: 13, ..Default::default() }
}

#[test]
fn rooms_conform() {
    let effort = Effort { steps: 20, action_scale: 1.0 };
    check(|n, seed| Box::new(env(rooms(), n, seed)), effort);
    let strict = MotionTask { penetration: Penetration { most: Some(40.0), points: 300, form: Form::Count }, ..rooms() };
    check(|n, seed| Box::new(env(strict.clone(), n, seed)), effort);
}

#[test]
fn training_and_tests_play_in_different_rooms() {
    let (sim, bank) = world();
    let train = MotionEnv::new(rooms(), sim.clone(), bank.clone(), 8, 1).unwrap();
    let test = MotionEnv::evaluation(rooms(), sim, bank, 8, 1).unwrap();
    let names = |e: &MotionEnv| (0..8).map(|i| e.room(i).unwrap().name.clone()).collect::<std::collections::BTreeSet<_>>();
    assert!(names(&train).len() == 2 && names(&train).is_disjoint(&names(&test)), "{:?} {:?}", names(&train), names(&test));
}

#[test]
fn who_walks_into_columns_pays_and_in_the_second_stage_ends() {
    // The figure glides straight on at 1 m/s, through whatever stands there.
    let play = |most: Option<f32>| {
        let task = MotionTask { penetration: Penetration { most, ..Default::default() }, yaw_noise_deg: 0.0, ..rooms() };
        let mut env = env(task, 24, 2);
        let (mut out, mut inside, mut ended, mut least) = (StepResult::default(), 0, 0, 1.0f32);
        for _ in 0..13 {
            env.step(&[1.0, 0.0, 0.0, 0.0].repeat(24), &mut out).unwrap();
            let width = TERMS.len();
            let at = TERMS.iter().position(|t| t.name == "penetration").unwrap();
            for i in 0..24 {
                let value = out.info[i * width + at] / 0.1;
                least = least.min(value);
                inside += usize::from(value < 0.9);
                let hit = out.episode[i * EPISODE.len() + 1];
                ended += usize::from(out.terminated[i] && hit == 1.0);
            }
        }
        (inside, ended, least)
    };
    let (inside, ended, least) = play(None);
    assert!(inside > 5 && ended == 0 && (0.0..0.5).contains(&least), "{inside} {ended} {least}");
    let (_, ended, _) = play(Some(40.0));
    assert!(ended > 2, "{ended}");
}

#[test]
fn training_may_fit_few_bodies_and_tests_fit_all() {
    let world = World::embedded().unwrap();
    let n = 8;
    let walk = |training: bool, body_every| {
        let task = MotionTask { body_every, ..Default::default() };
        let make = if training { MotionEnv::new } else { MotionEnv::evaluation };
        let mut env = make(task, world.sim.clone(), world.held_out.clone(), n, 3).unwrap();
        let mut out = StepResult::default();
        env.step(&vec![0.5; n * world.sim.model().latent_dim()], &mut out).unwrap();
        (env.primitives().markers.clone(), out.reward)
    };
    assert_eq!(walk(false, 3), walk(false, 1));
    let (few, all) = (walk(true, 3), walk(true, 1));
    assert!(few.0 != all.0 && few.1.iter().zip(&all.1).all(|(a, b)| (a - b).abs() < 0.02), "{:?} {:?}", few.1, all.1);
}
