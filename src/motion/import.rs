//! One entry for all kinds of recordings.

use super::amass::parse_amass;
use super::asf::{read_amc, read_asf};
use super::bvh::Bvh;
use super::canonical::CanonicalPrimitive;
use super::clip::{Clip, Skeleton};
use super::cmu::{CMU_JOINTS, SourceClip, read_expmap};
use super::named::parse_named;
use super::poses::{PoseClip, Up};
use super::retarget::{RetargetReport, retarget};
use super::samp::read_samp;
use crate::io::numpy::Npz;
use crate::{Error, Result};
use std::fs;
use std::path::{Path, PathBuf};

/// What a file leaves open.
#[derive(Clone, Copy, Debug, Default)]
pub struct ImportOptions {
    /// Frames per second of AMC, which does not state it.
    pub fps: Option<f32>,
    /// The axis that points up in AMASS and SAMP files that differ from their kind, which has z up.
    pub up: Option<Up>,
}

/// A recording as read.
#[derive(Clone, Debug)]
pub enum Recorded {
    /// Joints of the CMU skeleton: exponential maps, BVH, Acclaim.
    Cmu(SourceClip),
    /// Rotations of SMPL-X's joints: AMASS, SAMP, EgoGen's canonical primitives, BVH whose joints are known by name.
    Smplx(PoseClip),
}

impl Recorded {
    /// Puts the recording on `skeleton` at 40 frames per second, on the floor, with locked feet.
    pub fn put_on(&self, skeleton: &Skeleton) -> Result<(Clip, RetargetReport)> {
        match self {
            Self::Cmu(clip) => retarget(skeleton, clip),
            Self::Smplx(clip) => clip.put_on(skeleton),
        }
    }
}

/// Reads a recording of any known kind: `.txt`, `.bvh`, `.amc` (with its `.asf` beside it), `.npz`, `.pkl`; its name is the file's stem.
///
/// Of `NAME_TAKE.amc` the skeleton is `NAME.asf` or `NAME_TAKE.asf`, else the only `.asf` of the folder. An `.npz` with a
/// `transf_rotmat` is a canonical primitive, any other one is AMASS.
pub fn import(path: impl AsRef<Path>, options: &ImportOptions) -> Result<Recorded> {
    let path = path.as_ref();
    let name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    Ok(match extension.as_str() {
        "txt" => Recorded::Cmu(read_expmap(path, &name)?),
        "bvh" => read_bvh(path, &name)?,
        "amc" => Recorded::Cmu(read_amc(path, &read_asf(skeleton_of(path, &name)?)?, &name, options.fps)?),
        "asf" => return Err(Error::file(path, "is a skeleton without motion, expected its .amc")),
        "npz" => Recorded::Smplx(read_npz(path, &name, options.up)?),
        "pkl" | "pickle" => Recorded::Smplx(read_samp(path, &name, options.up)?),
        _ => return Err(Error::file(path, "is of no known kind, expected .txt, .bvh, .amc, .npz or .pkl")),
    })
}

/// A file with the joints of the CMU skeleton is one of CMU, any other one needs joints whose names are known.
fn read_bvh(path: &Path, name: &str) -> Result<Recorded> {
    let bvh = Bvh::parse(path, &fs::read_to_string(path).map_err(|e| Error::io(path, e))?)?;
    Ok(if bvh.joints.len() == CMU_JOINTS { Recorded::Cmu(bvh.cmu(path, name)?) } else { Recorded::Smplx(parse_named(path, &bvh, name)?) })
}

fn read_npz(path: &Path, name: &str, up: Option<Up>) -> Result<PoseClip> {
    let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
    let npz = Npz::new(path, &bytes)?;
    if npz.has("transf_rotmat") { CanonicalPrimitive::parse(path, &npz)?.clip(name) } else { parse_amass(path, &npz, name, up) }
}

