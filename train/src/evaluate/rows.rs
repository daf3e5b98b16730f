//! What the episodes of a policy or baseline come to: means with intervals, differences, tables.

use super::figures::{FIGURES, Figure, OF_STARTS};
use super::{Estimate, Fate, Played, ratio, share};
use egogen::metrics::{entropy, pairwise_path_distance};
use glam::Vec2;
use serde::Serialize;
use std::collections::BTreeMap;

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
}
