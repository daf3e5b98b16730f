//! Signed distances: a furnished room from triangles to a grid of 128 voxels along its longest side, and look-ups in it.
//!
//! The best of a few rounds counts; processor time over all threads tells more than wall time on a busy machine.

use egogen::render::Mesh;
use egogen::scene::{SdfGrid, SdfOptions, TriMesh};
use glam::{Vec2, Vec3};
use rand::RngExt;
use std::hint::black_box;
use std::time::Instant;

const POINTS: usize = 1_000_000;
const ROUNDS: usize = 3;

/// Four walls of 6 x 6 x 2.5 m, a floor, and finely meshed round things on it: 131,122 triangles.
fn room() -> TriMesh {
    let mut room = TriMesh::new();
    let (walls, things) = (room.add_object("walls"), room.add_object("things"));
    let material = room.add_material("grey", [0.5, 0.5, 0.5, 1.0]);
    for side in 0..4 {
        let turn = side as f32 * std::f32::consts::FRAC_PI_2;
        let centre = Vec2::from_angle(turn) * 3.05;
        room.add_box(walls, material, centre.extend(1.25), Vec3::new(0.1, 6.2, 2.5), turn);
    }
    room.add_quad(walls, material, [(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)].map(|(x, y)| Vec3::new(x, y, 0.0)));
    for (x, y, radius) in [(-2.0, -1.5, 0.5), (1.5, 2.0, 0.7), (2.2, -2.0, 0.4), (-1.0, 1.8, 0.6)] {
        let first = room.vertices.len() as u32;
        let ball = Mesh::sphere(Vec3::new(x, y, 0.9 * radius), radius, 6);
        room.vertices.extend(ball.vertices);
        ball.faces.iter().for_each(|f| room.push(f.map(|v| first + v), things, material));
    }
    room
}

/// The least time of a few runs, seconds.
fn best<T>(mut run: impl FnMut() -> T) -> f64 {
    let mut time = || {
        let start = Instant::now();
        black_box(run());
        start.elapsed().as_secs_f64()
    };
    (0..ROUNDS).map(|_| time()).fold(f64::INFINITY, f64::min)
}

fn main() {
    let room = room();
    let options = SdfOptions::default().with_cells(&room, 128);
    let build = || SdfGrid::build(&room, &options).expect("a room");
    let grid = build();
    let mut rng = egogen::rng::stream(1, "bench", 0);
    let mut within = || grid.lowest + (grid.highest() - grid.lowest) * Vec3::from([0; 3].map(|_| rng.random_range(0.0..1.0)));
    let points: Vec<Vec3> = (0..POINTS).map(|_| within()).collect();
    let building = best(build);
    let looking = best(|| points.iter().map(|&p| grid.at(p).min(0.0)).sum::<f32>());
    println!("{} threads, {} triangles, voxels {:?}", rayon::current_num_threads(), room.triangles.len(), grid.dims);
    println!("building the grid            {building:>8.2} s");
    println!("a look-up, on one thread     {:>8.1} ns", 1e9 * looking / POINTS as f64);
}
