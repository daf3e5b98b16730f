//! Pendulum-v1: swing a pendulum up and hold it.

use super::Dynamics;
use crate::ActionSpace;
use egogen::rng::Stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

const GRAVITY: f64 = 10.0;
const DT: f64 = 0.05;
const MAX_SPEED: f64 = 8.0;
const MAX_TORQUE: f32 = 2.0;

/// A rod of length 1 and mass 1; the action is the torque, cut to +-2. Observation: cos and sin of the angle from upright, speed.
///
/// Reward: -(angle^2 + 0.1 speed^2 + 0.001 torque^2) before the step, the angle in -pi to pi. Never terminates.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Pendulum {
    /// Not wrapped; grows with every turn.
    pub(super) angle: f64,
    pub(super) speed: f64,
}

impl Dynamics for Pendulum {
    const NAME: &'static str = "Pendulum-v1";
    const LIMIT: u32 = 200;
    const OBS: usize = 3;
    const ACTION: ActionSpace = ActionSpace::Continuous(1);

    fn draw(rng: &mut Stream) -> Self {
        Self { angle: rng.random_range(-PI..PI), speed: rng.random_range(-1.0..1.0) }
    }

    fn step(&mut self, action: f32) -> (f64, bool) {
        let torque = f64::from(action.clamp(-MAX_TORQUE, MAX_TORQUE));
        let angle = (self.angle + PI).rem_euclid(TAU) - PI;
        let cost = angle * angle + 0.1 * self.speed * self.speed + 0.001 * torque * torque;
        let turn = 1.5 * GRAVITY * self.angle.sin() + 3.0 * torque;
        self.speed = (self.speed + turn * DT).clamp(-MAX_SPEED, MAX_SPEED);
        self.angle += self.speed * DT;
        (-cost, false)
    }

    fn observe(&self, out: &mut [f32]) {
        let (sin, cos) = self.angle.sin_cos();
        out.copy_from_slice(&[cos, sin, self.speed].map(|v| v as f32));
    }
}
