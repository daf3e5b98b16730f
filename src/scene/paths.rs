//! Shortest ways for a disk-shaped person: a visibility graph round the corners of the walkable area.

use super::Polygon;
use super::rings::{ring_edges, segments_distance, segments_meet, signed_area};
use crate::{Error, Result};
use glam::DVec2;
use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::f64::consts::{FRAC_PI_6, PI};
use std::sync::OnceLock;

/// Side of the squares that edges are looked up in, metres.
const SQUARE: f64 = 0.5;
/// How much less than the clearance counts as kept, metres; ways lead along borders.
const SLACK: f64 = 1e-5;

/// A way from a start to a goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Route {
    /// Start, corners that it goes round, goal; metres.
    pub points: Vec<DVec2>,
    /// Length, metres.
    pub length: f64,
}

/// Finds ways through a walkable area that keep a clearance from its borders.
///
/// Around a corner the way follows an arc, for which tangents of 30 degrees or less stand here: a quarter turn at 0.22 m is at most
/// 9 mm too long.
pub struct Navigator {
    polygon: Polygon,
    clearance: f64,
    edges: Edges,
    nodes: Vec<DVec2>,
    /// Of each node the nodes in reach of a straight line, found when first asked for.
    visible: Vec<OnceLock<Vec<u32>>>,
}

impl Navigator {
    /// Prepares ways through `polygon` for a person of radius `clearance`, metres.
    pub fn new(polygon: &Polygon, clearance: f64) -> Result<Self> {
        if !(0.01..=2.0).contains(&clearance) {
            return Err(Error::invalid(format!("a clearance of {clearance} m: expected 0.01 to 2 m")));
        }
        let mut navigator =
            Self { polygon: polygon.clone(), clearance, edges: Edges::new(polygon, clearance)?, nodes: Vec::new(), visible: Vec::new() };
        let rings = polygon.rings().enumerate();
        let corners: Vec<DVec2> = rings.flat_map(|(i, ring)| tangents(ring, i == 0, clearance)).collect();
        navigator.nodes = corners.into_iter().filter(|&p| navigator.stands(p)).collect();
        navigator.visible = navigator.nodes.iter().map(|_| OnceLock::new()).collect();
        Ok(navigator)
    }

    /// The walkable area.
    pub fn polygon(&self) -> &Polygon {
        &self.polygon
    }

    /// Whether a person can stand at `p`.
    pub fn stands(&self, p: DVec2) -> bool {
        self.polygon.contains(p) && self.edges.along(p, p, |a, b| segments_distance(a, b, p, p) >= self.clearance - SLACK)
    }

    /// Whether the straight line between two walkable points stays in the walkable area (with no clearance).
    pub fn sees(&self, a: DVec2, b: DVec2) -> bool {
        self.edges.along(a, b, |c, d| !segments_meet(a, b, c, d))
    }

    /// Whether a person can walk straight from `a` to `b`, where it can stand.
    fn passes(&self, a: DVec2, b: DVec2) -> bool {
        self.edges.along(a, b, |c, d| segments_distance(a, b, c, d) >= self.clearance - SLACK)
    }

    /// The shortest way from `start` to `goal`; None where one cannot be stood on or none is wide enough.
    pub fn route(&self, start: DVec2, goal: DVec2) -> Option<Route> {
        if !self.stands(start) || !self.stands(goal) {
            return None;
        }
        if self.passes(start, goal) {
            return Some(Route { points: vec![start, goal], length: start.distance(goal) });
        }
        let last: Vec<bool> = self.nodes.iter().map(|&p| self.passes(p, goal)).collect();
        // The goal counts as one more node.
        let end = self.nodes.len();
        let mut best = vec![f64::INFINITY; end + 1];
        let mut before = vec![u32::MAX; end + 1];
        let mut open = BinaryHeap::new();
        for (i, &p) in self.nodes.iter().enumerate().filter(|(_, p)| self.passes(start, **p)) {
            best[i] = start.distance(p);
            open.push(Step { estimate: best[i] + p.distance(goal), length: best[i], node: i as u32 });
        }
        while let Some(step) = open.pop() {
            let i = step.node as usize;
            if i == end {
                return Some(self.trace(start, goal, &before));
            }
            if step.length > best[i] {
                continue;
            }
            let length = best[i] + self.nodes[i].distance(goal);
            if last[i] && length < best[end] {
                (best[end], before[end]) = (length, step.node);
                open.push(Step { estimate: length, length, node: end as u32 });
            }
            for &next in self.neighbours(i) {
                let (k, length) = (next as usize, best[i] + self.nodes[i].distance(self.nodes[next as usize]));
                if length < best[k] {
                    (best[k], before[k]) = (length, step.node);
                    open.push(Step { estimate: length + self.nodes[k].distance(goal), length, node: next });
                }
            }
        }
        None
    }

