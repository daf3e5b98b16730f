//! Properties of the edits on a made-up walker.

use super::*;
use crate::body::{BODY_JOINTS, JOINTS, PARENTS};
use crate::motion::clip::{FootPose, Pose, turn};
use crate::motion::footlock::{detect_contact, flat, lock_feet, set_feet};
use glam::{Quat, Vec2, Vec3};

/// A straight-legged body of 0.4 m thighs and shanks, with soles from 6 cm behind to 20 cm before the ankles.
fn skeleton() -> Skeleton {
    let offsets: [[f32; 3]; JOINTS] = std::array::from_fn(|j| match j {
        1 => [0.1, -0.05, 0.0],
        2 => [-0.1, -0.05, 0.0],
        4 | 5 | 7 | 8 => [0.0, -0.4, 0.0],
        10 | 11 => [0.0, -0.05, 0.13],
        3 | 6 | 9 | 12 | 15 => [0.0, 0.12, 0.0],
        13 | 16 | 18 | 20 => [0.15, 0.0, 0.0],
        14 | 17 | 19 | 21 => [-0.15, 0.0, 0.0],
        _ => [0.0, 0.0, 0.1],
    });
    let mut rest = [Vec3::ZERO; JOINTS];
    for j in 1..JOINTS {
        rest[j] = rest[PARENTS[j]] + Vec3::from(offsets[j]);
    }
    let sole = |x: f32, z: f32| Vec3::new(x, -0.92, z);
    Skeleton::with_soles(rest, &[sole(0.1, -0.06), sole(0.1, 0.2), sole(-0.1, -0.06), sole(-0.1, 0.2)])
}

/// Four seconds of walking towards -y at 1 m/s, 0.5 s a step, whose standing feet creep by `slip` m/s.
fn walker(skeleton: &Skeleton, slip: f32) -> Clip {
    let n = 160;
    let rots = [flat(0.0); BODY_JOINTS];
    let poses = (0..n).map(|t| Pose { root: Vec3::new(0.0, -(t as f32) / 40.0, 0.86), rots }).collect();
    let mut clip = Clip { name: "walker".into(), poses, contact: vec![[true; SIDES]; n] };
    let feet = std::array::from_fn(|side| {
        let foot = |t: usize| {
            // Strides of 1 m in 40 frames: 26 frames of stance, 14 of swing.
            let phase = t + 20 * side + 13;
            let (stride, at) = ((phase / 40) as f32, phase % 40);
            let swing = smoothstep((at as f32 - 26.0) / 14.0);
            let ahead = stride + swing + slip * (at.min(26) as f32) / 40.0 - 0.5 * side as f32;
            let lift = 0.1 * (std::f32::consts::PI * swing).sin();
            FootPose { ankle: Vec3::new(if side == 0 { 0.1 } else { -0.1 }, -ahead, 0.07 + lift), rot: flat(0.0), toe: flat(0.0) }
        };
        (0..n).map(foot).collect()
    });
    set_feet(skeleton, &mut clip, &feet);
    detect_contact(skeleton, &mut clip);
    clip
}

fn worst(skeleton: &Skeleton, a: &Clip, b: &Clip) -> f32 {
    let gap = |(p, q): (&Pose, &Pose)| {
        let (p, q) = (skeleton.joints(p), skeleton.joints(q));
        p.iter().zip(&q).map(|(p, q)| p.distance(*q)).fold(0.0, f32::max)
    };
    a.poses.iter().zip(&b.poses).map(gap).fold(0.0, f32::max)
}

#[test]
fn stances_are_found_and_locked() {
    let skeleton = skeleton();
    let mut clip = walker(&skeleton, 0.1);
    assert!((3..=5).contains(&clip.stances(0).len()), "{:?}", clip.stances(0));
    let before = quantile(&slides(&skeleton, &clip), 0.5);
    lock_feet(&skeleton, &mut clip);
    let after = quantile(&slides(&skeleton, &clip), 1.0);
    assert!(before > 0.02 && after < 2e-3, "{before} to {after}");
    let low = clip.poses.iter().flat_map(|p| (0..SIDES).flat_map(|s| skeleton.sole(s, &skeleton.foot(p, s)))).map(|p| p.z);
    assert!(low.fold(f32::INFINITY, f32::min) > -2e-3);
}

#[test]
fn mirroring_twice_is_the_identity() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    assert!(worst(&skeleton, &mirror(&mirror(&clip)), &clip) < 1e-6);
    let once = mirror(&clip);
    assert_eq!(once.contact[5], [clip.contact[5][1], clip.contact[5][0]]);
    let (left, right) = (skeleton.foot(&clip.poses[30], 0).ankle, skeleton.foot(&once.poses[30], 1).ankle);
    assert!((left * Vec3::new(-1.0, 1.0, 1.0) - right).length() < 1e-5);
}

#[test]
fn edits_that_ask_for_nothing_change_nothing() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    let n = clip.len();
    let path = bent_path(&clip, &vec![0.0; n], &vec![Vec2::X; n]);
    assert!(worst(&skeleton, &replant(&skeleton, &clip, &path, &vec![0.0; n]), &clip) < 1e-4);
    let times: Vec<f32> = (0..n).map(|t| t as f32).collect();
    assert!(worst(&skeleton, &resample(&skeleton, &clip, &times), &clip) < 1e-4);
}

