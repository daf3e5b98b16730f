//! What is measured of every motion, recorded or made, by the same functions.

use crate::evaluate::{Estimate, ratio};
use egogen::body::{MARKER_DIM, PARAMS, ShapedBody};
use egogen::metrics::{accelerations, contact_score, jerks, stance_moves, stance_slide, stance_slides};
use egogen::motion::clip::{Clip, Pose, SIDES, Skeleton};
use egogen::motion::footlock::{detect_contact, slides};
use egogen::motion::primitive::{ClipMarkers, JOINT_DIM};
use egogen::motion::{FPS, FRAMES, FUTURE, MotionSet, PosePrior, SEED};
use glam::Quat;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// A figure: how it is called in files and tables, and what it means.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Figure {
    pub key: &'static str,
    pub label: &'static str,
    pub unit: &'static str,
    #[serde(skip)]
    pub digits: usize,
    pub meaning: &'static str,
}

const fn figure(key: &'static str, label: &'static str, unit: &'static str, digits: usize, meaning: &'static str) -> Figure {
    Figure { key, label, unit, digits, meaning }
}

/// All figures in the order of the tables.
pub const FIGURES: [Figure; 16] = [
    figure("contact", "foot contact", "", 3, "eq. 12 of each primitive's 20 frames, mean"),
    figure(
        "slide",
        "slide of the stance foot",
        "cm",
        2,
        "greatest distance of a standing heel or ball from its median place in the stance",
    ),
    figure(
        "travel",
        "way per stance",
        "cm",
        2,
        "way of the lowest foot marker over a stance, rolling and changes between markers included",
    ),
    figure("travel_primitive", "way per stance in a primitive", "cm", 2, "the same, each primitive by itself: stances end where it ends"),
    figure("travel_speed", "speed of the standing marker", "cm/s", 2, "that way by time, frames within a primitive"),
    figure(
        "travel_speed_seam",
        "speed of the standing marker at seams",
        "cm/s",
        2,
        "the same from a seed's last frame to the first predicted one",
    ),
    figure("sole", "lowest sole point", "cm", 2, "height of the lowest of heel, ball and tip of both soles"),
    figure("sole_near", "soles within 2 cm of the floor", "% of frames", 1, "the lowest sole point within 2 cm above or below"),
    figure("penetration", "floor penetration", "cm", 2, "depth of the lowest sole point under the floor, 0 above it"),
    figure("acceleration", "acceleration", "m/s^2", 2, "mean over the joints, within a primitive"),
    figure("acceleration_seam", "acceleration at seams", "m/s^2", 2, "the same over three frames across a seam"),
    figure("jerk", "jerk", "m/s^3", 0, "mean length of the joints' third difference, within a primitive"),
    figure("jerk_seam", "jerk at seams", "m/s^3", 0, "the same over four frames across a seam"),
    figure("pose_norm", "||VP||", "", 2, "norm of the pose's embedding by the pose prior (eq. 9)"),
    figure("pose_odd", "poses beyond eq. 9's threshold", "% of frames", 1, "||VP|| above the prior's threshold"),
    figure("speed", "speed", "m/s", 2, "way of the pelvis in the plane over a primitive, by its duration"),
];

/// A sole point counts as near the floor within this, metres.
const NEAR: f32 = 0.02;
/// The pose prior looks at one frame of so many.
const POSE_STRIDE: usize = 6;

/// Of one motion: for each figure by key the sum of its values and how many there are.
pub type Sums = BTreeMap<&'static str, [f64; 2]>;

/// Many motions of one kind, measured.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    pub name: String,
    /// Motions.
    pub clips: usize,
    /// Groups that intervals are drawn over: people, or recordings with all that was made of them.
    pub groups: usize,
    pub seconds: f32,
    /// By key; mean over all values with a 95 % bootstrap interval over the groups, null where there is nothing to measure.
    pub figures: BTreeMap<&'static str, Option<Estimate>>,
}

/// What measuring needs.
pub struct Ruler<'a> {
    pub skeleton: Skeleton,
    pub body: &'a ShapedBody,
    pub prior: &'a PosePrior,
}

