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
    /// Half the height of the band around each point; empty for none.
    pub spread: Vec<f64>,
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
    let band = |s: &Series| {
        let half = s.spread.iter().copied().chain(std::iter::repeat(0.0));
        s.points.iter().zip(half).map(|(&(x, y), d)| (x, y - d, y + d)).collect::<Vec<_>>()
    };
    let all: Vec<_> = series.iter().flat_map(band).collect();
    let x = all.iter().fold(f64::MAX..f64::MIN, |r, p| r.start.min(p.0)..r.end.max(p.0));
    let y = wide(all.iter().fold(y, |r, p| r.start.min(p.1)..r.end.max(p.2)));
    svg(SIZE, |root| {
        let mut chart = chart(titles).build_on(root, wide(x), y.clone())?;
        for &at in &marks.borders {
            chart.draw_series(DashedLineSeries::new([(at, y.start), (at, y.end)], 4, 4, RGBColor(90, 90, 90).into()))?;
        }
        for (s, colour) in series.iter().zip(COLOURS.iter().cycle()) {
            if !s.spread.is_empty() {
                let (low, high): (Vec<_>, Vec<_>) = band(s).into_iter().map(|(x, a, b)| ((x, a), (x, b))).unzip();
                let ring: Vec<_> = low.into_iter().chain(high.into_iter().rev()).collect();
                chart.draw_series([Polygon::new(ring, colour.mix(0.18))])?;
            }
            let line = chart.draw_series(LineSeries::new(s.points.iter().copied(), colour.stroke_width(2)))?;
            if !s.name.is_empty() {
                named(line, &s.name, *colour);
            }
        }
        chart.draw_series(marks.chosen.iter().map(|&at| Circle::new(at, 5, BLACK.stroke_width(2))))?;
        legend(&mut chart)
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
    // Room for the legend.
    let top = top * (1.1 + 0.09 * counts.len() as f64);
    svg(SIZE, |root| {
        let mut chart = chart(titles).build_on(root, x.clone(), 0.0..top)?;
        for ((name, c), colour) in counts.iter().zip(COLOURS.iter().cycle()) {
            let width = (x.end - x.start) / c.len() as f64;
            let edge = |i: usize| x.start + width * i as f64;
            let steps: Vec<_> = shares(c).into_iter().enumerate().flat_map(|(i, s)| [(edge(i), s), (edge(i + 1), s)]).collect();
            named(chart.draw_series(LineSeries::new(steps, colour.stroke_width(2)))?, name, *colour);
        }
        legend(&mut chart)
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
        let mut chart = ChartBuilder::on(area)
            .caption(self.titles.title, ("sans-serif", 15))
            .margin(6)
            .margin_right(14)
            .x_label_area_size(34)
            .y_label_area_size(48)
            .build_cartesian_2d(x, y)?;
        chart.configure_mesh().x_desc(self.titles.x).y_desc(self.titles.y).x_labels(5).y_labels(6).light_line_style(WHITE).draw()?;
        Ok(chart)
    }
}

fn named<'a>(series: &mut plotters::chart::SeriesAnno<'a, SVGBackend<'_>>, name: &str, colour: RGBColor) {
    series.label(name).legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 14, y)], colour.stroke_width(2)));
}

fn legend<'a: 'b, 'b>(chart: &mut Chart<'a, 'b>) -> Drawn<'a> {
    let mut labels = chart.configure_series_labels();
    labels.position(SeriesLabelPosition::UpperRight).label_font(("sans-serif", 12)).background_style(WHITE.mix(0.8)).draw()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TITLES: Titles = Titles { title: "drift", x: "primitives", y: "cm" };

    #[test]
    fn plots_hold_what_they_are_given() {
        let series = Series { name: "feet <1>".into(), points: vec![(0.0, 1.0), (1.0, 2.0)], spread: vec![0.5, 0.25] };
        let plot = lines(TITLES, 0.0..1.0, &[series]).unwrap();
        assert!(plot.starts_with("<svg") && plot.contains("polygon") && plot.contains("drift") && plot.contains("feet &lt;1&gt;"));
        let series = Series { name: String::new(), points: vec![(0.0, 1.0), (4.0, 2.0)], spread: vec![] };
        let marks = Marks { borders: vec![2.0], chosen: vec![(4.0, 2.0)] };
        let circles =
            |marks: &Marks| marked_lines(TITLES, 0.0..1.0, std::slice::from_ref(&series), marks).unwrap().matches("<circle").count();
        assert_eq!((circles(&marks), circles(&Marks::default())), (1, 0));
        let plot = histogram(TITLES, -1.0..1.0, &[("a", &[1.0, 3.0]), ("b", &[0.0, 0.0])]).unwrap();
        assert!(plot.matches("<polyline").count() >= 2);
        // Two of three cells are filled.
        let count = |cells: &[f64]| map(TITLES, 0.0..3.0, 0.0..1.0, 3, cells).unwrap().matches("<rect").count();
        assert_eq!(count(&[1.0, 0.0, 2.0]) - count(&[0.0, 0.0, 0.0]), 2);
        assert!(ways(TITLES, 2.0, &[vec![(0.0, 0.0), (1.0, 1.0)]]).unwrap().contains("polyline"));
    }
}
