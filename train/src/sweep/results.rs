//! What a sweep came to: a table, and a page.

use super::plan::{Changes, Variant};
use super::{Folder, Manifest, State};
use crate::Result;
use crate::html::{Cell, Page, Picture};
use crate::plot::{Marks, Series, Titles, marked_lines};
use crate::report::{Group, curve_of};
use crate::stats::mean_and_half;
use egogen::io::write_atomic;
use std::collections::BTreeMap;

/// Settings whose curves the page shows.
const CURVES: usize = 8;
/// The column of the names of variants.
const VARIANT: &str = "variant";

/// One setting, with what its tasks came to.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    pub number: usize,
    /// The name of its variant; empty where the sweep has none.
    pub variant: String,
    pub changes: Changes,
    /// Rungs it got to, from 1, and the epochs of its last done task.
    pub rung: usize,
    pub epochs: u64,
    /// The figure of every seed that has it.
    pub values: BTreeMap<u64, f64>,
    /// Mean of those, and half its 95 % interval.
    pub mean: Option<[f64; 2]>,
    pub done: usize,
    pub tasks: usize,
}

/// The settings of a manifest, by the figure, larger first; those without one last.
pub fn ranked(manifest: &Manifest, figure: &str) -> Vec<Setting> {
    let mut settings: Vec<Setting> = Vec::new();
    for task in &manifest.tasks {
        if settings.last().is_none_or(|s| s.number != task.setting) {
            let (number, variant, changes) = (task.setting, task.variant.clone(), task.changes.clone());
            settings.push(Setting { number, variant, changes, rung: 1, epochs: 0, values: BTreeMap::new(), mean: None, done: 0, tasks: 0 });
        }
        let Some(setting) = settings.last_mut() else { continue };
        setting.tasks += 1;
        if let State::Done(done) = manifest.state(task) {
            setting.done += 1;
            setting.epochs = setting.epochs.max(done.epochs);
            setting.values.extend(done.figures.get(figure).map(|v| (task.seed, *v)));
        }
    }
    settings.iter_mut().for_each(|s| s.mean = mean_and_half(&s.values.values().copied().collect::<Vec<_>>()));
    settings.sort_by(|a, b| {
        let value = |s: &Setting| s.mean.map_or(f64::NEG_INFINITY, |m| m[0]);
        value(b).total_cmp(&value(a)).then(a.number.cmp(&b.number))
    });
    settings
}

impl Setting {
    /// Mean of the figure less that of another setting on the seeds that both have, and half its 95 % interval.
    fn less(&self, other: &Self) -> Option<[f64; 2]> {
        let differences: Vec<f64> = self.values.iter().filter_map(|(seed, v)| Some(v - other.values.get(seed)?)).collect();
        mean_and_half(&differences)
    }

    /// What the setting has in a column of the table: the name of its variant, or the value of a key.
    fn cell(&self, column: &str) -> String {
        if column == VARIANT { self.variant.clone() } else { self.changes.get(column).map_or(String::new(), |v| v.to_string()) }
    }
}

