//! Biovision hierarchy (BVH) files, and CMU motion in them.

use super::cmu::{CMU_JOINTS, CMU_PARENTS, SourceClip, SourceFrame, alignments, cmu_joint, leg_length};
use super::resample::check_fps;
use crate::{Error, Result};
use glam::{Quat, Vec3};
use std::fs;
use std::path::Path;

/// What a channel of a joint moves.
#[derive(Clone, Copy, PartialEq)]
enum Channel {
    Position(usize),
    Rotation(usize),
}

/// A joint of a hierarchy; the root is its own parent.
pub(super) struct Joint {
    pub name: String,
    pub parent: usize,
    /// From the parent in the rest pose, file units.
    pub offset: Vec3,
    channels: Vec<Channel>,
}

/// A file as written.
pub(super) struct Bvh {
    pub joints: Vec<Joint>,
    pub fps: f32,
    pub frames: Vec<BvhFrame>,
}

/// One frame: the root's position, file units, and each joint's rotation against the world, the identity in the rest pose.
pub(super) struct BvhFrame {
    pub root: Vec3,
    pub rots: Vec<Quat>,
}

/// Joints that a file may have, ends included.
const MAX_JOINTS: usize = 256;

/// Words of a file with the line and the place in the line each came from.
struct Words<'a> {
    path: &'a Path,
    words: Vec<(usize, usize, &'a str)>,
    next: usize,
}

impl<'a> Words<'a> {
    fn new(path: &'a Path, text: &'a str) -> Self {
        let words = text
            .lines()
            .enumerate()
            .flat_map(|(l, line)| line.split_whitespace().map(move |w| (l + 1, w.as_ptr() as usize - line.as_ptr() as usize + 1, w)));
        Self { path, words: words.collect(), next: 0 }
    }

    fn error(&self, expected: &str) -> Error {
        match self.words.get(self.next) {
            Some((l, c, w)) => Error::file(self.path, format!("line {l}, column {c}: '{w}', expected {expected}")),
            None => Error::file(self.path, format!("ends early, expected {expected}")),
        }
    }

    fn peek(&self) -> &'a str {
        self.words.get(self.next).map_or("", |w| w.2)
    }

    fn word(&mut self, want: &str) -> Result<()> {
        if !self.peek().eq_ignore_ascii_case(want) {
            return Err(self.error(&format!("'{want}'")));
        }
        self.next += 1;
        Ok(())
    }

    fn number(&mut self) -> Result<f32> {
        let value = self.peek().parse::<f32>().ok().filter(|v| v.is_finite()).ok_or_else(|| self.error("a finite number"))?;
        self.next += 1;
        Ok(value)
    }

    fn count(&mut self) -> Result<usize> {
        let value = self.peek().parse::<usize>().map_err(|_| self.error("a whole number"))?;
        self.next += 1;
        Ok(value)
    }

    fn vector(&mut self) -> Result<Vec3> {
        Ok(Vec3::new(self.number()?, self.number()?, self.number()?))
    }
}

/// Reads a BVH file of the CMU skeleton (38 joints, ends included, in the known order; names may differ).
///
/// The rotations are put on the common CMU skeleton, limb by limb, so that every limb points where the file has it whatever
/// its rest pose (some files rest with hanging arms); the root's path is scaled by the ratio of the leg lengths.
pub fn read_bvh(path: impl AsRef<Path>, name: &str) -> Result<SourceClip> {
    let path = path.as_ref();
    parse_bvh(path, &fs::read_to_string(path).map_err(|e| Error::io(path, e))?, name)
}

/// [`read_bvh`] of the text of a file; `path` names it in errors.
pub(super) fn parse_bvh(path: &Path, text: &str, name: &str) -> Result<SourceClip> {
    Bvh::parse(path, text)?.cmu(path, name)
}

impl Bvh {
    /// Reads the text of a file; `path` names it in errors.
    pub fn parse(path: &Path, text: &str) -> Result<Self> {
        let mut words = Words::new(path, text);
        words.word("HIERARCHY")?;
        words.word("ROOT")?;
        let mut joints = Vec::new();
        parse_joint(&mut words, 0, false, &mut joints)?;
        words.word("MOTION")?;
        words.word("Frames:")?;
        let count = words.count()?;
        words.word("Frame")?;
        words.word("Time:")?;
        let step = words.number()?;
        if count == 0 || step <= 0.0 {
            return Err(Error::file(path, format!("has {count} frames of {step} s, expected more than none of each")));
        }
        // Written frame times have few digits.
        let fps = check_fps(path, "Frame Time", (1.0 / step).round())?;
        let frames = (0..count).map(|_| parse_frame(&mut words, &joints)).collect::<Result<_>>()?;
        if words.next < words.words.len() {
            return Err(words.error(&format!("the end of the file after {count} frames")));
        }
        Ok(Self { joints, fps, frames })
    }

