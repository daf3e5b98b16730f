//! Clips on the project's body, the skeleton they live on and its feet.

use super::FPS;
use crate::body::{BODY_JOINTS, BodyModel, JOINTS, PARAMS, PARENTS, joint};
use glam::{Quat, Vec2, Vec3};
use std::f32::consts::{FRAC_PI_2, PI};
use std::ops::Range;

/// Left and right.
pub const SIDES: usize = 2;

/// Turns the rest frame (x left, y up, z forward) upright in the world (z up); the body then faces -y.
pub fn upright() -> Quat {
    Quat::from_rotation_x(FRAC_PI_2)
}

/// `angle` brought into -pi..pi.
pub fn wrap(angle: f32) -> f32 {
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

/// Planar rotation of `v` by `yaw`.
pub fn turn(yaw: f32, v: Vec2) -> Vec2 {
    Vec2::from_angle(yaw).rotate(v)
}

/// Heading of a joint about z, radians: 0 for the upright rest pose.
pub fn heading(rot: Quat) -> f32 {
    let forward = rot * Vec3::Z;
    forward.x.atan2(-forward.y)
}

/// One leg: its joints and, relative to them in rest axes, the points of the sole that touch the floor.
#[derive(Clone, Copy, Debug)]
pub struct Leg {
    pub hip: usize,
    pub knee: usize,
    pub ankle: usize,
    pub toe: usize,
    /// Rear end of the sole, from the ankle.
    pub heel: Vec3,
    /// Sole below the toe joint, from the ankle.
    pub ball: Vec3,
    /// Front end of the sole, from the toe joint.
    pub tip: Vec3,
}

/// Rest joints and legs of a body.
#[derive(Clone, Debug)]
pub struct Skeleton {
    /// Rest joints, metres.
    pub rest: [Vec3; JOINTS],
    /// Left and right leg.
    pub legs: [Leg; SIDES],
}

/// One frame of a clip, world with z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position of the pelvis joint, metres.
    pub root: Vec3,
    /// Global rotation of each joint, rest to world.
    pub rots: [Quat; BODY_JOINTS],
}

/// Where a foot is: the ankle, the foot's and the toes' global rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootPose {
    pub ankle: Vec3,
    pub rot: Quat,
    pub toe: Quat,
}

/// A motion clip at 40 frames per second on the body with zero betas.
#[derive(Clone, Debug)]
pub struct Clip {
    pub name: String,
    pub poses: Vec<Pose>,
    /// Whether the left and the right foot stand on the floor.
    pub contact: Vec<[bool; SIDES]>,
}

impl Pose {
    /// The pose `s` of the way (0..1) from this one to `next`: the root linearly, rotations along the shortest arc.
    pub fn between(&self, next: &Self, s: f32) -> Self {
        let rots = std::array::from_fn(|j| self.rots[j].slerp(next.rots[j], s));
        Self { root: self.root.lerp(next.root, s), rots }
    }
}

impl Skeleton {
    /// The skeleton of `model` with zero betas.
    pub fn new(model: &BodyModel) -> Self {
        let rest = *model.joints_template();
        let mut vertices = Vec::new();
        model.rest_vertices(&[0.0; crate::body::BETAS], &mut vertices);
        let feet: Vec<Vec3> = model.foot_vertices().iter().map(|&v| vertices[v]).collect();
        Self::with_soles(rest, &feet)
    }

    /// A skeleton whose soles are the lower hull of `foot_points` (rest frame, both feet).
    pub fn with_soles(rest: [Vec3; JOINTS], foot_points: &[Vec3]) -> Self {
        let floor = foot_points.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
        let leg = |left: bool| {
            let [hip, knee, ankle, toe] = if left { [1, 4, 7, 10] } else { [2, 5, 8, 11] };
            let z = foot_points.iter().filter(|p| (p.x > 0.0) == left && p.y < floor + 0.02).map(|p| p.z);
            let (rear, front) = z.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
            let at = |x: f32, z: f32| Vec3::new(x, floor, z);
            Leg {
                hip,
                knee,
                ankle,
                toe,
                heel: at(rest[ankle].x, rear) - rest[ankle],
                ball: at(rest[toe].x, rest[toe].z) - rest[ankle],
                tip: at(rest[toe].x, front) - rest[toe],
            }
        };
        Self { rest, legs: [leg(true), leg(false)] }
    }

    /// Hip to knee to ankle, metres.
    pub fn leg_length(&self, side: usize) -> f32 {
        let leg = &self.legs[side];
        self.rest[leg.hip].distance(self.rest[leg.knee]) + self.rest[leg.knee].distance(self.rest[leg.ankle])
    }

