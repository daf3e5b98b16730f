//! Penetration in rooms: by hand, against Open3D, few points against all, and that passing over changes nothing.

use super::*;
use crate::motion::{MotionEnv, Weights};
use crate::{StepResult, VecEnv};
use egogen::rng::stream;
use egogen::scene::{CrowdedScenes, PairOptions, SdfGrid, SdfOptions, TriMesh};
use egogen::sim::World;
use glam::{Mat3, Vec3};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

#[test]
fn equation_8_by_hand() {
    let p = Presence { count: 20.0, depth: 0.3, most: 50.0 };
    assert!((p.reward(Form::Depth) - (-0.3f32).exp()).abs() < 1e-7);
    assert!((p.reward(Form::Count) - (-2.0f32).exp()).abs() < 1e-7);
    assert_eq!(Presence::default().reward(Form::Depth), 1.0);
}

/// Steps of people who wander through furnished rooms by the motion model's prior: the primitives, and in which rooms they are.
fn wander(n: usize, steps: u64) -> (MotionTask, Vec<(Primitives, Vec<u32>)>) {
    let world = World::embedded().unwrap();
    let rooms = CrowdedScenes { count: 4, pairs: PairOptions { count: 16, ..Default::default() }, ..Default::default() };
    let weights = Weights { pose: 0.0, ..Default::default() };
    let task = MotionTask { rooms: Some(rooms.clone()), max_depth: steps as u32, weights, ..Default::default() };
    let scenes = rooms.make(Split::Train).unwrap();
    let mut env = MotionEnv::new(task.clone(), world.sim.clone(), world.train, n, 5).unwrap();
    let place = |env: &MotionEnv, i: usize| scenes.iter().position(|s| Some(&s.name) == env.room(i).map(|r| &r.name)).unwrap() as u32;
    let at: Vec<u32> = (0..n).map(|i| place(&env, i)).collect();
    let (mut out, dim) = (StepResult::default(), world.sim.model().latent_dim());
    let mut film = Vec::new();
    for step in 0..steps {
        let latents: Vec<f32> = StandardNormal.sample_iter(stream(3, "wander", step)).take(n * dim).collect();
        env.step(&latents, &mut out).unwrap();
        film.push((env.primitives().clone(), at.clone()));
    }
    (task, film)
}

fn crowd(task: &MotionTask, points: usize, n: usize) -> Crowd {
    let task = MotionTask { penetration: Penetration { points, ..Default::default() }, ..task.clone() };
    Crowd::new(&task, &World::embedded().unwrap().sim, n, Split::Train).unwrap().unwrap()
}

#[test]
fn few_points_judge_like_the_whole_mesh() {
    const N: usize = 64;
    let (task, film) = wander(N, 13);
    let (all, few) = (crowd(&task, 0, N), crowd(&task, 2000, N));
    let (mut sums, mut apart, mut ends, mut other, mut steps) = ([[0.0f32; 2]; 2], [0.0f32; 2], 0, 0, 0.0);
    for (prims, rooms) in &film {
        let judge = |crowd: &Crowd| (0..N).into_par_iter().map(|i| crowd.presence(rooms[i], prims, i)).collect::<Vec<_>>();
        for (a, b) in judge(&all).iter().zip(judge(&few)) {
            for (k, form) in [Form::Depth, Form::Count].into_iter().enumerate() {
                let (x, y) = (a.reward(form), b.reward(form));
                (sums[k][0], sums[k][1], apart[k]) = (sums[k][0] + x, sums[k][1] + y, apart[k] + (x - y).abs());
            }
            ends += usize::from(a.most >= 40.0);
            other += usize::from((a.most >= 40.0) != (b.most >= 40.0));
            steps += 1.0;
        }
    }
    let share = ends as f32 / steps;
    println!("eq. 8 by depth and by count, all vertices: {:?}, 2,000 points: {:?}", sums.map(|s| s[0] / steps), sums.map(|s| s[1] / steps));
    println!(
        "mean difference of a step: {:?}; eq. 11 in {share} of the steps, decided otherwise in {}",
        apart.map(|a| a / steps),
        other as f32 / steps
    );
    assert!((0.1..0.9).contains(&share));
    for ([x, y], d) in sums.iter().zip(apart) {
        assert!((x - y).abs() < 0.02 * x && d < 0.02 * x, "{x} {y} {d}");
    }
    assert!((other as f32) < 0.02 * steps);
}

/// A room in which no ball is passed over.
struct Everywhere<'a>(Probe<'a>);

impl Obstacles for Everywhere<'_> {
    fn distances(&self, at: &Group, out: &mut Lanes) {
        self.0.distances(at, out);
    }

    fn slack(&self) -> f32 {
        f32::INFINITY
    }
}

