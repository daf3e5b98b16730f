//! What is told of episodes: every figure with its name, unit and meaning.

use super::{Estimate, Fate, Played, THROUGH, ratio, share};
use egogen::metrics::{entropy, pairwise_path_distance};
use glam::Vec2;
use serde::Serialize;
use std::collections::BTreeMap;

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

/// Tables, and the figures that each shows.
const PARTS: [(&str, &[&str]); 3] = [
    ("The goal", &["success", "clean", "reached", "near", "seconds", "final_xy", "min_xy", "detour", "path_distance", "side_entropy"]),
    (
        "Obstacles and others",
        &["penetration", "obstacle_frames", "obstacle_depth_mm", "most_inside", "inside_frames", "inside_vertices", "occupancy"],
    ),
    ("Motion", &["contact", "slide_cm", "pose_norm", "body_error_mm", "kl", "kl_mean", "steps", "hover", "reward"]),
];

/// One policy or baseline in one scenario.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub name: String,
    pub episodes: usize,
    /// How many of them ended in each way.
    pub fates: Vec<(Fate, usize)>,
    /// By the names of [`FIGURES`] and [`OF_STARTS`]; those that apply.
    #[serde(flatten)]
    pub figures: BTreeMap<&'static str, Estimate>,
}

impl Row {
    /// Sums up the episodes of `name`; intervals resample scenes, for the people of one are not independent.
    pub fn new(name: &str, played: &[Played]) -> Self {
        let mut figures: BTreeMap<_, _> = FIGURES.iter().filter_map(|f| Some((f.key, summed(played, f)?))).collect();
        for ((key, ..), value) in OF_STARTS.iter().zip(diversity(played)) {
            figures.extend(value.map(|v| (*key, v)));
        }
        let fates: Vec<Fate> = played.iter().map(Fate::of).collect();
        let fates = Fate::ALL.map(|fate| (fate, fates.iter().filter(|f| **f == fate).count())).to_vec();
        Self { name: name.into(), episodes: played.len(), fates, figures }
    }

    /// The figure `key`, if it applies.
    pub fn get(&self, key: &str) -> Option<Estimate> {
        self.figures.get(key).copied()
    }
}

fn summed(played: &[Played], figure: &Figure) -> Option<Estimate> {
    let groups = grouped(played, |p| (figure.of)(p));
    if figure.share { share(&groups) } else { ratio(&groups) }
}

/// Sum and number of the finite values of each scene.
fn grouped(played: &[Played], of: impl Fn(&Played) -> f32) -> Vec<[f64; 2]> {
    let mut groups: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
    for (group, value) in played.iter().map(|p| (p.group, of(p))).filter(|(_, v)| v.is_finite()) {
        let sum = groups.entry(group).or_default();
        *sum = [sum[0] + f64::from(value), sum[1] + 1.0];
    }
    groups.into_values().collect()
}

/// Ways from one start, and how many of them pass on the right and on the left.
type Ways = (Vec<Vec<Vec2>>, [usize; 2]);

/// Figures of [`OF_STARTS`], where starts were played several times.
fn diversity(played: &[Played]) -> [Option<Estimate>; 2] {
    let mut starts: BTreeMap<u64, Ways> = BTreeMap::new();
    for (p, m) in played.iter().filter_map(|p| Some((p, p.measured.as_ref()?))) {
        let (paths, sides) = starts.entry(p.start).or_default();
        paths.push(m.path.clone());
        if let Some(left) = m.left {
            sides[usize::from(left)] += 1;
        }
    }
    starts.retain(|_, (paths, _)| paths.len() > 1);
    let mean = |of: fn(&Ways) -> f32| {
        let values = starts.values().map(of).filter(|v| v.is_finite());
        ratio(&values.map(|v| [f64::from(v), 1.0]).collect::<Vec<_>>())
    };
    [mean(|s| pairwise_path_distance(&s.0)), mean(|s| entropy(&s.1))]
}

/// Mean difference of `a` from `b` in the same episodes, for every figure that applies to both.
pub fn differences(a: &[Played], b: &[Played]) -> BTreeMap<&'static str, Estimate> {
    let of = |f: &Figure| {
        let mut groups: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
        for (p, q) in a.iter().zip(b) {
            let d = f64::from((f.of)(p)) - f64::from((f.of)(q));
            if d.is_finite() {
                let sum = groups.entry(p.group).or_default();
                *sum = [sum[0] + d, sum[1] + 1.0];
            }
        }
        ratio(&groups.into_values().collect::<Vec<_>>())
    };
    FIGURES.iter().filter_map(|f| Some((f.key, of(f)?))).collect()
}

/// A column of a table.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    pub key: &'static str,
    pub head: &'static str,
    pub digits: usize,
    /// What values are multiplied by: 100 for shares.
    pub factor: f64,
}

