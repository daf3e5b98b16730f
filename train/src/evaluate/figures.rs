//! What is told of an episode: every figure with its name, unit and meaning.

use super::{Played, THROUGH};

/// Whether more of a figure is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Better {
    More,
    Less,
    Neither,
}

/// A figure of one person's episode.
#[derive(Clone, Copy, Debug)]
pub struct Figure {
    /// Its name in report.json.
    pub key: &'static str,
    /// Its name in tables, with the unit.
    pub head: &'static str,
    /// What it is.
    pub meaning: &'static str,
    pub better: Better,
    /// Whether it is 0 or 1 in each episode.
    pub share: bool,
    /// Digits after the point in tables.
    pub digits: usize,
    /// Its value; NaN where it does not apply.
    pub of: fn(&Played) -> f32,
}

macro_rules! figure {
    ($key:literal, $head:literal, $better:ident, $share:literal, $digits:literal, $of:expr, $meaning:literal) => {
        Figure { key: $key, head: $head, meaning: $meaning, better: Better::$better, share: $share, digits: $digits, of: $of }
    };
}

/// What the episode's motion tells, where it was measured.
fn told(p: &Played, of: fn(&super::Measured) -> f32) -> f32 {
    p.measured.as_ref().map_or(f32::NAN, of)
}

/// All figures of an episode, in the order of tables.
pub const FIGURES: [Figure; 25] = [
    figure!(
        "success",
        "success %",
        More,
        true,
        1,
        |p| p.figure("success"),
        "arrived: pelvis within 0.1 m of the goal, in space, at the end of a step; where a penetration ends episodes, without one"
    ),
    figure!(
        "clean",
        "clean %",
        More,
        true,
        1,
        |p| told(p, |m| if m.most_inside.is_finite() { f32::from(m.most_inside < THROUGH) } else { f32::NAN }) * p.figure("success"),
        "arrived with never 40 or more vertices inside an obstacle (eq. 11)"
    ),
    figure!(
        "reached",
        "reached %",
        More,
        true,
        1,
        |p| told(p, |m| f32::from(m.seconds.is_finite())),
        "pelvis within 0.1 m of the goal, seen from above, in any frame"
    ),
    figure!("near", "near %", More, true, 1, |p| told(p, |m| m.near), "the same within 0.2 m"),
    figure!("seconds", "time s", Less, false, 2, |p| told(p, |m| m.seconds), "time until then, of those who reached it (0.1 m)"),
    figure!(
        "final_xy",
        "final m",
        Less,
        false,
        2,
        |p| told(p, |m| m.last),
        "distance from pelvis to goal in the last frame, seen from above"
    ),
    figure!("min_xy", "least m", Less, false, 2, |p| told(p, |m| m.least), "the smallest such distance in any frame"),
    figure!(
        "penetration",
        "hit %",
        Less,
        true,
        1,
        |p| p.figure("penetration"),
        "had a penetration of eq. 7: three or more non-walkable cells of 0.1 m under the body's box at the end of a step, others' boxes among them"
    ),
    figure!(
        "obstacle_frames",
        "over obstacle %",
        Less,
        false,
        1,
        |p| 100.0 * told(p, |m| m.obstacle_frames),
        "frames in which any vertex's floor projection lies in an obstacle or beyond a wall"
    ),
    figure!(
        "obstacle_depth_mm",
        "in obstacle mm",
        Less,
        false,
        1,
        |p| 1000.0 * told(p, |m| m.obstacle_depth),
        "depth of the deepest vertex inside obstacles, by signed distance, mean over all frames"
    ),
    figure!(
        "most_inside",
        "most inside",
        Less,
        false,
        0,
        |p| told(p, |m| m.most_inside),
        "greatest number of vertices inside obstacles in a frame, counted as SMPL-X's, without feet; eq. 11 forbids 40"
    ),
    figure!(
        "inside_frames",
        "in others %",
        Less,
        false,
        1,
        |p| 100.0 * told(p, |m| m.inside_frames),
        "frames in which any vertex lies inside another person's mesh (winding number above a half)"
    ),
    figure!(
        "inside_vertices",
        "vertices in others",
        Less,
        false,
        1,
        |p| told(p, |m| m.inside_vertices),
        "number of such vertices, of 13,718, mean over all frames"
    ),
    figure!(
        "occupancy",
        "occupancy",
        Less,
        false,
        5,
        |p| told(p, |m| m.occupancy),
        "mean over vertices of 1 / (1 + exp(d / 1 cm)), d the signed distance to another's surface, summed over the others, mean over all frames"
    ),
    figure!("contact", "contact", More, false, 3, |p| told(p, |m| m.contact), "foot contact of eq. 12 per frame, mean over all frames"),
    figure!("slide_cm", "slide cm", Less, false, 2, |p| 100.0 * p.slide, "way of the lowest foot marker per stance"),
    figure!(
        "detour",
        "detour",
        Less,
        false,
        3,
        |p| told(p, |m| m.detour),
        "length of the way over that of the shortest one round what stands still, of those who came within 0.2 m"
    ),
    figure!("steps", "steps", Neither, false, 1, |p| p.figure("steps"), "length of the episode in steps of 0.45 s"),
    figure!("reward", "return", More, false, 2, |p| p.figure("return"), "sum of rewards with the task's weights"),
    figure!(
        "hover",
        "hover %",
        Less,
        true,
        1,
        |p| p.figure("hover"),
        "more than two steps ended within 0.3 m of the goal without arriving"
    ),
    figure!("pose_norm", "VP norm", Neither, false, 2, |p| p.pose_norm, "||VP|| of eq. 9 under the shipped pose prior"),
    figure!("body_error_mm", "body error mm", Less, false, 1, |p| 1000.0 * p.body_error, "distance between predicted and skinned markers"),
    figure!("kl", "KL", Less, false, 3, |p| p.kl, "divergence of the actions from N(0, I), nats per dimension; baselines have none"),
    figure!("kl_mean", "0.5 mean mu^2", Less, false, 3, |p| p.kl_mean, "the authors' figure of the same"),
    figure!(
        "final_dist",
        "final 3-D m",
        Less,
        false,
        2,
        |p| p.figure("final_dist"),
        "distance from pelvis to goal at the end of the last step, in space"
    ),
];

/// Figures of starts that were played several times: name in report.json, name in tables, meaning.
pub const OF_STARTS: [(&str, &str, &str); 2] = [
    ("path_distance", "path distance m", "mean distance between two ways from one start, at 100 points that divide each into equal parts"),
    (
        "side_entropy",
        "side entropy bit",
        "entropy of passing the box on the left or on the right among the ways from one start; 1 is the most",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_told_once() {
        let mut keys: Vec<_> = FIGURES.iter().map(|f| f.key).chain(OF_STARTS.map(|o| o.0)).collect();
        keys.sort_unstable();
        keys.dedup();
        assert_eq!(keys.len(), FIGURES.len() + OF_STARTS.len());
    }
}
