//! Scene bundles from meshes, procedural rooms and the files that others keep scenes in.

use super::walkable::outline;
use super::{
    Grid, MeshOptions, Navigator, Pair, PairOptions, Polygon, Room, SceneBundle, SdfGrid, SdfOptions, TriMesh, Walkable, WalkableOptions,
    floor_height, navmesh_polygon, read_mesh, read_pairs, read_polygon,
};
use crate::io::content_hash;
use crate::{Error, Result};
use glam::{DVec2, Vec2};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// How a bundle is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MakeOptions {
    pub walkable: WalkableOptions,
    /// Side of the voxels of the distances, metres; none are made where it is 0.
    pub voxel: f32,
    pub pairs: PairOptions,
    /// Of the pairs.
    pub seed: u64,
}

impl Default for MakeOptions {
    fn default() -> Self {
        Self { walkable: WalkableOptions::default(), voxel: 0.05, pairs: PairOptions::default(), seed: 0 }
    }
}

/// Files of a scene that others made; at least one of the first three must be given.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneFiles {
    /// The walkable area: JSON or WKT.
    pub polygon: Option<PathBuf>,
    /// A navigation mesh: the walkable area where no polygon is given, and the height of the floor.
    pub navmesh: Option<PathBuf>,
    /// Signed distances; the walkable area where neither of the others is given.
    pub sdf: Option<PathBuf>,
    /// Starts and goals.
    pub pairs: Option<PathBuf>,
}

/// Told of each stage when it begins.
pub type Stages<'a> = &'a mut dyn FnMut(&str);

impl SceneBundle {
    /// The bundle of the mesh in the file `path`, and what the reader of the file warns of.
    pub fn of_file(path: &Path, reading: &MeshOptions, options: &MakeOptions, stages: Stages) -> Result<(Self, Vec<String>)> {
        stages("mesh");
        let imported = read_mesh(path, reading)?;
        let mut origin = BTreeMap::new();
        note(&mut origin, "mesh", path)?;
        let name = path.file_stem().map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned());
        let bundle = Self::of_mesh(name, origin, imported.mesh, None, options, stages);
        Ok((bundle.map_err(|e| in_file(path, e))?, imported.warnings))
    }

    /// The bundle of a procedural room.
    pub fn of_room(room: Room, options: &MakeOptions, stages: Stages) -> Result<Self> {
        let origin = BTreeMap::from([("room".into(), room.name.clone())]);
        Self::of_mesh(room.name, origin, room.mesh, Some(room.walkable), options, stages)
    }

    /// The bundle of a mesh whose walkable area is found unless it is known, with distances and pairs.
    fn of_mesh(
        name: String,
        origin: BTreeMap<String, String>,
        mesh: TriMesh,
        known: Option<Polygon>,
        options: &MakeOptions,
        stages: Stages,
    ) -> Result<Self> {
        stages("floor and walkable area");
        let found = Walkable::of_mesh(&mesh, &options.walkable)?;
        let walkable = known.unwrap_or(found.polygon);
        let mut bundle = Self {
            name,
            floor: found.floor,
            walkable,
            origin,
            mesh: Some(mesh),
            blocked: Some(found.blocked),
            sdf: None,
            clearance: options.pairs.clearance,
            pairs: Vec::new(),
        };
        bundle.measure(options, stages)?;
        bundle.pair(options, stages)?;
        Ok(bundle)
    }

    /// Adds the distances to the mesh.
    fn measure(&mut self, options: &MakeOptions, stages: Stages) -> Result<()> {
        stages("signed distances");
        let Some(mesh) = self.mesh.as_ref().filter(|_| options.voxel != 0.0) else { return Ok(()) };
        let layout = SdfOptions { voxel: options.voxel, ..SdfOptions::for_floor(&self.walkable, self.floor)? };
        self.sdf = Some(SdfGrid::build(mesh, &layout)?);
        Ok(())
    }

    /// Draws the pairs.
    fn pair(&mut self, options: &MakeOptions, stages: Stages) -> Result<()> {
        stages("starts and goals");
        if options.pairs.count > 0 {
            let navigator = Navigator::new(&self.walkable, options.pairs.clearance.into())?;
            self.pairs = options.pairs.draw(&navigator, options.seed)?;
        }
        Ok(())
    }

    /// The bundle of files that others made; pairs are drawn where no file of them is given. Everything is z up, in metres.
    pub fn of_files(name: String, files: &SceneFiles, options: &MakeOptions, stages: Stages) -> Result<Self> {
        let mut origin = BTreeMap::new();
        let named = [("polygon", &files.polygon), ("navmesh", &files.navmesh), ("sdf", &files.sdf), ("pairs", &files.pairs)];
        for (what, path) in named.into_iter().filter_map(|(what, path)| Some((what, path.as_ref()?))) {
            note(&mut origin, what, path)?;
        }
        stages("signed distances");
        let sdf = files.sdf.as_ref().map(SdfGrid::read).transpose()?;
        stages("floor and walkable area");
        let navmesh = files.navmesh.as_ref().map(|path| read_mesh(path, &MeshOptions::default())).transpose()?.map(|m| m.mesh);
        let level = navmesh.as_ref().map(floor_height).transpose()?;
        let floor = options.walkable.floor.or(level).unwrap_or(0.0);
        let walkable = match (&files.polygon, &navmesh, &sdf) {
            (Some(path), ..) => read_polygon(path)?,
            (None, Some(mesh), _) => navmesh_polygon(mesh)?,
            (None, None, Some(grid)) => free_floor(grid, floor, &options.walkable)?,
            (None, None, None) => return Err(Error::invalid("no walkable area: give a polygon, a navigation mesh or signed distances")),
        };
        let clearance = options.pairs.clearance;
        let mut bundle = Self { name, floor, walkable, origin, mesh: None, blocked: None, sdf, clearance, pairs: Vec::new() };
        match &files.pairs {
            Some(path) => {
                stages("starts and goals");
                let navigator = Navigator::new(&bundle.walkable, clearance.into())?;
                let judged = read_pairs(path)?.into_iter().enumerate();
                let judge = |(i, [start, goal]): (usize, [Vec2; 2])| {
                    Pair::judge(&navigator, start, goal).map_err(|e| Error::file(path, format!("pair {i}: {e}")))
                };
                bundle.pairs = judged.map(judge).collect::<Result<_>>()?;
            }
            None => bundle.pair(options, stages)?,
        }
        Ok(bundle)
    }
}

