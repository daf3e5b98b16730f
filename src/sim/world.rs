//! What people stand on: the body, the motion model and the seed motions, loaded together and checked against each other.

use super::{SeedBank, Sim};
use crate::body::BodyModel;
use crate::kernels::MotionEngine;
use crate::motion::{CONFIG_FILE, MotionWeights};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// File of seed motions in a motion-model folder.
pub const SEEDS_FILE: &str = "seeds.safetensors";

/// A simulation with the seed motions that belong to its motion model.
#[derive(Clone)]
pub struct World {
    /// The simulation.
    pub sim: Arc<Sim>,
    /// Seed motions to train from.
    pub train: Arc<SeedBank>,
    /// Seed motions kept for tests and evaluation.
    pub held_out: Arc<SeedBank>,
}

impl World {
    /// The shipped body and motion model, held by the program itself.
    pub fn embedded() -> Result<Self> {
        const MODEL: [&[u8]; 3] = [
            include_bytes!("../../checkpoints/motion/motion.json"),
            include_bytes!("../../checkpoints/motion/predictor.safetensors"),
            include_bytes!("../../checkpoints/motion/regressor.safetensors"),
        ];
        const SEEDS: &[u8] = include_bytes!("../../checkpoints/motion/seeds.safetensors");
        let dir = Path::new("checkpoints/motion");
        let [config, predictor, regressor] = MODEL.map(<[u8]>::to_vec);
        let body = BodyModel::embedded();
        let seeds = SeedBank::from_bytes(dir.join(SEEDS_FILE), SEEDS, &body)?;
        Self::new(dir, body, &MotionWeights::from_bytes(dir, config, predictor, regressor)?, seeds)
    }

    /// The motion model in the folder `dir` on the body beside it, or on the shipped one; see [`BodyModel::beside`].
    ///
    /// Errors: a missing or damaged file, a motion model or seeds made with another body, fewer than two seeds.
    pub fn load(dir: &Path) -> Result<Self> {
        let body = BodyModel::beside(dir)?;
        let seeds = SeedBank::read(dir.join(SEEDS_FILE), &body)?;
        Self::new(dir, body, &MotionWeights::load(dir)?, seeds)
    }

    /// Content hashes of the body and the motion model: what a policy trained here stands on.
    pub fn origin(&self) -> BTreeMap<String, String> {
        let hashes = [("body", self.sim.body().hash()), ("motion", self.sim.model().hash())];
        hashes.into_iter().map(|(name, hash)| (name.to_string(), hash.to_string())).collect()
    }

    /// People with the body beside the motion model in the folder `dir`, or the shipped one, moved by `weights` of that folder; refused when
    /// they were made with another body.
    pub fn simulation(dir: &Path, weights: &MotionWeights) -> Result<Arc<Sim>> {
        Self::simulate(dir, BodyModel::beside(dir)?, weights)
    }

    fn simulate(dir: &Path, body: Arc<BodyModel>, weights: &MotionWeights) -> Result<Arc<Sim>> {
        if weights.config.body != body.hash() {
            let what = format!("body is '{}', but the body here is '{}'; train the motion model on it", weights.config.body, body.hash());
            return Err(Error::file(dir.join(CONFIG_FILE), what));
        }
        Ok(Arc::new(Sim::new(body, Arc::new(MotionEngine::new(weights)?))))
    }

