//! From a folder of motion capture to the sets the motion model trains and is judged on.

use super::FPS;
use super::augment::{Kind, RECIPE, augment, hip_twists, mirror};
use super::clip::{Clip, Skeleton, quantile, wrap};
use super::cmu::read_expmap;
use super::footlock::slides;
use super::import::{ImportOptions, import};
use super::primitive::MotionSet;
use super::retarget::{RetargetReport, retarget};
use super::{FUTURE, bvh::read_bvh};
use crate::body::{BETAS, BodyModel};
use crate::{Error, Result};
use rayon::prelude::*;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

/// Folders of exponential-map walks below `mocap/cmu_expmap`; running is left out.
const WALKS: [&str; 4] = ["test/walking", "test/walking_extra", "train/walking", "train/walking_extra"];
/// BVH files that are used. 131 is a dance with stretched arms, 02_01 stands too high, 01_01 and 05_01 are no locomotion.
const BVHS: [&str; 1] = ["16_11"];
/// Folder of the exponential maps in the archives.
const EXPMAPS: &str = "cmu_expmap";
/// Of a folder of one's own, every eighth recording, from the second on, is held out; files of these kinds are recordings.
const HELD_OUT_EVERY: usize = 8;
const KINDS: [&str; 4] = ["bvh", "amc", "npz", "pkl"];
/// Folder, beside `mocap/cmu_expmap`, of recordings of people who stand; they lend stops their upper bodies.
const IDLE: &str = "reactidle_mit";
/// Clips kept from training: seven straight walks and a turning one.
const HELD_OUT: [&str; 8] = [
    "test/walking_extra/walking_10",
    "test/walking_extra/walking_11",
    "test/walking_extra/walking_12",
    "test/walking_extra/walking_13",
    "test/walking_extra/walking_14",
    "test/walking_extra/walking_15",
    "test/walking_extra/walking_16",
    "train/walking_extra/walking_49",
];

/// What is on the floor of a set of clips: how much motion, how fast, how well the feet stand.
#[derive(Clone, Debug, Default)]
pub struct SetStats {
    pub clips: usize,
    /// Length, seconds.
    pub seconds: f32,
    /// Speed over one primitive (0.45 s) along the facing direction, m/s: 1, 5, 50, 95, 99 %.
    pub speed: [f32; 5],
    /// Yaw change over one primitive, degrees: 1, 5, 50, 95, 99 %.
    pub yaw: [f32; 5],
    /// Slide per stance, metres: median, 90 %.
    pub slide: [f32; 2],
    /// Foot yaw against the pelvis in stance, degrees: median, 99 %.
    pub twist: [f32; 2],
}

/// What [`build`] measured.
#[derive(Clone, Debug, Default)]
pub struct BuildReport {
    /// Mean limb-joint error of retargeting over clips, metres.
    pub joint_error: f32,
    /// Least and greatest shift of a clip onto the floor, metres.
    pub ground_shift: [f32; 2],
    /// Slide per stance before and after the foot lock, metres: median, 90 %.
    pub slide_before: [f32; 2],
    pub slide_after: [f32; 2],
    /// Retargeted clips, then each kind of variation, then all of the training set; with how many were made of each.
    pub sets: Vec<(String, SetStats)>,
    /// Variations made and kept.
    pub made: usize,
    pub kept: usize,
}

/// Clips on the body before markers are made of them.
pub struct Clips {
    /// Training clips with their variations and mirror images.
    pub train: Vec<Clip>,
    /// Held-out clips as recorded.
    pub held_out: Vec<Clip>,
}

