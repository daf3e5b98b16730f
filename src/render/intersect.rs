//! A watertight ray-triangle test (Woop, Benthin and Wald, JCGT 2013).
//!
//! obvhs's own test leaks at edges that two triangles share: about one ray in eight that is aimed exactly at an edge slips through.

use glam::{Vec3, Vec3A};
use obvhs::{Boundable, aabb::Aabb};

/// A triangle of the tracer.
#[derive(Clone, Copy, Debug)]
pub struct Tri(pub [Vec3; 3]);

impl Boundable for Tri {
    /// The bounds, a little too large, so that rounding in the box test cannot lose a ray that the triangle test would keep.
    fn aabb(&self) -> Aabb {
        let points = self.0.map(Vec3A::from);
        let largest = points.iter().fold(0.0f32, |m, p| m.max(p.abs().max_element()));
        let mut aabb = Aabb::from_points(&points);
        let slack = Vec3A::splat(2e-6 * (1.0 + largest));
        aabb.min -= slack;
        aabb.max += slack;
        aabb
    }
}

/// A ray sheared so that it runs along the unit z axis: computed once per ray.
#[derive(Clone, Copy, Debug)]
pub struct Sheared {
    origin: Vec3,
    axes: [usize; 3],
    shear: Vec3,
}

impl Sheared {
    /// Prepares the ray `origin + t * direction`; the direction need not have unit length but must not be zero.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let z = direction.abs().max_position();
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        if direction[z] < 0.0 {
            (x, y) = (y, x);
        }
        Self { origin, axes: [x, y, z], shear: Vec3::new(direction[x], direction[y], 1.0) / direction[z] }
    }

    /// Distance along the ray, in lengths of its direction, and the weights of the three vertices; None for a miss.
    #[inline]
    pub fn hit(&self, tri: &Tri) -> Option<(f32, Vec3)> {
        let [a, b, c] = tri.0.map(|v| {
            let p = v - self.origin;
            let [x, y, z] = self.axes.map(|k| p[k]);
            Vec3::new(x - self.shear.x * z, y - self.shear.y * z, self.shear.z * z)
        });
        let mut w = Vec3::new(cross(b, c), cross(c, a), cross(a, b));
        if w.min_element() < 0.0 && w.max_element() > 0.0 {
            return None;
        }
        if w.x == 0.0 || w.y == 0.0 || w.z == 0.0 {
            // On an edge as far as f32 can tell: decide in f64, in which these products are exact.
            w = Vec3::new(cross64(b, c), cross64(c, a), cross64(a, b));
            if w.min_element() < 0.0 && w.max_element() > 0.0 {
                return None;
            }
        }
        let det = w.element_sum();
        let t = w.dot(Vec3::new(a.z, b.z, c.z)) / det;
        (det != 0.0 && t.is_finite()).then(|| (t, w / det))
    }
}

#[inline]
fn cross(a: Vec3, b: Vec3) -> f32 {
    b.x * a.y - b.y * a.x
}

fn cross64(a: Vec3, b: Vec3) -> f32 {
    (b.x as f64 * a.y as f64 - b.y as f64 * a.x as f64) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hit_by_hand() {
        // x + y + z = 1 seen along -z over (0.2, 0.3): z = 0.5; weights are the barycentric coordinates (0.2, 0.3, 0.5).
        let tri = Tri([Vec3::X, Vec3::Y, Vec3::Z]);
        let ray = Sheared::new(Vec3::new(0.2, 0.3, 2.5), Vec3::new(0.0, 0.0, -0.5));
        let (t, w) = ray.hit(&tri).unwrap();
        assert!((t - 4.0).abs() < 1e-6 && (w - Vec3::new(0.2, 0.3, 0.5)).length() < 1e-6);
        // Seen from behind as well, and missed beside it.
        let back = Sheared::new(Vec3::ZERO, Vec3::new(0.2, 0.3, 0.5));
        assert!((back.hit(&tri).unwrap().0 - 1.0).abs() < 1e-6);
        assert!(Sheared::new(Vec3::new(0.7, 0.4, 2.0), Vec3::NEG_Z).hit(&tri).is_none());
    }

    #[test]
    fn points_behind_the_origin_have_negative_distance() {
        let tri = Tri([Vec3::new(-1.0, -1.0, 1.0), Vec3::new(1.0, -1.0, 1.0), Vec3::new(0.0, 1.0, 1.0)]);
        assert!((Sheared::new(Vec3::ZERO, Vec3::NEG_Z).hit(&tri).unwrap().0 + 1.0).abs() < 1e-6);
    }
}
