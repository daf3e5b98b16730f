//! Learning curves as an SVG picture.

use crate::logger::Columns;
use crate::plot::{Area, COLOURS, Drawn, svg};
use crate::{Error, Result};
use plotters::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Columns of metrics.csv that share a panel: title, the column while training, the one of tests, what a baseline calls it.
const PANELS: [(&str, &str, &str, &str); 5] = [
    ("return", "train/return", "return", "reward"),
    ("success rate", "train/success", "success", "success"),
    ("hover rate", "train/hover", "hover", "hover"),
    ("final distance, m", "train/final_dist", "final_dist", "final_dist"),
    ("KL of actions to N(0, I), nats per dimension", "loss/kl_prior", "", ""),
];
const SIZE: (u32, u32) = (1200, 760);

/// The columns of a run's metrics.csv.
pub struct Run {
    name: String,
    columns: Columns,
}

impl Run {
    /// Reads the run folder `dir`.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join("metrics.csv");
        let bad = |what: &str| Error::config(format!("{}: {what}", path.display()));
        if !path.is_file() {
            return Err(bad("there is no such file; not a run's folder, or one in stages, each of which has its own below stages/"));
        }
        let columns = Columns::read(&path)?;
        if columns.rows() > 0 && !columns.names.iter().any(|n| n == "env_steps") {
            return Err(bad("has no column env_steps; not a run's metrics"));
        }
        let name = dir.file_name().map_or_else(|| dir.display().to_string(), |n| n.to_string_lossy().into_owned());
        Ok(Self { name, columns })
    }

    /// Finished epochs.
    pub fn rows(&self) -> usize {
        self.columns.rows()
    }

    /// (thousand environment steps, value) where there is one.
    fn points(&self, column: &str) -> Vec<(f64, f64)> {
        let of = |row| Some((self.columns.get("env_steps", row)? / 1000.0, self.columns.get(column, row)?));
        (0..self.rows()).filter_map(of).collect()
    }
}

/// A baseline's figures by name.
pub struct Baseline {
    name: String,
    figures: BTreeMap<String, f64>,
}

impl Baseline {
    /// The rows of a report's first scenario without a KL, which are the baselines.
    pub fn read(path: &Path) -> Result<Vec<Self>> {
        let bad = |e: String| Error::config(format!("{}: {e}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|e| bad(e.to_string()))?;
        let report: serde_json::Value = serde_json::from_str(&text).map_err(|e| bad(e.to_string()))?;
        let rows = report["scenarios"][0]["rows"].as_array();
        let rows = rows.ok_or_else(|| bad("has no scenario with 'rows'; not a report of this evaluate".into()))?;
        let figures = |row: &serde_json::Value| {
            row.as_object().into_iter().flatten().filter_map(|(k, v)| Some((k.clone(), v["value"].as_f64()?))).collect()
        };
        let baselines = rows.iter().filter(|r| r["kl"].is_null());
        Ok(baselines.map(|r| Self { name: r["name"].as_str().unwrap_or("?").into(), figures: figures(r) }).collect())
    }
}

/// The picture: a panel per figure; thin lines while training, points in tests (filled: mean action, open: with noise).
pub fn draw(runs: &[Run], baselines: &[Baseline]) -> Result<String> {
    svg(SIZE, |root| {
        let areas = root.split_evenly((2, 3));
        for (area, panel) in areas.iter().zip(PANELS) {
            draw_panel(area, panel, runs, baselines)?;
        }
        legend(&areas[5], runs, baselines)
    })
}

fn draw_panel<'a>(area: &Area<'a>, panel: (&str, &str, &str, &str), runs: &[Run], baselines: &[Baseline]) -> Drawn<'a> {
    let (title, training, test, baseline) = panel;
    let tests = |run: &Run, how: &str| if test.is_empty() { vec![] } else { run.points(&format!("{how}/{test}")) };
    let levels: Vec<f64> = baselines.iter().filter_map(|b| b.figures.get(baseline).copied()).collect();
    let all: Vec<(f64, f64)> =
        runs.iter().flat_map(|r| [r.points(training), tests(r, "test_sto"), tests(r, "test_det")].concat()).collect();
    let right = all.iter().fold(1.0, |m: f64, p| m.max(p.0));
    let top = all.iter().map(|p| p.1).chain(levels.iter().copied()).fold(1e-6, f64::max) * 1.05;
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 18))
        .margin(8)
        .x_label_area_size(34)
        .y_label_area_size(46)
        .build_cartesian_2d(0.0..right, 0.0..top)?;
    chart.configure_mesh().x_desc("thousand environment steps").x_labels(6).y_labels(6).light_line_style(WHITE).draw()?;
    for (k, level) in levels.iter().enumerate() {
        let grey = RGBColor(90, 90, 90).mix(0.8);
        let dash = [(2, 4), (6, 4), (12, 4)][k % 3];
        chart.draw_series(DashedLineSeries::new([(0.0, *level), (right, *level)], dash.0, dash.1, grey.into()))?;
    }
    for (run, colour) in runs.iter().zip(COLOURS.iter().cycle()) {
        chart.draw_series(LineSeries::new(run.points(training), colour.stroke_width(2)))?;
        chart.draw_series(tests(run, "test_det").into_iter().map(|p| Circle::new(p, 4, colour.filled())))?;
        chart.draw_series(tests(run, "test_sto").into_iter().map(|p| Circle::new(p, 4, colour.stroke_width(1))))?;
    }
    Ok(())
}

fn legend<'a>(area: &Area<'a>, runs: &[Run], baselines: &[Baseline]) -> Drawn<'a> {
    let font = |size| ("sans-serif", size).into_font().color(&BLACK);
    let mut y = 40;
    for (run, colour) in runs.iter().zip(COLOURS.iter().cycle()) {
        area.draw(&PathElement::new(vec![(30, y + 8), (70, y + 8)], colour.stroke_width(3)))?;
        area.draw(&Text::new(run.name.clone(), (84, y), font(17)))?;
        y += 28;
    }
    for (k, b) in baselines.iter().enumerate() {
        let step = [6, 10, 16][k % 3];
        for x in (30..70).step_by(step) {
            area.draw(&PathElement::new(vec![(x, y + 8), ((x + step as i32 - 4).min(70), y + 8)], RGBColor(90, 90, 90).stroke_width(1)))?;
        }
        area.draw(&Text::new(b.name.clone(), (84, y), font(17)))?;
        y += 28;
    }
    area.draw(&Text::new("line: while training, with noise", (30, y + 16), font(15)))?;
    area.draw(&Text::new("filled point: test, mean action; open: test, with noise", (30, y + 40), font(15)))
}
