//! The program `play`: a policy in its task, as pictures and as motion for other programs.

use clap::Parser;
use egogen::agent::bundle::Bundle;
use egogen::body::BodyModel;
use egogen::export::write_glb;
use egogen::motion::amass::write_amass;
use egogen::render::{Episode, Image, Walker, tile};
use egogen_envs::motion::MotionEnv;
use egogen_train::evaluate::{Actor, Film, Greedy, Played, play};
use egogen_train::program::{self, Given};
use egogen_train::{Error, Result};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

/// Draws episodes of a policy (or of a baseline): all of them from above; of the first, filmstrips and the motion itself as glTF
/// and in AMASS's layout.
#[derive(Debug, Parser)]
#[command(
    name = "play",
    version,
    after_help = "Examples:
  play checkpoints/policy/quick --out runs/play
  play prior --starts 4                     the motion model wandering; also: zero, greedy
  play runs/rooms/policy --set max_depth=13 --set rooms.kind=furnished
  play runs/rooms/policy --set 'rooms.bundles.train=[\"scenes/scan\"]'"
)]
struct Args {
    /// A policy bundle, or one of the baselines zero, prior, greedy
    policy: String,
    /// Starts 0 to this, less one, are played
    #[arg(long, default_value = "12")]
    starts: NonZeroUsize,
    /// Of those, this many also get a filmstrip and their motion as start-NNN.glb and start-NNN.npz
    #[arg(long, default_value_t = 2)]
    films: usize,
    /// Seed of the starts and of the noise
    #[arg(long, default_value_t = 2024)]
    seed: u64,
    /// Act with the policy's noise instead of its mean action
    #[arg(long)]
    stochastic: bool,
    /// Folder of a motion model instead of the shipped one
    #[arg(long, value_name = "DIR")]
    model: Option<PathBuf>,
    /// Change a value of the walking task, e.g. scene.kind=open; repeatable
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    set: Vec<String>,
    /// Folder for the pictures and the motion
    #[arg(long, value_name = "DIR", default_value = "runs/play")]
    out: PathBuf,
}

fn main() -> ExitCode {
    program::exit(run(&Args::parse()))
}

fn run(args: &Args) -> Result<u8> {
    let world = program::world(args.model.as_deref())?;
    let mut env = MotionEnv::evaluation(program::task(&args.set)?, world.sim.clone(), world.held_out.clone(), args.starts.get(), args.seed)
        .given()?;
    let actor = match args.policy.as_str() {
        "zero" => Actor::Zero,
        "prior" => Actor::Prior,
        "greedy" => Actor::Greedy(Greedy::default()),
        dir => {
            let bundle = Bundle::read(dir.as_ref()).given()?;
            Actor::policy(&bundle, &env, args.stochastic).map_err(|e| Error::config(format!("policy {dir}: {e}")))?
        }
    };
    let reach = env.task().success_distance;
    let played = play(&mut env, &actor, args.seed, true)?;
    let body = world.sim.body();
    let mut plans = Vec::new();
    for p in &played {
        let Some(film) = &p.film else { continue };
        draw(film, reach, |episode| {
            plans.push(episode.top_view(body, 320)?);
            if (p.start as usize) < args.films {
                strips(&episode, body, p, &args.out)?;
                let file = |kind: &str| args.out.join(format!("start-{:03}.{kind}", p.start));
                write_glb(file("glb"), body, &episode)?;
                write_amass(file("npz"), &film.frames, &film.betas)?;
            }
            Ok(())
        })?;
        println!("start {}: {}", p.start, p.outcome());
    }
    tile(&plans, 4).write_png(args.out.join("paths.png"))?;
    println!("pictures in {}", args.out.display());
    Ok(0)
}

fn draw(film: &Film, reach: f32, picture: impl FnOnce(Episode) -> Result<()>) -> Result<()> {
    let walkers = [Walker { frames: &film.frames, betas: &film.betas, goal: Some(film.setting.goal) }];
    picture(Episode { walkers: &walkers, scene: &film.setting.scene, room: film.room.as_deref(), reach })
}

fn strips(episode: &Episode, body: &BodyModel, p: &Played, out: &std::path::Path) -> Result<()> {
    let panels: Image = episode.panels(body, 8, 4, 400, 360)?;
    panels.write_png(out.join(format!("start-{:03}-film.png", p.start)))?;
    episode.ghosts(body, 9, 1200, 700)?.write_png(out.join(format!("start-{:03}-ghosts.png", p.start)))?;
    Ok(())
}
