//! Triangle meshes of the things that are drawn.

use glam::{Vec2, Vec3};
use std::collections::BTreeMap;

/// A triangle mesh; faces wind counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions, metres.
    pub vertices: Vec<Vec3>,
    /// Vertex indices of each triangle.
    pub faces: Vec<[u32; 3]>,
}

impl Mesh {
    /// An upright box standing on the floor: `centre` and `half` sides in the plane, turned by `yaw`, `height` metres tall.
    pub fn cuboid(centre: Vec2, half: Vec2, yaw: f32, height: f32) -> Self {
        let (x, y) = (Vec2::from_angle(yaw) * half.x, Vec2::from_angle(yaw).perp() * half.y);
        let floor = [centre - x - y, centre + x - y, centre + x + y, centre - x + y];
        let vertices = floor.iter().map(|p| p.extend(0.0)).chain(floor.iter().map(|p| p.extend(height))).collect();
        let quads = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
        let faces = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Self { vertices, faces }
    }

    /// A sphere: an octahedron with every triangle split in four `levels` times (8 * 4^levels triangles).
    pub fn sphere(centre: Vec3, radius: f32, levels: u32) -> Self {
        let mut unit = vec![Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        let mut faces: Vec<[u32; 3]> = (0..4).flat_map(|i| [[i, (i + 1) % 4, 4], [(i + 1) % 4, i, 5]]).collect();
        for _ in 0..levels {
            let mut middles = BTreeMap::new();
            let mut middle = |a: u32, b: u32| {
                *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    unit.push((unit[a as usize] + unit[b as usize]).normalize());
                    unit.len() as u32 - 1
                })
            };
            faces = faces
                .iter()
                .flat_map(|&[a, b, c]| {
                    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
                })
                .collect();
        }
        Self { vertices: unit.iter().map(|v| centre + radius * v).collect(), faces }
    }

    /// A six-sided tube of `radius` along a line of points, open at both ends; empty for fewer than two points.
    pub fn tube(points: &[Vec3], radius: f32) -> Self {
        const SIDES: u32 = 6;
        if points.len() < 2 {
            return Self::default();
        }
        let mut mesh = Self::default();
        for (i, &p) in points.iter().enumerate() {
            let along = points[(i + 1).min(points.len() - 1)] - points[i.saturating_sub(1)];
            let (u, v) = along.try_normalize().unwrap_or(Vec3::X).any_orthonormal_pair();
            for k in 0..SIDES {
                let (sin, cos) = (k as f32 * std::f32::consts::TAU / SIDES as f32).sin_cos();
                mesh.vertices.push(p + radius * (cos * u + sin * v));
            }
        }
        for i in 0..points.len() as u32 - 1 {
            for k in 0..SIDES {
                let (a, b) = (i * SIDES + k, i * SIDES + (k + 1) % SIDES);
                mesh.faces.extend([[a, b, b + SIDES], [a, b + SIDES, a + SIDES]]);
            }
        }
        mesh
    }

    /// Appends another mesh.
    pub fn append(&mut self, other: &Self) {
        let first = self.vertices.len() as u32;
        self.vertices.extend_from_slice(&other.vertices);
        self.faces.extend(other.faces.iter().map(|f| f.map(|i| i + first)));
    }

    /// Area-weighted unit normals of the vertices; z for a vertex without area.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO; self.vertices.len()];
        for &face in &self.faces {
            let [a, b, c] = face.map(|i| self.vertices[i as usize]);
            let area = (b - a).cross(c - a);
            face.iter().for_each(|&i| sums[i as usize] += area);
        }
        sums.iter().map(|s| s.try_normalize().unwrap_or(Vec3::Z)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every edge of a closed, consistently wound mesh is walked once in each direction.
    fn closed(mesh: &Mesh) -> bool {
        let mut edges = BTreeMap::new();
        for f in &mesh.faces {
            for k in 0..3 {
                *edges.entry((f[k], f[(k + 1) % 3])).or_insert(0) += 1;
            }
        }
        edges.iter().all(|(&(a, b), &n)| n == 1 && edges.get(&(b, a)) == Some(&1))
    }

    fn volume(mesh: &Mesh) -> f32 {
        mesh.faces.iter().map(|f| f.map(|i| mesh.vertices[i as usize])).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
    }

    #[test]
    fn solids_are_closed_and_face_outwards() {
        let cuboid = Mesh::cuboid(Vec2::new(3.0, -2.0), Vec2::new(0.5, 0.25), 0.7, 1.2);
        assert!(closed(&cuboid));
        assert!((volume(&cuboid) - 1.0 * 0.5 * 1.2).abs() < 1e-4);
        let sphere = Mesh::sphere(Vec3::new(1.0, 2.0, 3.0), 0.5, 4);
        assert!(closed(&sphere) && sphere.faces.len() == 8 * 256);
        assert!((volume(&sphere) / (4.0 / 3.0 * std::f32::consts::PI * 0.125) - 1.0).abs() < 0.01);
    }

    #[test]
    fn box_corners_turn_with_the_yaw() {
        let b = Mesh::cuboid(Vec2::new(1.0, 1.0), Vec2::new(2.0, 1.0), std::f32::consts::FRAC_PI_2, 0.5);
        // Half sides (2, 1) turned by 90 degrees span x 0..2 and y -1..3.
        let (low, high) = b.vertices.iter().fold((Vec3::MAX, Vec3::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        assert!((low - Vec3::new(0.0, -1.0, 0.0)).length() < 1e-5 && (high - Vec3::new(2.0, 3.0, 0.5)).length() < 1e-5);
    }

    #[test]
    fn normals_of_a_sphere_point_out() {
        let s = Mesh::sphere(Vec3::ZERO, 2.0, 3);
        assert!(s.normals().iter().zip(&s.vertices).all(|(n, v)| n.dot(*v) > 1.99));
        let tube = Mesh::tube(&[Vec3::ZERO, Vec3::X, Vec3::X * 2.0], 0.1);
        assert!(tube.normals().iter().zip(&tube.vertices).all(|(n, v)| n.dot(Vec3::new(0.0, v.y, v.z)) > 0.0));
    }
}
