//! The vectorised environment of the motion task.

use super::cast::{Cast, Stage};
use super::crowd::Crowd;
use super::member::{Member, OBS, STATE, Step, blocked};
use super::{EPISODE, MotionTask, OwnTerm, TERMS};
use crate::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
use egogen::body::PARAMS;
use egogen::motion::{FRAMES, PosePrior, SEED};
use egogen::rng::stream;
use egogen::scene::{CrowdedScene, Polygon, Setting, Split};
use egogen::sensing::RAYS;
use egogen::sim::{People, Primitives, SeedBank, Sim, yaw_towards};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::sync::Arc;

/// First word of a saved state; counts up when its layout changes.
const KIND: &str = "motion-env 4";

/// Which episodes are played. The draws of episode k of environment i depend on the seed and on:
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Starts {
    /// (i, k): training; the number of environments has no influence.
    Fresh,
    /// k n + i: evaluation; start number j is the same for every policy, however long its episodes are.
    Fixed,
}

/// n people on the motion task, each in a random scene of its own that changes with every episode.
///
/// Observation: "state" [2, 402] (per seed frame 67 markers, then 67 unit vectors from marker to goal; canonical frame with the origin of
/// the motion model's),
/// "egosensing" [2, 32] (see [`egogen::sensing::look`]), "dist" [1] = 1 / (1 + d), "time" [1] = 1 - steps / max_depth.
/// Action: the latent of the motion model or its most active dimensions (`latents`), unbounded. Info: the weighted reward terms. Episodes end on success, on
/// penetration and at the step limit (all of them terminations). Figures of an episode: see [`EPISODE`].
pub struct MotionEnv {
    spec: EnvSpec,
    task: MotionTask,
    own: Vec<OwnTerm>,
    starts: Starts,
    sim: Arc<Sim>,
    bank: Arc<SeedBank>,
    /// Judges poses; none when eq. 9 has no weight.
    judge: Option<PoseJudge>,
    /// The rooms, for a task in rooms.
    crowd: Option<Crowd>,
    /// The episodes, where they are given instead of drawn.
    stage: Option<Stage>,
    state: State,
    prims: Primitives,
}

/// A pose prior with a threshold (eq. 9).
struct PoseJudge {
    prior: Arc<PosePrior>,
    threshold: f32,
}

impl PoseJudge {
    fn new(task: &MotionTask) -> Result<Option<Self>, EnvError> {
        if task.weights.pose == 0.0 {
            return Ok(None);
        }
        let prior = match &task.pose.prior {
            Some(path) => Arc::new(PosePrior::load(path)?),
            None => PosePrior::embedded()?,
        };
        let threshold = task.pose.threshold.unwrap_or(prior.threshold());
        Ok(Some(Self { prior, threshold }))
    }

    /// Whether the mean ||VP|| over the primitive of person `i` is below the threshold.
    fn natural(&self, prims: &Primitives, i: usize) -> bool {
        let norms = self.prior.norms(&prims.params[i * FRAMES * PARAMS..][..FRAMES * PARAMS]);
        norms.iter().sum::<f32>() / (FRAMES as f32) < self.threshold
    }
}

/// Fewest people that one task works on.
const CHUNK: usize = 4;

type Identity = (MotionTask, Starts, String);

#[derive(Clone, Debug, Serialize, Deserialize)]
struct State {
    seed: u64,
    people: People,
    members: Vec<Member>,
}

impl MotionEnv {
    /// n environments that train on fresh scenes drawn from `seed`.
    pub fn new(task: MotionTask, sim: Arc<Sim>, bank: Arc<SeedBank>, n: usize, seed: u64) -> Result<Self, EnvError> {
        Self::build(task, sim, (bank, None), n, seed, Starts::Fresh)
    }

    /// n environments that play a numbered list of starts fixed by `seed`: first 0 to n-1, then environment i goes on to n+i.
    pub fn evaluation(task: MotionTask, sim: Arc<Sim>, bank: Arc<SeedBank>, n: usize, seed: u64) -> Result<Self, EnvError> {
        Self::build(task, sim, (bank, None), n, seed, Starts::Fixed)
    }

