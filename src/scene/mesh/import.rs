//! Meshes from files: which way is up, how long a unit is, and what is left out.

use super::{TriMesh, gltf, obj, ply};
use crate::{Error, Result};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::Path;

/// Most triangles that a file may have.
pub const MAX_TRIANGLES: usize = 10_000_000;
/// Triangles of a smaller area, square metres, are dropped: they have no normal.
const NO_AREA: f64 = 1e-12;
/// Largest extents, metres, between which a mesh is taken to be in metres.
const METRES: std::ops::RangeInclusive<f32> = 0.05..=200.0;
/// Extents, metres, beyond which a stated unit is wrong.
const SCENE: std::ops::RangeInclusive<f32> = 1e-3..=1e4;
/// Units that are tried when none is given, each with the largest extent in the file's numbers that it is taken for.
const UNITS: [(f32, &str, f32); 3] = [(1.0, "metres", 20.0), (0.01, "centimetres", 2e3), (0.001, "millimetres", 2e4)];

/// Colour of what has no material.
pub(super) const GREY: [f32; 4] = [0.7, 0.7, 0.7, 1.0];

/// The axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Up {
    #[serde(rename = "x")]
    X,
    #[serde(rename = "-x")]
    NegX,
    #[serde(rename = "y")]
    Y,
    #[serde(rename = "-y")]
    NegY,
    #[serde(rename = "z")]
    Z,
    #[serde(rename = "-z")]
    NegZ,
}

impl Up {
    /// A vector of the file in the world, whose z is up: always a rotation. From y up, the file's z becomes the world's -y.
    pub fn turn(self, v: Vec3) -> Vec3 {
        let Vec3 { x, y, z } = v;
        match self {
            Self::X => Vec3::new(y, z, x),
            Self::NegX => Vec3::new(z, y, -x),
            Self::Y => Vec3::new(x, -z, y),
            Self::NegY => Vec3::new(x, z, -y),
            Self::Z => v,
            Self::NegZ => Vec3::new(x, -y, -z),
        }
    }
}

/// How a file's numbers become the world's metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MeshOptions {
    /// The axis that points up. Default: y in glTF and OBJ, z in PLY.
    pub up: Option<Up>,
    /// Metres per unit of the file. Default: 1 in glTF, whose unit is the metre; of the others the first of metres, centimetres and
    /// millimetres in which the mesh is at most 20 m large, with a warning unless that is metres.
    pub unit: Option<f32>,
}

/// A mesh from a file and what was decided about it.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// Metres, z up; vertices without a triangle are left out.
    pub mesh: TriMesh,
    pub up: Up,
    /// Metres per unit of the file.
    pub unit: f32,
    /// Faces without area that were dropped.
    pub degenerate: usize,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Reads a mesh by the file's ending: `.gltf` and `.glb` (glTF 2.0), `.obj` with its `.mtl`, `.ply`.
///
/// Other files that it names are looked for beside it, never elsewhere than on disk. Errors name the file and what is wrong with it: bytes
/// that are missing, numbers that are not finite, vertices that do not exist, no triangle, more than [`MAX_TRIANGLES`], and an extent that
/// tells of another unit.
pub fn read_mesh(path: impl AsRef<Path>, options: &MeshOptions) -> Result<Imported> {
    let path = path.as_ref();
    Format::of(path)?.parse(path, &fs::read(path).map_err(|e| Error::io(path, e))?, options)
}

/// A kind of file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Gltf,
    Obj,
    Ply,
}

