//! Edits of clips that keep the feet standing: mirroring, another path, another timing, calmer limbs.

use crate::body::{BODY_JOINTS, PARENTS};
use crate::motion::clip::{Clip, FootPose, Pose, SIDES, Skeleton, heading, smoothstep, turn};
use crate::motion::footlock::{flat, lock_feet, set_feet};
use glam::{Quat, Vec2, Vec3, Vec4};

/// The joint on the other side of each body joint.
const OTHER: [usize; BODY_JOINTS] = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20];
/// Joints above the pelvis, parents first.
const UPPER: [usize; 13] = [3, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21];
/// Part of the limbs' swing that [`calm`] takes away at most.
const CALM: f32 = 0.85;
/// Steps shorter than this (metres) go by time, longer ones by way.
const MIN_WAY: f32 = 0.2;
/// Frames of half a walking cycle.
const HALF_CYCLE: usize = 22;
/// Part of its length to which a standing leg is stretched.
const STANDING: f32 = 0.99;

/// The clip seen in a mirror: x -> -x with left and right swapped.
pub fn mirror(clip: &Clip) -> Clip {
    let flip = |q: Quat| Quat::from_xyzw(q.x, -q.y, -q.z, q.w);
    let poses = clip
        .poses
        .iter()
        .map(|p| Pose { root: Vec3::new(-p.root.x, p.root.y, p.root.z), rots: std::array::from_fn(|j| flip(p.rots[OTHER[j]])) });
    Clip { name: format!("{}~mirror", clip.name), poses: poses.collect(), contact: clip.contact.iter().map(|c| [c[1], c[0]]).collect() }
}

/// A rigid motion of the floor: turn by `yaw` about the origin, then move by `shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planar {
    pub yaw: f32,
    pub shift: Vec2,
}

impl Planar {
    fn point(&self, p: Vec3) -> Vec3 {
        (turn(self.yaw, p.truncate()) + self.shift).extend(p.z)
    }

    fn rot(&self, q: Quat) -> Quat {
        (Quat::from_rotation_z(self.yaw) * q).normalize()
    }
}

/// The transforms that turn the clip's root path by the angle `yaw[t]` (radians) and make of each metre of it `stride[t]`: x metres
/// along the path and y metres to its left.
///
/// p'(t) = p'(t-1) + R(yaw) S (p(t) - p(t-1)), S = [x -y; y x], with both factors at the step's middle.
pub fn bent_path(clip: &Clip, yaw: &[f32], stride: &[Vec2]) -> Vec<Planar> {
    let at = |t: usize| clip.poses[t].root.truncate();
    let mut place = at(0);
    (0..clip.len())
        .map(|t| {
            if t > 0 {
                let (angle, scale) = (0.5 * (yaw[t] + yaw[t - 1]), 0.5 * (stride[t] + stride[t - 1]));
                place += scale.rotate(turn(angle, at(t) - at(t - 1)));
            }
            Planar { yaw: yaw[t], shift: place - turn(yaw[t], at(t)) }
        })
        .collect()
}

/// Moves the body along `path` (one transform per frame) while every stance of a foot moves as one rigid piece.
///
/// A stance takes the transform of its middle frame, so the foot keeps its own roll and does not slide; in a swing the
/// foot goes over from one stance's transform to the next as it proceeds along its step. Each foot is planted `spread` (metres,
/// per frame) further out than it was. The legs follow by IK.
pub fn replant(skeleton: &Skeleton, clip: &Clip, path: &[Planar], spread: &[f32]) -> Clip {
    let mut out = clip.clone();
    for (pose, m) in out.poses.iter_mut().zip(path) {
        pose.root = m.point(pose.root);
        pose.rots.iter_mut().for_each(|q| *q = m.rot(*q));
    }
    let feet = std::array::from_fn(|side| {
        let outward = if side == 0 { 1.0 } else { -1.0 };
        let left = |pose: &Pose| turn(heading(pose.rots[0]), Vec2::X);
        let moved = path.iter().zip(&out.poses).zip(spread);
        let places: Vec<Planar> = moved.map(|((m, pose), s)| Planar { shift: m.shift + outward * s * left(pose), ..*m }).collect();
        replanted_track(&clip.feet(skeleton, side), &clip.stances(side), &places)
    });
    set_feet(skeleton, &mut out, &feet);
    out
}

/// How far out feet must be planted, metres, so that they do not cross where `stride` (see [`bent_path`]) leads sideways.
///
/// In side steps the leading foot steps wide and the other one closes. With the pelvis moving on evenly, a quarter of the way of
/// a whole cycle either way keeps the feet's distance in closing what it was.
pub fn sideways_spread(clip: &Clip, stride: &[Vec2]) -> Vec<f32> {
    let n = clip.len();
    let step = |t: usize| stride[t].y * (clip.poses[t].root - clip.poses[t - 1].root).truncate().length();
    (0..n)
        .map(|t| {
            let cycle = t.saturating_sub(HALF_CYCLE) + 1..(t + HALF_CYCLE).min(n - 1) + 1;
            let share = (2 * HALF_CYCLE) as f32 / cycle.len() as f32;
            0.25 * share * cycle.map(step).sum::<f32>().abs()
        })
        .collect()
}

