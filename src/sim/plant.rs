//! Feet that stand: the body is carried by the foot it stands on, and legs give way to feet that stand.

use crate::body::rotation::to_axis_angle;
use crate::body::{PARAMS, PARENTS, ShapedBody, TRANSL};
use crate::motion::FPS;
use crate::motion::clip::{FootPose, Pose, SIDES, Skeleton, heading, smoothstep, wrap};
use crate::motion::ik::place_feet;
use glam::{Mat3, Quat, Vec2, Vec3};

/// Heights of the lowest sole point up to which a foot stands, and from which on it does not, metres.
const HEIGHT: [f32; 2] = [0.015, 0.04];
/// Speed from which on a foot is taken to move on purpose, m/s.
const SPEED: f32 = 0.6;
/// Height over which the load passes from one sole point, and from one foot, to another, metres.
const ROLL: f32 = 0.008;
/// Part of a swinging foot's correction that goes in each frame.
const RELEASE: f32 = 0.15;
/// Most that a foot is moved against the body, metres, and turned, radians.
const MOST: f32 = 0.08;
const MOST_TURN: f32 = 0.5;

/// What was changed on a foot so far.
#[derive(Clone, Copy, Default)]
struct Fix {
    yaw: f32,
    /// Against the body, in the plane.
    shift: Vec2,
}

/// Changes the bodies of the frames `which` (rising, counted from 0) among those behind the first one of `params` ((1 + T) x 93, z above the floor), which
/// stays, so that feet which stand do not slide; returns how far each was moved in the plane (its root; the legs then differ too).
///
/// A foot stands while its sole is low and slower than 0.6 m/s. The body moves against the slip of the foot that bears it; what slip
/// is left to a standing foot is taken by its leg (two-bone inverse kinematics), which also keeps the foot's heading. `legs`: the
/// soles of the mean shape.
pub(super) fn plant(legs: &Skeleton, body: &ShapedBody, params: &mut [f32], which: &[usize]) -> Vec<Vec2> {
    let skeleton = Skeleton { rest: *body.joints(), legs: legs.legs };
    let (first, rest) = params.split_at_mut(PARAMS);
    let pose = pose_of(body, first);
    let before = std::array::from_fn(|side| {
        let foot = skeleton.foot(&pose, side);
        (foot, skeleton.sole(side, &foot))
    });
    let mut walk = Walk { skeleton, at: Vec2::ZERO, fixes: [Fix::default(); SIDES], before };
    let mut next = 0;
    let each = which.iter().map(|&t| {
        let steps = (t + 1 - std::mem::replace(&mut next, t + 1)) as i32;
        walk.frame(body, &mut rest[t * PARAMS..][..PARAMS], steps)
    });
    each.collect()
}

struct Walk {
    skeleton: Skeleton,
    /// Where the body was moved to.
    at: Vec2,
    fixes: [Fix; SIDES],
    /// Each foot in the body before as it came, and its sole with the heading it was given.
    before: [(FootPose, [Vec3; 3]); SIDES],
}

impl Walk {
    /// The next body, `steps` frames after the one before.
    fn frame(&mut self, body: &ShapedBody, params: &mut [f32], steps: i32) -> Vec2 {
        let mut pose = pose_of(body, params);
        let feet: [FootPose; SIDES] = std::array::from_fn(|side| self.skeleton.foot(&pose, side));
        let raw: [[Vec3; 3]; SIDES] = std::array::from_fn(|side| self.skeleton.sole(side, &feet[side]));
        let stands: [f32; SIDES] = std::array::from_fn(|side| {
            let was = self.skeleton.sole(side, &self.before[side].0);
            standing(&was, &raw[side], steps)
        });
        let keep = stands.map(|s| (1.0 - RELEASE * (1.0 - s)).powi(steps));
        let mut slips = [Vec2::ZERO; SIDES];
        for side in 0..SIDES {
            let (foot, sole) = &mut self.before[side];
            let fix = &mut self.fixes[side];
            let turned = wrap(heading(feet[side].rot) - heading(foot.rot));
            fix.yaw = (keep[side] * fix.yaw - stands[side] * turned).clamp(-MOST_TURN, MOST_TURN);
            let now = self.skeleton.sole(side, &corrected(&feet[side], fix.yaw, Vec2::ZERO));
            slips[side] = slip(sole, &now);
            (*foot, *sole) = (feet[side], now);
        }
        let low = raw.map(|sole| lowest(&sole));
        let bears = low.map(|z| ((low[0].min(low[1]) - z) / ROLL).exp());
        let total = bears[0] + bears[1];
        let step: Vec2 = (0..SIDES).map(|s| -slips[s] * stands[s] * bears[s] / total).sum();
        self.at += step;
        for (side, fix) in self.fixes.iter_mut().enumerate() {
            fix.shift = (keep[side] * fix.shift - stands[side] * (slips[side] + step)).clamp_length_max(MOST);
        }
        pose.root += self.at.extend(0.0);
        params[TRANSL].copy_from_slice(&(pose.root - self.skeleton.rest[0]).to_array());
        if self.fixes.iter().any(|f| f.yaw != 0.0 || f.shift != Vec2::ZERO) {
            let fixed = |side: usize| corrected(&feet[side], self.fixes[side].yaw, self.at + self.fixes[side].shift);
            place_feet(&self.skeleton, &mut pose, &[fixed(0), fixed(1)]);
            self.write_legs(&pose, params);
        }
        self.at
    }

