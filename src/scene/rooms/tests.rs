use super::super::rings::{crossing, signed_area};
use super::super::{Grid, Navigator, PairOptions, Walkable, WalkableOptions};
use super::*;
use glam::Vec3;

const KINDS: [RoomKind; 4] = [RoomKind::Box, RoomKind::Furnished, RoomKind::Corridor, RoomKind::Hall];

fn rooms(count: u64) -> impl Iterator<Item = Room> {
    let draw = move |kind| (0..count).map(move |s| Rooms { kind, difficulty: s as f32 / (count - 1) as f32 }.draw(s).unwrap());
    KINDS.into_iter().flat_map(draw)
}

/// Volume within a mesh of closed parts that face outwards.
fn volume(mesh: &TriMesh) -> f64 {
    let signed = |[a, b, c]: [Vec3; 3]| a.as_dvec3().dot(b.as_dvec3().cross(c.as_dvec3())) / 6.0;
    (0..mesh.triangles.len()).map(|i| signed(mesh.corners(i))).sum()
}

/// Cells on which a person of this radius can stand.
fn standing(walkable: &Polygon, radius: f64) -> Grid {
    let mut grid = Grid::of_polygon(walkable, 0.1).unwrap();
    for k in 0..grid.cells.len() {
        let p = grid.centre(k % grid.dims[0], k / grid.dims[0]);
        grid.cells[k] &= walkable.border_distance(p) >= radius;
    }
    grid
}

#[test]
fn hundreds_of_different_rooms_that_hang_together() {
    let mut seen = std::collections::BTreeSet::new();
    for room in rooms(60) {
        room.mesh.check().unwrap();
        assert!(crossing(&[room.walkable.exterior()]).is_none() && volume(&room.mesh) > 0.0, "{}", room.name);
        let floor = Polygon::new(room.walkable.exterior().to_vec(), vec![]).unwrap();
        assert!(room.walkable.holes().iter().flatten().all(|&p| floor.contains(p)), "{}: a piece stands in a wall", room.name);
        let free = standing(&room.walkable, 0.3);
        let main = free.largest_part().unwrap().area();
        assert!(main >= 0.9 * free.area() && main > 2.0, "{}: {main} of {} m2", room.name, free.area());
        assert!(seen.insert(format!("{:?}", room.walkable)), "{} is not new", room.name);
    }
    assert_eq!(seen.len(), 240);
}

#[test]
fn the_same_seed_gives_the_same_room() {
    for kind in KINDS {
        let rooms = Rooms { kind, ..Default::default() };
        assert_eq!(rooms.draw(7).unwrap(), rooms.draw(7).unwrap());
        assert!(rooms.draw(7).unwrap().mesh != rooms.draw(8).unwrap().mesh);
    }
    let parts = [Split::Train, Split::Validation, Split::Test].map(Split::seeds);
    assert!(parts.windows(2).all(|p| p[0].end <= p[1].start) && parts.iter().all(|p| p.end - p.start >= 100_000));
}

#[test]
fn difficulty_takes_floor() {
    let share = |difficulty: f32| -> f64 {
        let taken = (0..30).map(|s| Rooms { kind: RoomKind::Furnished, difficulty }.draw(s).unwrap().walkable);
        taken.map(|w| 1.0 - Grid::of_polygon(&w, 0.05).unwrap().area() / signed_area(w.exterior())).sum::<f64>() / 30.0
    };
    let [easy, hard] = [share(0.0), share(1.0)];
    assert!(easy > 0.05 && hard > easy + 0.08 && hard < 0.5, "{easy} {hard}");
    assert!(Rooms { difficulty: 1.5, ..Default::default() }.draw(0).unwrap_err().to_string().contains("rooms.difficulty"));
}

#[test]
fn the_exact_area_is_that_of_the_mesh() {
    for room in rooms(8) {
        let found = Walkable::of_mesh(&room.mesh, &WalkableOptions::default()).unwrap();
        assert!(found.floor.abs() < 1e-3, "{}: floor at {}", room.name, found.floor);
        // Where a person of 10 cm can stand by the boxes, the mesh is free; where the mesh is free, so are the boxes.
        let exact = standing(&room.walkable, 0.1).largest_part().unwrap();
        for k in 0..exact.cells.len() {
            let p = exact.centre(k % exact.dims[0], k / exact.dims[0]);
            assert!(!exact.cells[k] || found.polygon.contains(p), "{}: {p} is walkable by the boxes alone", room.name);
            let by_mesh = found.polygon.contains(p) && found.polygon.border_distance(p) > 0.02;
            assert!(!by_mesh || room.walkable.contains(p), "{}: {p} is walkable by the mesh alone", room.name);
        }
    }
}

#[test]
fn pairs_like_the_papers_are_found() {
    for room in rooms(6).filter(|r| !r.name.starts_with("box")) {
        let navigator = Navigator::new(&room.walkable, 0.22).unwrap();
        let pairs = PairOptions { count: 40, ..Default::default() }.draw(&navigator, 1);
        let pairs = pairs.unwrap_or_else(|e| panic!("{}: {e}", room.name));
        assert!(pairs.iter().all(|p| p.way >= 1.49), "{}", room.name);
        assert!(pairs.iter().filter(|p| p.blocked).count() >= 30, "{}", room.name);
    }
}
