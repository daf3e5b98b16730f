//! One regressor that is told the body's shape, or one for each body: which is better?

use super::adam::{Adam, merge};
use super::fit::{means, regressor_step};
use super::gait::distance;
use super::regressor::Tape;
use super::sample::{BodySource, SHARD};
use super::{init, settings::Settings};
use crate::Result;
use egogen::body::{BETAS, BodyModel, MARKER_DIM, PARAMS};
use egogen::kernels::Regressor;
use egogen::motion::{MotionSet, Parameters, RegressorSizes, RegressorWeights};
use egogen::rng::stream;
use rayon::prelude::*;
use serde::Serialize;

/// Bodies to compare on: stature falls with being female-like in the first component, the second is female-like (see the body's card).
const BODIES: [(&str, f32, f32); 2] = [("male-like", 1.0, -1.0), ("female-like", -1.0, 1.0)];
/// Held-out frames that each regressor is judged on.
const JUDGED: usize = 4000;

/// Distance of skinned markers from the true ones on held-out poses of one body, mm.
#[derive(Clone, Debug, Serialize)]
pub struct Compared {
    pub body: &'static str,
    /// Of the regressor trained on many shapes, which is told the shape.
    pub conditioned: f32,
    /// Of the regressor trained on this body alone.
    pub own: f32,
}

/// Trains the regressors for `settings.steps[1]` updates each on recorded bodies and judges them; `tell` hears who is trained and
/// the update.
pub fn compare(
    set: &MotionSet,
    held_out: &MotionSet,
    model: &BodyModel,
    settings: &Settings,
    mut tell: impl FnMut(&str, u64),
) -> Result<Vec<Compared>> {
    let all = train(&BodySource::new(set, model, settings.seed), settings, |step| tell("all shapes", step))?;
    let mut out = Vec::new();
    for (name, first, second) in BODIES {
        let mut betas = [0.0; BETAS];
        (betas[0], betas[1]) = (first, second);
        let own = train(&BodySource::one(set, model, &betas), settings, |step| tell(name, step))?;
        let judged = BodySource::one(held_out, model, &betas);
        out.push(Compared { body: name, conditioned: judge(&all, &judged)?, own: judge(&own, &judged)? });
    }
    Ok(out)
}

fn train(source: &BodySource, settings: &Settings, mut tell: impl FnMut(u64)) -> Result<RegressorWeights> {
    let (rows, steps) = (settings.batch[1], settings.steps[1]);
    let (markers, pose) = means(source, settings.seed);
    let mut weights = init::regressor(RegressorSizes::default(), settings.seed, &markers, &pose);
    let mut adam = Adam::new(&weights);
    let mut shards: Vec<(Tape, RegressorWeights)> = (0..rows.div_ceil(SHARD)).map(|_| (Tape::default(), weights.zeros())).collect();
    for step in 0..steps {
        shards.par_iter_mut().enumerate().for_each(|(i, (tape, grad))| {
            let rng = &mut stream(settings.seed, "bodies", step << 16 | i as u64);
            regressor_step(&weights, grad, tape, source, SHARD.min(rows - i * SHARD), rows, rng);
        });
        let (first, rest) = shards.split_at_mut(1);
        rest.iter_mut().for_each(|(_, g)| merge(&mut first[0].1, g));
        let [from, to] = settings.rates[1];
        adam.update(&mut weights, &mut first[0].1, from + (to - from) * step as f32 / steps as f32);
        tell(step + 1);
    }
    Ok(weights)
}

fn judge(weights: &RegressorWeights, source: &BodySource) -> Result<f32> {
    let rng = &mut stream(0, "judged bodies", 0);
    let body = &source.shapes[1];
    let truth: Vec<f32> = (0..JUDGED).flat_map(|_| source.recorded(1, rng).markers).collect();
    let mut params = vec![0.0; JUDGED * PARAMS];
    Regressor::new(weights)?.regress(&truth, &body.betas().repeat(JUDGED), &mut params)?;
    let mut skinned = vec![0.0; JUDGED * MARKER_DIM];
    body.markers_batch(&params, &mut skinned);
    Ok(distance(&skinned, &truth))
}
