//! Points of a body's surface at which penetration is measured, in clusters that can be passed over together.

use super::extra::correct;
use super::parts::Part;
use super::{BODY_JOINTS, BodyModel, Frame, JOINTS, PARAMS, Posed, ShapedBody};
use crate::kernels::{Bone, Group, LANES, Lanes, Pulls};
use glam::{Affine3A, Vec3};
use std::ops::Range;
use std::sync::Arc;

/// Vertices of SMPL-X (10,475 in all): of the head with neck and eyes (FLAME's 5,023), of both hands (MANO's 778 each), of both feet,
/// which do not count, and of all else.
const SMPLX_HEAD: f32 = 5023.0;
const SMPLX_HANDS: f32 = 1556.0;
const SMPLX_REST: f32 = 10475.0 - SMPLX_HEAD - SMPLX_HANDS - 502.0;
/// Vertices of SMPL-X itself, each of which counts once.
const SMPLX: usize = 10475;
/// Frames in which parts are passed over together.
const BLOCK: usize = 5;
/// How far pose correctives may move a point, metres.
const CORRECTIVE: f32 = 0.06;
/// How far rounding may, metres.
const ROUNDING: f32 = 1e-4;

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
    /// Vertex and weight, [`LANES`] for each cluster; where it has fewer points, the last once more without weight.
    points: Vec<(usize, f32)>,
    /// The weights, cluster by cluster.
    weights: Vec<Lanes>,
    /// Bones of each cluster and what they weigh in each point.
    skin: Pulls,
    /// Bones of [`LANES`] clusters and what they weigh in the middle of each.
    middles: Pulls,
    /// The same bones, and how much their weights differ within each cluster; see [`ShapedSurface::inside`].
    spreads: Pulls,
    regions: Vec<Region>,
}

/// A body part.
#[derive(Clone)]
struct Region {
    part: Part,
    clusters: Range<usize>,
    /// Groups of [`LANES`] of them.
    groups: Range<usize>,
}