/// Reads the recordings in `data_dir`, retargets them to `model`, augments them and makes markers.
///
/// A folder with `mocap/cmu_expmap` is taken for the unpacked `mocap-cmu` and `mocap-idle` archives, of which the walks are used. Of any
/// other folder all files that [`import`] knows are used, those of sub-folders included; each eighth by name is held out.
///
/// Returns the training set, the held-out set (never augmented) and what was measured. `seed` fixes the augmentation.
pub fn build(data_dir: impl AsRef<Path>, seed: u64, model: &BodyModel) -> Result<(MotionSet, MotionSet, BuildReport)> {
    let skeleton = Skeleton::new(model);
    let (clips, report) = build_clips(data_dir, seed, &skeleton)?;
    let body = model.shape(&[0.0; BETAS]);
    Ok((MotionSet::new(&skeleton, &body, &clips.train), MotionSet::new(&skeleton, &body, &clips.held_out), report))
}

/// [`build`] up to the clips.
pub fn build_clips(data_dir: impl AsRef<Path>, seed: u64, skeleton: &Skeleton) -> Result<(Clips, BuildReport)> {
    let data_dir = data_dir.as_ref();
    let archives = root(data_dir).join(EXPMAPS).is_dir();
    let read = if archives { read_archives(data_dir, skeleton)? } else { read_folder(data_dir, skeleton)? };
    let (clips, reports): (Vec<Clip>, Vec<RetargetReport>) = read.into_iter().unzip();
    let mut report = retarget_report(&reports);
    let own: Vec<String> = clips.iter().skip(1).step_by(HELD_OUT_EVERY).map(|c| c.name.clone()).collect();
    let kept = |c: &Clip| if archives { HELD_OUT.contains(&c.name.as_str()) } else { own.contains(&c.name) };
    let (held_out, originals): (Vec<_>, Vec<_>) = clips.into_iter().partition(kept);
    let idle = if archives { read_idle(data_dir, skeleton)? } else { Vec::new() };
    let (variations, made) = augment(skeleton, &originals, &idle, seed);
    (report.made, report.kept) = (made, variations.len());
    report.sets.push(("held out".into(), SetStats::new(skeleton, &held_out.iter().collect::<Vec<_>>())));
    report.sets.push(("original".into(), SetStats::new(skeleton, &originals.iter().collect::<Vec<_>>())));
    for (kind, _) in RECIPE {
        let of_kind: Vec<&Clip> = variations.iter().filter(|(k, _)| *k == kind).map(|(_, c)| c).collect();
        report.sets.push((format!("{kind:?}").to_lowercase(), SetStats::new(skeleton, &of_kind)));
    }
    let mut train = originals;
    train.extend(variations.into_iter().map(|(_, c): (Kind, Clip)| c));
    train.extend(train.iter().map(mirror).collect::<Vec<_>>());
    report.sets.push(("training".into(), SetStats::new(skeleton, &train.iter().collect::<Vec<_>>())));
    Ok((Clips { train, held_out }, report))
}

/// The folder that the archives unpack to.
fn root(data_dir: &Path) -> PathBuf {
    if data_dir.join("mocap").is_dir() { data_dir.join("mocap") } else { data_dir.to_path_buf() }
}

/// Recordings of people who stand, on the body.
fn read_idle(data_dir: &Path, skeleton: &Skeleton) -> Result<Vec<Clip>> {
    let dir = root(data_dir).join(IDLE);
    if !dir.is_dir() {
        return Err(Error::file(data_dir, format!("holds no folder mocap/{IDLE}: expected the unpacked mocap-idle archive")));
    }
    let files = sorted_files(&dir, "bvh")?;
    files.par_iter().map(|(path, _)| Ok(import(path, &ImportOptions::default())?.put_on(skeleton)?.0)).collect()
}

fn read_archives(data_dir: &Path, skeleton: &Skeleton) -> Result<Vec<(Clip, RetargetReport)>> {
    let root = root(data_dir);
    let mut clips = Vec::new();
    for set in WALKS {
        for (path, stem) in sorted_files(&root.join(EXPMAPS).join(set), "txt")? {
            clips.push(read_expmap(path, &format!("{set}/{stem}"))?);
        }
    }
    for name in BVHS {
        clips.push(read_bvh(root.join("cmu_bvh").join(format!("{name}.bvh")), name)?);
    }
    clips.par_iter().map(|s| retarget(skeleton, s)).collect()
}

