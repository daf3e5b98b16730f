//! The training run: three stages, checkpoints, resuming.

use super::adam::{Adam, merge};
use super::eval::held_out_error;
use super::loss::{self, LossParts, LossWeights};
use super::progress::Progress;
use super::sample::{BodySource, Lanes, SHARD};
use super::settings::Settings;
use super::{init, predictor, regressor};
use crate::Result;
use egogen::Error;
use egogen::body::rotation::to_6d;
use egogen::body::{BodyModel, MARKER_DIM, ShapedBody};
use egogen::io::{Precision, Tensors, pack_tensors, write_atomic};
use egogen::kernels::{Decoder, Regressor};
use egogen::motion::{
    CONTINUOUS, MotionConfig, MotionSet, MotionWeights, Parameters, PredictorSizes, PredictorWeights, RegressorSizes, RegressorWeights,
};
use egogen::rng::stream;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A stage of training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Predictor on single primitives.
    Single,
    /// Regressor on recorded bodies and on what the predictor makes.
    Body,
    /// Predictor on roll-outs with the regressor in the loop, people in their own canonical frames.
    Rollout,
}

const STAGES: [Stage; 3] = [Stage::Single, Stage::Body, Stage::Rollout];

/// A network with its optimiser.
struct Trained<P> {
    weights: P,
    adam: Adam<P>,
}

/// Where a run stands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Place {
    /// 3 when all is done.
    stage: usize,
    /// Updates made in the stage.
    step: u64,
    /// Seconds spent in the stage.
    spent: f64,
    /// Adam's counters.
    updates: [u64; 2],
    settings: Settings,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Done,
    Interrupted,
}

/// A training run.
pub struct Run<'a> {
    set: &'a MotionSet,
    held_out: &'a MotionSet,
    model: &'a BodyModel,
    body: ShapedBody,
    predictor: Trained<PredictorWeights>,
    regressor: Trained<RegressorWeights>,
    place: Place,
    out: PathBuf,
}

const STATE: &str = "state.safetensors";
/// Time between checkpoints.
const SAVE_EVERY: Duration = Duration::from_secs(120);
/// Updates of the predictor between looks at held-out motion.
const WATCH_EVERY: u64 = 500;

impl<'a> Run<'a> {
    /// Fresh networks, to be trained on `set` and watched on `held_out`.
    pub fn new(set: &'a MotionSet, held_out: &'a MotionSet, model: &'a BodyModel, settings: Settings, out: impl Into<PathBuf>) -> Self {
        let source = BodySource::new(set, model, settings.seed);
        let (markers, pose) = means(&source, settings.seed);
        let predictor = init::predictor(PredictorSizes::default(), settings.seed, &markers);
        let regressor = init::regressor(RegressorSizes::default(), settings.seed, &markers, &pose);
        Self {
            set,
            held_out,
            model,
            body: source.shapes[0].clone(),
            predictor: Trained { adam: Adam::new(&predictor), weights: predictor },
            regressor: Trained { adam: Adam::new(&regressor), weights: regressor },
            place: Place { stage: 0, step: 0, spent: 0.0, updates: [0; 2], settings },
            out: out.into(),
        }
    }

    /// Takes the networks of the motion-model folder `dir` instead of fresh ones, to train them further on other data or losses.
    pub fn start_from(mut self, dir: &Path) -> Result<Self> {
        let w = MotionWeights::load(dir)?;
        let c = self.config();
        if (MotionConfig { planted: c.planted, ..w.config.clone() }) != c {
            return Err(Error::file(dir, format!("holds a model of {:?}, expected {c:?}", w.config)).into());
        }
        (self.predictor.weights, self.regressor.weights) = (w.predictor, w.regressor);
        Ok(self)
    }

