//! Distances from points to a triangle, several points at once and without branches, so that they become vector instructions.

use super::tree::Tri;
use glam::Vec3;

/// A triangle, ready to be asked for distances.
#[derive(Clone, Debug)]
pub(super) struct Face {
    corners: [Vec3; 3],
    /// From each corner to the next, and 1 over the square of its length; 0 where they are the same.
    edges: [(Vec3, f32); 3],
    /// Across each edge within the plane, towards the inside; 0 for a triangle without area.
    inwards: [Vec3; 3],
    normal: Vec3,
}

impl Face {
    pub fn new(&Tri(corners): &Tri) -> Self {
        let [a, b, c] = corners.map(|v| v.as_dvec3());
        let normal = (b - a).cross(c - a).try_normalize().unwrap_or_default().as_vec3();
        let edges = [0, 1, 2].map(|i| {
            let edge = corners[(i + 1) % 3] - corners[i];
            let squared = edge.length_squared();
            (edge, if squared > 0.0 { squared.recip() } else { 0.0 })
        });
        Self { corners, edges, inwards: edges.map(|(edge, _)| normal.cross(edge)), normal }
    }

    /// Squares of the distances from the points of these coordinates x, y and z: to the plane where a point lies over the inside, else to
    /// the nearest edge.
    pub fn distances_squared<const N: usize>(&self, [x, y, z]: &[[f32; N]; 3]) -> [f32; N] {
        let (mut across, mut inside) = ([f32::INFINITY; N], [f32::INFINITY; N]);
        for ((&corner, &(edge, inverse)), &inwards) in self.corners.iter().zip(&self.edges).zip(&self.inwards) {
            for k in 0..N {
                let q = Vec3::new(x[k], y[k], z[k]) - corner;
                let t = (q.dot(edge) * inverse).clamp(0.0, 1.0);
                across[k] = across[k].min((q - edge * t).length_squared());
                inside[k] = inside[k].min(q.dot(inwards));
            }
        }
        std::array::from_fn(|k| {
            let above = (Vec3::new(x[k], y[k], z[k]) - self.corners[0]).dot(self.normal);
            if inside[k] > 0.0 { above * above } else { across[k] }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tree::nearest;
    use super::*;
    use crate::rng::stream;
    use rand::RngExt;

    #[test]
    fn as_one_by_one() {
        let rng = &mut stream(1, "faces", 0);
        let mut point = |size: f32| Vec3::from([0; 3].map(|_| rng.random_range(-size..size)));
        let mut cases: Vec<Tri> = (0..200).map(|_| Tri([0; 3].map(|_| point(2.0)))).collect();
        // Without area: a point, and three in a line.
        cases.extend([Tri([Vec3::X; 3]), Tri([Vec3::ZERO, Vec3::X, Vec3::X * 2.0])]);
        for triangle in cases {
            let points: [Vec3; 64] = std::array::from_fn(|_| point(4.0));
            let got = Face::new(&triangle).distances_squared(&[0, 1, 2].map(|axis| points.map(|p| p[axis])));
            for (p, got) in points.into_iter().zip(got) {
                let want = p.distance(nearest(p, &triangle));
                assert!((got.sqrt() - want).abs() < 2e-6, "{triangle:?} {p}: {} {want}", got.sqrt());
            }
        }
    }
}