/// Every recording below `dir`, named by its path there.
fn read_folder(dir: &Path, skeleton: &Skeleton) -> Result<Vec<(Clip, RetargetReport)>> {
    let mut files = Vec::new();
    for entry in walkdir::WalkDir::new(dir).sort_by_file_name() {
        let path = entry.map_err(|e| Error::file(dir, e.to_string()))?.into_path();
        if path.extension().and_then(|e| e.to_str()).is_some_and(|e| KINDS.contains(&e.to_ascii_lowercase().as_str())) {
            files.push(path);
        }
    }
    if files.len() < 2 {
        let what = format!(
            "holds neither the unpacked mocap-cmu archive (a folder mocap/{EXPMAPS}) nor two recordings ({}), expected one or the other",
            KINDS.join(", ")
        );
        return Err(Error::file(dir, what));
    }
    let clip = |path: &PathBuf| {
        let (mut clip, report) = import(path, &ImportOptions::default())?.put_on(skeleton)?;
        clip.name = path.strip_prefix(dir).unwrap_or(path).with_extension("").to_string_lossy().into_owned();
        Ok((clip, report))
    };
    files.par_iter().map(clip).collect()
}

/// Files of `dir` with the extension, sorted by name, with their stems.
fn sorted_files(dir: &Path, extension: &str) -> Result<Vec<(PathBuf, String)>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).map_err(|e| Error::io(dir, e))? {
        let path = entry.map_err(|e| Error::io(dir, e))?.path();
        if path.extension().is_some_and(|e| e == extension) {
            let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
            files.push((path, stem));
        }
    }
    files.sort();
    Ok(files)
}

fn retarget_report(reports: &[RetargetReport]) -> BuildReport {
    let shifts: Vec<f32> = reports.iter().map(|r| r.ground_shift).collect();
    let slide = |of: fn(&RetargetReport) -> &Vec<f32>| {
        let all: Vec<f32> = reports.iter().flat_map(|r| of(r).clone()).collect();
        [quantile(&all, 0.5), quantile(&all, 0.9)]
    };
    BuildReport {
        joint_error: reports.iter().filter_map(|r| r.joint_error).sum::<f32>() / reports.len().max(1) as f32,
        ground_shift: [quantile(&shifts, 0.0), quantile(&shifts, 1.0)],
        slide_before: slide(|r| &r.slide_before),
        slide_after: slide(|r| &r.slide_after),
        ..Default::default()
    }
}

impl SetStats {
    /// Measures `clips`.
    pub fn new(skeleton: &Skeleton, clips: &[&Clip]) -> Self {
        let (mut speed, mut yaw) = (Vec::new(), Vec::new());
        for clip in clips {
            for t in FUTURE..clip.len() {
                let (a, b) = (&clip.poses[t - FUTURE], &clip.poses[t]);
                let forward = (a.rots[0] * glam::Vec3::Z).truncate().normalize_or_zero();
                speed.push((b.root - a.root).truncate().dot(forward) * FPS / FUTURE as f32);
                yaw.push(wrap(super::clip::heading(b.rots[0]) - super::clip::heading(a.rots[0])).to_degrees());
            }
        }
        let slide: Vec<f32> = clips.iter().flat_map(|c| slides(skeleton, c)).collect();
        let twist: Vec<f32> = clips.iter().flat_map(|c| hip_twists(skeleton, c)).collect();
        let five = |v: &[f32]| [0.01, 0.05, 0.5, 0.95, 0.99].map(|q| quantile(v, q));
        Self {
            clips: clips.len(),
            seconds: clips.iter().map(|c| c.len()).sum::<usize>() as f32 / FPS,
            speed: five(&speed),
            yaw: five(&yaw),
            slide: [quantile(&slide, 0.5), quantile(&slide, 0.9)],
            twist: [quantile(&twist, 0.5), quantile(&twist, 0.99)].map(f32::to_degrees),
        }
    }
}

