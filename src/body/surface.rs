//! Points of a body's surface at which penetration is measured, in clusters that can be passed over together.

use super::extra::correct;
use super::parts::Part;
use super::{BODY_JOINTS, BodyModel, Frame, JOINTS, PARAMS, Posed, ShapedBody};
use glam::{Affine3A, Vec3, Vec3A};
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
const CLUSTER: usize = 12;
/// Frames in which parts are passed over together.
const BLOCK: usize = 5;
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
    /// Bones of each point and their weights, where those of point i end at `ends[i]`.
    skin: Vec<(u32, f32)>,
    ends: Vec<usize>,
    /// Body parts with their clusters.
    parts: Vec<(Part, Range<usize>)>,
}

/// A [`Surface`] at rest on a body of one shape.
#[derive(Clone)]
pub struct ShapedSurface {
    surface: Arc<Surface>,
    rest: Vec<Vec3A>,
    /// Balls that hold the clusters at rest.
    balls: Vec<(Vec3A, f32)>,
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
        let (points, clusters, bones, skin, ends, parts) = Default::default();
        let mut surface = Self { model: model.clone(), points, clusters, bones, skin, ends, parts };
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
            let first = surface.clusters.len();
            surface.cluster(chosen, &rest);
            surface.parts.push((Part::new(model, usize::from(part), &vertices, &rest, &joints), first..surface.clusters.len()));
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
    pub fn shape(self: &Arc<Self>, body: &ShapedBody) -> ShapedSurface {
        let rest: Vec<Vec3A> = self.points.iter().map(|&(v, _)| self.model.rest_vertex(v, body.betas()).into()).collect();
        let slack = if self.model.extra.is_some() { CORRECTIVE } else { 0.0 };
        let ball = |range: &Range<usize>| {
            let points = &rest[range.clone()];
            let centre = points.iter().sum::<Vec3A>() / points.len() as f32;
            (centre, slack + points.iter().map(|p| p.distance(centre)).fold(0.0, f32::max))
        };
        let balls = self.clusters.iter().map(ball).collect();
        let joints: Vec<Vec3> = body.rest_bones().collect();
        let radius = |(part, clusters): &(Part, Range<usize>)| {
            let points = self.clusters[clusters.clone()].iter().flat_map(Range::clone).map(|i| (self.points[i].0, rest[i].into()));
            slack + part.radius(&self.model, points, &joints)
        };
        let reach = self.parts.iter().map(radius).collect();
        ShapedSurface { surface: self.clone(), rest, balls, reach }
    }

    /// Cuts `points` in two along their longest side until each piece is a cluster.
    fn cluster(&mut self, mut points: Vec<(usize, f32)>, rest: &[Vec3]) {
        if points.len() <= CLUSTER {
            let first = self.points.len();
            let mut bones: Vec<usize> = points.iter().flat_map(|p| self.model.skin.of(p.0)).filter(|e| e.1 > 0.0).map(|e| e.0).collect();
            bones.sort_unstable();
            bones.dedup();
            for (vertex, weight) in points {
                self.points.push((vertex, weight));
                self.skin.extend(self.model.skin.of(vertex).iter().filter(|e| e.1 > 0.0).map(|&(k, w)| (k as u32, w)));
                self.ends.push(self.skin.len());
            }
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

/// What a body may be inside of; points are in the world, metres.
pub trait Obstacles {
    /// No more than the distance from `p` to the nearest point inside.
    fn clear(&self, p: Vec3A) -> f32;

    /// How far inside `p` is; 0 outside.
    fn depth(&self, p: Vec3A) -> f32;
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
        let (mut near, mut touched, mut bones) = (Vec::new(), Vec::new(), Vec::new());
        let mut out = Vec::with_capacity(params.len());
        for (joints, params) in joints.chunks(BLOCK).zip(params.chunks(BLOCK)) {
            near.clear();
            near.extend((0..self.reach.len()).filter(|&p| self.comes_near(p, joints, motion.to_world, obstacles)));
            for (joints, params) in joints.iter().zip(params) {
                touched.clear();
                touched
                    .extend(near.iter().copied().filter(|&p| self.comes_near(p, std::slice::from_ref(joints), motion.to_world, obstacles)));
                let mut inside = Inside::default();
                if !touched.is_empty() {
                    let posed = motion.body.pose(params);
                    place(motion.body, &posed, motion.to_world, &mut bones);
                    touched.iter().for_each(|&p| self.add_part(p, &posed, &bones, obstacles, &mut inside));
                }
                out.push(inside);
            }
        }
        out
    }

    /// Whether any of part `p` may be inside in one of the frames with these joints.
    fn comes_near(&self, p: usize, frames: &[[Vec3; JOINTS]], to_world: &Frame, obstacles: &impl Obstacles) -> bool {
        let middle = |joints: &[Vec3; JOINTS]| self.surface.parts[p].0.middle(joints);
        let first = middle(&frames[frames.len() / 2]);
        let apart = frames.iter().map(|f| middle(f).distance(first)).fold(0.0, f32::max);
        obstacles.clear(to_world.point(first).into()) <= self.reach[p] + apart
    }

    /// Adds what is inside of part `p`.
    ///
    /// A bone takes a cluster's ball to a ball of the same size, and a skinned point lies between where its bones take it: so all points
    /// of a cluster lie in the ball round the middle of those.
    fn add_part(&self, p: usize, posed: &Posed, bones: &[Affine3A], obstacles: &impl Obstacles, sum: &mut Inside) {
        for c in self.surface.parts[p].1.clone() {
            let (used, (centre, radius)) = (&self.surface.bones[c], &self.balls[c]);
            let at = |k: &usize| bones[*k].transform_point3a(*centre);
            let middle = used.iter().map(at).sum::<Vec3A>() / used.len() as f32;
            let apart = used.iter().map(|k| at(k).distance_squared(middle)).fold(0.0, f32::max).sqrt();
            if obstacles.clear(middle) > radius + apart {
                continue;
            }
            for i in self.surface.clusters[c].clone() {
                let depth = obstacles.depth(self.skin(i, posed, bones));
                if depth > 0.0 {
                    let weight = self.surface.points[i].1;
                    sum.count += weight;
                    sum.depth += weight * depth;
                }
            }
        }
    }

    /// Point `i` in the world.
    fn skin(&self, i: usize, posed: &Posed, bones: &[Affine3A]) -> Vec3A {
        let (surface, mut v) = (&*self.surface, self.rest[i]);
        if let Some(extra) = &surface.model.extra {
            let (n, vertex) = (extra.columns(), surface.points[i].0);
            v += Vec3A::from(correct(&extra.correctives[vertex * n..(vertex + 1) * n], &posed.extra.feature));
        }
        let own = &surface.skin[if i == 0 { 0 } else { surface.ends[i - 1] }..surface.ends[i]];
        own.iter().fold(Vec3A::ZERO, |sum, &(k, w)| sum + w * bones[k as usize].transform_point3a(v))
    }
}

/// What the bones of a posed body, joints first, do to points at rest, into `out`.
fn place(body: &ShapedBody, posed: &Posed, to_world: &Frame, out: &mut Vec<Affine3A>) {
    let to_world = Affine3A::from_mat3_translation(to_world.rot, to_world.transl);
    out.clear();
    out.extend(posed.bones().zip(body.rest_bones()).map(|((rot, pos), j)| to_world * Affine3A::from_mat3_translation(rot, pos - rot * j)));
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
