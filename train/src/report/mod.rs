//! The report on training as one HTML page: curves over seeds, rewards, losses, time, stages, selection, and the chosen policy at work.

mod films;
mod runs;

pub use runs::{Group, Run, Stage};

use crate::Result;
use crate::evaluate::Estimate;
use crate::html::{Cell, Page, Picture};
use crate::plot::{Marks, Series, Titles, marked_lines};
use crate::registry::Registry;
use crate::select::{Entry, Quality, Round, Selection};
use runs::From;

/// Figures of episodes that have a panel: title, unit, name under `train/`, `test_sto/` and `test_det/`.
const FIGURES: [(&str, &str, &str); 7] = [
    ("return", "", "return"),
    ("success rate", "", "success"),
    ("hover rate", "", "hover"),
    ("rate of ends by penetration", "", "penetration"),
    ("vertices inside per frame", "", "inside"),
    ("final distance to the goal", "m", "final_dist"),
    ("length of an episode", "steps", "length"),
];
/// How episodes are played: prefix of the columns, and what it is called.
const WAYS: [(&str, &str); 3] = [("test_det", "test, mean action"), ("train", "training"), ("test_sto", "test, with noise")];

/// The page; `command` is what made it, `starts` how many starts the chosen policies are filmed on.
pub fn page(groups: &[Group], registry: &Registry, starts: usize, command: &str) -> Result<String> {
    let mut page = Page::new("Training report");
    page.code(command);
    overview(&mut page, groups);
    let panels = Panels { groups };
    page.section("Learning");
    page.text(&format!(
        "Over epochs. {}Where a folder holds several seeds, a line is their mean and the band its 95 % interval (Student's t). \
         Dashed: borders between stages. Rings: the policies that were chosen.",
        stages_text(groups)
    ));
    let mut learning = vec![];
    for (title, unit, name) in FIGURES {
        let ways = WAYS.map(|(prefix, way)| (format!("{prefix}/{name}"), way));
        learning.extend(panels.draw(title, unit, From::Metrics, &ways)?);
    }
    let kl = "KL of actions to N(0, I)";
    learning.extend(panels.draw(kl, "nats per dimension", From::Metrics, &[("loss/kl_prior".to_string(), "training")])?);
    figures(&mut page, learning);
    for (title, prefix, from) in [
        ("Reward terms, weighted, mean over steps", "step/", From::Metrics),
        ("Curricula: which value", "curriculum/", From::Metrics),
        ("Losses", "loss/", From::Metrics),
        ("Time", "", From::Timing),
    ] {
        let drawn = panels.all(prefix, from)?;
        if !drawn.is_empty() {
            page.section(title);
            figures(&mut page, drawn);
        }
    }
    for run in groups.iter().flat_map(|g| &g.runs) {
        for stage in &run.stages {
            if let Some(selection) = &stage.selection {
                page.section(&format!("Selection: {}", title_of(run, stage)));
                selected(&mut page, selection)?;
            }
        }
    }
    for run in groups.iter().flat_map(|g| &g.runs) {
        filmed(&mut page, run, registry, starts)?;
    }
    Ok(page.finish())
}

/// A column of metrics.csv over epochs, called as the group is: mean over its runs, with intervals.
pub fn curve_of(group: &Group, column: &str) -> Series {
    group.curve(&group.name, From::Metrics, column)
}

fn title_of(run: &Run, stage: &Stage) -> String {
    if stage.name.is_empty() { run.name.clone() } else { format!("{}, stage {}", run.name, stage.name) }
}

/// Which stages there are and where they begin.
fn stages_text(groups: &[Group]) -> String {
    let staged = groups.iter().filter(|g| g.stage_names().len() > 1);
    let text = |g: &Group| {
        let borders = g.borders();
        let stages = g.stage_names().into_iter().zip(borders.windows(2));
        let each: Vec<String> = stages.map(|(name, ends)| format!("{name} in epochs {} to {}", ends[0] + 1.0, ends[1])).collect();
        format!("Stages of {}: {}. ", g.name, each.join(", "))
    };
    staged.map(text).collect()
}

