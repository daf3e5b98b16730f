//! A bounding-volume tree over triangles, asked for the nearest of them and for winding numbers.

use glam::{Vec3, Vec3A};
use obvhs::bvh2::builder::build_bvh2;
use obvhs::{Boundable, BvhBuildParams, aabb::Aabb};
use std::f32::consts::PI;

/// Beyond this many radii of a node its triangles count as one dipole (Barill et al. 2018, their beta).
const FAR: f32 = 2.0;
/// From this many triangles on a tree is built faster, for somewhat slower questions.
const MANY: usize = 1_000_000;

/// The corners of a triangle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tri(pub [Vec3; 3]);

impl Boundable for Tri {
    fn aabb(&self) -> Aabb {
        Aabb::from_points(&self.0.map(Vec3A::from))
    }
}

#[derive(Clone, Debug, Default)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// First triangle, or first of the two children.
    first: u32,
    /// Triangles; 0 in nodes with children.
    count: u32,
    /// Sum of the triangles' areas times their normals, square metres.
    area: Vec3,
    /// Area-weighted middle of the triangles, metres.
    middle: Vec3,
    /// Square of the distance from the middle beyond which the node is far.
    far: f32,
}

impl Node {
    fn distance_squared(&self, p: Vec3) -> f32 {
        (self.low - p).max(p - self.high).max(Vec3::ZERO).length_squared()
    }
}

/// Triangles in a tree.
#[derive(Clone, Debug)]
pub(super) struct Tree {
    /// In the order of the leaves.
    triangles: Vec<Tri>,
    /// Which of the triangles that it was made from each of these is.
    order: Vec<u32>,
    nodes: Vec<Node>,
}

impl Tree {
    /// Builds the tree; there must be triangles.
    pub fn new(triangles: Vec<Tri>) -> Self {
        let params = if triangles.len() < MANY { BvhBuildParams::medium_build() } else { BvhBuildParams::fast_build() };
        let bvh = build_bvh2(&triangles, params, &mut Default::default());
        let node = |n: &obvhs::bvh2::node::Bvh2Node| Node { first: n.first_index, count: n.prim_count, ..Node::default() };
        let mut tree = Self { triangles: Vec::new(), order: bvh.primitive_indices, nodes: bvh.nodes.iter().map(node).collect() };
        tree.fit(&triangles);
        tree
    }

    /// Makes it the tree of triangles that have moved, as many and in the same order as those it was made from. Questions are as fast as
    /// before where neighbours stay neighbours.
    pub fn fit(&mut self, triangles: &[Tri]) {
        self.triangles.clear();
        self.triangles.extend(self.order.iter().map(|&i| triangles[i as usize]));
        self.sum_up();
    }

    /// Bounds, areas and middles of all nodes, children before their parents.
    fn sum_up(&mut self) {
        let (mut order, mut at) = (vec![0], 0);
        while at < order.len() {
            let node = &self.nodes[order[at]];
            if node.count == 0 {
                order.extend([node.first as usize, node.first as usize + 1]);
            }
            at += 1;
        }
        let mut sizes = vec![0.0; self.nodes.len()];
        for &i in order.iter().rev() {
            let node = &self.nodes[i];
            let (mut area, mut middle, mut size) = (Vec3::ZERO, Vec3::ZERO, 0.0);
            let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
            let mut add = |part: Vec3, at: Vec3, weight: f32| {
                area += part;
                middle += weight * at;
                size += weight;
            };
            if node.count == 0 {
                let first = node.first as usize;
                for c in [first, first + 1] {
                    add(self.nodes[c].area, self.nodes[c].middle, sizes[c]);
                    (low, high) = (low.min(self.nodes[c].low), high.max(self.nodes[c].high));
                }
            }
            for &Tri([a, b, c]) in &self.triangles[leaf(node)] {
                let area = 0.5 * (b - a).cross(c - a);
                add(area, (a + b + c) / 3.0, area.length());
                (low, high) = (low.min(a).min(b).min(c), high.max(a).max(b).max(c));
            }
            sizes[i] = size;
            let node = &mut self.nodes[i];
            (node.low, node.high, node.area) = (low, high, area);
            node.middle = if size > 0.0 { middle / size } else { 0.5 * (node.low + node.high) };
            node.far = FAR * FAR * (node.middle - node.low).max(node.high - node.middle).length_squared();
        }
    }

    /// Square of the distance from `p` to the nearest triangle, or `bound` if that is less. `open` is scratch memory.
    pub fn distance_squared(&self, p: Vec3, bound: f32, open: &mut Vec<(f32, u32)>) -> f32 {
        self.search(p, (bound, 0), open).0
    }

    /// The nearest triangle and the square of its distance from `p`. The search is shorter if `guess` is near.
    pub fn nearest(&self, p: Vec3, guess: u32, open: &mut Vec<(f32, u32)>) -> (f32, u32) {
        self.search(p, ((nearest(p, self.triangle(guess)) - p).length_squared(), guess), open)
    }

