mod rooms;

use super::build::SdfOptions;
use super::tree::{Tree, Tri};
use super::*;
use crate::scene::mesh::{MeshOptions, read_mesh};
use crate::scene::{RoomKind, Rooms, TriMesh};
use serde::Deserialize;
use std::path::{Path, PathBuf};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/scenes").join(name)
}

fn options(voxel: f32, margin: f32, floor: Option<f32>) -> SdfOptions {
    SdfOptions { voxel, margin, floor, ..Default::default() }
}

fn boxes(boxes: &[(Vec3, Vec3)]) -> TriMesh {
    let mut mesh = TriMesh::new();
    let material = mesh.add_material("grey", [0.5; 4]);
    for &(centre, size) in boxes {
        let object = mesh.add_object("box");
        mesh.add_box(object, material, centre, size, 0.0);
    }
    mesh
}

/// The six sides of a room of 4 x 3 x 2.5 m about the origin that face its inside, with a cupboard of 1 x 1 x 1.5 m in a corner.
fn room() -> TriMesh {
    let mut mesh = boxes(&[(Vec3::new(0.0, 0.0, 1.25), Vec3::new(4.0, 3.0, 2.5)), (Vec3::new(1.5, 1.0, 0.75), Vec3::new(1.0, 1.0, 1.5))]);
    mesh.triangles[..12].iter_mut().for_each(|t| t.swap(1, 2));
    mesh
}

fn each(grid: &SdfGrid) -> impl Iterator<Item = (Vec3, f32)> {
    grid.values.iter().enumerate().map(|(i, &v)| (grid.centre(grid.voxel_of(i)), v))
}

/// Signed distance of an upright box: outside the length of what sticks out, inside the least way to a side.
fn box_distance(p: Vec3, centre: Vec3, size: Vec3) -> f32 {
    let q = (p - centre).abs() - 0.5 * size;
    q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
}

#[test]
fn box_by_closed_form() {
    let (centre, size) = (Vec3::new(1.0, 2.0, 3.0), Vec3::new(2.0, 1.0, 1.0));
    let mut mesh = boxes(&[(centre, size)]);
    for inside_out in [false, true] {
        if inside_out {
            mesh.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        }
        let grid = SdfGrid::build(&mesh, &options(0.1, 0.5, None)).unwrap();
        grid.check().unwrap();
        // Extents 2, 1, 1 and twice the margin, in voxels, and one more for both ends.
        assert_eq!((grid.dims, grid.lowest), ([31, 21, 21], Vec3::new(-0.5, 1.0, 2.0)));
        let worst = each(&grid).map(|(p, v)| (v - box_distance(p, centre, size)).abs()).fold(0.0, f32::max);
        assert!(worst < 2e-6, "{worst}");
    }
}

#[test]
fn sphere_by_closed_form() {
    let mesh = sphere();
    let grid = SdfGrid::build(&mesh, &options(0.07, 0.2, Some(-5.0))).unwrap();
    // The mesh lies within 1.5 mm of a sphere of radius 0.6 about (0.3, -0.2, 0.9).
    let worst = each(&grid).map(|(p, v)| (v - ((p - Vec3::new(0.3, -0.2, 0.9)).length() - 0.6)).abs()).fold(0.0, f32::max);
    assert!(worst < 1.5e-3, "{worst}");
}

/// Longitudes and latitudes; chords of 64 around are at most 0.6 (1 - cos(pi / 64)) = 0.72 mm off, each way.
fn sphere() -> TriMesh {
    const N: u32 = 64;
    let mut mesh = TriMesh::new();
    let (object, material) = (mesh.add_object("sphere"), mesh.add_material("grey", [0.5; 4]));
    for i in 0..=N / 2 {
        for j in 0..N {
            let (a, b) = (std::f32::consts::PI * i as f32 / (N / 2) as f32, std::f32::consts::TAU * j as f32 / N as f32);
            mesh.vertices.push(Vec3::new(0.3, -0.2, 0.9) + 0.6 * Vec3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos()));
        }
    }
    for i in 0..N / 2 {
        for j in 0..N {
            let (a, b) = (i * N + j, i * N + (j + 1) % N);
            mesh.push([a, a + N, b + N], object, material);
            mesh.push([a, b + N, b], object, material);
        }
    }
    mesh
}

#[derive(Deserialize)]
struct Golden {
    grids: Vec<GoldenGrid>,
    authors: Lookup,
}

#[derive(Deserialize)]
struct GoldenGrid {
    file: String,
    lowest: Vec3,
    voxel: f32,
    dims: [usize; 3],
    values: Vec<f32>,
    winding: Vec<f32>,
}

#[derive(Deserialize)]
struct Lookup {
    points: Vec<f32>,
    values: Vec<f32>,
}

