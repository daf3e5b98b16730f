//! `primitives report`.

use super::{Data, Effort, page, report};
use crate::program::Given;
use crate::{Error, Result};
use clap::Args;
use egogen::body::BodyModel;
use egogen::io::write_atomic;
use egogen::motion::{self, MotionWeights};
use egogen::sim::{SEEDS_FILE, SeedBank, World};
use std::num::NonZeroUsize;
use std::path::PathBuf;

/// Measures a motion model beside recordings.
#[derive(Debug, Args)]
pub struct Command {
    /// Motion-model folder.
    #[arg(long, value_name = "DIR")]
    model: PathBuf,
    /// Folder with the unpacked mocap-cmu and mocap-idle archives, or with recordings of one's own; without it only the model is measured.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Seed of the data's augmentation.
    #[arg(long, default_value_t = 0)]
    data_seed: u64,
    /// Folder for report.json and report.html.
    #[arg(long, value_name = "DIR", default_value = "runs/motion-report")]
    out: PathBuf,
    /// People of the roll-outs.
    #[arg(long, default_value = "1000")]
    people: NonZeroUsize,
    /// Primitives that each of them walks.
    #[arg(long, default_value = "100")]
    primitives: NonZeroUsize,
    /// Root of all random streams.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

impl Command {
    /// Writes report.json and report.html, and prints the figures.
    pub fn run(&self) -> Result<u8> {
        let body = BodyModel::beside(&self.model).given()?;
        let weights = MotionWeights::load(&self.model).given()?;
        let sim = World::simulation(&self.model, &weights).given()?;
        let (mut data, mut bank) = (None, None);
        match &self.data {
            Some(dir) => {
                let (train, held_out, _) = motion::build(dir, self.data_seed, &body).given()?;
                data = Some(Data { train, held_out });
            }
            None => bank = Some(SeedBank::read(self.model.join(SEEDS_FILE), &body).given()?),
        }
        let effort = Effort { people: self.people.get(), primitives: self.primitives.get(), seed: self.seed };
        let (report, pictures) = report(&weights, &sim, data.as_ref(), bank.as_ref(), effort)?;
        let text = serde_json::to_string_pretty(&report).map_err(|e| Error::run(e.to_string()))?;
        write_atomic(self.out.join("report.json"), format!("{text}\n").as_bytes())?;
        let html = self.out.join("report.html");
        write_atomic(&html, page(&report, &pictures, &body, &self.again())?.as_bytes())?;
        print!("{report}");
        println!("page in {}", html.display());
        Ok(0)
    }

    /// The command that makes the same report.
    fn again(&self) -> String {
        let data = if self.data.is_some() { format!(" --data DIR --data-seed {}", self.data_seed) } else { String::new() };
        let (people, primitives, seed) = (self.people, self.primitives, self.seed);
        format!("primitives report --model DIR{data} --people {people} --primitives {primitives} --seed {seed}")
    }
}
