//! The reward terms of the paper's supplementary, one function each.

use super::Weights;
use egogen::metrics::{foot_heights, foot_speeds};
use glam::Vec3;

/// What one step led one person to. Points are those of the step's last frame, in the person's new canonical frame.
#[derive(Clone, Copy, Debug)]
pub struct Outcome<'a> {
    /// 20 x 201 markers of the primitive; z from the floor.
    pub markers: &'a [f32],
    pub pelvis: Vec3,
    pub head: Vec3,
    /// Unit viewing direction of the head.
    pub view: Vec3,
    /// Unit forward direction of the hips, horizontal.
    pub forward: Vec3,
    /// The goal, at the height of the pelvis at the start of the episode.
    pub goal: Vec3,
    /// Distance from pelvis to goal one step ago, metres.
    pub dist_before: f32,
    /// Distance from pelvis to goal, metres.
    pub dist: f32,
    /// Mean ||VP|| of the 20 frames' poses is below the task's threshold.
    pub natural: bool,
    /// Nearer than the task's success distance.
    pub arrived: bool,
    /// The body's box holds as many non-walkable cells, or in rooms one frame as many vertices inside, as the task forbids.
    pub penetrates: bool,
    /// In rooms the value of eq. 8.
    pub crowded: Option<f32>,
    /// Steps left in the episode.
    pub left: u32,
}

/// One named part of the reward.
#[derive(Clone, Copy, Debug)]
pub struct Term {
    pub name: &'static str,
    /// Its value before weighting.
    pub value: fn(&Outcome) -> f32,
    /// Its weight.
    pub weight: fn(&Weights) -> f32,
}

/// A term that other crates add to [`TERMS`].
#[derive(Clone, Debug)]
pub struct OwnTerm {
    /// Its name in the figures of a step.
    pub name: String,
    /// Its value before weighting.
    pub value: fn(&Outcome) -> f32,
    /// Its weight.
    pub weight: f32,
}

/// All terms of the task itself; the reward of a step is their weighted sum.
pub const TERMS: [Term; 9] = [
    Term { name: "floor", value: floor, weight: |w| w.floor },
    Term { name: "skate", value: skate, weight: |w| w.skate },
    Term { name: "dist", value: dist, weight: |w| w.dist },
    Term { name: "orient", value: orient, weight: |w| w.orient },
    Term { name: "attention", value: attention, weight: |w| w.attention },
    Term { name: "pose", value: pose, weight: |w| w.pose },
    Term { name: "penetration", value: penetration, weight: |w| w.penetration },
    Term { name: "success", value: success, weight: |w| w.success },
    Term { name: "arrival", value: arrival, weight: |w| w.arrival },
];

/// Eq. 3: exp(-(height of the lowest foot marker - 0.02 m)+), the excess averaged over the 20 frames.
fn floor(o: &Outcome) -> f32 {
    (-mean(foot_heights(o.markers).map(|z| (z - 0.02).max(0.0)))).exp()
}

/// Eq. 4: exp(-(speed of the slowest foot marker - 0.075 m/s)+), the excess averaged over the 18 inner frames.
fn skate(o: &Outcome) -> f32 {
    (-mean(foot_speeds(o.markers).map(|v| (v - 0.075).max(0.0)))).exp()
}

/// Eq. 5: the distance gained, metres.
fn dist(o: &Outcome) -> f32 {
    o.dist_before - o.dist
}

/// Eq. 6: whether the hips face the goal, in the plane; 0 to 1.
fn orient(o: &Outcome) -> f32 {
    let to = (o.goal - o.pelvis).truncate().normalize_or_zero();
    (o.forward.truncate().dot(to) + 1.0) / 2.0
}

/// Eq. 1: whether the head looks at the goal, in space; 0 to 1.
fn attention(o: &Outcome) -> f32 {
    (o.view.dot((o.goal - o.head).normalize_or_zero()) + 1.0) / 2.0
}

/// Eq. 9: 0.05 while the poses are natural.
fn pose(o: &Outcome) -> f32 {
    if o.natural { 0.05 } else { 0.0 }
}

/// Eq. 8 in rooms; else eq. 7: 0.05 while the body's box holds too few non-walkable cells to count.
fn penetration(o: &Outcome) -> f32 {
    o.crowded.unwrap_or(if o.penetrates { 0.0 } else { 0.05 })
}

/// Eq. 10: 1 on arrival.
fn success(o: &Outcome) -> f32 {
    f32::from(o.arrived)
}