fn golden() -> Golden {
    serde_json::from_slice(&std::fs::read(fixture("distances.json")).unwrap()).unwrap()
}

#[test]
fn distances_as_open3d_has_them() {
    for g in golden().grids {
        let mesh = read_mesh(fixture(&g.file), &MeshOptions::default()).unwrap().mesh;
        let grid = SdfGrid::sample(&mesh, &options(g.voxel, 0.0, None), g.lowest, g.dims).unwrap();
        let tree = Tree::new((0..mesh.triangles.len()).map(|i| Tri(mesh.corners(i))).collect());
        let (mut worst, mut bent) = ([0.0f32; 2], 0);
        for (i, (p, v)) in each(&grid).enumerate() {
            // On a surface either side will do.
            if v.abs() > 1e-5 {
                worst[0] = worst[0].max((tree.winding(p, &mut Vec::new()) - g.winding[i]).abs());
                assert_eq!(v < 0.0, g.winding[i] > 0.5, "{}: {p} is {v}, winding number {}", g.file, g.winding[i]);
            }
            let want = if g.file != "open.ply" { g.values[i] } else { opening(p).min(g.values[i]).copysign(v) };
            let near_opening = g.file == "open.ply" && opening(p) < g.values[i];
            bent += usize::from(near_opening);
            match near_opening {
                true => assert!((v - want).abs() < g.voxel, "{p}: {v}, {want} to the opening"),
                false => worst[1] = worst[1].max((v - want).abs()),
            }
        }
        println!("{}: winding numbers within {}, distances within {}, {bent} near an opening", g.file, worst[0], worst[1]);
        assert!(worst[0] < 0.05 && worst[1] < 1e-5, "{}: {worst:?}", g.file);
    }
}

#[test]
fn top_cuts_off_what_is_above_it() {
    let whole = SdfGrid::build(&room(), &options(0.1, 0.2, Some(0.0))).unwrap();
    let low = SdfGrid::build(&room(), &SdfOptions { top: Some(1.8), ..options(0.1, 0.2, Some(0.0)) }).unwrap();
    // From -0.2 to 1.8 m of -0.2 to 2.7 m.
    assert_eq!((whole.dims[2], low.dims[2]), (30, 21));
    assert!(each(&low).zip(whole.values.chunks(30).flat_map(|row| &row[..21])).all(|((_, a), b)| a == *b));
    let e = SdfGrid::build(&room(), &SdfOptions { top: Some(-1.0), ..SdfOptions::default() }).unwrap_err().to_string();
    assert!(e.contains("top = -1"), "{e}");
}

/// Distance to the open undersides of open.ply: a rectangle of 1 x 0.8 m and a disc of radius 0.4 m at height -0.3.
fn opening(p: Vec3) -> f32 {
    let beyond = (p.truncate().abs() - glam::Vec2::new(0.5, 0.4)).max(glam::Vec2::ZERO).length();
    let beside = ((p.truncate() - glam::Vec2::new(1.4, 0.0)).length() - 0.4).max(0.0);
    beyond.min(beside).hypot(p.z + 0.3)
}

#[test]
fn inside_of_a_room_is_free() {
    let mut options = options(0.11, 0.3, Some(0.0));
    options.free = vec![Vec3::new(-1.0, 0.0, 1.0), Vec3::new(0.3, -0.8, 1.0), Vec3::new(1.5, 1.0, 0.5)];
    let grid = SdfGrid::build(&room(), &options).unwrap();
    for (p, v) in each(&grid).filter(|(p, _)| p.z > 0.03) {
        // To the walls and the ceiling, from inside positive; the floor is no obstacle, so their edges go on below it.
        let walls = -box_distance(p, Vec3::new(0.0, 0.0, 0.25), Vec3::new(4.0, 3.0, 4.5));
        let cupboard = box_distance(p, Vec3::new(1.5, 1.0, 0.0), Vec3::new(1.0, 1.0, 3.0));
        let want = walls.min(cupboard);
        assert!((v < 0.0) == (want < 0.0) || want.abs() < 1e-5, "{p}: {v}, expected {want}");
        // Within the cupboard the walls that it touches are surfaces as well.
        if walls > 0.0 && cupboard > 0.0 {
            assert!((v - want).abs() < 1e-5, "{p}: {v}, expected {want}");
        }
    }
    // Below the floor the scene goes on as above it.
    assert!(grid.at(Vec3::new(-1.0, 0.0, -0.2)) > 0.9 && grid.at(Vec3::new(1.5, 1.0, -0.2)) < 0.0);
    // Without a point in free space the room is one solid.
    options.free.clear();
    assert!(SdfGrid::build(&room(), &options).unwrap().at(Vec3::new(-1.0, 0.0, 1.0)) < 0.0);
}

