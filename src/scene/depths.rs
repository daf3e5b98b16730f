//! Fast look-ups of depths within what stands in a scene.

use super::SdfGrid;
use glam::{Vec3, Vec3A, Vec4};

/// The cells of a distance grid, eight samples each, in which a point may be within an obstacle.
#[derive(Clone, Debug)]
pub struct Depths {
    /// Of the cell whose lowest sample has this number: whether one of its samples is negative.
    cells: Vec<bool>,
}

/// A grid made ready for many look-ups, which give what [`SdfGrid::at`] does but for rounding.
#[derive(Clone, Copy, Debug)]
pub struct Probe<'a> {
    grid: &'a SdfGrid,
    depths: &'a Depths,
    lowest: Vec3A,
    /// Voxels per metre.
    scale: f32,
    /// Last sample along each axis.
    last: Vec3A,
    /// Samples from one to the next along x and y.
    strides: [usize; 2],
}

impl Depths {
    /// The cells of `grid`.
    pub fn new(grid: &SdfGrid) -> Self {
        // One after the other along each axis: whether a sample or the next one is negative.
        let strides = [grid.dims[1] * grid.dims[2], grid.dims[2], 1];
        let mut cells: Vec<bool> = grid.values.iter().map(|v| *v < 0.0).collect();
        for stride in strides {
            for i in 0..cells.len() - stride {
                cells[i] |= cells[i + stride];
            }
        }
        Self { cells }
    }

    /// Look-ups in the grid from which this was made.
    pub fn probe<'a>(&'a self, grid: &'a SdfGrid) -> Probe<'a> {
        let last = Vec3A::from_array(grid.dims.map(|d| (d - 1) as f32));
        let strides = [grid.dims[1] * grid.dims[2], grid.dims[2]];
        Probe { grid, depths: self, lowest: grid.lowest.into(), scale: grid.voxel.recip(), last, strides }
    }
}

impl Probe<'_> {
    /// The distance at `p`, metres; negative within obstacles.
    #[inline]
    pub fn distance(&self, p: Vec3A) -> f32 {
        match self.cell(p) {
            Some((cell, within)) => self.interpolate(cell, within),
            None => self.grid.at(Vec3::from(p)),
        }
    }

    /// How far `p` is within obstacles, metres; 0 in free space.
    #[inline]
    pub fn depth(&self, p: Vec3A) -> f32 {
        match self.cell(p) {
            Some((cell, _)) if !self.depths.cells[cell] => 0.0,
            _ => self.depth_near(p),
        }
    }

    /// [`Probe::depth`] of a point that may be within an obstacle; apart, for few are.
    #[inline(never)]
    fn depth_near(&self, p: Vec3A) -> f32 {
        -self.distance(p).min(0.0)
    }

    /// The cell of `p` and the place in it, from 0 to 1 along each axis; None beyond the grid.
    #[inline]
    fn cell(&self, p: Vec3A) -> Option<(usize, Vec3A)> {
        let steps = (p - self.lowest) * self.scale;
        if !(steps.cmpge(Vec3A::ZERO) & steps.cmplt(self.last)).all() {
            return None;
        }
        let at = steps.as_ivec3();
        let cell = at.x as usize * self.strides[0] + at.y as usize * self.strides[1] + at.z as usize;
        Some((cell, steps - at.as_vec3a()))
    }

    #[inline]
    fn interpolate(&self, cell: usize, within: Vec3A) -> f32 {
        let square = |first: usize| {
            let (near, far) = (&self.grid.values[first..first + 2], &self.grid.values[first + self.strides[1]..][..2]);
            Vec4::new(near[0], near[1], far[0], far[1])
        };
        let (low, high) = (square(cell), square(cell + self.strides[0]));
        let v = low + within.x * (high - low);
        let (a, b) = (v.x + within.y * (v.z - v.x), v.y + within.y * (v.w - v.y));
        a + within.z * (b - a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn look_ups_are_those_of_the_grid() {
        let mut rng = crate::rng::stream(1, "depths", 0);
        let (dims, voxel) = ([5, 7, 4], 0.1);
        let values = (0..140).map(|_| rng.random_range(-0.4..0.2)).collect();
        let grid = SdfGrid { lowest: Vec3::new(-0.2, 0.1, 0.0), voxel, dims, values };
        let depths = Depths::new(&grid);
        let probe = depths.probe(&grid);
        let (mut free, mut inside) = (0, 0);
        for _ in 0..20_000 {
            let p = Vec3::from([0; 3].map(|_| rng.random_range(-0.4..1.0)));
            let d = grid.at(p);
            assert!((probe.distance(p.into()) - d).abs() < 1e-5, "{p}");
            assert!((probe.depth(p.into()) - (-d).max(0.0)).abs() < 1e-5, "{p}");
            free += usize::from(d >= 0.0);
            inside += usize::from(d < 0.0);
        }
        assert!(free > 1000 && inside > 1000, "{free} {inside}");
        // The last samples themselves.
        let corner = grid.highest();
        assert!((probe.distance(corner.into()) - grid.values[139]).abs() < 1e-5);
    }
}