/// Not in the paper: steps left on a clean arrival.
fn arrival(o: &Outcome) -> f32 {
    if o.arrived && !o.penetrates { o.left as f32 } else { 0.0 }
}

fn mean(values: impl ExactSizeIterator<Item = f32>) -> f32 {
    let n = values.len();
    values.sum::<f32>() / n as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::body::{FOOT_MARKERS, MARKER_DIM};
    use egogen::motion::FRAMES;

    fn near(a: f32, b: f32) -> bool {
        (a - b).abs() < 1e-5
    }

    /// 20 frames of markers: foot marker number k at height 0.05 k + `z`, all markers moving at `speed` m/s along y.
    fn film(z: f32, speed: f32) -> Vec<f32> {
        let mut m = vec![1.0; FRAMES * MARKER_DIM];
        for (t, frame) in m.chunks_exact_mut(MARKER_DIM).enumerate() {
            frame.iter_mut().skip(1).step_by(3).for_each(|y| *y = speed * t as f32 / 40.0);
            for (k, &i) in FOOT_MARKERS.iter().enumerate() {
                frame[3 * i + 2] = z + 0.05 * k as f32;
            }
        }
        m
    }

    fn outcome(markers: &[f32]) -> Outcome<'_> {
        Outcome {
            markers,
            pelvis: Vec3::new(0.0, 0.0, 0.9),
            head: Vec3::new(0.0, 0.0, 1.5),
            view: Vec3::Y,
            forward: Vec3::Y,
            goal: Vec3::new(0.8, 0.0, 0.9),
            dist_before: 1.3,
            dist: 0.8,
            natural: true,
            arrived: false,
            penetrates: false,
            crowded: None,
            left: 3,
        }
    }

    #[test]
    fn feet_by_hand() {
        let score = |f: fn(&Outcome) -> f32, z, v| f(&outcome(&film(z, v)));
        // Eq. 3: 12 cm up is 10 cm too much; one-sided, so under the floor costs nothing.
        assert!(near(score(floor, 0.12, 0.0), (-0.1f32).exp()));
        assert_eq!(score(floor, 0.02, 0.0), 1.0);
        assert_eq!(score(floor, -0.1, 0.0), 1.0);
        // Eq. 4: 0.875 m/s is 0.8 m/s too fast.
        assert!(near(score(skate, 0.0, 0.875), (-0.8f32).exp()));
        assert_eq!(score(skate, 0.0, 0.07), 1.0);
        // One of 20 frames 1 m up: the mean excess is 0.98 / 20.
        let mut m = film(0.0, 0.0);
        FOOT_MARKERS.iter().for_each(|&i| m[3 * i + 2] = 1.0);
        assert!(near(floor(&outcome(&m)), (-0.049f32).exp()));
    }

    #[test]
    fn goal_terms_by_hand() {
        let o = outcome(&[]);
        assert!(near(dist(&o), 0.5));
        // Eq. 6: forward +y, goal +x: a right angle.
        assert!(near(orient(&o), 0.5));
        assert!(near(orient(&Outcome { forward: Vec3::X, ..o }), 1.0));
        assert!(near(orient(&Outcome { forward: Vec3::NEG_X, ..o }), 0.0));
        // Eq. 1: from the head the goal lies at (0.8, 0, -0.6); looking along +x gives (0.8 + 1) / 2.
        assert!(near(attention(&Outcome { view: Vec3::X, ..o }), 0.9));
        assert!(near(attention(&Outcome { view: Vec3::NEG_Z, ..o }), 0.8));
        assert!(near(attention(&o), 0.5));
    }

    #[test]
    fn ends_by_hand() {
        let o = outcome(&[]);
        assert_eq!([penetration(&o), success(&o), arrival(&o)], [0.05, 0.0, 0.0]);
        assert_eq!([pose(&o), pose(&Outcome { natural: false, ..o })], [0.05, 0.0]);
        let there = Outcome { arrived: true, ..o };
        assert_eq!([penetration(&there), success(&there), arrival(&there)], [0.05, 1.0, 3.0]);
        let crash = Outcome { penetrates: true, ..there };
        assert_eq!(penetration(&Outcome { crowded: Some(0.7), ..crash }), 0.7);
        assert_eq!([penetration(&crash), success(&crash), arrival(&crash)], [0.0, 1.0, 0.0]);
    }

    #[test]
    fn weights_are_those_of_the_table() {
        let w: Vec<f32> = TERMS.iter().map(|t| (t.weight)(&Weights::default())).collect();
        assert_eq!(w, [0.1, 0.3, 1.0, 0.1, 0.3, 0.1, 0.1, 0.5, 0.0]);
    }
}