fn overview(page: &mut Page, groups: &[Group]) {
    page.section("Runs");
    let heads = ["run", "stage", "seed", "epochs", "steps, thousand", "hours", "chosen epoch", "test return", "test success", "KL"];
    let mut rows: Vec<Vec<Cell>> = Vec::new();
    for run in groups.iter().flat_map(|g| &g.runs) {
        for (k, stage) in run.stages.iter().enumerate() {
            let (first, (epochs, steps, hours)) = (k == 0, run.effort());
            let once = |text: String| Cell::from(if first { text } else { String::new() });
            let chosen = stage.chosen();
            let row = chosen.and_then(|e| usize::try_from(e).ok()?.checked_sub(1));
            let at = |name: &str| Cell::from(row.and_then(|row| stage.metrics.get(name, row)).map_or("-".into(), |v| format!("{v:.3}")));
            rows.push(vec![
                once(run.name.clone()).note(if first { run.dir.display().to_string() } else { String::new() }),
                stage.name.as_str().into(),
                once(run.seed.to_string()),
                Cell::from(stage.metrics.rows().to_string()).note(if first { format!("of {epochs}") } else { String::new() }),
                once(format!("{:.0}", steps / 1000.0)),
                once(format!("{hours:.2}")),
                chosen.map_or("not at its end".into(), |e| e.to_string()).into(),
                at("test_det/return"),
                at("test_det/success"),
                at("loss/kl_prior"),
            ]);
        }
    }
    page.table(&heads, &rows);
    page.text("Figures are those of the chosen epoch's row of metrics.csv: tests with the mean action, KL while training.");
}

/// Draws columns of all groups.
struct Panels<'a> {
    groups: &'a [Group],
}

impl Panels<'_> {
    /// One panel of some columns, each with what it is called; nothing where there are no values.
    fn draw(&self, title: &str, y: &str, from: From, columns: &[(String, &str)]) -> Result<Option<Picture>> {
        let several = self.groups.len() > 1;
        // Of several groups only the first column that any of them has, so that lines can be told apart.
        let has = |column: &str| self.groups.iter().any(|g| !g.curve("", from, column).points.is_empty());
        let present: Vec<&(String, &str)> = columns.iter().filter(|(c, _)| has(c)).take(if several { 1 } else { 3 }).collect();
        let Some((main, way)) = present.first() else { return Ok(None) };
        let mut marks = Marks::default();
        for group in self.groups {
            let own = group.marks(main);
            marks.borders.extend(own.borders);
            marks.chosen.extend(own.chosen);
        }
        let mut series = Vec::new();
        for group in self.groups {
            for (column, way) in &present {
                series.push(group.curve(if several { &group.name } else { way }, from, column));
            }
        }
        series.retain(|s| !s.points.is_empty());
        let title = if several && !way.is_empty() { format!("{title} ({way})") } else { title.to_string() };
        let first = series[0].points[0].1;
        Ok(Some(Picture::Svg(marked_lines(Titles { title: &title, x: "epoch", y }, first..first, &series, &marks)?)))
    }

    /// A panel for every column under `prefix`.
    fn all(&self, prefix: &str, from: From) -> Result<Vec<Picture>> {
        let mut names: Vec<&String> = Vec::new();
        for stage in self.groups.iter().flat_map(|g| &g.runs).flat_map(|r| &r.stages) {
            let table = if from == From::Metrics { &stage.metrics } else { &stage.timing };
            let new: Vec<_> = table.names.iter().filter(|n| n.starts_with(prefix) && !names.contains(n)).collect();
            names.extend(new);
        }
        let panels = names.into_iter().map(|n| self.draw(&n[prefix.len()..], "", from, &[(n.clone(), "")]));
        Ok(panels.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect())
    }
}

fn figures(page: &mut Page, drawn: impl IntoIterator<Item = Picture>) {
    let all: Vec<(Picture, &str)> = drawn.into_iter().map(|p| (p, "")).collect();
    page.figures(&all);
}