    /// Puts the motion on the common CMU skeleton; see [`read_bvh`].
    pub fn cmu(&self, path: &Path, name: &str) -> Result<SourceClip> {
        check_topology(path, &self.joints)?;
        let leg = self.joints[cmu_joint::L_KNEE].offset.length() + self.joints[cmu_joint::L_ANKLE].offset.length();
        if leg <= 0.0 {
            return Err(Error::file(path, "the left leg has no length: its OFFSETs are 0"));
        }
        // Metres per file unit, so that the legs get the common skeleton's length.
        let scale = leg_length() / leg;
        let align = alignments(|_, child| self.joints[child].offset);
        let frame = |f: &BvhFrame| SourceFrame { root: f.root * scale, rots: std::array::from_fn(|j| (f.rots[j] * align[j]).normalize()) };
        Ok(SourceClip { name: name.to_string(), fps: self.fps, frames: self.frames.iter().map(frame).collect() })
    }
}

fn parse_joint(words: &mut Words, parent: usize, is_end: bool, joints: &mut Vec<Joint>) -> Result<()> {
    let index = joints.len();
    if index == MAX_JOINTS {
        return Err(words.error(&format!("no more than {MAX_JOINTS} joints, ends included")));
    }
    let name = words.peek().to_string();
    words.next += 1;
    words.word("{")?;
    words.word("OFFSET")?;
    joints.push(Joint { name, parent, offset: words.vector()?, channels: Vec::new() });
    if !is_end {
        words.word("CHANNELS")?;
        let count = words.count()?;
        for _ in 0..count {
            let channel = parse_channel(words)?;
            joints[index].channels.push(channel);
        }
    }
    loop {
        let is_end = match words.peek() {
            "}" => break,
            "JOINT" => false,
            "End" => true,
            _ => return Err(words.error("'JOINT', 'End Site' or '}'")),
        };
        words.next += 1;
        parse_joint(words, index, is_end, joints)?;
    }
    words.word("}")
}

fn parse_channel(words: &mut Words) -> Result<Channel> {
    let bytes = words.peek().as_bytes();
    let axis = match bytes.first() {
        Some(&b @ b'X'..=b'Z') => (b - b'X') as usize,
        _ => return Err(words.error("a channel such as Xposition or Zrotation")),
    };
    let channel = match &bytes[1..] {
        b"position" => Channel::Position(axis),
        b"rotation" => Channel::Rotation(axis),
        _ => return Err(words.error("a channel such as Xposition or Zrotation")),
    };
    words.next += 1;
    Ok(channel)
}

fn check_topology(path: &Path, joints: &[Joint]) -> Result<()> {
    if joints.len() != CMU_JOINTS {
        return Err(Error::file(path, format!("has {} joints with its ends, expected the {CMU_JOINTS} of the CMU skeleton", joints.len())));
    }
    match (0..CMU_JOINTS).find(|&j| joints[j].parent != CMU_PARENTS[j]) {
        Some(j) => Err(Error::file(
            path,
            format!("joint {j} hangs on joint {}, expected {} as in the CMU skeleton", joints[j].parent, CMU_PARENTS[j]),
        )),
        None => Ok(()),
    }
}

fn parse_frame(words: &mut Words, joints: &[Joint]) -> Result<BvhFrame> {
    let mut frame = BvhFrame { root: Vec3::ZERO, rots: Vec::with_capacity(joints.len()) };
    for (j, joint) in joints.iter().enumerate() {
        let mut local = Quat::IDENTITY;
        for &channel in &joint.channels {
            let value = words.number()?;
            match channel {
                Channel::Position(axis) if j == 0 => frame.root[axis] = value,
                Channel::Position(_) => {}
                Channel::Rotation(axis) => local *= Quat::from_axis_angle(Vec3::AXES[axis], value.to_radians()),
            }
        }
        frame.rots.push(if j == 0 { local } else { (frame.rots[joint.parent] * local).normalize() });
    }
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bvh_matches_an_independent_reader() {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/motion");
        let clip = read_bvh(dir.join("small.bvh"), "small").unwrap();
        let want: Vec<Vec<[f32; 3]>> = serde_json::from_str(&fs::read_to_string(dir.join("bvh_joints.json")).unwrap()).unwrap();
        assert_eq!((clip.frames.len(), clip.fps), (want.len(), 120.0));
        for (frame, want) in clip.frames.iter().zip(&want) {
            for (j, p) in frame.joints().iter().enumerate() {
                assert!((*p - Vec3::from(want[j])).length() < 2e-5, "joint {j}: {p} for {:?}", want[j]);
            }
        }
    }

    #[test]
    fn bad_files_name_the_place() {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/motion");
        let good = fs::read_to_string(dir.join("small.bvh")).unwrap();
        let tmp = tempfile::tempdir().unwrap();
        let path = tmp.path().join("bad.bvh");
        let short = &good[..good.trim_end().rfind(' ').unwrap()];
        for (text, want) in [
            (good.replacen("CHANNELS 3", "CHANNELS three", 1), "'three', expected a whole number"),
            (good.replacen("Zrotation", "Wrotation", 1), "'Wrotation', expected a channel"),
            (good.replacen("JOINT", "KNOT", 1), "'KNOT', expected 'JOINT'"),
            (short.to_string(), "ends early, expected a finite number"),
            (format!("{good} 1.0\n"), "expected the end of the file"),
        ] {
            fs::write(&path, text).unwrap();
            let message = read_bvh(&path, "bad").unwrap_err().to_string();
            assert!(message.contains(want) && message.contains("bad.bvh"), "{message}");
        }
    }
}
