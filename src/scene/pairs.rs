//! Starts and goals in a walkable area.

use super::Navigator;
use crate::io::numpy::{npy, read_npy};
use crate::io::pickle::nested;
use crate::io::write_atomic;
use crate::rng::{Stream, stream};
use crate::{Error, Result};
use glam::{DVec2, Vec2};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

/// Draws for one pair before giving up.
const DRAWS: usize = 20_000;

/// How pairs of start and goal are drawn. Defaults are those measured of the authors' 20,000 pairs in Replica's room 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairOptions {
    /// How many.
    pub count: usize,
    /// Starts, goals and the ways between them keep this far from borders, metres.
    pub clearance: f32,
    /// Shortest and longest straight distance, metres.
    pub distance: [f32; 2],
    /// Share of pairs whose straight line leaves the walkable area.
    pub blocked: f32,
}

impl Default for PairOptions {
    fn default() -> Self {
        Self { count: 256, clearance: 0.22, distance: [1.5, 3.6], blocked: 0.91 }
    }
}

/// A start and a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// On the floor, metres.
    pub start: Vec2,
    pub goal: Vec2,
    /// Length of the shortest way for a person, metres; 0 where none is wide enough.
    pub way: f32,
    /// Whether the straight line leaves the walkable area.
    pub blocked: bool,
}

impl PairOptions {
    /// Refuses values from which no pair could be drawn.
    pub fn validate(&self) -> Result<()> {
        let bad = |key: &str, right: &str| Err(Error::invalid(format!("pairs.{key}: expected {right}")));
        match self {
            Self { clearance, .. } if !(0.01..=2.0).contains(clearance) => bad("clearance", "0.01 to 2 m"),
            Self { distance: [low, high], .. } if !(*low >= 0.0 && low < high && high.is_finite()) => {
                bad("distance", "[low, high] with 0 <= low < high")
            }
            Self { blocked, .. } if !(0.0..=1.0).contains(blocked) => bad("blocked", "a share from 0 to 1"),
            _ => Ok(()),
        }
    }

    /// Draws pairs with a way from start to goal, each from a stream of its own: uniform over the floor among those of its kind,
    /// which is blocked with the wanted chance. `navigator` must keep the clearance of these options.
    pub fn draw(&self, navigator: &Navigator, seed: u64) -> Result<Vec<Pair>> {
        self.validate()?;
        (0..self.count as u64).into_par_iter().map(|i| self.draw_one(navigator, &mut stream(seed, "pairs", i))).collect()
    }

    fn draw_one(&self, navigator: &Navigator, rng: &mut Stream) -> Result<Pair> {
        let (low, high) = navigator.polygon().bounds();
        let blocked = rng.random_range(0.0..1.0) < self.blocked;
        let [near, far] = self.distance.map(f64::from);
        for _ in 0..DRAWS {
            let start = DVec2::new(rng.random_range(low.x..high.x), rng.random_range(low.y..high.y));
            let distance = rng.random_range(near * near..far * far).sqrt();
            let goal = start + DVec2::from_angle(rng.random_range(0.0..TAU)) * distance;
            // What is stored is what is checked.
            let (start, goal) = (start.as_vec2(), goal.as_vec2());
            let [from, to] = [start, goal].map(|p| p.as_dvec2());
            if !navigator.stands(from) || !navigator.stands(to) || navigator.sees(from, to) == blocked {
                continue;
            }
            if let Some(route) = navigator.route(from, to) {
                return Ok(Pair { start, goal, way: route.length as f32, blocked });
            }
        }
        let line = if blocked { "blocked" } else { "free" };
        Err(Error::invalid(format!(
            "pairs: none in {DRAWS} draws has {near} to {far} m between, {} m to borders and a {line} straight line; change these",
            self.clearance
        )))
    }
}

impl Pair {
    /// What there is to know of a start and a goal, both in the walkable area.
    pub fn judge(navigator: &Navigator, start: Vec2, goal: Vec2) -> Result<Self> {
        let [from, to] = [start, goal].map(|p| p.as_dvec2());
        if let Some(p) = [from, to].into_iter().find(|&p| !navigator.polygon().contains(p)) {
            return Err(Error::invalid(format!("({}, {}) is not walkable", p.x, p.y)));
        }
        let way = navigator.route(from, to).map_or(0.0, |r| r.length as f32);
        Ok(Self { start, goal, way, blocked: !navigator.sees(from, to) })
    }
}

/// Reads starts and goals: NumPy's `.npy`, or a Python pickle of arrays or lists, of shape (n, 2, 2) or (n, 2, 3); heights are left out.
pub fn read_pairs(path: &Path) -> Result<Vec<[Vec2; 2]>> {
    parse_pairs(path, &fs::read(path).map_err(|e| Error::io(path, e))?)
}

