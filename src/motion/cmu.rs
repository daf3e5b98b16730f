//! CMU motion as exponential maps in comma-separated text, and the 38-joint skeleton all CMU clips are read on.
//!
//! The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.

use super::ik::arc;
use super::mend::mend_root;
use crate::{Error, Result};
use glam::{Quat, Vec3};
use std::fs;
use std::path::Path;

/// Joints of the CMU skeleton, ends included.
pub const CMU_JOINTS: usize = 38;
/// Metres per length unit of the files.
pub const UNIT: f32 = 0.0254 / 0.45;
/// Frames per second of the recordings.
pub const SOURCE_FPS: f32 = 120.0;
/// Numbers of one frame: root position and 38 exponential maps.
const COLUMNS: usize = 3 + 3 * CMU_JOINTS;

/// Parent of each joint; the root is its own.
#[rustfmt::skip]
pub const CMU_PARENTS: [usize; CMU_JOINTS] = [
    0, 0, 1, 2, 3, 4, 5, 0, 7, 8, 9, 10, 11, 0, 13, 14, 15, 16, 17, 18, 15, 20, 21, 22, 23, 24, 25, 23, 27, 15, 29, 30, 31, 32, 33, 34, 32, 36,
];

/// Offset of each joint from its parent in the rest pose (x left, y up, z forward), file units.
#[rustfmt::skip]
const OFFSETS: [[f32; 3]; CMU_JOINTS] = [
    [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.65674, -1.80282, 0.62477], [2.5972, -7.13576, 0.0], [2.49236, -6.8477, 0.0],
    [0.19704, -0.54136, 2.14581], [0.0, 0.0, 1.11249], [0.0, 0.0, 0.0], [-1.6107, -1.80282, 0.62476], [-2.59502, -7.12977, 0.0],
    [-2.4678, -6.78024, 0.0], [-0.23024, -0.63258, 2.13368], [0.0, 0.0, 1.11569], [0.0, 0.0, 0.0], [0.01961, 2.0545, -0.14112],
    [0.01021, 2.06436, -0.05921], [0.0, 0.0, 0.0], [0.00713, 1.56711, 0.14968], [0.03429, 1.56041, -0.10006],
    [0.01305, 1.6256, -0.05265], [0.0, 0.0, 0.0], [3.54205, 0.90436, -0.17364], [4.86513, 0.0, 0.0], [3.35554, 0.0, 0.0],
    [0.0, 0.0, 0.0], [0.66117, 0.0, 0.0], [0.53306, 0.0, 0.0], [0.0, 0.0, 0.0], [0.5412, 0.0, 0.5412], [0.0, 0.0, 0.0],
    [-3.49802, 0.75994, -0.32616], [-5.02649, 0.0, 0.0], [-3.36431, 0.0, 0.0], [0.0, 0.0, 0.0], [-0.73041, 0.0, 0.0],
    [-0.58887, 0.0, 0.0], [0.0, 0.0, 0.0], [-0.59786, 0.0, 0.59786],
];

/// Indices of the joints the importer speaks of.
pub mod cmu_joint {
    pub const L_HIP: usize = 2;
    pub const L_KNEE: usize = 3;
    pub const L_ANKLE: usize = 4;
    pub const R_HIP: usize = 8;
    pub const R_KNEE: usize = 9;
    pub const R_ANKLE: usize = 10;
}

/// One frame of CMU motion in the recording's world (y up).
#[derive(Clone, Debug, PartialEq)]
pub struct SourceFrame {
    /// Root position, metres.
    pub root: Vec3,
    /// Global rotation of each joint, rest to world, acting on column vectors; the identity in the rest pose.
    pub rots: [Quat; CMU_JOINTS],
}

/// One recording on the CMU skeleton.
#[derive(Clone, Debug)]
pub struct SourceClip {
    /// Set, folder and file stem, such as `train/walking_extra/walking_22`.
    pub name: String,
    /// Frames per second.
    pub fps: f32,
    pub frames: Vec<SourceFrame>,
}

/// Rest offset of joint `j` from its parent, metres.
pub fn rest_offset(j: usize) -> Vec3 {
    Vec3::from(OFFSETS[j]) * UNIT
}

/// Length of the left leg of the CMU skeleton, hip to ankle, metres.
pub fn leg_length() -> f32 {
    rest_offset(cmu_joint::L_KNEE).length() + rest_offset(cmu_joint::L_ANKLE).length()
}

