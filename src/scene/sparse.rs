//! Random sparse scenes: one box between start and goal.

use super::{BoxObstacle, Scene};
use crate::rng::Stream;
use crate::{Error, Result};
use glam::Vec2;
use rand::RngExt;
use rand_distr::{Distribution, Normal};
use serde::{Deserialize, Serialize};
use std::f32::consts::TAU;

/// What stands in the scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SparseKind {
    /// One box in the middle.
    #[default]
    Box,
    /// Nothing; starts and goals are drawn as if the box stood there.
    Open,
}

/// How sparse scenes are drawn. Defaults follow the authors' training scenes of a single static box, with distances that a
/// person can walk in 11 steps. Ranges are [low, high], drawn uniformly.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SparseScenes {
    pub kind: SparseKind,
    /// Side lengths of the box, metres.
    pub side: [f32; 2],
    /// Height of the box, metres.
    pub height: f32,
    /// Distance of the four walls from the origin, metres.
    pub wall: [f32; 2],
    /// Starts keep this far from the box (the radius of a person), metres.
    pub clearance: f32,
    /// Starts lie within the axis-aligned bounds of the box grown by this much, metres.
    pub margin: f32,
    /// Shortest and longest straight distance from start to goal, metres.
    pub min_distance: f32,
    pub max_distance: f32,
    /// Standard deviation added to each coordinate of the goal, which otherwise is the start mirrored at the origin, metres.
    pub goal_noise: f32,
}

impl Default for SparseScenes {
    fn default() -> Self {
        Self {
            kind: SparseKind::Box,
            side: [0.5, 1.0],
            height: 2.0,
            wall: [4.5, 5.0],
            clearance: 0.4,
            margin: 1.0,
            min_distance: 0.0,
            max_distance: 4.0,
            goal_noise: 0.0,
        }
    }
}

/// One drawn task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Setting {
    pub scene: Scene,
    /// Where the person starts, on the floor.
    pub start: Vec2,
    /// Where it should go, on the floor.
    pub goal: Vec2,
}

impl SparseScenes {
    /// Refuses values from which no scene, or no start, could be drawn.
    pub fn validate(&self) -> Result<()> {
        let need = |ok: bool, key: &str, right: &str| {
            if ok { Ok(()) } else { Err(Error::invalid(format!("scene.{key}: expected {right}"))) }
        };
        let range = |r: [f32; 2]| r[0] > 0.0 && r[0] <= r[1] && r[1].is_finite();
        let finite =
            [self.height, self.clearance, self.margin, self.min_distance, self.max_distance, self.goal_noise].iter().all(|v| v.is_finite());
        need(finite, "*", "finite numbers")?;
        need(range(self.side), "side", "[low, high] with 0 < low <= high")?;
        need(range(self.wall), "wall", "[low, high] with 0 < low <= high")?;
        need(self.height > 0.0, "height", "more than 0")?;
        need(self.clearance >= 0.0, "clearance", "0 or more")?;
        need(self.margin > self.clearance, "margin", &format!("more than the clearance of {} m", self.clearance))?;
        // The nearest starts lie beside the middle of the longest side or, at worst, at a corner.
        let reach = 2.0 * (self.side[1] * std::f32::consts::FRAC_1_SQRT_2 + self.clearance);
        need((0.0..self.max_distance).contains(&self.min_distance), "min_distance", "0 or more, less than max_distance")?;
        need(self.max_distance > reach, "max_distance", &format!("more than {reach:.2} m, through the largest box"))?;
        let far = self.max_distance / 2.0 + 4.0 * self.goal_noise + self.clearance;
        need(self.wall[0] > far, "wall", &format!("more than {far:.2} m, so that every goal lies within"))?;
        need(self.goal_noise >= 0.0 && self.goal_noise <= 0.5, "goal_noise", "0 to 0.5 m")
    }

    /// Draws a scene with start and goal. `self` must be valid.
    pub fn draw(&self, rng: &mut Stream) -> Result<Setting> {
        let mut within = |r: [f32; 2]| rng.random_range(r[0]..=r[1]);
        let size = Vec2::new(within(self.side), within(self.side));
        let wall = within(self.wall);
        let block = BoxObstacle { centre: Vec2::ZERO, size, yaw: rng.random_range(0.0..TAU), height: self.height };
        let obstacles = if self.kind == SparseKind::Box { vec![block] } else { vec![] };
        let (start, goal) = self.draw_pair(&block, rng)?;
        Ok(Setting { scene: Scene::with_boxes(wall, obstacles)?, start, goal })
    }