/// Writes down a file and the SHA-256 of its content.
fn note(origin: &mut BTreeMap<String, String>, what: &str, path: &Path) -> Result<()> {
    let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
    let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    origin.insert(what.into(), format!("{name} {}", content_hash(&bytes)));
    Ok(())
}

/// Names the file in what is wrong with its content.
fn in_file(path: &Path, error: Error) -> Error {
    match error {
        Error::Invalid(what) => Error::file(path, what),
        other => other,
    }
}

/// Where nothing of a distance grid is in a person's way: columns of samples that are all positive.
fn free_floor(grid: &SdfGrid, floor: f32, options: &WalkableOptions) -> Result<Polygon> {
    let [nx, ny, nz] = grid.dims;
    let height = |k: usize| f64::from(grid.centre([0, 0, k]).z - floor);
    let heights: Vec<usize> = (0..nz).filter(|&k| height(k) > options.low && height(k) < options.high).collect();
    let cell = f64::from(grid.voxel);
    let lowest = grid.lowest.truncate().as_dvec2() - DVec2::splat(1.5 * cell);
    // A border of one cell all round.
    let dims = [nx + 2, ny + 2];
    let free = |i: usize, j: usize| heights.iter().all(|&k| grid.values[(i * ny + j) * nz + k] > 0.0);
    let within = |c: usize| {
        let (i, j) = (c % dims[0], c / dims[0]);
        (1..=nx).contains(&i) && (1..=ny).contains(&j) && free(i - 1, j - 1)
    };
    let free = Grid { lowest, cell, dims, cells: (0..dims[0] * dims[1]).map(within).collect() };
    match free.largest_part().filter(|_| !heights.is_empty()) {
        Some(part) => outline(&part, 0.75 * cell),
        None => Err(Error::invalid(format!(
            "no walkable area: the distances show none free from {} to {} m above the floor at z = {floor}",
            options.low, options.high
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{RoomKind, Rooms, write_pairs};
    use glam::Vec3;

    fn options() -> MakeOptions {
        MakeOptions { voxel: 0.15, pairs: PairOptions { count: 8, ..Default::default() }, ..Default::default() }
    }

    #[test]
    fn a_room_has_everything() {
        let room = Rooms { kind: RoomKind::Corridor, difficulty: 0.3 }.draw(2).unwrap();
        let mut stages = Vec::new();
        let bundle = SceneBundle::of_room(room.clone(), &options(), &mut |s| stages.push(s.to_string())).unwrap();
        assert_eq!(stages, ["floor and walkable area", "signed distances", "starts and goals"]);
        assert_eq!((bundle.pairs.len(), &bundle.walkable, bundle.floor.abs() < 1e-3), (8, &room.walkable, true));
        let sdf = bundle.sdf.as_ref().unwrap();
        // Standing people are in free space.
        for pair in &bundle.pairs {
            assert!(sdf.at(pair.start.extend(0.3)) > 0.1 && sdf.at(pair.goal.extend(1.0)) > 0.1);
        }
        let again = SceneBundle::of_room(room, &options(), &mut |_| ()).unwrap();
        assert_eq!(again, bundle);
    }

    #[test]
    fn files_alone_and_together() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        fs::write(path("area.wkt"), "POLYGON ((-3 -2, 3 -2, 3 2, -3 2, -3 -2), (-0.5 -0.5, 0.5 -0.5, 0.5 0.5, -0.5 0.5, -0.5 -0.5))")
            .unwrap();
        let pair = |y: f32| Pair { start: Vec2::new(-1.5, y), goal: Vec2::new(1.5, y), way: 0.0, blocked: false };
        write_pairs(&path("pairs.npy"), &[pair(0.0), pair(1.5)]).unwrap();
        // A block of 1 m on a floor of 6 x 4 m: outside the floor and in the block distances are negative.
        let (lowest, voxel, dims) = (Vec3::new(-3.95, -2.95, 0.05), 0.1, [80, 60, 15]);
        let mut sdf = SdfGrid { lowest, voxel, dims, values: Vec::new() };
        let centres = (0..80).flat_map(|i| (0..60).flat_map(move |j| (0..15).map(move |k| [i, j, k])));
        sdf.values = centres
            .map(|c| sdf.centre(c))
            .map(|p| (3.0 - p.x.abs()).min(2.0 - p.y.abs()).min((p.x.abs() - 0.5).max(p.y.abs() - 0.5).max(p.z - 1.0)))
            .collect();
        sdf.write(path("sdf.npz")).unwrap();
        let make = |files: &SceneFiles| SceneBundle::of_files("scene".into(), files, &options(), &mut |_| ());
        let some = |name: &str| Some(path(name));
        let all = SceneFiles { polygon: some("area.wkt"), navmesh: None, sdf: some("sdf.npz"), pairs: some("pairs.npy") };
        let bundle = make(&all).unwrap();
        assert_eq!((bundle.pairs.len(), bundle.pairs[0].blocked, bundle.pairs[1].blocked, bundle.pairs[1].way), (2, true, false, 3.0));
        assert!(bundle.sdf.is_some() && bundle.origin["polygon"].starts_with("area.wkt "));
        assert_eq!(make(&SceneFiles { polygon: some("area.wkt"), ..Default::default() }).unwrap().pairs.len(), 8);
        let by_sdf = make(&SceneFiles { sdf: some("sdf.npz"), ..Default::default() }).unwrap().walkable;
        assert_eq!(by_sdf.holes().len(), 1);
        assert!((by_sdf.bounds().1 - DVec2::new(3.0, 2.0)).length() < 1e-5 && (by_sdf.border_distance(DVec2::X) - 0.5).abs() < 1e-5);
        let none = make(&SceneFiles { pairs: some("pairs.npy"), ..Default::default() }).unwrap_err().to_string();
        assert!(none.contains("no walkable area"), "{none}");
        write_pairs(&path("pairs.npy"), &[pair(1.0), pair(9.0)]).unwrap();
        let e = make(&all).unwrap_err().to_string();
        assert!(e.contains("pairs.npy: pair 1: (-1.5, 9) is not walkable"), "{e}");
    }
}
