//! Scene bundles from meshes, procedural rooms and the files that others keep scenes in.

use super::mesh::{Format, Up};
use super::outline::parse_polygon;
use super::pairs::parse_pairs;
use super::walkable::outline;
use super::{
    Grid, MeshOptions, Navigator, Pair, PairOptions, Polygon, Room, SceneBundle, SdfGrid, SdfOptions, Walkable, WalkableOptions,
    floor_height, navmesh_polygon,
};
use crate::io::content_hash;
use crate::{Error, Result};
use glam::{DVec2, Vec2};
use rayon::prelude::*;
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

impl MakeOptions {
    /// Refuses values with which no bundle could be made.
    pub fn validate(&self) -> Result<()> {
        self.walkable.validate()?;
        self.pairs.validate()?;
        match self.voxel == 0.0 || (0.005..=1.0).contains(&self.voxel) {
            true => Ok(()),
            false => Err(Error::invalid(format!("voxel is {}, expected 0.005 to 1 m, or 0 for no distances", self.voxel))),
        }
    }
}

/// Files of a scene that others made; at least one of the first three must be given.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneFiles {
    /// The walkable area: JSON or WKT.
    pub polygon: Option<PathBuf>,
    /// A navigation mesh, metres, z up: the walkable area where no polygon is given, and the height of the floor where that is not.
    pub navmesh: Option<PathBuf>,
    /// Signed distances; the walkable area where neither of the others is given.
    pub sdf: Option<PathBuf>,
    /// Starts and goals.
    pub pairs: Option<PathBuf>,
}

/// Told of each stage when it begins.
pub type Stages<'a> = &'a mut dyn FnMut(&str);

/// What a bundle is made from: names of files and the SHA-256 of their content.
#[derive(Default)]
struct Origin(BTreeMap<String, String>);

impl Origin {
    /// The content of a file, which is written down as `what`.
    fn read(&mut self, what: &str, path: &Path) -> Result<Vec<u8>> {
        let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
        let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        self.0.insert(what.into(), format!("{name} {}", content_hash(&bytes)));
        Ok(bytes)
    }
}

impl SceneBundle {
    /// The bundle of the mesh in the file `path`, and what the reader of the file warns of.
    pub fn of_file(path: &Path, reading: &MeshOptions, options: &MakeOptions, stages: Stages) -> Result<(Self, Vec<String>)> {
        options.validate()?;
        stages("mesh");
        let mut origin = Origin::default();
        let imported = Format::of(path)?.parse(path, &origin.read("mesh", path)?, reading)?;
        let name = path.file_stem().map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned());
        let make = || -> Result<_> {
            stages("floor and walkable area");
            let found = Walkable::of_mesh(&imported.mesh, &options.walkable)?;
            let mut bundle = Self::bare(name, origin, found.floor, found.polygon, options);
            (bundle.mesh, bundle.blocked) = (Some(imported.mesh), Some(found.blocked));
            bundle.pair(options, stages)?;
            bundle.measure(options, stages)?;
            Ok(bundle)
        };
        Ok((make().map_err(|e| in_file(path, e))?, imported.warnings))
    }

    /// The bundle of a procedural room, whose floor and walkable area are known.
    pub fn of_room(room: Room, options: &MakeOptions, stages: Stages) -> Result<Self> {
        options.validate()?;
        let origin = Origin(BTreeMap::from([("room".into(), room.name.clone())]));
        let blocked = Grid::of_polygon(&room.walkable, options.walkable.cell)?.inverse();
        let mut bundle = Self::bare(room.name, origin, 0.0, room.walkable, options);
        (bundle.mesh, bundle.blocked) = (Some(room.mesh), Some(blocked));
        bundle.pair(options, stages)?;
        bundle.measure(options, stages)?;
        Ok(bundle)
    }

    /// A bundle of what must be known.
    fn bare(name: String, origin: Origin, floor: f32, walkable: Polygon, options: &MakeOptions) -> Self {
        let clearance = options.pairs.clearance;
        Self { name, floor, walkable, origin: origin.0, mesh: None, blocked: None, sdf: None, clearance, pairs: Vec::new() }
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

    /// The bundle of files that others made, and what the reader of a navigation mesh warns of. Pairs are drawn where no file of them is
    /// given. Everything is z up, in metres.
    pub fn of_files(name: String, files: &SceneFiles, options: &MakeOptions, stages: Stages) -> Result<(Self, Vec<String>)> {
        options.validate()?;
        let mut origin = Origin::default();
        stages("floor and walkable area");
        let sdf = files.sdf.as_ref().map(|path| SdfGrid::parse(path, &origin.read("sdf", path)?)).transpose()?;
        let reading = MeshOptions { up: Some(Up::Z), unit: Some(1.0) };
        let navmesh = |path| -> Result<_> { Ok((path, Format::of(path)?.parse(path, &origin.read("navmesh", path)?, &reading)?)) };
        let navmesh = files.navmesh.as_deref().map(navmesh).transpose()?;
        let floor = match (options.walkable.floor, &navmesh) {
            (Some(floor), _) => floor,
            (None, Some((path, found))) => floor_height(&found.mesh).map_err(|e| in_file(path, e))?,
            (None, None) => 0.0,
        };
        let walkable = match (&files.polygon, &navmesh, &sdf) {
            (Some(_), Some((path, _)), _) if options.walkable.floor.is_some() => {
                return Err(Error::file(
                    path,
                    "would tell nothing: the walkable area is the polygon's, and the height of the floor is given",
                ));
            }
            (Some(path), ..) => parse_polygon(path, &origin.read("polygon", path)?)?,
            (None, Some((path, found)), _) => navmesh_polygon(&found.mesh).map_err(|e| in_file(path, e))?,
            (None, None, Some(grid)) => free_floor(grid, floor, &options.walkable)?,
            (None, None, None) => return Err(Error::invalid("no walkable area: give a polygon, a navigation mesh or signed distances")),
        };
        let pairs = |path| -> Result<_> { Ok((path, parse_pairs(path, &origin.read("pairs", path)?)?)) };
        let pairs = files.pairs.as_deref().map(pairs).transpose()?;
        let mut bundle = Self { sdf, ..Self::bare(name, origin, floor, walkable, options) };
        match pairs {
            Some((path, pairs)) => {
                stages("starts and goals");
                bundle.pairs = judge(path, &pairs, &Navigator::new(&bundle.walkable, bundle.clearance.into())?)?;
            }
            None => bundle.pair(options, stages)?,
        }
        Ok((bundle, navmesh.map_or_else(Vec::new, |(_, found)| found.warnings)))
    }
}