impl Ruler<'_> {
    /// Measures clip `i` of `set`. `seams`: it is made of primitives, each joined to its two seed frames, the first of them frames 0 and 1.
    pub fn measure(&self, set: &MotionSet, i: usize, seams: bool) -> Sums {
        let clip = &set.clips[i];
        let seam = |t: usize| seams && t % FUTURE == SEED - 1;
        // A difference of `order` from frame k on is at a seam if one lies between two of its frames.
        let across = |k: usize, order: usize| (k..k + order).any(seam);
        let moves: Vec<(usize, f32)> = stance_moves(&clip.markers).enumerate().filter_map(|(t, d)| Some((t, 100.0 * FPS * d?))).collect();
        let speed = |at: bool| total(moves.iter().filter(|(t, _)| seam(*t) == at).map(|m| m.1));
        let smooth = |values: &[f32], order: usize, at: bool| {
            total(values.iter().enumerate().filter(|(k, _)| across(*k, order) == at).map(|(_, v)| *v))
        };
        let (a, j) = (accelerations(&clip.joints, JOINT_DIM), jerks(&clip.joints, JOINT_DIM));
        let mut posed = self.posed(clip);
        detect_contact(&self.skeleton, &mut posed);
        let soles: Vec<f32> = posed.poses.iter().map(|p| self.skeleton.lowest(p)).collect();
        let norms = self.prior.norms(&thinned(&clip.params));
        let primitives = || (0..(clip.len() + 1).saturating_sub(FRAMES)).step_by(FUTURE);
        let markers = |t: usize| &clip.markers[t * MARKER_DIM..(t + FRAMES) * MARKER_DIM];
        let way = |t: usize| (set.frame(i, t + FUTURE).transl - set.frame(i, t).transl).truncate().length();
        BTreeMap::from([
            ("contact", total(primitives().map(|t| contact_score(markers(t))))),
            ("slide", total(slides(&self.skeleton, &posed).into_iter().map(|d| 100.0 * d))),
            ("travel", total(stance_slides(&clip.markers).into_iter().map(|d| 100.0 * d))),
            ("travel_primitive", total(primitives().map(|t| 100.0 * stance_slide(markers(t))))),
            ("travel_speed", speed(false)),
            ("travel_speed_seam", speed(true)),
            ("sole", total(soles.iter().map(|z| 100.0 * z))),
            ("sole_near", share(soles.iter().map(|z| z.abs() <= NEAR))),
            ("penetration", total(soles.iter().map(|z| 100.0 * (-z).max(0.0)))),
            ("acceleration", smooth(&a, 2, false)),
            ("acceleration_seam", smooth(&a, 2, true)),
            ("jerk", smooth(&j, 3, false)),
            ("jerk_seam", smooth(&j, 3, true)),
            ("pose_odd", share(norms.iter().map(|n| *n > self.prior.threshold()))),
            ("pose_norm", total(norms.into_iter())),
            ("speed", total(primitives().map(|t| way(t) * FPS / FUTURE as f32))),
        ])
    }

    /// The clip's poses, nothing known of contacts.
    fn posed(&self, clip: &ClipMarkers) -> Clip {
        let pose = |p: &[f32]| {
            let posed = self.body.pose(p);
            Pose { root: posed.pos[0], rots: std::array::from_fn(|j| Quat::from_mat3(&posed.rot[j])) }
        };
        let poses: Vec<Pose> = clip.params.chunks_exact(PARAMS).map(pose).collect();
        Clip { name: clip.name.clone(), contact: vec![[false; SIDES]; poses.len()], poses }
    }

    /// Measures all clips of recorded motion; variations of one recording (`recording~variation`) make one group.
    pub fn recorded(&self, name: &str, set: &MotionSet) -> Measured {
        let sums: Vec<Sums> = (0..set.clips.len()).into_par_iter().map(|i| self.measure(set, i, false)).collect();
        let mut groups: BTreeMap<&str, Sums> = BTreeMap::new();
        for (clip, sums) in set.clips.iter().zip(sums) {
            let group = groups.entry(family(&clip.name)).or_default();
            for (key, [sum, count]) in sums {
                let to = group.entry(key).or_default();
                *to = [to[0] + sum, to[1] + count];
            }
        }
        let groups: Vec<Sums> = groups.into_values().collect();
        Measured::new(name, set.clips.len(), set.frames() as f32 / FPS, &groups)
    }
}

impl Measured {
    /// The figures of `groups`.
    pub fn new(name: &str, clips: usize, seconds: f32, groups: &[Sums]) -> Self {
        let estimate = |f: &Figure| {
            let pairs: Vec<[f64; 2]> = groups.iter().filter_map(|g| g.get(f.key).copied()).collect();
            (f.key, ratio(&pairs))
        };
        Self { name: name.into(), clips, groups: groups.len(), seconds, figures: FIGURES.par_iter().map(estimate).collect() }
    }

    /// The value of a figure.
    pub fn value(&self, key: &str) -> Option<f64> {
        self.figures.get(key).copied().flatten().map(|e| e.value)
    }
}

/// The recording that a clip was made from.
pub fn family(name: &str) -> &str {
    name.split('~').next().unwrap_or(name)
}

