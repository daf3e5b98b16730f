//! A scene in a folder: walkable area, mesh, cells, distances and pairs of start and goal, written and read whole.

use super::outline::check_simple;
use super::{Grid, Material, Pair, Polygon, SdfGrid, TriMesh};
use crate::io::{RawTensor, Tensors, content_hash, kept_folder, pack_raw, replace_folder, write_atomic};
use crate::{Error, Result};
use glam::{DVec2, Vec2, Vec3};
use safetensors::Dtype;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

const FORMAT: u32 = 1;
const UNITS: &str = "metres, z up";
const DESCRIPTION: &str = "scene.json";
const TENSORS: &str = "scene.safetensors";
/// The picture of the scene.
pub const PICTURE: &str = "top.png";

/// A scene with all that is known of it; only the walkable area must be.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneBundle {
    pub name: String,
    /// Height of the floor, metres.
    pub floor: f32,
    /// Where people may walk.
    pub walkable: Polygon,
    /// What the scene was made from.
    pub origin: BTreeMap<String, String>,
    /// What stands there.
    pub mesh: Option<TriMesh>,
    /// Cells that cannot be walked on.
    pub blocked: Option<Grid>,
    /// Distances to what stands there.
    pub sdf: Option<SdfGrid>,
    /// Radius of the person that the pairs are for, metres.
    pub clearance: f32,
    pub pairs: Vec<Pair>,
}