    /// Goes on where the checkpoint in `out` left off, with its settings.
    pub fn resume(set: &'a MotionSet, held_out: &'a MotionSet, model: &'a BodyModel, out: impl Into<PathBuf>) -> Result<Self> {
        let out = out.into();
        let t = Tensors::read(out.join(STATE))?;
        let bad = |e: String| Error::file(t.origin(), e);
        let place = t.metadata().get("place").cloned().ok_or_else(|| bad("has no metadata entry 'place': not a training state".into()))?;
        let place: Place = serde_json::from_str(&place).map_err(|e| bad(format!("metadata entry 'place': {e}")))?;
        let mut run = Self::new(set, held_out, model, place.settings.clone(), out);
        run.place = place;
        run.predictor.read(&t, "predictor")?;
        run.regressor.read(&t, "regressor")?;
        (run.predictor.adam.steps, run.regressor.adam.steps) = (run.place.updates[0], run.place.updates[1]);
        Ok(run)
    }

    /// Settings of the run.
    pub fn settings(&self) -> &Settings {
        &self.place.settings
    }

    /// Trains to the end or until `stop` is set, and saves.
    pub fn train(&mut self, stop: &AtomicBool) -> Result<Outcome> {
        while let Some(&stage) = STAGES.get(self.place.stage) {
            let progress = Progress::new(&self.out, stage, self.place.step)?;
            let outcome = match stage {
                Stage::Body => self.fit_regressor(stop, progress)?,
                Stage::Single => self.fit_predictor(1, stop, progress)?,
                Stage::Rollout => self.fit_predictor(self.place.settings.depth, stop, progress)?,
            };
            if outcome == Outcome::Done {
                self.place = Place { stage: self.place.stage + 1, step: 0, spent: 0.0, ..self.place.clone() };
            }
            self.save()?;
            if outcome == Outcome::Interrupted {
                return Ok(outcome);
            }
        }
        Ok(Outcome::Done)
    }

    /// The share of the stage that is done.
    fn fraction(&self, spent: f64) -> f64 {
        let s = &self.place.settings;
        match s.minutes {
            Some(m) => spent / (60.0 * m * s.shares[self.place.stage]),
            None => self.place.step as f64 / s.steps[self.place.stage] as f64,
        }
    }

    fn rate(&self, fraction: f64) -> f32 {
        let [from, to] = self.place.settings.rates[self.place.stage];
        from + (to - from) * fraction.min(1.0) as f32
    }

    fn fit_predictor(&mut self, depth: usize, stop: &AtomicBool, mut progress: Progress) -> Result<Outcome> {
        let s = self.place.settings.clone();
        let rows = s.batch[self.place.stage];
        // Early samples of the prior have no feet to speak of.
        let loss_weights = LossWeights { contact: if depth > 1 { s.loss.contact } else { 0.0 }, ..s.loss };
        let mut lanes = Lanes::new(self.set, rows, depth, s.favour)?;
        let regressor = Regressor::new(&self.regressor.weights)?;
        let mut shards: Vec<(predictor::Tape, PredictorWeights)> =
            (0..rows.div_ceil(SHARD)).map(|_| (predictor::Tape::default(), self.predictor.weights.zeros())).collect();
        let mut clock = Clock::new(self.place.spent);
        loop {
            let fraction = self.fraction(clock.spent());
            if lanes.is_start(self.place.step)
                && let Some(outcome) = self.pause(&mut clock, fraction, stop)?
            {
                return Ok(outcome);
            }
            let batch = lanes.batch(s.seed ^ self.place.stage as u64, self.place.step);
            let weights = &predictor::Ready::new(&self.predictor.weights)?;
            let parts: Vec<LossParts> = shards
                .par_iter_mut()
                .zip(&batch)
                .map(|((tape, grad), b)| loss::step(weights, grad, tape, b, &loss_weights, b.rows as f32 / rows as f32))
                .collect();
            let (first, rest) = shards.split_at_mut(1);
            rest.iter_mut().for_each(|(_, g)| merge(&mut first[0].1, g));
            let rate = self.rate(fraction);
            self.predictor.adam.update(&mut self.predictor.weights, &mut first[0].1, rate);
            lanes.advance(&shards.iter().map(|(t, _)| &t.frames[..]).collect::<Vec<_>>(), &self.body, &regressor, s.frames)?;
            self.place.step += 1;
            let share = 1.0 / parts.len() as f32;
            let mean = |f: fn(&LossParts) -> f32| parts.iter().map(f).sum::<f32>() * share;
            let figures = [mean(|p| p.reconstruction), mean(|p| p.velocity), mean(|p| p.kl), mean(|p| p.skate), mean(|p| p.contact)];
            progress.step(self.place.step, fraction, rate, &figures)?;
            if self.place.step.is_multiple_of(WATCH_EVERY) {
                progress.held_out(self.place.step, held_out_error(&self.predictor.weights, self.held_out)?)?;
            }
        }
    }

