//! Small SVG plots: lines with bands, histograms, maps of counts, ways in the plane.

use crate::{Error, Result};
use plotters::prelude::*;
use std::ops::Range;

/// Colours of lines, from the first.
pub const COLOURS: [RGBColor; 8] = [
    RGBColor(52, 100, 180),
    RGBColor(214, 116, 40),
    RGBColor(60, 140, 80),
    RGBColor(150, 70, 150),
    RGBColor(190, 50, 50),
    RGBColor(90, 170, 200),
    RGBColor(120, 100, 60),
    RGBColor(110, 110, 120),
];
/// Pixels of what [`lines`] and [`histogram`] draw, of which three stand side by side, and [`map`] and [`ways`], of which four do.
const SIZE: (u32, u32) = (380, 290);
const SMALL: (u32, u32) = (282, 262);

/// What is drawn on.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
/// How drawing went.
pub type Drawn<'a> = std::result::Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

/// What a plot and its axes are called.
#[derive(Clone, Copy, Debug)]
pub struct Titles<'a> {
    pub title: &'a str,
    pub x: &'a str,
    pub y: &'a str,
}

/// One line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    pub name: String,
    /// (x, y) in the order of x.
    pub points: Vec<(f64, f64)>,
    pub band: Option<Band>,
}

/// A band around a line.
#[derive(Clone, Debug)]
pub struct Band {
    /// Half its height at each point.
    pub half: Vec<f64>,
    /// What the legend calls it, such as "standard error".
    pub what: &'static str,
}

/// What stands on lines, beside them.
#[derive(Clone, Debug, Default)]
pub struct Marks {
    /// Places on the x axis where something changes.
    pub borders: Vec<f64>,
    /// Points that were chosen.
    pub chosen: Vec<(f64, f64)>,
}

/// An SVG picture of `size` pixels on white.
pub fn svg<D>(size: (u32, u32), draw: D) -> Result<String>
where
    D: for<'a> FnOnce(&Area<'a>) -> Drawn<'a>,
{
    let mut svg = String::new();
    let failed = |e: &dyn std::fmt::Display| Error::run(format!("cannot draw: {e}"));
    {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE).map_err(|e| failed(&e))?;
        draw(&root).map_err(|e| failed(&e))?;
        root.present().map_err(|e| failed(&e))?;
    }
    Ok(svg)
}

/// Lines with the bands around them; y runs over `y` at least.
pub fn lines(titles: Titles, y: Range<f64>, series: &[Series]) -> Result<String> {
    marked_lines(titles, y, series, &Marks::default())
}

/// [`lines`] with marks: borders dashed, chosen points as rings.
pub fn marked_lines(titles: Titles, y: Range<f64>, series: &[Series], marks: &Marks) -> Result<String> {
    let all: Vec<_> = series.iter().flat_map(|s| s.points.iter().copied()).collect();
    let x = all.iter().fold(f64::MAX..f64::MIN, |r, p| r.start.min(p.0)..r.end.max(p.0));
    let lines = wide(all.iter().fold(y, |r, p| r.start.min(p.1)..r.end.max(p.1)));
    // A band may take twice the height of the lines; one that is higher still ends at the edge.
    let span = lines.end - lines.start;
    let (low, high) = (lines.start - 0.5 * span, lines.end + 0.5 * span);
    let edges = |s: &Series| -> Vec<(f64, f64, f64)> {
        let half = s.band.iter().flat_map(|b| b.half.iter().copied());
        s.points.iter().zip(half).map(|(&(x, y), d)| (x, (y - d).max(low), (y + d).min(high))).collect()
    };
    let chosen = marks.chosen.iter().map(|&(x, y)| (x, y, y));
    let y = series.iter().flat_map(edges).chain(chosen).fold(lines, |r, p| r.start.min(p.1)..r.end.max(p.2));
    let edge = 0.04 * (y.end - y.start);
    let y = y.start - edge..y.end + edge;
    let keys = keys(series);
    svg((SIZE.0, SIZE.1 + legend_height(&keys)), |root| {
        let (upper, lower) = root.split_vertically(SIZE.1);
        let mut chart = chart(titles).build_on(&upper, wide(x), y.clone())?;
        for &at in &marks.borders {
            chart.draw_series(DashedLineSeries::new([(at, y.start), (at, y.end)], 4, 4, RGBColor(90, 90, 90).into()))?;
        }
        for (s, colour) in series.iter().zip(COLOURS.iter().cycle()) {
            if s.band.is_some() {
                let (low, high): (Vec<_>, Vec<_>) = edges(s).into_iter().map(|(x, a, b)| ((x, a), (x, b))).unzip();
                let ring: Vec<_> = low.into_iter().chain(high.into_iter().rev()).collect();
                chart.draw_series([Polygon::new(ring, colour.mix(0.18))])?;
            }
            chart.draw_series(LineSeries::new(s.points.iter().copied(), colour.stroke_width(2)))?;
            if let [at] = s.points[..] {
                chart.draw_series([Circle::new(at, 3, colour.filled())])?;
            }
        }
        chart.draw_series(marks.chosen.iter().map(|&at| Circle::new(at, 5, BLACK.stroke_width(2))))?;
        legend(&lower, &keys)
    })
}

