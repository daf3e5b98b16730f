//! Points of a body's surface at which penetration is measured, in clusters that can be passed over together.

use super::extra::correct;
use super::{BODY_JOINTS, BodyModel, Frame, Posed, ShapedBody};
use glam::{Mat3, Vec3};
use std::ops::Range;
use std::sync::Arc;

/// Vertices of SMPL-X (10,475 in all): of the head with neck and eyes (FLAME's 5,023), of both hands (MANO's 778 each), of both feet,
/// which do not count, and of all else.
const SMPLX_HEAD: f32 = 5023.0;
const SMPLX_HANDS: f32 = 1556.0;
const SMPLX_REST: f32 = 10475.0 - SMPLX_HEAD - SMPLX_HANDS - 502.0;
/// Vertices of SMPL-X itself, each of which counts once.
const SMPLX: usize = 10475;
/// Most points of a cluster.
const CLUSTER: usize = 24;
/// How far pose correctives may move a point, metres.
const CORRECTIVE: f32 = 0.06;

/// Which points are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Points {
    /// Every vertex.
    All,
    /// About that many vertices, spread evenly, each standing for those around it.
    Spread(usize),
}

/// Points on the surface of a body, feet left out, each with the number of SMPL-X vertices that it stands for.
///
/// Eq. 8 and 11 count vertices of SMPL-X. On another body each vertex weighs as many of them as its region (head, hands, rest) has
/// there per vertex here, so that 40 of them mean the same.
#[derive(Clone)]
pub struct Surface {
    model: Arc<BodyModel>,
    /// Vertex and weight, cluster by cluster.
    points: Vec<(usize, f32)>,
    clusters: Vec<Range<usize>>,
    /// Bones that move each cluster.
    bones: Vec<Vec<usize>>,
}

/// A [`Surface`] at rest on a body of one shape.
#[derive(Clone)]
pub struct ShapedSurface {
    surface: Arc<Surface>,
    rest: Vec<Vec3>,
    /// Balls that hold the clusters at rest.
    balls: Vec<(Vec3, f32)>,
}

/// What of a body lies inside obstacles in one frame, in vertices of SMPL-X.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Inside {
    /// How many.
    pub count: f32,
    /// Sum of their depths, metres.
    pub depth: f32,
}

impl Surface {
    /// The points of `model`.
    pub fn new(model: &Arc<BodyModel>, points: Points) -> Self {
        let weights = weights(model);
        let mut rest = Vec::new();
        model.rest_vertices(&[0.0; super::BETAS], &mut rest);
        let area = vertex_areas(model, &rest);
        let total: f32 = weights.iter().zip(&area).filter(|(w, _)| **w > 0.0).map(|(_, a)| a).sum();
        let mut surface = Self { model: model.clone(), points: Vec::new(), clusters: Vec::new(), bones: Vec::new() };
        for part in 0..=u8::MAX {
            let vertices: Vec<usize> = (0..rest.len()).filter(|&v| model.part()[v] == part && weights[v] > 0.0).collect();
            if vertices.is_empty() {
                continue;
            }
            let chosen = match points {
                Points::All => vertices.iter().map(|&v| (v, weights[v])).collect(),
                Points::Spread(n) => {
                    let share: f32 = vertices.iter().map(|&v| area[v]).sum::<f32>() / total;
                    spread(&vertices, ((share * n as f32).round() as usize).max(1), &rest, &weights)
                }
            };
            surface.cluster(chosen, &rest);
        }
        surface
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points on a body of this shape.
    pub fn shape(self: &Arc<Self>, betas: &[f32]) -> ShapedSurface {
        let rest: Vec<Vec3> = self.points.iter().map(|&(v, _)| self.model.rest_vertex(v, betas)).collect();
        let slack = if self.model.extra.is_some() { CORRECTIVE } else { 0.0 };
        let ball = |range: &Range<usize>| {
            let points = &rest[range.clone()];
            let centre = points.iter().sum::<Vec3>() / points.len() as f32;
            (centre, slack + points.iter().map(|p| p.distance(centre)).fold(0.0, f32::max))
        };
        let balls = self.clusters.iter().map(ball).collect();
        ShapedSurface { surface: self.clone(), rest, balls }
    }

    /// Cuts `points` in two along their longest side until each piece is a cluster.
    fn cluster(&mut self, mut points: Vec<(usize, f32)>, rest: &[Vec3]) {
        if points.len() <= CLUSTER {
            let first = self.points.len();
            let mut bones: Vec<usize> = points.iter().flat_map(|p| self.model.skin.of(p.0)).filter(|e| e.1 > 0.0).map(|e| e.0).collect();
            bones.sort_unstable();
            bones.dedup();
            self.points.extend(points);
            self.clusters.push(first..self.points.len());
            self.bones.push(bones);
            return;
        }
        let bounds = points.iter().map(|p| rest[p.0]).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
        let axis = (bounds.1 - bounds.0).max_position();
        points.sort_by(|a, b| rest[a.0][axis].total_cmp(&rest[b.0][axis]));
        let upper = points.split_off(points.len() / 2);
        self.cluster(points, rest);
        self.cluster(upper, rest);
    }
}

impl ShapedSurface {
    /// What lies inside, that is at a negative `distance` (metres, of a point in the world), of `body` as `posed` in the frame `to_world`.
    ///
    /// A bone takes a cluster's ball to a ball of the same size, and a skinned point lies between where its bones take it: so all points
    /// of a cluster lie in the ball round the middle of those, and are passed over where the distance there is greater than its radius
    /// and `slack` (how much `distance` may be too great, such as a voxel).
    pub fn inside(&self, body: &ShapedBody, posed: &Posed, to_world: &Frame, slack: f32, distance: impl Fn(Vec3) -> f32) -> Inside {
        let world = |(rot, pos): (Mat3, Vec3), j: Vec3| (to_world.rot * rot, to_world.point(pos - rot * j));
        let bones: Vec<(Mat3, Vec3)> = posed.bones().zip(body.rest_bones()).map(|(b, j)| world(b, j)).collect();
        let mut sum = Inside::default();
        for ((range, used), (centre, radius)) in self.surface.clusters.iter().zip(&self.surface.bones).zip(&self.balls) {
            let at = |k: &usize| bones[*k].0 * *centre + bones[*k].1;
            let middle = used.iter().map(at).sum::<Vec3>() / used.len() as f32;
            let apart = used.iter().map(|k| at(k).distance(middle)).fold(0.0, f32::max);
            if distance(middle) > radius + apart + slack {
                continue;
            }
            for i in range.clone() {
                let (vertex, weight) = self.surface.points[i];
                let d = distance(self.skin(i, vertex, posed, &bones));
                if d < 0.0 {
                    sum.count += weight;
                    sum.depth -= weight * d;
                }
            }
        }
        sum
    }

