//! Signed distance to what stands in a scene, sampled on a grid.

mod blocks;
mod build;
mod face;
mod file;
mod inside;
mod solid;
mod tree;

pub use build::SdfOptions;
pub use solid::Solid;

use crate::kernels::Probe;
use crate::{Error, Result};
use glam::{UVec3, Vec3};

/// Most samples of a grid: 512 MiB.
pub const MAX_SAMPLES: usize = 1 << 27;

/// Distances to the nearest obstacle, metres: positive in free space, negative within obstacles.
///
/// Sample (i, j, k) is the distance at the centre of its voxel, `lowest + voxel * (i, j, k)`. It is `values[(i * dims[1] + j) * dims[2] + k]`:
/// z runs fastest, as in a NumPy array of shape (x, y, z).
#[derive(Clone, Debug, PartialEq)]
pub struct SdfGrid {
    /// Centre of voxel (0, 0, 0), metres.
    pub lowest: Vec3,
    /// Side of a voxel, metres.
    pub voxel: f32,
    /// Numbers of voxels along x, y and z, each at least 2.
    pub dims: [usize; 3],
    /// Metres.
    pub values: Vec<f32>,
}

impl SdfGrid {
    /// Refuses sizes that do not fit together and values that are not finite.
    pub fn check(&self) -> Result<()> {
        if !self.lowest.is_finite() || !self.voxel.is_finite() || self.voxel <= 0.0 {
            return Err(Error::invalid(format!("a distance grid at {} with voxels of {} m", self.lowest, self.voxel)));
        }
        let count = self.dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        if self.dims.iter().any(|&d| d < 2) || count.is_none_or(|n| n > MAX_SAMPLES) {
            return Err(Error::invalid(format!(
                "a distance grid of {:?} voxels, expected 2 or more a side and {MAX_SAMPLES} at most",
                self.dims
            )));
        }
        if count != Some(self.values.len()) {
            return Err(Error::invalid(format!("a distance grid of {:?} voxels has {} values", self.dims, self.values.len())));
        }
        match self.values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(Error::invalid(format!("value {i} of a distance grid is {}", self.values[i]))),
            None => Ok(()),
        }
    }

    /// Centre of the voxel with the highest numbers, metres.
    pub fn highest(&self) -> Vec3 {
        self.centre(self.dims.map(|d| d - 1))
    }

    /// Centre of a voxel, metres.
    pub fn centre(&self, voxel: [usize; 3]) -> Vec3 {
        self.lowest + self.voxel * Vec3::from(voxel.map(|i| i as f32))
    }

    /// The voxel of a value.
    fn voxel_of(&self, value: usize) -> [usize; 3] {
        let [_, ny, nz] = self.dims;
        [value / (ny * nz), value / nz % ny, value % nz]
    }

    /// The distance at `p`, metres, trilinear between voxel centres.
    ///
    /// Beyond the box of the centres, e away from its nearest point, where the distance is d: sqrt(d^2 + e^2), below which the distance
    /// cannot be while all obstacles are within the box; d + e where d is negative.
    pub fn at(&self, p: Vec3) -> f32 {
        let steps = (p - self.lowest) / self.voxel;
        let last = UVec3::from(self.dims.map(|d| d as u32 - 1)).as_vec3();
        let held = steps.clamp(Vec3::ZERO, last);
        let beyond = (steps - held).length() * self.voxel;
        let distance = self.interpolate(held);
        match beyond {
            0.0 => distance,
            _ if distance < 0.0 => distance + beyond,
            _ => distance.hypot(beyond),
        }
    }

    /// Many look-ups at once, which give what [`SdfGrid::at`] does but for rounding.
    ///
    /// # Panics
    /// When [`SdfGrid::check`] would refuse the sizes.
    pub fn probe(&self) -> Probe<'_> {
        Probe::new(&self.values, self.lowest.to_array(), self.voxel, self.dims)
    }

    /// Trilinear interpolation at `steps` voxels from the lowest centre, which must lie within the grid.
    fn interpolate(&self, steps: Vec3) -> f32 {
        let cell = |axis: usize| (steps[axis] as usize).min(self.dims[axis] - 2);
        let (i, j, k) = (cell(0), cell(1), cell(2));
        let t = steps - Vec3::new(i as f32, j as f32, k as f32);
        let along_z = |i: usize, j: usize| {
            let first = (i * self.dims[1] + j) * self.dims[2] + k;
            lerp(self.values[first], self.values[first + 1], t.z)
        };
        let along_y = |i: usize| lerp(along_z(i, j), along_z(i, j + 1), t.y);
        lerp(along_y(i), along_y(i + 1), t.x)
    }
}

fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + t * (b - a)
}

#[cfg(test)]
mod tests;
