//! CartPole-v1 (Barto, Sutton and Anderson 1983; equations without friction by Florian 2007).

use super::Dynamics;
use crate::ActionSpace;
use egogen::rng::Stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};

const GRAVITY: f64 = 9.8;
const POLE_MASS: f64 = 0.1;
const TOTAL_MASS: f64 = 1.0 + POLE_MASS;
/// Half of the pole's length.
const LENGTH: f64 = 0.5;
const FORCE: f64 = 10.0;
const DT: f64 = 0.02;
/// The cart may not leave +- this.
const TRACK: f64 = 2.4;
/// The pole may not lean further: 12 degrees.
const LEAN: f64 = 12.0 * std::f64::consts::PI / 180.0;

/// A pole on a cart that is pushed left (0) or right (1). Observation: position, speed, angle, angular speed.
///
/// Reward 1 for every step; terminated when the pole leans more than 12 degrees or the cart leaves +-2.4.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct CartPole {
    pub(super) x: [f64; 2],
    pub(super) theta: [f64; 2],
}

impl Dynamics for CartPole {
    const NAME: &'static str = "CartPole-v1";
    const LIMIT: u32 = 500;
    const OBS: usize = 4;
    const ACTION: ActionSpace = ActionSpace::Discrete(2);

    fn draw(rng: &mut Stream) -> Self {
        let mut near_zero = || std::array::from_fn(|_| rng.random_range(-0.05..0.05));
        Self { x: near_zero(), theta: near_zero() }
    }

    fn step(&mut self, action: f32) -> (f64, bool) {
        let (sin, cos) = self.theta[0].sin_cos();
        let force = if action == 1.0 { FORCE } else { -FORCE };
        // Products in Gymnasium's order: the pole is unstable, so that another rounding grows to 1e-5 within eight seconds.
        let push = (force + POLE_MASS * LENGTH * (self.theta[1] * self.theta[1]) * sin) / TOTAL_MASS;
        let turn = (GRAVITY * sin - cos * push) / (LENGTH * (4.0 / 3.0 - POLE_MASS * (cos * cos) / TOTAL_MASS));
        let slide = push - POLE_MASS * LENGTH * turn * cos / TOTAL_MASS;
        // Explicit Euler: positions move by the old speeds.
        self.x = [self.x[0] + DT * self.x[1], self.x[1] + DT * slide];
        self.theta = [self.theta[0] + DT * self.theta[1], self.theta[1] + DT * turn];
        (1.0, self.x[0].abs() > TRACK || self.theta[0].abs() > LEAN)
    }

    fn observe(&self, out: &mut [f32]) {
        let state = [self.x[0], self.x[1], self.theta[0], self.theta[1]];
        out.copy_from_slice(&state.map(|v| v as f32));
    }
}
