//! The report as a page.

use super::coverage::{BINS, FORWARD, SIDEWAYS, TURN};
use super::{Coverage, FIGURES, Measured, Pictures, Report};
use crate::Result;
use crate::evaluate::Estimate;
use crate::html::{Cell, Page, Picture};
use crate::plot::{Band, Series, Titles, histogram, lines, map, ways};
use crate::primitives::export::strip;
use egogen::body::BodyModel;

/// Panels of a filmstrip, and how wide each is, pixels.
const PANELS: usize = 8;
const PANEL: usize = 140;
/// Half the width of the plans of ways, metres.
const PLAN: f64 = 6.0;
/// What bands show.
const DEVIATION: &str = "standard deviation";

/// The page; `command` is what made it.
pub fn page(report: &Report, pictures: &Pictures, body: &BodyModel, command: &str) -> Result<String> {
    let mut page = Page::new("Motion model report");
    page.text(&format!("Motion model {} on body {}.", report.model, report.body));
    page.code(command);
    if !report.recordings {
        page.warning(
            "Made without recordings: only the model is measured, from its own seed motions; there is nothing to compare it with.",
        );
    }
    summary(&mut page, report);
    measured(&mut page, report);
    drift(&mut page, report)?;
    reconstruction(&mut page, report);
    diversity(&mut page, report);
    coverage(&mut page, report)?;
    plans(&mut page, pictures)?;
    page.section("Filmstrips");
    page.text("People of the roll-outs and recordings, picked by their number: 8 moments of up to 5 seconds each.");
    let strips = pictures
        .films
        .iter()
        .map(|f| Ok((Picture::Png(strip(&f.frames, body, PANELS, PANEL)?.png()?), f.caption.as_str())))
        .collect::<Result<Vec<_>>>()?;
    page.figures(&strips);
    Ok(page.finish())
}

fn summary(page: &mut Page, report: &Report) {
    page.section("Aims");
    let row = |a: &super::Aim| {
        let value = a.value.map_or("-".into(), |v| format!("{v:.3}"));
        let verdict = match a.met {
            Some(met) => Cell::verdict(if met { "met" } else { "missed" }, met),
            None => "-".into(),
        };
        vec![a.name.as_str().into(), value.into(), format!("{}", a.limit).into(), verdict]
    };
    page.table(&["aim", "value", "at most", ""], &report.aims.iter().map(row).collect::<Vec<_>>());
}

fn shown(e: Option<Estimate>, digits: usize) -> Cell {
    match e {
        Some(e) => Cell::from(format!("{:.digits$}", e.value)).note(format!("{:.digits$} to {:.digits$}", e.low, e.high)),
        None => "-".into(),
    }
}

fn measured(page: &mut Page, report: &Report) {
    page.section("Motion");
    let e = report.effort;
    page.text(&format!(
        "Every figure of every column is made by the same function from the markers, joints and poses of whole bodies at 40 frames per \
         second. The model's column is {} people who are led by latents from N(0, I) for {} primitives of 0.45 s. Below a figure its 95 % \
         bootstrap interval, over people, or over recordings with all their variations. A seam is where a primitive joins the one before.",
        e.people, e.primitives
    ));
    let name = |m: &Measured| m.name.clone();
    let heads: Vec<String> = std::iter::once("figure".into()).chain(report.motions.iter().map(name)).collect();
    let of = |text: &dyn Fn(&Measured) -> String| report.motions.iter().map(|m| Cell::from(text(m))).collect::<Vec<_>>();
    let mut rows = vec![[vec!["motions".into()], of(&|m| m.clips.to_string())].concat()];
    rows.push([vec!["seconds".into()], of(&|m| format!("{:.0}", m.seconds))].concat());
    rows.extend(FIGURES.iter().map(|f| {
        let label = if f.unit.is_empty() { f.label.to_string() } else { format!("{}, {}", f.label, f.unit) };
        let value = |m: &Measured| shown(m.figures.get(f.key).copied().flatten(), f.digits);
        [vec![Cell::words(label).note(f.meaning)], report.motions.iter().map(value).collect()].concat()
    }));
    page.table(&heads.iter().map(String::as_str).collect::<Vec<_>>(), &rows);
}

