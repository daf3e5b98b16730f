//! Cleaning of recordings: false starts, ankles that jump, jitter.

use super::clip::{Pose, quantile};
use super::cmu::{SOURCE_FPS, SourceFrame, cmu_joint};
use glam::{Quat, Vec3, Vec4};

/// Frames cut off at both ends at 120 per second: some recordings begin with leftovers of the T-pose.
const TRIM: usize = 12;
/// Half the window of the running median over the ankles' rotations, frames at 120 per second.
const MEDIAN: usize = 5;

/// Trims both ends and takes jumps of some hundredths of a second out of the ankles by a running median.
pub fn clean(frames: &[SourceFrame], fps: f32) -> Vec<SourceFrame> {
    let at_rate = |frames: usize| (frames as f32 * fps / SOURCE_FPS).round() as usize;
    let (trim, half) = (at_rate(TRIM).min(frames.len() / 4), at_rate(MEDIAN));
    let mut out = frames[trim..frames.len() - trim].to_vec();
    for (knee, ankle) in [(cmu_joint::L_KNEE, cmu_joint::L_ANKLE), (cmu_joint::R_KNEE, cmu_joint::R_ANKLE)] {
        let local: Vec<Vec3> = out.iter().map(|f| short(f.rots[knee].inverse() * f.rots[ankle]).to_scaled_axis()).collect();
        for (t, frame) in out.iter_mut().enumerate() {
            let window = &local[t.saturating_sub(half)..(t + half + 1).min(local.len())];
            let middle = |axis: usize| quantile(&window.iter().map(|v| v[axis]).collect::<Vec<_>>(), 0.5);
            let turn = Quat::from_scaled_axis(Vec3::new(middle(0), middle(1), middle(2)));
            frame.rots[ankle] = frame.rots[knee] * turn;
        }
    }
    out
}

/// The same rotation with an angle of at most pi.
fn short(q: Quat) -> Quat {
    if q.w < 0.0 { -q } else { q }
}

/// Smooths poses with the weights 1/4, 1/2, 1/4, which halve what moves at a quarter of the frame rate; the ends stay.
pub fn smooth(poses: &[Pose]) -> Vec<Pose> {
    let mean = |a: Quat, b: Quat, c: Quat| {
        let near = |q: Quat| Vec4::from(if q.dot(b) < 0.0 { -q } else { q });
        Quat::from_vec4(near(a) + 2.0 * Vec4::from(b) + near(c)).normalize()
    };
    let mut out = poses.to_vec();
    for (w, pose) in poses.windows(3).zip(out.iter_mut().skip(1)) {
        pose.root = 0.25 * (w[0].root + 2.0 * w[1].root + w[2].root);
        pose.rots = std::array::from_fn(|j| mean(w[0].rots[j], w[1].rots[j], w[2].rots[j]));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::cmu::CMU_JOINTS;

    #[test]
    fn ankle_jumps_vanish_and_steady_turns_stay() {
        let frame = |t: usize, jump: f32| {
            let mut rots = [Quat::from_rotation_y(0.3); CMU_JOINTS];
            rots[cmu_joint::L_ANKLE] = rots[0] * Quat::from_rotation_x(0.01 * t as f32 + jump);
            SourceFrame { root: Vec3::ZERO, rots }
        };
        let frames: Vec<_> = (0..80).map(|t| frame(t, if (40..44).contains(&t) { 0.7 } else { 0.0 })).collect();
        let out = clean(&frames, SOURCE_FPS);
        assert_eq!(out.len(), 80 - 2 * TRIM);
        for (i, f) in out.iter().enumerate().skip(MEDIAN).take(80 - 2 * TRIM - 2 * MEDIAN) {
            let want = frame(i + TRIM, 0.0).rots[cmu_joint::L_ANKLE];
            assert!(f.rots[cmu_joint::L_ANKLE].angle_between(want) < 0.05, "frame {i}");
        }
    }

    #[test]
    fn smoothing_by_hand() {
        let pose = |x: f32| Pose { root: Vec3::X * x, rots: [Quat::IDENTITY; crate::body::BODY_JOINTS] };
        let out = smooth(&[pose(0.0), pose(4.0), pose(0.0), pose(0.0)]);
        assert_eq!(out.iter().map(|p| p.root.x).collect::<Vec<_>>(), [0.0, 2.0, 1.0, 0.0]);
    }
}
