//! What is within obstacles, by winding numbers.

use super::SdfGrid;
use super::blocks::SLACK;
use super::build::{FLOOR, SdfOptions};
use super::tree::{Tree, Tri};
use glam::Vec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// All surfaces of a mesh: those that are closed, whose winding numbers are whole and change at surfaces alone, and the others.
pub(super) struct Surfaces {
    closed: Option<Tree>,
    open: Option<Tree>,
}

impl Surfaces {
    pub fn new(triangles: Vec<Tri>) -> Self {
        let tree = |part: Vec<Tri>| (!part.is_empty()).then(|| Tree::new(part));
        let (closed, open) = divide(triangles);
        let (closed, open) = rayon::join(|| tree(closed), || tree(open));
        Self { closed, open }
    }

    /// Whether all surfaces are closed.
    pub fn are_closed(&self) -> bool {
        self.open.is_none()
    }

    /// By how much the winding number of each centre of the grid, which holds the distances to obstacles without sign, is more than a half
    /// away from that of free space: above 0 within obstacles.
    pub fn excess(&self, grid: &SdfGrid, options: &SdfOptions) -> Vec<f32> {
        let free = self.free(options);
        let mut out = vec![0.0; grid.values.len()];
        if let Some(tree) = &self.closed {
            parts(grid, |part| {
                // Where the part is farthest from surfaces the number is most exact.
                let farther = |p: u32, q: u32| if grid.values[q as usize] > grid.values[p as usize] { q } else { p };
                let at = part.iter().copied().reduce(farther).unwrap_or(0) as usize;
                let winding = tree.winding(options.above_floor(grid.centre(grid.voxel_of(at))), &mut Vec::new()).round();
                part.iter().for_each(|&k| out[k as usize] = winding);
            });
        }
        match &self.open {
            Some(tree) => add_open(tree, free, grid, options, &mut out),
            None => out.par_iter_mut().for_each(|v| *v = (*v - free).abs() - 0.5),
        }
        out
    }

    /// The winding number of free space: the median of those of points in it.
    fn free(&self, options: &SdfOptions) -> f32 {
        let open = &mut Vec::new();
        let mut winding = |p: Vec3| {
            let closed = self.closed.as_ref().map_or(0.0, |tree| tree.winding(p, open).round());
            closed + self.open.as_ref().map_or(0.0, |tree| tree.winding(p, open))
        };
        let mut numbers: Vec<f32> = options.free.iter().map(|&p| winding(options.above_floor(p))).collect();
        numbers.sort_by(f32::total_cmp);
        numbers.get(numbers.len() / 2).copied().unwrap_or(0.0)
    }
}

/// Adds the winding numbers of open surfaces to those in `out`, row by row, and makes them what [`Surfaces::excess`] gives.
///
/// Away from surfaces winding numbers are harmonic. In a ball of radius d without a surface, within which they lie between two whole
/// numbers, they are at rho d from its middle at most (1 + rho) / (1 - rho)^2 times as far from either as there (Harnack). As long as
/// that keeps them on one side of the half, they are not asked for again.
fn add_open(tree: &Tree, free: f32, grid: &SdfGrid, options: &SdfOptions, out: &mut [f32]) {
    let [_, ny, nz] = grid.dims;
    out.par_chunks_mut(nz).enumerate().for_each_init(Vec::new, |open, (row, out)| {
        let mut k = 0;
        while k < nz {
            let p = options.above_floor(grid.centre([row / ny, row % ny, k]));
            let winding = out[k] + tree.winding(p, open) - free;
            // The floor is a surface too, though no obstacle.
            let above = options.floor.map_or(f32::INFINITY, |floor| p.z - floor - FLOOR);
            let ball = grid.values[row * nz + k].min(above);
            let times = 0.45 / (winding - winding.round()).abs().max(0.01);
            let share = if times > 1.0 { (2.0 * times + 1.0 - (8.0 * times + 1.0).sqrt()) / (2.0 * times) } else { 0.0 };
            let end = nz.min(k + 1 + (share * ball / grid.voxel) as usize);
            out[k..end].fill(winding.abs() - 0.5);
            k = end;
        }
    });
}

