//! Motions made to order: latents of the prior, chosen step by step by where they lead.

use super::gait::{displacement, place_people};
use super::sample::normals;
use crate::Result;
use egogen::Error;
use egogen::body::{BETAS, Frame, MARKER_DIM, ShapedBody};
use egogen::metrics::stance_slide;
use egogen::motion::{FPS, FRAMES, FUTURE, LATENT};
use egogen::rng::{Stream, stream};
use egogen::sim::{People, Primitives, SeedBank, SeedMotion, Sim};
use glam::Vec2;

/// Ways to begin and to go on that are kept at each step.
const KEPT: usize = 8;
/// What facing wrong by one radian and sliding by one metre per stance cost, metres.
const TURN_COST: f32 = 0.4;
const SLIDE_COST: f32 = 2.0;

/// What a person should do in one primitive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Speed ahead and to the right of where it should face, m/s.
    pub forward: f32,
    pub right: f32,
    /// Where it should face in the end, degrees to the left of the beginning.
    pub heading: f32,
}

/// A motion to order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Straight on at 1.2 m/s.
    Straight,
    /// Turns about within four primitives.
    Turn,
    /// Stops, stands for two seconds, and walks on.
    Stop,
    /// Steps to the right, facing ahead.
    Side,
}

impl Order {
    /// One target per primitive.
    pub fn targets(self) -> Vec<Target> {
        let go = |count: usize, forward: f32, right: f32, heading: f32| vec![Target { forward, right, heading }; count];
        let parts = match self {
            Self::Straight => vec![go(12, 1.2, 0.0, 0.0)],
            Self::Turn => {
                let turning = [45.0, 90.0, 135.0, 180.0].map(|h| go(1, 0.5, 0.0, h)).concat();
                vec![go(3, 1.0, 0.0, 0.0), turning, go(4, 1.0, 0.0, 180.0)]
            }
            Self::Stop => {
                vec![go(4, 1.1, 0.0, 0.0), go(1, 0.5, 0.0, 0.0), go(5, 0.0, 0.0, 0.0), go(1, 0.5, 0.0, 0.0), go(4, 1.1, 0.0, 0.0)]
            }
            Self::Side => vec![go(2, 0.0, 0.0, 0.0), go(7, 0.0, 0.5, 0.0), go(2, 0.0, 0.0, 0.0)],
        };
        parts.concat()
    }
}

/// A motion (T x 93, world) that comes near `targets`: from beginnings in `bank` on, at each step `candidates` latents from N(0, I)
/// are tried for each of the 8 best motions so far.
pub fn steer(sim: &Sim, bank: &SeedBank, targets: &[Target], candidates: usize, seed: u64) -> Result<Vec<f32>> {
    let body = sim.body().shape(&[0.0; BETAS]);
    let starts: Vec<SeedMotion> = bank.seeds.iter().cycle().take(KEPT * candidates).map(mean_shape).collect();
    let mut kept = Kept { people: place_people(sim, &starts)?, films: vec![(Vec::new(), 0.0); starts.len()] };
    for (k, target) in targets.iter().enumerate() {
        let each = if k == 0 { 1 } else { candidates };
        kept = kept.step(sim, &body, target, each, &mut stream(seed, "steering latents", k as u64))?;
    }
    kept.films.into_iter().next().map(|(film, _)| film).ok_or_else(|| Error::invalid("no seed motion to start from").into())
}

/// A motion (T x 93, world) of `primitives` primitives led by the prior from the beginning that `seed` draws from `bank`.
pub fn wander(sim: &Sim, bank: &SeedBank, primitives: usize, seed: u64) -> Result<Vec<f32>> {
    let body = sim.body().shape(&[0.0; BETAS]);
    let Some(start) = bank.seeds.get(seed as usize % bank.seeds.len().max(1)) else {
        return Err(Error::invalid("no seed motion to start from").into());
    };
    let mut people = place_people(sim, &[mean_shape(start)])?;
    let (mut out, mut film) = (Primitives::default(), Vec::new());
    for k in 0..primitives {
        let latents = normals(&mut stream(seed, "wandering latents", k as u64), LATENT);
        sim.step(&mut people, &latents, &mut out)?;
        out.record(0, &body, &mut film);
    }
    Ok(film)
}

