//! How smoothly points move. Points are T x `dim` floats, `dim` / 3 points per frame, metres, 40 frames per second.

use crate::motion::FPS;
use glam::Vec3;

/// Acceleration in each of the frames 1 to T-2, m/s^2: mean over the points of |x(t+1) - 2 x(t) + x(t-1)| FPS^2 (T - 2 values,
/// none if T < 3).
pub fn accelerations(points: &[f32], dim: usize) -> Vec<f32> {
    differences(points, dim, &[1.0, -2.0, 1.0])
}

/// Jerk over each four frames in a row, m/s^3: mean over the points of |x(t+3) - 3 x(t+2) + 3 x(t+1) - x(t)| FPS^3 (T - 3 values,
/// none if T < 4).
pub fn jerks(points: &[f32], dim: usize) -> Vec<f32> {
    differences(points, dim, &[-1.0, 3.0, -3.0, 1.0])
}

/// Mean length over the points of the difference with these factors, in units of a second.
fn differences(points: &[f32], dim: usize, factors: &[f32]) -> Vec<f32> {
    assert!(dim > 0 && dim.is_multiple_of(3) && points.len().is_multiple_of(dim), "whole frames of points");
    let frames = points.len() / dim;
    let scale = FPS.powi(factors.len() as i32 - 1) / (dim / 3) as f32;
    let at = |t: usize, i: usize| Vec3::from_slice(&points[t * dim + 3 * i..]);
    let difference = |t: usize, i: usize| factors.iter().enumerate().map(|(k, f)| *f * at(t + k, i)).sum::<Vec3>().length();
    let each = |t: usize| scale * (0..dim / 3).map(|i| difference(t, i)).sum::<f32>();
    (0..(frames + 1).saturating_sub(factors.len())).map(each).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_cubic_by_hand() {
        // x = (t / 40)^3 and a point at rest: the second difference is exactly 6 s, the third 6; half of it on average.
        let points: Vec<f32> = (0..7).flat_map(|t| [(t as f32 / FPS).powi(3), 0.0, 0.0, 1.0, 2.0, 3.0]).collect();
        let (a, j) = (accelerations(&points, 6), jerks(&points, 6));
        assert_eq!((a.len(), j.len()), (5, 4));
        for (k, a) in a.iter().enumerate() {
            assert!((a - 3.0 * (k + 1) as f32 / FPS).abs() < 1e-3, "{a}");
        }
        assert!(j.iter().all(|j| (j - 3.0).abs() < 0.03), "{j:?}");
        assert!(accelerations(&points[..12], 6).is_empty() && jerks(&points[..18], 6).is_empty());
    }
}