fn replanted_track(feet: &[FootPose], stances: &[std::ops::Range<usize>], path: &[Planar]) -> Vec<FootPose> {
    let last = feet.len() - 1;
    // Stances as (first frame, last frame, transform); the ends of the clip close the outer swings.
    let mut plants: Vec<(usize, usize, Planar)> = vec![(0, 0, path[0])];
    plants.extend(stances.iter().map(|s| (s.start, s.end - 1, path[(s.start + s.end - 1) / 2])));
    plants.push((last, last, path[last]));
    if stances.first().is_some_and(|s| s.start == 0) {
        plants.remove(0);
    }
    if stances.last().is_some_and(|s| s.end == feet.len()) {
        plants.pop();
    }
    let mut next = 0;
    (0..feet.len())
        .map(|t| {
            while plants[next].1 < t {
                next += 1;
            }
            let (start, _, b) = plants[next];
            if t >= start {
                return FootPose { ankle: b.point(feet[t].ankle), rot: b.rot(feet[t].rot), toe: b.rot(feet[t].toe) };
            }
            let (_, end, a) = plants[next - 1];
            let s = progress(feet, end, start, t);
            let turned = Planar { yaw: a.yaw + s * (b.yaw - a.yaw), shift: Vec2::ZERO };
            let (left, landed) = (feet[end].ankle, feet[start].ankle);
            let (from, to) = (a.point(left), b.point(landed));
            // From plant to plant on an arc that leaves and arrives along the turned headings, plus the clip's own
            // deviation from its straight way.
            let arc = (to - from).truncate().perp() * (-0.5 * s * (1.0 - s) * (b.yaw - a.yaw));
            let ankle = from.lerp(to, s) + arc.extend(0.0) + turned.point(feet[t].ankle - left.lerp(landed, s));
            FootPose { ankle, rot: turned.rot(feet[t].rot), toe: turned.rot(feet[t].toe) }
        })
        .collect()
}

/// How much of the swing between frames `a` and `b` is done at `t`: the part of the step's way, or of its time when the
/// foot lands near where it left.
fn progress(feet: &[FootPose], a: usize, b: usize, t: usize) -> f32 {
    let way = (feet[b].ankle - feet[a].ankle).with_z(0.0);
    if way.length() < MIN_WAY {
        return smoothstep((t - a) as f32 / (b - a) as f32);
    }
    ((feet[t].ankle - feet[a].ankle).dot(way) / way.length_squared()).clamp(0.0, 1.0)
}

/// The clip at the given frame times (fractional, within the clip; going backwards is allowed).
///
/// Positions and rotations are interpolated by Catmull-Rom splines, the feet on their own so that they stay where they stand.
pub fn resample(skeleton: &Skeleton, clip: &Clip, times: &[f32]) -> Clip {
    let feet: [Vec<FootPose>; SIDES] = std::array::from_fn(|side| clip.feet(skeleton, side));
    let n = clip.len();
    let mut out = Clip { name: clip.name.clone(), poses: Vec::with_capacity(times.len()), contact: Vec::with_capacity(times.len()) };
    let mut tracks: [Vec<FootPose>; SIDES] = Default::default();
    for &time in times {
        let time = time.clamp(0.0, (n - 1) as f32);
        let base = (time as usize).min(n.saturating_sub(2));
        let spline = Spline { at: [base.saturating_sub(1), base, (base + 1).min(n - 1), (base + 2).min(n - 1)], s: time - base as f32 };
        out.poses.push(Pose {
            root: spline.point(|t| clip.poses[t].root),
            rots: std::array::from_fn(|j| spline.rot(|t| clip.poses[t].rots[j])),
        });
        let (a, b) = (clip.contact[time as usize], clip.contact[time.ceil() as usize]);
        out.contact.push([a[0] && b[0], a[1] && b[1]]);
        for (track, feet) in tracks.iter_mut().zip(&feet) {
            track.push(FootPose {
                ankle: spline.point(|t| feet[t].ankle),
                rot: spline.rot(|t| feet[t].rot),
                toe: spline.rot(|t| feet[t].toe),
            });
        }
    }
    set_feet(skeleton, &mut out, &tracks);
    out
}

/// Four frames and the place between the middle two.
struct Spline {
    at: [usize; 4],
    s: f32,
}

impl Spline {
    fn weights(&self) -> [f32; 4] {
        let s = self.s;
        let (s2, s3) = (s * s, s * s * s);
        [-0.5 * s + s2 - 0.5 * s3, 1.0 - 2.5 * s2 + 1.5 * s3, 0.5 * s + 2.0 * s2 - 1.5 * s3, 0.5 * (s3 - s2)]
    }

