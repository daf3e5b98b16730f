//! BVH skeletons whose joints are known by name: the rig of the ReActIdle recordings (a plain Blender rig).

use super::bvh::{Bvh, BvhFrame};
use super::clip::{Pose, upright};
use super::ik::arc;
use super::poses::PoseClip;
use crate::body::{BODY_JOINTS, BodyModel};
use crate::{Error, Result};
use glam::{Quat, Vec3};
use std::path::Path;

/// The joint that drives each body joint.
#[rustfmt::skip]
const DRIVERS: [&str; BODY_JOINTS] = [
    "pelvis", "thigh.L", "thigh.R", "spine", "shin.L", "shin.R", "spine", "foot.L", "foot.R", "spine.001", "foot.L", "foot.R", "neck",
    "shoulder.L", "shoulder.R", "face", "upper_arm.L", "upper_arm.R", "forearm.L", "forearm.R", "forearm.L", "forearm.R",
];
/// Limbs whose rest directions are aligned: body joint, its child, and the joint whose offset is the limb in the file.
const LIMBS: [(usize, usize, &str); 6] =
    [(1, 4, "shin.L"), (2, 5, "shin.R"), (4, 7, "foot.L"), (5, 8, "foot.R"), (16, 18, "forearm.L"), (17, 19, "forearm.R")];

/// The motion as rotations of SMPL-X's joints. The rig rests like ours: arms sideways, y up, facing z.
pub(super) fn parse_named(path: &Path, bvh: &Bvh, name: &str) -> Result<PoseClip> {
    let find = |wanted: &str| {
        bvh.joints.iter().position(|j| j.name == wanted).ok_or_else(|| {
            let what = format!("has {} joints with its ends, which is not the CMU skeleton, and no joint '{wanted}'", bvh.joints.len());
            Error::file(path, what)
        })
    };
    let mut drivers = [0; BODY_JOINTS];
    for (driver, wanted) in drivers.iter_mut().zip(DRIVERS) {
        *driver = find(wanted)?;
    }
    let rest = *BodyModel::embedded().joints_template();
    let mut align = [Quat::IDENTITY; BODY_JOINTS];
    for (j, child, limb) in LIMBS {
        align[j] = arc(rest[child] - rest[j], bvh.joints[find(limb)?].offset);
    }
    (align[18], align[19]) = (align[16], align[17]);
    (align[20], align[21]) = (align[16], align[17]);
    // The root's channels hold its way from its rest place.
    let frames = bvh.frames.iter().map(|f| pose(f, bvh.joints[0].offset, &drivers, &align)).collect();
    Ok(PoseClip { name: name.to_string(), fps: bvh.fps, frames })
}

fn pose(frame: &BvhFrame, root: Vec3, drivers: &[usize; BODY_JOINTS], align: &[Quat; BODY_JOINTS]) -> Pose {
    let rots = std::array::from_fn(|j| (upright() * frame.rots[drivers[j]] * align[j]).normalize());
    Pose { root: upright() * (root + frame.root), rots }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::fs;

    fn read(change: impl Fn(String) -> String) -> Result<PoseClip> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/motion/named.bvh");
        parse_named(&path, &Bvh::parse(&path, &change(fs::read_to_string(&path).unwrap()))?, "named")
    }

    #[test]
    fn limbs_point_where_an_independent_reader_has_them() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/motion/named_directions.json");
        let want: Vec<BTreeMap<String, Vec<f32>>> = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
        let clip = read(|text| text).unwrap();
        assert_eq!((clip.frames.len(), clip.fps), (want.len(), 24.0));
        let rest = *BodyModel::embedded().joints_template();
        for (pose, want) in clip.frames.iter().zip(&want) {
            let near = |got: Vec3, name: &str, at: usize| {
                let want = Vec3::from_slice(&want[name][at..]);
                assert!((got - want).length() < 1e-4, "{name}: {got} for {want}");
            };
            near(pose.root, "root", 0);
            for (j, child, limb) in LIMBS {
                near(pose.rots[j] * (rest[child] - rest[j]).normalize(), limb, 0);
            }
            for (j, name) in [(0, "pelvis"), (9, "spine.001"), (12, "neck"), (15, "face")] {
                (0..3).for_each(|axis| near(pose.rots[j] * Vec3::AXES[axis], name, 3 * axis));
            }
        }
    }

    #[test]
    fn unknown_rigs_are_refused() {
        let message = read(|text| text.replace("forearm.R", "lower_arm.R")).unwrap_err().to_string();
        assert!(message.contains("named.bvh") && message.contains("no joint 'forearm.R'"), "{message}");
    }
}
