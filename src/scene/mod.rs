//! Scenes as data: where people may walk, what stands there, and procedural makers.

mod bundle;
mod crowded;
#[cfg(test)]
mod furniture;
#[cfg(test)]
mod fuzz;
mod grid;
mod make;
pub mod mesh;
mod outline;
mod pairs;
mod paths;
mod polygon;
mod rings;
pub mod rooms;
pub mod sdf;
mod sparse;
mod walkable;

pub use bundle::{PICTURE, SceneBundle};
pub use crowded::{BundleFolders, CrowdedScene, CrowdedScenes};
pub use grid::Grid;
pub use make::{MakeOptions, SceneFiles, Stages};
pub use mesh::{Material, MeshOptions, TriMesh, Up, read_mesh};
pub use outline::{navmesh_polygon, read_polygon};
pub use pairs::{Pair, PairOptions, read_pairs, write_pairs};
pub use paths::{Navigator, Route};
pub use polygon::Polygon;
pub use rooms::{Room, RoomKind, Rooms, Split};
pub use sdf::{SdfGrid, SdfOptions, Solid};
pub use sparse::{Setting, SparseKind, SparseScenes};
pub use walkable::{Walkable, WalkableOptions, floor_height};

use glam::{DVec2, Vec2};
use serde::{Deserialize, Serialize};

/// A box standing on the floor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoxObstacle {
    /// Centre on the floor, metres.
    pub centre: Vec2,
    /// Side lengths along its own x and y, metres.
    pub size: Vec2,
    /// Turn about z, radians.
    pub yaw: f32,
    /// Height above the floor, metres.
    pub height: f32,
}

impl BoxObstacle {
    /// The four corners on the floor, counter-clockwise.
    pub fn corners(&self) -> [DVec2; 4] {
        let (h, turn) = (self.size.as_dvec2() / 2.0, DVec2::from_angle(self.yaw.into()));
        let corner = |x, y| self.centre.as_dvec2() + turn.rotate(h * DVec2::new(x, y));
        [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)]
    }

    /// Distance on the floor from `p` to the box, 0 inside it.
    pub fn distance(&self, p: Vec2) -> f32 {
        let local = Vec2::from_angle(-self.yaw).rotate(p - self.centre);
        (local.abs() - self.size / 2.0).max(Vec2::ZERO).length()
    }
}

/// A scene with a flat floor at z = 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Where people may walk; its outer border acts as walls.
    pub walkable: Polygon,
    /// What stands on the floor, for drawing; each is a hole of `walkable`.
    pub obstacles: Vec<BoxObstacle>,
}

impl Scene {
    /// A square floor of side 2 `half` about the origin with boxes on it.
    pub fn with_boxes(half: f32, obstacles: Vec<BoxObstacle>) -> crate::Result<Self> {
        let floor = BoxObstacle { centre: Vec2::ZERO, size: Vec2::splat(2.0 * half), yaw: 0.0, height: 0.0 };
        let holes = obstacles.iter().map(|b| b.corners().to_vec()).collect();
        Ok(Self { walkable: Polygon::new(floor.corners().to_vec(), holes)?, obstacles })
    }
}