fn drift(page: &mut Page, report: &Report) -> Result<()> {
    page.section("Drift");
    page.text(
        "The same roll-outs at the end of some primitives; plus-minus is the standard deviation over people. Bone error: distances \
         between predicted markers of one bone against the body's. Collapsed: a pelvis below 0.5 or above 1.5 m, feet more than 0.2 m \
         under or 0.25 m above the floor, a head less than 0.25 m above the pelvis, or bone errors above 5 cm, at the end of any primitive \
         so far.",
    );
    let heads =
        ["primitives", "lowest foot marker, cm", "pelvis, m", "bone error, mm", "predicted against body's markers, mm", "collapsed, %"];
    let rows: Vec<Vec<Cell>> = (report.drift.iter())
        .map(|d| {
            vec![
                d.primitive.to_string().into(),
                format!("{:.2} ± {:.2}", d.foot[0], d.foot[1]).into(),
                format!("{:.3} ± {:.3}", d.pelvis[0], d.pelvis[1]).into(),
                format!("{:.1}", d.shape).into(),
                format!("{:.1}", d.regression).into(),
                Cell::verdict(format!("{:.1}", 100.0 * d.collapsed), d.collapsed == 0.0),
            ]
        })
        .collect();
    page.table(&heads, &rows);
    if !report.collapsed.is_empty() {
        let reasons: Vec<String> = report.collapsed.iter().map(|(why, n)| format!("{n} by {why}")).collect();
        page.warning(&format!("People who collapsed, by the first reason: {}.", reasons.join(", ")));
    }
    let series = |what: &'static str, of: &dyn Fn(&super::Drift) -> [f32; 2]| Series {
        name: "mean".into(),
        points: report.drift.iter().map(|d| (d.primitive as f64, f64::from(of(d)[0]))).collect(),
        band: (!what.is_empty()).then(|| Band { half: report.drift.iter().map(|d| f64::from(of(d)[1])).collect(), what }),
    };
    let plot = |title: &str, y: &str, range, s: Series| lines(Titles { title, x: "primitives", y }, range, &[s]);
    let feet = plot("lowest foot marker", "cm", 0.0..5.0, series(DEVIATION, &|d| d.foot))?;
    let pelvis = plot("height of the pelvis", "m", 0.75..1.0, series(DEVIATION, &|d| d.pelvis))?;
    let bones = plot("bone error", "mm", 0.0..6.0, series("", &|d| [d.shape, 0.0]))?;
    page.figures(&[(Picture::Svg(feet), ""), (Picture::Svg(pelvis), ""), (Picture::Svg(bones), "")]);
    Ok(())
}

fn reconstruction(page: &mut Page, report: &Report) {
    let Some(r) = &report.reconstruction else { return };
    page.section("Reconstruction of held-out recordings");
    let h = &r.all;
    page.text(&format!(
        "Mean distance per marker from the recording, mm, with the encoder's mean latent, over all windows of 20 frames that start every 5 \
         frames. With a latent of zero the distance is {:.1}, with one from the prior {:.1}; the markers of bodies fitted to the true \
         markers are {:.1} off, of those fitted to the reconstructed ones {:.1}. {} of 128 latent dimensions are active (their mean \
         varies by more than 0.01); the posterior is {:.1} nats from the prior.",
        h.zero, h.prior, h.reskinned, h.reskinned_posterior, h.active, h.nats
    ));
    let mm = |v: f32| Cell::from(format!("{v:.1}"));
    let mut rows: Vec<Vec<Cell>> =
        r.clips.iter().map(|c| vec![c.clip.as_str().into(), c.windows.to_string().into(), mm(c.mean), mm(c.last)]).collect();
    rows.push(vec!["all".into(), h.windows.to_string().into(), mm(h.posterior[0]), mm(h.posterior[1])]);
    page.table(&["recording", "windows", "18 frames, mm", "last frame, mm"], &rows);
}

