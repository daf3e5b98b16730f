//! The shortest way round what stands still, for walkers that plan.

use egogen::scene::{Navigator, Polygon};
use glam::Vec2;
use std::sync::OnceLock;

/// Distances to keep from borders, metres: the first that leaves a way.
const CLEARANCES: [f64; 4] = [0.4, 0.3, 0.2, 0.1];
/// How far ahead on its way a walker turns to, metres.
const AHEAD: f32 = 0.5;

/// Ways over one floor. What they share is found once.
pub struct Ways {
    floor: Polygon,
    /// Of each clearance; None where nobody can walk with it.
    navigators: [OnceLock<Option<Navigator>>; CLEARANCES.len()],
}

impl Ways {
    /// Ways over `floor`.
    pub fn over(floor: &Polygon) -> Self {
        Self { floor: floor.clone(), navigators: Default::default() }
    }

    /// Where they lead.
    pub fn floor(&self) -> &Polygon {
        &self.floor
    }

    /// The shortest way from `start` to `goal`, as far from borders as can be; the straight line where there is none.
    pub fn plan(&self, start: Vec2, goal: Vec2) -> Way {
        let route = |(clearance, kept): (f64, &OnceLock<Option<Navigator>>)| {
            kept.get_or_init(|| Navigator::new(&self.floor, clearance).ok()).as_ref()?.route(start.as_dvec2(), goal.as_dvec2())
        };
        let found = CLEARANCES.into_iter().zip(&self.navigators).find_map(route);
        Way { points: found.map_or_else(|| vec![start, goal], |r| r.points.iter().map(|p| p.as_vec2()).collect()) }
    }
}

/// A way to the goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Way {
    /// From where it was planned, corners, goal.
    points: Vec<Vec2>,
}

impl Way {
    /// Length of the way, metres.
    pub fn length(&self) -> f32 {
        self.points.windows(2).map(|s| s[0].distance(s[1])).sum()
    }

    /// How far it still is from `at` over the nearest point of the way, metres, and the point of the way to turn to next.
    pub fn follow(&self, at: Vec2) -> (f32, Vec2) {
        let nearest = |s: &[Vec2]| {
            let along = s[1] - s[0];
            s[0] + along * ((at - s[0]).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0)
        };
        let parts: Vec<Vec2> = self.points.windows(2).map(nearest).collect();
        let best = (0..parts.len()).fold(0, |b, k| if at.distance(parts[k]) <= at.distance(parts[b]) { k } else { b });
        if best + 1 == parts.len() {
            let goal = self.points[best + 1];
            return (at.distance(goal), goal);
        }
        let rest = || std::iter::once(parts[best]).chain(self.points[best + 1..].iter().copied());
        let mut left = at.distance(parts[best]);
        let (mut ahead, mut last) = (None, parts[best]);
        let mut to_go = AHEAD;
        for p in rest().skip(1) {
            let length = last.distance(p);
            if ahead.is_none() && length >= to_go {
                ahead = Some(last.lerp(p, to_go / length));
            }
            to_go -= length;
            left += length;
            last = p;
        }
        (left, ahead.unwrap_or(last))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    fn near(a: (f32, Vec2), left: f32, to: Vec2) -> bool {
        (a.0 - left).abs() < 1e-5 && (a.1 - to).length() < 1e-5
    }

    #[test]
    fn followed_by_hand() {
        let way = Way { points: [(0.0, 0.0), (2.0, 0.0), (2.0, 3.0)].map(Vec2::from).to_vec() };
        // 0.3 m beside the way, 1.2 m before the corner, which the point half a metre on lies before.
        assert!(near(way.follow(Vec2::new(0.8, -0.3)), 0.3 + 1.2 + 3.0, Vec2::new(1.3, 0.0)));
        // 0.2 m before the corner: 0.3 m round it.
        assert!(near(way.follow(Vec2::new(1.8, -0.1)), 0.1 + 0.2 + 3.0, Vec2::new(2.0, 0.3)));
        // On the last part straight to the goal.
        assert!(near(way.follow(Vec2::new(1.0, 3.0)), 1.0, Vec2::new(2.0, 3.0)));
    }

    #[test]
    fn planned_round_a_box() {
        let square = |h: f64| [(-h, -h), (h, -h), (h, h), (-h, h)].map(DVec2::from).to_vec();
        let floor = Polygon::new(square(4.0), vec![square(0.5)]).unwrap();
        let (start, goal) = (Vec2::new(-2.0, 0.1), Vec2::new(2.0, 0.1));
        let ways = Ways::over(&floor);
        let way = ways.plan(start, goal);
        let highest = way.points.iter().map(|p| p.y).fold(0.0, f32::max);
        assert!(way.points.len() > 2 && highest > 0.89 && highest < 1.0, "{way:?}");
        // From within the box there is no way but the straight one.
        assert_eq!(ways.plan(Vec2::ZERO, goal).points, [Vec2::ZERO, goal]);
        // Where there is less room: 0.35 m beside the box need the second clearance. What was asked before makes no difference.
        let close = ways.plan(Vec2::new(0.0, -0.85), goal);
        assert_eq!(close, Ways::over(&floor).plan(Vec2::new(0.0, -0.85), goal));
        let lowest = close.points[1..].iter().map(|p| p.y).fold(0.0, f32::min);
        assert!(close.points.len() > 2 && lowest < -0.79 && lowest > -0.83, "{close:?}");
        assert_eq!(ways.plan(start, goal), way);
    }
}