/// Per joint the rest rotation that turns the common skeleton's limb into a file's; hands go with their forearms.
///
/// `limb(joint, child)` is the file's rest vector from a joint to its child, in any unit.
pub(super) fn alignments(limb: impl Fn(usize, usize) -> Vec3) -> [Quat; CMU_JOINTS] {
    let mut align = [Quat::IDENTITY; CMU_JOINTS];
    for (j, child) in [(2, 3), (3, 4), (8, 9), (9, 10), (21, 22), (22, 23), (30, 31), (31, 32)] {
        align[j] = arc(rest_offset(child), limb(j, child));
    }
    let (left, right) = (align[22], align[31]);
    align[23..29].fill(left);
    align[32..].fill(right);
    align
}

impl SourceFrame {
    /// The frame `s` of the way (0..1) from this one to `next`: positions linearly, rotations along the shortest arc.
    pub fn between(&self, next: &Self, s: f32) -> Self {
        let rots = std::array::from_fn(|j| self.rots[j].slerp(next.rots[j], s));
        Self { root: self.root.lerp(next.root, s), rots }
    }

    /// Joint positions in the recording's world, metres.
    pub fn joints(&self) -> [Vec3; CMU_JOINTS] {
        let mut p = [self.root; CMU_JOINTS];
        for j in 1..CMU_JOINTS {
            let parent = CMU_PARENTS[j];
            p[j] = p[parent] + self.rots[parent] * rest_offset(j);
        }
        p
    }
}

/// Reads an exponential-map file; its first row is a T-pose and is dropped, and the root's rotation is mended ([`super::mend`]).
///
/// The files hold rotations for row vectors, `G_j = R(e_j) G_parent`, so the rotation of column vectors is about `-e_j`.
pub fn read_expmap(path: impl AsRef<Path>, name: &str) -> Result<SourceClip> {
    let path = path.as_ref();
    parse_expmap(path, &fs::read_to_string(path).map_err(|e| Error::io(path, e))?, name)
}

/// [`read_expmap`] of the text of a file; `path` names it in errors.
pub(super) fn parse_expmap(path: &Path, text: &str, name: &str) -> Result<SourceClip> {
    let mut frames = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        frames.push(frame_of_row(&parse_row(path, i + 1, line)?));
    }
    if frames.len() < 2 {
        return Err(Error::file(path, format!("holds {} rows, expected a T-pose row and at least one frame", frames.len())));
    }
    frames.remove(0);
    mend_root(&mut frames);
    Ok(SourceClip { name: name.to_string(), fps: SOURCE_FPS, frames })
}

fn parse_row(path: &Path, line_no: usize, line: &str) -> Result<Vec<f32>> {
    let mut row = Vec::with_capacity(COLUMNS);
    for (c, field) in line.split(',').enumerate() {
        let value = field
            .trim()
            .parse::<f32>()
            .ok()
            .filter(|v| v.is_finite())
            .ok_or_else(|| Error::file(path, format!("line {line_no}, column {}: '{}' is not a finite number", c + 1, field.trim())))?;
        row.push(value);
    }
    if row.len() != COLUMNS {
        return Err(Error::file(path, format!("line {line_no} has {} columns, expected {COLUMNS} (root and 38 joints)", row.len())));
    }
    Ok(row)
}

fn frame_of_row(row: &[f32]) -> SourceFrame {
    let mut rots = [Quat::IDENTITY; CMU_JOINTS];
    for j in 0..CMU_JOINTS {
        let local = Quat::from_scaled_axis(-Vec3::from_slice(&row[3 + 3 * j..]));
        rots[j] = if j == 0 { local } else { (rots[CMU_PARENTS[j]] * local).normalize() };
    }
    SourceFrame { root: Vec3::from_slice(row) * UNIT, rots }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/motion").join(name)
    }

    #[test]
    fn expmap_matches_an_independent_reader() {
        let clip = read_expmap(fixture("expmap.txt"), "expmap").unwrap();
        let want: Vec<Vec<[f32; 3]>> = serde_json::from_str(&fs::read_to_string(fixture("expmap_joints.json")).unwrap()).unwrap();
        assert_eq!(clip.frames.len(), want.len());
        for (frame, want) in clip.frames.iter().zip(&want) {
            for (j, p) in frame.joints().iter().enumerate() {
                assert!((*p - Vec3::from(want[j])).length() < 2e-5, "joint {j}: {p} for {:?}", want[j]);
            }
        }
    }

    #[test]
    fn bad_files_name_line_and_column() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bad.txt");
        let good = vec!["0"; COLUMNS].join(",");
        for (bad, want) in [
            (good.replacen("0", "nan", 1), "line 2, column 1: 'nan' is not a finite number"),
            (good[2..].to_string(), "line 2 has 116 columns, expected 117"),
            (String::new(), "holds 1 rows"),
        ] {
            fs::write(&path, format!("{good}\n{bad}\n")).unwrap();
            let message = read_expmap(&path, "bad").unwrap_err().to_string();
            assert!(message.contains(want) && message.contains("bad.txt"), "{message}");
        }
    }
}