/// An axis on which something can be drawn, even where all values are the same.
fn wide(range: Range<f64>) -> Range<f64> {
    let more = if range.end > range.start { 0.0 } else { 0.5 * range.start.abs().max(1.0) };
    range.start - more..range.end + more
}

/// Outlines of histograms over the same bins, which divide `x` evenly; heights are shares of each one's sum.
pub fn histogram(titles: Titles, x: Range<f64>, counts: &[(&str, &[f64])]) -> Result<String> {
    let shares = |c: &[f64]| {
        let sum: f64 = c.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        c.iter().map(|v| v / sum).collect::<Vec<_>>()
    };
    let top = counts.iter().flat_map(|(_, c)| shares(c)).fold(0.01, f64::max);
    let keys: Vec<Key> = counts.iter().zip(COLOURS.iter().cycle()).map(|((name, _), c)| Key::new(name, Some(*c))).collect();
    svg((SIZE.0, SIZE.1 + legend_height(&keys)), |root| {
        let (upper, lower) = root.split_vertically(SIZE.1);
        let mut chart = chart(titles).build_on(&upper, x.clone(), 0.0..1.05 * top)?;
        for ((_, c), colour) in counts.iter().zip(COLOURS.iter().cycle()) {
            let width = (x.end - x.start) / c.len() as f64;
            let edge = |i: usize| x.start + width * i as f64;
            let steps: Vec<_> = shares(c).into_iter().enumerate().flat_map(|(i, s)| [(edge(i), s), (edge(i + 1), s)]).collect();
            chart.draw_series(LineSeries::new(steps, colour.stroke_width(2)))?;
        }
        legend(&lower, &keys)
    })
}

/// A map of counts: `cells` holds rows of `columns` from the lowest y up, which divide `x` and `y` evenly. The colour goes with the
/// logarithm of a cell's share of the sum, from one in 10,000 to one in 20; what is rarer stays white.
pub fn map(titles: Titles, x: Range<f64>, y: Range<f64>, columns: usize, cells: &[f64]) -> Result<String> {
    let rows = cells.len() / columns;
    let sum: f64 = cells.iter().sum();
    let (least, most) = (1e-4f64, 0.05f64);
    svg(SMALL, |root| {
        let (width, height) = ((x.end - x.start) / columns as f64, (y.end - y.start) / rows as f64);
        let corner = |i: usize, j: usize| (x.start + width * i as f64, y.start + height * j as f64);
        let mut chart = chart(titles).build_on(root, x.clone(), y.clone())?;
        let filled = cells.iter().enumerate().filter(|(_, c)| **c / sum >= least).map(|(k, c)| {
            let (i, j) = (k % columns, k / columns);
            let [r, g, b] = egogen::render::ramp(1.0 - ((c / sum / least).ln() / (most / least).ln()) as f32);
            Rectangle::new([corner(i, j), corner(i + 1, j + 1)], RGBColor(r, g, b).filled())
        });
        chart.draw_series(filled)?;
        Ok(())
    })
}

/// Ways in the plane, metres, drawn to scale on `half` metres to each side of the origin.
pub fn ways(titles: Titles, half: f64, ways: &[Vec<(f64, f64)>]) -> Result<String> {
    svg(SMALL, |root| {
        let mut chart = chart(titles).build_on(root, -half..half, -half..half)?;
        for (way, colour) in ways.iter().zip(COLOURS.iter().cycle()) {
            chart.draw_series(LineSeries::new(way.iter().copied(), colour.mix(0.7).stroke_width(1)))?;
        }
        Ok(())
    })
}