impl Format {
    /// The format of a file by its ending.
    pub fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match ending.as_deref() {
            Some("gltf" | "glb") => Ok(Self::Gltf),
            Some("obj") => Ok(Self::Obj),
            Some("ply") => Ok(Self::Ply),
            _ => Err(Error::file(path, "is no mesh that can be read; expected .gltf, .glb, .obj or .ply")),
        }
    }

    /// Reads the content of a file; `path` names it in errors and says where the files beside it are.
    pub fn parse(self, path: &Path, bytes: &[u8], options: &MeshOptions) -> Result<Imported> {
        let raw = match self {
            Self::Gltf => gltf::parse(path, bytes)?,
            Self::Obj => obj::parse(path, bytes)?,
            Self::Ply => ply::parse(path, bytes)?,
        };
        raw.mesh.check().map_err(|e| Error::file(path, e.to_string()))?;
        let up = options.up.unwrap_or(if self == Self::Ply { Up::Z } else { Up::Y });
        let mut warnings = raw.warnings;
        let unit = self.unit(path, &raw.mesh, options.unit, &mut warnings)?;
        let mut mesh = raw.mesh;
        mesh.vertices.iter_mut().for_each(|v| *v = up.turn(*v) * unit);
        let degenerate = raw.degenerate + drop_degenerate(&mut mesh);
        if mesh.triangles.is_empty() {
            return Err(Error::file(path, format!("has only triangles without area ({degenerate})")));
        }
        mesh.check().map_err(|e| Error::file(path, format!("in metres: {e}")))?;
        Ok(Imported { mesh, up, unit, degenerate, warnings })
    }

    /// Metres per unit, given or guessed from the extent.
    fn unit(self, path: &Path, mesh: &TriMesh, given: Option<f32>, warnings: &mut Vec<String>) -> Result<f32> {
        let extent = mesh.bounds().map_or(0.0, |(low, high)| (high - low).max_element());
        if let Some(unit) = given {
            if !unit.is_finite() || unit <= 0.0 {
                return Err(Error::invalid(format!(
                    "unit = {unit}: expected the metres per unit of the mesh, such as 0.01 for centimetres"
                )));
            }
            if extent > 0.0 && !SCENE.contains(&(extent * unit)) {
                let what = format!("is {extent} units large, with unit = {unit} {} m; expected 1 mm to 10 km", extent * unit);
                return Err(Error::file(path, what));
            }
            if !METRES.contains(&(extent * unit)) {
                warnings.push(format!("with unit = {unit} the mesh is {} m large; is that meant?", extent * unit));
            }
            return Ok(unit);
        }
        let wrong = |as_metres: f32| {
            let hint = "give unit, the metres per unit of the file (0.01 for centimetres, 0.001 for millimetres)";
            Error::file(path, format!("is {as_metres} units large, which in metres would be no scene; {hint}"))
        };
        if extent < *METRES.start() {
            return Err(wrong(extent));
        }
        if self == Self::Gltf {
            return if extent <= *METRES.end() { Ok(1.0) } else { Err(wrong(extent)) };
        }
        let &(unit, name, _) = UNITS.iter().find(|(_, _, largest)| extent <= *largest).ok_or_else(|| wrong(extent))?;
        if unit != 1.0 {
            warnings.push(format!("is {extent} units large and taken to be in {name}; give unit (metres per unit) if it is not"));
        }
        Ok(unit)
    }
}

/// A mesh as its file has it.
#[derive(Debug, Default)]
pub(super) struct Raw {
    pub mesh: TriMesh,
    /// Faces of fewer than three corners.
    pub degenerate: usize,
    pub warnings: Vec<String>,
}

impl Raw {
    /// Adds a triangle; the error says that there are too many.
    pub fn push(&mut self, triangle: [u32; 3], object: u16, material: u16) -> std::result::Result<(), String> {
        if self.mesh.triangles.len() >= MAX_TRIANGLES {
            return Err(format!("has more than {MAX_TRIANGLES} triangles, the most that are read; simplify the mesh first"));
        }
        self.mesh.push(triangle, object, material);
        Ok(())
    }
}

/// Drops triangles without area, then vertices without a triangle; says how many triangles.
fn drop_degenerate(mesh: &mut TriMesh) -> usize {
    let good: Vec<usize> = (0..mesh.triangles.len()).filter(|&i| mesh.triangle_area(i) >= NO_AREA).collect();
    let dropped = mesh.triangles.len() - good.len();
    mesh.triangles = good.iter().map(|&i| mesh.triangles[i]).collect();
    mesh.object = good.iter().map(|&i| mesh.object[i]).collect();
    mesh.material = good.iter().map(|&i| mesh.material[i]).collect();
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    mesh.triangles.as_flattened().iter().for_each(|&v| number[v as usize] = 0);
    let mut kept = Vec::new();
    for (slot, &v) in number.iter_mut().zip(&mesh.vertices).filter(|(slot, _)| **slot == 0) {
        *slot = kept.len() as u32;
        kept.push(v);
    }
    mesh.triangles.as_flattened_mut().iter_mut().for_each(|v| *v = number[*v as usize]);
    mesh.vertices = kept;
    dropped
}

#[cfg(test)]
mod tests;
