//! Distances from a mesh.

use super::blocks::{BLOCK, SLACK, Search, Slab};
use super::inside::Surfaces;
use super::tree::{Tree, Tri};
use super::{MAX_SAMPLES, SdfGrid};
use crate::scene::{Grid, Polygon, TriMesh};
use crate::{Error, Result};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Triangles wholly within this height of the floor, metres, belong to it: what a scan's noise, rugs and boxes' undersides need.
pub(super) const FLOOR: f32 = 0.02;
/// Below this height over the floor, metres, the scene is taken as it is at this height.
const ABOVE: f32 = 0.03;

/// How a grid is laid over a mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SdfOptions {
    /// Side of a voxel, metres.
    pub voxel: f32,
    /// How far the grid reaches beyond the mesh, metres.
    pub margin: f32,
    /// Height of the floor, metres, which is no obstacle: triangles within 2 cm of it are left out, and what is less than 3 cm above the
    /// floor or beneath it is as it is 3 cm above. None: there is no floor.
    pub floor: Option<f32>,
    /// Height of the highest voxel centres, metres; None: the margin above the mesh.
    pub top: Option<f32>,
    /// Points in free space, such as some of the walkable floor 1 m up. Needed if the mesh is a room's shell, whose inside is free; without
    /// them free space is what no surface encloses.
    pub free: Vec<Vec3>,
}

impl Default for SdfOptions {
    fn default() -> Self {
        Self { voxel: 0.05, margin: 0.2, floor: Some(0.0), top: None, free: Vec::new() }
    }
}

impl SdfOptions {
    /// Of a room with this walkable area and the floor at this height: what is 1 m above the one on the other is free space.
    ///
    /// Errors: a walkable area that is none.
    pub fn for_floor(walkable: &Polygon, floor: f32) -> Result<Self> {
        let free = Grid::of_polygon_within(walkable, 0.5, 2e3)?.centres().map(|p| p.as_vec2().extend(floor + 1.0)).collect();
        Ok(Self { floor: Some(floor), free, ..Self::default() })
    }

    /// Sets the voxel so that `cells` of them reach over the longest side of `mesh` and its margin.
    pub fn with_cells(self, mesh: &TriMesh, cells: usize) -> Self {
        let longest = mesh.bounds().map_or(0.0, |(low, high)| (high - low).max_element()) + 2.0 * self.margin;
        Self { voxel: longest / cells.max(2).saturating_sub(1) as f32, ..self }
    }

    /// Lowest voxel centre and numbers of voxels: the centres reach at least from margin to margin.
    fn layout(&self, low: Vec3, high: Vec3) -> Result<(Vec3, [usize; 3])> {
        for (name, value, least) in [("voxel", self.voxel, f32::MIN_POSITIVE), ("margin", self.margin, 0.0)] {
            if !value.is_finite() || value < least {
                return Err(Error::invalid(format!("{name} = {value} of a distance grid: expected metres, such as 0.05")));
            }
        }
        if let Some(p) = self.free.iter().find(|p| !p.is_finite()) {
            return Err(Error::invalid(format!("free point {p} of a distance grid: expected finite metres")));
        }
        let (low, mut high) = (low - self.margin, high + self.margin);
        if let Some(top) = self.top {
            if !top.is_finite() || top <= low.z {
                let lowest = low.z;
                return Err(Error::invalid(format!("top = {top} of a distance grid: expected a height above its lowest, {lowest} m")));
            }
            high.z = high.z.min(top);
        }
        let extent = high - low;
        // A hair less than a whole voxel is rounding.
        let dims = extent.to_array().map(|e| ((e / self.voxel - 1e-4).ceil().max(1.0) as usize).saturating_add(1));
        let count = dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        if count.is_none_or(|n| n > MAX_SAMPLES) {
            let what = format!("a distance grid of {dims:?} voxels of {} m over {extent} m has more than {MAX_SAMPLES}", self.voxel);
            return Err(Error::invalid(format!("{what}; take a larger voxel")));
        }
        Ok((low, dims))
    }

    /// The point that stands for `p`: beneath the floor the scene goes on as it is just above it.
    pub(super) fn above_floor(&self, p: Vec3) -> Vec3 {
        p.with_z(p.z.max(self.floor.map_or(f32::MIN, |floor| floor + ABOVE)))
    }
}