    /// Plays the episodes of `cast`, one person each, instead of drawing any; `task.scene` and `task.rooms` have no influence.
    ///
    /// Each is played once: whoever ends stands where it is, seen by the others, until the next reset. The state cannot be saved.
    pub fn staged(task: MotionTask, sim: Arc<Sim>, cast: Cast) -> Result<Self, EnvError> {
        let (task, n) = (MotionTask { rooms: None, ..task }, cast.roles.len());
        Self::build(task, sim, (Arc::default(), Some(Stage::new(cast)?)), n, 0, Starts::Fixed)
    }

    fn build(
        task: MotionTask,
        sim: Arc<Sim>,
        (bank, stage): (Arc<SeedBank>, Option<Stage>),
        n: usize,
        seed: u64,
        starts: Starts,
    ) -> Result<Self, EnvError> {
        task.validate()?;
        if stage.is_none() && bank.seeds.is_empty() {
            return Err(EnvError::Invalid("the seed bank is empty, expected at least one seed motion".into()));
        }
        let dim = sim.model().latent_dim();
        if let Some(k) = task.latents.filter(|&k| k > dim) {
            return Err(EnvError::Invalid(format!("latents is {k}, expected at most the motion model's {dim}")));
        }
        let spec = spec(task.latents.unwrap_or(dim));
        let state = State { seed, people: People::new(n), members: vec![Member::default(); n] };
        let judge = PoseJudge::new(&task)?;
        let crowd = Crowd::new(&task, &sim, n, if starts == Starts::Fixed { Split::Validation } else { Split::Train })?;
        let mut env = Self { spec, task, own: Vec::new(), starts, sim, bank, judge, crowd, stage, state, prims: Primitives::default() };
        env.restart(seed)?;
        Ok(env)
    }

    /// Adds terms of one's own to the reward and to the figures of a step.
    pub fn with_terms(mut self, own: Vec<OwnTerm>) -> Self {
        self.spec.info.extend(own.iter().map(|term| term.name.clone()));
        self.own.extend(own);
        self
    }

    /// The simulation that moves everyone.
    pub fn sim(&self) -> &Sim {
        &self.sim
    }

    /// The task.
    pub fn task(&self) -> &MotionTask {
        &self.task
    }

    /// Where everyone stands now.
    pub fn people(&self) -> &People {
        &self.state.people
    }

    /// The motion of the last step, of the episodes that it may have ended.
    pub fn primitives(&self) -> &Primitives {
        &self.prims
    }

    /// Scene, start and goal of environment `i`'s present episode (ask before a step to know where that step happens).
    pub fn setting(&self, i: usize) -> &Setting {
        &self.state.members[i].setting
    }

    /// The room of environment `i`'s present episode, for a task in rooms.
    pub fn room(&self, i: usize) -> Option<&CrowdedScene> {
        self.crowd.as_ref().zip(self.state.members[i].room).and_then(|(crowd, room)| crowd.scene(room).ok())
    }

    /// The given episodes, where they are not drawn.
    pub fn cast(&self) -> Option<&Cast> {
        self.stage.as_ref().map(|stage| &stage.cast)
    }