    fn new(dir: &Path, body: Arc<BodyModel>, weights: &MotionWeights, seeds: SeedBank) -> Result<Self> {
        let sim = Self::simulate(dir, body, weights)?;
        if seeds.seeds.len() < 2 {
            return Err(Error::file(dir.join(SEEDS_FILE), "holds one seed motion, expected some to train and some to test from"));
        }
        let (train, held_out) = seeds.halves();
        Ok(Self { sim, train: Arc::new(train), held_out: Arc::new(held_out) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BETAS, MARKER_DIM};
    use crate::metrics::{contact_score, foot_heights, rigid_marker_error};
    use crate::motion::{FRAMES, SEED};
    use crate::rng::stream;
    use crate::sim::people::JOINT_DIM;
    use crate::sim::{People, Primitives};
    use glam::Vec3;
    use rand_distr::{Distribution, StandardNormal};

    /// 48 people on held-out seeds.
    fn standing() -> (World, People) {
        let world = World::embedded().unwrap();
        let mut people = People::new(48);
        for (i, seed) in world.held_out.seeds.iter().cycle().take(people.len()).enumerate() {
            people.place(i, world.sim.body(), seed, 0.0, 0.0, 0.0).unwrap();
        }
        (world, people)
    }

    /// Latents of everyone's step from N(0, I).
    fn latents(world: &World, people: &People, step: u64) -> Vec<f32> {
        StandardNormal.sample_iter(stream(3, "walk", step)).take(people.len() * world.sim.model().latent_dim()).collect()
    }

    #[test]
    fn people_of_the_shipped_model_stand_on_the_floor_and_stay_whole() {
        let (world, mut people) = standing();
        let mut out = Primitives::default();
        for step in 0..11 {
            let latents = latents(&world, &people, step);
            world.sim.step(&mut people, &latents, &mut out).unwrap();
        }
        let body = world.sim.body().shape(&[0.0; BETAS]);
        let each = out.markers.chunks_exact(FRAMES * MARKER_DIM);
        let mean = |of: &dyn Fn(&[f32]) -> f32| each.clone().map(of).sum::<f32>() / people.len() as f32;
        let lowest = mean(&|m| foot_heights(m).sum::<f32>() / FRAMES as f32);
        assert!((0.0..0.05).contains(&lowest), "the lowest foot marker is at {lowest} m on average");
        let contact = mean(&|m| contact_score(m));
        assert!(contact > 0.9, "contact {contact}");
        let stretched = mean(&|m| rigid_marker_error(&m[SEED * MARKER_DIM..], &body));
        assert!(stretched < 0.02, "markers move {stretched} m against their bones");
    }

    /// With bodies for a few frames people walk nearly the same way.
    #[test]
    fn few_fitted_bodies_are_enough() {
        let (world, mut people) = standing();
        let (mut all, mut few) = (Primitives::default(), Primitives::default());
        let pelvis = |p: &Primitives, i: usize| Vec3::from_slice(&p.joints[(i * FRAMES + FRAMES - 1) * JOINT_DIM..]);
        for (every, most) in [(3, 0.0015), (6, 0.0025)] {
            for step in 0..4 {
                let latents = latents(&world, &people, step);
                world.sim.step_by(every, &mut people.clone(), &latents, &mut few).unwrap();
                world.sim.step(&mut people, &latents, &mut all).unwrap();
                let off: Vec<f32> = all.markers.iter().zip(&few.markers).map(|(a, b)| (a - b).abs()).collect();
                let mean = off.iter().sum::<f32>() / off.len() as f32;
                assert!((1e-6..most).contains(&mean), "every {every}: markers are {mean} m off in step {step}");
                let off = (0..people.len()).map(|i| pelvis(&all, i).distance(pelvis(&few, i)));
                let mean = off.sum::<f32>() / people.len() as f32;
                assert!(mean < 2.5 * most, "every {every}: people end step {step} {mean} m off");
            }
        }
    }

    #[test]
    fn a_folder_of_another_body_and_a_missing_file_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let error = World::load(dir.path()).err().unwrap().to_string();
        assert!(error.contains(SEEDS_FILE), "{error}");
        let shipped = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/motion"));
        for name in ["motion.json", "predictor.safetensors", "regressor.safetensors", SEEDS_FILE] {
            std::fs::copy(shipped.join(name), dir.path().join(name)).unwrap();
        }
        assert_eq!(World::load(dir.path()).unwrap().origin(), World::embedded().unwrap().origin());
        let config = dir.path().join(CONFIG_FILE);
        let text = std::fs::read_to_string(&config).unwrap();
        std::fs::write(&config, text.replace(BodyModel::embedded().hash(), "another")).unwrap();
        let error = World::load(dir.path()).err().unwrap().to_string();
        assert!(error.contains("motion.json") && error.contains("another"), "{error}");
    }
}