/// A [`Surface`] at rest on a body of one shape.
#[derive(Clone)]
pub struct ShapedSurface {
    surface: Arc<Surface>,
    /// The points of each cluster.
    rest: Vec<Group>,
    /// Balls that hold the clusters at rest, group by group: middles and radii.
    balls: Vec<(Group, Lanes)>,
    /// Radii of the balls that hold the parts in every pose.
    reach: Vec<f32>,
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
    pub fn new(model: &Arc<BodyModel>, which: Points) -> Self {
        let weights = smplx_weights(model);
        let (mut rest, mean) = (Vec::new(), model.shape(&[0.0; super::BETAS]));
        model.rest_vertices(mean.betas(), &mut rest);
        let joints: Vec<Vec3> = mean.rest_bones().collect();
        let area = vertex_areas(model, &rest);
        let total: f32 = weights.iter().zip(&area).filter(|(w, _)| **w > 0.0).map(|(_, a)| a).sum();
        let (points, weights_of, skin, middles, spreads, regions) = Default::default();
        let mut surface = Self { model: model.clone(), points, weights: weights_of, skin, middles, spreads, regions };
        for part in 0..=u8::MAX {
            let vertices: Vec<usize> = (0..rest.len()).filter(|&v| model.part()[v] == part && weights[v] > 0.0).collect();
            if vertices.is_empty() {
                continue;
            }
            let chosen = match which {
                Points::All => vertices.iter().map(|&v| (v, weights[v])).collect(),
                Points::Spread(n) => {
                    let share: f32 = vertices.iter().map(|&v| area[v]).sum::<f32>() / total;
                    spread(&vertices, ((share * n as f32).round() as usize).max(1), &rest, &weights)
                }
            };
            let (first, group) = (surface.weights.len(), surface.middles.groups());
            surface.cluster(chosen, &rest);
            let clusters = first..surface.weights.len();
            clusters.clone().step_by(LANES).for_each(|c| surface.group(c..clusters.end.min(c + LANES)));
            let part = Part::new(model, usize::from(part), &vertices, &rest, &joints);
            surface.regions.push(Region { part, clusters, groups: group..surface.middles.groups() });
        }
        surface
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.iter().filter(|p| p.1 > 0.0).count()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points on a body of this shape.
    pub fn shape(self: &Arc<Self>, body: &ShapedBody) -> ShapedSurface {
        let rest: Vec<Vec3> = self.points.iter().map(|&(v, _)| self.model.rest_vertex(v, body.betas())).collect();
        let slack = ROUNDING + if self.model.extra.is_some() { CORRECTIVE } else { 0.0 };
        let joints: Vec<Vec3> = body.rest_bones().collect();
        let radius = |region: &Region| {
            let points = region.clusters.start * LANES..region.clusters.end * LANES;
            slack + region.part.radius(&self.model, points.map(|i| (self.points[i].0, rest[i])), &joints)
        };
        let balls = self.regions.iter().flat_map(|region| balls(&region.clusters, &rest, slack)).collect();
        let reach = self.regions.iter().map(radius).collect();
        ShapedSurface { surface: self.clone(), rest: rest.chunks_exact(LANES).map(|p| grouped(|l| p[l])).collect(), balls, reach }
    }

    /// Cuts `points` in two along their longest side until each piece is a cluster.
    fn cluster(&mut self, mut points: Vec<(usize, f32)>, rest: &[Vec3]) {
        if points.len() <= LANES {
            points.resize(LANES, (points[points.len() - 1].0, 0.0));
            let bones = self.bones(&points);
            self.skin.push(bones.into_iter().map(|k| (k, Lanes(std::array::from_fn(|l| self.model.skin.weight(points[l].0, k))))));
            self.weights.push(Lanes(std::array::from_fn(|l| points[l].1)));
            self.points.extend(points);
            return;
        }
        let bounds = points.iter().map(|p| rest[p.0]).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
        let axis = (bounds.1 - bounds.0).max_position();
        points.sort_by(|a, b| rest[a.0][axis].total_cmp(&rest[b.0][axis]));
        let upper = points.split_off((points.len() / 2).next_multiple_of(LANES));
        self.cluster(points, rest);
        self.cluster(upper, rest);
    }

    /// Bones that move any of `points`.
    fn bones(&self, points: &[(usize, f32)]) -> Vec<usize> {
        let mut bones: Vec<usize> = points.iter().flat_map(|p| self.model.skin.of(p.0)).filter(|e| e.1 > 0.0).map(|e| e.0).collect();
        bones.sort_unstable();
        bones.dedup();
        bones
    }

    /// Takes [`LANES`] clusters or fewer together, so that their balls can be looked at together.
    fn group(&mut self, clusters: Range<usize>) {
        let points = |c: usize| &self.points[LANES * c..LANES * (c + 1)];
        // Mean of a bone's weights in a cluster, and how far one of them is from it.
        let sway = |c: usize, bone: usize| {
            let weight = |p: &(usize, f32)| self.model.skin.weight(p.0, bone);
            let mean = points(c).iter().map(weight).sum::<f32>() / LANES as f32;
            (mean, points(c).iter().map(|p| (weight(p) - mean).abs()).fold(0.0, f32::max))
        };
        let bones = self.bones(&self.points[LANES * clusters.start..LANES * clusters.end]);
        let sways: Vec<Vec<(f32, f32)>> = bones.iter().map(|&k| clusters.clone().map(|c| sway(c, k)).collect()).collect();
        let total = |l: usize| sways.iter().map(|s| s[l].1).sum::<f32>();
        let lanes = |of: &dyn Fn(usize) -> f32| Lanes(std::array::from_fn(|l| if l < clusters.len() { of(l) } else { 0.0 }));
        let means: Vec<_> = bones.iter().zip(&sways).map(|(&k, s)| (k, lanes(&|l| s[l].0))).collect();
        let spreads: Vec<_> = bones.iter().zip(&sways).map(|(&k, s)| (k, lanes(&|l| s[l].1 * total(l)))).collect();
        self.middles.push(means);
        self.spreads.push(spreads.into_iter().filter(|(_, w)| w.0.iter().any(|&w| w > 0.0)));
    }
}

/// Middles and radii of the balls round these clusters of points at rest, group by group.
fn balls(clusters: &Range<usize>, rest: &[Vec3], slack: f32) -> Vec<(Group, Lanes)> {
    let ball = |c: usize| {
        let points = &rest[LANES * c..LANES * (c + 1)];
        let middle = points.iter().sum::<Vec3>() / LANES as f32;
        (middle, slack + points.iter().map(|p| p.distance(middle)).fold(0.0, f32::max))
    };
    let balls: Vec<(Vec3, f32)> = clusters.clone().map(ball).collect();
    let group = |balls: &[(Vec3, f32)]| {
        let at = |l: usize| balls[l.min(balls.len() - 1)];
        (grouped(|l| at(l).0), Lanes(std::array::from_fn(|l| at(l).1)))
    };
    balls.chunks(LANES).map(group).collect()
}

/// Sixteen points.
fn grouped(point: impl Fn(usize) -> Vec3) -> Group {
    [0, 1, 2].map(|axis| Lanes(std::array::from_fn(|l| point(l)[axis])))
}

/// What a body may be inside of; points are in the world, metres.
pub trait Obstacles {
    /// Distances of sixteen points to the nearest point inside; negative inside.
    fn distances(&self, at: &Group, out: &mut Lanes);