    fn neighbours(&self, i: usize) -> &[u32] {
        let p = self.nodes[i];
        self.visible[i].get_or_init(|| {
            let others = (0..self.nodes.len()).filter(|&k| k != i && self.passes(p, self.nodes[k]));
            others.map(|k| k as u32).collect()
        })
    }

    fn trace(&self, start: DVec2, goal: DVec2, before: &[u32]) -> Route {
        let mut points = vec![goal];
        let mut at = before[self.nodes.len()];
        while at != u32::MAX {
            points.push(self.nodes[at as usize]);
            at = before[at as usize];
        }
        points.push(start);
        points.reverse();
        let length = points.windows(2).map(|s| s[0].distance(s[1])).sum();
        Route { points, length }
    }
}

/// Points round the corners of a ring that a way may bend at, at `radius` from the ring: the corners of tangents to the arcs.
fn tangents(ring: &[DVec2], exterior: bool, radius: f64) -> Vec<DVec2> {
    let mut ring = ring.to_vec();
    // Free floor on the left.
    if (signed_area(&ring) > 0.0) != exterior {
        ring.reverse();
    }
    ring.dedup();
    let edges: Vec<DVec2> = ring_edges(&ring).map(|(a, b)| (b - a).normalize_or_zero()).collect();
    let mut out = Vec::new();
    for (i, &p) in ring.iter().enumerate() {
        let (before, after) = (edges[i], edges[(i + 1) % ring.len()]);
        let turn = before.perp_dot(after).atan2(before.dot(after));
        if !(1e-9 - PI..-1e-9).contains(&turn) {
            continue;
        }
        let parts = (-turn / FRAC_PI_6).ceil();
        let half = turn / (2.0 * parts);
        let first = before.perp();
        out.extend((0..parts as usize).map(|k| p + DVec2::from_angle(half * (2 * k + 1) as f64).rotate(first) * (radius / half.cos())));
    }
    out
}

/// A node on the way, ordered by the least estimate first; ties by number, so that ways do not depend on chance.
struct Step {
    estimate: f64,
    length: f64,
    node: u32,
}

impl Ord for Step {
    fn cmp(&self, other: &Self) -> Ordering {
        other.estimate.total_cmp(&self.estimate).then(other.node.cmp(&self.node))
    }
}

impl PartialOrd for Step {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Step {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Step {}

/// The edges of a polygon in squares, each in all squares that it may be nearer to than the clearance.
struct Edges {
    edges: Vec<(DVec2, DVec2)>,
    lowest: DVec2,
    dims: [usize; 2],
    squares: Vec<Vec<u32>>,
}

impl Edges {
    fn new(polygon: &Polygon, reach: f64) -> Result<Self> {
        let (low, high) = polygon.bounds();
        let dims = ((high - low) / SQUARE).floor() + 1.0;
        if dims.x * dims.y > 1e7 {
            return Err(Error::invalid(format!("a walkable area from {low} to {high} m is too large to find ways through")));
        }
        let dims = [dims.x as usize, dims.y as usize];
        let edges: Vec<(DVec2, DVec2)> = polygon.edges().collect();
        let mut out = Self { edges, lowest: low, dims, squares: vec![Vec::new(); dims[0] * dims[1]] };
        for i in 0..out.edges.len() {
            let (a, b) = out.edges[i];
            // A little more, as points on the border of a square belong to one side only.
            let ([i0, j0], [i1, j1]) = (out.square(a.min(b) - reach - 1e-9), out.square(a.max(b) + reach + 1e-9));
            (j0..=j1).flat_map(|j| (i0..=i1).map(move |k| j * dims[0] + k)).for_each(|s| out.squares[s].push(i as u32));
        }
        Ok(out)
    }

    /// The square of `p`, or the nearest one.
    fn square(&self, p: DVec2) -> [usize; 2] {
        let at = ((p - self.lowest) / SQUARE).floor().max(DVec2::ZERO);
        [(at.x as usize).min(self.dims[0] - 1), (at.y as usize).min(self.dims[1] - 1)]
    }

