//! CMU motion in Acclaim files: a skeleton (ASF) and its motion (AMC).

use super::cmu::{CMU_JOINTS, CMU_PARENTS, SOURCE_FPS, SourceClip, SourceFrame, alignments, cmu_joint, leg_length};
use super::resample::check_fps;
use crate::{Error, Result};
use glam::{Quat, Vec3};
use std::collections::HashMap;
use std::fs;
use std::path::Path;

/// The bone that starts in each joint of the CMU skeleton; ends have none and go with their parent.
#[rustfmt::skip]
const BONES: [&str; CMU_JOINTS] = [
    "root", "lhipjoint", "lfemur", "ltibia", "lfoot", "ltoes", "", "rhipjoint", "rfemur", "rtibia", "rfoot", "rtoes", "",
    "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head", "", "lclavicle", "lhumerus", "lradius", "lwrist", "lhand",
    "lfingers", "", "lthumb", "", "rclavicle", "rhumerus", "rradius", "rwrist", "rhand", "rfingers", "", "rthumb", "",
];

/// What a number of a frame moves: the position along an axis or the rotation about it.
#[derive(Clone, Copy)]
enum Channel {
    Position(usize),
    Rotation(usize),
}

struct Bone {
    name: String,
    /// Index of the parent, which stands before its children; the root is its own.
    parent: usize,
    /// Start to end in the rest pose, file units.
    offset: Vec3,
    /// Axes of the rotations to world, as turns about fixed axes (0, 1, 2), the first one first, in the file's unit of angles.
    axis: Vec<(usize, f32)>,
    channels: Vec<Channel>,
}

/// An Acclaim skeleton with the names of CMU's bones.
pub struct AsfSkeleton {
    bones: Vec<Bone>,
    /// Whether angles are degrees.
    degrees: bool,
    /// The bone of each joint of the CMU skeleton.
    joints: [usize; CMU_JOINTS],
}

/// Lines that hold something, as words, with their numbers; comments (#) are cut off.
struct Lines<'a> {
    path: &'a Path,
    lines: Vec<(usize, Vec<&'a str>)>,
    next: usize,
}

impl<'a> Lines<'a> {
    fn new(path: &'a Path, text: &'a str) -> Self {
        let words = |line: &'a str| line.split('#').next().unwrap_or("").split_whitespace().collect::<Vec<_>>();
        let lines = text.lines().enumerate().map(|(i, line)| (i + 1, words(line))).filter(|(_, w)| !w.is_empty()).collect();
        Self { path, lines, next: 0 }
    }

    /// The next line without taking it.
    fn peek(&self) -> Option<&[&'a str]> {
        self.lines.get(self.next).map(|l| &l.1[..])
    }

    fn take(&mut self) -> Option<Vec<&'a str>> {
        let line = self.lines.get(self.next)?.1.clone();
        self.next += 1;
        Some(line)
    }

    /// An error at the line taken last.
    fn error(&self, what: impl AsRef<str>) -> Error {
        match self.lines.get(self.next.saturating_sub(1)) {
            Some((number, _)) => Error::file(self.path, format!("line {number}: {}", what.as_ref())),
            None => Error::file(self.path, format!("holds nothing: {}", what.as_ref())),
        }
    }

    /// The numbers after the first word of `line`; there must be `count`.
    fn numbers(&self, line: &[&str], count: usize) -> Result<Vec<f32>> {
        let values = &line[1..];
        if values.len() != count {
            return Err(self.error(format!("'{}' has {} numbers, expected {count}", line[0], values.len())));
        }
        let number = |v: &&str| v.parse::<f32>().ok().filter(|v| v.is_finite());
        values.iter().map(|v| number(v).ok_or_else(|| self.error(format!("'{v}' is not a finite number")))).collect()
    }

    fn vector(&self, line: &[&str]) -> Result<Vec3> {
        Ok(Vec3::from_slice(&self.numbers(line, 3)?))
    }
}

/// Reads an Acclaim skeleton. Errors name the line, or the bone that CMU's skeleton has and the file lacks.
///
/// Lengths may have any unit, because motion is scaled by the length of the left leg. A rotation axis `axis a b c XYZ` turns by a
/// about x, then by b about the fixed y, then by c about the fixed z. A root that does not start at 0 is refused.
pub fn read_asf(path: impl AsRef<Path>) -> Result<AsfSkeleton> {
    let path = path.as_ref();
    parse_asf(path, &fs::read_to_string(path).map_err(|e| Error::io(path, e))?)
}

