//! A walkable region: a polygon with holes on the ground plane, in f64.

use super::rings::{ring_edges, segment_distance, signed_area};
use crate::body::Frame;
use crate::{Error, Result};
use glam::{DVec2, Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// Points inside the exterior ring and outside every hole, metres in the world.
///
/// Rings are not closed (the last point differs from the first) and may turn either way. Holes may overlap each other and
/// reach beyond the exterior: the region is the difference, and what is asked of it below needs no clipping.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Polygon {
    exterior: Vec<DVec2>,
    holes: Vec<Vec<DVec2>>,
}

impl Polygon {
    /// Checks that every ring has at least 3 finite points and encloses an area.
    pub fn new(exterior: Vec<DVec2>, holes: Vec<Vec<DVec2>>) -> Result<Self> {
        for (i, ring) in std::iter::once(&exterior).chain(&holes).enumerate() {
            let name = if i == 0 { "the exterior ring".to_string() } else { format!("hole {}", i - 1) };
            if ring.len() < 3 {
                return Err(Error::invalid(format!("{name} has {} points, expected at least 3", ring.len())));
            }
            if let Some(p) = ring.iter().find(|p| !p.is_finite()) {
                return Err(Error::invalid(format!("{name} holds the point ({}, {}), expected finite numbers", p.x, p.y)));
            }
            if signed_area(ring).abs() < 1e-9 {
                return Err(Error::invalid(format!("{name} encloses no area")));
            }
        }
        Ok(Self { exterior, holes })
    }

    /// The region less `rings`, each of which must be one that [`Polygon::new`] takes.
    pub fn less(&self, rings: impl IntoIterator<Item = Vec<DVec2>>) -> Self {
        Self { exterior: self.exterior.clone(), holes: self.holes.iter().cloned().chain(rings).collect() }
    }

    /// The outer ring.
    pub fn exterior(&self) -> &[DVec2] {
        &self.exterior
    }

    /// The rings cut out.
    pub fn holes(&self) -> &[Vec<DVec2>] {
        &self.holes
    }

    /// The outer ring, then the rings cut out.
    pub fn rings(&self) -> impl Iterator<Item = &Vec<DVec2>> {
        std::iter::once(&self.exterior).chain(&self.holes)
    }

    /// Lower and upper corner of the exterior's bounds.
    pub fn bounds(&self) -> (DVec2, DVec2) {
        let start = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        self.exterior.iter().fold(start, |(lo, hi), &p| (lo.min(p), hi.max(p)))
    }

    /// Whether `p` may be stood on (points exactly on a border may go either way).
    pub fn contains(&self, p: DVec2) -> bool {
        inside(&self.exterior, p) && !self.holes.iter().any(|hole| inside(hole, p))
    }

    /// Distance from `p` to the nearest border, inside or outside.
    pub fn border_distance(&self, p: DVec2) -> f64 {
        self.edges().map(|(a, b)| segment_distance(a, b, p)).fold(f64::INFINITY, f64::min)
    }

    /// Distance along the ray from `origin` in the unit direction `dir` to the first border, if it meets one.
    ///
    /// From a walkable origin this is the length of free ground ahead.
    pub fn first_hit(&self, origin: DVec2, dir: DVec2) -> Option<f64> {
        let nearest = self.edges().filter_map(|(a, b)| ray_hit(a, b, origin, dir)).fold(f64::INFINITY, f64::min);
        nearest.is_finite().then_some(nearest)
    }

    /// Non-walkable cells of side `cell` within the axis-aligned box `lo..hi` of a planar frame (local-to-world).
    ///
    /// Cell borders lie at whole multiples of `cell` in that frame; a cell belongs to the box, and to the non-walkable
    /// area, when its centre does.
    pub fn blocked_cells(&self, frame: &Frame, lo: Vec2, hi: Vec2, cell: f32) -> usize {
        let range = |lo: f32, hi: f32| (lo / cell - 0.5).ceil() as i32..=(hi / cell - 0.5).floor() as i32;
        let centre = |i: i32| (i as f32 + 0.5) * cell;
        let blocked = |x: f32, y: f32| {
            let p = frame.point(Vec3::new(x, y, 0.0));
            !self.contains(p.truncate().as_dvec2())
        };
        let row = |j: i32| range(lo.x, hi.x).filter(|&i| blocked(centre(i), centre(j))).count();
        range(lo.y, hi.y).map(row).sum()
    }

