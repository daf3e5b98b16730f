//! Whether a simulated person is still a person on its feet.

use super::{foot_heights, rigid_marker_error};
use crate::body::{JOINTS, MARKER_DIM, ShapedBody, joint};
use std::ops::Range;

/// Heights of the pelvis at which nobody has fallen or taken off, metres.
const PELVIS: Range<f32> = 0.5..1.5;
/// Heights of the lowest foot marker that count as near the floor, metres.
const FEET: Range<f32> = -0.2..0.25;
/// Height of the head above the pelvis under which somebody lies or hangs, metres.
const UPRIGHT: f32 = 0.25;
/// Mean error of the distances between markers of one bone from which on they belong to no body, metres.
const BONES: f32 = 0.05;

/// Why a person counts as collapsed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Collapse {
    /// A number that is not finite.
    NotFinite,
    /// The pelvis below 0.5 m or above 1.5 m.
    Pelvis,
    /// The lowest foot marker more than 0.2 m under or 0.25 m above the floor.
    Feet,
    /// The head less than 0.25 m above the pelvis.
    Fallen,
    /// Distances between markers of one bone wrong by more than 5 cm on average.
    Bones,
}

/// The first reason, in the order of [`Collapse`], for which one frame shows a collapsed person; none if it stands or walks.
///
/// `markers`: 201 floats, `joints`: 24 x 3 floats, metres, z measured from the floor.
pub fn collapse(markers: &[f32], joints: &[f32], body: &ShapedBody) -> Option<Collapse> {
    let markers = &markers[..MARKER_DIM];
    let height = |j: usize| joints[3 * j + 2];
    let feet = foot_heights(markers).fold(f32::INFINITY, f32::min);
    if !markers.iter().chain(&joints[..3 * JOINTS]).all(|v| v.is_finite()) {
        Some(Collapse::NotFinite)
    } else if !PELVIS.contains(&height(joint::PELVIS)) {
        Some(Collapse::Pelvis)
    } else if !FEET.contains(&feet) {
        Some(Collapse::Feet)
    } else if height(joint::HEAD) - height(joint::PELVIS) < UPRIGHT {
        Some(Collapse::Fallen)
    } else {
        (rigid_marker_error(markers, body) > BONES).then_some(Collapse::Bones)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BETAS, BodyModel, PARAMS};
    use glam::{Quat, Vec3};
    use std::f32::consts::FRAC_PI_2;

    #[test]
    fn each_reason_by_hand() {
        let body = BodyModel::embedded().shape(&[0.0; BETAS]);
        // Upright (a quarter turn about x from the rest frame) with the pelvis at `height`, leaning by `lean` radians.
        let stand = |height: f32, lean: f32| {
            let turn = Quat::from_rotation_x(FRAC_PI_2 + lean);
            let mut params = [0.0; PARAMS];
            params[..3].copy_from_slice(&(Vec3::Z * height - body.joints()[joint::PELVIS]).to_array());
            params[3..6].copy_from_slice(&turn.to_scaled_axis().to_array());
            let posed = body.pose(&params);
            let (mut markers, mut joints) = (vec![0.0; MARKER_DIM], vec![0.0; 3 * JOINTS]);
            body.markers(&posed, &mut markers);
            posed.write_joints(&mut joints);
            (markers, joints)
        };
        let judge = |(markers, joints): &(Vec<f32>, Vec<f32>)| collapse(markers, joints, &body);
        let (markers, _) = stand(1.0, 0.0);
        let standing = 1.0 - foot_heights(&markers).fold(f32::INFINITY, f32::min);
        assert!((0.8..1.1).contains(&standing), "{standing}");
        assert_eq!(judge(&stand(standing, 0.0)), None);
        assert_eq!(judge(&stand(0.49, 0.0)), Some(Collapse::Pelvis));
        assert_eq!(judge(&stand(1.51, 0.0)), Some(Collapse::Pelvis));
        assert_eq!(judge(&stand(standing + 0.26, 0.0)), Some(Collapse::Feet));
        assert_eq!(judge(&stand(standing - 0.21, 0.0)), Some(Collapse::Feet));
        // Lying at the height at which the feet would be near the floor is told from standing by the head.
        let (markers, joints) = stand(0.6, FRAC_PI_2);
        let drop = foot_heights(&markers).fold(f32::INFINITY, f32::min);
        let lower = |v: &[f32]| v.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2] - drop + 0.1]).collect::<Vec<_>>();
        let (markers, mut joints) = (lower(&markers), lower(&joints));
        joints[3 * joint::PELVIS + 2] = 0.6;
        joints[3 * joint::HEAD + 2] = 0.7;
        assert_eq!(judge(&(markers, joints)), Some(Collapse::Fallen));
        // Markers a tenth too wide apart in the plane.
        let (markers, joints) = stand(standing, 0.0);
        let wide = |by: f32| markers.chunks_exact(3).flat_map(|p| [p[0] * by, p[1] * by, p[2]]).collect::<Vec<_>>();
        assert_eq!(judge(&(wide(2.5), joints.clone())), Some(Collapse::Bones));
        assert_eq!(judge(&(wide(f32::NAN), joints)), Some(Collapse::NotFinite));
    }
}
