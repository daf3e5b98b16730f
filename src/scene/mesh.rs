//! Triangle meshes of rooms and what stands in them.

mod gltf;
mod import;
mod obj;
mod ply;

pub(crate) use import::Format;
pub use import::{Imported, MAX_TRIANGLES, MeshOptions, Up, read_mesh};

use crate::{Error, Result};
use glam::{Affine3A, Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// What a surface looks like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Material {
    pub name: String,
    /// Linear red, green and blue and opacity, each 0 to 1.
    pub color: [f32; 4],
}

/// A triangle mesh of several objects in the world: metres, z up, outward normals by counter-clockwise order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Positions, metres.
    pub vertices: Vec<Vec3>,
    /// Numbers of the three vertices of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Of each triangle: which of `objects` it belongs to.
    pub object: Vec<u16>,
    /// Of each triangle: which of `materials` it has.
    pub material: Vec<u16>,
    /// Names of the objects; two may have the same.
    pub objects: Vec<String>,
    pub materials: Vec<Material>,
}

impl TriMesh {
    /// A mesh without anything.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds an object without triangles and says its number. A mesh has at most 65,536; the last stands for all that follow.
    pub fn add_object(&mut self, name: &str) -> u16 {
        if self.objects.len() <= usize::from(u16::MAX) {
            self.objects.push(name.into());
        }
        (self.objects.len() - 1) as u16
    }

    /// The number of a material, which is added unless the mesh has it. At most 65,536, as for objects.
    pub fn add_material(&mut self, name: &str, color: [f32; 4]) -> u16 {
        let known = self.materials.iter().position(|m| m.name == name && m.color == color);
        if known.is_none() && self.materials.len() <= usize::from(u16::MAX) {
            self.materials.push(Material { name: name.into(), color });
        }
        known.unwrap_or(self.materials.len() - 1) as u16
    }

