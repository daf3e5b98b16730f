//! Rotations: axis-angle and the continuous 6-D form.

use glam::{Mat3, Quat, Vec3};

/// Rotation matrix of the axis-angle vector `v` (direction = axis, length = angle in radians), by Rodrigues' formula.
pub fn from_axis_angle(v: Vec3) -> Mat3 {
    let t2 = v.length_squared();
    // Below this the two series' next terms are less than f32's rounding.
    let (a, b) = if t2 < 1e-6 {
        (1.0 - t2 / 6.0, 0.5 - t2 / 24.0)
    } else {
        let t = t2.sqrt();
        let half = (0.5 * t).sin();
        (t.sin() / t, 2.0 * half * half / t2)
    };
    let (x, y, z) = (v.x, v.y, v.z);
    let c = 1.0 - b * t2;
    Mat3::from_cols(
        Vec3::new(c + b * x * x, b * x * y + a * z, b * x * z - a * y),
        Vec3::new(b * x * y - a * z, c + b * y * y, b * y * z + a * x),
        Vec3::new(b * x * z + a * y, b * y * z - a * x, c + b * z * z),
    )
}

/// Axis-angle vector of the rotation matrix `m`, angle in [0, pi].
///
/// Goes through the quaternion, whose largest component is found first, so it is accurate at 0 and at pi too.
pub fn to_axis_angle(m: &Mat3) -> Vec3 {
    let q = Quat::from_mat3(m);
    let q = if q.w < 0.0 { -q } else { q };
    let v = Vec3::new(q.x, q.y, q.z);
    let s = v.length();
    if s < 1e-6 { 2.0 * v } else { v * (2.0 * s.atan2(q.w) / s) }
}

/// Rotation matrix of the continuous 6-D form: `d` holds the rows of a (3, 2) matrix whose two columns are orthonormalised
/// by Gram-Schmidt; the third column is their cross product. Parallel or zero columns fall back to some rotation.
pub fn from_6d(d: &[f32; 6]) -> Mat3 {
    let x = Vec3::new(d[0], d[2], d[4]).try_normalize().unwrap_or(Vec3::X);
    let a = Vec3::new(d[1], d[3], d[5]);
    let y = (a - x * x.dot(a)).try_normalize().unwrap_or_else(|| x.any_orthonormal_vector());
    Mat3::from_cols(x, y, x.cross(y))
}

/// The 6-D form of a rotation matrix: its first two columns as the rows of a (3, 2) matrix.
pub fn to_6d(m: &Mat3) -> [f32; 6] {
    let (x, y) = (m.x_axis, m.y_axis);
    [x.x, y.x, x.y, y.y, x.z, y.z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Tensors;
    use proptest::prelude::*;
    use std::f32::consts::PI;

    fn axis() -> impl Strategy<Value = Vec3> {
        [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0]
            .prop_map(Vec3::from)
            .prop_filter("direction", |v| v.length() > 0.1)
            .prop_map(|v| v.normalize())
    }

    proptest! {
        #[test]
        fn axis_angle_round_trip(a in axis(), t in 0.0f32..(PI - 1e-3)) {
            let m = from_axis_angle(a * t);
            prop_assert!((to_axis_angle(&m) - a * t).length() < 3e-6);
        }

        #[test]
        fn rotations_are_orthonormal(a in axis(), t in 0.0f32..20.0) {
            let m = from_axis_angle(a * t);
            prop_assert!((m * m.transpose()).abs_diff_eq(Mat3::IDENTITY, 2e-6));
            prop_assert!((m.determinant() - 1.0).abs() < 2e-6);
        }

        #[test]
        fn stable_near_zero_and_pi(a in axis(), e in -1e-3f32..1e-3) {
            prop_assert!((to_axis_angle(&from_axis_angle(a * e)) - a * e).length() < 2e-7);
            let m = from_axis_angle(a * (PI + e));
            prop_assert!(from_axis_angle(to_axis_angle(&m)).abs_diff_eq(m, 2e-6));
        }

        #[test]
        fn six_d_round_trip_and_scale(a in axis(), t in 0.0f32..PI, s in 0.1f32..10.0, k in -2.0f32..2.0) {
            let m = from_axis_angle(a * t);
            let mut d = to_6d(&m);
            prop_assert!(from_6d(&d).abs_diff_eq(m, 1e-6));
            // Scaling the first column and shearing the second towards it changes nothing.
            for r in 0..3 {
                d[2 * r + 1] += k * d[2 * r];
                d[2 * r] *= s;
            }
            prop_assert!(from_6d(&d).abs_diff_eq(m, 3e-6));
        }
    }

    #[test]
    fn matches_scipy() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/rotations.safetensors");
        let t = Tensors::read(file).unwrap();
        let n = t.shape("rotvec").unwrap()[0];
        let (v, m, d, md) = (
            t.f32s("rotvec", &[n, 3]).unwrap(),
            t.f32s("matrix", &[n, 3, 3]).unwrap(),
            t.f32s("six", &[n, 6]).unwrap(),
            t.f32s("six_matrix", &[n, 3, 3]).unwrap(),
        );
        assert!(n >= 50);
        for i in 0..n {
            let (v, m) = (Vec3::from_slice(&v[3 * i..]), Mat3::from_cols_slice(&m[9 * i..9 * i + 9]).transpose());
            assert!(from_axis_angle(v).abs_diff_eq(m, 1e-6), "matrix {i}");
            let back = to_axis_angle(&m);
            // At pi both signs stand for the same rotation.
            let error = if v.length() > PI - 1e-5 { (back - v).length().min((back + v).length()) } else { (back - v).length() };
            assert!(error < 3e-6, "vector {i}: {back} {v}");
            let six: [f32; 6] = d[6 * i..6 * i + 6].try_into().unwrap();
            let want = Mat3::from_cols_slice(&md[9 * i..9 * i + 9]).transpose();
            assert!(from_6d(&six).abs_diff_eq(want, 2e-6), "6-D {i}");
        }
    }
}
