//! Bodies in obstacles and in each other, from their vertices in the world.

use crate::scene::{BoxObstacle, Polygon, Solid};
use glam::Vec3;

/// Width of the step of an occupancy, metres.
const SOFT: f32 = 0.01;
/// Beyond this from a surface an occupancy is less than 0.0001 from 0 or 1, which it counts as, metres.
const AWAY: f32 = 10.0 * SOFT;

/// Whether the floor projection of any vertex lies off the walkable area: in an obstacle's outline or beyond the walls.
pub fn meets_outline(vertices: &[Vec3], walkable: &Polygon) -> bool {
    vertices.iter().any(|v| !walkable.contains(v.truncate().as_dvec2()))
}

/// Depth of the deepest vertex, metres, from the vertices' distances, negative within obstacles; 0 where none is.
pub fn deepest(distances: &[f32]) -> f32 {
    distances.iter().fold(0.0, |deep, &d| f32::max(deep, -d))
}

/// Signed distance to a box that stands on the floor and reaches below it, metres: negative inside.
pub fn box_distance(b: &BoxObstacle, p: Vec3) -> f32 {
    let local = glam::Vec2::from_angle(-b.yaw).rotate(p.truncate() - b.centre).abs() - b.size / 2.0;
    let out = local.extend(p.z - b.height);
    out.max(Vec3::ZERO).length() + out.max_element().min(0.0)
}

/// How much of a body lies in another's.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Overlap {
    /// Number of vertices inside: those at which the winding number of the other's mesh is above a half.
    pub vertices: usize,
    /// Mean over the vertices of 1 / (1 + exp(d / 1 cm)), d the signed distance to the other's surface (negative inside): 0 for bodies
    /// apart, and for one vertex 0.5 on the other's surface. Smooth in [0, 1], as learned occupancy fields are.
    pub occupancy: f32,
}

/// How much of the body of these vertices lies in `other`.
///
/// Whether a vertex is inside is not asked for where one before it is, and no surface lies between them: it is nearer to that one than any
/// triangle.
pub fn overlap(vertices: &[Vec3], other: &Solid) -> Overlap {
    let (mut inside, mut sum) = (0, 0.0);
    let (mut last, mut clear, mut within) = (Vec3::ZERO, 0.0, false);
    for v in near(vertices, other, AWAY) {
        let distance = other.surface_distance(v, AWAY);
        if last.distance(v) >= clear {
            within = other.contains(v);
        }
        (last, clear) = (v, distance);
        inside += usize::from(within);
        sum += match (distance < AWAY, within) {
            (true, true) => 1.0 / (1.0 + (-distance / SOFT).exp()),
            (true, false) => 1.0 / (1.0 + (distance / SOFT).exp()),
            (false, within) => f32::from(within),
        };
    }
    Overlap { vertices: inside, occupancy: sum / vertices.len().max(1) as f32 }
}