    /// Whether `test` holds for all edges near the segment from `a` to `b`.
    fn along(&self, a: DVec2, b: DVec2, test: impl Fn(DVec2, DVec2) -> bool) -> bool {
        let (a, b) = if a.y <= b.y { (a, b) } else { (b, a) };
        let ([_, j0], [_, j1]) = (self.square(a), self.square(b));
        let x_at = |y: f64| if b.y > a.y { a.x + (b.x - a.x) * ((y - a.y) / (b.y - a.y)).clamp(0.0, 1.0) } else { b.x };
        (j0..=j1).all(|j| {
            let y = self.lowest.y + j as f64 * SQUARE;
            let from = if j == j0 { a.x } else { x_at(y) };
            let to = if j == j1 { b.x } else { x_at(y + SQUARE) };
            let [first, _] = self.square(DVec2::new(from.min(to) - 1e-9, y));
            let [last, _] = self.square(DVec2::new(from.max(to) + 1e-9, y));
            let row = &self.squares[j * self.dims[0]..][first..=last];
            row.iter().flatten().map(|&e| self.edges[e as usize]).all(|(c, d)| test(c, d))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::stream;
    use rand::RngExt;
    use std::f64::consts::FRAC_PI_2;

    fn square(half: f64) -> Vec<DVec2> {
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(DVec2::from).to_vec()
    }

    fn round_a_box(clearance: f64) -> Navigator {
        Navigator::new(&Polygon::new(square(4.0), vec![square(0.5)]).unwrap(), clearance).unwrap()
    }

    #[test]
    fn detour_round_a_box_by_hand() {
        // From (-2, 0) to (2, 0) round the box of 1 m: tangent to the circle of radius r round (-0.5, 0.5), along it, straight over
        // the box, and the same back. With d = |(1.5, 0.5)| the tangent is sqrt(d^2 - r^2) long; the arc is what is left of the
        // quarter turn from the normal of the tangent to the normal of the box's side.
        let (start, goal) = (DVec2::new(-2.0, 0.0), DVec2::new(2.0, 0.0));
        for r in [0.05f64, 0.22, 0.4] {
            let d2 = 1.5f64 * 1.5 + 0.5 * 0.5;
            let rise = 0.5f64.atan2(1.5) + (r / d2.sqrt()).asin();
            let exact = 2.0 * ((d2 - r * r).sqrt() + r * rise) + 1.0;
            let route = round_a_box(r).route(start, goal).unwrap();
            assert!(route.length >= exact - 1e-6 && route.length < exact + 0.03 * r, "{r}: {} {exact}", route.length);
            let sum: f64 = route.points.windows(2).map(|s| s[0].distance(s[1])).sum();
            assert!((sum - route.length).abs() < 1e-12 && (route.points[0], *route.points.last().unwrap()) == (start, goal));
        }
        let free = round_a_box(0.22).route(DVec2::new(-2.0, 1.0), DVec2::new(2.0, 1.0)).unwrap();
        assert_eq!((free.length, free.points.len()), (4.0, 2));
    }

    #[test]
    fn what_can_be_stood_on_seen_and_reached() {
        let n = round_a_box(0.3);
        let p = DVec2::new;
        assert!(n.stands(p(0.81, 0.0)) && !n.stands(p(0.79, 0.0)) && !n.stands(p(0.0, 0.0)) && !n.stands(p(3.8, 0.0)));
        assert!(n.sees(p(-2.0, 0.6), p(2.0, 0.6)) && !n.sees(p(-2.0, 0.4), p(2.0, 0.4)));
        assert!(n.route(p(0.0, 0.0), p(2.0, 0.0)).is_none());
        // Two chambers joined by a door of 0.8 m: 0.39 m fit through, 0.41 m do not.
        let walls = vec![
            [(-0.1, -9.0), (0.1, -9.0), (0.1, -0.4), (-0.1, -0.4)].map(DVec2::from).to_vec(),
            [(-0.1, 0.4), (0.1, 0.4), (0.1, 9.0), (-0.1, 9.0)].map(DVec2::from).to_vec(),
        ];
        let chambers = Polygon::new(square(4.0), walls).unwrap();
        let way = |r| Navigator::new(&chambers, r).unwrap().route(p(-1.0, 2.0), p(1.0, 2.0));
        assert!(way(0.39).is_some() && way(0.41).is_none());
        assert!(Navigator::new(&chambers, 0.0).is_err());
    }

    #[test]
    fn arcs_are_bounded() {
        // A square hole has a quarter turn at each corner: three tangent points each, at r / cos 15 degrees.
        let points = tangents(&square(0.5), false, 0.2);
        assert_eq!(points.len(), 12);
        let far = points.iter().map(|p| p.abs() - 0.5).map(|d| d.length());
        assert!(far.clone().all(|d| (d - 0.2 / (FRAC_PI_2 / 6.0).cos()).abs() < 1e-9), "{:?}", far.collect::<Vec<_>>());
        assert!(tangents(&square(4.0), true, 0.2).is_empty());
    }

    /// An 8 x 8 m floor with six boxes anywhere.
    fn cluttered(seed: u64) -> Polygon {
        let rng = &mut stream(seed, "paths", 0);
        let mut hole = || {
            let c = DVec2::new(rng.random_range(-3.0..3.0), rng.random_range(-3.0..3.0));
            let (h, turn) =
                (DVec2::new(rng.random_range(0.2..0.9), rng.random_range(0.2..0.9)), DVec2::from_angle(rng.random_range(0.0..PI)));
            square(1.0).into_iter().map(|v| c + turn.rotate(v * h)).collect()
        };
        let holes = (0..6).map(|_| hole()).collect();
        Polygon::new(square(4.0), holes).unwrap()
    }

    /// Lengths of the shortest ways from `start` to all points of a grid of 0.1 m by steps to their eight neighbours, all 5 cm farther
    /// from borders than `clearance`, so that the steps between keep the clearance; by an outright search.
    fn by_steps(polygon: &Polygon, clearance: f64, start: DVec2) -> Vec<(DVec2, f64)> {
        const N: i32 = 81;
        let point = |i: i32| DVec2::new(f64::from(i % N) - 40.0, f64::from(i / N) - 40.0) * 0.1;
        let free: Vec<bool> =
            (0..N * N).map(|i| polygon.contains(point(i)) && polygon.border_distance(point(i)) >= clearance + 0.05).collect();
        let mut best = vec![f64::INFINITY; free.len()];
        let first = (0..N * N).min_by(|&i, &j| point(i).distance(start).total_cmp(&point(j).distance(start))).unwrap();
        best[first as usize] = 0.0;
        let mut changed = vec![first];
        while let Some(i) = changed.pop() {
            let (x, y) = (i % N, i / N);
            for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
                let (u, v) = (x + dx, y + dy);
                let length = best[i as usize] + point(i).distance(point(i + dy * N + dx));
                if (0..N).contains(&u) && (0..N).contains(&v) && free[(v * N + u) as usize] && length + 1e-9 < best[(v * N + u) as usize] {
                    best[(v * N + u) as usize] = length;
                    changed.insert(0, v * N + u);
                }
            }
        }
        (0..N * N).filter(|&i| free[i as usize]).map(|i| (point(i), best[i as usize])).collect()
    }

    #[test]
    fn ways_are_found_keep_their_distance_and_are_short() {
        let (mut found, mut bent) = (0, 0);
        for seed in 0..12 {
            let polygon = cluttered(seed);
            let navigator = Navigator::new(&polygon, 0.25).unwrap();
            let rng = &mut stream(seed, "ways", 0);
            let reached = by_steps(&polygon, 0.25, DVec2::ZERO);
            let start = reached[rng.random_range(0..reached.len())].0;
            let reached = by_steps(&polygon, 0.25, start);
            for _ in 0..20 {
                let (goal, steps) = reached[rng.random_range(0..reached.len())];
                let Some(route) = navigator.route(start, goal) else {
                    assert_eq!(steps, f64::INFINITY, "{seed}: {start} to {goal}");
                    continue;
                };
                found += 1;
                bent += usize::from(route.points.len() > 2);
                // Steps in eight directions are at most 8.3 % too long, and their clearance is 5 cm larger.
                let straight = start.distance(goal);
                assert!(route.length >= straight - 1e-9 && route.length <= steps + 1e-3, "{seed}: {} {steps}", route.length);
                assert_eq!((route.points[0], route.points.last()), (start, Some(&goal)));
                for s in route.points.windows(2) {
                    for t in 0..=20 {
                        let p = s[0].lerp(s[1], t as f64 / 20.0);
                        assert!(polygon.contains(p) && polygon.border_distance(p) >= 0.25 - 2e-5, "{seed}: {p}");
                    }
                }
                assert!((navigator.route(goal, start).unwrap().length - route.length).abs() < 1e-9);
            }
        }
        assert!(found > 150 && bent > 50, "{found} {bent}");
    }
}