impl Folder<'_> {
    /// Columns that tell settings apart.
    fn columns(&self) -> Vec<&str> {
        let names = if self.sweep.variants.is_empty() { None } else { Some(VARIANT) };
        names.into_iter().chain(self.sweep.keys()).collect()
    }

    /// Every setting where it got to: those of the last rung first, by the figure.
    pub fn settings(&self) -> Result<Vec<Setting>> {
        let mut all: Vec<Setting> = Vec::new();
        for (rung, manifest) in self.manifests()?.iter().enumerate().rev() {
            let new: Vec<Setting> =
                ranked(manifest, &self.sweep.figure).into_iter().filter(|s| all.iter().all(|a| a.number != s.number)).collect();
            all.extend(new.into_iter().map(|s| Setting { rung: rung + 1, ..s }));
        }
        Ok(all)
    }

    /// Writes `table.csv` and `sweep.html`; gives the table.
    pub fn sum_up(&self) -> Result<String> {
        let settings = self.settings()?;
        let keys = self.columns();
        let number = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.4}"));
        let mut table = String::from("setting,rung,epochs");
        keys.iter().for_each(|key| table += &format!(",{key}"));
        table += &format!(",{},half95,done,tasks\n", self.sweep.figure);
        for s in &settings {
            table += &format!("{},{},{}", s.number, s.rung, s.epochs);
            keys.iter().for_each(|key| table += &format!(",{}", quoted(&s.cell(key))));
            let [mean, half] = [0, 1].map(|k| number(s.mean.map(|m| m[k])));
            table += &format!(",{mean},{half},{},{}\n", s.done, s.tasks);
        }
        write_atomic(self.dir.join("table.csv"), table.as_bytes())?;
        write_atomic(self.dir.join("sweep.html"), self.page(&settings, &keys)?.as_bytes())?;
        Ok(table)
    }

    fn page(&self, settings: &[Setting], keys: &[&str]) -> Result<String> {
        let figure = &self.sweep.figure;
        let mut page = Page::new("Sweep");
        page.text(&format!(
            "{} settings of the recipe {}, each with {} seeds; by {figure} at the end: mean over seeds, and its 95 % interval (Student's \
             t). The best comes first; \"less the best\" is the mean difference on the same seeds. Where rungs differ, later ones come first.",
            self.sweep.settings().len(),
            self.sweep.recipe,
            self.sweep.seeds.len()
        ));
        let heads: Vec<&str> = ["setting"]
            .into_iter()
            .chain(keys.iter().copied())
            .chain([figure.as_str(), "less the best", "epochs", "rung", "done"])
            .collect();
        let best = settings.first().filter(|s| s.mean.is_some());
        let with_half = |mean: Option<[f64; 2]>, seeds: usize| match mean {
            Some([mean, half]) => {
                Cell::from(format!("{mean:.4}")).note(if seeds > 1 { format!("± {half:.4}") } else { "one seed".into() })
            }
            None => "-".into(),
        };
        let row = |s: &Setting| {
            let is_best = best.is_some_and(|b| b.number == s.number);
            let number = format!("{:03}", s.number);
            let mut row = vec![if is_best { Cell::verdict(number, true).note("best") } else { number.into() }];
            row.extend(keys.iter().map(|key| Cell::words(s.cell(key))));
            let less = best.filter(|b| !is_best && b.rung == s.rung).and_then(|b| s.less(b));
            row.extend([with_half(s.mean, s.values.len()), with_half(less, s.values.len())]);
            row.extend([Cell::from(s.epochs.to_string()), s.rung.to_string().into()]);
            row.push(Cell::verdict(format!("{} of {}", s.done, s.tasks), s.done == s.tasks));
            row
        };
        page.table(&heads, &settings.iter().map(row).collect::<Vec<_>>());
        if !self.sweep.variants.is_empty() {
            page.section("Variants");
            let sets = |changes: Changes| changes.iter().map(|(key, value)| format!("{key} = {value}")).collect::<Vec<_>>().join(", ");
            let row = |v: &Variant| {
                vec![Cell::from(v.name.as_str()), Cell::words(if v.set.is_empty() { "nothing".into() } else { sets(v.changes()) })]
            };
            page.table(&["variant", "sets"], &self.sweep.variants.iter().map(row).collect::<Vec<_>>());
        }
        self.curves(&mut page, settings)?;
        let manifests = self.manifests()?;
        let states = manifests.iter().flat_map(|m| m.tasks.iter().map(|t| (&t.id, m.state(t))));
        let failed: Vec<Vec<Cell>> = states
            .filter_map(|(id, s)| if let State::Failed(why) = s { Some(vec![id.as_str().into(), Cell::words(why)]) } else { None })
            .collect();
        if !failed.is_empty() {
            page.section("Failed tasks");
            page.text("They are tried again when the sweep is run again.");
            page.table(&["task", "why"], &failed);
        }
        Ok(page.finish())
    }

    /// The figure over epochs of the first settings.
    fn curves(&self, page: &mut Page, settings: &[Setting]) -> Result<()> {
        let figure = &self.sweep.figure;
        let folder = |s: &Setting| self.dir.join(format!("settings/{:03}", s.number));
        let mut series = Vec::new();
        for s in settings.iter().take(CURVES).filter(|s| s.done > 0) {
            let curve = curve_of(&Group::read(&folder(s))?, figure);
            series.push(Series { name: format!("{:03} {}", s.number, s.variant).trim_end().into(), ..curve });
        }
        series.retain(|s| !s.points.is_empty());
        let Some(&(_, first)) = series.first().and_then(|s| s.points.first()) else { return Ok(()) };
        page.section("The first settings over epochs");
        let plot = marked_lines(Titles { title: figure, x: "epoch", y: "" }, first..first, &series, &Marks::default())?;
        page.figures(&[(Picture::Svg(plot), "Mean over seeds. More of a setting: train report settings/NNN.")]);
        Ok(())
    }
}

/// A cell of a CSV file.
fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.into(),
    }
}