    /// What is nearer than `best`, a square of a distance and a triangle, or that.
    fn search(&self, p: Vec3, mut best: (f32, u32), open: &mut Vec<(f32, u32)>) -> (f32, u32) {
        open.clear();
        open.push((self.nodes[0].distance_squared(p), 0));
        while let Some((distance, i)) = open.pop() {
            if distance >= best.0 {
                continue;
            }
            let node = &self.nodes[i as usize];
            if node.count > 0 {
                let squares = leaf(node).map(|t| ((nearest(p, &self.triangles[t]) - p).length_squared(), t as u32));
                best = squares.fold(best, |best, t| if t.0 < best.0 { t } else { best });
                continue;
            }
            let mut children = [node.first, node.first + 1].map(|c| (self.nodes[c as usize].distance_squared(p), c));
            if children[0].0 < children[1].0 {
                children.swap(0, 1);
            }
            open.extend(children.iter().filter(|c| c.0 < best.0));
        }
        best
    }

    /// Adds the triangles of all leaves that come as near to the box `low..high` as `reach` to `out`; false where these would be more than
    /// `most`.
    pub fn within(&self, low: Vec3, high: Vec3, reach: f32, most: usize, out: &mut Vec<u32>) -> bool {
        let mut open = vec![0];
        while let Some(i) = open.pop() {
            let node = &self.nodes[i as usize];
            if (node.low - high).max(low - node.high).max(Vec3::ZERO).length_squared() > reach * reach {
                continue;
            }
            if node.count > 0 {
                out.extend(leaf(node).map(|t| t as u32));
            } else {
                open.extend([node.first, node.first + 1]);
            }
            if out.len() > most {
                return false;
            }
        }
        true
    }

    /// One of the triangles.
    pub fn triangle(&self, i: u32) -> &Tri {
        &self.triangles[i as usize]
    }

    /// The generalised winding number at `p`: 1 within a closed surface whose normals point outwards, 0 outside, between them near holes.
    ///
    /// The sum of the solid angles of all triangles over 4 pi; far nodes count as dipoles. `open` is scratch memory.
    pub fn winding(&self, p: Vec3, open: &mut Vec<u32>) -> f32 {
        let mut sum = 0.0;
        open.clear();
        open.push(0);
        while let Some(i) = open.pop() {
            let node = &self.nodes[i as usize];
            let away = node.middle - p;
            let squared = away.length_squared();
            if squared > node.far {
                sum += node.area.dot(away) / (squared * squared.sqrt());
            } else if node.count > 0 {
                sum += self.triangles[leaf(node)].iter().map(|t| solid_angle(p, t)).sum::<f32>();
            } else {
                open.extend([node.first, node.first + 1]);
            }
        }
        sum / (4.0 * PI)
    }
}

/// Triangles of a leaf; none of an inner node.
fn leaf(node: &Node) -> std::ops::Range<usize> {
    let first = if node.count > 0 { node.first as usize } else { 0 };
    first..first + node.count as usize
}

/// The point of a triangle nearest to `p` (Ericson, Real-Time Collision Detection, 5.1.5).
pub(super) fn nearest(p: Vec3, &Tri([a, b, c]): &Tri) -> Vec3 {
    let (ab, ac, ap, bp, cp) = (b - a, c - a, p - a, p - b, p - c);
    let (d1, d2, d3, d4, d5, d6) = (ab.dot(ap), ac.dot(ap), ab.dot(bp), ac.dot(bp), ab.dot(cp), ac.dot(cp));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let (va, vb, vc) = (d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2);
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    a + (ab * vb + ac * vc) / (va + vb + vc)
}

/// Solid angle under which `p` sees a triangle, positive from behind its outer side (Van Oosterom and Strackee 1983).
fn solid_angle(p: Vec3, triangle: &Tri) -> f32 {
    let [a, b, c] = triangle.0.map(|v| v - p);
    let (la, lb, lc) = (a.length(), b.length(), c.length());
    2.0 * a.dot(b.cross(c)).atan2(la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_points_by_hand() {
        // A right triangle in the plane z = 0 seen from its face, edges and corners.
        let t = Tri([Vec3::ZERO, Vec3::X * 4.0, Vec3::Y * 3.0]);
        for (p, want) in [
            (Vec3::new(1.0, 1.0, 2.0), Vec3::new(1.0, 1.0, 0.0)),
            (Vec3::new(1.0, -1.0, 1.0), Vec3::X),
            (Vec3::new(-2.0, 1.5, 0.0), Vec3::Y * 1.5),
            (Vec3::new(-1.0, -1.0, 5.0), Vec3::ZERO),
            (Vec3::new(6.0, -1.0, 0.0), Vec3::X * 4.0),
            (Vec3::new(-1.0, 9.0, 0.0), Vec3::Y * 3.0),
            // (2, 1.5) is the middle of the long side; (3, 4) is its normal.
            (Vec3::new(5.0, 5.5, 1.0), Vec3::new(2.0, 1.5, 0.0)),
        ] {
            assert!((nearest(p, &t) - want).length() < 1e-5, "{p}: {}", nearest(p, &t));
        }
        // No area: a point, and three in a line.
        assert_eq!(nearest(Vec3::Z, &Tri([Vec3::X; 3])), Vec3::X);
        assert_eq!(nearest(Vec3::new(1.0, 1.0, 0.0), &Tri([Vec3::ZERO, Vec3::X, Vec3::X * 2.0])), Vec3::X);
    }

    #[test]
    fn solid_angle_of_an_octant() {
        let t = Tri([Vec3::X, Vec3::Y, Vec3::Z]);
        assert!((solid_angle(Vec3::ZERO, &t) - 0.5 * PI).abs() < 1e-6);
        assert!((solid_angle(Vec3::ZERO, &Tri([Vec3::X, Vec3::Z, Vec3::Y])) + 0.5 * PI).abs() < 1e-6);
    }
}