    fn skin(&self, i: usize, vertex: usize, posed: &Posed, bones: &[(Mat3, Vec3)]) -> Vec3 {
        let (model, mut v) = (&self.surface.model, self.rest[i]);
        if let Some(extra) = &model.extra {
            let n = extra.columns();
            v += correct(&extra.correctives[vertex * n..(vertex + 1) * n], &posed.extra.feature);
        }
        model.skin.of(vertex).iter().fold(Vec3::ZERO, |sum, &(k, w)| sum + w * (bones[k].0 * v + bones[k].1))
    }
}

/// SMPL-X vertices that each vertex stands for; 0 on the feet.
fn weights(model: &BodyModel) -> Vec<f32> {
    let mut foot = vec![false; model.vertex_count()];
    model.foot_vertices().iter().for_each(|&v| foot[v] = true);
    if model.vertex_count() == SMPLX {
        return foot.into_iter().map(|f| if f { 0.0 } else { 1.0 }).collect();
    }
    // Neck, head and eyes; wrists, to which fingers count; all else.
    let region = |part: u8| match part {
        12 | 15 => 0,
        20 | 21 => 1,
        p if usize::from(p) >= BODY_JOINTS => 0,
        _ => 2,
    };
    let mut counts = [0.0f32; 3];
    model.part().iter().zip(&foot).filter(|(_, foot)| !**foot).for_each(|(p, _)| counts[region(*p)] += 1.0);
    let each: Vec<f32> = [SMPLX_HEAD, SMPLX_HANDS, SMPLX_REST].iter().zip(counts).map(|(n, c)| n / c.max(1.0)).collect();
    model.part().iter().zip(foot).map(|(p, foot)| if foot { 0.0 } else { each[region(*p)] }).collect()
}

/// A third of the area of the triangles round each vertex, square metres.
fn vertex_areas(model: &BodyModel, rest: &[Vec3]) -> Vec<f32> {
    let mut area = vec![0.0; rest.len()];
    for f in model.faces() {
        let [a, b, c] = f.map(|i| rest[i as usize]);
        let third = (b - a).cross(c - a).length() / 6.0;
        f.iter().for_each(|&i| area[i as usize] += third);
    }
    area
}

/// `n` of `vertices`, each next one furthest from those before, with the weights of all that are nearer to it than to the others.
fn spread(vertices: &[usize], n: usize, rest: &[Vec3], weights: &[f32]) -> Vec<(usize, f32)> {
    let mut nearest = vec![(f32::INFINITY, 0); vertices.len()];
    let mut chosen = Vec::new();
    let mut next = 0;
    for k in 0..n.min(vertices.len()) {
        let at = rest[vertices[next]];
        chosen.push((vertices[next], 0.0));
        for (near, &v) in nearest.iter_mut().zip(vertices) {
            let d = rest[v].distance_squared(at);
            if d < near.0 {
                *near = (d, k);
            }
        }
        next = (0..nearest.len()).fold(0, |best, i| if nearest[i].0 > nearest[best].0 { i } else { best });
    }
    nearest.iter().zip(vertices).for_each(|(&(_, k), &v)| chosen[k].1 += weights[v]);
    chosen
}

#[cfg(test)]
mod tests {
    use super::super::tests::random_params;
    use super::*;
    use crate::body::BETAS;

