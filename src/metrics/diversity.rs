//! How different motions are that start alike.

use glam::Vec3;

/// Average pairwise distance of `n` samples of equally many points (n x P x 3), in their unit: the mean over all pairs of samples of
/// the mean distance between corresponding points. NaN for fewer than two samples.
pub fn average_pairwise_distance(samples: &[f32], n: usize) -> f32 {
    assert!(n > 0 && samples.len().is_multiple_of(3 * n), "{n} samples of whole points");
    let each: Vec<&[f32]> = samples.chunks_exact((samples.len() / n).max(1)).collect();
    let distance = |a: &[f32], b: &[f32]| -> f32 {
        let points = a.chunks_exact(3).zip(b.chunks_exact(3));
        points.map(|(a, b)| Vec3::from_slice(a).distance(Vec3::from_slice(b))).sum::<f32>() / (a.len() / 3) as f32
    };
    let pairs = (0..n).flat_map(|i| (0..i).map(move |j| (i, j)));
    let (sum, count) = pairs.fold((0.0, 0), |(s, c), (i, j)| (s + distance(each[i], each[j]), c + 1));
    sum / count as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_hand() {
        // Two samples of two points that are 5 and 1 apart.
        let two = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 3.0, 4.0, 0.0, 1.0, 1.0, 2.0];
        assert_eq!(average_pairwise_distance(&two, 2), 3.0);
        // Points at 0, 1 and 5: pairs 1, 5 and 4.
        let three = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 5.0, 0.0, 0.0];
        assert!((average_pairwise_distance(&three, 3) - 10.0 / 3.0).abs() < 1e-6);
        assert!(average_pairwise_distance(&three[..3], 1).is_nan());
    }
}
