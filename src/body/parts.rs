//! Balls round body parts whose middles follow from the joints alone, so that a part far from everything needs no posing.

use super::model::BodyModel;
use super::{JOINTS, PARENTS};
use glam::Vec3;

/// A body part: the points whose skin its bone moves most.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// Joints that stay together with the bone, whose mean is the middle of the ball.
    anchors: Vec<usize>,
    /// For each bone that moves points of the part, the joints on the way from it to the part's bone.
    ways: Vec<(usize, Vec<usize>)>,
}

impl Part {
    /// The part of `bone` with these vertices, which at rest are at `rest`; `joints` are all bones at rest.
    pub fn new(model: &BodyModel, bone: usize, vertices: &[usize], rest: &[Vec3], joints: &[Vec3]) -> Self {
        let mut bones: Vec<usize> = vertices.iter().flat_map(|&v| model.skin.of(v)).map(|e| e.0).collect();
        bones.sort_unstable();
        bones.dedup();
        let ways: Vec<_> = bones.into_iter().map(|k| (k, way(model, k, bone))).collect();
        let children: Vec<usize> = (1..JOINTS).filter(|&k| PARENTS[k] == bone).collect();
        let with = |others: &[usize]| std::iter::once(bone).chain(others.iter().copied()).collect::<Vec<_>>();
        let choices = [with(&[]), with(&children)].into_iter().chain(children.iter().map(|&c| with(&[c])));
        let of = |anchors: Vec<usize>| Self { anchors, ways: ways.clone() };
        let radius = |part: &Self| part.radius(model, vertices.iter().map(|&v| (v, rest[v])), joints);
        let mut best = of(with(&[]));
        let mut least = f32::INFINITY;
        for part in choices.map(of) {
            let r = radius(&part);
            if r < least {
                (best, least) = (part, r);
            }
        }
        best
    }

    /// The middle of the ball, in the frame of the joints.
    pub fn middle(&self, joints: &[Vec3]) -> Vec3 {
        self.anchors.iter().map(|&j| joints[j]).sum::<Vec3>() / self.anchors.len() as f32
    }

    /// Radius of a ball round the middle that holds these points (vertex, place at rest) in every pose.
    ///
    /// A bone and its parent share a joint, whichever way they turn. So where bone k takes a point v, it is at most as far from the middle
    /// as the way from v through the shared joints to the middle is long at rest, and a skinned point at most as far as the weighted mean.
    pub fn radius(&self, model: &BodyModel, points: impl Iterator<Item = (usize, Vec3)>, joints: &[Vec3]) -> f32 {
        let middle = self.middle(joints);
        let far = |(vertex, at): (usize, Vec3)| {
            let reach = |&(bone, weight): &(usize, f32)| {
                let way = self.ways.iter().find(|w| w.0 == bone).map_or(&[][..], |w| &w.1);
                let (end, length) = way.iter().fold((at, 0.0), |(from, sum), &j| (joints[j], sum + from.distance(joints[j])));
                weight * (length + end.distance(middle))
            };
            model.skin.of(vertex).iter().map(reach).sum::<f32>()
        };
        points.map(far).fold(0.0, f32::max)
    }
}

/// The joints at which one goes from bone to bone on the way from bone `from` to bone `to`.
fn way(model: &BodyModel, from: usize, to: usize) -> Vec<usize> {
    let parent = |k: usize| match k.checked_sub(JOINTS) {
        None => PARENTS[k],
        Some(e) => model.extra.as_ref().map_or(0, |extra| extra.parents[e]),
    };
    let up = |mut k: usize| {
        let mut line = vec![];
        while k != 0 {
            line.push(k);
            k = parent(k);
        }
        line
    };
    let (mut a, mut b) = (up(from), up(to));
    while a.last().is_some() && a.last() == b.last() {
        a.pop();
        b.pop();
    }
    a.extend(b.into_iter().rev());
    a
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_lead_through_shared_joints() {
        let model = BodyModel::embedded();
        // Left shank (4) hangs on the thigh (1) at joint 4; the thigh on the pelvis (0) at joint 1; the other hip is joint 2.
        assert!(way(&model, 4, 4).is_empty());
        assert_eq!(way(&model, 4, 1), [4]);
        assert_eq!(way(&model, 1, 4), [4]);
        assert_eq!(way(&model, 0, 4), [1, 4]);
        assert_eq!(way(&model, 4, 2), [4, 1, 2]);
    }
}