/// What there is to know of the pairs of a file.
fn judge(path: &Path, pairs: &[[Vec2; 2]], navigator: &Navigator) -> Result<Vec<Pair>> {
    let judge = |(i, &[start, goal]): (usize, &[Vec2; 2])| {
        Pair::judge(navigator, start, goal).map_err(|e| Error::file(path, format!("pair {i}: {e}")))
    };
    let judged: Vec<Result<Pair>> = pairs.par_iter().enumerate().map(judge).collect();
    // The first error is the first pair's, whichever thread came to one first.
    judged.into_iter().collect()
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
        assert_eq!(stages, ["starts and goals", "signed distances"]);
        assert_eq!((bundle.pairs.len(), &bundle.walkable, bundle.floor), (8, &room.walkable, 0.0));
        let blocked = bundle.blocked.as_ref().unwrap();
        for p in blocked.centres().chain(blocked.inverse().centres()) {
            assert!(blocked.holds(p) != room.walkable.contains(p) || room.walkable.border_distance(p) < 1e-6, "{p}");
        }
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
        let make = |files: &SceneFiles| SceneBundle::of_files("scene".into(), files, &options(), &mut |_| ()).map(|(bundle, _)| bundle);
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

    #[test]
    fn navmeshes_are_metres_with_z_up() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        // 30 x 24 m at a height of 1.5 m: OBJ would have y up, and so large a mesh would be taken to be in centimetres.
        fs::write(path("floor.obj"), "v 0 0 1.5\nv 30 0 1.5\nv 30 24 1.5\nv 0 24 1.5\nf 1 2 3 4\n").unwrap();
        fs::write(path("wall.obj"), "v 0 0 0\nv 3 0 0\nv 3 0 3\nv 0 0 3\nf 1 2 3 4\n").unwrap();
        fs::write(path("area.json"), "[[0, 0], [9, 0], [9, 9], [0, 9]]").unwrap();
        let some = |name: &str| Some(path(name));
        let with = |polygon: Option<PathBuf>, navmesh: &str, floor: Option<f32>| {
            let files = SceneFiles { polygon, navmesh: some(navmesh), ..Default::default() };
            let pairs = PairOptions { count: 0, ..Default::default() };
            let options = MakeOptions { walkable: WalkableOptions { floor, ..Default::default() }, pairs, ..options() };
            SceneBundle::of_files("scene".into(), &files, &options, &mut |_| ())
        };
        let (bundle, warnings) = with(None, "floor.obj", None).unwrap();
        assert_eq!((bundle.floor, bundle.walkable.bounds(), warnings.len()), (1.5, (DVec2::ZERO, DVec2::new(30.0, 24.0)), 0));
        assert!(bundle.origin["navmesh"].starts_with("floor.obj "));
        assert_eq!(with(some("area.json"), "floor.obj", None).unwrap().0.floor, 1.5);
        assert_eq!(with(None, "floor.obj", Some(0.25)).unwrap().0.floor, 0.25);
        for (polygon, navmesh, floor, word) in [
            (None, "wall.obj", None, "wall.obj: no floor"),
            (None, "wall.obj", Some(0.0), "wall.obj: no navigation mesh"),
            (some("area.json"), "floor.obj", Some(0.0), "floor.obj: would tell nothing"),
        ] {
            let e = with(polygon, navmesh, floor).unwrap_err().to_string();
            assert!(e.contains(word), "{word}: {e}");
        }
    }

    #[test]
    fn unusable_options_are_named() {
        let room = Rooms { kind: RoomKind::Box, difficulty: 0.0 }.draw(0).unwrap();
        for (change, word) in [
            ((|o| o.voxel = f32::NAN) as fn(&mut MakeOptions), "voxel is NaN"),
            (|o| o.voxel = -0.1, "voxel is -0.1"),
            (|o| o.walkable.floor = Some(f32::INFINITY), "walkable.floor"),
            (|o| o.pairs.clearance = 0.0, "pairs.clearance"),
        ] {
            let mut bad = options();
            change(&mut bad);
            let e = SceneBundle::of_room(room.clone(), &bad, &mut |stage| panic!("{stage} has begun")).unwrap_err().to_string();
            assert!(e.contains(word), "{word}: {e}");
        }
    }
}
