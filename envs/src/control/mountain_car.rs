//! MountainCar-v0 and MountainCarContinuous-v0 (Moore 1990): a car too weak to drive straight out of a valley.

use super::Dynamics;
use crate::ActionSpace;
use egogen::rng::Stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};

const GRAVITY: f64 = 0.0025;
const LEFT: f64 = -1.2;
const RIGHT: f64 = 0.6;
const MAX_SPEED: f64 = 0.07;

/// Position and speed on the track, whose height is that of sin(3 position).
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Car {
    pub(super) position: f64,
    pub(super) speed: f64,
}

impl Car {
    fn draw(rng: &mut Stream) -> Self {
        Self { position: rng.random_range(-0.6..-0.4), speed: 0.0 }
    }

    /// One step under the acceleration of the motor; the left end stops the car.
    fn roll(&mut self, motor: f64) {
        let speed = (self.speed + motor - GRAVITY * (3.0 * self.position).cos()).clamp(-MAX_SPEED, MAX_SPEED);
        self.position = (self.position + speed).clamp(LEFT, RIGHT);
        self.speed = if self.position == LEFT { speed.max(0.0) } else { speed };
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&[self.position as f32, self.speed as f32]);
    }
}

/// The motor pushes left (0), not at all (1) or right (2). Observation: position, speed.
///
/// Reward -1 for every step; terminated at position 0.5, not rolling back.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct MountainCar(pub(super) Car);

impl Dynamics for MountainCar {
    const NAME: &'static str = "MountainCar-v0";
    const LIMIT: u32 = 200;
    const OBS: usize = 2;
    const ACTION: ActionSpace = ActionSpace::Discrete(3);

    fn draw(rng: &mut Stream) -> Self {
        Self(Car::draw(rng))
    }

    fn step(&mut self, action: f32) -> (f64, bool) {
        self.0.roll(0.001 * (f64::from(action) - 1.0));
        (-1.0, self.0.position >= 0.5 && self.0.speed >= 0.0)
    }

    fn observe(&self, out: &mut [f32]) {
        self.0.observe(out);
    }
}

/// The action is the motor's force, cut to +-1. Observation: position, speed.
///
/// Reward: 100 on arrival at position 0.45 (terminated), less 0.1 force^2 in every step.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct MountainCarContinuous(pub(super) Car);

impl Dynamics for MountainCarContinuous {
    const NAME: &'static str = "MountainCarContinuous-v0";
    const LIMIT: u32 = 999;
    const OBS: usize = 2;
    const ACTION: ActionSpace = ActionSpace::Continuous(1);

    fn draw(rng: &mut Stream) -> Self {
        Self(Car::draw(rng))
    }

    fn step(&mut self, action: f32) -> (f64, bool) {
        let force = f64::from(action.clamp(-1.0, 1.0));
        self.0.roll(0.0015 * force);
        // Unlike the other tasks, Gymnasium keeps this state in f32.
        let (position, speed) = (self.0.position as f32, self.0.speed as f32);
        self.0 = Car { position: position.into(), speed: speed.into() };
        let arrived = position >= 0.45 && speed >= 0.0;
        (if arrived { 100.0 } else { 0.0 } - 0.1 * force * force, arrived)
    }

    fn observe(&self, out: &mut [f32]) {
        self.0.observe(out);
    }
}
