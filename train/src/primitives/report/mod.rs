//! The report on a motion model: its samples and its reconstructions beside recorded motion, measured by the same functions.

mod command;
mod coverage;
mod diversity;
mod measure;
mod page;
mod roll;

pub use command::Command;
pub use coverage::{Coverage, Histograms};
pub use diversity::Diversity;
pub use measure::{FIGURES, Figure, Measured, family};
pub use page::page;

use super::eval::{HeldOut, judge_held_out};
use super::gait::{Drift, draw_starts};
use crate::Result;
use egogen::body::{BETAS, PARAMS, ShapedBody};
use egogen::motion::clip::Skeleton;
use egogen::motion::{FRAMES, MotionSet, MotionWeights, PosePrior};
use egogen::sim::{SeedBank, SeedMotion, Sim};
use measure::Ruler;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// Version of report.json.
const FORMAT: u32 = 1;
/// Beginnings per person of a roll-out from which one primitive is sampled to see where people go.
const FIRST_STEPS: usize = 10;
/// Frames of a film: 11 primitives.
const FILM: usize = 200;
/// Recordings shorter than this are not filmed, frames.
const SHORTEST: usize = 100;
/// Films of the model, and of each kind of recording; ways in a plan.
const FILMS: [usize; 2] = [4, 2];
const WAYS: usize = 40;

/// How much is rolled out.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Effort {
    pub people: usize,
    pub primitives: usize,
    pub seed: u64,
}

/// Recordings to compare with.
pub struct Data {
    /// What the model was trained on.
    pub train: MotionSet,
    /// Recordings kept from training.
    pub held_out: MotionSet,
}

/// The whole report.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    pub format: u32,
    /// Content hashes.
    pub model: String,
    pub body: String,
    pub pose_prior: String,
    pub effort: Effort,
    /// Whether there were recordings to compare with; else only the model is measured, from its own seed motions.
    pub recordings: bool,
    pub aims: Vec<Aim>,
    pub definitions: Vec<Figure>,
    /// Recordings, held-out recordings, training set (where there are recordings) and the model.
    pub motions: Vec<Measured>,
    pub drift: Vec<Drift>,
    /// People who collapsed within the roll-out, by the first reason.
    pub collapsed: BTreeMap<String, usize>,
    pub reconstruction: Option<Reconstruction>,
    pub diversity: Vec<Diversity>,
    pub coverage: Vec<Coverage>,
}

/// Something that the model should reach.
#[derive(Clone, Debug, Serialize)]
pub struct Aim {
    pub name: String,
    /// None without recordings where it takes them.
    pub value: Option<f64>,
    /// The value should not be above this.
    pub limit: f64,
    pub met: Option<bool>,
}

/// What the page shows of the motions.
#[derive(Default)]
pub struct Pictures {
    pub films: Vec<Film>,
    /// By name, ways in the plane: metres, from the origin and along y at first.
    pub ways: Vec<(String, Vec<Way>)>,
}

/// Points of the plane, metres.
pub type Way = Vec<(f64, f64)>;

/// A motion for a filmstrip, T x 93 in the world.
pub struct Film {
    pub caption: String,
    pub frames: Vec<f32>,
}

/// Errors on held-out recordings, mm per marker.
#[derive(Clone, Debug, Serialize)]
pub struct Reconstruction {
    pub all: HeldOut,
    pub clips: Vec<ClipError>,
}

/// Of one recording, with the encoder's mean latent.
#[derive(Clone, Debug, Serialize)]
pub struct ClipError {
    pub clip: String,
    /// Windows of 20 frames.
    pub windows: usize,
    /// Over the 18 frames, and in the last.
    pub mean: f32,
    pub last: f32,
}