    /// Adds a closed box with sides `size` along its own axes, turned by `yaw` radians about z: 8 vertices, 12 triangles.
    pub fn add_box(&mut self, object: u16, material: u16, centre: Vec3, size: Vec3, yaw: f32) {
        const SIDES: [[u32; 4]; 6] = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
        let first = self.vertices.len() as u32;
        let turn = Vec2::from_angle(yaw);
        for z in [-0.5, 0.5] {
            for (x, y) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
                self.vertices.push(centre + turn.rotate(Vec2::new(x, y) * size.truncate()).extend(z * size.z));
            }
        }
        for [a, b, c, d] in SIDES.map(|side| side.map(|i| first + i)) {
            self.push([a, b, c], object, material);
            self.push([a, c, d], object, material);
        }
    }

    /// Adds a flat four-sided face, seen counter-clockwise from its outer side: 4 vertices, 2 triangles.
    pub fn add_quad(&mut self, object: u16, material: u16, corners: [Vec3; 4]) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(corners);
        self.push([first, first + 1, first + 2], object, material);
        self.push([first, first + 2, first + 3], object, material);
    }

    /// Adds one triangle of vertices that are there.
    pub fn push(&mut self, triangle: [u32; 3], object: u16, material: u16) {
        self.triangles.push(triangle);
        self.object.push(object);
        self.material.push(material);
    }

    /// Adds all of `other`, moved by `place`; its objects become new ones, equal materials are shared. A mirroring `place` turns the
    /// triangles round, so that they still face outwards. `other` must pass [`TriMesh::check`].
    pub fn append(&mut self, other: &Self, place: Affine3A) {
        let first = self.vertices.len() as u32;
        let mirrored = place.matrix3.determinant() < 0.0;
        let objects: Vec<u16> = other.objects.iter().map(|name| self.add_object(name)).collect();
        let materials: Vec<u16> = other.materials.iter().map(|m| self.add_material(&m.name, m.color)).collect();
        self.vertices.extend(other.vertices.iter().map(|&v| place.transform_point3(v)));
        for ((t, &o), &m) in other.triangles.iter().zip(&other.object).zip(&other.material) {
            let [a, b, c] = t.map(|i| first + i);
            self.push(if mirrored { [a, c, b] } else { [a, b, c] }, objects[usize::from(o)], materials[usize::from(m)]);
        }
    }

    /// The corners of triangle `i`, metres.
    pub fn corners(&self, i: usize) -> [Vec3; 3] {
        self.triangles[i].map(|v| self.vertices[v as usize])
    }

    /// The lowest and the highest coordinates of the vertices that triangles use, metres; None without triangles.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        let mut used = self.triangles.as_flattened().iter().map(|&i| self.vertices[i as usize]);
        let first = used.next()?;
        Some(used.fold((first, first), |(low, high), v| (low.min(v), high.max(v))))
    }

    /// The sum of the triangles' areas, square metres.
    pub fn area(&self) -> f32 {
        (0..self.triangles.len()).map(|i| self.triangle_area(i)).sum::<f64>() as f32
    }

    fn triangle_area(&self, i: usize) -> f64 {
        let [a, b, c] = self.corners(i).map(|v| v.as_dvec3());
        (b - a).cross(c - a).length() / 2.0
    }

    /// Refuses a mesh without triangles, positions that are not finite, and numbers of vertices, objects or materials that it has not.
    pub fn check(&self) -> Result<()> {
        let n = self.triangles.len();
        if n == 0 {
            return Err(Error::invalid("the mesh has no triangles"));
        }
        if self.object.len() != n || self.material.len() != n {
            let (objects, materials) = (self.object.len(), self.material.len());
            return Err(Error::invalid(format!(
                "the mesh has {n} triangles, but {objects} numbers of objects and {materials} of materials"
            )));
        }
        if let Some(i) = self.vertices.iter().position(|v| !v.is_finite()) {
            return Err(Error::invalid(format!("vertex {i} of the mesh is {}, expected finite metres", self.vertices[i])));
        }
        let below = |what: &str, i: usize, number: usize, limit: usize| match number < limit {
            true => Ok(()),
            false => Err(Error::invalid(format!("triangle {i} of the mesh names {what} {number}, but there are {limit}"))),
        };
        for (i, t) in self.triangles.iter().enumerate() {
            t.iter().try_for_each(|&v| below("vertex", i, v as usize, self.vertices.len()))?;
            below("object", i, self.object[i].into(), self.objects.len())?;
            below("material", i, self.material[i].into(), self.materials.len())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_box(yaw: f32) -> TriMesh {
        let mut mesh = TriMesh::new();
        let (object, material) = (mesh.add_object("box"), mesh.add_material("red", [1.0, 0.0, 0.0, 1.0]));
        mesh.add_box(object, material, Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 2.0, 1.0), yaw);
        mesh
    }

    /// Six times the volume is the sum of the corners' triple products; positive when normals point outwards.
    fn volume(mesh: &TriMesh) -> f32 {
        (0..mesh.triangles.len()).map(|i| mesh.corners(i)).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
    }

    #[test]
    fn box_by_hand() {
        let mesh = one_box(std::f32::consts::FRAC_PI_2);
        mesh.check().unwrap();
        // Sides (4, 2, 1) turned by a right angle: (2, 4, 1) about (1, 2, 3); area 2 (8 + 4 + 2), volume 8.
        let (low, high) = mesh.bounds().unwrap();
        assert!((low - Vec3::new(0.0, 0.0, 2.5)).length() < 1e-5 && (high - Vec3::new(2.0, 4.0, 3.5)).length() < 1e-5, "{low} {high}");
        assert!((mesh.area() - 28.0).abs() < 1e-4 && (volume(&mesh) - 8.0).abs() < 1e-4);
    }

    #[test]
    fn quad_faces_the_side_that_sees_it_counter_clockwise() {
        let mut mesh = TriMesh::new();
        let (object, material) = (mesh.add_object("floor"), mesh.add_material("grey", [0.5; 4]));
        mesh.add_quad(object, material, [Vec3::ZERO, Vec3::X * 2.0, Vec3::new(2.0, 3.0, 0.0), Vec3::Y * 3.0]);
        let [a, b, c] = mesh.corners(1);
        assert_eq!(((b - a).cross(c - a).normalize(), mesh.area()), (Vec3::Z, 6.0));
    }

    #[test]
    fn appended_parts_share_materials_and_keep_their_outside() {
        let mut all = one_box(0.0);
        // Half as large, mirrored in x, 10 m up: volume 8 / 8, and still positive.
        all.append(&one_box(0.0), Affine3A::from_translation(Vec3::Z * 10.0) * Affine3A::from_scale(Vec3::new(-0.5, 0.5, 0.5)));
        all.check().unwrap();
        assert_eq!((all.objects.len(), all.materials.len(), all.object[12], all.material[12]), (2, 1, 1, 0));
        assert!((volume(&all) - 9.0).abs() < 1e-4);
        assert!((all.bounds().unwrap().1.z - (10.0 + 1.75)).abs() < 1e-5);
    }

    #[test]
    fn what_check_refuses() {
        let message = |change: fn(&mut TriMesh)| {
            let mut mesh = one_box(0.0);
            change(&mut mesh);
            mesh.check().unwrap_err().to_string()
        };
        assert_eq!(TriMesh::new().check().unwrap_err().to_string(), "the mesh has no triangles");
        assert_eq!(message(|m| m.triangles[3][1] = 8), "triangle 3 of the mesh names vertex 8, but there are 8");
        assert_eq!(message(|m| m.object[0] = 1), "triangle 0 of the mesh names object 1, but there are 1");
        assert_eq!(message(|m| m.material[11] = 7), "triangle 11 of the mesh names material 7, but there are 1");
        assert_eq!(message(|m| m.vertices[2].y = f32::NAN), "vertex 2 of the mesh is [3, NaN, 2.5], expected finite metres");
        assert!(message(|m| m.object.truncate(5)).contains("12 triangles, but 5 numbers of objects"));
        assert!(TriMesh::new().bounds().is_none());
    }
}
