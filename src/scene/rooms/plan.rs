//! Placing furniture so that people still get about.

use super::furniture::{Kind, Piece};
use super::shell::Shell;
use crate::rng::Stream;
use crate::scene::{BoxObstacle, Grid, Polygon};
use glam::{DVec2, Vec2, Vec3};
use rand::RngExt;
use std::f32::consts::{FRAC_PI_2, TAU};

/// Side of the cells in which ways are checked, metres.
const CELL: f64 = 0.1;
/// Radius of the person that must get about, metres.
const RADIUS: f64 = 0.3;
/// Between a piece and the wall behind it, and at least between two pieces, metres.
const GAP: f32 = 0.02;
/// Tries for the place of one piece.
const TRIES: usize = 30;

/// A room being furnished.
pub struct Plan<'a> {
    pub shell: Shell,
    pub pieces: Vec<Piece>,
    pub rng: &'a mut Stream,
    floor: Polygon,
    /// Cells of the floor.
    free: Grid,
    /// Of each cell the distance from walls and pieces, negative outside.
    gaps: Vec<f64>,
    /// Cells that a person could stand on in the empty room.
    empty: usize,
    /// In front of the doors, where nothing may stand.
    kept: Vec<BoxObstacle>,
}

impl<'a> Plan<'a> {
    /// An empty room.
    pub fn new(shell: Shell, rng: &'a mut Stream) -> crate::Result<Self> {
        let (low, high) = shell.ring.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), &p| (l.min(p), h.max(p)));
        let mut free = Grid::covering(low, high, CELL, 0.0)?;
        free.fill(&shell.ring, true);
        let cells = free.cells.iter().enumerate();
        let gaps: Vec<f64> =
            cells.map(|(k, &within)| if within { shell.distance(free.centre(k % free.dims[0], k / free.dims[0])) } else { -1.0 }).collect();
        let empty = gaps.iter().filter(|&&g| g >= RADIUS).count();
        let kept = shell.doors.iter().map(|d| {
            let (_, along, _) = shell.wall(d.wall);
            let [a, b] = shell.opening(d);
            let centre = (0.5 * (a + b) + 0.45 * along.perp()).as_vec2();
            BoxObstacle { centre, size: Vec2::new(1.0, 0.9), yaw: along.as_vec2().to_angle(), height: 0.0 }
        });
        let kept = kept.collect();
        let floor = Polygon::new(shell.ring.clone(), Vec::new())?;
        Ok(Self { floor, shell, pieces: Vec::new(), rng, free, gaps, empty, kept })
    }

    /// Draws from `low..high`.
    pub fn within(&mut self, low: f32, high: f32) -> f32 {
        self.rng.random_range(low..high)
    }

    /// True with this chance.
    pub fn chance(&mut self, share: f32) -> bool {
        self.rng.random_range(0.0..1.0) < share
    }

    /// Sets up a piece where it neither meets others (but for the one that it belongs to) nor the walls, nor cuts off floor; says
    /// whether it did.
    pub fn place(&mut self, piece: Piece, belongs_to: Option<usize>) -> bool {
        if !self.fits(&piece, belongs_to) {
            return false;
        }
        let gaps: Vec<f64> = (self.gaps.iter().enumerate())
            .map(|(k, &gap)| gap.min(distance(&piece, self.free.centre(k % self.free.dims[0], k / self.free.dims[0]))))
            .collect();
        if !self.passable(&gaps) {
            return false;
        }
        self.gaps = gaps;
        self.pieces.push(piece);
        true
    }

    /// A piece of this kind and size with its back to a wall.
    pub fn at_wall(&mut self, kind: Kind, size: Vec3) -> Option<usize> {
        (0..TRIES).find_map(|_| {
            let wall = self.rng.random_range(0..self.shell.ring.len());
            let (a, along, length) = self.shell.wall(wall);
            if length < f64::from(size.x) + 0.1 {
                return None;
            }
            let half = f64::from(size.x) / 2.0 + 0.03;
            let at = self.rng.random_range(half..length - half);
            let centre = a + along * at + along.perp() * f64::from(size.y / 2.0 + GAP);
            let yaw = along.as_vec2().to_angle() + std::f32::consts::PI;
            self.put(Piece { kind, size, centre: centre.as_vec2(), yaw }, None)
        })
    }

    /// A piece of this kind and size anywhere, turned by a multiple of a right angle and up to `skew` radians more.
    pub fn anywhere(&mut self, kind: Kind, size: Vec3, skew: f32) -> Option<usize> {
        let (low, high) = (self.free.centre(0, 0), self.free.centre(self.free.dims[0] - 1, self.free.dims[1] - 1));
        (0..TRIES).find_map(|_| {
            let centre = Vec2::new(self.within(low.x as f32, high.x as f32), self.within(low.y as f32, high.y as f32));
            let yaw = self.rng.random_range(0..4) as f32 * FRAC_PI_2 + self.within(-skew, skew + 1e-6);
            self.put(Piece { kind, size, centre, yaw }, None)
        })
    }

    /// A piece at `offset` in the frame of piece `host`, turned by `turn` against it.
    pub fn beside(&mut self, host: usize, kind: Kind, size: Vec3, offset: Vec2, turn: f32) -> Option<usize> {
        let from = self.pieces[host];
        let centre = from.centre + Vec2::from_angle(from.yaw).rotate(offset);
        self.put(Piece { kind, size, centre, yaw: (from.yaw + turn).rem_euclid(TAU) }, Some(host))
    }

    fn put(&mut self, piece: Piece, belongs_to: Option<usize>) -> Option<usize> {
        self.place(piece, belongs_to).then(|| self.pieces.len() - 1)
    }

    fn fits(&self, piece: &Piece, belongs_to: Option<usize>) -> bool {
        let bounds = piece.bounds();
        let inside = |p: &DVec2| self.floor.contains(*p) && self.shell.distance(*p) > 0.01;
        let corners = bounds.corners();
        let reflex = self.shell.ring.iter().any(|p| bounds.distance(p.as_vec2()) < 0.01);
        let others = self.pieces.iter().enumerate().filter(|(i, _)| Some(*i) != belongs_to);
        corners.iter().all(inside)
            && !reflex
            && self.kept.iter().all(|k| apart(&bounds, k, 0.0))
            && others.into_iter().all(|(_, other)| apart(&bounds, &other.bounds(), GAP))
    }

    /// Whether nearly all that can be stood on hangs together, is enough, and holds the places inside the doors.
    fn passable(&self, gaps: &[f64]) -> bool {
        let standing = Grid { cells: gaps.iter().map(|&g| g >= RADIUS).collect(), ..self.free.clone() };
        let Some(main) = standing.largest_part() else { return false };
        let count = |grid: &Grid| grid.cells.iter().filter(|&&c| c).count();
        let (reached, all) = (count(&main), count(&standing));
        let door_reached = |door: &BoxObstacle| main.holds(door.centre.as_dvec2());
        reached * 20 >= all * 19 && reached * 3 >= self.empty && self.kept.iter().all(door_reached)
    }
}

/// Distance from a point on the floor to a piece, 0 on it.
fn distance(piece: &Piece, p: DVec2) -> f64 {
    piece.bounds().distance(p.as_vec2()).into()
}

/// Whether two boxes leave at least `gap` between them along an axis of one of them.
fn apart(a: &BoxObstacle, b: &BoxObstacle, gap: f32) -> bool {
    let axes = [a.yaw, a.yaw + FRAC_PI_2, b.yaw, b.yaw + FRAC_PI_2].map(Vec2::from_angle);
    axes.into_iter().any(|axis| {
        let range = |o: &BoxObstacle| {
            let along = o.corners().map(|c| c.as_vec2().dot(axis));
            along.into_iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        let ((a0, a1), (b0, b1)) = (range(a), range(b));
        a1 + gap <= b0 || b1 + gap <= a0
    })
}
