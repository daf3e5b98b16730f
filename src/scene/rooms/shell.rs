//! Floor and walls of a room, with door openings.

use super::furniture::add_prism;
use crate::scene::TriMesh;
use crate::scene::rings::{ring_edges, segment_distance};
use glam::{DVec2, Vec3};

/// Thickness and height of walls, height of door openings, depth of the floor; metres.
const THICK: f64 = 0.12;
const WALL: f32 = 2.5;
const DOOR: f32 = 2.05;
const SLAB: f32 = 0.015;
/// Width of door openings, metres.
pub const DOOR_WIDTH: f64 = 0.9;

/// An opening in a wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Door {
    /// The wall, by the corner that it starts from.
    pub wall: usize,
    /// Middle of the opening, metres along the wall.
    pub at: f64,
}

/// The walls round a floor: a simple counter-clockwise ring with right angles, and openings.
#[derive(Clone, Debug, PartialEq)]
pub struct Shell {
    pub ring: Vec<DVec2>,
    pub doors: Vec<Door>,
}

impl Shell {
    /// A floor of `size` about the origin, less a box at each corner: lower left, lower right, upper right, upper left.
    pub fn with_cuts(size: DVec2, cuts: [DVec2; 4]) -> Self {
        let half = size / 2.0;
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(DVec2::from);
        let mut ring = Vec::new();
        for (i, (corner, cut)) in corners.into_iter().zip(cuts).enumerate() {
            let at = corner * half;
            if cut.min_element() <= 0.0 {
                ring.push(at);
                continue;
            }
            let inner = at - corner * cut;
            // Along the sides of the floor in turn: of even corners first up or down, then sideways.
            let bend = [DVec2::new(at.x, inner.y), inner, DVec2::new(inner.x, at.y)];
            ring.extend(if i % 2 == 0 { bend } else { [bend[2], bend[1], bend[0]] });
        }
        Self { ring, doors: Vec::new() }
    }

    /// Start, direction and length of wall `i`; the floor is on its left.
    pub fn wall(&self, i: usize) -> (DVec2, DVec2, f64) {
        let (a, b) = (self.ring[i], self.ring[(i + 1) % self.ring.len()]);
        (a, (b - a).normalize(), a.distance(b))
    }

    /// Both ends of a door on the inner side of its wall.
    pub fn opening(&self, door: &Door) -> [DVec2; 2] {
        let (a, along, _) = self.wall(door.wall);
        [a + along * (door.at - DOOR_WIDTH / 2.0), a + along * (door.at + DOOR_WIDTH / 2.0)]
    }

    /// Distance from `p` to the nearest wall.
    pub fn distance(&self, p: DVec2) -> f64 {
        ring_edges(&self.ring).map(|(a, b)| segment_distance(a, b, p)).fold(f64::INFINITY, f64::min)
    }

    /// The border of the floor: the ring with the thresholds of its doors.
    pub fn exterior(&self) -> Vec<DVec2> {
        let mut out = Vec::new();
        for i in 0..self.ring.len() {
            let (a, along, _) = self.wall(i);
            let outwards = -along.perp() * THICK;
            out.push(a);
            for [from, to] in self.doors_of(i).iter().map(|d| self.opening(d)) {
                out.extend([from, from + outwards, to + outwards, to]);
            }
        }
        out
    }

    /// Adds floor and walls to a mesh, the floor's surface at z = 0.
    pub fn add_to(&self, mesh: &mut TriMesh) {
        let floor = mesh.add_object("floor");
        let boards = mesh.add_material("floor", [0.72, 0.66, 0.57, 1.0]);
        add_prism(mesh, floor, boards, &self.exterior(), -SLAB, 0.0);
        let walls = mesh.add_object("wall");
        let plaster = mesh.add_material("wall", [0.42, 0.42, 0.41, 1.0]);
        let n = self.ring.len();
        for i in 0..n {
            let (a, along, length) = self.wall(i);
            // A wall takes the outer corner at its end and leaves an inner one to the next wall, so that none overlap.
            let left_turn = along.perp_dot(self.wall((i + 1) % n).1) > 0.0;
            let end = if left_turn { length + THICK } else { length - THICK };
            let mut piece = |from: f64, to: f64, low: f32| {
                let middle = a + along * ((from + to) / 2.0) - along.perp() * (THICK / 2.0);
                let size = Vec3::new((to - from) as f32, THICK as f32, WALL - low);
                let yaw = along.y.atan2(along.x) as f32;
                mesh.add_box(walls, plaster, middle.as_vec2().extend((low + WALL) / 2.0), size, yaw);
            };
            let mut from = 0.0;
            for door in self.doors_of(i) {
                piece(from, door.at - DOOR_WIDTH / 2.0, 0.0);
                from = door.at + DOOR_WIDTH / 2.0;
                piece(door.at - DOOR_WIDTH / 2.0, from, DOOR);
            }
            piece(from, end, 0.0);
        }
    }

    /// The doors of wall `i` in the order of the way along it.
    fn doors_of(&self, i: usize) -> Vec<Door> {
        let mut doors: Vec<Door> = self.doors.iter().filter(|d| d.wall == i).copied().collect();
        doors.sort_by(|p, q| p.at.total_cmp(&q.at));
        doors
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::rings::{crossing, signed_area};

    #[test]
    fn shells_by_hand() {
        // A 4 x 3 m floor without 1 x 1 m at the upper right, with a door in its lower wall.
        let cuts = [DVec2::ZERO, DVec2::ZERO, DVec2::ONE, DVec2::ZERO];
        let shell = Shell { doors: vec![Door { wall: 0, at: 1.0 }], ..Shell::with_cuts(DVec2::new(4.0, 3.0), cuts) };
        assert_eq!(shell.ring, [(-2.0, -1.5), (2.0, -1.5), (2.0, 0.5), (1.0, 0.5), (1.0, 1.5), (-2.0, 1.5)].map(DVec2::from));
        let exterior = shell.exterior();
        assert!((signed_area(&exterior) - (11.0 + 0.9 * 0.12)).abs() < 1e-12 && crossing(&[&exterior]).is_none());
        let mut mesh = TriMesh::new();
        shell.add_to(&mut mesh);
        mesh.check().unwrap();
        let volume: f64 =
            (0..mesh.triangles.len()).map(|i| mesh.corners(i).map(|v| v.as_dvec3())).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum();
        // Floor, and walls whose ring of thickness 0.12 has the area of the outer offset less the floor.
        let outer = 14.0 * 0.12 + 5.0 * 0.0144 - 0.0144;
        let want = (11.0 + 0.9 * 0.12) * 0.015 + outer * 2.5 - 0.9 * 0.12 * 2.05;
        assert!((volume - want).abs() < 1e-4, "{volume} {want}");
        assert_eq!(shell.distance(DVec2::new(0.0, 0.5)), 1.0);
    }

    #[test]
    fn every_cut_keeps_the_turn() {
        let size = DVec2::new(6.0, 5.0);
        for k in 0..16u32 {
            let cuts = std::array::from_fn(|i| if k >> i & 1 == 1 { DVec2::new(1.0, 2.0) } else { DVec2::ZERO });
            let ring = Shell::with_cuts(size, cuts).ring;
            assert!((signed_area(&ring) - (30.0 - 2.0 * f64::from(k.count_ones()))).abs() < 1e-12 && crossing(&[&ring]).is_none(), "{k}");
        }
    }
}
