//! Who walks in a scenario: build, first pose and turn.

use super::scenario::Looks;
use crate::Result;
use egogen::body::{BETAS, MARKER_DIM, PARAMS, TRANSL, smplx_weights};
use egogen::rng::Stream;
use egogen::scene::SdfGrid;
use egogen::sim::{People, SeedMotion, World, yaw_towards};
use glam::{Vec2, Vec3};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

/// First two shape coefficients of a male-like and a female-like body (see the body's card).
const BUILDS: [[f32; 2]; 2] = [[1.0, -1.0], [-1.0, 1.0]];

/// A person's first pose with its shape, and how far it is turned away from its goal, radians.
pub type Start = (SeedMotion, f32);

/// First pose and shape of the `n` people of a scene, and their turns.
pub fn first_poses(looks: &Looks, n: usize, world: &World, rng: &mut Stream) -> Result<Vec<Start>> {
    let bank = &world.held_out.seeds;
    let build = if looks.builds { BUILDS[rng.random_range(0..2)] } else { [0.0; 2] };
    let noise = looks.turn_deg.to_radians();
    let mut person = || {
        let mut seed = bank[rng.random_range(0..bank.len())].clone();
        let turn = rng.random_range(-noise..=noise);
        if looks.builds || looks.shape > 0.0 {
            let mut betas = [0.0; BETAS];
            betas[..2].copy_from_slice(&build);
            betas.iter_mut().for_each(|b| *b += looks.shape * Distribution::<f32>::sample(&StandardNormal, rng));
            reshape(&mut seed, betas, world);
        }
        (seed, turn)
    };
    Ok((0..n).map(|_| person()).collect())
}

/// Gives the person of a seed another shape, its lowest marker as high as before.
fn reshape(seed: &mut SeedMotion, betas: [f32; BETAS], world: &World) {
    let lowest = |seed: &SeedMotion| {
        let (shaped, mut markers) = (world.sim.body().shape(&seed.betas), [0.0; MARKER_DIM]);
        shaped.markers(&shaped.pose(&seed.params[..PARAMS]), &mut markers);
        markers.chunks_exact(3).map(|m| Vec3::from_slice(m).z).fold(f32::INFINITY, f32::min)
    };
    let before = lowest(seed);
    seed.betas = betas;
    let sunk = before - lowest(seed);
    seed.params.chunks_exact_mut(PARAMS).for_each(|p| p[TRANSL][2] += sunk);
}

/// Whether a person who goes from the first place of `pair` to the second begins with no vertex inside what stands there; feet do not
/// count.
pub fn stands_free((seed, turn): &Start, [from, to]: [Vec2; 2], sdf: &SdfGrid, world: &World) -> bool {
    let (model, mut people, way) = (world.sim.body(), People::new(1), to - from);
    if people.place(0, model, seed, yaw_towards(way.x, way.y) + turn, from.x, from.y).is_err() {
        return false;
    }
    let (shaped, weights, mut vertices) = (model.shape(&seed.betas), smplx_weights(model), Vec::new());
    people.params.chunks_exact(PARAMS).all(|params| {
        model.skin(&shaped, &shaped.pose(params), &mut vertices);
        vertices.iter().zip(&weights).all(|(v, w)| *w == 0.0 || sdf.at(people.frames[0].point(*v)) >= 0.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::rng::stream;

    #[test]
    fn builds_differ_and_stand_on_the_floor() {
        let world = World::embedded().unwrap();
        let looks = Looks { turn_deg: 0.0, builds: true, shape: 0.3 };
        let rng = &mut stream(1, "looks", 0);
        let scenes: Vec<_> = (0..8).map(|_| first_poses(&looks, 2, &world, rng).unwrap()).collect();
        let tall = |s: &[(SeedMotion, f32)]| s.iter().map(|p| p.0.betas[0] > 0.0).collect::<Vec<_>>();
        assert!(scenes.iter().any(|s| tall(s)[0]) && scenes.iter().any(|s| !tall(s)[0]));
        assert!(scenes.iter().filter(|s| tall(s)[0] == tall(s)[1]).count() >= 7, "of one build");
        for (seed, _) in scenes.iter().flatten() {
            let (shaped, mut markers) = (world.sim.body().shape(&seed.betas), [0.0; MARKER_DIM]);
            shaped.markers(&shaped.pose(&seed.params[..PARAMS]), &mut markers);
            let low = markers.iter().skip(2).step_by(3).fold(f32::INFINITY, |a, &b| a.min(b));
            assert!((-0.02..0.06).contains(&low), "{low}");
        }
    }

    #[test]
    fn whoever_stands_in_something_is_told() {
        let world = World::embedded().unwrap();
        let start = (world.held_out.seeds[0].clone(), 0.3);
        // Samples 10 cm apart of the distance to the half space x > 1 m.
        let (dims, voxel, lowest) = ([41, 41, 25], 0.1, Vec3::new(-2.0, -2.0, -0.2));
        let values = (0..dims[0] * dims[1] * dims[2]).map(|i| 3.0 - 0.1 * (i / (dims[1] * dims[2])) as f32).collect();
        let sdf = SdfGrid { lowest, voxel, dims, values };
        let free = |x: f32| stands_free(&start, [Vec2::new(x, 0.0), Vec2::new(-2.0, 0.0)], &sdf, &world);
        // A body is narrower than 1.2 m and wider than 20 cm.
        assert!(free(0.4) && free(-1.0) && !free(0.95) && !free(1.5));
    }
}