    /// Height of the ankle above the floor when the foot stands flat, metres.
    pub fn ankle_height(&self, side: usize) -> f32 {
        -self.legs[side].heel.y
    }

    /// Joint positions of a pose, eyes last.
    pub fn joints(&self, pose: &Pose) -> [Vec3; JOINTS] {
        let mut p = [pose.root; JOINTS];
        for j in 1..JOINTS {
            p[j] = p[PARENTS[j]] + pose.rots[PARENTS[j]] * (self.rest[j] - self.rest[PARENTS[j]]);
        }
        p
    }

    /// The foot of a pose.
    pub fn foot(&self, pose: &Pose, side: usize) -> FootPose {
        let leg = &self.legs[side];
        let bone = |a: usize, b: usize| pose.rots[a] * (self.rest[b] - self.rest[a]);
        let ankle = pose.root + bone(joint::PELVIS, leg.hip) + bone(leg.hip, leg.knee) + bone(leg.knee, leg.ankle);
        FootPose { ankle, rot: pose.rots[leg.ankle], toe: pose.rots[leg.toe] }
    }

    /// Heel, ball and tip of the sole.
    pub fn sole(&self, side: usize, foot: &FootPose) -> [Vec3; 3] {
        let leg = &self.legs[side];
        let toe_joint = foot.ankle + foot.rot * (self.rest[leg.toe] - self.rest[leg.ankle]);
        [foot.ankle + foot.rot * leg.heel, foot.ankle + foot.rot * leg.ball, toe_joint + foot.toe * leg.tip]
    }

    /// Height of the lowest point of both soles.
    pub fn lowest(&self, pose: &Pose) -> f32 {
        (0..SIDES).flat_map(|s| self.sole(s, &self.foot(pose, s))).map(|q| q.z).fold(f32::INFINITY, f32::min)
    }

    /// Body parameters of a pose (hands zero).
    pub fn params(&self, pose: &Pose) -> [f32; PARAMS] {
        let mut out = [0.0; PARAMS];
        out[0..3].copy_from_slice(&(pose.root - self.rest[joint::PELVIS]).to_array());
        for j in 0..BODY_JOINTS {
            let local = if j == 0 { pose.rots[0] } else { pose.rots[PARENTS[j]].inverse() * pose.rots[j] };
            out[3 + 3 * j..6 + 3 * j].copy_from_slice(&short(local).to_scaled_axis().to_array());
        }
        out
    }
}

/// The same rotation with an angle of at most pi.
fn short(q: Quat) -> Quat {
    let q = q.normalize();
    if q.w < 0.0 { -q } else { q }
}

impl Clip {
    /// Frames.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether the clip holds no frame.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Runs of frames in which foot `side` stands.
    pub fn stances(&self, side: usize) -> Vec<Range<usize>> {
        runs(&self.contact.iter().map(|c| c[side]).collect::<Vec<_>>())
    }

    /// Tracks of one foot.
    pub fn feet(&self, skeleton: &Skeleton, side: usize) -> Vec<FootPose> {
        self.poses.iter().map(|p| skeleton.foot(p, side)).collect()
    }

    /// Body parameters, one row of 93 per frame.
    pub fn params(&self, skeleton: &Skeleton) -> Vec<[f32; PARAMS]> {
        self.poses.iter().map(|p| skeleton.params(p)).collect()
    }
}

/// Runs of true.
pub fn runs(flags: &[bool]) -> Vec<Range<usize>> {
    let mut out: Vec<Range<usize>> = Vec::new();
    for (t, _) in flags.iter().enumerate().filter(|(_, f)| **f) {
        match out.last_mut() {
            Some(r) if r.end == t => r.end = t + 1,
            _ => out.push(t..t + 1),
        }
    }
    out
}

/// Speed between neighbours of a track, metres per second, one value per frame.
pub fn speeds(points: &[Vec3]) -> Vec<f32> {
    let n = points.len();
    (0..n)
        .map(|t| {
            let (a, b) = (t.saturating_sub(1), (t + 1).min(n - 1));
            points[b].distance(points[a]) * FPS / (b - a).max(1) as f32
        })
        .collect()
}

/// 3 s^2 - 2 s^3 on 0..1.
pub fn smoothstep(s: f32) -> f32 {
    let s = s.clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// The `q` quantile (0..1) of `values`; 0 when there are none.
pub fn quantile(values: &[f32], q: f32) -> f32 {
    let mut v = values.to_vec();
    v.sort_by(f32::total_cmp);
    if v.is_empty() { 0.0 } else { v[((v.len() - 1) as f32 * q).round() as usize] }
}
