//! `evaluate`, `play` and `curves` as a user runs them, on the shipped motion model.

use std::path::Path;
use std::process::{Command, Output};

fn run(program: &str, arguments: &[&str], dir: &Path) -> Output {
    Command::new(program).args(arguments).current_dir(dir).output().expect("the program starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn baselines_are_reported_the_same_every_time() {
    let dir = tempfile::tempdir().unwrap();
    let report = |out: &str| {
        let done = run(env!("CARGO_BIN_EXE_evaluate"), &["--episodes", "3", "--out", out], dir.path());
        assert!(done.status.success(), "{}", text(&done.stderr));
        assert!(text(&done.stdout).contains("greedy, best of 64"));
        std::fs::read_to_string(dir.path().join(out).join("report.json")).unwrap()
    };
    let first = report("a");
    assert_eq!(first, report("b"));
    let json: serde_json::Value = serde_json::from_str(&first).unwrap();
    assert_eq!(json["scenarios"][0]["rows"].as_array().unwrap().len(), 3);
    assert!(json["scenarios"][0]["rows"][1]["contact"]["value"].as_f64().unwrap() > 0.5);
    assert!(json["scenarios"][0]["rows"][1]["kl"].is_null());
}

#[test]
fn scenarios_make_one_report() {
    let dir = tempfile::tempdir().unwrap();
    let own = "about = 'Two meet'\nscenes = 2\n[layout]\nkind = 'circle'\npeople = 2\nradius = 1.5\nwall = 4.0\n";
    std::fs::write(dir.path().join("mine.toml"), own).unwrap();
    let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/../checkpoints/policy/quick");
    let arguments = [
        policy,
        "--no-baselines",
        "--blind",
        "--scenario",
        "mine.toml",
        "--scenario",
        "midpoint",
        "--episodes",
        "4",
        "--motions",
        "1",
        "--out",
        "r",
    ];
    let done = run(env!("CARGO_BIN_EXE_evaluate"), &arguments, dir.path());
    assert!(done.status.success(), "{}", text(&done.stderr));
    let read = |name: &str| std::fs::read_to_string(dir.path().join("r").join(name)).unwrap();
    let json: serde_json::Value = serde_json::from_str(&read("report.json")).unwrap();
    let [mine, midpoint] = [0, 1].map(|i| &json["scenarios"][i]);
    assert_eq!((&mine["name"], &mine["scenes"], &mine["episodes"]), (&"mine".into(), &2.into(), &4.into()));
    assert_eq!((midpoint["scenes"].as_u64(), midpoint["rows"].as_array().unwrap().len()), (Some(10), 3));
    assert!(mine["rows"][0]["inside_frames"]["high"].is_f64() && midpoint["rows"][0]["inside_frames"].is_null());
    // Everyone's end is counted, and boxes can be walked through.
    let ends = |row: &serde_json::Value| row["fates"].as_array().unwrap().iter().map(|f| f[1].as_u64().unwrap()).sum::<u64>();
    assert!(midpoint["rows"].as_array().unwrap().iter().all(|row| Some(ends(row)) == midpoint["episodes"].as_u64()));
    assert!(midpoint["rows"][0]["most_inside"]["value"].is_f64() && mine["rows"][0]["most_inside"].is_null());
    // Ten ways of the stochastic policy differ, of the deterministic one they do not.
    let spread = |row: usize| midpoint["rows"][row]["path_distance"]["value"].as_f64().unwrap();
    assert!(spread(0) > 0.01 && spread(1) == 0.0, "{} {}", spread(0), spread(1));
    assert_eq!(mine["differences"].as_array().unwrap().len(), 2);
    let html = read("report.html");
    for part in ["<svg", "data:image/png;base64,", "vertices in others", "How episodes ended", "no egosensing", "side entropy"] {
        assert!(html.contains(part), "{part}");
    }
    assert!(!html.contains("src=\"http") && !html.contains("href") && !html.contains("<script"), "needs nothing else");
    let motions = dir.path().join("r/motions/mine/quick--deterministic");
    let names: Vec<_> = std::fs::read_dir(motions).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    assert_eq!(names.len(), 3, "{names:?}");
}

#[test]
fn episodes_become_pictures() {
    let dir = tempfile::tempdir().unwrap();
    let done = run(env!("CARGO_BIN_EXE_play"), &["prior", "--starts", "2", "--films", "1", "--out", "pictures"], dir.path());
    assert!(done.status.success(), "{}", text(&done.stderr));
    for name in ["paths.png", "start-000-film.png", "start-000-ghosts.png"] {
        let bytes = std::fs::read(dir.path().join("pictures").join(name)).unwrap();
        assert!(bytes.starts_with(b"\x89PNG") && bytes.len() > 5000, "{name}");
    }
    assert!(!dir.path().join("pictures/start-001-film.png").exists());
    // The motion beside them, as long in one form as in the other.
    let path = dir.path().join("pictures/start-000.npz");
    let frames = egogen::motion::amass::read_amass(&path, "start", None).unwrap().frames.len();
    let bytes = std::fs::read(path.with_extension("glb")).unwrap();
    let size = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + size]).unwrap();
    let times = json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
    assert_eq!(json["accessors"][times]["count"], frames);
}

#[test]
fn mistakes_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let fails = |program: &str, arguments: &[&str], expected: &str| {
        let done = run(program, arguments, dir.path());
        let message = text(&done.stderr);
        assert!(done.status.code() == Some(2) && message.contains(expected), "{arguments:?}: {message}");
    };
    fails(env!("CARGO_BIN_EXE_evaluate"), &["nowhere", "--no-baselines"], "nowhere");
    fails(env!("CARGO_BIN_EXE_evaluate"), &["--episodes", "0"], "--episodes");
    fails(env!("CARGO_BIN_EXE_evaluate"), &["--model", "nowhere"], "nowhere");
    fails(env!("CARGO_BIN_EXE_evaluate"), &["--scenario", "circle-3"], "circle-16");
    fails(env!("CARGO_BIN_EXE_evaluate"), &["--set", "pose.prior=gone.safetensors"], "gone.safetensors");
    fails(env!("CARGO_BIN_EXE_play"), &["nowhere"], "nowhere");
    fails(env!("CARGO_BIN_EXE_curves"), &["nowhere"], "metrics.csv");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left behind");
}
