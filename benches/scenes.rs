//! Signed distances: procedural rooms and a finely meshed one from triangles to grids, and look-ups.
//!
//! The best of a few rounds counts; processor time over all threads tells more than wall time on a busy machine.

use egogen::render::Mesh;
use egogen::scene::{RoomKind, Rooms, SdfGrid, SdfOptions, TriMesh};
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

/// Tells how long the grid of a mesh takes, and gives it.
fn build(what: &str, mesh: &TriMesh, options: &SdfOptions) -> SdfGrid {
    let build = || SdfGrid::build(mesh, options).expect("a room");
    let (grid, time) = (build(), best(build));
    let per_voxel = 1e9 * time / grid.values.len() as f64;
    println!("{what:<28} {:>7} triangles, {:?} voxels: {time:>7.3} s, {per_voxel:>6.0} ns a voxel", mesh.triangles.len(), grid.dims);
    grid
}

fn main() {
    println!("{} threads", rayon::current_num_threads());
    for (kind, name) in [(RoomKind::Furnished, "furnished room"), (RoomKind::Hall, "hall")] {
        let room = Rooms { kind, difficulty: 0.7 }.draw(1).expect("a room");
        for voxel in [0.1, 0.05] {
            let options = SdfOptions { voxel, ..SdfOptions::for_floor(&room.walkable, 0.0).expect("a floor") };
            build(name, &room.mesh, &options);
        }
    }
    let room = room();
    let grid = build("finely meshed room", &room, &SdfOptions::default().with_cells(&room, 128));
    let mut rng = egogen::rng::stream(1, "bench", 0);
    let mut within = || grid.lowest + (grid.highest() - grid.lowest) * Vec3::from([0; 3].map(|_| rng.random_range(0.0..1.0)));
    let points: Vec<Vec3> = (0..POINTS).map(|_| within()).collect();
    let looking = best(|| points.iter().map(|&p| grid.at(p).min(0.0)).sum::<f32>());
    println!("a look-up, on one thread: {:.1} ns", 1e9 * looking / POINTS as f64);
}