/// Measures `weights`, which move `sim`, beside `data`; without, people start as in `bank`. Also gives what the page shows.
pub fn report(
    weights: &MotionWeights,
    sim: &Arc<Sim>,
    data: Option<&Data>,
    bank: Option<&SeedBank>,
    effort: Effort,
) -> Result<(Report, Pictures)> {
    let body = sim.body().shape(&[0.0; BETAS]);
    let prior = PosePrior::embedded()?;
    let ruler = Ruler { skeleton: Skeleton::new(sim.body()), body: &body, prior: &prior };
    let starts = |n: usize, purpose: &str| begin(data, bank, n, effort.seed, purpose);
    let walked = roll::walk(sim, &ruler, &starts(effort.people, "report starts")?, effort.primitives, effort.seed)?;
    let first = roll::first_steps(sim, &starts(FIRST_STEPS * effort.people, "coverage starts")?, effort.seed)?;
    let sampled = Diversity::sampled("model", sim, &starts(beginnings(effort), "diversity starts")?, effort.seed)?;
    let mut pictures = Pictures::default();
    pictures.show("model", &walked.films, FILMS[0], 0);
    let mut report = Report {
        format: FORMAT,
        model: weights.hash.clone(),
        body: sim.body().hash().into(),
        pose_prior: prior.hash().into(),
        effort,
        recordings: data.is_some(),
        aims: Vec::new(),
        definitions: FIGURES.to_vec(),
        motions: vec![walked.measured],
        drift: walked.drift,
        collapsed: walked.collapsed,
        reconstruction: None,
        diversity: vec![sampled],
        coverage: vec![Coverage::new("model, one primitive", &first), Coverage::new("model, roll-outs", &walked.ways)],
    };
    if let Some(data) = data {
        compare(&mut report, weights, &ruler, data, &mut pictures)?;
    }
    report.aims = aims(&report);
    Ok((report, pictures))
}

/// `n` beginnings: from the training set, else from the model's seed motions in turn.
fn begin(data: Option<&Data>, bank: Option<&SeedBank>, n: usize, seed: u64, purpose: &str) -> Result<Vec<SeedMotion>> {
    match (data, bank) {
        (Some(data), _) => Ok(draw_starts(&data.train, n, seed, purpose)?),
        (None, Some(bank)) => Ok(bank.seeds.iter().cycle().take(n).cloned().collect()),
        (None, None) => Err(egogen::Error::invalid("neither recordings nor seed motions to start from").into()),
    }
}

/// Beginnings whose continuations are compared.
fn beginnings(effort: Effort) -> usize {
    diversity::QUERIES.min(effort.people)
}

/// Puts what the recordings give in front of the model's figures.
fn compare(report: &mut Report, weights: &MotionWeights, ruler: &Ruler, data: &Data, pictures: &mut Pictures) -> Result<()> {
    let raw = MotionSet { clips: data.train.clips.iter().filter(|c| family(&c.name) == c.name).cloned().collect() };
    let sets = [("recordings", &raw), ("held out", &data.held_out), ("training set", &data.train)];
    report.motions.splice(0..0, sets.map(|(name, set)| ruler.recorded(name, set)));
    if !data.held_out.windows(FRAMES, 1).is_empty() {
        report.reconstruction = Some(reconstruct(weights, ruler.body, &data.held_out)?);
    }
    let diversity = sets.map(|(name, set)| Diversity::recorded(name, &data.train, beginnings(report.effort), set, report.effort.seed));
    report.diversity.splice(0..0, diversity);
    let coverage = sets.map(|(name, set)| Coverage::recorded(name, set));
    let train = coverage[2].clone();
    report.coverage.splice(0..0, coverage);
    report.coverage = std::mem::take(&mut report.coverage).into_iter().map(|c| c.beside(&train)).collect();
    pictures.show("recordings", &raw, FILMS[1], SHORTEST);
    let varied = data.train.clips.iter().filter(|c| family(&c.name) != c.name).cloned().collect();
    pictures.show("variations", &MotionSet { clips: varied }, FILMS[1], SHORTEST);
    Ok(())
}

fn reconstruct(weights: &MotionWeights, body: &ShapedBody, held_out: &MotionSet) -> Result<Reconstruction> {
    let mut clips = Vec::new();
    for clip in held_out.clips.iter().filter(|c| c.len() >= FRAMES) {
        let of = judge_held_out(weights, body, &MotionSet { clips: vec![clip.clone()] })?;
        clips.push(ClipError { clip: clip.name.clone(), windows: of.windows, mean: of.posterior[0], last: of.posterior[1] });
    }
    Ok(Reconstruction { all: judge_held_out(weights, body, held_out)?, clips })
}

impl Pictures {
    /// Adds the first [`FILM`] frames of `films` motions of at least `shortest` frames, and the ways of more of them.
    fn show(&mut self, name: &str, set: &MotionSet, films: usize, shortest: usize) {
        let long: Vec<usize> = (0..set.clips.len()).filter(|&i| set.clips[i].len() >= shortest.max(1)).collect();
        // Spread evenly over the set.
        let pick = |count: usize| {
            let count = count.min(long.len());
            (0..count).map(|i| long[(2 * i + 1) * long.len() / (2 * count)]).collect::<Vec<_>>()
        };
        let film = |i: usize| {
            let clip = &set.clips[i];
            Film { caption: format!("{name}: {}", clip.name), frames: clip.params[..clip.len().min(FILM) * PARAMS].to_vec() }
        };
        self.films.extend(pick(films).into_iter().map(film));
        self.ways.push((name.into(), pick(WAYS).into_iter().map(|i| way(set, i)).collect()));
    }
}

