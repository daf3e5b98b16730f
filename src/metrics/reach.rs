//! How a person comes to its goal, in the plane. Paths hold one point per frame, metres.

use crate::motion::FPS;
use glam::Vec2;

/// Time from the first frame to the first one within `reach` of the goal, seconds; None where there is none.
pub fn time_to_reach(path: &[Vec2], goal: Vec2, reach: f32) -> Option<f32> {
    path.iter().position(|p| p.distance(goal) < reach).map(|t| t as f32 / FPS)
}

/// Distance to the goal in the last frame, metres. NaN without frames.
pub fn final_distance(path: &[Vec2], goal: Vec2) -> f32 {
    path.last().map_or(f32::NAN, |p| p.distance(goal))
}

/// Smallest distance to the goal in any frame, metres. NaN without frames.
pub fn least_distance(path: &[Vec2], goal: Vec2) -> f32 {
    path.iter().map(|p| p.distance(goal)).fold(f32::NAN, f32::min)
}

/// Length of the way, metres.
pub fn path_length(path: &[Vec2]) -> f32 {
    path.windows(2).map(|s| s[0].distance(s[1])).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_hand() {
        // 1 m per frame along x past a goal 1 m beside the way.
        let path: Vec<Vec2> = (0..6).map(|t| Vec2::new(t as f32, 0.0)).collect();
        let goal = Vec2::new(4.0, 1.0);
        assert_eq!(time_to_reach(&path, goal, 1.5), Some(3.0 / 40.0));
        assert_eq!(time_to_reach(&path, goal, 1.0), None);
        assert_eq!((final_distance(&path, goal), least_distance(&path, goal)), (2f32.sqrt(), 1.0));
        assert_eq!(path_length(&path), 5.0);
        assert!(final_distance(&[], goal).is_nan() && least_distance(&[], goal).is_nan() && path_length(&path[..1]) == 0.0);
    }
}