    /// The edges of all rings.
    pub(crate) fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> {
        self.rings().flat_map(|ring| ring_edges(ring))
    }
}

/// Crossing-number test.
fn inside(ring: &[DVec2], p: DVec2) -> bool {
    let crosses = |(a, b): &(DVec2, DVec2)| (a.y > p.y) != (b.y > p.y) && p.x < (b.x - a.x) * (p.y - a.y) / (b.y - a.y) + a.x;
    ring_edges(ring).filter(crosses).count() % 2 == 1
}

/// Solves origin + t dir = a + s (b - a); an edge parallel to the ray is met through its neighbours.
fn ray_hit(a: DVec2, b: DVec2, origin: DVec2, dir: DVec2) -> Option<f64> {
    let (edge, to) = (b - a, a - origin);
    let det = dir.perp_dot(edge);
    if det == 0.0 {
        return None;
    }
    let t = to.perp_dot(edge) / det;
    let s = to.perp_dot(dir) / det;
    (t >= 0.0 && (0.0..=1.0).contains(&s)).then_some(t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::stream;
    use proptest::prelude::*;
    use rand::RngExt;
    use serde_json::Value;
    use std::f64::consts::TAU;

    fn square(half: f64) -> Vec<DVec2> {
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(DVec2::from).to_vec()
    }

    /// A 4 x 4 m floor with a 1 x 1 m hole in the middle.
    fn floor() -> Polygon {
        Polygon::new(square(2.0), vec![square(0.5)]).unwrap()
    }

    #[test]
    fn by_hand() {
        let f = floor();
        assert!(f.contains(DVec2::new(1.0, 0.2)) && !f.contains(DVec2::ZERO) && !f.contains(DVec2::new(3.0, 0.0)));
        assert_eq!(f.border_distance(DVec2::new(1.0, 0.0)), 0.5);
        assert_eq!(f.border_distance(DVec2::new(5.0, 6.0)), 5.0);
        assert_eq!(f.first_hit(DVec2::new(1.0, 0.0), DVec2::NEG_X), Some(0.5));
        assert_eq!(f.first_hit(DVec2::new(1.0, 0.0), DVec2::X), Some(1.0));
        assert_eq!(f.first_hit(DVec2::new(3.0, 0.0), DVec2::X), None);
        assert_eq!(f.bounds(), (DVec2::splat(-2.0), DVec2::splat(2.0)));
    }

    #[test]
    fn cells_by_hand() {
        let f = floor();
        // The box x 0.25..0.75, y -0.1..0.1 holds centres x = .25 .35 .45 | .55 .65 .75 and y = -.05 .05: 3 x 2 in the hole
        // (with a hair's width added so that centres on the box's edge count).
        let (lo, hi) = (Vec2::new(0.249, -0.1), Vec2::new(0.751, 0.1));
        assert_eq!(f.blocked_cells(&Frame::IDENTITY, lo, hi, 0.1), 6);
        // Half a turn maps the box to the other side of the hole; shifts by 1.5 m and 0.5 m put its right half off the floor
        // and all of it on free floor.
        assert_eq!(f.blocked_cells(&Frame::planar(std::f32::consts::PI, 0.0, 0.0), lo, hi, 0.1), 6);
        assert_eq!(f.blocked_cells(&Frame::planar(0.0, 1.5, 0.0), lo, hi, 0.1), 6);
        assert_eq!(f.blocked_cells(&Frame::planar(0.0, 0.5, 0.0), lo, hi, 0.1), 0);
    }

    #[test]
    fn bad_rings_are_refused() {
        let line = vec![DVec2::ZERO, DVec2::X, 2.0 * DVec2::X];
        for (rings, word) in [(vec![], "0 points"), (line, "no area"), (vec![DVec2::NAN; 3], "finite")] {
            let e = Polygon::new(rings.clone(), vec![]).unwrap_err().to_string();
            assert!(e.contains(word) && e.contains("exterior"), "{e}");
            let e = Polygon::new(square(1.0), vec![square(0.1), rings]).unwrap_err().to_string();
            assert!(e.contains("hole 1"), "{e}");
        }
    }

    /// Values by shapely: tests/tools/scene/make_fixtures.py.
    #[test]
    fn agrees_with_shapely() {
        let cases: Vec<Value> = serde_json::from_str(include_str!("../../tests/fixtures/scene/polygons.json")).unwrap();
        assert!(cases.len() >= 30);
        let near = |a: f64, b: f64| (a - b).abs() <= 1e-6 * b.abs().max(1e-3);
        for case in &cases {
            let poly: Polygon = serde_json::from_value(case["polygon"].clone()).unwrap();
            for q in case["points"].as_array().unwrap() {
                let p: DVec2 = serde_json::from_value(q["p"].clone()).unwrap();
                assert_eq!(poly.contains(p), q["inside"].as_bool().unwrap(), "{p}");
                if let Some(d) = q["distance"].as_f64() {
                    assert!(near(poly.border_distance(p), d), "{p}");
                }
            }
            for q in case["rays"].as_array().unwrap() {
                let o: DVec2 = serde_json::from_value(q["origin"].clone()).unwrap();
                let dir = DVec2::from_angle(q["angle"].as_f64().unwrap());
                assert!(near(poly.first_hit(o, dir).unwrap(), q["distance"].as_f64().unwrap()), "{o} {dir}");
            }
            for q in case["cells"].as_array().unwrap() {
                let v: Vec<f32> = serde_json::from_value(q["frame"].clone()).unwrap();
                let b: [Vec2; 2] = serde_json::from_value(q["box"].clone()).unwrap();
                let count = poly.blocked_cells(&Frame::planar(v[0], v[1], v[2]), b[0], b[1], 0.1);
                assert_eq!(count as u64, q["blocked"].as_u64().unwrap());
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Turning the world turns the answers, and marching along a free ray meets no hole.
        #[test]
        fn turns_with_the_world_and_agrees_with_marching(seed in 0u64..1000, turn in 0.0..TAU) {
            let rng = &mut stream(seed, "polygon", 0);
            let star = |rng: &mut crate::rng::Stream, c: DVec2, lo: f64, hi: f64| -> Vec<DVec2> {
                (0..9).map(|i| c + rng.random_range(lo..hi) * DVec2::from_angle(TAU * i as f64 / 9.0)).collect()
            };
            let holes = (0..3).map(|_| {
                let c = DVec2::new(rng.random_range(-3.0..3.0), rng.random_range(-3.0..3.0));
                star(rng, c, 0.2, 0.9)
            }).collect();
            let poly = Polygon::new(star(rng, DVec2::ZERO, 3.0, 6.0), holes).unwrap();
            let by = |p: DVec2| DVec2::from_angle(turn).rotate(p);
            let ring = |r: &[DVec2]| r.iter().map(|&p| by(p)).collect::<Vec<_>>();
            let turned = Polygon::new(ring(poly.exterior()), poly.holes().iter().map(|h| ring(h)).collect()).unwrap();
            for _ in 0..20 {
                let p = DVec2::new(rng.random_range(-6.0..6.0), rng.random_range(-6.0..6.0));
                let dir = DVec2::from_angle(rng.random_range(0.0..TAU));
                prop_assert!((poly.border_distance(p) - turned.border_distance(by(p))).abs() < 1e-9);
                prop_assume!(poly.border_distance(p) > 1e-6);
                prop_assert_eq!(poly.contains(p), turned.contains(by(p)));
                if poly.contains(p) {
                    let d = poly.first_hit(p, dir).unwrap();
                    prop_assert!((d - turned.first_hit(by(p), by(dir)).unwrap()).abs() < 1e-6);
                    prop_assert!((1..100).all(|k| poly.contains(p + dir * d * (k as f64 / 100.0))));
                    prop_assert!(poly.border_distance(p + dir * d) < 1e-9);
                }
            }
        }
    }
}
