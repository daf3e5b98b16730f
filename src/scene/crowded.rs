//! Crowded scenes: many rooms, procedural or from bundles, each with what walking and penetration need, made or read once and kept.

use super::{Navigator, Pair, PairOptions, Room, RoomKind, Rooms, Scene, SceneBundle, SdfGrid, SdfOptions, Setting, Split, TriMesh};
use crate::rng::{Stream, stream};
use crate::{Error, Result};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Height that people do not reach, metres; distances are not kept above it.
const REACH: f32 = 2.2;

/// How crowded scenes are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CrowdedScenes {
    pub kind: RoomKind,
    /// Lowest and highest difficulty, drawn uniformly per room; see [`Rooms`].
    pub difficulty: [f32; 2],
    /// Rooms to draw from; episodes choose among them and their pairs at random.
    pub count: usize,
    /// Which rooms; absent: those of training for training, those of validation for tests.
    pub split: Option<Split>,
    /// Starts and goals of each room.
    pub pairs: PairOptions,
    /// Side of the voxels of the signed distance, metres.
    pub voxel: f32,
    /// Scenes from files instead of procedural rooms, with pairs and distances of their own; then only `split` matters of the above.
    pub bundles: Option<BundleFolders>,
}

/// Folders of scene bundles, as the program `scene` writes them. What is not absolute counts from the folder in which the program was
/// started.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleFolders {
    /// For training.
    pub train: Vec<PathBuf>,
    /// For validation, which is what `evaluate` and `play` show; none: those of training.
    pub validation: Vec<PathBuf>,
    /// For the test; none: those of training.
    pub test: Vec<PathBuf>,
}

impl BundleFolders {
    fn of(&self, split: Split) -> &[PathBuf] {
        let own = match split {
            Split::Train => &self.train,
            Split::Validation => &self.validation,
            Split::Test => &self.test,
        };
        if own.is_empty() { &self.train } else { own }
    }
}

impl Default for CrowdedScenes {
    fn default() -> Self {
        let pairs = PairOptions { count: 64, ..Default::default() };
        Self { kind: RoomKind::Furnished, difficulty: [0.0, 0.7], count: 32, split: None, pairs, voxel: 0.1, bundles: None }
    }
}

/// One room, ready.
#[derive(Clone, Debug)]
pub struct CrowdedScene {
    pub name: String,
    pub scene: Scene,
    /// None where it is not known.
    pub mesh: Option<Arc<TriMesh>>,
    pub sdf: Arc<SdfGrid>,
    pub pairs: Vec<Pair>,
}

impl CrowdedScenes {
    /// Refuses values from which no scene could be drawn; `key` names them in errors.
    pub fn validate(&self, key: &str) -> Result<()> {
        let need = |ok: bool, what: &str, right: &str| {
            if ok { Ok(()) } else { Err(Error::invalid(format!("{key}.{what}: expected {right}"))) }
        };
        let [low, high] = self.difficulty;
        need(0.0 <= low && low <= high && high <= 1.0, "difficulty", "[low, high] from 0 to 1")?;
        need((1..=100_000).contains(&self.count), "count", "1 to 100000 rooms")?;
        need(self.pairs.count >= 1, "pairs.count", "1 or more")?;
        need((0.01..=0.2).contains(&self.voxel), "voxel", "0.01 to 0.2 m")?;
        let folders = self.bundles.as_ref().is_none_or(|b| !b.train.is_empty());
        need(folders, "bundles.train", "one or more folders that the program `scene` wrote")?;
        self.pairs.validate().map_err(|e| Error::invalid(format!("{key}.{e}")))
    }

    /// The scenes of `split` (or of this configuration's own). What was made once in a process is kept, so that environments share it.
    pub fn make(&self, split: Split) -> Result<Arc<Vec<CrowdedScene>>> {
        type Kept = Vec<(CrowdedScenes, Arc<Vec<CrowdedScene>>)>;
        static KEPT: Mutex<Kept> = Mutex::new(Vec::new());
        let key = Self { split: Some(self.split.unwrap_or(split)), ..self.clone() };
        let mut kept = KEPT.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some((_, scenes)) = kept.iter().find(|(k, _)| *k == key) {
            return Ok(scenes.clone());
        }
        let split = self.split.unwrap_or(split);
        let scenes = Arc::new(match &self.bundles {
            Some(folders) => folders.of(split).par_iter().map(|dir| CrowdedScene::read(dir)).collect::<Result<Vec<_>>>()?,
            None => {
                let seeds: Vec<u64> = split.seeds().take(self.count).collect();
                seeds.into_par_iter().map(|seed| key.draw_room(seed)).collect::<Result<Vec<_>>>()?
            }
        });
        kept.push((key, scenes.clone()));
        Ok(scenes)
    }

    fn draw_room(&self, seed: u64) -> Result<CrowdedScene> {
        let difficulty = stream(seed, "difficulty", 0).random_range(self.difficulty[0]..=self.difficulty[1]);
        let room = Rooms { kind: self.kind, difficulty }.draw(seed)?;
        CrowdedScene::new(room, &self.pairs, self.voxel, seed).map_err(|e| Error::invalid(format!("room of seed {seed}: {e}")))
    }
}

impl CrowdedScene {
    /// A room with its distances, and pairs drawn by `seed`.
    pub fn new(room: Room, pairs: &PairOptions, voxel: f32, seed: u64) -> Result<Self> {
        let pairs = pairs.draw(&Navigator::new(&room.walkable, pairs.clearance.into())?, seed)?;
        let layout = SdfOptions { voxel, top: Some(REACH), ..SdfOptions::for_floor(&room.walkable, 0.0)? };
        let sdf = SdfGrid::build(&room.mesh, &layout)?;
        let scene = Scene { walkable: room.walkable, obstacles: Vec::new() };
        Ok(Self { name: room.name, scene, mesh: Some(Arc::new(room.mesh)), sdf: Arc::new(sdf), pairs })
    }

