//! Feet and floor. Markers are T x 201 floats with z measured from the floor, in any frame turned about z only.

use crate::body::{FOOT_MARKERS, MARKER_DIM};
use crate::motion::FPS;
use glam::Vec3;

/// Height under which the lower foot counts as standing, metres: eq. 12's tolerance.
const STANCE_HEIGHT: f32 = 0.05;
/// Markers of one foot in [`FOOT_MARKERS`]: the right foot's come first.
const PER_FOOT: usize = FOOT_MARKERS.len() / 2;

/// Lowest foot marker of each frame, metres (T values).
pub fn foot_heights(markers: &[f32]) -> impl ExactSizeIterator<Item = f32> + '_ {
    frames(markers).map(|m| FOOT_MARKERS.iter().fold(f32::INFINITY, |low, &i| low.min(marker(m, i).z)))
}

/// Speed of the slowest foot marker in each of the frames 1 to T-2, m/s, by central differences (T - 2 values, none if T < 3).
pub fn foot_speeds(markers: &[f32]) -> impl ExactSizeIterator<Item = f32> + '_ {
    let next = markers.get(2 * MARKER_DIM..).unwrap_or(&[]);
    frames(markers).zip(frames(next)).map(|(before, after)| {
        let slowest = FOOT_MARKERS.iter().map(|&i| (marker(after, i) - marker(before, i)).length());
        slowest.fold(f32::INFINITY, f32::min) * (0.5 * FPS)
    })
}

/// Foot contact of eq. 12 in [0, 1]: mean over the frames 1 to T-2 of exp(-(|min z| - 0.05)+) exp(-(min speed - 0.075)+).
/// NaN if T < 3.
pub fn contact_score(markers: &[f32]) -> f32 {
    let each = foot_heights(markers).skip(1).zip(foot_speeds(markers));
    mean(each.map(|(z, v)| (-(z.abs() - 0.05).max(0.0) - (v - 0.075).max(0.0)).exp()))
}

/// Horizontal travel of the standing foot from each frame to the next, metres (T - 1 values); none where no foot stands or the
/// standing foot changes.
///
/// The standing foot of a frame is the one with the lowest marker, if that is below 5 cm; what travels is this marker.
pub fn stance_moves(markers: &[f32]) -> impl ExactSizeIterator<Item = Option<f32>> + '_ {
    let next = markers.get(MARKER_DIM..).unwrap_or(&[]);
    frames(markers).zip(frames(next)).map(|(now, after)| {
        let k = standing_marker(now)?;
        let foot = |k: usize| k / PER_FOOT;
        let i = FOOT_MARKERS[k];
        (standing_marker(after).map(foot) == Some(foot(k))).then(|| (marker(after, i) - marker(now, i)).truncate().length())
    })
}

/// How far the standing foot slides in each stance, metres: the sum of [`stance_moves`] over a run of frames on the same foot.
pub fn stance_slides(markers: &[f32]) -> Vec<f32> {
    let mut slides: Vec<f32> = Vec::new();
    let mut standing = false;
    for travel in stance_moves(markers) {
        match (travel, slides.last_mut()) {
            (Some(d), Some(slide)) if standing => *slide += d,
            (Some(d), _) => slides.push(d),
            (None, _) => {}
        }
        standing = travel.is_some();
    }
    slides
}

/// Mean of [`stance_slides`], metres per stance; 0 where there is no stance.
pub fn stance_slide(markers: &[f32]) -> f32 {
    let slides = stance_slides(markers);
    if slides.is_empty() { 0.0 } else { mean(slides.into_iter()) }
}

/// Mean over the frames of how deep the lowest of all markers stands under the floor, metres. NaN without frames.
pub fn floor_penetration(markers: &[f32]) -> f32 {
    mean(frames(markers).map(|m| m.iter().skip(2).step_by(3).fold(0.0f32, |deep, &z| deep.max(-z))))
}