    fn fit_regressor(&mut self, stop: &AtomicBool, mut progress: Progress) -> Result<Outcome> {
        let s = self.place.settings.clone();
        let rows = s.batch[self.place.stage];
        let mut source = BodySource::new(self.set, self.model, s.seed);
        let decoder = Decoder::new(&self.predictor.weights)?;
        let n = rows.div_ceil(SHARD);
        let mut shards: Vec<(regressor::Tape, RegressorWeights)> =
            (0..n).map(|_| (regressor::Tape::default(), self.regressor.weights.zeros())).collect();
        let mut clock = Clock::new(self.place.spent);
        let mut fresh = true;
        loop {
            let fraction = self.fraction(clock.spent());
            if let Some(outcome) = self.pause(&mut clock, fraction, stop)? {
                return Ok(outcome);
            }
            let step = self.place.step;
            if fresh || step.is_multiple_of(20) {
                // After a resume the same frames come back, for the stream is that of the last renewal.
                source.predict(&decoder, &mut stream(s.seed, "predicted bodies", step / 20))?;
                fresh = false;
            }
            let weights = &self.regressor.weights;
            let parts: Vec<[f32; 2]> = shards
                .par_iter_mut()
                .enumerate()
                .map(|(i, (tape, grad))| {
                    let rng = &mut stream(s.seed, "bodies", step << 16 | i as u64);
                    regressor_step(weights, grad, tape, &source, SHARD.min(rows - i * SHARD), rows, rng)
                })
                .collect();
            let (first, rest) = shards.split_at_mut(1);
            rest.iter_mut().for_each(|(_, g)| merge(&mut first[0].1, g));
            let rate = self.rate(fraction);
            self.regressor.adam.update(&mut self.regressor.weights, &mut first[0].1, rate);
            self.place.step += 1;
            let sum = |k: usize| parts.iter().map(|p| p[k]).sum::<f32>();
            progress.step(self.place.step, fraction, rate, &[sum(0), sum(1)])?;
        }
    }

    /// Ends the stage, saves now and then, and heeds `stop`.
    fn pause(&mut self, clock: &mut Clock, fraction: f64, stop: &AtomicBool) -> Result<Option<Outcome>> {
        self.place.spent = clock.spent();
        if fraction >= 1.0 {
            return Ok(Some(Outcome::Done));
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(Some(Outcome::Interrupted));
        }
        if clock.saved.elapsed() > SAVE_EVERY {
            self.save()?;
            clock.saved = Instant::now();
        }
        Ok(None)
    }

    /// Writes the training state and the motion-model folder.
    pub fn save(&mut self) -> Result<()> {
        self.place.updates = [self.predictor.adam.steps, self.regressor.adam.steps];
        let mut tensors = Vec::new();
        self.predictor.put("predictor", &mut tensors);
        self.regressor.put("regressor", &mut tensors);
        let place = serde_json::to_string(&self.place).map_err(|e| Error::invalid(e.to_string()))?;
        let metadata = BTreeMap::from([("place".to_string(), place)]);
        write_atomic(self.out.join(STATE), &pack_tensors(&tensors, &metadata, Precision::Full)?)?;
        MotionWeights::save(&self.out, &self.config(), &self.predictor.weights, &self.regressor.weights)?;
        Ok(())
    }