/// The content of `scene.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    format: u32,
    name: String,
    units: String,
    floor: f32,
    walkable: Rings,
    clearance: f32,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    objects: Vec<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    materials: Vec<Material>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blocked: Option<Cells>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sdf: Option<Voxels>,
    origin: BTreeMap<String, String>,
    /// SHA-256 of the file of tensors.
    tensors: String,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rings {
    exterior: Vec<DVec2>,
    holes: Vec<Vec<DVec2>>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Cells {
    lowest: DVec2,
    cell: f64,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Voxels {
    lowest: Vec3,
    voxel: f32,
}

impl SceneBundle {
    /// Writes the folder `dir` with `picture`, the content of `top.png`, so that a reader finds the old bundle or the whole new one.
    ///
    /// Errors: files, and what [`SceneBundle::check_target`] refuses.
    pub fn write(&self, dir: &Path, picture: &[u8]) -> Result<()> {
        Self::check_target(dir)?;
        replace_folder(dir, |fresh| self.write_files(fresh, picture))
    }

    /// The scene moved so that its floor is at z = 0.
    pub fn on_floor(mut self) -> Self {
        let floor = std::mem::take(&mut self.floor);
        self.mesh.iter_mut().flat_map(|mesh| &mut mesh.vertices).for_each(|v| v.z -= floor);
        self.sdf.iter_mut().for_each(|sdf| sdf.lowest.z -= floor);
        self
    }

    /// Refuses a folder that a bundle must not take the place of: all but a new one, an empty one, and a bundle with nothing else in it.
    pub fn check_target(dir: &Path) -> Result<()> {
        let bad = |what: String| Err(Error::file(dir, format!("{what}; give a new folder")));
        if dir.is_symlink() || dir.exists() && !dir.is_dir() {
            return bad("is no folder".into());
        }
        let names: Vec<_> = fs::read_dir(dir).into_iter().flatten().flatten().map(|e| e.file_name()).collect();
        if let Some(name) = names.iter().find(|n| ![DESCRIPTION, TENSORS, PICTURE].iter().any(|own| n.as_os_str() == *own)) {
            return bad(format!("holds {}, which is no part of a scene", Path::new(name).display()));
        }
        if !names.is_empty() && !names.iter().any(|n| n == DESCRIPTION) {
            return bad(format!("is not empty and holds no {DESCRIPTION}"));
        }
        Ok(())
    }

    fn write_files(&self, dir: &Path, picture: &[u8]) -> Result<()> {
        let tensors = pack_raw(&self.tensors(), &BTreeMap::new())?;
        let mesh = self.mesh.as_ref();
        let description = Description {
            format: FORMAT,
            name: self.name.clone(),
            units: UNITS.into(),
            floor: self.floor,
            walkable: Rings { exterior: exact(self.walkable.exterior()), holes: self.walkable.holes().iter().map(|h| exact(h)).collect() },
            clearance: self.clearance,
            objects: mesh.map_or_else(Vec::new, |m| m.objects.clone()),
            materials: mesh.map_or_else(Vec::new, |m| m.materials.clone()),
            blocked: self.blocked.as_ref().map(|g| Cells { lowest: nanometres(g.lowest), cell: g.cell }),
            sdf: self.sdf.as_ref().map(|g| Voxels { lowest: g.lowest, voxel: g.voxel }),
            origin: self.origin.clone(),
            tensors: content_hash(&tensors),
        };
        let text = serde_json::to_string_pretty(&description).map_err(|e| Error::invalid(format!("cannot describe the scene: {e}")))?;
        write_atomic(dir.join(TENSORS), &tensors)?;
        write_atomic(dir.join(PICTURE), picture)?;
        write_atomic(dir.join(DESCRIPTION), format!("{text}\n").as_bytes())
    }

    fn tensors(&self) -> Vec<RawTensor<'static>> {
        let floats = |v: &mut dyn Iterator<Item = f32>| v.flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
        let shorts = |v: &[u16]| v.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<u8>>();
        let mut out = Vec::new();
        if let Some(mesh) = &self.mesh {
            let n = mesh.triangles.len();
            let vertices = floats(&mut mesh.vertices.iter().flat_map(Vec3::to_array));
            let triangles = mesh.triangles.as_flattened().iter().flat_map(|i| i.to_le_bytes()).collect();
            out.push(("vertices", Dtype::F32, vec![mesh.vertices.len(), 3], vertices));
            out.push(("triangles", Dtype::I32, vec![n, 3], triangles));
            out.push(("object", Dtype::U16, vec![n], shorts(&mesh.object)));
            out.push(("material", Dtype::U16, vec![n], shorts(&mesh.material)));
        }
        if let Some(grid) = &self.blocked {
            let cells = grid.cells.iter().map(|&c| u8::from(c)).collect();
            out.push(("blocked", Dtype::U8, vec![grid.dims[1], grid.dims[0]], cells));
        }
        if let Some(grid) = &self.sdf {
            out.push(("sdf", Dtype::F32, grid.dims.to_vec(), floats(&mut grid.values.iter().copied())));
        }
        if !self.pairs.is_empty() {
            let (n, pairs) = (self.pairs.len(), &self.pairs);
            let points = floats(&mut pairs.iter().flat_map(|p| [p.start, p.goal]).flat_map(|p| p.to_array()));
            out.push(("pairs", Dtype::F32, vec![n, 2, 2], points));
            out.push(("ways", Dtype::F32, vec![n], floats(&mut pairs.iter().map(|p| p.way))));
            out.push(("ways_bend", Dtype::U8, vec![n], pairs.iter().map(|p| u8::from(p.blocked)).collect()));
        }
        out
    }

    /// Reads the folder `dir`; every file must be whole and belong to the others.
    ///
    /// Errors name the file and the entry: unknown or missing keys and tensors, other shapes, rings that cross themselves.
    pub fn read(dir: &Path) -> Result<Self> {
        let dir = &kept_folder(dir)?;
        let path = dir.join(DESCRIPTION);
        let text = fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
        let about: Description = serde_json::from_str(&text).map_err(|e| Error::file(&path, e.to_string()))?;
        let bad = |what: String| Error::file(&path, what);
        if about.format != FORMAT {
            return Err(bad(format!("has format {}, expected {FORMAT}", about.format)));
        }
        if about.units != UNITS {
            return Err(bad(format!("has units '{}', expected '{UNITS}'", about.units)));
        }
        let walkable = Polygon::new(about.walkable.exterior, about.walkable.holes).map_err(|e| bad(format!("walkable: {e}")))?;
        check_simple(&walkable).map_err(|e| bad(format!("walkable: {e}")))?;
        let reader = Reader::new(dir, &about.tensors)?;
        let (sdf, blocked) = (reader.sdf(about.sdf)?, reader.blocked(about.blocked)?);
        let mesh = reader.mesh(about.objects, about.materials)?;
        let (name, floor, clearance) = (about.name, about.floor, about.clearance);
        Ok(Self { name, floor, walkable, origin: about.origin, mesh, blocked, sdf, clearance, pairs: reader.pairs()? })
    }
}

/// Points as they are read back, bit for bit: longer decimals than these may be off in their last place.
fn exact(ring: &[DVec2]) -> Vec<DVec2> {
    ring.iter().map(|&p| nanometres(p)).collect()
}

fn nanometres(p: DVec2) -> DVec2 {
    (p * 1e9).round() / 1e9
}

/// The groups of tensors: each is there as a whole or not at all.
const GROUPS: [&[&str]; 4] = [&["vertices", "triangles", "object", "material"], &["blocked"], &["sdf"], &["pairs", "ways", "ways_bend"]];

/// Takes the file of tensors apart.
struct Reader {
    path: PathBuf,
    tensors: Tensors,
}

impl Reader {
    fn new(dir: &Path, hash: &str) -> Result<Self> {
        let path = dir.join(TENSORS);
        let tensors = Tensors::read(&path)?;
        if tensors.hash() != hash {
            return Err(Error::file(&path, format!("does not belong to {DESCRIPTION}, which names another SHA-256")));
        }
        let names = tensors.names();
        if let Some(name) = names.iter().find(|n| !GROUPS.iter().any(|g| g.contains(&n.as_str()))) {
            return Err(Error::file(&path, format!("holds the unknown tensor '{name}'")));
        }
        Ok(Self { path, tensors })
    }

    /// Whether the group of `name` is there.
    fn has(&self, name: &str) -> bool {
        let names = self.tensors.names();
        GROUPS.iter().filter(|g| g.contains(&name)).any(|g| g.iter().any(|n| names.iter().any(|m| m == n)))
    }

    /// A tensor's place in the world, which must be told just where the tensor is there.
    fn place<T>(&self, name: &str, place: Option<T>) -> Result<Option<T>> {
        match place.is_some() == self.has(name) {
            true => Ok(place),
            false => {
                Err(Error::file(&self.path, format!("tensor '{name}' and key '{name}' of {DESCRIPTION} must both be there, or neither")))
            }
        }
    }

    fn mesh(&self, objects: Vec<String>, materials: Vec<Material>) -> Result<Option<TriMesh>> {
        if !self.has("vertices") {
            return Ok(None);
        }
        let vertices = self.tensors.f32s("vertices", &[0, 3])?.as_chunks::<3>().0.iter().map(|&v| v.into()).collect::<Vec<Vec3>>();
        let triangles = self.tensors.indices("triangles", &[0, 3], vertices.len())?;
        let n = triangles.len() / 3;
        let shorts = |name: &str, limit: usize| -> Result<Vec<u16>> {
            Ok(self.tensors.indices(name, &[n], limit)?.into_iter().map(|i| i as u16).collect())
        };
        let (object, material) = (shorts("object", objects.len())?, shorts("material", materials.len())?);
        let triangles = triangles.as_chunks::<3>().0.iter().map(|t| t.map(|i| i as u32)).collect();
        let mesh = TriMesh { vertices, triangles, object, material, objects, materials };
        mesh.check().map_err(|e| Error::file(&self.path, e.to_string()))?;
        Ok(Some(mesh))
    }

    fn blocked(&self, place: Option<Cells>) -> Result<Option<Grid>> {
        let Some(Cells { lowest, cell }) = self.place("blocked", place)? else { return Ok(None) };
        if !(cell > 0.0 && cell.is_finite() && lowest.is_finite()) {
            return Err(Error::file(&self.path, format!("cells of {cell} m from {lowest}, expected finite metres")));
        }
        let shape = self.tensors.shape("blocked")?;
        let cells = self.tensors.indices("blocked", &[0, 0], 2)?.into_iter().map(|c| c == 1).collect();
        Ok(Some(Grid { lowest, cell, dims: [shape[1], shape[0]], cells }))
    }

    fn sdf(&self, place: Option<Voxels>) -> Result<Option<SdfGrid>> {
        let Some(Voxels { lowest, voxel }) = self.place("sdf", place)? else { return Ok(None) };
        let values = self.tensors.f32s("sdf", &[0, 0, 0])?;
        let shape = self.tensors.shape("sdf")?;
        let grid = SdfGrid { lowest, voxel, dims: [shape[0], shape[1], shape[2]], values };
        grid.check().map_err(|e| Error::file(&self.path, e.to_string()))?;
        Ok(Some(grid))
    }

    fn pairs(&self) -> Result<Vec<Pair>> {
        if !self.has("pairs") {
            return Ok(Vec::new());
        }
        let points = self.tensors.f32s("pairs", &[0, 2, 2])?;
        let n = points.len() / 4;
        let (ways, bend) = (self.tensors.f32s("ways", &[n])?, self.tensors.indices("ways_bend", &[n], 2)?);
        let pair = |(([a, b, c, d], way), bend): ((&[f32; 4], f32), usize)| {
            let (start, goal) = (Vec2::new(*a, *b), Vec2::new(*c, *d));
            Pair { start, goal, way, blocked: bend == 1 }
        };
        Ok(points.as_chunks::<4>().0.iter().zip(ways).zip(bend).map(pair).collect())
    }
}

#[cfg(test)]
pub(super) mod tests;