#[test]
fn one_rigid_motion_moves_everything_rigidly() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    let m = Planar { yaw: 0.7, shift: Vec2::new(2.0, -1.0) };
    let moved = replant(&skeleton, &clip, &vec![m; clip.len()], &vec![0.0; clip.len()]);
    for (a, b) in clip.poses.iter().zip(&moved.poses) {
        for (p, q) in skeleton.joints(a).iter().zip(skeleton.joints(b)) {
            assert!((turn(0.7, p.truncate()) + m.shift - q.truncate()).length() < 1e-4 && (p.z - q.z).abs() < 1e-4);
        }
    }
}

#[test]
fn bent_slow_and_stopped_walks_do_not_slide() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    for kind in [Kind::Bent, Kind::SlowBent, Kind::Stop, Kind::Small, Kind::Reversed] {
        let made = vary(&skeleton, &clip, &[], kind, &mut stream(3, "test", kind as u64)).unwrap();
        let slide = quantile(&slides(&skeleton, &made), 0.9);
        assert!(slide < 5e-3, "{kind:?}: {slide}");
    }
}

#[test]
fn bent_path_by_hand() {
    // Steps of 1/40 m towards -y, turned by 90 degrees to +x from the start: after 40 frames the root is 1 m along +x.
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    let n = clip.len();
    let path = bent_path(&clip, &vec![std::f32::consts::FRAC_PI_2; n], &vec![0.5 * Vec2::X; n]);
    let out = replant(&skeleton, &clip, &path, &vec![0.0; n]);
    assert!((out.poses[40].root.truncate() - Vec2::new(0.5, 0.0)).length() < 1e-4, "{}", out.poses[40].root);
    assert!(out.poses[0].rots[0].angle_between(Quat::from_rotation_z(std::f32::consts::FRAC_PI_2) * clip.poses[0].rots[0]) < 1e-3);
}

#[test]
fn a_stop_holds_and_resumes_by_hand() {
    // Stop at frame 40, easing 0.5 s (20 frames, 10 of the clip) either side of a hold of 1 s: 20 + 40 frames more in all.
    let times = stop_times(81, 40.0, 0.5, 1.0);
    assert_eq!(times.len(), 81 + 20 + 40);
    assert!((times[30] - 30.0).abs() < 1e-4 && (times[50] - 40.0).abs() < 1e-4 && (times[90] - 40.0).abs() < 1e-4);
    assert!((times[110] - 50.0).abs() < 1e-4);
    assert!(times.windows(2).all(|w| (0.0..1.01).contains(&(w[1] - w[0] + 1e-5))));
}

#[test]
fn side_steps_by_hand() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    let n = clip.len();
    // A metre ahead becomes 0.4 m to the left: with -y ahead, x is left.
    let stride = vec![Vec2::new(0.0, 0.4); n];
    let path = bent_path(&clip, &vec![0.0; n], &stride);
    let spread = sideways_spread(&clip, &stride);
    // A cycle of 44 frames at 1 m/s is 1.1 m long, 0.44 m sideways, a quarter of it either way.
    assert!(spread.iter().all(|s| (s - 0.11).abs() < 1e-3), "{spread:?}");
    let out = replant(&skeleton, &clip, &path, &spread);
    let (a, b) = (out.poses[0].root, out.poses[n - 1].root);
    assert!((b.x - a.x - 0.4 * 159.0 / 40.0).abs() < 1e-3 && (b.y - a.y).abs() < 1e-3);
    assert!(quantile(&slides(&skeleton, &out), 1.0) < 0.002);
    for t in 0..n {
        let [l, r] = [0, 1].map(|side| skeleton.foot(&out.poses[t], side).ankle);
        assert!(l.x - r.x > 0.15, "the feet cross at {t}: {}", l.x - r.x);
    }
}

#[test]
fn a_stander_lends_the_upper_body() {
    let skeleton = skeleton();
    let clip = walker(&skeleton, 0.0);
    let mut idle = clip.clone();
    // Somebody who faces x with straight legs, bent at the waist and swaying to the right.
    let turned = flat(std::f32::consts::FRAC_PI_2);
    for pose in &mut idle.poses {
        *pose = Pose { root: Vec3::new(0.0, -0.03, 0.9), rots: [turned; BODY_JOINTS] };
        pose.rots[9] = turned * Quat::from_rotation_x(0.3);
    }
    let out = stand_idly(&skeleton, &clip, &idle, 0, &vec![1.0; clip.len()]);
    let none = stand_idly(&skeleton, &clip, &idle, 0, &vec![0.0; clip.len()]);
    assert!(worst(&skeleton, &none, &clip) < 1e-4);
    for (p, old) in out.poses.iter().zip(&clip.poses) {
        let bend = p.rots[6].inverse() * p.rots[9];
        assert!(bend.angle_between(Quat::from_rotation_x(0.3)) < 1e-3);
        for side in 0..SIDES {
            assert!((skeleton.foot(p, side).ankle - skeleton.foot(old, side).ankle).length() < 0.01);
        }
    }
}