/// The pelvis in the plane, metres, from the origin and along y at first.
fn way(set: &MotionSet, i: usize) -> Way {
    let local = set.frame(i, 0).inverse();
    let at = |t: usize| local.point(set.frame(i, t).transl);
    (0..set.clips[i].len().min(FILM)).step_by(4).map(at).map(|p| (f64::from(p.x), f64::from(p.y))).collect()
}

/// What the model should reach, see the page of the book on this report.
fn aims(report: &Report) -> Vec<Aim> {
    let value = |motion: &str, key: &str| report.motions.iter().find(|m| m.name == motion).and_then(|m| m.value(key));
    let aim = |name: &str, value: Option<f64>, limit: f64| Aim { name: name.into(), value, limit, met: value.map(|v| v <= limit) };
    let contact = value("recordings", "contact").zip(value("model", "contact")).map(|(a, b)| (a - b).abs());
    let collapsed = report.collapsed.values().sum::<usize>() as f64;
    vec![
        aim("contact score apart from the recordings'", contact, 0.03),
        aim("slide of the stance foot, cm", value("model", "slide"), 2.0),
        aim("frames with the soles further than 2 cm from the floor, %", value("model", "sole_near").map(|v| 100.0 - v), 5.0),
        aim("people who collapsed in the roll-out", Some(collapsed), 0.0),
        aim(
            "posterior error on held-out recordings, mm per marker",
            report.reconstruction.as_ref().map(|r| f64::from(r.all.posterior[0])),
            15.0,
        ),
    ]
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<31}", "")?;
        self.motions.iter().try_for_each(|m| write!(f, "{:>14}", m.name))?;
        writeln!(f)?;
        for figure in FIGURES {
            write!(f, "{:<31}", figure.label)?;
            for m in &self.motions {
                let text = m.value(figure.key).map_or("-".into(), |v| format!("{v:.digits$}", digits = figure.digits));
                write!(f, "{text:>14}")?;
            }
            writeln!(f, "  {}", figure.unit)?;
        }
        for c in &self.coverage {
            let [a, b] = c.overlap.unwrap_or([f64::NAN; 2]);
            writeln!(f, "{}: standing {:.1} %, overlap {a:.2}, {b:.2}", c.name, 100.0 * c.still)?;
        }
        for d in &self.diversity {
            let [frames, last] = [d.frames, d.last].map(|e| e.map_or(f64::NAN, |e| e.value));
            writeln!(f, "{}: average pairwise distance {frames:.1} mm, last frame {last:.1} mm", d.name)?;
        }
        for a in &self.aims {
            let verdict = a.met.map_or("not known", |met| if met { "met" } else { "missed" });
            writeln!(f, "{}: {:.3}, at most {}: {verdict}", a.name, a.value.unwrap_or(f64::NAN), a.limit)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::sim::World;

    #[test]
    fn a_model_without_recordings_is_measured_by_itself() {
        let dir = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/motion"));
        let (weights, world) = (MotionWeights::load(dir).unwrap(), World::embedded().unwrap());
        let effort = Effort { people: 3, primitives: 2, seed: 1 };
        let (report, pictures) = report(&weights, &world.sim, None, Some(&world.held_out), effort).unwrap();
        assert_eq!((report.motions.len(), report.diversity.len(), report.coverage.len()), (1, 1, 2));
        assert_eq!(report.coverage.iter().map(|c| c.primitives).collect::<Vec<_>>(), [30, 6]);
        assert_eq!((pictures.films.len(), pictures.films[0].frames.len(), pictures.ways[0].1.len()), (3, 38 * PARAMS, 3));
        assert_eq!(report.drift.iter().map(|d| d.primitive).collect::<Vec<_>>(), [1, 2]);
        let aims: Vec<Option<bool>> = report.aims.iter().map(|a| a.met).collect();
        assert!(aims[0].is_none() && aims[4].is_none() && aims[3] == Some(true), "{aims:?}");
        assert!(report.motions[0].figures.values().all(Option::is_some));
        assert!(super::report(&weights, &world.sim, None, None, effort).is_err());
    }
}
