//! Closed rings of points on the floor: area, crossings, fewer points, triangles.

use glam::DVec2;

/// The edges of a ring, from each point to the next.
pub(crate) fn ring_edges(ring: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> + Clone {
    let before = ring.iter().skip(ring.len().saturating_sub(1)).chain(ring);
    before.zip(ring).map(|(&a, &b)| (a, b))
}

/// The area within, positive where the ring turns counter-clockwise.
pub(crate) fn signed_area(ring: &[DVec2]) -> f64 {
    ring_edges(ring).map(|(a, b)| a.perp_dot(b)).sum::<f64>() / 2.0
}

/// A point at or near which two edges cross or touch that are no neighbours, or two neighbours lie on each other.
pub(crate) fn crossing(rings: &[&[DVec2]]) -> Option<DVec2> {
    let mut edges: Vec<Edge> = rings.iter().enumerate().flat_map(|(r, ring)| (0..ring.len()).map(move |i| Edge::new(r, i, ring))).collect();
    edges.sort_by(|p, q| p.low.total_cmp(&q.low));
    edges.iter().enumerate().find_map(|(i, p)| {
        let near = edges[i + 1..].iter().take_while(|q| q.low <= p.high);
        near.filter(|q| p.meets(q)).map(|q| if q.high - q.low < p.high - p.low { q.a } else { p.a }).next()
    })
}

/// An edge on its way through [`crossing`].
struct Edge {
    ring: usize,
    index: usize,
    count: usize,
    a: DVec2,
    b: DVec2,
    low: f64,
    high: f64,
}

impl Edge {
    fn new(ring: usize, index: usize, points: &[DVec2]) -> Self {
        let (a, b) = (points[index], points[(index + 1) % points.len()]);
        Self { ring, index, count: points.len(), a, b, low: a.x.min(b.x), high: a.x.max(b.x) }
    }

    fn meets(&self, other: &Self) -> bool {
        if self.ring == other.ring && (self.index + 1) % self.count == other.index {
            return folds(self.a, self.b, other.b);
        }
        if self.ring == other.ring && (other.index + 1) % self.count == self.index {
            return folds(other.a, other.b, self.b);
        }
        segments_meet(self.a, self.b, other.a, other.b)
    }
}

/// Whether the way from `a` to `b` to `c` turns back on itself.
fn folds(a: DVec2, b: DVec2, c: DVec2) -> bool {
    (b - a).perp_dot(c - b) == 0.0 && (b - a).dot(c - b) < 0.0
}

/// Whether two segments have a point in common.
pub(crate) fn segments_meet(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> bool {
    let side = |p: DVec2, q: DVec2, r: DVec2| (q - p).perp_dot(r - p);
    let sides = [side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)];
    if sides.iter().all(|&s| s != 0.0) {
        return (sides[0] > 0.0) != (sides[1] > 0.0) && (sides[2] > 0.0) != (sides[3] > 0.0);
    }
    let between = |p: DVec2, q: DVec2, r: DVec2| r.cmpge(p.min(q)).all() && r.cmple(p.max(q)).all();
    let on = [(a, b, c), (a, b, d), (c, d, a), (c, d, b)];
    on.into_iter().zip(sides).any(|((p, q, r), s)| s == 0.0 && between(p, q, r))
}

/// Distance from `p` to the segment from `a` to `b`.
pub(crate) fn segment_distance(a: DVec2, b: DVec2, p: DVec2) -> f64 {
    let (along, to) = (b - a, p - a);
    let t = (to.dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    (to - t * along).length()
}

/// Distance between two segments.
pub(crate) fn segments_distance(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> f64 {
    if segments_meet(a, b, c, d) {
        return 0.0;
    }
    let ends = [segment_distance(a, b, c), segment_distance(a, b, d), segment_distance(c, d, a), segment_distance(c, d, b)];
    ends.into_iter().fold(f64::INFINITY, f64::min)
}

/// The ring with fewer points, none of the old ones farther than `tolerance` from it (Douglas and Peucker 1973).
pub(crate) fn simplify(ring: &[DVec2], tolerance: f64) -> Vec<DVec2> {
    let farthest = |from: usize| (0..ring.len()).max_by(|&i, &j| ring[i].distance(ring[from]).total_cmp(&ring[j].distance(ring[from])));
    // Two points that lie far apart stay.
    let Some(first) = farthest(0) else { return Vec::new() };
    let second = farthest(first).unwrap_or(first);
    let n = ring.len();
    let at = |i: usize| ring[i % n];
    let opposite = first + (second + n - first) % n;
    let mut keep = vec![false; n];
    (keep[first], keep[second]) = (true, true);
    let mut open = vec![(first, opposite), (opposite, first + n)];
    while let Some((from, to)) = open.pop() {
        let off = |i: usize| segment_distance(at(from), at(to), at(i));
        let Some(worst) = (from + 1..to).max_by(|&i, &j| off(i).total_cmp(&off(j))) else { continue };
        if off(worst) > tolerance {
            keep[worst % n] = true;
            open.extend([(from, worst), (worst, to)]);
        }
    }
    ring.iter().zip(keep).filter(|(_, k)| *k).map(|(&p, _)| p).collect()
}

/// Triangles that fill a simple counter-clockwise ring, as numbers of its points, counter-clockwise (ears cut off one by one).
pub(crate) fn triangulate(ring: &[DVec2]) -> Vec<[u32; 3]> {
    let mut left: Vec<u32> = (0..ring.len() as u32).collect();
    let mut out = Vec::with_capacity(ring.len().saturating_sub(2));
    let p = |i: u32| ring[i as usize];
    while left.len() > 2 {
        let n = left.len();
        let corner = |k: usize| [left[(k + n - 1) % n], left[k], left[(k + 1) % n]];
        let turn = |[a, b, c]: [u32; 3]| (p(b) - p(a)).perp_dot(p(c) - p(b));
        let holds = |t: [u32; 3], q: u32| !t.contains(&q) && (0..3).all(|k| (p(t[(k + 1) % 3]) - p(t[k])).perp_dot(p(q) - p(t[k])) >= 0.0);
        let ear = (0..n).find(|&k| turn(corner(k)) > 0.0 && !left.iter().any(|&q| holds(corner(k), q)));
        // Points on a straight line are left over at the end and have no area.
        let Some(k) = ear else { break };
        out.push(corner(k));
        left.remove(k);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(points: &[(f64, f64)]) -> Vec<DVec2> {
        points.iter().map(|&p| p.into()).collect()
    }

    #[test]
    fn areas_and_triangles_by_hand() {
        // An L of 3 unit squares.
        let l = ring(&[(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]);
        assert_eq!(signed_area(&l), 3.0);
        let triangles = triangulate(&l);
        let area = |t: &[u32; 3]| signed_area(&t.map(|i| l[i as usize]));
        assert_eq!(triangles.len(), 4);
        assert!(triangles.iter().all(|t| area(t) > 0.0) && (triangles.iter().map(area).sum::<f64>() - 3.0).abs() < 1e-12);
        let turned: Vec<DVec2> = l.into_iter().rev().collect();
        assert_eq!(signed_area(&turned), -3.0);
    }

    #[test]
    fn crossings_by_hand() {
        let square = ring(&[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]);
        let bow = ring(&[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)]);
        let spike = ring(&[(0.0, 0.0), (2.0, 0.0), (1.0, 0.0), (1.0, 1.0)]);
        let pinch = ring(&[(0.0, 0.0), (1.0, 1.0), (2.0, 0.0), (2.0, 2.0), (1.0, 1.0), (0.0, 2.0)]);
        assert_eq!(crossing(&[&square]), None);
        for bad in [&bow, &spike, &pinch] {
            assert!(crossing(&[bad]).is_some(), "{bad:?}");
        }
        let moved = |by: f64| square.iter().map(|p| p + by).collect::<Vec<_>>();
        assert!(crossing(&[&square, &moved(0.5)]).is_some() && crossing(&[&square, &moved(1.5)]).is_none());
    }

    #[test]
    fn distances_of_segments() {
        let (a, b) = (DVec2::ZERO, DVec2::X);
        assert_eq!(segments_distance(a, b, DVec2::new(0.5, -1.0), DVec2::new(0.5, 1.0)), 0.0);
        assert_eq!(segments_distance(a, b, DVec2::new(4.0, 4.0), DVec2::new(9.0, 4.0)), 5.0);
        assert_eq!(segments_distance(a, b, DVec2::new(0.2, 0.3), DVec2::new(0.8, 0.7)), 0.3);
    }

    #[test]
    fn a_staircase_becomes_a_line() {
        // Ten steps of 0.1 m along a diagonal, within 0.1 / sqrt 2 of it, and two corners.
        let mut steps: Vec<DVec2> =
            (0..10).flat_map(|i| [(i, i), (i + 1, i)]).map(|(x, y)| DVec2::new(x as f64, y as f64) / 10.0).collect();
        steps.extend(ring(&[(1.0, 1.0), (0.0, 1.0)]));
        assert_eq!(simplify(&steps, 0.08), ring(&[(0.0, 0.0), (1.0, 1.0), (0.0, 1.0)]));
        assert_eq!(simplify(&steps, 0.01).len(), 22);
    }
}
