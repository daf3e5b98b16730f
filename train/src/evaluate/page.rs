//! What an evaluation found, as one HTML page.

use super::figures::{Better, FIGURES, OF_STARTS};
use super::pictures::{failures, plans, worst};
use super::rows::{Column, parts};
use super::{Estimate, Fate, Played, Row, Setup};
use crate::Result;
use crate::html::{Cell, Page, Picture};
use crate::plot::{Band, Series, Titles, histogram, lines};
use egogen::motion::FPS;
use egogen_envs::motion::TERMS;
use std::collections::BTreeMap;

/// Filmstrips of each scenario.
const WORST: usize = 3;
/// Most failures on the contact sheet of a scenario.
const FAILURES: usize = 16;
/// Bins of histograms.
const BINS: usize = 24;
/// Figures that differences are shown of.
const COMPARED: [&str; 9] =
    ["success", "reached", "seconds", "penetration", "obstacle_frames", "inside_frames", "inside_vertices", "contact", "slide_cm"];

/// A scenario that all have played.
pub struct Outcome<'a> {
    pub setup: &'a Setup,
    /// Of each policy or baseline its sums, ...
    pub rows: &'a [Row],
    /// ... its episodes, ...
    pub played: &'a [Vec<Played>],
    /// ... and how it differs from the one that is compared with, by name of the figure.
    pub differences: &'a [BTreeMap<&'static str, Estimate>],
    /// Number of the one that is compared with.
    pub reference: usize,
}

/// Adds a scenario to the page.
pub fn add_scenario(page: &mut Page, o: &Outcome) -> Result<()> {
    let s = &o.setup.scenario;
    page.section(&s.name);
    let people = o.setup.place.len();
    page.text(&format!("{}. {} scenes, {people} episodes, the same starts for everyone.", s.about, o.setup.solids.len()));
    for (title, shown) in parts(o.rows) {
        let head: Vec<&str> = std::iter::once(title).chain(shown.iter().map(|c| c.head)).collect();
        let cell = |row: &Row, c: &Column| row.get(c.key).map_or("-".into(), |e| number(e, c.digits, c.factor));
        let rows = o.rows.iter().map(|row| std::iter::once(row.name.as_str().into()).chain(shown.iter().map(|c| cell(row, c))).collect());
        page.table(&head, &rows.collect::<Vec<Vec<Cell>>>());
    }
    let head: Vec<&str> = std::iter::once("How episodes ended").chain(Fate::ALL.map(Fate::words)).collect();
    let counts = |row: &Row| row.fates.iter().map(|(_, n)| Cell::from(n.to_string())).collect::<Vec<_>>();
    let rows = o.rows.iter().map(|row| std::iter::once(row.name.as_str().into()).chain(counts(row)).collect());
    page.table(&head, &rows.collect::<Vec<Vec<Cell>>>());
    compare(page, o);
    let mut figures = vec![distances(o)?, rewards(o)?];
    figures.extend(histograms(o)?);
    page.figures(&figures.iter().map(|(svg, caption)| (Picture::Svg(svg.clone()), caption.as_str())).collect::<Vec<_>>());
    let mut views = Vec::new();
    for (row, played) in o.rows.iter().zip(o.played) {
        if let Some(image) = plans(o.setup, played)? {
            views.push((Picture::Png(image.png()?), row.name.as_str()));
        }
    }
    page.figures(&views);
    if let Some((image, caption)) = failures(o.setup, &o.played[o.reference], FAILURES)? {
        page.text(&format!("Episodes of {} that failed:", o.rows[o.reference].name));
        page.figures(&[(Picture::Png(image.png()?), caption.as_str())]);
    }
    let strips = worst(o.setup, &o.played[o.reference], WORST)?;
    page.text(&format!("The worst episodes of {}, from the first to the last frame:", o.rows[o.reference].name));
    for (image, caption) in strips {
        page.figures(&[(Picture::Png(image.png()?), caption.as_str())]);
    }
    Ok(())
}

/// What the figures are.
pub fn add_meanings(page: &mut Page) {
    page.section("What the figures are");
    let each = FIGURES.iter().map(|f| (f.head, f.key, f.meaning));
    let all = each.chain(OF_STARTS.iter().map(|&(key, head, meaning)| (head, key, meaning)));
    let rows: Vec<Vec<Cell>> = all.map(|(head, key, meaning)| vec![head.into(), Cell::words(key), Cell::words(meaning)]).collect();
    page.table(&["figure", "in report.json", "meaning"], &rows);
    page.text(
        "Small print under a figure: 95 % intervals. Shares have Wilson's, widened by the design effect where people share a scene; all else \
         a percentile bootstrap that resamples scenes. Differences are taken episode by episode, from the same start.",
    );
}

fn number(e: Estimate, digits: usize, factor: f64) -> Cell {
    let [value, low, high] = [e.value, e.low, e.high].map(|v| format!("{:.digits$}", factor * v));
    Cell::from(value).note(format!("{low} to {high}"))
}