/// [`read_pairs`] of a file's content; `path` names it in errors.
pub(crate) fn parse_pairs(path: &Path, bytes: &[u8]) -> Result<Vec<[Vec2; 2]>> {
    let array = if bytes.starts_with(&[0x80]) { nested(path, bytes)? } else { read_npy(path, bytes)? };
    let width = match array.shape[..] {
        [_, 2, width @ (2 | 3)] => width,
        _ => return Err(Error::file(path, format!("has shape {:?}, expected [n, 2, 2] or [n, 2, 3]", array.shape))),
    };
    let points: Vec<Vec2> = array.data.chunks_exact(width).map(|p| Vec2::new(p[0], p[1])).collect();
    if let Some(i) = points.iter().position(|p| !p.is_finite()) {
        return Err(Error::file(path, format!("pair {} holds {}, expected finite numbers", i / 2, points[i])));
    }
    Ok(points.as_chunks::<2>().0.to_vec())
}

/// Writes starts and goals as `.npy` of shape (n, 2, 2) in single precision.
pub fn write_pairs(path: &Path, pairs: &[Pair]) -> Result<()> {
    let data: Vec<u8> = pairs.iter().flat_map(|p| [p.start.x, p.start.y, p.goal.x, p.goal.y]).flat_map(f32::to_le_bytes).collect();
    write_atomic(path, &npy("<f4", &[pairs.len(), 2, 2], &data))
}

#[cfg(test)]
mod tests {
    use super::super::Polygon;
    use super::*;
    use proptest::prelude::*;

    fn square(half: f64) -> Vec<DVec2> {
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(DVec2::from).to_vec()
    }

    fn navigator() -> Navigator {
        Navigator::new(&Polygon::new(square(3.0), vec![square(0.8)]).unwrap(), 0.22).unwrap()
    }

    /// Whether a segment meets the box |x|, |y| <= half, by the intervals in which it is between two lines.
    fn meets_box(a: DVec2, b: DVec2, half: f64) -> bool {
        let (t0, t1) = ((DVec2::splat(-half) - a) / (b - a), (DVec2::splat(half) - a) / (b - a));
        t0.min(t1).max_element().max(0.0) <= t0.max(t1).min_element().min(1.0)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn pairs_keep_their_promises(seed in 0u64..10_000) {
            let navigator = navigator();
            let options = PairOptions { count: 40, ..Default::default() };
            for pair in options.draw(&navigator, seed).unwrap() {
                let [a, b] = [pair.start, pair.goal].map(|p| p.as_dvec2());
                let straight = a.distance(b);
                for p in [a, b] {
                    prop_assert!(navigator.polygon().contains(p) && navigator.polygon().border_distance(p) >= 0.22 - 2e-5);
                }
                prop_assert!((1.5 - 1e-5..=3.6 + 1e-5).contains(&straight) && f64::from(pair.way) >= straight - 1e-5);
                prop_assert_eq!(meets_box(a, b, 0.8), pair.blocked);
                prop_assert_eq!(Pair::judge(&navigator, pair.start, pair.goal).unwrap(), pair);
            }
        }
    }

    #[test]
    fn the_wanted_share_is_blocked() {
        let options = PairOptions { count: 600, ..Default::default() };
        let pairs = options.draw(&navigator(), 5).unwrap();
        let blocked = pairs.iter().filter(|p| p.blocked).count();
        // 546 expected, standard deviation 7.
        assert!((516..=576).contains(&blocked), "{blocked}");
        assert_eq!(pairs[..50], PairOptions { count: 50, ..options.clone() }.draw(&navigator(), 5).unwrap()[..]);
        assert!(pairs != options.draw(&navigator(), 6).unwrap());
    }

    #[test]
    fn impossible_wishes_are_named() {
        let open = Navigator::new(&Polygon::new(square(3.0), vec![]).unwrap(), 0.22).unwrap();
        let e = PairOptions::default().draw(&open, 0).unwrap_err().to_string();
        assert!(e.contains("blocked straight line"), "{e}");
        for (options, key) in [
            (PairOptions { distance: [3.0, 2.0], ..Default::default() }, "distance"),
            (PairOptions { blocked: 1.5, ..Default::default() }, "blocked"),
            (PairOptions { clearance: f32::NAN, ..Default::default() }, "clearance"),
        ] {
            assert!(options.draw(&open, 0).unwrap_err().to_string().contains(key));
        }
    }

    #[test]
    fn files_of_pairs() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pairs.npy");
        let pair = |x: f32| Pair { start: Vec2::new(x, 1.0), goal: Vec2::new(2.0, -x), way: 3.0, blocked: true };
        write_pairs(&path, &[pair(0.5), pair(-2.0)]).unwrap();
        assert_eq!(read_pairs(&path).unwrap(), [pair(0.5), pair(-2.0)].map(|p| [p.start, p.goal]));
        let bad = |shape: &[usize], values: &[f32]| {
            fs::write(&path, npy("<f4", shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())).unwrap();
            read_pairs(&path).unwrap_err().to_string()
        };
        assert!(bad(&[1, 4], &[0.0; 4]).contains("shape [1, 4], expected [n, 2, 2]"));
        assert!(bad(&[1, 2, 2], &[0.0, 0.0, f32::NAN, 0.0]).contains("pair 0 holds"));
        fs::write(&path, b"nothing").unwrap();
        assert!(read_pairs(&path).unwrap_err().to_string().contains("pairs.npy"));
    }
}
