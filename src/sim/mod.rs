//! Many people stepped together: latent actions in, 20 frames and the next state out. No reward, no learning.

mod people;
mod plant;
mod seed;
mod step;
mod world;

pub use people::{People, Primitives, yaw_towards};
pub use seed::{SeedBank, SeedMotion};
pub use step::Sim;
pub use world::{SEEDS_FILE, World};