/// The table of candidates and the reasons.
fn selected(page: &mut Page, selection: &Selection) -> Result<()> {
    page.text(&format!("Chosen: epoch {}: {}.", selection.epoch, selection.why));
    let r = &selection.rule;
    page.text(&format!(
        "Admitted: return at least {} of the best, success below the best by at most {} standard errors of the paired difference, ||VP|| \
         and bone error at most {} above those of actions from N(0, I). The smallest divergence wins, then the earliest epoch.",
        r.return_share, r.success_errors, r.quality
    ));
    let mut pictures = vec![];
    for (title, y, of) in PANELS {
        let points: Vec<(f64, f64)> = (selection.candidates.entries.iter()).filter_map(|e| Some((e.epoch as f64, of(e)?.value))).collect();
        let Some(&(_, first)) = points.first() else { continue };
        let chosen = points.iter().filter(|p| p.0 == selection.epoch as f64).copied().collect();
        let series = Series { name: String::new(), points, band: None };
        let marks = Marks { borders: vec![], chosen };
        pictures.push(Picture::Svg(marked_lines(Titles { title, x: "epoch of the candidate", y }, first..first, &[series], &marks)?));
    }
    figures(page, pictures);
    for (name, round) in [("Candidates", &selection.candidates), ("Finalists", &selection.finalists)] {
        rounds(page, name, round, selection.prior, selection.epoch);
    }
    Ok(())
}

type Of = fn(&Entry) -> Option<Estimate>;

/// Figures of selection over epochs: title, unit, value.
const PANELS: [(&str, &str, Of); 4] = [
    ("return", "", |e| Some(e.figures.reward)),
    ("success rate", "", |e| e.figures.success),
    ("hover rate", "", |e| e.figures.hover),
    ("KL to N(0, I)", "nats per dimension", |e| e.figures.kl),
];

fn rounds(page: &mut Page, name: &str, round: &Round, prior: Option<Quality>, chosen: u64) {
    let left_out = match round.left_out.len() {
        0 => String::new(),
        _ => format!(" Left out, as nobody would have been admitted: {}.", round.left_out.join(", ")),
    };
    page.text(&format!("{name}, each on the same {} starts (seed {}).{left_out}", round.starts, round.seed));
    let heads = ["epoch", "return", "success", "hover", "KL", "0.5 mean mu^2", "||VP||", "bone error, mm", "place", ""];
    let shown = |e: Option<Estimate>| match e {
        Some(e) => Cell::from(format!("{:.3}", e.value)).note(format!("{:.3} to {:.3}", e.low, e.high)),
        None => "-".into(),
    };
    let quality = |q: Option<Quality>| {
        [q.map(|q| q.pose_norm), q.map(|q| q.bone_error_mm)].map(|v| Cell::from(v.map_or("-".into(), |v| format!("{v:.2}"))))
    };
    let row = |e: &Entry| {
        let f = &e.figures;
        let epoch = Cell::from(e.epoch.to_string()).note(if e.epoch == chosen { "chosen" } else { "" });
        let [pose, bones] = quality(f.quality);
        let place = match e.place {
            Some(place) => Cell::verdict(place.to_string(), true),
            None => Cell::verdict("out", false),
        };
        let figures = [Some(f.reward), f.success, f.hover, f.kl, f.kl_mean].map(shown);
        [vec![epoch], figures.to_vec(), vec![pose, bones, place, Cell::words(e.reasons.join("; "))]].concat()
    };
    let mut rows: Vec<Vec<Cell>> = round.entries.iter().map(row).collect();
    if prior.is_some() {
        let [pose, bones] = quality(prior);
        let dashes = vec![Cell::from("-"); 5];
        rows.push([vec!["N(0, I)".into()], dashes, vec![pose, bones, "".into(), "".into()]].concat());
    }
    page.table(&heads, &rows);
}

/// The chosen policy of a run's last stage.
fn filmed(page: &mut Page, run: &Run, registry: &Registry, starts: usize) -> Result<()> {
    let Some(stage) = run.stages.last().filter(|s| starts > 0 && s.chosen().is_some()) else { return Ok(()) };
    let pictures = films::films(stage, registry, starts)?;
    if !pictures.is_empty() {
        page.section(&format!("The chosen policy: {}", title_of(run, stage)));
        let each: Vec<(Picture, &str)> = pictures.iter().map(|(p, caption)| (p.clone(), caption.as_str())).collect();
        page.figures(&each);
    }
    Ok(())
}