    fn point(&self, value: impl Fn(usize) -> Vec3) -> Vec3 {
        self.at.iter().zip(self.weights()).map(|(&t, w)| w * value(t)).sum()
    }

    fn rot(&self, value: impl Fn(usize) -> Quat) -> Quat {
        let reference = value(self.at[1]);
        let sum: Vec4 = self
            .at
            .iter()
            .zip(self.weights())
            .map(|(&t, w)| {
                let q = value(t);
                Vec4::from(if q.dot(reference) < 0.0 { -q } else { q }) * w
            })
            .sum();
        Quat::from_vec4(sum).normalize()
    }
}

/// Takes the swing out of the body by `amount[t]` (0 none, 1 nearly all): upper limbs go to the clip's mean and feet become
/// flat. For slow, small steps and standing; see also [`raise`].
pub fn calm(skeleton: &Skeleton, clip: &Clip, amount: &[f32]) -> Clip {
    let mut out = clip.clone();
    let mean = mean_locals(clip);
    for (t, pose) in out.poses.iter_mut().enumerate() {
        let a = CALM * amount[t];
        let old = clip.poses[t].rots;
        for j in UPPER {
            let local = old[PARENTS[j]].inverse() * old[j];
            pose.rots[j] = (pose.rots[PARENTS[j]] * local.slerp(mean[j], a)).normalize();
        }
        for leg in &skeleton.legs {
            let level = flat(heading(old[leg.ankle]));
            pose.rots[leg.ankle] = old[leg.ankle].slerp(level, a);
        }
    }
    // Levelled about their ankles, the feet have left the floor and slipped: put them down again.
    lock_feet(skeleton, &mut out);
    out
}

/// Gives `clip` by `weight[t]` (0 none, 1 all) the upper body of somebody who stands, `idle` from frame `from` on, and carries
/// the pelvis over the feet as that person does; the feet stay where they are.
pub fn stand_idly(skeleton: &Skeleton, clip: &Clip, idle: &Clip, from: usize, weight: &[f32]) -> Clip {
    let mut out = clip.clone();
    let between = |p: &Pose| 0.5 * (skeleton.foot(p, 0).ankle + skeleton.foot(p, 1).ankle);
    let facing = |c: &Clip, t: usize| heading(c.poses[t].rots[0]);
    let middle = from + clip.len() / 2;
    for (t, pose) in out.poses.iter_mut().enumerate() {
        let (w, like) = (weight[t], &idle.poses[from + t]);
        if w == 0.0 {
            continue;
        }
        let yaw = Planar { yaw: facing(clip, t) - facing(idle, middle), shift: Vec2::ZERO };
        let old = clip.poses[t];
        pose.root = old.root.lerp(between(&old) + yaw.point(like.root - between(like)), w);
        pose.rots[0] = old.rots[0].slerp(yaw.rot(like.rots[0]), w);
        for j in UPPER {
            let local = |p: &Pose| p.rots[PARENTS[j]].inverse() * p.rots[j];
            pose.rots[j] = (pose.rots[PARENTS[j]] * local(&old).slerp(local(like), w)).normalize();
        }
    }
    let feet = std::array::from_fn(|side| clip.feet(skeleton, side));
    set_feet(skeleton, &mut out, &feet);
    out
}

/// Brings the pelvis by `amount[t]` (0 to 1) to the height at which nearly straight legs carry it, feet unmoved.
pub fn raise(skeleton: &Skeleton, clip: &Clip, amount: &[f32]) -> Clip {
    let mut out = clip.clone();
    let height = standing_height(skeleton);
    for (pose, amount) in out.poses.iter_mut().zip(amount) {
        pose.root.z += CALM * amount * (height - pose.root.z);
    }
    let feet = std::array::from_fn(|side| clip.feet(skeleton, side));
    set_feet(skeleton, &mut out, &feet);
    out
}

/// Height of the pelvis over flat feet with legs stretched to [`STANDING`] of their length, metres.
fn standing_height(skeleton: &Skeleton) -> f32 {
    let hips = 0.5 * (skeleton.rest[1].y + skeleton.rest[2].y) - skeleton.rest[0].y;
    skeleton.ankle_height(0) + STANDING * skeleton.leg_length(0) - hips
}

/// Mean local rotation of each joint over the clip.
fn mean_locals(clip: &Clip) -> [Quat; BODY_JOINTS] {
    std::array::from_fn(|j| {
        let local = |p: &Pose| if j == 0 { p.rots[0] } else { p.rots[PARENTS[j]].inverse() * p.rots[j] };
        let reference = local(&clip.poses[0]);
        let sum: Vec4 = clip.poses.iter().map(local).map(|q| Vec4::from(if q.dot(reference) < 0.0 { -q } else { q })).sum();
        Quat::from_vec4(sum).normalize()
    })
}
