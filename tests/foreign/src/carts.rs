//! n carts on a line that are to stop at 0: a push within +-1 a step, cut off after 50 steps.

use egogen::rng::{Stream, stream};
use egogen_envs::{ActionSpace, EnvError, EnvSpec, ObsGroup, StepResult, VecEnv};
use rand::RngExt;

/// Place, speed, and steps so far.
type Cart = (f32, f32, u32);

/// A term of the reward: its name, and its value for a cart and the push that it got.
type Term = (&'static str, fn(Cart, f32) -> f32);
const TERMS: [Term; 2] = [("near", |(x, ..), _| -x.abs()), ("effort", |_, push| -0.1 * push * push)];

pub struct Carts(EnvSpec, Vec<(Cart, Stream)>);

impl Carts {
    pub fn new(n: usize, seed: u64) -> Self {
        let (obs, info) = (ObsGroup { name: "cart".into(), shape: vec![2] }, TERMS.map(|(name, _)| name.into()).to_vec());
        let spec = EnvSpec { obs: vec![obs], action: ActionSpace::Continuous(1), info, episode: vec![] };
        let begin = |mut rng| (begun(&mut rng), rng);
        Self(spec, (0..n as u64).map(|i| begin(stream(seed, "carts", i))).collect())
    }
}

fn begun(rng: &mut Stream) -> Cart {
    (rng.random_range(-1.0..1.0), 0.0, 0)
}

#[rustfmt::skip]
impl VecEnv for Carts {
    fn spec(&self) -> &EnvSpec { &self.0 }
    fn num_envs(&self) -> usize { self.1.len() }
    fn reset(&mut self, seed: u64, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        *self = Self::new(self.1.len(), seed);
        self.observe(obs)
    }
    fn step(&mut self, actions: &[f32], out: &mut StepResult) -> Result<(), EnvError> {
        self.0.check_actions(self.1.len(), actions)?;
        out.prepare(&self.0, self.1.len());
        for (i, (cart, rng)) in self.1.iter_mut().enumerate() {
            let push = actions[i].clamp(-1.0, 1.0);
            *cart = (cart.0 + 0.1 * cart.1, cart.1 + 0.1 * push, cart.2 + 1);
            out.info[2 * i..2 * i + 2].copy_from_slice(&TERMS.map(|(_, term)| term(*cart, push)));
            (out.reward[i], out.truncated[i]) = (out.info[2 * i] + out.info[2 * i + 1], cart.2 == 50);
            out.final_obs[2 * i..2 * i + 2].copy_from_slice(&[cart.0, cart.1]);
            *cart = if out.truncated[i] { begun(rng) } else { *cart };
        }
        self.observe(&mut out.obs)
    }
    fn save_state(&self) -> Result<Vec<u8>, EnvError> { postcard::to_stdvec(&self.1).map_err(|e| EnvError::Invalid(e.to_string())) }
    fn load_state(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let carts: Vec<_> = postcard::from_bytes(state).map_err(|e| EnvError::Invalid(e.to_string()))?;
        if carts.len() == self.1.len() { self.1 = carts; Ok(()) } else { Err(EnvError::Invalid("another number of carts".into())) }
    }
    fn observe(&self, obs: &mut Vec<f32>) -> Result<(), EnvError> {
        *obs = self.1.iter().flat_map(|((x, speed, _), _)| [*x, *speed]).collect();
        Ok(())
    }
}