/// Reads Acclaim motion of `skeleton` (y up) onto the common CMU skeleton; limbs point where the files have them.
///
/// AMC does not state its frame rate (`:SAMPLES-PER-SECOND` counts where it stands); `fps` overrides, 120 is CMU's.
pub fn read_amc(path: impl AsRef<Path>, skeleton: &AsfSkeleton, name: &str, fps: Option<f32>) -> Result<SourceClip> {
    let path = path.as_ref();
    parse_amc(path, &fs::read_to_string(path).map_err(|e| Error::io(path, e))?, skeleton, name, fps)
}

/// [`read_asf`] of the text of a file; `path` names it in errors.
pub(super) fn parse_asf(path: &Path, text: &str) -> Result<AsfSkeleton> {
    let mut lines = Lines::new(path, text);
    let mut degrees = true;
    let mut bones = vec![Bone { name: "root".into(), parent: 0, offset: Vec3::ZERO, axis: Vec::new(), channels: Vec::new() }];
    let mut hierarchy = Vec::new();
    while let Some(line) = lines.take() {
        match line[0].to_ascii_lowercase().as_str() {
            ":units" => degrees = parse_units(&mut lines, degrees)?,
            ":root" => bones[0].channels = parse_root(&mut lines)?,
            ":bonedata" => {
                while lines.peek().is_some_and(|l| !l[0].starts_with(':')) {
                    bones.push(parse_bone(&mut lines)?);
                }
            }
            ":hierarchy" => hierarchy = parse_hierarchy(&mut lines)?,
            // Headers such as :version; prose such as :documentation runs until the next keyword.
            _ => {}
        }
    }
    if bones[0].channels.is_empty() {
        return Err(Error::file(path, "has no ':root' with an 'order'"));
    }
    let bones = sort_bones(path, bones, &hierarchy)?;
    let joints = find_joints(path, &bones)?;
    Ok(AsfSkeleton { bones, degrees, joints })
}

/// Whether angles are in degrees.
fn parse_units(lines: &mut Lines, mut degrees: bool) -> Result<bool> {
    while lines.peek().is_some_and(|l| !l[0].starts_with(':')) {
        let line = lines.take().unwrap_or_default();
        match line[..] {
            ["angle", "deg" | "degrees"] => degrees = true,
            ["angle", "rad" | "radians"] => degrees = false,
            ["angle", ..] => return Err(lines.error(format!("'{}', expected 'angle deg' or 'angle rad'", line.join(" ")))),
            ["length" | "mass", ..] => lines.numbers(&line, 1).map(drop)?,
            _ => {}
        }
    }
    Ok(degrees)
}

/// The channels of the root.
fn parse_root(lines: &mut Lines) -> Result<Vec<Channel>> {
    let mut channels = Vec::new();
    while lines.peek().is_some_and(|l| !l[0].starts_with(':')) {
        let line = lines.take().unwrap_or_default();
        match line[0] {
            "order" => channels = line[1..].iter().map(|w| parse_channel(lines, w, true)).collect::<Result<_>>()?,
            "axis" => {}
            "position" | "orientation" if lines.vector(&line)? != Vec3::ZERO => {
                return Err(lines.error(format!("'{}', expected 0 0 0: readers disagree about other values", line.join(" "))));
            }
            "position" | "orientation" => {}
            word => return Err(lines.error(format!("'{word}', expected 'order', 'axis', 'position' or 'orientation'"))),
        }
    }
    Ok(channels)
}

fn parse_channel(lines: &Lines, word: &str, is_root: bool) -> Result<Channel> {
    let bytes = word.to_ascii_lowercase().into_bytes();
    match bytes[..] {
        [b't', axis @ b'x'..=b'z'] if is_root => Ok(Channel::Position((axis - b'x') as usize)),
        [b'r', axis @ b'x'..=b'z'] => Ok(Channel::Rotation((axis - b'x') as usize)),
        _ if is_root => Err(lines.error(format!("channel '{word}', expected tx, ty, tz, rx, ry or rz"))),
        _ => Err(lines.error(format!("dof '{word}', expected rx, ry or rz: bones keep their lengths"))),
    }
}

