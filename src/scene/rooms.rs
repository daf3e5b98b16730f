//! Procedural rooms: meshes of floor, walls and furniture, with the walkable area that they leave.

pub mod furniture;
mod layout;
mod plan;
pub mod shell;

use super::{Polygon, SparseScenes, TriMesh};
use crate::rng::stream;
use crate::{Error, Result};
use furniture::{Kind, Palette, Piece, add_prism};
use serde::{Deserialize, Serialize};
use shell::Shell;
use std::ops::Range;

/// What a room is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RoomKind {
    /// One box on a square floor, as [`SparseScenes`] draws it.
    Box,
    /// A living room, dining room, bedroom or office.
    #[default]
    Furnished,
    /// A corridor, straight or with bends or a fork.
    Corridor,
    /// A hall with rows of columns.
    Hall,
}

/// How rooms are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rooms {
    pub kind: RoomKind,
    /// From 0, little in the way, to 1: larger rooms with more furniture and clutter (corridors are narrower; the box stays the same).
    pub difficulty: f32,
}

impl Default for Rooms {
    fn default() -> Self {
        Self { kind: RoomKind::Furnished, difficulty: 0.5 }
    }
}

/// What rooms are for; each has seeds of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    Train,
    Validation,
    Test,
}

impl Split {
    /// Seeds of the rooms of this part.
    pub fn seeds(self) -> Range<u64> {
        match self {
            Self::Train => 0..1_000_000,
            Self::Validation => 1_000_000..1_100_000,
            Self::Test => 1_100_000..1_200_000,
        }
    }
}

/// A room: x and y on the floor, which is at z = 0, about the origin.
#[derive(Clone, Debug, PartialEq)]
pub struct Room {
    /// Kind, seed and difficulty.
    pub name: String,
    /// Closed meshes of floor, walls and each piece of furniture, every one an object.
    pub mesh: TriMesh,
    /// Where people may walk: the floor with the thresholds of its doors, less the footprints of what stands on it (which may overlap).
    pub walkable: Polygon,
}

impl Rooms {
    /// Refuses values that are no rooms.
    pub fn validate(&self) -> Result<()> {
        match (0.0..=1.0).contains(&self.difficulty) {
            true => Ok(()),
            false => Err(Error::invalid(format!("rooms.difficulty is {}, expected 0 to 1", self.difficulty))),
        }
    }

    /// The room of this seed. A person of radius 0.3 m can walk from every door over nearly all the floor that it can stand on.
    pub fn draw(&self, seed: u64) -> Result<Room> {
        self.validate()?;
        let word = match self.kind {
            RoomKind::Box => "box",
            RoomKind::Furnished => "furnished",
            RoomKind::Corridor => "corridor",
            RoomKind::Hall => "hall",
        };
        let rng = &mut stream(seed, &format!("room {word}"), 0);
        let mut mesh = TriMesh::new();
        let palette = Palette::draw(rng);
        let (shell, pieces) = match self.kind {
            RoomKind::Box => return sparse_room(format!("{word}-{seed}"), rng),
            RoomKind::Furnished => layout::furnished(self.difficulty, rng)?,
            RoomKind::Corridor => layout::corridor(self.difficulty, rng)?,
            RoomKind::Hall => layout::hall(self.difficulty, rng)?,
        };
        shell.add_to(&mut mesh);
        pieces.iter().for_each(|p| p.add_to(&mut mesh, &palette));
        let holes = pieces.iter().map(Piece::footprint).collect();
        let name = format!("{word}-{seed}-{:.2}", self.difficulty);
        Ok(Room { name, mesh, walkable: Polygon::new(shell.exterior(), holes)? })
    }
}

/// The scene of one box with walls round its floor.
fn sparse_room(name: String, rng: &mut crate::rng::Stream) -> Result<Room> {
    let scene = SparseScenes::default().draw(rng)?.scene;
    let mut mesh = TriMesh::new();
    Shell { ring: scene.walkable.exterior().to_vec(), doors: Vec::new() }.add_to(&mut mesh);
    for obstacle in &scene.obstacles {
        let object = mesh.add_object(Kind::Crate.name());
        let material = mesh.add_material("cardboard", [0.72, 0.58, 0.40, 1.0]);
        add_prism(&mut mesh, object, material, &obstacle.corners(), 0.0, obstacle.height);
    }
    Ok(Room { name, mesh, walkable: scene.walkable })
}

#[cfg(test)]
mod tests;
