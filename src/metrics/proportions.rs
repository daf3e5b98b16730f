//! Whether joints or markers keep the proportions of the body they claim to be.

use crate::body::{BODY_JOINTS, JOINTS, MARKER_DIM, MARKERS, PARENTS, ShapedBody};
use glam::Vec3;

/// Share of its weight that ties a marker to one bone from which on it counts as rigid there.
const RIGID: f32 = 0.9;

/// Mean absolute error of the 21 bone lengths over T frames of joints (T x 24 x 3), metres; `body` gives the true lengths.
pub fn bone_length_error(joints: &[f32], body: &ShapedBody) -> f32 {
    let rest = body.joints();
    let frames = joints.chunks_exact(3 * JOINTS);
    let count = frames.len() * (BODY_JOINTS - 1);
    let error = |j: &[f32], k: usize| (distance(j, k, PARENTS[k]) - (rest[k] - rest[PARENTS[k]]).length()).abs();
    let sum: f32 = frames.map(|j| (1..BODY_JOINTS).map(|k| error(j, k)).sum::<f32>()).sum();
    sum / count as f32
}

/// Mean absolute error, over T frames of markers (T x 201), of the distances between markers that ride on the same bone,
/// metres: 0 for a rigid body of the right shape in any pose.
pub fn rigid_marker_error(markers: &[f32], body: &ShapedBody) -> f32 {
    let pairs = rigid_pairs(body);
    let rest = body.rest_markers();
    let frames = markers.chunks_exact(MARKER_DIM);
    let count = frames.len() * pairs.len();
    let error = |m: &[f32], &(i, j): &(usize, usize)| (distance(m, i, j) - (rest[i] - rest[j]).length()).abs();
    let sum: f32 = frames.map(|m| pairs.iter().map(|p| error(m, p)).sum::<f32>()).sum();
    sum / count as f32
}

fn rigid_pairs(body: &ShapedBody) -> Vec<(usize, usize)> {
    let bones: Vec<_> = body.marker_bones().collect();
    let together = |i: usize, j: usize| bones[i].0 == bones[j].0 && bones[i].1.min(bones[j].1) >= RIGID;
    let all = (0..MARKERS).flat_map(|i| (i + 1..MARKERS).map(move |j| (i, j)));
    all.filter(|&(i, j)| together(i, j)).collect()
}

fn distance(points: &[f32], i: usize, j: usize) -> f32 {
    (Vec3::from_slice(&points[3 * i..]) - Vec3::from_slice(&points[3 * j..])).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::tests::{random_params, toy};

    #[test]
    fn the_body_itself_is_exact_and_growth_is_seen() {
        let body = toy().shape(&[0.5; 10]);
        let posed = body.pose(&random_params(1));
        let (mut joints, mut markers) = (vec![0.0; 2 * 3 * JOINTS], vec![0.0; 2 * MARKER_DIM]);
        for t in 0..2 {
            posed.write_joints(&mut joints[t * 3 * JOINTS..]);
            body.markers(&posed, &mut markers[t * MARKER_DIM..]);
        }
        assert!(bone_length_error(&joints, &body) < 1e-6 && rigid_marker_error(&markers, &body) < 1e-6);

        // All lengths of the second of two frames a tenth longer: the mean error is a twentieth of the mean length.
        joints[3 * JOINTS..].iter_mut().for_each(|x| *x *= 1.1);
        let rest = body.joints();
        let mean = (1..22).map(|k| (rest[k] - rest[PARENTS[k]]).length()).sum::<f32>() / 21.0;
        assert!((bone_length_error(&joints, &body) - 0.05 * mean).abs() < 1e-5);

        markers[MARKER_DIM..].iter_mut().for_each(|x| *x *= 1.1);
        let pairs = rigid_pairs(&body);
        assert!(pairs.len() > 20);
        let rest = body.rest_markers();
        let mean = pairs.iter().map(|&(i, j)| (rest[i] - rest[j]).length()).sum::<f32>() / pairs.len() as f32;
        assert!((rigid_marker_error(&markers, &body) - 0.05 * mean).abs() < 1e-5);
    }
}