/// A chart with a mesh, on which a kind of plot draws.
struct Blank<'t> {
    titles: Titles<'t>,
}

type Chart<'a, 'b> =
    ChartContext<'b, SVGBackend<'a>, Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>>;

fn chart(titles: Titles) -> Blank {
    Blank { titles }
}

impl Blank<'_> {
    fn build_on<'a, 'b>(
        self,
        area: &'b Area<'a>,
        x: Range<f64>,
        y: Range<f64>,
    ) -> std::result::Result<Chart<'a, 'b>, DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
        let ranges = [x.clone(), y.clone()];
        let mut chart = ChartBuilder::on(area)
            .caption(self.titles.title, ("sans-serif", 15))
            .margin(6)
            .margin_right(14)
            .x_label_area_size(34)
            .y_label_area_size(48)
            .build_cartesian_2d(x, y)?;
        let [in_x, in_y] = ranges.map(|r| move |v: &f64| label(*v, r.end - r.start));
        let mut mesh = chart.configure_mesh();
        mesh.x_label_formatter(&in_x)
            .y_label_formatter(&in_y)
            .x_desc(self.titles.x)
            .y_desc(self.titles.y)
            .x_labels(5)
            .y_labels(6)
            .light_line_style(WHITE)
            .draw()?;
        Ok(chart)
    }
}

/// A number on an axis of this length: no more digits than say something.
fn label(value: f64, span: f64) -> String {
    let value = if value.abs() < 1e-6 * span { 0.0 } else { value };
    format!("{value:.5e}").parse::<f64>().map_or_else(|_| value.to_string(), |v| v.to_string())
}

/// Height of a line of a legend, of which a letter is so wide at least, in pixels.
const LINE: i32 = 16;
const LETTER: f64 = 6.3;
/// Where a legend's names begin after their marks, and the next mark after a name.
const MARK: i32 = 20;
const GAP: i32 = 12;

/// An entry of a legend: a line of this colour, or a band.
struct Key {
    name: String,
    colour: Option<RGBColor>,
}

impl Key {
    fn new(name: &str, colour: Option<RGBColor>) -> Self {
        let most = (f64::from(SIZE.0 as i32 - MARK - 2 * GAP) / LETTER) as usize;
        let short = name.chars().count() > most;
        let name = if short { name.chars().take(most - 3).chain("...".chars()).collect() } else { name.into() };
        Self { name, colour }
    }

    fn width(&self) -> i32 {
        MARK + (LETTER * self.name.chars().count() as f64).ceil() as i32
    }
}

/// The legend of lines: their names, and once what each kind of band is.
fn keys(series: &[Series]) -> Vec<Key> {
    let named = series.iter().zip(COLOURS.iter().cycle()).filter(|(s, _)| !s.name.is_empty());
    let mut keys: Vec<Key> = named.map(|(s, colour)| Key::new(&s.name, Some(*colour))).collect();
    let mut bands: Vec<&str> = series.iter().filter_map(|s| Some(s.band.as_ref()?.what)).collect();
    bands.dedup();
    keys.extend(bands.into_iter().map(|what| Key::new(what, None)));
    keys
}
/// Upper left corners of the entries of a legend, in lines as wide as the picture.
fn places(keys: &[Key]) -> Vec<(i32, i32)> {
    let mut at = (GAP, 0);
    let place = |key: &Key| {
        if at.0 > GAP && at.0 + key.width() > SIZE.0 as i32 {
            at = (GAP, at.1 + LINE);
        }
        let place = at;
        at.0 += key.width() + GAP;
        place
    };
    keys.iter().map(place).collect()
}

/// Pixels that a legend takes below the plot.
fn legend_height(keys: &[Key]) -> u32 {
    places(keys).last().map_or(0, |at| (at.1 + LINE + 4) as u32)
}