    /// The scene of the bundle in the folder `dir`, with its floor at z = 0. Pairs without a way are left out.
    ///
    /// Errors: what [`SceneBundle::read`] refuses, and a bundle without distances or without pairs that a person can walk between.
    pub fn read(dir: &Path) -> Result<Self> {
        let SceneBundle { name, walkable, mesh, sdf, mut pairs, .. } = SceneBundle::read(dir)?.on_floor();
        let lack =
            |what: &str, with: &str| Error::file(dir, format!("holds no {what}, which playing in it needs; make the scene with {with}"));
        pairs.retain(|p| p.way > 0.0);
        if pairs.is_empty() {
            return Err(lack("pairs with a way from start to goal", "--pairs-count"));
        }
        let sdf = sdf.ok_or_else(|| lack("signed distances", "--voxel 0.05"))?;
        let scene = Scene { walkable, obstacles: Vec::new() };
        Ok(Self { name, scene, mesh: mesh.map(Arc::new), sdf: Arc::new(sdf), pairs })
    }

    /// One of the pairs.
    pub fn draw(&self, rng: &mut Stream) -> Setting {
        let pair = self.pairs[rng.random_range(0..self.pairs.len())];
        Setting { scene: self.scene.clone(), start: pair.start, goal: pair.goal }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Vec2, Vec3};

    #[test]
    fn rooms_are_made_once_and_differ_between_splits() {
        let pairs = PairOptions { count: 5, ..Default::default() };
        let config = CrowdedScenes { count: 2, pairs, voxel: 0.2, ..Default::default() };
        config.validate("rooms").unwrap();
        let train = config.make(Split::Train).unwrap();
        assert!(Arc::ptr_eq(&train, &config.make(Split::Train).unwrap()));
        let test = CrowdedScenes { split: Some(Split::Test), ..config }.make(Split::Train).unwrap();
        assert_eq!((train.len(), test.len()), (2, 2));
        assert!(train.iter().all(|a| test.iter().all(|b| a.name != b.name)));
        for scene in train.iter() {
            assert_eq!(scene.pairs.len(), 5);
            for pair in &scene.pairs {
                // Breast-high above a start there is room; beyond the walls there is none.
                assert!(scene.sdf.at(pair.start.extend(1.2)) > 0.0, "{}", scene.name);
                assert!(scene.scene.walkable.contains(pair.goal.as_dvec2()));
            }
        }
    }

    #[test]
    fn bundles_are_played_in_on_their_own_floor() {
        let dir = tempfile::tempdir().unwrap();
        let room = Rooms { kind: RoomKind::Box, difficulty: 0.0 }.draw(1).unwrap();
        let pair = |way: f32| Pair { start: Vec2::new(1.5, 0.0), goal: Vec2::new(-1.5, 0.0), way, blocked: true };
        let mut bundle = SceneBundle {
            name: "attic".into(),
            floor: 3.0,
            walkable: room.walkable,
            origin: Default::default(),
            mesh: Some(TriMesh { vertices: room.mesh.vertices.iter().map(|v| *v + 3.0 * Vec3::Z).collect(), ..room.mesh }),
            blocked: None,
            sdf: Some(SdfGrid { lowest: Vec3::new(-9.0, -9.0, 3.5), voxel: 9.0, dims: [2, 2, 2], values: vec![1.0; 8] }),
            clearance: 0.22,
            pairs: vec![pair(0.0), pair(3.4)],
        };
        let (good, bad) = (dir.path().join("good"), dir.path().join("bad"));
        bundle.write(&good, b"").unwrap();
        bundle.pairs.pop();
        bundle.write(&bad, b"").unwrap();
        let config = |train: &Path, test: Vec<PathBuf>| CrowdedScenes {
            bundles: Some(BundleFolders { train: vec![train.into()], test, ..Default::default() }),
            ..Default::default()
        };
        // Validation falls back on what is trained in.
        let scenes = config(&good, vec![bad.clone()]).make(Split::Validation).unwrap();
        let scene = &scenes[0];
        assert_eq!((scene.name.as_str(), scene.pairs.len(), scene.sdf.lowest.z), ("attic", 1, 0.5));
        assert!(scene.mesh.as_ref().unwrap().bounds().unwrap().0.z.abs() < 0.02);
        let error = config(&good, vec![bad]).make(Split::Test).unwrap_err().to_string();
        assert!(error.contains("bad: holds no pairs") && error.contains("--pairs-count"), "{error}");
        assert!(config(Path::new("gone"), Vec::new()).make(Split::Train).unwrap_err().to_string().contains("gone"));
        bundle.pairs = vec![pair(3.4)];
        bundle.sdf = None;
        bundle.write(&good, b"").unwrap();
        assert!(CrowdedScene::read(&good).unwrap_err().to_string().contains("good: holds no signed distances"));
    }

    #[test]
    fn unusable_values_are_named() {
        let base = CrowdedScenes::default;
        for (config, key) in [
            (CrowdedScenes { difficulty: [0.5, 0.4], ..base() }, "rooms.difficulty"),
            (CrowdedScenes { count: 0, ..base() }, "rooms.count"),
            (CrowdedScenes { voxel: 0.5, ..base() }, "rooms.voxel"),
            (CrowdedScenes { bundles: Some(BundleFolders::default()), ..base() }, "rooms.bundles.train"),
        ] {
            assert!(config.validate("rooms").unwrap_err().to_string().contains(key), "{key}");
        }
    }
}
