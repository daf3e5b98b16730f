//! Recipes of the motion model: what its training does, as TOML.

use super::loss::LossWeights;
use crate::recipe::changed;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// The recipe that comes with the program.
const EMBEDDED: &str = include_str!("../../recipes/motion/default.toml");

/// What a run does; the whole of it is kept in its checkpoints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Root of all random streams.
    pub seed: u64,
    /// Updates of the stages: predictor on single primitives, regressor, predictor on roll-outs.
    pub steps: [u64; 3],
    /// Minutes for all stages; when given, stages end by the clock (and the result is not repeatable to the bit).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// Share of the minutes of each stage.
    pub shares: [f64; 3],
    /// People (or, for the regressor, bodies) of a batch.
    pub batch: [usize; 3],
    /// Learning rate at the start and the end of each stage, linear between.
    pub rates: [[f32; 2]; 3],
    /// Most consecutive primitives of a roll-out.
    pub depth: usize,
    /// Where the seed of a roll-out's next primitive stands.
    pub frames: Frames,
    /// How strongly rare manoeuvres are favoured: a manoeuvre seen n times is drawn as if seen n^(1 - this) times. Recorded people
    /// mostly go on as they are; a prior that does so too can hardly be steered.
    pub favour: f32,
    /// Whether the simulation is to carry bodies by the foot that bears them; no part of the training.
    #[serde(default)]
    pub planted: bool,
    /// Weights of the predictor's loss.
    pub loss: LossWeights,
}

/// The canonical frame in which a roll-out's next seed is given to the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Frames {
    /// The predicted person's own, as in the simulation: drift out of place cannot be seen, heights can.
    Own,
    /// The recorded person's, as published: the network sees its drift, which it does not in the simulation.
    Truth,
}

impl Settings {
    /// The recipe `name` (`default` or a path ending in .toml) with `key.path=value` changes, checked.
    pub fn load(name: &str, changes: &[String]) -> Result<Self> {
        let text = match name {
            "default" => EMBEDDED.to_string(),
            path if path.ends_with(".toml") => std::fs::read_to_string(path).map_err(|e| Error::config(format!("{path}: {e}")))?,
            _ => return Err(Error::config(format!("no recipe '{name}' of a motion model: expected default or a path ending in .toml"))),
        };
        let what = format!("recipe {name}");
        let read: Self = toml::from_str(&text).map_err(|e| Error::config(format!("{what}: {}", e.to_string().trim_end())))?;
        let settings = changed(&what, read, changes)?;
        settings.check(&what)?;
        Ok(settings)
    }

    fn check(&self, what: &str) -> Result<()> {
        let expect = |key: &str, holds: bool, value: String, want: &str| match holds {
            true => Ok(()),
            false => Err(Error::config(format!("{what}: {key} is {value}, expected {want}"))),
        };
        expect("steps", self.steps.iter().all(|n| *n > 0), format!("{:?}", self.steps), "at least 1 each")?;
        expect("batch", self.batch.iter().all(|n| *n > 0), format!("{:?}", self.batch), "at least 1 each")?;
        let positive = |v: &f32| *v > 0.0 && v.is_finite();
        expect("rates", self.rates.iter().flatten().all(positive), format!("{:?}", self.rates), "numbers above 0")?;
        expect("depth", (1..=8).contains(&self.depth), self.depth.to_string(), "1 to 8")?;
        expect("favour", (0.0..=1.0).contains(&self.favour), self.favour.to_string(), "0 to 1")?;
        let minutes = self.minutes.is_none_or(|m| m > 0.0 && m.is_finite());
        expect("minutes", minutes, format!("{:?}", self.minutes), "a number above 0")?;
        let shares = (self.shares.iter().sum::<f64>() - 1.0).abs() < 1e-6 && self.shares.iter().all(|s| *s > 0.0);
        expect("shares", shares, format!("{:?}", self.shares), "numbers above 0 that add up to 1")?;
        let l = &self.loss;
        for (key, v) in [("velocity", l.velocity), ("kl", l.kl), ("skate", l.skate), ("contact", l.contact)] {
            expect(&format!("loss.{key}"), v >= 0.0 && v.is_finite(), v.to_string(), "0 or more")?;
        }
        Ok(())
    }
}

impl Default for Settings {
    /// The embedded recipe.
    fn default() -> Self {
        toml::from_str(EMBEDDED).expect("the embedded recipe is tested")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recipes_are_checked() {
        assert_eq!(Settings::load("default", &[]).unwrap(), Settings::default());
        let with = |change: &str| Settings::load("default", &[change.to_string()]);
        assert_eq!(with("loss.kl=0.7").unwrap().loss.kl, 0.7);
        assert_eq!(with("frames=truth").unwrap().frames, Frames::Truth);
        for (change, want) in [
            ("loss.klx=1", "klx"),
            ("frames=mine", "mine"),
            ("depth=9", "depth is 9, expected 1 to 8"),
            ("loss.contact=-1.0", "loss.contact is -1"),
            ("favour=2.0", "favour is 2"),
            ("steps=[1, 0, 1]", "steps is [1, 0, 1]"),
            ("shares=[0.5, 0.5, 0.5]", "shares is"),
        ] {
            let message = with(change).unwrap_err().to_string();
            assert!(message.contains(want), "{message}");
        }
        assert!(Settings::load("other", &[]).unwrap_err().to_string().contains("no recipe 'other'"));
    }
}
