//! How different the ways are that a policy finds from one start to one goal.

use glam::Vec2;

/// Points that ways are compared at.
const POINTS: usize = 100;

/// `count` points that divide the way `path` into parts of equal length, its ends among them. Without points: none.
pub fn resample(path: &[Vec2], count: usize) -> Vec<Vec2> {
    let mut lengths = vec![0.0];
    path.windows(2).for_each(|s| lengths.push(lengths[lengths.len() - 1] + s[0].distance(s[1])));
    let total = lengths[lengths.len() - 1];
    let at = |k: usize| {
        let length = total * k as f32 / (count - 1).max(1) as f32;
        let i = lengths.partition_point(|&l| l < length).clamp(1, path.len() - 1);
        let part = lengths[i] - lengths[i - 1];
        path[i - 1].lerp(path[i], if part > 0.0 { (length - lengths[i - 1]) / part } else { 1.0 })
    };
    match path {
        [] => Vec::new(),
        [only] => vec![*only; count],
        _ => (0..count).map(at).collect(),
    }
}

/// Mean distance over all pairs of ways between corresponding points, metres: each way is divided into 99 parts of equal length, so that
/// speed has no influence. NaN for fewer than two ways.
pub fn pairwise_path_distance(paths: &[Vec<Vec2>]) -> f32 {
    let each: Vec<Vec<Vec2>> = paths.iter().map(|p| resample(p, POINTS)).collect();
    let distance = |a: &[Vec2], b: &[Vec2]| a.iter().zip(b).map(|(a, b)| a.distance(*b)).sum::<f32>() / POINTS as f32;
    let pairs = (0..each.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    let (sum, count) = pairs.fold((0.0, 0), |(s, n), (i, j)| (s + distance(&each[i], &each[j]), n + 1));
    sum / count as f32
}

/// Whether the way passes `middle` on the left, as seen from its start towards `goal`: the side on which it first comes level with the
/// middle. None where it never does.
pub fn passes_left(path: &[Vec2], goal: Vec2, middle: Vec2) -> Option<bool> {
    let ahead = (goal - *path.first()?).normalize_or_zero();
    let level = path.iter().position(|p| (*p - middle).dot(ahead) >= 0.0).filter(|&t| t > 0)?;
    Some(ahead.perp_dot(path[level] - middle) > 0.0)
}

/// Entropy of a choice made `counts` times each, bits. NaN where nothing was chosen.
pub fn entropy(counts: &[usize]) -> f32 {
    let total: usize = counts.iter().sum();
    if total == 0 {
        return f32::NAN;
    }
    let part = |n: usize| {
        let p = n as f32 / total as f32;
        -p * p.log2()
    };
    counts.iter().filter(|n| **n > 0).map(|&n| part(n)).sum::<f32>().max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn way(points: &[(f32, f32)]) -> Vec<Vec2> {
        points.iter().map(|&p| p.into()).collect()
    }

    #[test]
    fn equal_parts_by_hand() {
        // An L of 3 + 1 m in four parts, walked with a rest at the corner.
        let path = way(&[(0.0, 0.0), (3.0, 0.0), (3.0, 0.0), (3.0, 1.0)]);
        assert_eq!(resample(&path, 5), way(&[(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (3.0, 1.0)]));
        assert_eq!(resample(&path[1..3], 2), way(&[(3.0, 0.0), (3.0, 0.0)]));
        assert_eq!((resample(&path[..1], 3).len(), resample(&[], 3).len()), (3, 0));
    }

    #[test]
    fn distances_between_ways_by_hand() {
        // Parallel ways 1 m apart, one of them walked unevenly; and a third one 3 m from the first.
        let a = way(&[(0.0, 0.0), (4.0, 0.0)]);
        let b = way(&[(0.0, 1.0), (0.5, 1.0), (4.0, 1.0)]);
        let c = way(&[(0.0, 3.0), (4.0, 3.0)]);
        assert!((pairwise_path_distance(&[a.clone(), b.clone()]) - 1.0).abs() < 1e-5);
        assert!((pairwise_path_distance(&[a.clone(), b, c]) - 2.0).abs() < 1e-5);
        // Diverging from one point to 2 m apart: 1 m in the mean.
        let fork = [way(&[(0.0, 0.0), (4.0, 1.0)]), way(&[(0.0, 0.0), (4.0, -1.0)])];
        assert!((pairwise_path_distance(&fork) - 1.0).abs() < 1e-5);
        assert_eq!(pairwise_path_distance(&[a.clone(), a.clone()]), 0.0);
        assert!(pairwise_path_distance(&[a]).is_nan());
    }

    #[test]
    fn sides_and_their_entropy_by_hand() {
        let goal = Vec2::new(4.0, 0.0);
        let middle = Vec2::new(2.0, 0.0);
        let left = way(&[(0.0, 0.0), (1.0, 1.0), (2.5, 1.0), (4.0, 0.0)]);
        let right: Vec<Vec2> = left.iter().map(|p| Vec2::new(p.x, -p.y)).collect();
        assert_eq!(passes_left(&left, goal, middle), Some(true));
        assert_eq!(passes_left(&right, goal, middle), Some(false));
        assert_eq!(passes_left(&left[..2], goal, middle), None);
        assert_eq!(passes_left(&[], goal, middle), None);
        assert_eq!((entropy(&[5, 5]), entropy(&[7, 0])), (1.0, 0.0));
        // One in four: 0.25 x 2 + 0.75 x log2(4/3).
        assert!((entropy(&[1, 3]) - 0.811_278).abs() < 1e-5);
        assert!(entropy(&[0, 0]).is_nan());
    }
}