#[test]
fn passing_over_what_is_clear_of_a_room_changes_nothing() {
    const N: usize = 48;
    let (task, film) = wander(N, 4);
    let crowd = crowd(&task, 3000, N);
    let mut inside = 0;
    for (prims, rooms) in &film {
        for (i, &room) in rooms.iter().enumerate() {
            let scene = crowd.scene(room).unwrap();
            let motion = Moving {
                body: &crowd.shapes[i].body,
                params: &prims.params[i * FRAMES * PARAMS..][..FRAMES * PARAMS],
                joints: &prims.joints[i * FRAMES * 3 * JOINTS..][..FRAMES * 3 * JOINTS],
                to_world: &prims.frames[i],
            };
            let room = Room::new(&scene.sdf);
            let got = crowd.shapes[i].surface.over(&motion, &room);
            assert_eq!(got, crowd.shapes[i].surface.over(&motion, &Everywhere(scene.sdf.probe())));
            inside += got.iter().filter(|f| f.count > 0.0).count();
        }
    }
    assert!(inside > 500, "{inside} frames");
}

#[derive(serde::Deserialize)]
struct Block {
    centre: Vec3,
    size: Vec3,
    yaw: f32,
}

/// A room of tests/fixtures/scenes/penetration.json.
#[derive(serde::Deserialize)]
struct Case {
    boxes: Vec<Block>,
    params: Vec<Vec<f32>>,
    count: Vec<f32>,
    depth: Vec<f32>,
    eq8_depth: f32,
    eq8_count: f32,
    eq11: f32,
}

/// What lies in boxes of frames of the mean body, all its vertices, by distances in voxels of that size.
fn inside(boxes: &[Block], params: &[f32], to_world: &Frame, voxel: f32) -> Vec<Inside> {
    let mut mesh = TriMesh::new();
    let (object, material) = (mesh.add_object("box"), mesh.add_material("grey", [0.5, 0.5, 0.5, 1.0]));
    boxes.iter().for_each(|b| mesh.add_box(object, material, b.centre, b.size, b.yaw));
    let sdf = SdfGrid::build(&mesh, &SdfOptions { voxel, ..Default::default() }).unwrap();
    let model = BodyModel::embedded();
    let Shaped { body, surface } = Shaped::new(&model, &Arc::new(Surface::new(&model, Points::All)), &[0.0; BETAS]);
    let joints: Vec<f32> = params.chunks_exact(PARAMS).flat_map(|p| body.pose(p).pos).flat_map(|p| p.to_array()).collect();
    let motion = Moving { body: &body, params, joints: &joints, to_world };
    surface.over(&motion, &Room::new(&sdf))
}

#[test]
fn pushed_on_by_a_centimetre_what_is_inside_is_a_centimetre_deeper() {
    // A person upright with the arms spread, 30 frames, 1 cm further backwards into a block in each.
    let params: Vec<f32> = (0..30).flat_map(|k| [0.0, 0.0, -0.01 * k as f32].into_iter().chain([0.0; PARAMS - 3])).collect();
    let upright = Frame { rot: Mat3::from_rotation_x(std::f32::consts::FRAC_PI_2), transl: Vec3::new(0.0, 0.75, 0.95) };
    let block = Block { centre: Vec3::new(0.0, 2.0, 1.3), size: Vec3::new(5.0, 2.0, 2.6), yaw: 0.0 };
    let frames = inside(&[block], &params, &upright, 0.05);
    assert!(frames[0] == Inside::default() && frames[29].count > 3000.0, "{:?}", frames[29]);
    for pair in frames.windows(2) {
        let deeper = pair[1].depth - pair[0].depth;
        let (low, high) = (0.01 * pair[0].count, 0.01 * pair[1].count);
        assert!(deeper >= 0.999 * low - 1e-3 && deeper <= 1.001 * high + 1e-3, "{pair:?}");
    }
}

#[test]
fn posed_bodies_in_rooms_agree_with_open3d() {
    let cases: Vec<Case> = serde_json::from_str(include_str!("../../../../tests/fixtures/scenes/penetration.json")).unwrap();
    // Side of a voxel, and how far off count and depth may be: voxels round off edges.
    for (voxel, most) in [(0.05, [0.01, 0.04]), (0.1, [0.03, 0.15])] {
        for case in &cases {
            let params: Vec<f32> = case.params.iter().flat_map(|p| p.iter().copied().chain([0.0; PARAMS - 69])).collect();
            let frames = inside(&case.boxes, &params, &Frame::IDENTITY, voxel);
            let off = |got: fn(&Inside) -> f32, want: &[f32]| {
                let apart: f32 = frames.iter().zip(want).map(|(f, w)| (got(f) - w).abs()).sum();
                apart / want.iter().sum::<f32>()
            };
            let got = [off(|f| f.count, &case.count), off(|f| f.depth, &case.depth)];
            println!("voxels of {voxel} m: {} of the count and {} of the depth too much or too little", got[0], got[1]);
            assert!(got[0] < most[0] && got[1] < most[1], "{voxel}: {got:?}");
            let all = Presence::over(&frames);
            let close = |value: f32, want: f32, share: f32| (value - want).abs() < share * want;
            // As logarithms, for so many deep vertices leave nothing of a reward.
            assert!(close(-all.reward(Form::Depth).ln(), -case.eq8_depth.ln(), most[1]));
            assert!(close(-all.reward(Form::Count).ln(), -case.eq8_count.ln(), most[0]));
            assert!(close(all.most, case.eq11, most[0]));
        }
    }
}
