//! The inside of one mesh, asked point by point.

use super::tree::{Tree, Tri};
use crate::{Error, Result};
use glam::Vec3;
use std::cell::RefCell;
use std::sync::Arc;

/// Triangles that enclose a solid: a body, a piece of furniture.
#[derive(Clone)]
pub struct Solid {
    faces: Arc<[[u32; 3]]>,
    tree: Tree,
    low: Vec3,
    high: Vec3,
}

/// Scratch memory of a thread's questions.
#[derive(Default)]
struct Scratch {
    distances: Vec<(f32, u32)>,
    nodes: Vec<u32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

impl Solid {
    /// The solid within triangles that wind counter-clockwise as seen from outside; parts may overlap.
    ///
    /// Errors: no triangle, a corner that is no vertex, vertices that are not finite.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<Self> {
        let tree = Tree::new(triangles(vertices, faces)?);
        let (low, high) = bounds(vertices);
        Ok(Self { faces: faces.into(), tree, low, high })
    }

    /// The solid once its vertices have moved; faster than a new one, and questions are as fast where neighbours stay neighbours.
    ///
    /// Errors: as [`Solid::new`].
    pub fn moved(&self, vertices: &[Vec3]) -> Result<Self> {
        let mut tree = self.tree.clone();
        tree.fit(&triangles(vertices, &self.faces)?);
        let (low, high) = bounds(vertices);
        Ok(Self { faces: self.faces.clone(), tree, low, high })
    }

    /// Lower and upper corner of the bounds of the vertices.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        (self.low, self.high)
    }

    /// Whether the winding number at `p` is above a half.
    pub fn contains(&self, p: Vec3) -> bool {
        SCRATCH.with_borrow_mut(|s| self.tree.winding(p, &mut s.nodes) > 0.5)
    }

    /// Distance from `p` to the nearest triangle, metres, negative inside.
    pub fn distance(&self, p: Vec3) -> f32 {
        let distance = self.surface_distance(p, f32::INFINITY);
        if self.contains(p) { -distance } else { distance }
    }

    /// Distance from `p` to the nearest triangle, inside or outside, or `most` where that is less, metres.
    pub fn surface_distance(&self, p: Vec3, most: f32) -> f32 {
        SCRATCH.with_borrow_mut(|s| self.tree.distance_squared(p, most * most, &mut s.distances).sqrt()).min(most)
    }
}

fn triangles(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<Vec<Tri>> {
    if faces.is_empty() || vertices.iter().any(|v| !v.is_finite()) {
        return Err(Error::invalid("a solid needs triangles and finite vertices"));
    }
    let corner = |i: u32| vertices.get(i as usize).copied().ok_or_else(|| Error::invalid(format!("vertex {i} of {}", vertices.len())));
    faces.iter().map(|f| Ok(Tri([corner(f[0])?, corner(f[1])?, corner(f[2])?]))).collect()
}

fn bounds(vertices: &[Vec3]) -> (Vec3, Vec3) {
    vertices.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::tests::random_params;
    use crate::body::{BETAS, BodyModel};
    use rand::RngExt;

    #[test]
    fn what_is_no_solid_is_refused() {
        assert!(Solid::new(&[Vec3::ZERO], &[]).is_err());
        assert!(Solid::new(&[Vec3::ZERO], &[[0, 0, 1]]).err().unwrap().to_string().contains("vertex 1 of 1"));
        assert!(Solid::new(&[Vec3::NAN], &[[0, 0, 0]]).is_err());
        let one = Solid::new(&[Vec3::ZERO], &[[0, 0, 0]]).unwrap();
        assert!(one.moved(&[]).err().unwrap().to_string().contains("vertex 0 of 0"));
    }

    #[test]
    fn a_solid_that_has_moved_is_as_one_made_anew() {
        let model = BodyModel::embedded();
        let posed = |seed: u64| {
            let (body, mut out) = (model.shape(&[0.0; BETAS]), Vec::new());
            model.skin(&body, &body.pose(&random_params(seed)), &mut out);
            out
        };
        let (before, after) = (posed(1), posed(2));
        let want = Solid::new(&after, model.faces()).unwrap();
        let got = Solid::new(&before, model.faces()).unwrap().moved(&after).unwrap();
        let (low, high) = got.bounds();
        assert_eq!((low, high), want.bounds());
        let mut inside = 0;
        let mut rng = crate::rng::stream(1, "solid", 0);
        for _ in 0..2000 {
            let p = low + (high - low) * Vec3::from([0; 3].map(|_| rng.random_range(0.0..1.0)));
            let (a, b) = (got.distance(p), want.distance(p));
            assert!((a - b).abs() < 1e-5, "{p}: {a}, expected {b}");
            assert!((got.surface_distance(p, 0.1) - b.abs().min(0.1)).abs() < 1e-5);
            inside += usize::from(b < 0.0);
        }
        assert!(inside > 20, "{inside}");
    }
}