#[test]
fn walkable_floor_of_drawn_rooms_is_free() {
    for seed in 0..3 {
        let room = Rooms { kind: RoomKind::Furnished, difficulty: 0.5 * seed as f32 }.draw(seed).unwrap();
        let grid = SdfGrid::build(&room.mesh, &options(0.12, 0.1, Some(0.0))).unwrap();
        let (mut walked, mut blocked) = (0, 0);
        // Below the lintels of doors, what stands there is no nearer than the border of its footprint.
        for (p, v) in each(&grid).filter(|(p, _)| p.z > 0.0 && p.z < 1.5) {
            if room.walkable.contains(p.truncate().as_dvec2()) {
                let clearance = room.walkable.border_distance(p.truncate().as_dvec2()) as f32;
                assert!(v >= clearance - 1e-4, "{}: {p} is {v} from obstacles, {clearance} from their footprints", room.name);
                walked += 1;
            }
            blocked += usize::from(v < 0.0);
        }
        assert!(walked > 1000 && blocked > 100, "{}: {walked} {blocked}", room.name);
    }
}

#[test]
fn floor_is_no_obstacle() {
    let mut mesh = boxes(&[(Vec3::new(0.0, 0.0, 0.5), Vec3::new(1.0, 1.0, 1.0))]);
    let (object, material) = (mesh.add_object("floor"), mesh.add_material("wood", [1.0; 4]));
    mesh.add_quad(object, material, [(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)].map(|(x, y)| Vec3::new(x, y, 0.01)));
    let grid = SdfGrid::build(&mesh, &options(0.1, 0.1, Some(0.0))).unwrap();
    let side = |p: Vec3| box_distance(p, Vec3::ZERO, Vec3::new(1.0, 1.0, 2.0));
    for p in [Vec3::new(2.0, 0.0, 0.05), Vec3::new(-1.0, 2.0, 0.0), Vec3::new(0.3, 0.1, 0.0), Vec3::new(0.0, 0.45, 0.5)] {
        assert!((grid.at(p) - side(p)).abs() < 0.02, "{p}: {} {}", grid.at(p), side(p));
    }
    assert!(grid.at(Vec3::new(0.0, 0.0, 0.8)) < -0.15);
    let counts = SdfGrid::build(&mesh, &options(0.1, 0.1, None)).unwrap();
    assert!((counts.at(Vec3::new(2.0, 0.0, 0.11)) - 0.1).abs() < 1e-3, "a floor that is not declared is an obstacle");
    // A floor alone is nothing.
    let mut alone = TriMesh::new();
    alone.add_object("floor");
    alone.add_material("wood", [1.0; 4]);
    alone.add_quad(0, 0, [Vec3::ZERO, Vec3::X, Vec3::ONE.with_z(0.0), Vec3::Y]);
    let message = SdfGrid::build(&alone, &options(0.1, 0.1, Some(0.0))).unwrap_err().to_string();
    assert!(message.contains("nothing but floor"), "{message}");
}

#[test]
fn a_sheet_encloses_nothing() {
    let mut mesh = TriMesh::new();
    mesh.add_object("screen");
    mesh.add_material("paper", [1.0; 4]);
    mesh.add_quad(0, 0, [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 0.0, 2.0), Vec3::Z * 2.0]);
    let grid = SdfGrid::build(&mesh, &options(0.1, 0.35, Some(0.0))).unwrap();
    for y in [-0.3, 0.3] {
        assert!((grid.at(Vec3::new(0.5, y, 1.0)) - 0.3).abs() < 1e-5);
    }
}

/// Values a + b x + c y + d z on a grid of unlike sides.
fn linear() -> SdfGrid {
    let mut grid = SdfGrid { lowest: Vec3::new(-1.0, 0.5, 0.0), voxel: 0.25, dims: [4, 3, 5], values: vec![0.0; 60] };
    let values: Vec<f32> = each(&grid).map(|(p, _)| 1.0 + p.dot(Vec3::new(0.5, -0.3, 0.2))).collect();
    grid.values = values;
    grid
}

#[test]
fn interpolation_by_hand() {
    let grid = linear();
    // Centres reach to (-0.25, 1, 1).
    assert_eq!(grid.highest(), Vec3::new(-0.25, 1.0, 1.0));
    for p in [grid.lowest, grid.highest(), Vec3::new(-0.6, 0.7, 0.33), Vec3::new(-0.3, 0.99, 0.02)] {
        assert!((grid.at(p) - (1.0 + p.dot(Vec3::new(0.5, -0.3, 0.2)))).abs() < 1e-6);
    }
    // 0.4 beyond the lowest corner along x and 0.3 along y, where the value is 1 - 0.5 - 0.15 = 0.35.
    let beyond = grid.at(grid.lowest - Vec3::new(0.4, 0.3, 0.0));
    assert!((beyond - 0.35f32.hypot(0.5)).abs() < 1e-6, "{beyond}");
    let mut below = grid.clone();
    below.values.iter_mut().for_each(|v| *v -= 1.0);
    assert!((below.at(grid.lowest - Vec3::X * 0.1) - (0.35 - 1.0 + 0.1)).abs() < 1e-6);
    assert!(grid.at(Vec3::NAN).is_nan() || grid.at(Vec3::NAN).is_finite());
}

