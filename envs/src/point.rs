//! A point that must walk to a goal on a plane: a task of seconds for testing trainers.

use crate::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
use egogen::rng::{Stream, stream};
use rand::RngExt;
use serde::{Deserialize, Serialize};

/// Longest move of one step.
const STRIDE: f32 = 0.25;
/// The goal counts as reached within this distance.
const REACH: f32 = 0.1;
/// The point may not leave +- this square.
const BOUND: f32 = 1.5;
/// Steps after which an episode is cut off (truncated: the observation does not show the time).
const MAX_STEPS: u32 = 20;
const KIND: &str = "point-goal 1";

/// n points in the plane. Observation "position" [2], "offset" [2] to the goal; the action is the wanted move (cut to 0.25).
///
/// Rewards: the distance gained, 1 on arrival within 0.1 (terminated), -1 on leaving the +-1.5 square (terminated).
/// Cut off (truncated) after 20 steps. Going straight at the goal reaches it in at most 12 steps.
pub struct PointGoal {
    spec: EnvSpec,
    points: Vec<Point>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Point {
    rng: Stream,
    pos: [f32; 2],
    goal: [f32; 2],
    steps: u32,
    total: f32,
}

impl PointGoal {
    /// n points, placed by `seed`.
    pub fn new(n: usize, seed: u64) -> Self {
        let group = |name: &str| ObsGroup { name: name.into(), shape: vec![2] };
        let names = |v: &[&str]| v.iter().map(|s| s.to_string()).collect();
        let spec = EnvSpec {
            obs: vec![group("position"), group("offset")],
            action: ActionSpace::Continuous(2),
            info: names(&["progress", "arrival", "leaving"]),
            episode: names(&["success", "return", "steps", "final_dist"]),
        };
        Self { spec, points: (0..n).map(|i| Point::new(seed, i as u64)).collect() }
    }
}

impl Point {
    fn new(seed: u64, index: u64) -> Self {
        let rng = stream(seed, "point", index);
        let mut point = Self { rng, pos: [0.0; 2], goal: [0.0; 2], steps: 0, total: 0.0 };
        point.restart();
        point
    }

    fn restart(&mut self) {
        self.pos = std::array::from_fn(|_| self.rng.random_range(-1.0..1.0));
        self.goal = std::array::from_fn(|_| self.rng.random_range(-1.0..1.0));
        (self.steps, self.total) = (0, 0.0);
    }

    fn offset(&self) -> [f32; 2] {
        [self.goal[0] - self.pos[0], self.goal[1] - self.pos[1]]
    }

    fn dist(&self) -> f32 {
        let [x, y] = self.offset();
        x.hypot(y)
    }

    fn observe(&self, out: &mut [f32]) {
        out[..2].copy_from_slice(&self.pos);
        out[2..].copy_from_slice(&self.offset());
    }

    /// Moves and returns the three reward terms.
    fn act(&mut self, action: &[f32]) -> [f32; 3] {
        let before = self.dist();
        let cut = (STRIDE / action[0].hypot(action[1]).max(STRIDE)).min(1.0);
        self.pos = [self.pos[0] + cut * action[0], self.pos[1] + cut * action[1]];
        self.steps += 1;
        let arrived = self.dist() < REACH;
        let left = self.pos.iter().any(|x| x.abs() > BOUND);
        let terms = [before - self.dist(), f32::from(arrived), -f32::from(left && !arrived)];
        self.total += terms.iter().sum::<f32>();
        terms
    }
}

impl VecEnv for PointGoal {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.points.len()
    }

    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        *self = Self::new(self.points.len(), seed);
        self.observe(obs)
    }

    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError> {
        self.spec.check_actions(self.points.len(), actions)?;
        out.prepare(&self.spec, self.points.len());
        for (i, point) in self.points.iter_mut().enumerate() {
            let terms = point.act(&actions[2 * i..2 * i + 2]);
            out.info[3 * i..3 * i + 3].copy_from_slice(&terms);
            out.reward[i] = terms.iter().sum();
            out.terminated[i] = terms[1] != 0.0 || terms[2] != 0.0;
            out.truncated[i] = !out.terminated[i] && point.steps >= MAX_STEPS;
            point.observe(&mut out.final_obs[4 * i..4 * i + 4]);
            if out.terminated[i] || out.truncated[i] {
                let figures = [terms[1], point.total, point.steps as f32, point.dist()];
                out.episode[4 * i..4 * i + 4].copy_from_slice(&figures);
                point.restart();
            }
            point.observe(&mut out.obs[4 * i..4 * i + 4]);
        }
        Ok(())
    }

    fn save_state(&self) -> Result<Vec<u8>, EnvError> {
        postcard::to_stdvec(&(KIND, &self.points)).map_err(|e| EnvError::Invalid(format!("cannot save the points: {e}")))
    }

    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let bad = |why: String| EnvError::Invalid(format!("not a saved state of {} points: {why}", self.points.len()));
        let (kind, points): (String, Vec<Point>) = postcard::from_bytes(state).map_err(|e| bad(e.to_string()))?;
        if kind != KIND || points.len() != self.points.len() {
            return Err(bad(format!("it holds {} of kind '{kind}'", points.len())));
        }
        self.points = points;
        Ok(())
    }

    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        obs.clear();
        obs.resize(4 * self.points.len(), 0.0);
        for (point, row) in self.points.iter().zip(obs.chunks_exact_mut(4)) {
            point.observe(row);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance::{Effort, check};

    #[test]
    fn conforms() {
        check(|n, seed| Box::new(PointGoal::new(n, seed)), Effort::default());
    }

    #[test]
    fn going_straight_arrives() {
        let mut env = PointGoal::new(8, 3);
        let (mut obs, mut out) = (Vec::new(), StepResult::default());
        env.reset(3, &mut obs).unwrap();
        let (mut arrived, mut progress) = (0, 0.0);
        for _ in 0..12 {
            let actions: Vec<f32> = obs.chunks_exact(4).flat_map(|o| [o[2], o[3]]).collect();
            env.step(&actions, &mut out).unwrap();
            arrived += out.terminated.iter().filter(|&&t| t).count();
            assert!(out.info.chunks_exact(3).all(|t| t[2] == 0.0) && !out.truncated.contains(&true));
            progress += out.info.chunks_exact(3).map(|t| t[0]).sum::<f32>();
            obs.clone_from(&out.obs);
        }
        assert!(arrived >= 8 && progress > 0.0);
    }

    #[test]
    fn one_step_by_hand() {
        let mut p = Point { rng: stream(0, "point", 0), pos: [0.0, 0.0], goal: [0.6, 0.8], steps: 0, total: 0.0 };
        // A wish of length 1 towards the goal is cut to 0.25: 1 - 0.75.
        let terms = p.act(&[0.6, 0.8]);
        assert!((terms[0] - 0.25).abs() < 1e-6 && terms[1..] == [0.0, 0.0]);
        p.pos = [1.45, 0.0];
        assert_eq!(p.act(&[0.1, 0.0])[2], -1.0);
    }

    #[test]
    fn standing_still_is_cut_off() {
        let mut env = PointGoal::new(16, 1);
        let mut out = StepResult::default();
        env.reset(1, &mut Vec::new()).unwrap();
        for _ in 0..20 {
            env.step(&[0.0; 32], &mut out).unwrap();
        }
        assert!(out.truncated.iter().filter(|&&t| t).count() >= 14);
        assert!(out.episode.chunks_exact(4).all(|e| e[2] == 0.0 || e[2] == 20.0));
    }
}