    /// The legs of `pose`; what else `params` holds stays.
    fn write_legs(&self, pose: &Pose, params: &mut [f32]) {
        for leg in &self.skeleton.legs {
            for j in [leg.hip, leg.knee, leg.ankle, leg.toe] {
                let local = Mat3::from_quat(pose.rots[PARENTS[j]].inverse() * pose.rots[j]);
                params[3 + 3 * j..6 + 3 * j].copy_from_slice(&to_axis_angle(&local).to_array());
            }
        }
    }
}

fn pose_of(body: &ShapedBody, params: &[f32]) -> Pose {
    let posed = body.pose(params);
    Pose { root: posed.pos[0], rots: std::array::from_fn(|j| Quat::from_mat3(&posed.rot[j])) }
}

fn corrected(foot: &FootPose, yaw: f32, shift: Vec2) -> FootPose {
    let turn = Quat::from_rotation_z(yaw);
    FootPose { ankle: foot.ankle + shift.extend(0.0), rot: turn * foot.rot, toe: turn * foot.toe }
}

fn lowest(sole: &[Vec3; 3]) -> f32 {
    sole.iter().fold(f32::INFINITY, |low, p| low.min(p.z))
}

/// Horizontal way of the part of the sole that bears from one frame to the next, metres: heel, ball and tip count the more the lower.
fn slip(before: &[Vec3; 3], after: &[Vec3; 3]) -> Vec2 {
    let load = |sole: &[Vec3; 3]| {
        let w = sole.map(|p| ((lowest(sole) - p.z) / ROLL).exp());
        let sum: f32 = w.iter().sum();
        w.map(|w| w / sum)
    };
    let (a, b) = (load(before), load(after));
    (0..3).map(|i| 0.5 * (a[i] + b[i]) * (after[i] - before[i]).truncate()).sum()
}

