//! How episodes end, for counting the causes of failures.

use super::Played;
use serde::{Serialize, Serializer};

/// Vertices of SMPL-X inside obstacles in one frame from which on a body is not brushing something but in it (the limit of eq. 11).
pub const THROUGH: f32 = 40.0;
/// Who ends this close to the goal without arriving has stayed there, metres.
const BESIDE: f32 = 0.3;
/// Who has not come this far in the last frames does not get on, metres; and how many frames: four steps.
const PROGRESS: f32 = 0.3;
const LATELY: usize = 72;

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fate {
    /// At the goal, round everything.
    Arrived,
    /// At the goal, on the way with 40 or more vertices inside an obstacle.
    Through,
    /// A penetration ended it.
    Hit,
    /// Out of time within 0.3 m of the goal.
    Beside,
    /// Out of time, having moved less than 0.3 m in the last four steps.
    Stuck,
    /// Out of time and still walking.
    Underway,
}

impl Fate {
    /// All, in the order of tables.
    pub const ALL: [Self; 6] = [Self::Arrived, Self::Through, Self::Hit, Self::Beside, Self::Stuck, Self::Underway];

    /// That of an episode; one that was not measured tells neither what was walked through nor who was stuck.
    pub fn of(p: &Played) -> Self {
        let measured = p.measured.as_ref();
        if p.figure("success") > 0.5 {
            return if measured.is_some_and(|m| m.most_inside >= THROUGH) { Self::Through } else { Self::Arrived };
        }
        if p.stopped {
            return Self::Hit;
        }
        if p.figure("final_dist") < BESIDE {
            return Self::Beside;
        }
        let path = measured.map_or(&[][..], |m| &m.path);
        match (path.last(), path.len().checked_sub(LATELY)) {
            (Some(last), Some(before)) if last.distance(path[before]) < PROGRESS => Self::Stuck,
            _ => Self::Underway,
        }
    }

    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Arrived => "arrived",
            Self::Through => "arrived through something",
            Self::Hit => "hit something",
            Self::Beside => "stayed beside the goal",
            Self::Stuck => "got stuck",
            Self::Underway => "ran out of time",
        }
    }
}

impl Serialize for Fate {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_str(self.words())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Measured;
    use super::*;
    use egogen_envs::motion::EPISODE;
    use glam::Vec2;

    fn played(success: bool, final_dist: f32, measured: Option<Measured>) -> Played {
        let mut p = Played { measured, ..Default::default() };
        for (name, value) in [("success", f32::from(success)), ("final_dist", final_dist)] {
            p.figures[EPISODE.iter().position(|n| *n == name).unwrap()] = value;
        }
        p
    }

    #[test]
    fn each_by_hand() {
        // 1 cm a frame for `walked` frames, then at rest for `rested`.
        let way = |walked: usize, rested: usize, most_inside: f32| {
            let path = (0..walked + rested).map(|t| Vec2::new(0.01 * t.min(walked) as f32, 0.0)).collect();
            Some(Measured { path, most_inside, ..Default::default() })
        };
        assert_eq!(Fate::of(&played(true, 0.05, way(100, 0, 39.0))), Fate::Arrived);
        assert_eq!(Fate::of(&played(true, 0.05, way(100, 0, 40.0))), Fate::Through);
        assert_eq!(Fate::of(&played(true, 0.05, None)), Fate::Arrived);
        assert_eq!(Fate::of(&Played { stopped: true, ..played(false, 1.0, way(100, 0, 0.0)) }), Fate::Hit);
        assert_eq!(Fate::of(&played(false, 0.2, way(100, 0, 0.0))), Fate::Beside);
        // 28 cm in the last 72 frames, and 43 cm.
        assert_eq!(Fate::of(&played(false, 1.0, way(100, 44, 0.0))), Fate::Stuck);
        assert_eq!(Fate::of(&played(false, 1.0, way(100, 29, 0.0))), Fate::Underway);
        assert_eq!(Fate::of(&played(false, 1.0, None)), Fate::Underway);
    }
}
