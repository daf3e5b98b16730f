//! Training of the motion model: through the program where the recordings are at hand, through the library otherwise.

use egogen::body::{BETAS, BodyModel};
use egogen::io::Tensors;
use egogen::motion::primitive::{ClipMarkers, MotionSet};
use egogen::sim::World;
use egogen_envs::motion::{MotionEnv, MotionTask};
use egogen_train::evaluate::{Actor, play};
use egogen_train::primitives::fit::{Outcome, Run};
use egogen_train::primitives::settings::Settings;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const PRIMITIVES: &str = env!("CARGO_BIN_EXE_primitives");

/// Motion of the shipped model instead of recordings.
fn wandering() -> MotionSet {
    let world = World::embedded().unwrap();
    let mut env = MotionEnv::evaluation(MotionTask::default(), world.sim.clone(), world.held_out.clone(), 6, 1).unwrap();
    let body = world.sim.body().shape(&[0.0; BETAS]);
    let clip = |params: Vec<f32>| ClipMarkers::from_params("wandering".into(), &body, params);
    let films = play(&mut env, &Actor::Prior, 1, true).unwrap().into_iter().filter_map(|p| p.film);
    MotionSet { clips: films.map(|f| clip(f.frames)).collect() }
}

#[test]
fn an_interrupted_training_goes_on_to_the_same_weights() {
    let (set, body) = (wandering(), BodyModel::embedded());
    let dir = tempfile::tempdir().unwrap();
    let (whole, pieces) = (dir.path().join("whole"), dir.path().join("pieces"));
    let settings = Settings { steps: [12, 40, 16], batch: [32, 64, 32], ..Default::default() };
    let go_on = AtomicBool::new(false);
    assert_eq!(Run::new(&set, &set, &body, settings.clone(), &whole).train(&go_on).unwrap(), Outcome::Done);
    let mut interruptions = 0;
    let mut run = Run::new(&set, &set, &body, settings, &pieces);
    loop {
        let stop = AtomicBool::new(false);
        let outcome = std::thread::scope(|s| {
            s.spawn(|| {
                std::thread::sleep(Duration::from_millis(700));
                stop.store(true, Ordering::Relaxed);
            });
            run.train(&stop).unwrap()
        });
        if outcome == Outcome::Done {
            break;
        }
        interruptions += 1;
        run = Run::resume(&set, &set, &body, &pieces).unwrap();
    }
    assert!(interruptions > 0, "was never interrupted");
    let states = [&whole, &pieces].map(|dir| Tensors::read(dir.join("state.safetensors")).unwrap());
    for name in ["predictor", "regressor"].iter().flat_map(|n| [n.to_string(), format!("{n}.m"), format!("{n}.v")]) {
        let [a, b] = states.each_ref().map(|t| t.f32s(&name, &[0]).unwrap());
        assert!(a == b, "{name} differs");
    }
    for file in ["predictor.safetensors", "regressor.safetensors", "motion.json"] {
        assert!(fs::read(whole.join(file)).unwrap() == fs::read(pieces.join(file)).unwrap(), "{file} differs");
    }
}

#[test]
fn a_folder_without_recordings_and_a_damaged_state_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let fails = |arguments: &[&str], expected: &str| {
        let done = Command::new(PRIMITIVES).args(arguments).current_dir(dir.path()).output().unwrap();
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "{message}");
    };
    fails(&["train", "--data", "nowhere", "--out", "out"], "nowhere");
    fails(&["eval", "--data", ".", "--model", "out"], "nor two recordings");
    fails(&["train", "--data", ".", "--out", "out", "--klx", "1"], "--klx");
    fails(&["train", "--data", ".", "--out", "out", "--set", "loss.klx=1"], "klx");
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left behind");
    fs::write(dir.path().join("state.safetensors"), b"\x08\0\0\0\0\0\0\0{}").unwrap();
    let message = Run::resume(&wandering(), &wandering(), &BodyModel::embedded(), dir.path()).err().unwrap().to_string();
    assert!(message.contains("state.safetensors"), "{message}");
}

/// The recordings, unpacked into `dir`; none where they are not at hand.
fn recordings(dir: &Path) -> Option<PathBuf> {
    let shared =
        std::env::var_os("EGOGEN_SHARED").map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    for name in ["mocap-cmu", "mocap-idle"] {
        let archive = shared.join(format!("data/{name}.tar.gz"));
        if !archive.is_file() {
            println!("skipped: no {} (set EGOGEN_SHARED)", archive.display());
            return None;
        }
        assert!(Command::new("tar").arg("xzf").arg(archive).arg("-C").arg(dir).status().unwrap().success());
    }
    Some(dir.join("mocap"))
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_and_resume_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let Some(data) = recordings(dir.path()) else { return };
    let (data, out) = (data.to_str().unwrap(), dir.path().join("out"));
    let interrupted = |more: &[&str]| {
        let mut arguments = vec!["train", "--data", data, "--out", out.to_str().unwrap()];
        arguments.extend(more);
        let mut child = Command::new(PRIMITIVES).args(arguments).stderr(Stdio::piped()).spawn().unwrap();
        let rows = || fs::read_to_string(out.join("single.csv")).map_or(0, |t| t.lines().count());
        let (before, begun) = (rows(), Instant::now());
        while rows() <= before.max(1) && begun.elapsed() < Duration::from_secs(300) && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(200));
        }
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        let done = child.wait_with_output().unwrap();
        assert_eq!(done.status.code(), Some(130), "{}", String::from_utf8_lossy(&done.stderr));
        rows()
    };
    let first = interrupted(&[]);
    assert!(interrupted(&["--resume"]) > first);
}