fn diversity(page: &mut Page, report: &Report) {
    page.section("Diversity");
    page.text(
        "Average pairwise distance: the mean over all pairs of 16 continuations of one beginning of the mean distance between \
         corresponding markers, mm; mean over 100 beginnings (or one per person, if these are fewer). The model continues one and the same beginning. In recordings the \
         continuations are those of the 16 windows from other recordings (one each) that begin most alike; how far these beginnings are \
         apart is given beside.",
    );
    let row = |d: &super::Diversity| vec![d.name.as_str().into(), shown(d.frames, 1), shown(d.last, 1), shown(d.beginnings, 1)];
    page.table(&["", "18 frames, mm", "last frame, mm", "beginnings, mm"], &report.diversity.iter().map(row).collect::<Vec<_>>());
}

fn coverage(page: &mut Page, report: &Report) -> Result<()> {
    page.section("Coverage");
    page.text(
        "Speeds and turn over one primitive, in the frame of the hips at its start: 1 / 5 / 50 / 95 / 99 %. Standing still: less than \
         0.1 m/s and 10 degrees. The model's single primitives start where the training set's do. Overlap: common area with the training \
         set's maps below, forward speed against sideways speed or turn, 1 for the same.",
    );
    let five = |v: [f32; 5], digits: usize| Cell::from(v.map(|x| format!("{x:.digits$}")).join(" / "));
    let row = |c: &Coverage| {
        let overlap = c.overlap.map_or(["-".to_string(), "-".to_string()], |o| o.map(|x| format!("{x:.2}")));
        let [a, b] = overlap.map(Cell::from);
        let still = format!("{:.1}", 100.0 * c.still);
        let count = c.primitives.to_string();
        vec![c.name.as_str().into(), count.into(), five(c.forward, 2), five(c.sideways, 2), five(c.turn, 0), still.into(), a, b]
    };
    let heads = [
        "",
        "primitives",
        "forward, m/s",
        "to the right, m/s",
        "turn to the left, degrees",
        "standing, %",
        "overlap, sideways",
        "overlap, turn",
    ];
    page.table(&heads, &report.coverage.iter().map(row).collect::<Vec<_>>());
    // The held-out recordings are too few for a histogram.
    let drawn: Vec<&Coverage> = report.coverage.iter().filter(|c| c.name != "held out").collect();
    let one = |title: &str, x: &str, range, of: fn(&Coverage) -> &[f64]| {
        let counts: Vec<(&str, &[f64])> = drawn.iter().map(|c| (c.name.as_str(), of(c))).collect();
        Ok((Picture::Svg(histogram(Titles { title, x, y: "share" }, range, &counts)?), ""))
    };
    let plain: Result<Vec<_>> = [
        one("forward speed", "m/s", FORWARD, |c| &c.histograms.forward),
        one("sideways speed, to the right", "m/s", SIDEWAYS, |c| &c.histograms.sideways),
        one("turn in a primitive, to the left", "degrees", TURN, |c| &c.histograms.turn),
    ]
    .into_iter()
    .collect();
    page.figures(&plain?);
    page.text("Maps of the same, from yellow (rare, 1 in 10,000) to dark (1 in 20 and more).");
    let two = |c: &&Coverage, y: &str, range, cells: &[f64]| {
        let titles = Titles { title: &c.name, x: "forward, m/s", y };
        Ok((Picture::Svg(map(titles, FORWARD, range, BINS, cells)?), ""))
    };
    let sideways: Result<Vec<_>> = drawn.iter().map(|c| two(c, "to the right, m/s", SIDEWAYS, &c.histograms.forward_sideways)).collect();
    let turns: Result<Vec<_>> = drawn.iter().map(|c| two(c, "turn to the left, degrees", TURN, &c.histograms.forward_turn)).collect();
    page.figures(&sideways?);
    page.figures(&turns?);
    Ok(())
}

/// Where people go, seen from above.
fn plans(page: &mut Page, pictures: &Pictures) -> Result<()> {
    page.text("Ways of up to 40 motions of at most 5 seconds from above; all start in the middle and face up.");
    let plan = |(name, each): &(String, Vec<super::Way>)| {
        let titles = Titles { title: name, x: "to the right, m", y: "ahead, m" };
        Ok((Picture::Svg(ways(titles, PLAN, each)?), ""))
    };
    page.figures(&pictures.ways.iter().map(plan).collect::<Result<Vec<_>>>()?);
    Ok(())
}
