//! Acrobot-v1 (Sutton 1996): a double pendulum driven at the elbow swings its tip above a line.

use super::Dynamics;
use crate::ActionSpace;
use egogen::rng::Stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

const GRAVITY: f64 = 9.8;
/// Both links have length, mass and moment of inertia 1; their centres of mass lie half way.
const CENTRE: f64 = 0.5;
const DT: f64 = 0.2;
const MAX_SPEED: [f64; 2] = [4.0 * PI, 9.0 * PI];

/// Two links that hang from a bar; torque -1, 0 or 1 (choices 0, 1, 2) acts at the elbow.
///
/// Observation: cos and sin of the first angle (0 hangs down), cos and sin of the second (relative to the first), both speeds.
/// Reward -1 for every step and 0 for the last; terminated when the tip is more than one link above the bar.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Acrobot {
    pub(super) angle: [f64; 2],
    pub(super) speed: [f64; 2],
}

impl Acrobot {
    /// Accelerations by the equations of Sutton and Barto's book (Gymnasium's default, not those of the 1996 paper).
    pub(super) fn acceleration(angle: [f64; 2], speed: [f64; 2], torque: f64) -> [f64; 2] {
        let (sin, cos) = angle[1].sin_cos();
        let d1 = CENTRE * CENTRE + (1.0 + CENTRE * CENTRE + 2.0 * CENTRE * cos) + 2.0;
        let d2 = CENTRE * CENTRE + CENTRE * cos + 1.0;
        let phi2 = CENTRE * GRAVITY * (angle[0] + angle[1] - FRAC_PI_2).cos();
        let phi1 = -CENTRE * speed[1] * speed[1] * sin - 2.0 * CENTRE * speed[1] * speed[0] * sin
            + (CENTRE + 1.0) * GRAVITY * (angle[0] - FRAC_PI_2).cos()
            + phi2;
        let second = (torque + d2 / d1 * phi1 - CENTRE * speed[0] * speed[0] * sin - phi2) / (CENTRE * CENTRE + 1.0 - d2 * d2 / d1);
        [-(d2 * second + phi1) / d1, second]
    }

    /// Classic Runge-Kutta over the whole step; wraps and limits follow at its end.
    fn integrate(&mut self, torque: f64) {
        let start = [self.angle[0], self.angle[1], self.speed[0], self.speed[1]];
        let slope = |s: [f64; 4]| {
            let [first, second] = Self::acceleration([s[0], s[1]], [s[2], s[3]], torque);
            [s[2], s[3], first, second]
        };
        let along = |k: [f64; 4], dt: f64| std::array::from_fn(|i| start[i] + dt * k[i]);
        let k1 = slope(start);
        let k2 = slope(along(k1, DT / 2.0));
        let k3 = slope(along(k2, DT / 2.0));
        let k4 = slope(along(k3, DT));
        let end: [f64; 4] = along(std::array::from_fn(|i| (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]) / 6.0), DT);
        self.angle = [wrap(end[0]), wrap(end[1])];
        self.speed = std::array::from_fn(|i| end[2 + i].clamp(-MAX_SPEED[i], MAX_SPEED[i]));
    }
}

/// Turns an angle into -pi to pi; both ends stay as they are.
fn wrap(mut angle: f64) -> f64 {
    while angle > PI {
        angle -= TAU;
    }
    while angle < -PI {
        angle += TAU;
    }
    angle
}

impl Dynamics for Acrobot {
    const NAME: &'static str = "Acrobot-v1";
    const LIMIT: u32 = 500;
    const OBS: usize = 6;
    const ACTION: ActionSpace = ActionSpace::Discrete(3);

    fn draw(rng: &mut Stream) -> Self {
        // Gymnasium draws in f64 and rounds the start to f32.
        let mut near_zero = || std::array::from_fn(|_| f64::from(rng.random_range(-0.1..0.1) as f32));
        Self { angle: near_zero(), speed: near_zero() }
    }

    fn step(&mut self, action: f32) -> (f64, bool) {
        self.integrate(f64::from(action) - 1.0);
        let up = -self.angle[0].cos() - (self.angle[0] + self.angle[1]).cos() > 1.0;
        (if up { 0.0 } else { -1.0 }, up)
    }

    fn observe(&self, out: &mut [f32]) {
        let ([(s1, c1), (s2, c2)], [v1, v2]) = (self.angle.map(f64::sin_cos), self.speed);
        out.copy_from_slice(&[c1, s1, c2, s2, v1, v2].map(|v| v as f32));
    }
}
