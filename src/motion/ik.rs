//! Two-bone inverse kinematics that puts given feet under a given upper body.

use super::clip::{FootPose, Pose, SIDES, Skeleton};
use glam::{Quat, Vec3};

/// The leg is never stretched beyond this part of its length.
pub const REACH: f32 = 0.995;

/// The knee between `hip` and `ankle` for bones of length `upper` and `lower`, bent towards `pole` (a direction).
///
/// Out of reach, the ankle is taken to lie on the ray from the hip at [`REACH`] of the leg's length. Law of cosines.
pub fn knee_position(hip: Vec3, ankle: Vec3, upper: f32, lower: f32, pole: Vec3) -> Vec3 {
    let to = ankle - hip;
    let axis = to.try_normalize().unwrap_or(Vec3::NEG_Z);
    let d = to.length().clamp((upper - lower).abs() + 1e-4, REACH * (upper + lower));
    let along = (upper * upper - lower * lower + d * d) / (2.0 * d);
    let out = (pole - axis * pole.dot(axis)).try_normalize().unwrap_or_else(|| axis.any_orthonormal_vector());
    hip + axis * along + out * (upper * upper - along * along).max(0.0).sqrt()
}

/// Turns the legs of `pose` so that its feet are `feet`. Upper body and pelvis stay; the old knee directions are the poles.
pub fn place_feet(skeleton: &Skeleton, pose: &mut Pose, feet: &[FootPose; SIDES]) {
    for (side, foot) in feet.iter().enumerate() {
        let leg = &skeleton.legs[side];
        let (thigh, shank) = (skeleton.rest[leg.knee] - skeleton.rest[leg.hip], skeleton.rest[leg.ankle] - skeleton.rest[leg.knee]);
        let hip = pose.root + pose.rots[0] * (skeleton.rest[leg.hip] - skeleton.rest[0]);
        let old_knee = hip + pose.rots[leg.hip] * thigh;
        let old_axis = old_knee + pose.rots[leg.knee] * shank - hip;
        // A straight leg has no knee direction of its own: the thigh's front decides there.
        let perpendicular = (old_knee - hip) - old_axis * ((old_knee - hip).dot(old_axis) / old_axis.length_squared().max(1e-9));
        let pole = perpendicular + 0.02 * (pose.rots[leg.hip] * Vec3::Z);
        let swing = arc(old_axis, foot.ankle - hip);
        let knee = knee_position(hip, foot.ankle, thigh.length(), shank.length(), swing * pole);
        pose.rots[leg.hip] = aim(swing * pose.rots[leg.hip], thigh, knee - hip);
        pose.rots[leg.knee] = aim(swing * pose.rots[leg.knee], shank, foot.ankle - knee);
        pose.rots[leg.ankle] = foot.rot;
        pose.rots[leg.toe] = foot.toe;
    }
}

/// How far a foot lies beyond the leg's reach, metres; negative when it is within.
pub fn overreach(skeleton: &Skeleton, pose: &Pose, side: usize, ankle: Vec3) -> f32 {
    let hip = pose.root + pose.rots[0] * (skeleton.rest[skeleton.legs[side].hip] - skeleton.rest[0]);
    hip.distance(ankle) - REACH * skeleton.leg_length(side)
}

/// `rot` with the least further turn that brings rest direction `bone` to `to`.
fn aim(rot: Quat, bone: Vec3, to: Vec3) -> Quat {
    (arc(rot * bone, to) * rot).normalize()
}

/// The least rotation from the direction of `from` to that of `to`; the identity for vanishing vectors.
pub fn arc(from: Vec3, to: Vec3) -> Quat {
    match (from.try_normalize(), to.try_normalize()) {
        (Some(a), Some(b)) => Quat::from_rotation_arc(a, b),
        _ => Quat::IDENTITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn knee_by_hand() {
        // Bones of 5 and 5 over a distance of 6: the knee stands 3 along and 4 out.
        let knee = knee_position(Vec3::Z, Vec3::new(0.0, 0.0, -5.0), 5.0, 5.0, Vec3::new(0.0, -1.0, 3.0));
        assert!((knee - Vec3::new(0.0, -4.0, -2.0)).length() < 1e-5, "{knee}");
        // Out of reach: 12 for bones of 5 + 5; the leg ends at 9.95, so the knee is 4.975 along.
        let knee = knee_position(Vec3::ZERO, Vec3::new(0.0, 0.0, -12.0), 5.0, 5.0, Vec3::NEG_Y);
        assert!((knee.z + 4.975).abs() < 1e-5 && knee.y < 0.0, "{knee}");
    }
}
