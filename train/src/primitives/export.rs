//! `primitives export`: motions of the model and recordings as files for other programs.

use super::steer::{Order, steer, wander};
use crate::program::{self, Given};
use crate::{Error, Result};
use clap::{ArgGroup, Args, ValueEnum};
use egogen::body::{BETAS, BodyModel, PARAMS, joint};
use egogen::export::write_glb;
use egogen::motion::amass::write_amass;
use egogen::motion::clip::Skeleton;
use egogen::motion::{self, FPS, ImportOptions};
use egogen::render::{Camera, Episode, Image, Mesh, Shading, Stage, Walker, colour, film};
use egogen::scene::Scene;
use glam::Vec3;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Writes a motion for other programs.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("source").required(true))]
pub struct Export {
    /// A motion of the model: of its prior, or steered by choosing the prior's latents.
    #[arg(long, value_enum, group = "source")]
    kind: Option<Kind>,
    /// A clip of the recordings or of what was made of them, by name, such as test/walking/walking_1.
    #[arg(long, value_name = "NAME", group = "source", requires = "data")]
    clip: Option<String>,
    /// A recording: exponential maps (.txt), .bvh, .amc, AMASS or canonical .npz, SAMP's .pkl.
    #[arg(long, value_name = "FILE", group = "source")]
    file: Option<PathBuf>,
    /// Motion-model folder instead of the shipped model.
    #[arg(long, value_name = "DIR")]
    model: Option<PathBuf>,
    /// Root of all random streams; with --kind prior it also chooses the beginning.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Primitives of --kind prior.
    #[arg(long, default_value = "12")]
    primitives: NonZeroUsize,
    /// Latents that are tried at each step of a steered motion, for each of the 8 best so far.
    #[arg(long, default_value = "64")]
    candidates: NonZeroUsize,
    /// Folder with the unpacked mocap-cmu and mocap-idle archives, or with recordings of one's own.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Seed of the data's augmentation.
    #[arg(long, default_value_t = 0)]
    data_seed: u64,
    /// Frames per second of an .amc file, which does not state it.
    #[arg(long)]
    fps: Option<f32>,
    /// Panels of the filmstrip.
    #[arg(long, default_value = "24")]
    panels: NonZeroUsize,
    /// What to write, without the ending.
    #[arg(long, value_name = "PATH", default_value = "runs/motion")]
    out: PathBuf,
}

/// A motion of the model.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Kind {
    /// Straight on at 1.2 m/s.
    Straight,
    /// Turns about within four primitives.
    Turn,
    /// Stops, stands for two seconds, walks on.
    Stop,
    /// Steps to the right.
    Side,
    /// Whatever the prior does.
    Prior,
}

impl Export {
    /// Writes the .glb, the .npz and the .png.
    pub fn run(&self) -> Result<u8> {
        let body = self.model.as_ref().map_or_else(|| Ok(BodyModel::embedded()), BodyModel::beside).given()?;
        let frames = match (&self.kind, &self.clip, &self.file) {
            (Some(kind), ..) => made(self, *kind)?,
            (_, Some(name), _) => recorded(self, name, &body)?,
            (.., file) => imported(self, file.as_deref().unwrap_or(Path::new("")), &body)?,
        };
        let betas = [0.0; BETAS];
        let walkers = [Walker { frames: &frames, betas: &betas, goal: None }];
        let episode = Episode { walkers: &walkers, scene: &Scene::default(), room: None, reach: 0.1 };
        let file = |ending: &str| {
            let mut name = self.out.as_os_str().to_owned();
            name.push(ending);
            PathBuf::from(name)
        };
        write_glb(file(".glb"), &body, &episode)?;
        write_amass(file(".npz"), &frames, &betas)?;
        strip(&frames, &body, self.panels.get(), 190)?.write_png(file(".png"))?;
        println!("{} frames in {}, .npz and .png", frames.len() / PARAMS, file(".glb").display());
        Ok(0)
    }
}

/// `panels` moments of a motion (T x 93, world), 8 in a row of `width` x 260 pixels each, seen from the right of where it begins and
/// a little from ahead by a camera that goes with the person.
pub fn strip(frames: &[f32], model: &BodyModel, panels: usize, width: usize) -> Result<Image> {
    let body = model.shape(&[0.0; BETAS]);
    let posed = |t: usize| body.pose(&frames[t * PARAMS..(t + 1) * PARAMS]);
    let ahead = (posed(0).rot[joint::PELVIS].z_axis).with_z(0.0).normalize_or(Vec3::Y);
    let aside = 3.6 * ahead.cross(Vec3::Z) + 1.8 * ahead + 0.8 * Vec3::Z;
    let panel = |i: usize| {
        let t = i * (frames.len() / PARAMS - 1) / (panels - 1).max(1);
        let (now, mut vertices, mut stage) = (posed(t), Vec::new(), Stage::new());
        model.skin(&body, &now, &mut vertices);
        stage.add(&Mesh { vertices, faces: model.faces().to_vec() }, colour::BLUE, Shading::Smooth);
        let at = now.pos[joint::PELVIS].with_z(0.85);
        Ok((stage, Camera::look_at(at + aside, at, width, 260, 0.5)?, format!("{:.2} s", t as f32 / FPS)))
    };
    Ok(film(&(0..panels).map(panel).collect::<Result<Vec<_>>>()?, 8))
}

/// A motion of the model.
fn made(args: &Export, kind: Kind) -> Result<Vec<f32>> {
    let world = program::world(args.model.as_deref())?;
    let (sim, bank) = (&world.sim, &world.held_out);
    let order = match kind {
        Kind::Straight => Order::Straight,
        Kind::Turn => Order::Turn,
        Kind::Stop => Order::Stop,
        Kind::Side => Order::Side,
        Kind::Prior => return wander(sim, bank, args.primitives.get(), args.seed),
    };
    steer(sim, bank, &order.targets(), args.candidates.get(), args.seed)
}

/// A clip of the recordings or of what was made of them.
fn recorded(args: &Export, name: &str, body: &BodyModel) -> Result<Vec<f32>> {
    let dir = args.data.as_deref().unwrap_or(Path::new(""));
    let (train, held_out, _) = motion::build(dir, args.data_seed, body).given()?;
    let mut clips = train.clips.into_iter().chain(held_out.clips);
    let found = clips.by_ref().find(|c| c.name == name).map(|c| c.params);
    found.ok_or_else(|| {
        let what = "expected a recording such as test/walking/walking_1 or 16_11, or a variation such as 16_11~bent0";
        Error::config(format!("{}: holds no clip '{name}'; {what}", dir.display()))
    })
}

/// A recording put on the body.
fn imported(args: &Export, file: &Path, body: &BodyModel) -> Result<Vec<f32>> {
    let recorded = motion::import(file, &ImportOptions { fps: args.fps, up: None }).given()?;
    let skeleton = Skeleton::new(body);
    let (clip, _) = recorded.put_on(&skeleton).given()?;
    Ok(clip.params(&skeleton).concat())
}