/// How much a foot stands whose sole was `before` that many frames ago, 0 to 1.
fn standing(before: &[Vec3; 3], after: &[Vec3; 3], steps: i32) -> f32 {
    let height = lowest(before).max(lowest(after));
    let speed = slip(before, after).length() * (FPS / steps as f32);
    let low = 1.0 - smoothstep((height - HEIGHT[0]) / (HEIGHT[1] - HEIGHT[0]));
    low * (1.0 - (speed / SPEED).powi(2)).max(0.0).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BETAS, BODY_JOINTS, BodyModel};
    use crate::motion::clip::upright;

    const FRAMES: usize = 9;

    struct Film {
        legs: Skeleton,
        body: ShapedBody,
        params: Vec<f32>,
    }

    /// The rest pose upright with bent knees, its soles `height` up, changed by `change(frame, pose)`.
    fn film(height: f32, change: impl Fn(usize, &mut Pose)) -> Film {
        let model = BodyModel::embedded();
        let (legs, body) = (Skeleton::new(&model), model.shape(&[0.0; BETAS]));
        let mut still = Pose { root: Vec3::ZERO, rots: [upright(); BODY_JOINTS] };
        for (thigh, shank) in [(1, 4), (2, 5)] {
            still.rots[thigh] = Quat::from_rotation_x(-0.2) * upright();
            still.rots[shank] = Quat::from_rotation_x(0.2) * upright();
        }
        let root = Vec3::Z * (height - legs.lowest(&still));
        let mut params = Vec::new();
        for t in 0..FRAMES {
            let mut pose = Pose { root, rots: still.rots };
            change(t, &mut pose);
            params.extend(legs.params(&pose));
        }
        Film { legs, body, params }
    }

    impl Film {
        fn sole(&self, params: &[f32], t: usize, side: usize) -> [Vec3; 3] {
            let foot = self.legs.foot(&pose_of(&self.body, &params[t * PARAMS..][..PARAMS]), side);
            self.legs.sole(side, &foot)
        }

        /// The bodies as planted, and where they were moved to.
        fn planted(&self) -> (Vec<f32>, Vec<Vec2>) {
            self.planted_at(&Vec::from_iter(0..FRAMES - 1))
        }

        fn planted_at(&self, which: &[usize]) -> (Vec<f32>, Vec<Vec2>) {
            let mut params = self.params.clone();
            let by = plant(&self.legs, &self.body, &mut params, which);
            (params, by)
        }

        /// Way of heel, ball and tip of one foot over the film, metres.
        fn way(&self, params: &[f32], side: usize) -> f32 {
            let (a, b) = (self.sole(params, 0, side), self.sole(params, FRAMES - 1, side));
            (0..3).map(|i| (b[i] - a[i]).truncate().length()).fold(0.0, f32::max)
        }
    }

    #[test]
    fn a_gliding_body_is_held() {
        // 2.5 mm a frame, 0.1 m/s: (1 - (0.1 / 0.6)^2)^2 of it is taken back.
        let f = film(0.0, |t, pose| pose.root.x += 0.0025 * t as f32);
        let (params, by) = f.planted();
        let part = (1.0f32 - 1.0 / 36.0).powi(2);
        for (t, by) in by.iter().enumerate() {
            let want = -part * 0.0025 * (t + 1) as f32;
            assert!((by.x - want).abs() < 1e-5 && by.y.abs() < 1e-5, "{by} for {want}");
        }
        assert_eq!(params[..PARAMS], f.params[..PARAMS]);
        // Where only some frames are looked at, those stand as they did.
        let (_, some) = f.planted_at(&[0, 3, 7]);
        some.iter().zip([by[0], by[3], by[7]]).for_each(|(a, b)| assert!((a - b).length() < 1e-5, "{a} for {b}"));
        // What is left, the legs take the same part of.
        let left = 0.0025 * (FRAMES - 1) as f32 * (1.0 - part) * (1.0 - part);
        assert!((f.way(&params, 0) - left).abs() < 1e-4, "{} for {left}", f.way(&params, 0));
    }

    #[test]
    fn feet_that_part_are_held_by_their_legs() {
        // Both legs swing apart at the hips, the left twice as fast: no movement of the body alone could hold both feet.
        let f = film(0.003, |t, pose| {
            for (side, rate) in [(0, 2.0), (1, -1.0)] {
                let turn = Quat::from_rotation_x(0.0012 * rate * t as f32);
                for j in [[1, 4, 7, 10], [2, 5, 8, 11]][side] {
                    pose.rots[j] = turn * pose.rots[j];
                }
            }
        });
        let (params, _) = f.planted();
        for side in 0..SIDES {
            let (raw, held) = (f.way(&f.params, side), f.way(&params, side));
            assert!(raw > 0.007 && held < 0.15 * raw, "foot {side} slides {held} m of {raw}");
        }
    }

    /// A foot that was held while it glided is given back by 15 % in each frame once it is up, however many frames lie between two bodies.
    #[test]
    fn a_lifted_foot_is_let_go_by_time() {
        let f = film(0.0, |t, pose| {
            pose.root.x += 0.01 * t.min(2) as f32;
            pose.root.z += if t > 2 { 0.1 } else { 0.0 };
        });
        let [every, some] = [vec![0, 1, 2, 3, 4, 5, 6, 7], vec![0, 1, 2, 7]].map(|which| f.planted_at(&which).0);
        let shift = |params: &[f32], t: usize| {
            let root = Vec3::from_slice(&params[t * PARAMS..]) - Vec3::from_slice(&f.params[t * PARAMS..]);
            (f.sole(params, t, 0)[0] - f.sole(&f.params, t, 0)[0] - root).x
        };
        let (held, left) = (shift(&every, 3), shift(&every, 8));
        assert!(held.abs() > 5e-4, "the leg gave way by {held} m");
        assert!((left - held * 0.85f32.powi(5)).abs() < 2e-5, "{left} of {held}");
        assert!((shift(&some, 8) - left).abs() < 2e-5, "{} for {left}", shift(&some, 8));
    }

    #[test]
    fn a_turning_foot_keeps_its_heading() {
        let f = film(0.0, |t, pose| {
            let turn = Quat::from_rotation_z(0.01 * t as f32);
            pose.rots.iter_mut().for_each(|r| *r = turn * *r);
        });
        let (params, _) = f.planted();
        let yaw = |p: &[f32], t: usize| heading(pose_of(&f.body, &p[t * PARAMS..][..PARAMS]).rots[7]);
        let (raw, held) = (yaw(&f.params, FRAMES - 1) - yaw(&f.params, 0), yaw(&params, FRAMES - 1) - yaw(&params, 0));
        assert!(raw > 0.079 && held.abs() < 0.15 * raw, "turns by {held} of {raw}");
        // The body turns on.
        let root = |p: &[f32]| heading(pose_of(&f.body, &p[(FRAMES - 1) * PARAMS..]).rots[0]);
        assert!((root(&params) - root(&f.params)).abs() < 1e-4);
    }

    #[test]
    fn what_flies_or_runs_is_left() {
        let flies = film(0.05, |t, pose| pose.root.x += 0.0025 * t as f32);
        let runs = film(0.0, |t, pose| pose.root.x += 0.016 * t as f32);
        for f in [flies, runs] {
            let (params, by) = f.planted();
            assert!(by.iter().all(|b| *b == Vec2::ZERO));
            let worst = params.iter().zip(&f.params).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 2e-3, "{worst}");
        }
    }
}