    /// By how much distances outside may be too great, metres.
    fn slack(&self) -> f32;
}

/// A body's motion: T frames.
#[derive(Clone, Copy, Debug)]
pub struct Moving<'a> {
    pub body: &'a ShapedBody,
    /// T x 93 parameters.
    pub params: &'a [f32],
    /// T x 24 x 3 joints of these, metres.
    pub joints: &'a [f32],
    /// From their frame to the world.
    pub to_world: &'a Frame,
}

impl ShapedSurface {
    /// What lies inside in each frame of a motion of the body of this shape.
    ///
    /// Where the distance at the middle of a ball is greater than its radius, nothing in it is inside. Such balls hold a body part over some
    /// frames, then in one frame, for which the joints suffice; then, of a posed body, a cluster.
    pub fn over(&self, motion: &Moving, obstacles: &impl Obstacles) -> Vec<Inside> {
        let joints: Vec<[Vec3; JOINTS]> = motion.joints.chunks_exact(3 * JOINTS).map(as_points).collect();
        let params: Vec<&[f32]> = motion.params.chunks_exact(PARAMS).collect();
        let all: Vec<usize> = (0..self.reach.len()).collect();
        let (mut near, mut touched, mut bones) = (Vec::new(), Vec::new(), Vec::new());
        let mut out = Vec::with_capacity(params.len());
        for (joints, params) in joints.chunks(BLOCK).zip(params.chunks(BLOCK)) {
            self.near(&all, joints, motion.to_world, obstacles, &mut near);
            for (joints, params) in joints.iter().zip(params) {
                self.near(&near, std::slice::from_ref(joints), motion.to_world, obstacles, &mut touched);
                out.push(if touched.is_empty() {
                    Inside::default()
                } else {
                    let posed = motion.body.pose(params);
                    place(motion.body, &posed, motion.to_world, &mut bones);
                    self.inside(&touched, &posed, &bones, obstacles)
                });
            }
        }
        out
    }

    /// Those of `parts` of which any may be inside in one of the frames with these joints, into `out`.
    fn near(&self, parts: &[usize], frames: &[[Vec3; JOINTS]], to_world: &Frame, obstacles: &impl Obstacles, out: &mut Vec<usize>) {
        out.clear();
        for parts in parts.chunks(LANES) {
            let (mut at, mut reach, mut distances) = (Group::default(), [0.0; LANES], Lanes::default());
            for (l, &p) in parts.iter().enumerate() {
                let middle = |joints: &[Vec3; JOINTS]| self.surface.regions[p].part.middle(joints);
                let first = middle(&frames[frames.len() / 2]);
                reach[l] = self.reach[p] + frames.iter().map(|f| middle(f).distance(first)).fold(0.0, f32::max);
                at.iter_mut().zip(to_world.point(first).to_array()).for_each(|(at, v)| at.0[l] = v);
            }
            obstacles.distances(&at, &mut distances);
            let may = |l: &usize| distances.0[*l] - obstacles.slack() <= reach[*l];
            out.extend((0..parts.len()).filter(may).map(|l| parts[l]));
        }
    }