#[test]
fn beyond_the_grid_it_stays_below_the_distance() {
    let (centre, size) = (Vec3::new(0.0, 0.0, 1.0), Vec3::new(0.6, 0.4, 2.0));
    let grid = SdfGrid::build(&boxes(&[(centre, size)]), &options(0.1, 0.2, None)).unwrap();
    for p in [Vec3::new(3.0, 1.0, 1.0), Vec3::new(-0.8, -0.7, 4.0), Vec3::new(0.1, 9.0, -2.0)] {
        let want = box_distance(p, centre, size);
        assert!(grid.at(p) <= want + 1e-5 && grid.at(p) > 0.8 * want, "{p}: {} {want}", grid.at(p));
    }
}

#[test]
fn threads_do_not_matter() {
    let mut options = options(0.13, 0.2, Some(0.0));
    options.free = vec![Vec3::new(0.0, 0.0, 1.0)];
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| SdfGrid::build(&room(), &options).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn files_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let grid = linear();
    grid.write(dir.path().join("grid.npz")).unwrap();
    assert_eq!(SdfGrid::read(dir.path().join("grid.npz")).unwrap(), grid);
    for name in ["cube.npz", "cube.pkl"] {
        grid.write_authors(dir.path().join(name)).unwrap();
        let cube = SdfGrid::read(dir.path().join(name)).unwrap();
        assert_eq!(cube.dims, [5; 3]);
        assert!((cube.lowest - grid.lowest).length() < 1e-6 && (cube.voxel - grid.voxel).abs() < 1e-7);
        for p in [grid.lowest, grid.highest(), Vec3::new(-0.6, 0.7, 0.33), Vec3::new(0.0, 1.5, 1.0)] {
            assert!((cube.at(p) - grid.at(p)).abs() < 1e-5, "{name} {p}");
        }
    }
}

#[test]
fn authors_look_up() {
    let golden = golden().authors;
    for name in ["authors.pkl", "authors.npz"] {
        let grid = SdfGrid::read(fixture(name)).unwrap();
        // Six samples over -1..1: the first centre is 1/6 of the half side within the face at 0.5 - 1 / 0.4.
        assert!((grid.lowest.x - (0.5 - 2.5 + 2.5 / 6.0)).abs() < 1e-5 && (grid.voxel - 5.0 / 6.0).abs() < 1e-6);
        for (p, want) in golden.points.chunks(3).zip(&golden.values) {
            let got = grid.at(Vec3::from_slice(p));
            assert!((got - want).abs() < 2e-5, "{name} {p:?}: {got} {want}");
        }
    }
}

#[test]
fn what_is_refused() {
    let mesh = boxes(&[(Vec3::ZERO, Vec3::ONE)]);
    let message = |mesh: &TriMesh, options: &SdfOptions| SdfGrid::build(mesh, options).unwrap_err().to_string();
    assert_eq!(message(&TriMesh::new(), &SdfOptions::default()), "the mesh has no triangles");
    assert!(message(&mesh, &options(0.0, 0.1, None)).contains("voxel = 0"));
    assert!(message(&mesh, &options(0.1, f32::NAN, None)).contains("margin = NaN"));
    assert!(message(&mesh, &options(1e-4, 0.1, None)).contains("take a larger voxel"));
    let free = SdfOptions { free: vec![Vec3::NAN], ..options(0.1, 0.1, None) };
    assert!(message(&mesh, &free).contains("free point"));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("grid.npz");
    let mut grid = linear();
    grid.write(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for (end, what) in [(0, "is no npz archive"), (bytes.len() / 2, "is no npz archive")] {
        let message = SdfGrid::parse(&path, &bytes[..end]).unwrap_err().to_string();
        assert!(message.contains(what) && message.contains("grid.npz"), "{message}");
    }
    grid.values[7] = f32::NAN;
    assert!(grid.write(&path).unwrap_err().to_string().contains("value 7"));
    let cells = SdfOptions::default().with_cells(&mesh, 128);
    assert_eq!(SdfGrid::build(&mesh, &SdfOptions { floor: None, ..cells }).unwrap().dims, [128; 3]);
}