/// Vertices within `margin` of the bounds of `other`.
fn near<'a>(vertices: &'a [Vec3], other: &Solid, margin: f32) -> impl Iterator<Item = Vec3> + 'a {
    let (low, high) = other.bounds();
    vertices.iter().copied().filter(move |v| v.cmpge(low - margin).all() && v.cmple(high + margin).all())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BETAS, BodyModel, PARAMS};
    use glam::{DVec2, Vec2};
    use serde_json::Value;

    fn square(half: f64) -> Vec<DVec2> {
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(DVec2::from).to_vec()
    }

    /// The cube from -h to h.
    fn cube(h: f32) -> Solid {
        let b = BoxObstacle { centre: Vec2::ZERO, size: Vec2::splat(2.0 * h), yaw: 0.0, height: 2.0 * h };
        let mesh = crate::render::Mesh::cuboid(b.centre, b.size / 2.0, b.yaw, b.height);
        let vertices: Vec<Vec3> = mesh.vertices.iter().map(|v| *v - Vec3::Z * h).collect();
        Solid::new(&vertices, &mesh.faces).unwrap()
    }

    #[test]
    fn outlines_and_depths_by_hand() {
        let floor = Polygon::new(square(3.0), vec![square(0.5)]).unwrap();
        let at = |x: f32| Vec3::new(x, 0.0, 1.7);
        assert!(!meets_outline(&[at(0.6), at(2.9)], &floor));
        assert!(meets_outline(&[at(0.6), at(0.4)], &floor) && meets_outline(&[at(3.1)], &floor));
        let b = BoxObstacle { centre: Vec2::new(1.0, 0.0), size: Vec2::new(1.0, 2.0), yaw: std::f32::consts::FRAC_PI_2, height: 2.0 };
        // Turned by a quarter: 2 m along x, 1 m along y.
        for (p, d) in [
            (Vec3::new(1.0, 0.0, 1.0), -0.5),
            (Vec3::new(1.0, 0.0, 1.9), -0.1),
            (Vec3::new(1.8, 0.1, 0.5), -0.2),
            (Vec3::new(2.3, 0.9, 0.5), 0.5),
            (Vec3::new(1.0, 0.0, 3.0), 1.0),
        ] {
            assert!((box_distance(&b, p) - d).abs() < 1e-6, "{p}: {}", box_distance(&b, p));
        }
        assert_eq!(deepest(&[-0.25, -1.25, 0.5]), 1.25);
        assert_eq!(deepest(&[1.0]), 0.0);
    }

    #[test]
    fn points_in_a_cube_by_hand() {
        let solid = cube(0.5);
        let points = [Vec3::ZERO, Vec3::new(0.45, 0.45, -0.45), Vec3::new(0.55, 0.0, 0.0), Vec3::new(3.0, 0.0, 0.0)];
        let got = overlap(&points, &solid);
        assert_eq!(got.vertices, 2);
        assert!((solid.distance(points[1]) + 0.05).abs() < 1e-6 && (solid.distance(points[2]) - 0.05).abs() < 1e-6);
        // 5 cm are five widths: 1 / (1 + e^-5) and 1 / (1 + e^5); deep inside 1; beyond 10 cm nothing.
        let want = (1.0 + 0.993_307 + 0.006_693) / 4.0;
        assert!((got.occupancy - want).abs() < 1e-5, "{got:?}");
        assert!((overlap(&[Vec3::new(0.5, 0.1, 0.1)], &solid).occupancy - 0.5).abs() < 1e-4);
    }

    /// Counts and distances by Open3D and trimesh: tests/tools/bodies/make.py.
    #[test]
    fn agrees_with_open3d_on_bodies() {
        let file: Value = serde_json::from_str(include_str!("../../tests/fixtures/bodies/inside.json")).unwrap();
        let numbers = |v: &Value| v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap() as f32).collect::<Vec<_>>();
        let model = BodyModel::embedded();
        let skin = |v: &Value| {
            let (params, betas) = (numbers(&v["params"]), numbers(&v["betas"]));
            assert_eq!((params.len(), betas.len()), (PARAMS, BETAS));
            let (shaped, mut out) = (model.shape(&betas), Vec::new());
            model.skin(&shaped, &shaped.pose(&params), &mut out);
            out
        };
        let cases = file.as_array().unwrap();
        assert!(cases.len() >= 4);
        for (i, case) in cases.iter().enumerate() {
            let (a, b) = (skin(&case["a"]), skin(&case["b"]));
            let solid = Solid::new(&b, model.faces()).unwrap();
            let got = overlap(&a, &solid);
            let inside = got.vertices;
            let want = case["inside"].as_u64().unwrap() as usize;
            // Vertices within rounding of the surface may go either way.
            assert!(inside.abs_diff(want) <= 1 + want / 500, "case {i}: {inside}, expected {want}");
            // Vertex by vertex, at any distance.
            let distances: Vec<f32> = a.iter().map(|&v| solid.distance(v)).collect();
            assert_eq!(inside, distances.iter().filter(|d| **d < 0.0).count(), "case {i}");
            let occupancy = distances.iter().map(|d| 1.0 / (1.0 + (d / SOFT).exp())).sum::<f32>() / a.len() as f32;
            assert!((got.occupancy - occupancy).abs() < 2e-5, "case {i}: {}, expected {occupancy}", got.occupancy);
            for p in case["points"].as_array().unwrap() {
                let p = numbers(p);
                let d = solid.distance(Vec3::new(p[0], p[1], p[2]));
                assert!((d - p[3]).abs() < 2e-5, "case {i}: {d}, expected {}", p[3]);
            }
        }
    }
}