/// Shows the voxels of each part of the grid whose neighbours no surface divides.
fn parts(grid: &SdfGrid, mut show: impl FnMut(&[u32])) {
    let [nx, ny, nz] = grid.dims;
    let (mut seen, mut part) = (vec![false; grid.values.len()], Vec::new());
    for start in 0..seen.len() {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        part.clear();
        part.push(start as u32);
        let mut next = 0;
        while let Some(&at) = part.get(next) {
            next += 1;
            let at = at as usize;
            let [i, j, k] = grid.voxel_of(at);
            let mut visit = |within: bool, side: usize| {
                // A surface between two centres is at most a voxel away from both together.
                if within && !seen[side] && grid.values[at] + grid.values[side] > SLACK * grid.voxel {
                    seen[side] = true;
                    part.push(side as u32);
                }
            };
            visit(k + 1 < nz, at + 1);
            visit(k > 0, at.wrapping_sub(1));
            visit(j + 1 < ny, at + nz);
            visit(j > 0, at.wrapping_sub(nz));
            visit(i + 1 < nx, at + ny * nz);
            visit(i > 0, at.wrapping_sub(ny * nz));
        }
        show(&part);
    }
}

/// Triangles of closed surfaces, and the others. Surfaces hang together by corners at the same place; a closed one has every edge as
/// often one way as the other.
fn divide(triangles: Vec<Tri>) -> (Vec<Tri>, Vec<Tri>) {
    let (mut numbers, mut above): (HashMap<[u32; 3], u32>, Vec<u32>) = Default::default();
    // Adding 0 makes one of both zeros.
    let mut number = |v: Vec3| {
        let new = above.len() as u32;
        *numbers.entry((v + 0.0).to_array().map(f32::to_bits)).or_insert_with(|| {
            above.push(new);
            new
        })
    };
    let corners: Vec<[u32; 3]> = triangles.iter().map(|t| t.0.map(&mut number)).collect();
    for &[a, b, c] in &corners {
        let root = top(&mut above, a);
        for other in [b, c] {
            let other = top(&mut above, other);
            above[other as usize] = root;
        }
    }
    let edges = |&[a, b, c]: &[u32; 3]| [(a, b), (b, c), (c, a)].map(|(a, b)| (a.min(b), a.max(b), if a < b { 1i32 } else { -1 }));
    let mut edges: Vec<_> = corners.par_iter().flat_map_iter(edges).filter(|(a, b, _)| a != b).collect();
    edges.par_sort_unstable();
    let mut closed = vec![true; above.len()];
    for same in edges.chunk_by(|p, q| (p.0, p.1) == (q.0, q.1)).filter(|same| same.iter().map(|e| e.2).sum::<i32>() != 0) {
        closed[top(&mut above, same[0].0) as usize] = false;
    }
    let (closed, open): (Vec<_>, Vec<_>) =
        triangles.into_iter().zip(corners).partition(|(_, [a, ..])| closed[top(&mut above, *a) as usize]);
    let bare = |part: Vec<(Tri, [u32; 3])>| part.into_iter().map(|(t, _)| t).collect();
    (bare(closed), bare(open))
}

/// The number that stands for all that hang together with `i`.
fn top(above: &mut [u32], mut i: u32) -> u32 {
    while above[i as usize] != i {
        above[i as usize] = above[above[i as usize] as usize];
        i = above[i as usize];
    }
    i
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closed_surfaces_by_every_edge() {
        let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(-0.0, 0.0, 1.0)];
        let solid: Vec<Tri> = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]].map(|t| Tri(t.map(|i| corners[i]))).to_vec();
        let count = |t: Vec<Tri>| {
            let (closed, open) = divide(t);
            (closed.len(), open.len())
        };
        assert_eq!(count(solid.clone()), (4, 0));
        // A second one beside it without a side, or with a side turned round.
        let beside: Vec<Tri> = solid.iter().map(|t| Tri(t.0.map(|v| v + Vec3::splat(0.25)))).collect();
        assert_eq!(count([&solid[..], &beside[1..]].concat()), (4, 3));
        let mut turned = [&solid[..], &beside[..]].concat();
        assert_eq!(count(turned.clone()), (8, 0));
        turned[5].0.swap(0, 1);
        assert_eq!(count(turned), (4, 4));
        // Joined at a corner both hang together.
        let joined: Vec<Tri> = solid.iter().map(|t| Tri(t.0.map(|v| v + Vec3::X))).collect();
        assert_eq!(count([&solid[..], &joined[1..]].concat()), (0, 7));
    }
}