/// One bone, `begin` to `end`.
fn parse_bone(lines: &mut Lines) -> Result<Bone> {
    let mut bone = Bone { name: String::new(), parent: 0, offset: Vec3::ZERO, axis: Vec::new(), channels: Vec::new() };
    let (mut direction, mut length) = (Vec3::ZERO, 0.0);
    expect(lines, "begin")?;
    while let Some(line) = lines.take() {
        match line[0] {
            "end" => {
                bone.offset = direction.normalize_or_zero() * length;
                return if bone.name.is_empty() { Err(lines.error("the bone has no 'name'")) } else { Ok(bone) };
            }
            "name" => bone.name = line[1..].join(" "),
            "direction" => direction = lines.vector(&line)?,
            "length" => length = lines.numbers(&line, 1)?[0],
            "axis" => bone.axis = parse_axis(lines, &line)?,
            "dof" => bone.channels = line[1..].iter().map(|w| parse_channel(lines, w, false)).collect::<Result<_>>()?,
            "id" | "limits" | "bodymass" | "cofmass" => {}
            word if word.starts_with('(') => {}
            word => return Err(lines.error(format!("'{word}', expected a property of a bone or 'end'"))),
        }
    }
    Err(lines.error("ends within a bone, expected 'end'"))
}

fn parse_axis(lines: &Lines, line: &[&str]) -> Result<Vec<(usize, f32)>> {
    let [numbers @ .., order] = line else { return Err(lines.error("empty")) };
    if numbers.is_empty() {
        return Err(lines.error("'axis' alone, expected three angles and their order"));
    }
    let angles = lines.vector(numbers)?;
    let axes: Vec<usize> = order.bytes().filter_map(|b| b"XYZ".iter().position(|&a| a == b.to_ascii_uppercase())).collect();
    if order.len() != 3 || (0..3).any(|axis| !axes.contains(&axis)) {
        return Err(lines.error(format!("axis order '{order}', expected the letters X, Y and Z once each")));
    }
    Ok(axes.into_iter().map(|axis| (axis, angles[axis])).collect())
}

fn expect(lines: &mut Lines, word: &str) -> Result<()> {
    match lines.take() {
        Some(line) if line[0] == word => Ok(()),
        Some(line) => Err(lines.error(format!("'{}', expected '{word}'", line[0]))),
        None => Err(lines.error(format!("the file ends, expected '{word}'"))),
    }
}

/// Lists of a parent and its children, in the order of the file.
fn parse_hierarchy(lines: &mut Lines) -> Result<Vec<(String, Vec<String>)>> {
    expect(lines, "begin")?;
    let mut out = Vec::new();
    while let Some(line) = lines.take() {
        if line[0] == "end" {
            return Ok(out);
        }
        out.push((line[0].to_string(), line[1..].iter().map(|w| w.to_string()).collect()));
    }
    Err(lines.error("ends within ':hierarchy', expected 'end'"))
}

/// Bones in the order of the hierarchy, parents first.
fn sort_bones(path: &Path, mut bones: Vec<Bone>, hierarchy: &[(String, Vec<String>)]) -> Result<Vec<Bone>> {
    let mut unplaced: HashMap<String, Bone> = bones.drain(1..).map(|b| (b.name.clone(), b)).collect();
    let mut place = HashMap::from([("root".to_string(), 0)]);
    for (parent, children) in hierarchy {
        let Some(&parent_index) = place.get(parent) else {
            return Err(Error::file(path, format!("':hierarchy' lists children of '{parent}', which hangs on nothing by then")));
        };
        for child in children {
            let Some(mut bone) = unplaced.remove(child) else {
                return Err(Error::file(path, format!("':hierarchy' names '{child}', which is no bone or hangs on two")));
            };
            bone.parent = parent_index;
            place.insert(child.clone(), bones.len());
            bones.push(bone);
        }
    }
    match unplaced.keys().min() {
        Some(name) => Err(Error::file(path, format!("bone '{name}' is not in ':hierarchy'"))),
        None => Ok(bones),
    }
}

fn find_joints(path: &Path, bones: &[Bone]) -> Result<[usize; CMU_JOINTS]> {
    let mut joints = [0; CMU_JOINTS];
    for j in 0..CMU_JOINTS {
        joints[j] = match BONES[j] {
            "" => joints[CMU_PARENTS[j]],
            name => bones.iter().position(|b| b.name == name).ok_or_else(|| {
                Error::file(path, format!("has no bone '{name}' among its {} bones, expected the names of the CMU skeleton", bones.len()))
            })?,
        };
    }
    let bone = |joint: usize| bones[joints[joint]].offset;
    if [cmu_joint::L_HIP, cmu_joint::L_KNEE].into_iter().any(|j| bone(j).length() < 1e-6) {
        return Err(Error::file(path, "bone 'lfemur' or 'ltibia' has no length"));
    }
    Ok(joints)
}