fn thinned(params: &[f32]) -> Vec<f32> {
    params.chunks_exact(PARAMS).step_by(POSE_STRIDE).flatten().copied().collect()
}

fn total(values: impl Iterator<Item = f32>) -> [f64; 2] {
    values.fold([0.0, 0.0], |[sum, count], v| [sum + f64::from(v), count + 1.0])
}

/// A share in per cent.
fn share(hits: impl Iterator<Item = bool>) -> [f64; 2] {
    total(hits.map(|h| if h { 100.0 } else { 0.0 }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::body::{BETAS, BODY_JOINTS, BodyModel};
    use glam::Vec3;

    /// `frames` frames of the rest pose turned upright, moved by `way` and standing on the floor.
    fn stiff(frames: usize, way: impl Fn(usize) -> Vec3) -> MotionSet {
        let (model, mut params) = (BodyModel::embedded(), Vec::new());
        let body = model.shape(&[0.0; BETAS]);
        let upright = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
        let skeleton = Skeleton::new(&model);
        let low = skeleton.lowest(&Pose { root: Vec3::ZERO, rots: [upright; BODY_JOINTS] });
        for t in 0..frames {
            let mut p = [0.0; PARAMS];
            p[..3].copy_from_slice(&(way(t) - Vec3::Z * low - body.joints()[0]).to_array());
            p[3..6].copy_from_slice(&upright.to_scaled_axis().to_array());
            params.extend(p);
        }
        MotionSet { clips: vec![ClipMarkers::from_params("walk~bent0".into(), &body, params)] }
    }

    fn measured(set: &MotionSet, seams: bool) -> Sums {
        let model = BodyModel::embedded();
        let (body, prior) = (model.shape(&[0.0; BETAS]), PosePrior::embedded().unwrap());
        Ruler { skeleton: Skeleton::new(&model), body: &body, prior: &prior }.measure(set, 0, seams)
    }

    fn value(sums: &Sums, key: &str) -> f64 {
        sums[key][0] / sums[key][1]
    }

    #[test]
    fn a_gliding_body_by_hand() {
        // 38 frames, two primitives, at 1 cm a frame, 1 cm under the floor; the move into frame 20, a seam, is 3 cm.
        let glide = stiff(38, |t| Vec3::new(0.01 * t as f32 + if t >= 20 { 0.02 } else { 0.0 }, 0.0, -0.01));
        let sums = measured(&glide, true);
        assert_eq!(sums.len(), FIGURES.len());
        assert!(FIGURES.iter().all(|f| sums.contains_key(f.key)));
        let near = |key: &str, want: f64, within: f64| assert!((value(&sums, key) - want).abs() < within, "{key}: {}", value(&sums, key));
        // Each foot stands once; its median place is that of frame 19, the last one's 20 cm further.
        near("slide", 20.0, 0.01);
        assert_eq!(sums["slide"][1], 2.0);
        // One stance of 37 moves.
        near("travel", 39.0, 0.01);
        assert_eq!(sums["travel"][1], 1.0);
        // Frames 0 to 19 and 18 to 37: 19 and 19 + 2 cm.
        near("travel_primitive", 20.0, 0.01);
        // Seams lie before frames 2 and 20: 1 and 3 cm a frame.
        near("travel_speed", 40.0, 0.1);
        near("travel_speed_seam", 80.0, 0.1);
        near("sole", -1.0, 0.01);
        near("penetration", 1.0, 0.01);
        near("sole_near", 100.0, 1e-9);
        // Two of the four triples across a seam hold the jump: 0.02 m x 1600 / s^2 half of the time.
        near("acceleration", 0.0, 0.01);
        near("acceleration_seam", 16.0, 0.05);
        near("jerk", 0.0, 0.5);
        // Ways of 18 and 20 cm in 0.45 s.
        near("speed", 0.19 / 0.45, 1e-3);
        let whole = measured(&glide, false);
        assert_eq!((whole["travel_speed_seam"][1], whole["jerk_seam"][1]), (0.0, 0.0));
        assert!((value(&whole, "travel_speed") - 100.0 * 40.0 * 0.39 / 37.0).abs() < 0.1);
    }

    #[test]
    fn variations_count_with_their_recording() {
        assert_eq!((family("train/walking/walking_1~bent0~mirror"), family("16_11")), ("train/walking/walking_1", "16_11"));
        let sums = |v: f64, n: f64| Sums::from([("slide", [v, n])]);
        let m = Measured::new("x", 2, 1.0, &[sums(4.0, 2.0), sums(2.0, 1.0)]);
        assert_eq!((m.value("slide"), m.value("contact"), m.groups), (Some(2.0), None, 2));
    }
}