    /// What is inside of these parts.
    ///
    /// A bone k takes a cluster's ball to a ball of the same size round m_k. A point whose bones weigh w_k lies within that size of the sum
    /// of w_k m_k. From the middle m, the sum of W_k m_k with mean weights W_k, that is the sum of (w_k - W_k) (m_k - m) away: with
    /// d_k >= |w_k - W_k| at most the root of (sum of d_k) (sum of d_k |m_k - m|^2).
    fn inside(&self, parts: &[usize], posed: &Posed, bones: &[Bone], obstacles: &impl Obstacles) -> Inside {
        let (mut count, mut depth) = (Lanes::default(), Lanes::default());
        let (mut at, mut apart, mut distances) = (Group::default(), Lanes::default(), Lanes::default());
        for region in parts.iter().map(|&p| &self.surface.regions[p]) {
            for (group, first) in region.groups.clone().zip(region.clusters.clone().step_by(LANES)) {
                let (middles, radii) = &self.balls[group];
                self.surface.middles.skin(group, bones, middles, &mut at);
                self.surface.spreads.spread(group, bones, middles, &at, &mut apart);
                obstacles.distances(&at, &mut distances);
                for l in 0..LANES.min(region.clusters.end - first) {
                    if distances.0[l] - obstacles.slack() > radii.0[l] + apart.0[l] {
                        continue;
                    }
                    let (mut points, mut own) = (Group::default(), Lanes::default());
                    self.skin(first + l, posed, bones, &mut points);
                    obstacles.distances(&points, &mut own);
                    let sums = count.0.iter_mut().zip(&mut depth.0);
                    for ((count, depth), (d, weight)) in sums.zip(own.0.iter().zip(&self.surface.weights[first + l].0)) {
                        *count += if *d < 0.0 { *weight } else { 0.0 };
                        *depth -= weight * d.min(0.0);
                    }
                }
            }
        }
        Inside { count: count.0.iter().sum(), depth: depth.0.iter().sum() }
    }

    /// The points of cluster `c` in the world.
    fn skin(&self, c: usize, posed: &Posed, bones: &[Bone], out: &mut Group) {
        let surface = &*self.surface;
        let Some(extra) = &surface.model.extra else {
            return surface.skin.skin(c, bones, &self.rest[c], out);
        };
        let (n, mut rest) = (extra.columns(), self.rest[c]);
        for (l, &(vertex, _)) in surface.points[LANES * c..LANES * (c + 1)].iter().enumerate() {
            let lift = correct(&extra.correctives[vertex * n..(vertex + 1) * n], &posed.extra.feature);
            rest.iter_mut().zip(lift.to_array()).for_each(|(rest, v)| rest.0[l] += v);
        }
        surface.skin.skin(c, bones, &rest, out);
    }
}

/// What the bones of a posed body, joints first, do to points at rest, into `out`.
fn place(body: &ShapedBody, posed: &Posed, to_world: &Frame, out: &mut Vec<Bone>) {
    let to_world = Affine3A::from_mat3_translation(to_world.rot, to_world.transl);
    let moves = posed.bones().zip(body.rest_bones()).map(|((rot, pos), j)| to_world * Affine3A::from_mat3_translation(rot, pos - rot * j));
    out.clear();
    out.extend(moves.map(|m| [0, 1, 2].map(|row| m.matrix3.row(row).extend(m.translation[row]).to_array())));
}

/// One frame of joints.
fn as_points(floats: &[f32]) -> [Vec3; JOINTS] {
    std::array::from_fn(|k| Vec3::from_slice(&floats[3 * k..]))
}

/// Number of SMPL-X vertices that each vertex stands for, 0 on the feet; see [`Surface`].
pub fn smplx_weights(model: &BodyModel) -> Vec<f32> {
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
mod tests;
