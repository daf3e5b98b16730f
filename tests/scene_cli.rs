//! Scene bundles through the program `scene`: made, shown, read back, and what it refuses.

use egogen::scene::SceneBundle;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn start(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_scene")).args(args).output().expect("the program starts")
}

fn done(args: &[&str]) -> String {
    let output = start(args);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn refused(args: &[&str], word: &str) {
    let output = start(args);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && message.contains(word), "{args:?}: {word}: {:?} {message}", output.status.code());
}

/// All that lies in a folder and those below it.
fn listing(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).unwrap().map(|e| e.unwrap().path());
    let mut all: Vec<PathBuf> = entries.flat_map(|p| if p.is_dir() { [vec![p.clone()], listing(&p)].concat() } else { vec![p] }).collect();
    all.sort();
    all
}

fn room(out: &str) -> Vec<&str> {
    vec!["room", "--kind", "corridor", "--seed", "3", "--difficulty", "0.6", "--voxel", "0.2", "--pairs-count", "20", "--out", out]
}

#[test]
fn a_room_is_made_shown_and_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|n| dir.path().join(n).display().to_string());
    let told = done(&room(&a));
    assert_eq!(done(&["show", &a]), told);
    for word in ["corridor-3-0.60", "walkable", "triangles", "voxels of 0.2 m", "pairs      20", "from       room"] {
        assert!(told.contains(word), "{word}: {told}");
    }
    let bundle = SceneBundle::read(Path::new(&a)).unwrap();
    assert!(bundle.mesh.is_some() && bundle.sdf.is_some() && bundle.pairs.len() == 20);
    assert!(bundle.pairs.iter().filter(|p| p.blocked).count() >= 14);
    // The same again, over the old one too, byte for byte.
    done(&room(&b));
    done(&room(&a));
    for file in ["scene.json", "scene.safetensors", "top.png"] {
        assert!(fs::read(Path::new(&a).join(file)).unwrap() == fs::read(Path::new(&b).join(file)).unwrap(), "{file}");
    }
}

#[test]
fn meshes_and_files_become_scenes() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    // A floor of 5 x 4 m with a block of 1 m, y up as OBJ has it.
    let block = |(x0, x1): (f32, f32), (y0, y1): (f32, f32), (z0, z1): (f32, f32), first: usize| {
        let corners = [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0), (x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)];
        let points: String = corners.iter().map(|(x, y, z)| format!("v {x} {z} {}\n", -y)).collect();
        let sides = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
        let faces: String =
            sides.iter().map(|s| format!("f {} {} {} {}\n", s[0] + first, s[1] + first, s[2] + first, s[3] + first)).collect();
        points + &faces
    };
    let floor = block((-2.5, 2.5), (-2.0, 2.0), (-0.01, 0.0), 1);
    fs::write(path("room.obj"), floor.clone() + &block((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0), 9)).unwrap();
    let told = done(&["mesh", &path("room.obj"), "--voxel", "0.1", "--pairs-count", "10", "--blocked", "0.5", "--out", &path("scene")]);
    assert!(told.contains("1 holes") && told.contains("floor      z = 0.000 m"), "{told}");
    let scene = SceneBundle::read(Path::new(&path("scene"))).unwrap();
    let sdf = scene.sdf.unwrap();
    assert!((sdf.at([1.5, 0.0, 0.5].into()) - 1.0).abs() < 0.02 && sdf.at([0.0, 0.0, 0.5].into()) < -0.4);

    fs::write(path("area.json"), "[[[-3, -2], [3, -2], [3, 2], [-3, 2]], [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]]").unwrap();
    let told = done(&["import", "--polygon", &path("area.json"), "--pairs-count", "6", "--out", &path("imported")]);
    assert!(told.contains("23.00 m2") && told.contains("from       polygon: area.json"), "{told}");

    let out = path("never");
    fs::write(path("wall.obj"), "v 0 0 0\nv 3 0 0\nv 3 3 0\nf 1 2 3\n").unwrap();
    fs::write(path("full.obj"), floor + &block((-2.6, 2.6), (-2.1, 2.1), (0.0, 1.0), 9)).unwrap();
    fs::write(path("nan.json"), "[[0, 0], [4, 0], [NaN, 4]]").unwrap();
    fs::write(path("bow.wkt"), "POLYGON ((0 0, 4 4, 4 0, 0 2, 0 0))").unwrap();
    let before = listing(dir.path());
    refused(&["mesh", &path("wall.obj"), "--out", &out], "wall.obj: no floor");
    refused(&["mesh", &path("full.obj"), "--floor", "0", "--out", &out], "no walkable area");
    refused(&["mesh", &path("room.obj"), "--unit", "1e9", "--out", &out], "expected 1 mm to 10 km");
    refused(&["import", "--polygon", &path("nan.json"), "--out", &out], "nan.json: is no JSON");
    refused(&["import", "--polygon", &path("bow.wkt"), "--out", &out], "crosses or touches itself");
    refused(&["import", "--out", &out], "no walkable area");
    refused(&["import", "--polygon", &path("area.json"), "--voxel", "0.1", "--out", &out], "--voxel");
    for option in ["--pairs-count", "--blocked", "--seed"] {
        let pairs = path("pairs.npy");
        refused(&["import", "--polygon", &path("area.json"), "--pairs", &pairs, option, "0", "--out", &out], "cannot be used with");
    }
    refused(&["room", "--difficulty", "7", "--out", &out], "rooms.difficulty");
    refused(&["room", "--voxel", "nan", "--out", &out], "voxel is NaN");
    // After the pairs, and after everything: a folder that cannot be made.
    refused(&["room", "--kind", "hall", "--voxel", "0.005", "--pairs-count", "1", "--out", &out], "take a larger voxel");
    let within_a_file = path("area.json") + "/scene";
    let output = start(&room(&within_a_file));
    assert!(output.status.code() == Some(1) && String::from_utf8_lossy(&output.stderr).contains("area.json"));
    assert_eq!(listing(dir.path()), before, "nothing is left behind");
}

