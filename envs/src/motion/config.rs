//! What a motion task is, as data.

use super::crowd::Penetration;
use egogen::motion::FUTURE;
use egogen::scene::{CrowdedScenes, SparseScenes};
use egogen::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Weights of the reward terms: Tab. S2, with the authors' 0.1 for the sparse penetration term, which the table leaves open.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Weights {
    pub floor: f32,
    pub skate: f32,
    pub dist: f32,
    pub orient: f32,
    pub attention: f32,
    /// The pose prior is only asked when this is not 0, for that takes time.
    pub pose: f32,
    pub penetration: f32,
    pub success: f32,
    /// Not in the paper (0 there): paid on success for every step left. Each step alive pays about 0.5, so without this a
    /// policy gains by hovering at the goal until the last step.
    pub arrival: f32,
}

impl Default for Weights {
    fn default() -> Self {
        Self { floor: 0.1, skate: 0.3, dist: 1.0, orient: 0.1, attention: 0.3, pose: 0.1, penetration: 0.1, success: 0.5, arrival: 0.0 }
    }
}

/// What judges poses (eq. 9).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseCheck {
    /// A pose prior of VPoser's form (see `egogen::motion::pose_prior`); absent: the shipped one.
    pub prior: Option<PathBuf>,
    /// ||VP|| below which a pose is natural; absent: the one in the prior's file, or 11, which is the paper's for VPoser v1.
    pub threshold: Option<f32>,
}

/// The task of walking to a goal in a sparse scene. Defaults are the paper's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionTask {
    /// How scenes, starts and goals are drawn.
    pub scene: SparseScenes,
    /// Rooms to walk in instead of `scene`, with the penetration of eq. 8 and 11 instead of eq. 7's.
    pub rooms: Option<CrowdedScenes>,
    /// How penetration is judged in rooms.
    pub penetration: Penetration,
    pub weights: Weights,
    pub pose: PoseCheck,
    /// Act through that many latents, those that move people most, and leave the others 0; absent: all of them, as published.
    pub latents: Option<usize>,
    /// Training fits bodies to every so-many-th new frame of a primitive and to its last two, and takes those of the others between them
    /// ([`egogen::sim::Sim::step_by`]), which saves time; 1: to all. Evaluation always fits all.
    pub body_every: usize,
    /// Steps (of 0.45 s) after which an episode ends. The observation shows the time, so this is a termination.
    pub max_depth: u32,
    /// People start facing the goal but for a turn of up to this, degrees either way.
    pub yaw_noise_deg: f32,
    /// The goal is reached when the pelvis is nearer than this at the end of a step, metres (eq. 10).
    pub success_distance: f32,
    /// That many non-walkable cells under the body's box are a penetration (eq. 7).
    pub blocked_cells: usize,
    /// Side of those cells, metres.
    pub cell: f32,
    /// Whether a penetration ends the episode. If not, who has one may still arrive.
    pub end_on_penetration: bool,
}

impl Default for MotionTask {
    fn default() -> Self {
        Self {
            scene: SparseScenes::default(),
            rooms: None,
            penetration: Penetration::default(),
            weights: Weights::default(),
            pose: PoseCheck::default(),
            latents: None,
            body_every: 1,
            max_depth: 11,
            yaw_noise_deg: 36.0,
            success_distance: 0.1,
            blocked_cells: 3,
            cell: 0.1,
            end_on_penetration: true,
        }
    }
}

impl MotionTask {
    /// Refuses values that make no task; the message names the key and what would be right.
    pub fn validate(&self) -> Result<()> {
        self.scene.validate()?;
        self.rooms.as_ref().map_or(Ok(()), |r| r.validate("rooms"))?;
        let need = |ok: bool, key: &str, right: &str| {
            if ok { Ok(()) } else { Err(Error::invalid(format!("{key}: expected {right}"))) }
        };
        for term in super::TERMS {
            let weight = (term.weight)(&self.weights);
            need(weight.is_finite(), &format!("weights.{}", term.name), "a finite number")?;
        }
        need(self.pose.threshold.is_none_or(|t| t > 0.0 && t.is_finite()), "pose.threshold", "more than 0")?;
        need(self.penetration.most.is_none_or(|n| n > 0.0 && n.is_finite()), "penetration.most", "more than 0 vertices")?;
        need(self.latents != Some(0), "latents", "1 or more")?;
        need((1..=FUTURE).contains(&self.body_every), "body_every", "1 to 18 frames")?;
        need((1..=1000).contains(&self.max_depth), "max_depth", "1 to 1000 steps")?;
        need((0.0..=180.0).contains(&self.yaw_noise_deg), "yaw_noise_deg", "0 to 180 degrees")?;
        need(self.success_distance > 0.0 && self.success_distance <= 1.0, "success_distance", "more than 0, at most 1 m")?;
        need(self.blocked_cells >= 1, "blocked_cells", "1 or more")?;
        need((0.01..=0.5).contains(&self.cell), "cell", "0.01 to 0.5 m")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_complete_themselves() {
        let task: MotionTask = serde_json::from_str(r#"{"weights": {"arrival": 0.8}, "max_depth": 13}"#).unwrap();
        task.validate().unwrap();
        let weights = Weights { arrival: 0.8, ..Default::default() };
        assert_eq!(task, MotionTask { weights, max_depth: 13, ..Default::default() });
        assert!(serde_json::from_str::<MotionTask>(r#"{"max_deph": 13}"#).unwrap_err().to_string().contains("max_deph"));
    }

    #[test]
    fn unusable_values_are_named() {
        for (text, key) in [
            (r#"{"max_depth": 0}"#, "max_depth"),
            (r#"{"latents": 0}"#, "latents"),
            (r#"{"body_every": 0}"#, "body_every"),
            (r#"{"rooms": {"count": 0}}"#, "rooms.count"),
            (r#"{"rooms": {"pairs": {"blocked": 2.0}}}"#, "rooms.pairs.blocked"),
            (r#"{"penetration": {"most": 0.0}}"#, "penetration.most"),
            (r#"{"yaw_noise_deg": -1.0}"#, "yaw_noise_deg"),
            (r#"{"success_distance": 0.0}"#, "success_distance"),
            (r#"{"blocked_cells": 0}"#, "blocked_cells"),
            (r#"{"cell": 0.0}"#, "cell"),
            (r#"{"weights": {"skate": 1e39}}"#, "weights.skate"),
            (r#"{"pose": {"threshold": 0.0}}"#, "pose.threshold"),
            (r#"{"scene": {"side": [2.0, 1.0]}}"#, "scene.side"),
        ] {
            let task: MotionTask = serde_json::from_str(text).unwrap();
            assert!(task.validate().unwrap_err().to_string().starts_with(key), "{key}");
        }
    }
}