    fn config(&self) -> MotionConfig {
        MotionConfig { planted: self.place.settings.planted, ..MotionConfig::new(self.model.hash()) }
    }

    /// The folder that the run writes.
    pub fn folder(&self) -> &Path {
        &self.out
    }
}

/// Forward and backward of `rows` of a batch's `all` bodies; sums for the batch's mean loss and marker distance.
pub(super) fn regressor_step(
    w: &RegressorWeights,
    grad: &mut RegressorWeights,
    tape: &mut regressor::Tape,
    source: &BodySource,
    rows: usize,
    all: usize,
    rng: &mut egogen::rng::Stream,
) -> [f32; 2] {
    let b = source.draw(rows, rng);
    tape.forward(w, &b.markers, &b.betas);
    let mut d = vec![0.0; rows * CONTINUOUS];
    let share = 1.0 / all as f32;
    let mut sums = [0.0; 2];
    for (i, (c, d)) in tape.body.chunks_exact(CONTINUOUS).zip(d.chunks_exact_mut(CONTINUOUS)).enumerate() {
        let (loss, distance) = regressor::body_loss(&source.shapes[b.shape[i]], c, &b.truth[i], share, d);
        sums[0] += share * loss;
        sums[1] += share * distance;
    }
    tape.backward(w, grad, d);
    sums
}

/// Mean markers and mean body in continuous form of the set, from 2,000 draws.
pub(super) fn means(source: &BodySource, seed: u64) -> (Vec<f32>, [f32; CONTINUOUS]) {
    let rng = &mut stream(seed, "means", 0);
    let n = 2000;
    let (mut markers, mut body) = (vec![0.0; MARKER_DIM], [0.0; CONTINUOUS]);
    for _ in 0..n {
        let truth = source.recorded(0, rng);
        markers.iter_mut().zip(&truth.markers).for_each(|(m, v)| *m += v / n as f32);
        let Some((local, transl)) = truth.pose else { continue };
        body.iter_mut().zip(transl.to_array()).for_each(|(b, v)| *b += v / n as f32);
        for (six, rot) in body[3..].chunks_exact_mut(6).zip(&local) {
            six.iter_mut().zip(to_6d(rot)).for_each(|(b, v)| *b += v / n as f32);
        }
    }
    (markers, body)
}

/// Time spent in a stage over all sessions, and time of the last checkpoint.
struct Clock {
    before: f64,
    start: Instant,
    saved: Instant,
}

impl Clock {
    fn new(before: f64) -> Self {
        Self { before, start: Instant::now(), saved: Instant::now() }
    }

    fn spent(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64()
    }
}

impl<P: Parameters> Trained<P> {
    fn parts(&mut self) -> [(&'static str, &mut P); 3] {
        [("", &mut self.weights), (".m", &mut self.adam.m), (".v", &mut self.adam.v)]
    }

    fn put(&mut self, name: &str, out: &mut Vec<egogen::motion::Named>) {
        for (suffix, part) in self.parts() {
            let flat: Vec<f32> = part.tensors_mut().into_iter().flat_map(|t| t.iter().copied()).collect();
            out.push((format!("{name}{suffix}"), vec![flat.len()], flat));
        }
    }

    fn read(&mut self, t: &Tensors, name: &str) -> Result<()> {
        for (suffix, part) in self.parts() {
            let tensors = part.tensors_mut();
            let n = tensors.iter().map(|t| t.len()).sum();
            let flat = t.f32s(&format!("{name}{suffix}"), &[n])?;
            let mut at = 0;
            for tensor in tensors {
                let end = at + tensor.len();
                tensor.copy_from_slice(&flat[at..end]);
                at = end;
            }
        }
        Ok(())
    }
}