impl fmt::Display for BuildReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cm = |v: f32| 100.0 * v;
        writeln!(
            f,
            "retarget: limb joints off by {:.1} cm, clips shifted onto the floor by {:.1} to {:.1} cm",
            cm(self.joint_error),
            cm(self.ground_shift[0]),
            cm(self.ground_shift[1])
        )?;
        writeln!(
            f,
            "slide per stance, median / 90 %: {:.2} / {:.2} cm before the foot lock, {:.2} / {:.2} cm after",
            cm(self.slide_before[0]),
            cm(self.slide_before[1]),
            cm(self.slide_after[0]),
            cm(self.slide_after[1])
        )?;
        writeln!(f, "variations within the limits: {} of {}", self.kept, self.made)?;
        writeln!(
            f,
            "{:<10}{:>6}{:>8}  {:<36}{:<32}{:<16}hip twist deg",
            "set", "clips", "s", "speed m/s 1/5/50/95/99 %", "yaw deg per 0.45 s", "slide cm"
        )?;
        for (name, s) in &self.sets {
            let row = |v: &[f32], digits: usize| v.iter().map(|x| format!("{x:.digits$}")).collect::<Vec<_>>().join(" / ");
            writeln!(
                f,
                "{name:<10}{:>6}{:>8.0}  {:<36}{:<32}{:<16}{}",
                s.clips,
                s.seconds,
                row(&s.speed, 2),
                row(&s.yaw, 0),
                row(&s.slide.map(cm), 2),
                row(&s.twist, 0)
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_ones_own_is_read_by_kind() {
        let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("b")).unwrap();
        let copy = |from: &str, to: &str| std::fs::copy(fixtures.join(from), dir.path().join(to)).unwrap();
        let skeleton = Skeleton::new(&BodyModel::embedded());
        let refused = || build_clips(dir.path(), 0, &skeleton).err().unwrap().to_string();
        assert!(refused().contains("holds neither the unpacked mocap-cmu archive"), "{}", refused());
        copy("importers/smplx.npz", "b/walk.npz");
        copy("motion/named.bvh", "a.bvh");
        std::fs::write(dir.path().join("notes.md"), "no recording").unwrap();
        let (clips, _) = build_clips(dir.path(), 0, &skeleton).unwrap();
        assert_eq!(clips.held_out.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["b/walk"]);
        assert_eq!(clips.train[0].name, "a");
        std::fs::write(dir.path().join("c.npz"), "no archive").unwrap();
        assert!(refused().contains("c.npz"), "{}", refused());
    }

    /// The unpacked archive, from EGOGEN_MOCAP; the data is not part of the repository.
    #[test]
    fn recorded_walks_keep_their_quality() {
        let Ok(dir) = std::env::var("EGOGEN_MOCAP") else {
            println!("skipped: set EGOGEN_MOCAP to the folder of the unpacked mocap-cmu archive");
            return;
        };
        let model = BodyModel::load(Path::new(env!("CARGO_MANIFEST_DIR")).join("checkpoints/body/body.safetensors")).unwrap();
        let (train, held_out, report) = build(dir, 0, &model).unwrap();
        println!("{report}");
        let all = &report.sets.iter().find(|(name, _)| name == "training").unwrap().1;
        assert!(all.seconds > 3000.0 && held_out.clips.len() == 8 && train.clips.len() == all.clips);
        assert!(all.slide[1] < 0.015 && report.slide_before[1] > 0.02);
        assert!(all.yaw[0] < -40.0 && all.yaw[4] > 40.0 && all.speed[1] < 0.0 && all.speed[3] > 1.2);
    }
}