/// The skeleton file that belongs to a motion file.
fn skeleton_of(path: &Path, name: &str) -> Result<PathBuf> {
    let subject = name.split('_').next().unwrap_or(name);
    if let Some(near) = [subject, name].map(|n| path.with_file_name(format!("{n}.asf"))).into_iter().find(|p| p.is_file()) {
        return Ok(near);
    }
    let dir = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).map_err(|e| Error::io(dir, e))? {
        let file = entry.map_err(|e| Error::io(dir, e))?.path();
        if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("asf")) {
            found.push(file);
        }
    }
    match found.len() {
        1 => Ok(found.remove(0)),
        n => Err(Error::file(path, format!("needs its skeleton {subject}.asf beside it; the folder has {n} other .asf files"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::BodyModel;
    use glam::{Quat, Vec3};

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/importers")
    }

    /// Frames at 40 per second: the root, then 22 rotations x y z w.
    type Frames = Vec<(Vec<f32>, Vec<[f32; 4]>)>;

    #[test]
    fn poses_match_an_independent_reader() {
        let want: std::collections::BTreeMap<String, Frames> =
            serde_json::from_str(&fs::read_to_string(fixtures().join("poses.json")).unwrap()).unwrap();
        assert_eq!(want.len(), 7);
        for (file, want) in &want {
            let Recorded::Smplx(clip) = import(fixtures().join(file), &ImportOptions::default()).unwrap() else { panic!("{file}") };
            let frames = crate::motion::resample::resample(file, &clip.frames, clip.fps, crate::motion::clip::Pose::between).unwrap();
            assert_eq!(frames.len(), want.len(), "{file}");
            for (got, (root, rots)) in frames.iter().zip(want) {
                assert!((got.root - Vec3::from_slice(root)).length() < 1e-5, "{file}: {}", got.root);
                for (j, (a, b)) in got.rots.iter().zip(rots).enumerate() {
                    assert!(1.0 - a.dot(Quat::from_array(*b)).abs() < 1e-6, "{file} joint {j}: {a} for {b:?}");
                }
            }
        }
    }

    #[test]
    fn every_kind_lands_on_the_body() {
        let skeleton = Skeleton::new(&BodyModel::embedded());
        for (file, frames) in
            [("importers/small.amc", 1), ("importers/smplx.npz", 3), ("importers/canonical.npz", 20), ("motion/small.bvh", 1)]
        {
            let recorded = import(fixtures().parent().unwrap().join(file), &ImportOptions::default()).unwrap();
            let (clip, report) = recorded.put_on(&skeleton).unwrap();
            assert_eq!(clip.len(), frames, "{file}");
            assert!(clip.poses.iter().all(|p| p.root.is_finite()) && report.ground_shift.is_finite(), "{file}");
        }
    }

    #[test]
    fn what_cannot_be_read_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let with = |name: &str, bytes: &[u8]| {
            fs::write(dir.path().join(name), bytes).unwrap();
            import(dir.path().join(name), &ImportOptions::default()).unwrap_err().to_string()
        };
        for (message, want) in [
            (with("a.fbx", b""), "a.fbx: is of no known kind"),
            (with("a_01.amc", b""), "needs its skeleton a.asf beside it; the folder has 0"),
            (with("a.asf", b""), "expected its .amc"),
            (with("a.npz", b"PK"), "is no npz archive"),
            (with("a.pkl", b"hello"), "is no Python pickle of protocol 2 to 5"),
            (with("b.pkl", b"\x80\x02cos\nsystem\n"), "'os.system' is refused"),
            (with("c.pkl", b"\x80\x04)\x81."), "opcode NEWOBJ is refused"),
            (with("d.pkl", b"\x80\x04}."), "has no key 'pose_est_fullposes'"),
            (with("e.pkl", b"\x80\x04]."), "holds no dict"),
            (with("f.pkl", b"\x80\x04X\xff\xff\xff\xff"), "ends within a value of 4294967295 bytes"),
        ] {
            assert!(message.contains(want), "{message}");
        }
    }
}