#[test]
fn what_is_exported_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    done(&room(&path("room")));
    let (sdf, pickle, pairs) = (path("sdf.npz"), path("authors.pkl"), path("pairs.npy"));
    done(&["export", &path("room"), "--sdf", &sdf, "--authors-sdf", &pickle, "--pairs", &pairs]);
    let whole = SceneBundle::read(Path::new(&path("room"))).unwrap();
    fs::write(path("area.json"), serde_json::json!(whole.walkable).to_string()).unwrap();
    for file in [&sdf, &pickle] {
        done(&["import", "--polygon", &path("area.json"), "--sdf", file, "--pairs", &pairs, "--out", &path("again")]);
        let again = SceneBundle::read(Path::new(&path("again"))).unwrap();
        assert_eq!(again.pairs.len(), whole.pairs.len());
        for (pair, same) in whole.pairs.iter().zip(&again.pairs) {
            assert_eq!((pair.start, pair.goal, pair.blocked), (same.start, same.goal, same.blocked));
            // A corner that just keeps the clearance may not after its coordinates were rounded.
            assert!((pair.way - same.way).abs() < 5e-3, "{} {}", pair.way, same.way);
            let at = |bundle: &SceneBundle| bundle.sdf.as_ref().unwrap().at(pair.start.extend(1.0));
            assert!((at(&again) - at(&whole)).abs() < 1e-4);
        }
    }
    done(&["import", "--polygon", &path("area.json"), "--pairs-count", "0", "--out", &path("bare")]);
    refused(&["export", &path("bare"), "--sdf", &sdf], "has no signed distances");
    refused(&["export", &path("bare"), "--pairs", &pairs], "has no pairs");
    refused(&["export", &path("bare")], "required");
}

#[test]
fn damaged_bundles_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("scene");
    let name = out.display().to_string();
    done(&room(&name));
    let (json, tensors) = (out.join("scene.json"), out.join("scene.safetensors"));
    let (text, bytes) = (fs::read_to_string(&json).unwrap(), fs::read(&tensors).unwrap());
    fs::write(&json, text.replacen("\"floor\"", "\"flor\"", 1)).unwrap();
    refused(&["show", &name], "flor");
    fs::write(&json, &text).unwrap();
    fs::write(&tensors, &bytes[..1000]).unwrap();
    refused(&["show", &name], "scene.safetensors");
    fs::remove_file(&tensors).unwrap();
    refused(&["show", &name], "scene.safetensors");
    let thesis = dir.path().join("thesis");
    fs::create_dir(&thesis).unwrap();
    fs::write(thesis.join("chapter.tex"), "work").unwrap();
    let output = start(&room(thesis.to_str().unwrap()));
    assert!(output.status.code() == Some(2) && thesis.join("chapter.tex").exists());
}
