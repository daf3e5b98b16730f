//! Distances of all voxel centres, block by block: what may be nearest to a block is found once for all its voxels.

use super::SdfOptions;
use super::face::Face;
use super::tree::Tree;
use glam::Vec3;

/// Voxels along each side of a block; a power of two.
pub(super) const BLOCK: usize = 8;
/// With more triangles than these in reach of a block the tree is asked voxel by voxel.
const MANY: usize = 768;
/// Bounds are this much larger than they are, so that rounding does not make them the answer.
pub(super) const SLACK: f32 = 1.001;

/// A slab of a grid: [`BLOCK`] voxels or fewer along x, and all along y and z.
pub(super) struct Slab<'a> {
    pub tree: &'a Tree,
    pub options: &'a SdfOptions,
    /// Centre of its first voxel, metres.
    pub lowest: Vec3,
    pub dims: [usize; 3],
    pub values: &'a mut [f32],
}

/// Memory of one thread.
#[derive(Default)]
pub(super) struct Search {
    open: Vec<(f32, u32)>,
    triangles: Vec<u32>,
    faces: Vec<Face>,
    /// Numbers of faces, level under level of blocks.
    near: Vec<u32>,
    /// For each face of a level the squares of its distances from the middles of the eight parts of the block.
    squares: Vec<[f32; 8]>,
}

/// The centres of voxels `from..to`, of which there may be none.
struct Part {
    from: [usize; 3],
    to: [usize; 3],
    low: Vec3,
    high: Vec3,
}

impl Part {
    fn middle(&self) -> Vec3 {
        0.5 * (self.low + self.high)
    }

    fn radius(&self) -> f32 {
        0.5 * (self.high - self.low).length()
    }

    fn is_empty(&self) -> bool {
        (0..3).any(|axis| self.from[axis] >= self.to[axis])
    }
}

impl Slab<'_> {
    /// Fills in the distances to the triangles of the tree, without sign.
    pub fn fill(&mut self, search: &mut Search) {
        for j in (0..self.dims[1]).step_by(BLOCK) {
            for k in (0..self.dims[2]).step_by(BLOCK) {
                self.block([0, j, k], search);
            }
        }
    }

    fn part(&self, from: [usize; 3], size: usize) -> Part {
        let to = [0, 1, 2].map(|axis| (from[axis] + size).min(self.dims[axis]));
        let centre = |voxel: [usize; 3]| self.options.above_floor(self.lowest + self.options.voxel * Vec3::from(voxel.map(|i| i as f32)));
        Part { from, to, low: centre(from), high: centre(to.map(|i| i.saturating_sub(1))) }
    }

    fn value(&mut self, [i, j, k]: [usize; 3]) -> &mut f32 {
        &mut self.values[(i * self.dims[1] + j) * self.dims[2] + k]
    }

    fn block(&mut self, from: [usize; 3], search: &mut Search) {
        let part = self.part(from, BLOCK);
        let (square, nearest) = self.tree.nearest(part.middle(), 0, &mut search.open);
        search.triangles.clear();
        // No voxel of the block is farther from what is nearest to it than this.
        let reach = (square.sqrt() + part.radius()) * SLACK;
        if self.tree.within(part.low, part.high, reach, MANY, &mut search.triangles) {
            search.faces.clear();
            search.faces.extend(search.triangles.iter().map(|&t| Face::new(self.tree.triangle(t))));
            search.near.clear();
            search.near.extend(0..search.faces.len() as u32);
            self.descend(from, BLOCK, 0, search);
        } else {
            self.by_voxel(&part, nearest, search);
        }
    }

    /// Asks the tree for every voxel; what is nearest to one is a good guess for the next.
    fn by_voxel(&mut self, part: &Part, mut nearest: u32, search: &mut Search) {
        for i in part.from[0]..part.to[0] {
            for j in part.from[1]..part.to[1] {
                for k in part.from[2]..part.to[2] {
                    let p = self.part([i, j, k], 1).low;
                    let square;
                    (square, nearest) = self.tree.nearest(p, nearest, &mut search.open);
                    *self.value([i, j, k]) = square.sqrt();
                }
            }
        }
    }

    /// Fills the block of `size` voxels a side whose nearest faces are all in `search.near[start..]`.
    fn descend(&mut self, from: [usize; 3], size: usize, start: usize, search: &mut Search) {
        let half = size / 2;
        let corner = |k: usize| [from[0] + half * (k >> 2), from[1] + half * (k >> 1 & 1), from[2] + half * (k & 1)];
        let parts: [Part; 8] = std::array::from_fn(|k| self.part(corner(k), half));
        let middles = [0, 1, 2].map(|axis| std::array::from_fn(|k| parts[k].middle()[axis]));
        let (end, first) = (search.near.len(), search.squares.len());
        let mut nearest = [f32::INFINITY; 8];
        for &face in &search.near[start..end] {
            let squares = search.faces[face as usize].distances_squared(&middles);
            nearest = std::array::from_fn(|k| nearest[k].min(squares[k]));
            search.squares.push(squares);
        }
        for (k, part) in parts.iter().enumerate().filter(|(_, part)| !part.is_empty()) {
            if half == 1 {
                *self.value(part.from) = nearest[k].sqrt();
                continue;
            }
            let reach = (nearest[k].sqrt() + 2.0 * part.radius()) * SLACK;
            for n in 0..end - start {
                if search.squares[first + n][k] <= reach * reach {
                    search.near.push(search.near[start + n]);
                }
            }
            self.descend(part.from, half, end, search);
            search.near.truncate(end);
        }
        search.squares.truncate(first);
    }
}
