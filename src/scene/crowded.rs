//! Crowded scenes: many rooms, each with what walking and penetration need, made once and kept.

use super::{Depths, Navigator, Pair, PairOptions, Probe, Room, RoomKind, Rooms, Scene, SdfGrid, SdfOptions, Setting, Split, TriMesh};
use crate::rng::{Stream, stream};
use crate::{Error, Result};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
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
}

impl Default for CrowdedScenes {
    fn default() -> Self {
        let pairs = PairOptions { count: 64, ..Default::default() };
        Self { kind: RoomKind::Furnished, difficulty: [0.0, 0.7], count: 32, split: None, pairs, voxel: 0.1 }
    }
}

/// One room, ready.
#[derive(Clone, Debug)]
pub struct CrowdedScene {
    pub name: String,
    pub scene: Scene,
    pub mesh: TriMesh,
    pub sdf: SdfGrid,
    depths: Depths,
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
        let seeds: Vec<u64> = self.split.unwrap_or(split).seeds().take(self.count).collect();
        let scenes = Arc::new(seeds.into_par_iter().map(|seed| key.draw_room(seed)).collect::<Result<Vec<_>>>()?);
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
        let (depths, scene) = (Depths::new(&sdf), Scene { walkable: room.walkable, obstacles: Vec::new() });
        Ok(Self { name: room.name, scene, mesh: room.mesh, sdf, depths, pairs })
    }

    /// Look-ups of its distances.
    pub fn probe(&self) -> Probe<'_> {
        self.depths.probe(&self.sdf)
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
    fn unusable_values_are_named() {
        let base = CrowdedScenes::default;
        for (config, key) in [
            (CrowdedScenes { difficulty: [0.5, 0.4], ..base() }, "rooms.difficulty"),
            (CrowdedScenes { count: 0, ..base() }, "rooms.count"),
            (CrowdedScenes { voxel: 0.5, ..base() }, "rooms.voxel"),
        ] {
            assert!(config.validate("rooms").unwrap_err().to_string().contains(key), "{key}");
        }
    }
}