/// [`read_amc`] of the text of a file; `path` names it in errors.
pub(super) fn parse_amc(path: &Path, text: &str, skeleton: &AsfSkeleton, name: &str, fps: Option<f32>) -> Result<SourceClip> {
    let mut lines = Lines::new(path, text);
    let mut motion = Motion::new(skeleton);
    let mut stated = SOURCE_FPS;
    while lines.peek().is_some_and(|l| l[0].starts_with(':')) {
        let line = lines.take().unwrap_or_default();
        match line[0].to_ascii_uppercase().as_str() {
            ":DEGREES" => motion.degrees = true,
            ":RADIANS" => motion.degrees = false,
            ":SAMPLES-PER-SECOND" => stated = lines.numbers(&line, 1)?[0],
            _ => {}
        }
    }
    let fps = check_fps(path, ":SAMPLES-PER-SECOND", fps.unwrap_or(stated))?;
    let mut frames = Vec::new();
    while let Some(line) = lines.take() {
        if line.len() != 1 || line[0].parse::<usize>().is_err() {
            return Err(lines.error(format!("'{}', expected the number of a frame", line.join(" "))));
        }
        frames.push(motion.frame(&mut lines, line[0])?);
    }
    if frames.is_empty() {
        return Err(Error::file(path, "holds no frame"));
    }
    Ok(SourceClip { name: name.to_string(), fps, frames })
}

/// What the frames of a file have in common.
struct Motion<'a> {
    skeleton: &'a AsfSkeleton,
    index: HashMap<&'a str, usize>,
    degrees: bool,
    /// Metres per file unit, so that the legs get the common skeleton's length.
    scale: f32,
    /// Axes of the bones' rotations, to world.
    axes: Vec<Quat>,
    align: [Quat; CMU_JOINTS],
}

impl<'a> Motion<'a> {
    fn new(skeleton: &'a AsfSkeleton) -> Self {
        let bones = &skeleton.bones;
        let offset = |joint: usize| bones[skeleton.joints[joint]].offset;
        Self {
            skeleton,
            index: bones.iter().enumerate().map(|(i, b)| (b.name.as_str(), i)).collect(),
            degrees: skeleton.degrees,
            scale: leg_length() / (offset(cmu_joint::L_HIP).length() + offset(cmu_joint::L_KNEE).length()),
            axes: bones.iter().map(|b| turns(b.axis.iter().copied(), skeleton.degrees)).collect(),
            align: alignments(|joint, _| offset(joint)),
        }
    }

    /// The lines of frame `number`: a bone and its values each.
    fn frame(&self, lines: &mut Lines, number: &str) -> Result<SourceFrame> {
        let bones = &self.skeleton.bones;
        let mut root = Vec3::ZERO;
        let mut local = vec![None; bones.len()];
        while lines.peek().is_some_and(|l| l.len() > 1) {
            let line = lines.take().unwrap_or_default();
            let Some(&b) = self.index.get(line[0]) else {
                return Err(lines.error(format!("'{}' is no bone of the skeleton", line[0])));
            };
            let values = lines.numbers(&line, bones[b].channels.len())?;
            let channels = || bones[b].channels.iter().zip(&values);
            channels().for_each(|(c, v)| {
                if let Channel::Position(axis) = c {
                    root[*axis] = v * self.scale
                }
            });
            let rotations = channels().filter_map(|(c, v)| if let Channel::Rotation(axis) = c { Some((*axis, *v)) } else { None });
            let turn = self.axes[b] * turns(rotations, self.degrees) * self.axes[b].inverse();
            if local[b].replace(turn).is_some() {
                return Err(lines.error(format!("frame {number} has bone '{}' twice", line[0])));
            }
        }
        let mut world = vec![Quat::IDENTITY; bones.len()];
        for (b, bone) in bones.iter().enumerate() {
            let turn = match local[b] {
                Some(turn) => turn,
                None if bone.channels.is_empty() => Quat::IDENTITY,
                None => return Err(lines.error(format!("frame {number} ends without bone '{}'", bone.name))),
            };
            world[b] = if b == 0 { turn } else { (world[bone.parent] * turn).normalize() };
        }
        let rots = std::array::from_fn(|j| (world[self.skeleton.joints[j]] * self.align[j]).normalize());
        Ok(SourceFrame { root, rots })
    }
}

/// Turns about fixed axes, the first one first.
fn turns(turns: impl Iterator<Item = (usize, f32)>, degrees: bool) -> Quat {
    turns.fold(Quat::IDENTITY, |q, (axis, angle)| {
        let angle = if degrees { angle.to_radians() } else { angle };
        Quat::from_axis_angle(Vec3::AXES[axis], angle) * q
    })
}

#[cfg(test)]
mod tests;