/// The tables of a scenario: name, and the figures shown there that any row has.
pub fn parts(rows: &[Row]) -> Vec<(&'static str, Vec<Column>)> {
    let column = |key: &&'static str| {
        let figure = FIGURES.iter().find(|f| f.key == *key);
        let told = figure.map(|f| Column { key: f.key, head: f.head, digits: f.digits, factor: if f.share { 100.0 } else { 1.0 } });
        let of_starts = || OF_STARTS.iter().find(|o| o.0 == *key).map(|o| Column { key: o.0, head: o.1, digits: 2, factor: 1.0 });
        told.or_else(of_starts).filter(|_| rows.iter().any(|r| r.get(key).is_some()))
    };
    PARTS
        .iter()
        .map(|(name, keys)| (*name, keys.iter().filter_map(column).collect()))
        .filter(|(_, c): &(_, Vec<_>)| !c.is_empty())
        .collect()
}

/// The rows as Markdown tables, intervals in brackets.
pub fn table(rows: &[Row]) -> String {
    let mut text = String::new();
    for (name, columns) in parts(rows) {
        let heads: String = columns.iter().map(|c| format!(" {} |", c.head)).collect();
        text += &format!("| {name} |{heads}\n|---|{}\n", "---|".repeat(columns.len()));
        for row in rows {
            let cell = |c: &Column| match row.get(c.key) {
                Some(e) => {
                    let [value, low, high] = [e.value, e.low, e.high].map(|v| format!("{:.*}", c.digits, c.factor * v));
                    format!(" {value} ({low}, {high}) |")
                }
                None => " - |".into(),
            };
            text += &format!("| {} |{}\n", row.name, columns.iter().map(cell).collect::<String>());
        }
        text.push('\n');
    }
    text + &fates(rows)
}

/// How many episodes ended in each way, as a Markdown table.
fn fates(rows: &[Row]) -> String {
    let mut text = format!(
        "| How episodes ended |{}\n|---|{}\n",
        Fate::ALL.map(|f| format!(" {} |", f.words())).concat(),
        "---|".repeat(Fate::ALL.len())
    );
    for row in rows {
        text += &format!("| {} |{}\n", row.name, row.fates.iter().map(|(_, n)| format!(" {n} |")).collect::<String>());
    }
    text + "\n"
}

#[cfg(test)]
mod tests {
    use super::super::Measured;
    use super::*;

    fn played(group: usize, start: u64, slide: f32, path: &[(f32, f32)], left: Option<bool>) -> Played {
        let path = path.iter().map(|&p| p.into()).collect();
        Played {
            group,
            start,
            slide,
            measured: Some(Measured { path, left, seconds: f32::NAN, ..Default::default() }),
            ..Default::default()
        }
    }

    #[test]
    fn rows_by_hand() {
        let (a, b) = ([(0.0, 0.0), (4.0, 0.0)], [(0.0, 1.0), (4.0, 1.0)]);
        let all = [
            played(0, 0, 0.01, &a, Some(true)),
            played(1, 0, 0.03, &b, Some(false)),
            played(2, 1, 0.05, &a, Some(true)),
            played(3, 1, 0.07, &a, Some(true)),
        ];
        let row = Row::new("x", &all);
        let value = |key: &str| row.get(key).map(|e| (e.value * 1e4).round() / 1e4);
        assert_eq!((value("slide_cm"), value("reached"), value("seconds")), (Some(4.0), Some(0.0), None));
        // Ways of the first start are 1 m apart, of the second the same; sides 1 bit and 0.
        assert_eq!((value("path_distance"), value("side_entropy")), (Some(0.5), Some(0.5)));
        let json = serde_json::to_value(&row).unwrap();
        assert!(json["slide_cm"]["value"].as_f64().is_some() && json["name"] == "x" && json["seconds"].is_null());
        let text = table(std::slice::from_ref(&row));
        assert!(text.contains("slide cm") && !text.contains("time s") && text.contains("4.00 ("));
    }

    #[test]
    fn differences_are_paired() {
        let way = [(0.0, 0.0), (1.0, 0.0)];
        let a: Vec<Played> = (0..20).map(|i| played(i, i as u64, 0.1 * i as f32 + 0.02, &way, None)).collect();
        let b: Vec<Played> = (0..20).map(|i| played(i, i as u64, 0.1 * i as f32, &way, None)).collect();
        // The figures spread over 2 m, their difference not at all.
        let d = differences(&a, &b)["slide_cm"];
        assert!((d.value - 2.0).abs() < 1e-3 && d.high - d.low < 1e-3, "{d:?}");
        assert!(!differences(&a, &b).contains_key("seconds"));
    }

    #[test]
    fn names_are_told_once() {
        let mut keys: Vec<_> = FIGURES.iter().map(|f| f.key).chain(OF_STARTS.map(|o| o.0)).collect();
        keys.sort_unstable();
        keys.dedup();
        assert_eq!(keys.len(), FIGURES.len() + OF_STARTS.len());
    }
}