fn mean_shape(seed: &SeedMotion) -> SeedMotion {
    SeedMotion { betas: [0.0; BETAS], ..seed.clone() }
}

/// Motions under way, the best first.
struct Kept {
    people: People,
    /// Each one's frames, and what its steps cost.
    films: Vec<(Vec<f32>, f32)>,
}

impl Kept {
    fn step(self, sim: &Sim, body: &ShapedBody, target: &Target, each: usize, rng: &mut Stream) -> Result<Self> {
        let parents: Vec<usize> = (0..self.films.len()).flat_map(|i| std::iter::repeat_n(i, each)).collect();
        let mut people = self.people.select(&parents);
        let mut out = Primitives::default();
        sim.step(&mut people, &normals(rng, parents.len() * LATENT), &mut out)?;
        let cost = |i: usize| {
            let markers = &out.markers[i * FRAMES * MARKER_DIM..(i + 1) * FRAMES * MARKER_DIM];
            let (from, to) = (&out.frames[i], &people.frames[i]);
            let [_, _, turned] = displacement(&Frame::IDENTITY, to);
            let moved = (to.transl - from.transl).truncate();
            self.films[parents[i]].1 + step_cost(target, moved, turned) + SLIDE_COST * stance_slide(markers)
        };
        let costs: Vec<f32> = (0..parents.len()).map(cost).collect();
        let mut order: Vec<usize> = (0..parents.len()).collect();
        order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]));
        order.truncate(KEPT);
        let film = |&i: &usize| {
            let mut film = self.films[parents[i]].0.clone();
            out.record(i, body, &mut film);
            (film, costs[i])
        };
        Ok(Self { people: people.select(&order), films: order.iter().map(film).collect() })
    }
}

/// What it costs to have moved by `moved` (world, metres) and to face `turned` degrees to the left of the world's y axis, metres.
fn step_cost(target: &Target, moved: Vec2, turned: f32) -> f32 {
    let seconds = FUTURE as f32 / FPS;
    let wanted = Vec2::from_angle(target.heading.to_radians()).rotate(Vec2::new(target.right, target.forward)) * seconds;
    let off = (turned - target.heading + 180.0).rem_euclid(360.0) - 180.0;
    moved.distance(wanted) + TURN_COST * off.to_radians().abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::body::PARAMS;
    use egogen::sim::World;

    #[test]
    fn costs_by_hand() {
        let target = Target { forward: 1.0, right: 0.0, heading: 90.0 };
        // Facing left, ahead is the world's -x.
        assert!(step_cost(&target, Vec2::new(-0.45, 0.0), 90.0) < 1e-6);
        assert!((step_cost(&target, Vec2::new(-0.45, 0.3), -225.0) - 0.3 - 0.4 * 45f32.to_radians()).abs() < 1e-5);
        let aside = Target { forward: 0.0, right: 1.0, heading: 0.0 };
        assert!((step_cost(&aside, Vec2::ZERO, 0.0) - 0.45).abs() < 1e-6);
    }

    #[test]
    fn more_candidates_come_nearer() {
        let world = World::embedded().unwrap();
        let targets = &Order::Straight.targets()[..3];
        let ends = |candidates| {
            let film = steer(&world.sim, &world.held_out, targets, candidates, 1).unwrap();
            assert_eq!(film.len(), (2 + 3 * FUTURE) * PARAMS);
            let end = &film[film.len() - PARAMS..];
            Vec2::new(end[0], end[1]).distance(Vec2::new(0.0, 1.2 * 3.0 * 0.45))
        };
        let (few, many) = (ends(1), ends(12));
        assert!(many < 0.3 && many < few + 0.05, "{many} m off with 12 candidates, {few} m with one");
        assert_eq!(wander(&world.sim, &world.held_out, 2, 3).unwrap().len(), (2 + 2 * FUTURE) * PARAMS);
    }
}