    /// Where person `i` may walk now: its scene's floor, less what moves there and where others stand.
    pub fn ground(&self, i: usize) -> Cow<'_, Polygon> {
        ground(&self.stage, &self.state.members[i], i)
    }

    /// Number of the start that environment `i` plays now; meaningful for [`Starts::Fixed`].
    pub fn start_number(&self, i: usize) -> u64 {
        self.draw_index(i, self.state.members[i].episode)
    }

    /// What a saved state must have in common with this environment.
    fn identity(&self) -> Identity {
        (self.task.clone(), self.starts, self.sim.model().hash().to_string())
    }

    fn draw_index(&self, i: usize, episode: u64) -> u64 {
        match self.starts {
            Starts::Fresh => ((i as u64) << 40) + episode,
            Starts::Fixed => episode * self.num_envs() as u64 + i as u64,
        }
    }

    fn restart(&mut self, seed: u64) -> Result<(), EnvError> {
        self.state.seed = seed;
        (0..self.num_envs()).try_for_each(|i| self.begin(i, 0))?;
        if let Some(stage) = &mut self.stage {
            stage.begin(&self.state.people);
        }
        Ok(())
    }

    /// Draws scene, start, seed motion and turn until the body's box is free of blocked cells.
    fn begin(&mut self, i: usize, episode: u64) -> Result<(), EnvError> {
        if let Some(stage) = &self.stage {
            let setting = stage.place(i, self.sim.body(), &mut self.state.people)?;
            self.state.members[i] = Member::begin(episode, (None, setting), &self.state.people, i);
            return Ok(());
        }
        let purpose = if self.starts == Starts::Fixed { "fixed start" } else { "episode" };
        let mut rng = stream(self.state.seed, purpose, self.draw_index(i, episode));
        let noise = self.task.yaw_noise_deg.to_radians();
        for _ in 0..1000 {
            let (room, setting) = match &self.crowd {
                Some(crowd) => crowd.draw(&mut rng),
                None => (None, self.task.scene.draw(&mut rng)?),
            };
            let to = setting.goal - setting.start;
            let turn = rng.random_range(-noise..=noise);
            let seed = &self.bank.seeds[rng.random_range(0..self.bank.seeds.len())];
            let yaw = yaw_towards(to.x, to.y) + turn;
            self.state.people.place(i, self.sim.body(), seed, yaw, setting.start.x, setting.start.y)?;
            let people = &self.state.people;
            self.crowd.iter_mut().for_each(|crowd| crowd.dress(i, people));
            let free = match (&self.crowd, room) {
                (Some(crowd), Some(room)) => crowd.stands_free(room, people, i),
                _ => blocked(&self.task, people, i, &setting.scene.walkable) == 0,
            };
            if free {
                self.state.members[i] = Member::begin(episode, (room, setting), people, i);
                return Ok(());
            }
        }
        Err(EnvError::Invalid("no free start in 1000 draws: give scene.clearance (in rooms: pairs.clearance) more room".into()))
    }

    fn write_obs(&self, obs: &mut [f32]) {
        let State { people, members, .. } = &self.state;
        let rows = obs.par_chunks_exact_mut(OBS).zip(members).with_min_len(CHUNK);
        rows.enumerate().for_each(|(i, (row, member))| {
            member.observe(&self.task, (people, i), &self.ground(i), self.sim.model().origin(), row);
        });
    }

    /// Judges everyone after a step; returns who ended.
    fn judge(&mut self, out: &mut StepResult) -> Result<Vec<usize>, EnvError> {
        let State { people, members, .. } = &mut self.state;
        let (task, prims, people, judge) = ((&self.task, self.own.as_slice()), &self.prims, &*people, &self.judge);
        let (names, crowd, stage) = (&self.spec.info, &self.crowd, &self.stage);
        let (terms, figures) = (out.info.par_chunks_exact_mut(names.len()), out.episode.par_chunks_exact_mut(EPISODE.len()));
        let each = (members, terms, figures, &mut out.reward, &mut out.terminated).into_par_iter().with_min_len(CHUNK);
        each.enumerate().for_each(|(i, (member, terms, episode, reward, ended))| {
            if stage.as_ref().is_some_and(|stage| stage.done[i]) {
                return;
            }
            let natural = judge.as_ref().is_none_or(|j| j.natural(prims, i));
            let presence = crowd.as_ref().zip(member.room).map(|(crowd, room)| crowd.presence(room, prims, i));
            let blocked = if presence.is_some() { 0 } else { blocked(task.0, people, i, &ground(stage, member, i)) };
            let verdict = member.judge(task, &Step { people, prims, person: i, natural, blocked, presence }, terms, episode);
            (*reward, *ended) = (verdict.reward, verdict.ended);
        });
        if let Some(i) = out.reward.iter().position(|r| !r.is_finite()) {
            let k = out.info[i * names.len()..].iter().position(|t| !t.is_finite()).unwrap_or(0);
            let what = format!("reward term '{}' of environment {i} is {}", names[k], out.info[i * names.len() + k]);
            return Err(EnvError::Invalid(format!("{what}: the motion model left all bounds")));
        }
        Ok((0..out.terminated.len()).filter(|&i| out.terminated[i]).collect())
    }
}