/// Position in [`FOOT_MARKERS`] of the marker the body stands on.
fn standing_marker(m: &[f32]) -> Option<usize> {
    let height = |k: usize| marker(m, FOOT_MARKERS[k]).z;
    let lowest = (1..FOOT_MARKERS.len()).fold(0, |low, k| if height(k) < height(low) { k } else { low });
    (height(lowest) < STANCE_HEIGHT).then_some(lowest)
}

fn frames(markers: &[f32]) -> impl ExactSizeIterator<Item = &[f32]> + '_ {
    markers.chunks_exact(MARKER_DIM)
}

fn marker(frame: &[f32], i: usize) -> Vec3 {
    Vec3::from_slice(&frame[3 * i..])
}

fn mean(values: impl Iterator<Item = f32>) -> f32 {
    let (sum, n) = values.fold((0.0, 0), |(s, n), v| (s + v, n + 1));
    sum / n as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// T frames of markers 1 m up, except foot markers (index in FOOT_MARKERS) placed by `at(frame, foot marker)`.
    fn film(frames: usize, at: impl Fn(usize, usize) -> [f32; 3]) -> Vec<f32> {
        let mut out = [0.0, 0.0, 1.0].repeat(frames * MARKER_DIM / 3);
        for t in 0..frames {
            for (k, &i) in FOOT_MARKERS.iter().enumerate() {
                out[t * MARKER_DIM + 3 * i..][..3].copy_from_slice(&at(t, k));
            }
        }
        out
    }

    fn near(a: f32, b: f32) -> bool {
        (a - b).abs() < 1e-5
    }

    #[test]
    fn heights_and_speeds_by_hand() {
        // Marker k stands k cm up and moves 1 + k cm per frame along x, 40 fps: the slowest at 0.4 m/s.
        let m = film(4, |t, k| [0.01 * (1 + k) as f32 * t as f32, 0.0, 0.02 + 0.01 * k as f32]);
        assert!(foot_heights(&m).all(|z| near(z, 0.02)) && foot_heights(&m).len() == 4);
        assert!(foot_speeds(&m).all(|v| near(v, 0.4)) && foot_speeds(&m).len() == 2);
        assert_eq!(foot_speeds(&m[..MARKER_DIM]).len(), 0);
        // Height within tolerance: exp(-(0.4 - 0.075)).
        assert!(near(contact_score(&m), (-0.325f32).exp()));
    }

    #[test]
    fn contact_counts_height_both_ways() {
        let score = |z: f32| contact_score(&film(5, |_, _| [0.0, 0.0, z]));
        assert_eq!(score(0.05), 1.0);
        assert!(near(score(0.15), (-0.1f32).exp()));
        assert!(near(score(-0.15), (-0.1f32).exp()));
    }

    #[test]
    fn slide_of_two_stances() {
        // Right foot stands in frames 0-3 sliding 1 cm per frame, left in 4-7 sliding 2 cm per frame; the other foot is up.
        let m = film(8, |t, k| {
            let (foot, standing) = (k / 3, t / 4);
            [0.01 * (1 + foot) as f32 * t as f32, 0.0, if foot == standing { 0.0 } else { 0.2 }]
        });
        assert!(near(stance_slide(&m), (3.0 * 0.01 + 3.0 * 0.02) / 2.0));
        let moves: Vec<_> = stance_moves(&m).collect();
        assert!(moves.len() == 7 && moves[3].is_none() && near(moves[2].unwrap(), 0.01) && near(moves[4].unwrap(), 0.02));
        assert_eq!(stance_slide(&film(8, |t, _| [t as f32, 0.0, 0.1])), 0.0);
    }

    #[test]
    fn penetration_is_the_deepest_marker() {
        let m = film(4, |t, k| [0.0, 0.0, if t == 1 && k == 2 { -0.04 } else { 0.01 }]);
        assert!(near(floor_penetration(&m), 0.01));
    }
}