fn legend<'a>(area: &Area<'a>, keys: &[Key]) -> Drawn<'a> {
    for (key, (x, y)) in keys.iter().zip(places(keys)) {
        match key.colour {
            Some(colour) => area.draw(&PathElement::new(vec![(x, y + 6), (x + 14, y + 6)], colour.stroke_width(2)))?,
            None => area.draw(&Rectangle::new([(x, y + 1), (x + 14, y + 11)], BLACK.mix(0.18).filled()))?,
        }
        area.draw(&Text::new(key.name.as_str(), (x + MARK, y), ("sans-serif", 11)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TITLES: Titles = Titles { title: "drift", x: "primitives", y: "cm" };

    /// y of every element that is named, by what stands in its line.
    fn heights(plot: &str, element: &str) -> Vec<f64> {
        let y = |line: &str| line.split(" y=\"").nth(1)?.split('"').next()?.parse().ok();
        plot.lines().filter(|l| l.starts_with(&format!("<{element}"))).filter_map(y).collect()
    }

    #[test]
    fn legends_lie_below_the_plot() {
        let named = |name: &str| Series { name: name.into(), points: vec![(0.0, 1.0), (1.0, 2.0)], band: None };
        let height = |names: &[&str]| {
            let plot = lines(TITLES, 0.0..1.0, &names.iter().map(|n| named(n)).collect::<Vec<_>>()).unwrap();
            let low = heights(&plot, "text").iter().filter(|y| **y >= f64::from(SIZE.1)).count();
            assert_eq!(low, names.iter().filter(|n| !n.is_empty()).count(), "{plot}");
            plot.split("height=\"").nth(1).unwrap().split('"').next().unwrap().parse::<u32>().unwrap() - SIZE.1
        };
        let long = "x".repeat(200);
        assert_eq!(
            [height(&[""]), height(&["a", "b"]), height(&[&long, "b"])],
            [0, 20, 36],
            "a name that is too long has a line of its own"
        );
    }

    #[test]
    fn numbers_on_axes_are_short() {
        let labels = [(10.0, 20.0), (0.1 + 0.2, 1.0), (-1e-17, 1.0), (3e-7, 1e-6), (0.09885, 0.0004)].map(|(v, span)| label(v, span));
        assert_eq!(labels, ["10", "0.3", "0", "0.0000003", "0.09885"]);
    }

    #[test]
    fn a_wide_band_leaves_the_line_its_shape() {
        let rise = |half: f64| {
            let band = Some(Band { half: vec![half; 2], what: "" });
            let plot = lines(TITLES, 1.0..1.0, &[Series { name: String::new(), points: vec![(0.0, 1.0), (1.0, 2.0)], band }]).unwrap();
            let line = plot.lines().find(|l| l.starts_with("<polyline") && l.contains("#3464B4")).unwrap();
            let points = line.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
            let y: Vec<f64> = points.split_whitespace().map(|p| p.split(',').nth(1).unwrap().parse().unwrap()).collect();
            y[0] - y[1]
        };
        let (narrow, wide, wider) = (rise(0.0), rise(1.0), rise(100.0));
        assert!(wide == wider && (wide / narrow - 0.5).abs() < 0.02, "{narrow}, {wide}, {wider}");
    }

    #[test]
    fn plots_hold_what_they_are_given() {
        let band = Some(Band { half: vec![0.5, 0.25], what: "standard error" });
        let series = Series { name: "feet <1>".into(), points: vec![(0.0, 1.0), (1.0, 2.0)], band };
        let plot = lines(TITLES, 0.0..1.0, &[series]).unwrap();
        assert!(plot.starts_with("<svg") && ["polygon", "drift", "feet &lt;1&gt;", "standard error"].iter().all(|w| plot.contains(w)));
        let series = Series { name: String::new(), points: vec![(0.0, 1.0), (4.0, 2.0)], band: None };
        let marks = Marks { borders: vec![2.0], chosen: vec![(4.0, 2.0)] };
        let circles =
            |marks: &Marks| marked_lines(TITLES, 0.0..1.0, std::slice::from_ref(&series), marks).unwrap().matches("<circle").count();
        assert_eq!((circles(&marks), circles(&Marks::default())), (1, 0));
        let single = Series { points: vec![(1.0, 2.0)], ..series.clone() };
        assert_eq!(lines(TITLES, 0.0..1.0, &[single]).unwrap().matches("<circle").count(), 1, "a line of one point is a point");
        let plot = histogram(TITLES, -1.0..1.0, &[("a", &[1.0, 3.0]), ("b", &[0.0, 0.0])]).unwrap();
        assert!(plot.matches("<polyline").count() >= 2);
        // Two of three cells are filled.
        let count = |cells: &[f64]| map(TITLES, 0.0..3.0, 0.0..1.0, 3, cells).unwrap().matches("<rect").count();
        assert_eq!(count(&[1.0, 0.0, 2.0]) - count(&[0.0, 0.0, 0.0]), 2);
        assert!(ways(TITLES, 2.0, &[vec![(0.0, 0.0), (1.0, 1.0)]]).unwrap().contains("polyline"));
    }
}
