//! Grids in files.

use super::SdfGrid;
use crate::io::numpy::{Array, Npz, NpzWriter};
use crate::io::pickle::Pickle;
use crate::io::write_atomic;
use crate::{Error, Result};
use glam::Vec3;
use std::fs;
use std::path::Path;

impl SdfGrid {
    /// Reads a grid: an `.npz` as [`SdfGrid::write`] makes it, or the authors' layout as `.npz` or Python's `.pkl`, told by their keys.
    ///
    /// The authors' layout: `sdf` (n, n, n), indexed by x, y, z and negative in free space, `center` (3) and `scale`. A point p is looked up
    /// at (p - center) * scale, where -1 and 1 are the outer faces of the first and the last voxel (align_corners = False): sample i
    /// belongs to the voxel centre (2 i + 1) / n - 1, half a voxel within the faces. Errors name file, key and what would be right.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::parse(path, &fs::read(path).map_err(|e| Error::io(path, e))?)
    }

    pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let grid = if bytes.starts_with(&[0x80]) {
            let pickle = Pickle::parse(path, bytes)?;
            authors(path, |key| pickle.array(key))?
        } else {
            let npz = Npz::new(path, bytes)?;
            if npz.has("lowest") { own(path, &npz)? } else { authors(path, |key| npz.array(key))? }
        };
        grid.check().map_err(|e| Error::file(path, e.to_string()))?;
        Ok(grid)
    }

    /// Writes an `.npz` with `sdf` (x, y, z), metres, positive in free space, `lowest` (3), the centre of its first voxel, and `voxel`,
    /// the side of a voxel.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        self.check()?;
        let mut npz = NpzWriter::default();
        npz.f32s("lowest", &[3], &self.lowest.to_array());
        npz.f32s("voxel", &[], &[self.voxel]);
        npz.f32s("sdf", &self.dims, &self.values);
        write_atomic(path, &npz.finish())
    }

    /// Writes the authors' layout (see [`SdfGrid::read`]), as a pickle if `path` ends in `.pkl`, else as `.npz`. It is a cube: a grid that is
    /// none is filled up with what [`SdfGrid::at`] says beyond its highest side.
    pub fn write_authors(&self, path: impl AsRef<Path>) -> Result<()> {
        self.check()?;
        let path = path.as_ref();
        let n = self.dims.into_iter().max().unwrap_or(0);
        let centre = self.lowest + 0.5 * (n - 1) as f32 * self.voxel;
        let scale = 2.0 / (n as f32 * self.voxel);
        let voxels = (0..n * n * n).map(|v| [v / (n * n), v / n % n, v % n]);
        let held = |v: &[usize; 3]| (0..3).all(|axis| v[axis] < self.dims[axis]);
        let value = |v: [usize; 3]| match held(&v) {
            true => -self.values[(v[0] * self.dims[1] + v[1]) * self.dims[2] + v[2]],
            false => -self.at(self.centre(v)),
        };
        let sdf: Vec<f32> = voxels.map(value).collect();
        let bytes = if path.extension().is_some_and(|e| e == "pkl") {
            pickle(&[("center", &[3], &centre.to_array()), ("scale", &[], &[scale]), ("sdf", &[n, n, n], &sdf)])
        } else {
            let mut npz = NpzWriter::default();
            npz.f32s("center", &[3], &centre.to_array());
            npz.f32s("scale", &[], &[scale]);
            npz.f32s("sdf", &[n, n, n], &sdf);
            npz.finish()
        };
        write_atomic(path, &bytes)
    }
}

fn own(path: &Path, npz: &Npz) -> Result<SdfGrid> {
    let (lowest, voxel) = (point(path, "lowest", npz.array("lowest")?)?, npz.array("voxel")?.scalar(path, "voxel")?);
    let sdf = npz.array("sdf")?;
    sdf.check(path, "sdf", &[0, 0, 0])?;
    Ok(SdfGrid { lowest, voxel, dims: [sdf.shape[0], sdf.shape[1], sdf.shape[2]], values: sdf.data })
}

/// The authors' layout, whose arrays may have extra axes of length 1 in front.
fn authors(path: &Path, array: impl Fn(&str) -> Result<Array>) -> Result<SdfGrid> {
    let (centre, scale, mut sdf) = (point(path, "center", array("center")?)?, array("scale")?.scalar(path, "scale")?, array("sdf")?);
    while sdf.shape.len() > 3 && sdf.shape[0] == 1 {
        sdf.shape.remove(0);
    }
    sdf.check(path, "sdf", &[0, 0, 0])?;
    let [nx, ny, nz] = sdf.shape[..] else { return Err(Error::file(path, "'sdf' has no three axes")) };
    if nx != ny || ny != nz {
        return Err(Error::file(path, format!("'sdf' has shape ({nx}, {ny}, {nz}), expected a cube: its voxels would not be cubes")));
    }
    if !scale.is_finite() || scale <= 0.0 {
        return Err(Error::file(path, format!("'scale' is {scale}, expected a positive number")));
    }
    let voxel = 2.0 / (nx as f32 * scale);
    let lowest = centre + (1.0 / nx as f32 - 1.0) / scale;
    Ok(SdfGrid { lowest, voxel, dims: [nx, ny, nz], values: sdf.data.into_iter().map(|v| -v).collect() })
}

fn point(path: &Path, key: &str, array: Array) -> Result<Vec3> {
    match array.data[..] {
        [x, y, z] => Ok(Vec3::new(x, y, z)),
        _ => Err(Error::file(path, format!("'{key}' has {} numbers, expected 3", array.data.len()))),
    }
}

/// A pickle (protocol 3) of a dict of arrays in single precision, as NumPy writes them.
fn pickle(arrays: &[(&str, &[usize], &[f32])]) -> Vec<u8> {
    let mut out = b"\x80\x03}(".to_vec();
    let text = |out: &mut Vec<u8>, text: &str| {
        out.push(b'X');
        out.extend((text.len() as u32).to_le_bytes());
        out.extend(text.as_bytes());
    };
    for (key, shape, data) in arrays {
        text(&mut out, key);
        // _reconstruct(ndarray, (0,), b'b'), then its state: version, shape, type, order, bytes.
        out.extend(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\x01b\x87R(K\x01(");
        for &d in *shape {
            out.push(b'J');
            out.extend((d as i32).to_le_bytes());
        }
        out.extend(b"tcnumpy\ndtype\n");
        text(&mut out, "f4");
        out.extend(b"\x89\x88\x87R(K\x03");
        text(&mut out, "<");
        out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb\x89B");
        out.extend((4 * data.len() as u32).to_le_bytes());
        out.extend(data.iter().flat_map(|v| v.to_le_bytes()));
        out.extend(b"tb");
    }
    out.extend(b"u.");
    out
}