fn compare(page: &mut Page, o: &Outcome) {
    let shown: Vec<_> =
        FIGURES.iter().filter(|f| COMPARED.contains(&f.key)).filter(|f| o.differences.iter().any(|d| d.contains_key(f.key))).collect();
    if o.rows.len() < 2 || shown.is_empty() {
        return;
    }
    let title = format!("Less that of {}", o.rows[o.reference].name);
    let head: Vec<&str> = std::iter::once(title.as_str()).chain(shown.iter().map(|f| f.head)).collect();
    let cell = |d: &BTreeMap<&'static str, Estimate>, f: &super::figures::Figure| {
        let Some(e) = d.get(f.key) else { return "-".into() };
        let factor = if f.share { 100.0 } else { 1.0 };
        let (sign, digits) = (if e.value > 0.0 { "+" } else { "" }, f.digits);
        let text = format!("{sign}{:.digits$}", factor * e.value);
        let sure = e.low * e.high > 0.0;
        let cell = match f.better {
            Better::More if sure => Cell::verdict(text, e.value > 0.0),
            Better::Less if sure => Cell::verdict(text, e.value < 0.0),
            _ => Cell::from(text),
        };
        cell.note(format!("{:.digits$} to {:.digits$}", factor * e.low, factor * e.high))
    };
    let others = o.rows.iter().zip(o.differences).enumerate().filter(|(i, _)| *i != o.reference);
    let rows = others.map(|(_, (row, d))| std::iter::once(row.name.as_str().into()).chain(shown.iter().map(|f| cell(d, f))).collect());
    page.table(&head, &rows.collect::<Vec<Vec<Cell>>>());
}

/// Distance to the goal over time, mean and standard error; who has ended keeps its last one.
fn distances(o: &Outcome) -> Result<(String, String)> {
    let series = |(row, played): (&Row, &Vec<Played>)| {
        let each: Vec<Vec<f32>> = played.iter().filter_map(way_left).collect();
        let longest = each.iter().map(Vec::len).max().unwrap_or(0);
        let at = |t: usize| spread(each.iter().filter_map(|d| d.get(t).or(d.last()).copied()));
        let points: Vec<(f64, [f64; 2])> = (0..longest).step_by(6).map(|t| (t as f64 / f64::from(FPS), at(t))).collect();
        Series {
            name: row.name.clone(),
            points: points.iter().map(|p| (p.0, p.1[0])).collect(),
            band: Some(Band { half: points.iter().map(|p| p.1[1]).collect(), what: "standard error" }),
        }
    };
    let all: Vec<Series> = o.rows.iter().zip(o.played).map(series).collect();
    let titles = Titles { title: "distance to the goal", x: "seconds", y: "m" };
    Ok((lines(titles, 0.0..0.5, &all)?, "Mean over the people; who has ended keeps its last distance.".into()))
}

fn way_left(p: &Played) -> Option<Vec<f32>> {
    let (m, film) = (p.measured.as_ref()?, p.film.as_ref()?);
    Some(m.path.iter().map(|q| q.distance(film.setting.goal)).collect())
}

/// Mean and standard error.
fn spread(values: impl Iterator<Item = f32> + Clone) -> [f64; 2] {
    let n = values.clone().count().max(1) as f64;
    let mean = values.clone().map(f64::from).sum::<f64>() / n;
    let variance = values.map(|v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
    [mean, (variance / n).sqrt()]
}

/// Reward terms of the reference over the steps, mean over those still under way.
fn rewards(o: &Outcome) -> Result<(String, String)> {
    let (played, width) = (&o.played[o.reference], TERMS.len());
    let longest = played.iter().map(|p| p.terms.len() / width).max().unwrap_or(0);
    let term = |k: usize| Series {
        name: TERMS[k].name.into(),
        points: (0..longest)
            .map(|s| (s as f64 + 1.0, spread(played.iter().filter_map(|p| p.terms.get(s * width + k).copied()))[0]))
            .collect(),
        band: None,
    };
    let all: Vec<Series> = (0..width).map(term).filter(|s| s.points.iter().any(|p| p.1.abs() > 1e-6)).collect();
    let titles = Titles { title: "reward terms", x: "step", y: "weighted" };
    Ok((lines(titles, 0.0..0.1, &all)?, format!("Weighted reward terms of {}, mean over those still under way.", o.rows[o.reference].name)))
}

/// Histograms of some figures.
fn histograms(o: &Outcome) -> Result<Vec<(String, String)>> {
    let mut out = Vec::new();
    for key in ["final_xy", "seconds", "contact", "inside_vertices"] {
        let Some(f) = FIGURES.iter().find(|f| f.key == key) else { continue };
        let values: Vec<Vec<f64>> =
            o.played.iter().map(|p| p.iter().map(f.of).filter(|v| v.is_finite()).map(f64::from).collect()).collect();
        let all = || values.iter().flatten().copied();
        let (low, high) = (all().fold(f64::MAX, f64::min).min(if key == "contact" { 0.9 } else { 0.0 }), all().fold(f64::MIN, f64::max));
        if all().count() == 0 || high <= low {
            continue;
        }
        let bin = |v: f64| (((v - low) / (high - low) * BINS as f64) as usize).min(BINS - 1);
        let counts: Vec<[f64; BINS]> = values
            .iter()
            .map(|v| {
                let mut counts = [0.0; BINS];
                v.iter().for_each(|&v| counts[bin(v)] += 1.0);
                counts
            })
            .collect();
        let named: Vec<(&str, &[f64])> = o.rows.iter().zip(&counts).map(|(r, c)| (r.name.as_str(), c.as_slice())).collect();
        let svg = histogram(Titles { title: f.head, x: "", y: "share of the episodes" }, low..high, &named)?;
        out.push((svg, f.meaning.to_string()));
    }
    Ok(out)
}
