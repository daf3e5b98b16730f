//! The chosen policy at work, for the report: a filmstrip and ways from above.

use super::runs::Stage;
use crate::course::{last_levels, options};
use crate::evaluate::{Actor, play};
use crate::html::Picture;
use crate::registry::{Purpose, Registry};
use crate::{Error, Result};
use egogen::agent::bundle::Bundle;
use egogen::render::{Episode, Walker, tile};
use egogen_envs::motion::MotionEnv;
use std::any::Any;

/// Seed of the starts.
const SEED: u64 = 2024;
/// Ways from above in a row, and pixels of each.
const ROW: usize = 4;
const PLAN: usize = 280;

/// Pictures of the chosen policy of a stage in its task, on `starts` held-out starts; none but in the motion task.
pub fn films(stage: &Stage, registry: &Registry, starts: usize) -> Result<Vec<(Picture, String)>> {
    let recipe = &stage.recipe;
    let mut task = options(recipe, &last_levels(recipe))?;
    if let Some(task) = task.get_mut("task").and_then(toml::Value::as_table_mut) {
        // Who acts for an actor gives all latents.
        task.remove("latents");
    }
    let mut made = registry.make(&recipe.env, &task, starts, Purpose::Test)?;
    let Some(env) = (made.env.as_mut() as &mut dyn Any).downcast_mut::<MotionEnv>() else { return Ok(vec![]) };
    let dir = stage.dir.join("policy");
    let actor = Actor::policy(&Bundle::read(&dir)?, env, false).map_err(|e| Error::run(format!("{}: {e}", dir.display())))?;
    let played = play(env, &actor, SEED, true)?;
    let body = env.sim().body();
    let mut plans = Vec::new();
    let mut pictures = Vec::new();
    for p in &played {
        let Some(film) = &p.film else { continue };
        let walkers = [Walker { frames: &film.frames, betas: &film.betas, goal: Some(film.setting.goal) }];
        let (scene, room) = (&film.setting.scene, film.room.as_deref());
        let episode = Episode { walkers: &walkers, scene, room, reach: env.task().success_distance };
        plans.push(episode.top_view(body, PLAN)?);
        if pictures.is_empty() {
            let strip = episode.panels(body, 8, 8, 140, 180)?;
            pictures.push((Picture::Png(strip.png()?), format!("Start {}: {}", p.start, p.outcome())));
        }
    }
    let all = played.iter().map(|p| format!("{} {}", p.start, p.outcome())).collect::<Vec<_>>().join("; ");
    pictures.push((Picture::Png(tile(&plans, ROW).png()?), format!("Ways from above, by row: {all}.")));
    Ok(pictures)
}