    /// Depth and count over all vertices, one by one.
    fn brute(model: &BodyModel, body: &ShapedBody, posed: &Posed, to_world: &Frame, distance: impl Fn(Vec3) -> f32) -> Inside {
        let (mut vertices, weights) = (Vec::new(), weights(model));
        model.skin(body, posed, &mut vertices);
        vertices.iter().zip(weights).fold(Inside::default(), |sum, (v, w)| {
            let d = distance(to_world.point(*v)).min(0.0);
            Inside { count: sum.count + if d < 0.0 { w } else { 0.0 }, depth: sum.depth - w * d }
        })
    }

    /// Distance to a box of half sides `h` at `c`.
    fn boxed(c: Vec3, h: Vec3) -> impl Fn(Vec3) -> f32 {
        move |p| {
            let q = (p - c).abs() - h;
            q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
        }
    }

    #[test]
    fn weights_make_the_vertices_of_smplx() {
        let model = BodyModel::embedded();
        let total: f32 = weights(&model).iter().sum();
        assert!((total - (10475.0 - 502.0)).abs() < 1.0, "{total}");
        for points in [Points::All, Points::Spread(800)] {
            let surface = Surface::new(&model, points);
            let sum: f32 = surface.points.iter().map(|p| p.1).sum();
            assert!((sum - total).abs() < 1.0, "{sum}");
            assert!(surface.points.iter().all(|p| !model.foot_vertices().contains(&p.0)));
        }
    }

    #[test]
    fn passing_over_clusters_changes_nothing() {
        let model = BodyModel::embedded();
        let surface = Arc::new(Surface::new(&model, Points::All));
        let mut touched = 0;
        for k in 0..40u64 {
            let betas = [0.5 * ((k % 5) as f32 - 2.0); BETAS];
            let body = model.shape(&betas);
            let posed = body.pose(&random_params(k));
            let to_world = Frame::planar(0.3 * k as f32, 0.1 * k as f32, -0.2);
            let pelvis = to_world.point(posed.pos[0]);
            let distance = boxed(pelvis + Vec3::new(0.35, 0.05 * k as f32 - 1.0, 0.1), Vec3::new(0.3, 0.4, 0.5));
            let (got, want) = (
                surface.shape(&betas).inside(&body, &posed, &to_world, 0.0, &distance),
                brute(&model, &body, &posed, &to_world, &distance),
            );
            assert!((got.count - want.count).abs() <= 1e-3 * want.count && (got.depth - want.depth).abs() <= 1e-3 * want.depth + 1e-4);
            touched += usize::from(want.count > 0.0);
        }
        assert!((10..40).contains(&touched), "{touched} of 40 bodies touch the box");
    }

    #[test]
    fn a_wall_at_a_known_depth() {
        // A wall through the upright rest pose: half spaces below and above everything, and one that cuts nothing off but a hand.
        let model = BodyModel::embedded();
        let surface = Arc::new(Surface::new(&model, Points::All));
        let body = model.shape(&[0.0; BETAS]);
        let posed = body.pose(&[0.0; crate::body::PARAMS]);
        let shaped = surface.shape(&[0.0; BETAS]);
        let inside = |x: f32| shaped.inside(&body, &posed, &Frame::IDENTITY, 0.0, |p| x - p.x);
        assert_eq!(inside(3.0), Inside::default());
        // All 9,973, each as deep as it lies right of the plane at -3 m: the body is symmetric, so 3 m on average.
        let all = inside(-3.0);
        assert!((all.count - 9973.0).abs() < 1.0 && (all.depth / all.count - 3.0).abs() < 0.01, "{all:?}");
        // The left hand alone: 778.
        let wrist = posed.pos[20].x;
        let hand = inside(wrist + 0.005);
        assert!((600.0..=800.0).contains(&hand.count), "{hand:?}");
    }

    #[test]
    fn spread_points_stand_for_their_surroundings() {
        let model = BodyModel::embedded();
        let (all, few) = (Arc::new(Surface::new(&model, Points::All)), Arc::new(Surface::new(&model, Points::Spread(1500))));
        assert!(few.len() < 1600 && all.len() > 5 * few.len());
        let body = model.shape(&[0.0; BETAS]);
        let (all, few) = (all.shape(&[0.0; BETAS]), few.shape(&[0.0; BETAS]));
        for k in 0..20 {
            let posed = body.pose(&random_params(100 + k));
            let at = posed.pos[0].x + 0.04 * k as f32 - 0.3;
            let inside = |s: &ShapedSurface| s.inside(&body, &posed, &Frame::IDENTITY, 0.0, |p| at - p.x);
            let (a, b) = (inside(&all), inside(&few));
            assert!((a.count - b.count).abs() < 0.03 * a.count + 30.0, "{a:?} {b:?}");
            assert!((a.depth - b.depth).abs() < 0.03 * a.depth + 1.0, "{a:?} {b:?}");
        }
    }
}
