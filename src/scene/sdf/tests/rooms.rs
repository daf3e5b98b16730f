//! Furniture and rooms against Open3D.

use super::super::*;
use super::{fixture, options};
use crate::scene::furniture::unpacked;
use crate::scene::mesh::{MeshOptions, read_mesh};
use crate::scene::{Grid, Polygon, RoomKind, Rooms, TriMesh, Walkable, WalkableOptions};
use glam::{Affine3A, Quat};
use serde::Deserialize;

#[derive(Deserialize)]
struct GoldenRoom {
    lowest: Vec3,
    voxel: f32,
    dims: [usize; 3],
    /// Of some of the values.
    numbers: Vec<usize>,
    values: Vec<f32>,
    free: Vec<Vec3>,
}

#[derive(Deserialize)]
struct Furnished {
    pieces: Vec<Placed>,
    #[serde(flatten)]
    grid: GoldenRoom,
}

/// A piece of furniture in the archive and where it stands.
#[derive(Deserialize)]
struct Placed {
    file: String,
    yaw: f32,
    at: Vec3,
}

/// A sofa of others where a procedural hall is freest: solid inside, nearer than what stood there, and no longer floor to walk on.
#[test]
fn furniture_of_others_in_a_room() {
    let Some(dir) = unpacked() else { return };
    let room = Rooms { kind: RoomKind::Hall, difficulty: 0.0 }.draw(5).unwrap();
    let layout = |floor: &Polygon| SdfOptions { voxel: 0.1, ..SdfOptions::for_floor(floor, 0.0).unwrap() };
    let bare = SdfGrid::build(&room.mesh, &layout(&room.walkable)).unwrap();
    let place = |i: usize| bare.centre(bare.voxel_of(i));
    let seat = |p: Vec3| (p.z - 0.3).abs() < 0.06 && room.walkable.contains(p.truncate().as_dvec2());
    let freest = (0..bare.values.len()).filter(|&i| seat(place(i))).max_by(|&a, &b| bare.values[a].total_cmp(&bare.values[b])).unwrap();
    let sofa = read_mesh(dir.path().join("scenes/sweethome3d_cc0/sofa/sofa.obj"), &MeshOptions::default()).unwrap().mesh;
    let (low, high) = sofa.bounds().unwrap();
    let (size, middle) = (high - low, 0.5 * (low + high));
    let at = place(freest).with_z(0.0) - middle.with_z(low.z);
    let mut mesh = room.mesh.clone();
    mesh.append(&sofa, Affine3A::from_translation(at));
    let walkable = |mesh: &TriMesh| Walkable::of_mesh(mesh, &WalkableOptions::default()).unwrap().polygon;
    let area = |mesh: &TriMesh| Grid::of_polygon(&walkable(mesh), 0.02).unwrap().area();
    let (lost, print) = (area(&room.mesh) - area(&mesh), f64::from(size.x * size.y));
    // It does not fill its bounds.
    assert!((0.5 * print..1.1 * print).contains(&lost), "{lost} of {print} m2");
    let full = SdfGrid::sample(&mesh, &layout(&walkable(&mesh)), bare.lowest, bare.dims).unwrap();
    let mut inside = 0;
    for (i, (&before, &now)) in bare.values.iter().zip(&full.values).enumerate() {
        let beside = (place(i) - (at + middle)).abs() - 0.5 * size;
        assert!(now <= before + 1e-5, "{}", place(i));
        let far = beside.max(Vec3::ZERO).length();
        assert!(far <= before.abs() || (now - before).abs() < 1e-5, "{}: {now} instead of {before}", place(i));
        assert!(now >= 0.0 || before < 0.0 || far == 0.0, "{} is inside", place(i));
        inside += usize::from(now < 0.0 && before >= 0.0);
    }
    assert!(inside > 30, "{inside} voxels inside the sofa");
}

/// Furniture of others on a floor that is a sheet; values as before.
#[test]
fn furniture_on_a_floor_as_open3d_has_it() {
    let Some(dir) = unpacked() else { return };
    let golden: Furnished = serde_json::from_slice(&std::fs::read(fixture("furnished.json")).unwrap()).unwrap();
    let mut mesh = TriMesh::new();
    let (object, material) = (mesh.add_object("floor"), mesh.add_material("wood", [1.0; 4]));
    mesh.add_quad(object, material, [(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)].map(|(x, y)| Vec3::new(x, y, 0.0)));
    for piece in &golden.pieces {
        let read = read_mesh(dir.path().join("scenes").join(&piece.file), &MeshOptions::default()).unwrap().mesh;
        mesh.append(&read, Affine3A::from_rotation_translation(Quat::from_rotation_z(piece.yaw), piece.at));
    }
    let golden = golden.grid;
    let options = SdfOptions { free: golden.free, ..options(golden.voxel, 0.2, Some(0.0)) };
    let grid = SdfGrid::sample(&mesh, &options, golden.lowest, golden.dims).unwrap();
    let (mut inside, mut nearer) = (0, 0);
    for (&i, &want) in golden.numbers.iter().zip(&golden.values) {
        let (got, p) = (grid.values[i], grid.centre(grid.voxel_of(i)));
        assert!((got < 0.0) == (want < 0.0) || want.abs() < 1e-5, "{p}: {got}, expected {want}");
        // Holes that are closed count as surface as well, so that no distance is larger.
        assert!(got.abs() <= want.abs() + 2e-5, "{p}: {got}, expected {want}");
        nearer += usize::from(got.abs() < want.abs() - 2e-5);
        inside += usize::from(want < 0.0);
    }
    println!("{} values, {inside} inside, {nearer} of them nearer to a hole", golden.numbers.len());
    assert!(inside > 30 && nearer < golden.numbers.len() / 20, "{nearer}");
}

/// Values by Open3D and summed-up solid angles: tests/tools/scenes/rooms.py.
#[test]
fn a_furnished_room_as_open3d_has_it() {
    let golden: GoldenRoom = serde_json::from_slice(&std::fs::read(fixture("rooms.json")).unwrap()).unwrap();
    let mesh = read_mesh(fixture("room.ply"), &MeshOptions::default()).unwrap().mesh;
    assert!(golden.free.is_empty());
    let closed = SdfGrid::build(&mesh, &options(golden.voxel, 0.2, Some(0.0))).unwrap();
    assert!(closed.dims == golden.dims && (closed.lowest - golden.lowest).length() < 1e-5);
    // With a sheet far below the room not all surfaces are closed, which is another way to the same signs.
    let mut open = mesh.clone();
    open.add_quad(0, 0, [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vec3::new(x, y, -9.0)));
    let open = SdfGrid::sample(&open, &options(golden.voxel, 0.2, Some(0.0)), closed.lowest, closed.dims).unwrap();
    for grid in [closed, open] {
        for (&i, &want) in golden.numbers.iter().zip(&golden.values) {
            let (got, p) = (grid.values[i], grid.centre(grid.voxel_of(i)));
            assert!((got - want).abs() < 1e-5, "{p}: {got}, expected {want}");
        }
    }
    assert!(golden.values.iter().filter(|v| **v < 0.0).count() > 40);
}