impl VecEnv for MotionEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.state.members.len()
    }

    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        self.restart(seed)?;
        self.observe(obs)
    }

    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError> {
        self.spec.check_actions(self.num_envs(), actions)?;
        out.prepare(&self.spec, self.num_envs());
        let held = self.stage.as_ref().map(Stage::held).unwrap_or_default();
        let standing = self.state.people.select(&held);
        let every = if self.starts == Starts::Fresh { self.task.body_every } else { 1 };
        match self.task.latents {
            Some(k) => self.sim.step_by(every, &mut self.state.people, &self.sim.widen(actions, k)?, &mut self.prims)?,
            None => self.sim.step_by(every, &mut self.state.people, actions, &mut self.prims)?,
        }
        self.state.people.put(&held, &standing);
        if let Some(stage) = &mut self.stage {
            stage.moved(&self.state.people);
        }
        let ended = self.judge(out)?;
        self.write_obs(&mut out.final_obs);
        out.obs.copy_from_slice(&out.final_obs);
        if let Some(stage) = &mut self.stage {
            ended.into_iter().for_each(|i| stage.done[i] = true);
            return Ok(());
        }
        for i in ended {
            self.begin(i, self.state.members[i].episode + 1)?;
            let row = &mut out.obs[i * OBS..(i + 1) * OBS];
            let member = &self.state.members[i];
            member.observe(&self.task, (&self.state.people, i), &member.setting.scene.walkable, self.sim.model().origin(), row);
        }
        Ok(())
    }

    fn save_state(&self) -> Result<Vec<u8>, EnvError> {
        if self.stage.is_some() {
            return Err(EnvError::Invalid("the state of given episodes cannot be saved".into()));
        }
        let saved = (KIND, self.identity(), &self.state);
        postcard::to_stdvec(&saved).map_err(|e| EnvError::Invalid(format!("cannot save the motion environments: {e}")))
    }

    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let bad = |why: String| EnvError::Invalid(format!("not a saved state of these {} motion environments: {why}", self.num_envs()));
        let (kind, rest) = postcard::take_from_bytes::<&str>(state).map_err(|e| bad(e.to_string()))?;
        if kind != KIND {
            return Err(bad(format!("it is of kind '{kind}', expected '{KIND}'")));
        }
        let (identity, state): (Identity, State) = postcard::from_bytes(rest).map_err(|e| bad(e.to_string()))?;
        if identity != self.identity() {
            return Err(bad("it was saved with another task, motion model or choice of starts".into()));
        }
        if [state.members.len(), state.people.len()] != [self.num_envs(); 2] {
            return Err(bad(format!("it holds {}", state.members.len())));
        }
        if let Some(i) = state.members.iter().position(|m| m.room.is_some() != self.crowd.is_some()) {
            return Err(bad(format!("environment {i} of it does not say in which room it plays")));
        }
        if let Some((i, room)) = state.members.iter().enumerate().find_map(|(i, m)| Some((i, self.crowd.as_ref()?.scene(m.room?).err()?))) {
            return Err(bad(format!("environment {i} of it plays in {room}")));
        }
        self.state = state;
        self.crowd.iter_mut().for_each(|crowd| (0..self.state.members.len()).for_each(|i| crowd.dress(i, &self.state.people)));
        Ok(())
    }

    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        obs.clear();
        obs.resize(self.num_envs() * OBS, 0.0);
        self.write_obs(obs);
        Ok(())
    }
}

fn ground<'a>(stage: &Option<Stage>, member: &'a Member, i: usize) -> Cow<'a, Polygon> {
    let walkable = &member.setting.scene.walkable;
    stage.as_ref().map_or(Cow::Borrowed(walkable), |stage| stage.ground(i, walkable))
}

fn spec(latent_dim: usize) -> EnvSpec {
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.to_vec() };
    EnvSpec {
        obs: vec![group("state", &[SEED, STATE / SEED]), group("egosensing", &[SEED, RAYS]), group("dist", &[1]), group("time", &[1])],
        action: ActionSpace::Continuous(latent_dim),
        info: TERMS.iter().map(|t| t.name.to_string()).collect(),
        episode: EPISODE.iter().map(|s| s.to_string()).collect(),
    }
}
