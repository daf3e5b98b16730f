//! The inside of one mesh, asked point by point.

use super::tree::{Tree, Tri};
use crate::{Error, Result};
use glam::Vec3;
use std::cell::RefCell;

/// Triangles that enclose a solid: a body, a piece of furniture.
pub struct Solid {
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
        if faces.is_empty() || vertices.iter().any(|v| !v.is_finite()) {
            return Err(Error::invalid("a solid needs triangles and finite vertices"));
        }
        let corner = |i: u32| vertices.get(i as usize).copied().ok_or_else(|| Error::invalid(format!("vertex {i} of {}", vertices.len())));
        let tri = |f: &[u32; 3]| Ok(Tri([corner(f[0])?, corner(f[1])?, corner(f[2])?]));
        let tree = Tree::new(faces.iter().map(tri).collect::<Result<_>>()?);
        let (low, high) = vertices.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        Ok(Self { tree, low, high })
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
        let distance = SCRATCH.with_borrow_mut(|s| self.tree.distance_squared(p, f32::INFINITY, &mut s.distances).sqrt());
        if self.contains(p) { -distance } else { distance }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_solid_is_refused() {
        assert!(Solid::new(&[Vec3::ZERO], &[]).is_err());
        assert!(Solid::new(&[Vec3::ZERO], &[[0, 0, 1]]).err().unwrap().to_string().contains("vertex 1 of 1"));
        assert!(Solid::new(&[Vec3::NAN], &[[0, 0, 0]]).is_err());
    }
}