impl SdfGrid {
    /// The distances of all voxel centres to the triangles of `mesh` but the floor's, exact but for rounding and caps (below).
    ///
    /// A centre is within obstacles where the generalised winding number (Jacobson et al. 2013, by the hierarchy of Barill et al. 2018)
    /// differs by more than a half from that of free space, the median at `options.free`. So a solid is solid whichever way its normals
    /// point, furniture may lack its underside and a scan have holes, and of a closed room the inside is free while its walls, what is
    /// beyond them and closed furniture are not. Where the sign changes without a surface, across a hole, the middle of the change
    /// counts as surface. Single sheets enclose nothing: the distance to them is positive on both sides.
    ///
    /// Errors: a mesh that does not pass its check or is nothing but floor, options that make no grid.
    pub fn build(mesh: &TriMesh, options: &SdfOptions) -> Result<Self> {
        mesh.check()?;
        let (low, high) = mesh.bounds().ok_or_else(|| Error::invalid("the mesh has no triangles"))?;
        let (lowest, dims) = options.layout(low, high)?;
        Self::sample(mesh, options, lowest, dims)
    }

    /// [`SdfGrid::build`] at given voxels.
    pub(super) fn sample(mesh: &TriMesh, options: &SdfOptions, lowest: Vec3, dims: [usize; 3]) -> Result<Self> {
        let all: Vec<Tri> = (0..mesh.triangles.len()).map(|i| Tri(mesh.corners(i))).collect();
        let on_floor = |t: &Tri| options.floor.is_some_and(|floor| t.0.iter().all(|v| (v.z - floor).abs() <= FLOOR));
        let obstacles: Vec<Tri> = all.iter().filter(|t| !on_floor(t)).copied().collect();
        if obstacles.is_empty() {
            return Err(Error::invalid("the mesh is nothing but floor: there is no obstacle to measure distances to"));
        }
        let (obstacles, surfaces) = rayon::join(|| Tree::new(obstacles), || Surfaces::new(all));
        let mut grid = Self { lowest, voxel: options.voxel, dims, values: vec![0.0; dims.iter().product()] };
        grid.measure(&obstacles, options);
        let excess = surfaces.excess(&grid, options);
        if !surfaces.are_closed() {
            grid.nearer(grid.caps(&excess), options);
        }
        grid.values.par_iter_mut().zip(&excess).for_each(|(value, &excess)| *value = if excess > 0.0 { -*value } else { *value });
        grid.check()?;
        Ok(grid)
    }

    /// Fills in the distances to obstacles, without sign.
    fn measure(&mut self, tree: &Tree, options: &SdfOptions) {
        let (lowest, [_, ny, nz]) = (self.lowest, self.dims);
        let slabs = self.values.par_chunks_mut(BLOCK * ny * nz).enumerate();
        slabs.for_each_init(Search::default, |search, (i, values)| {
            let lowest = lowest + Vec3::X * ((i * BLOCK) as f32 * options.voxel);
            Slab { tree, options, lowest, dims: [values.len() / (ny * nz), ny, nz], values }.fill(search);
        });
    }

    /// Lessens the distances to those of `points`.
    fn nearer(&mut self, points: Vec<Tri>, options: &SdfOptions) {
        if points.is_empty() {
            return;
        }
        let tree = Tree::new(points);
        self.rows().for_each_init(Vec::new, |open, (row, values)| {
            for (k, value) in values.iter_mut().enumerate() {
                let p = options.above_floor(row + Vec3::Z * (k as f32 * options.voxel));
                *value = tree.distance_squared(p, *value * *value, open).sqrt();
            }
        });
    }

    /// Every row along z: the centre of its first voxel and its values.
    fn rows(&mut self) -> impl IndexedParallelIterator<Item = (Vec3, &mut [f32])> {
        let (lowest, voxel, [_, ny, nz]) = (self.lowest, self.voxel, self.dims);
        let start = move |row: usize| lowest + voxel * Vec3::new((row / ny) as f32, (row % ny) as f32, 0.0);
        self.values.par_chunks_mut(nz).enumerate().map(move |(row, values)| (start(row), values))
    }

    /// Points between neighbours of unlike sign that no surface parts; `excess` is above 0 within obstacles.
    fn caps(&self, excess: &[f32]) -> Vec<Tri> {
        let [nx, ny, nz] = self.dims;
        let strides = [ny * nz, nz, 1];
        let slab = |i: usize| {
            let voxels = (0..ny).flat_map(move |j| (0..nz).map(move |k| [i, j, k]));
            voxels.flat_map(move |voxel| {
                (0..3).filter_map(move |axis| {
                    let first = voxel[0] * strides[0] + voxel[1] * strides[1] + voxel[2];
                    let second = (voxel[axis] + 1 < self.dims[axis]).then_some(first + strides[axis])?;
                    let (a, b) = (excess[first], excess[second]);
                    // A surface between two centres is at most a voxel away from both together.
                    let parted = self.values[first] + self.values[second] <= SLACK * self.voxel;
                    let t = a / (a - b);
                    ((a > 0.0) != (b > 0.0) && !parted).then(|| Tri([self.centre(voxel) + Vec3::AXES[axis] * (t * self.voxel); 3]))
                })
            })
        };
        (0..nx).into_par_iter().flat_map_iter(slab).collect()
    }
}