    /// Uniform over the ring of free floor round the box. (Drawing a half first and a point in it comes to the same.)
    fn draw_pair(&self, block: &BoxObstacle, rng: &mut Stream) -> Result<(Vec2, Vec2)> {
        let bound = block.corners().iter().fold(Vec2::ZERO, |m, c| m.max(c.as_vec2().abs())) + self.margin;
        let noise = Normal::new(0.0, self.goal_noise).map_err(|e| Error::invalid(format!("scene.goal_noise: {e}")))?;
        for _ in 0..10_000 {
            let start = Vec2::new(rng.random_range(-bound.x..=bound.x), rng.random_range(-bound.y..=bound.y));
            let goal = -start + Vec2::new(noise.sample(rng), noise.sample(rng));
            let free = block.distance(start) >= self.clearance && block.distance(goal) >= self.clearance;
            if free && (self.min_distance..=self.max_distance).contains(&start.distance(goal)) {
                return Ok((start, goal));
            }
        }
        Err(Error::invalid("scene: no start found in 10000 draws; give more margin or max_distance"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::stream;
    use glam::DVec2;

    #[test]
    fn settings_keep_their_promises() {
        let config = SparseScenes { goal_noise: 0.1, ..Default::default() };
        config.validate().unwrap();
        let (mut left, mut distances) = (0, vec![]);
        for k in 0..400 {
            let s = config.draw(&mut stream(3, "scene", k)).unwrap();
            let b = s.scene.obstacles[0];
            assert!((0.5..=1.0).contains(&b.size.x) && (0.5..=1.0).contains(&b.size.y) && b.height == 2.0);
            let (_, hi) = s.scene.walkable.bounds();
            assert!((4.5..=5.0).contains(&hi.x) && hi.x == hi.y);
            for p in [s.start, s.goal] {
                assert!(s.scene.walkable.contains(p.as_dvec2()));
                // The drawn pair keeps its distance from the very polygon that is walked on.
                assert!(s.scene.walkable.border_distance(p.as_dvec2()) >= 0.4 - 1e-5);
            }
            assert!((s.goal + s.start).length() < 0.5);
            left += (s.start.x < 0.0) as usize;
            distances.push(s.start.distance(s.goal));
            assert_eq!(s, config.draw(&mut stream(3, "scene", k)).unwrap());
        }
        assert!((160..240).contains(&left), "{left}");
        distances.sort_by(f32::total_cmp);
        assert!(distances[0] < 2.0 && distances[399] > 3.8 && distances[399] <= 4.0);
    }

    #[test]
    fn the_box_blocks_the_straight_way() {
        let s = SparseScenes::default().draw(&mut stream(0, "scene", 1)).unwrap();
        assert_eq!(s.goal, -s.start);
        let blocked = |s: &Setting| (1..20).any(|k| !s.scene.walkable.contains(s.start.lerp(s.goal, k as f32 / 20.0).as_dvec2()));
        assert!(blocked(&s));
        let open = SparseScenes { kind: SparseKind::Open, ..Default::default() };
        let o = open.draw(&mut stream(0, "scene", 1)).unwrap();
        assert!(!blocked(&o) && o.start == s.start && o.scene.obstacles.is_empty());
    }

    #[test]
    fn box_geometry_by_hand() {
        let b = BoxObstacle { centre: Vec2::new(1.0, 0.0), size: Vec2::new(2.0, 1.0), yaw: TAU / 4.0, height: 1.0 };
        // Turned by a quarter: 1 m along x, 2 m along y.
        assert!((b.corners()[0] - DVec2::new(1.5, -1.0)).length() < 1e-6);
        assert!((b.distance(Vec2::new(3.5, 0.0)) - 2.0).abs() < 1e-6);
        assert!((b.distance(Vec2::new(4.5, 5.0)) - 5.0).abs() < 1e-6);
        assert_eq!(b.distance(Vec2::new(1.0, 0.9)), 0.0);
    }

    #[test]
    fn unusable_values_are_named() {
        let base = SparseScenes::default;
        let bad = [
            (SparseScenes { side: [1.0, 0.5], ..base() }, "scene.side"),
            (SparseScenes { margin: 0.4, ..base() }, "scene.margin"),
            (SparseScenes { max_distance: 2.0, ..base() }, "scene.max_distance"),
            (SparseScenes { min_distance: 4.0, ..base() }, "scene.min_distance"),
            (SparseScenes { wall: [2.0, 5.0], ..base() }, "scene.wall"),
            (SparseScenes { height: f32::NAN, ..base() }, "scene.*"),
        ];
        for (config, key) in bad {
            assert!(config.validate().unwrap_err().to_string().contains(key), "{key}");
        }
    }
}
