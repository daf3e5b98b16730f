//! Scene bundles written, read, damaged and compared.

use super::*;
use crate::scene::{Navigator, PairOptions, RoomKind, Rooms, Walkable, WalkableOptions};
use serde_json::Value;

pub fn bundle() -> SceneBundle {
    let room = Rooms { kind: RoomKind::Corridor, difficulty: 0.2 }.draw(5).unwrap();
    let found = Walkable::of_mesh(&room.mesh, &WalkableOptions { cell: 0.1, close: 0.0, ..Default::default() }).unwrap();
    let navigator = Navigator::new(&room.walkable, 0.22).unwrap();
    SceneBundle {
        name: room.name,
        floor: 0.0,
        walkable: room.walkable,
        origin: BTreeMap::from([("seed".into(), "5".into())]),
        mesh: Some(room.mesh),
        blocked: Some(found.blocked),
        sdf: Some(SdfGrid { lowest: Vec3::NEG_ONE, voxel: 0.5, dims: [2, 3, 2], values: (0..12).map(|i| i as f32).collect() }),
        clearance: 0.22,
        pairs: PairOptions { count: 5, ..Default::default() }.draw(&navigator, 0).unwrap(),
    }
}

#[test]
fn a_bundle_survives_its_files() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a/scene");
    let full = bundle();
    full.write(&path, b"picture").unwrap();
    let read = SceneBundle::read(&path).unwrap();
    // Coordinates of rings and cells are kept to a nanometre.
    let points = |b: &SceneBundle| b.walkable.rings().flatten().copied().chain([b.blocked.as_ref().unwrap().lowest]).collect::<Vec<_>>();
    assert!(points(&read).iter().zip(points(&full)).all(|(a, b)| a.distance(b) < 1e-9));
    assert_eq!(SceneBundle { walkable: full.walkable.clone(), blocked: full.blocked.clone(), ..read.clone() }, full);
    read.write(&path, b"picture").unwrap();
    assert_eq!(SceneBundle::read(&path).unwrap(), read);
    // Once more over the old one, bare.
    let bare = SceneBundle { mesh: None, blocked: None, sdf: None, pairs: Vec::new(), ..read };
    bare.write(&path, b"other").unwrap();
    assert_eq!(SceneBundle::read(&path).unwrap(), bare);
    assert_eq!(fs::read(path.join(PICTURE)).unwrap(), b"other");
    assert_eq!(fs::read_dir(dir.path().join("a")).unwrap().count(), 1, "nothing is left behind");
    let foreign = dir.path().join("foreign");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("thesis.tex"), "much work").unwrap();
    let refused = |dir: &Path| bare.write(dir, b"").unwrap_err().to_string();
    assert!(refused(&foreign).contains("holds thesis.tex, which is no part of a scene"));
    fs::write(path.join("notes.txt"), "of mine").unwrap();
    assert!(refused(&path).contains("holds notes.txt"));
    assert!(foreign.join("thesis.tex").exists() && path.join("notes.txt").exists() && SceneBundle::read(&path).is_ok());
    assert!(refused(&path.join("notes.txt")).contains("is no folder"));
    fs::rename(foreign.join("thesis.tex"), foreign.join(PICTURE)).unwrap();
    assert!(refused(&foreign).contains("holds no scene.json"));
}

#[test]
fn a_bundle_survives_a_kill_between_renames() {
    let dir = tempfile::tempdir().unwrap();
    let (path, aside) = (dir.path().join("scene"), dir.path().join(".scene.old.tmp"));
    let bare = SceneBundle { mesh: None, blocked: None, sdf: None, pairs: Vec::new(), ..bundle() };
    bare.write(&path, b"").unwrap();
    let whole = SceneBundle::read(&path).unwrap();
    fs::rename(&path, &aside).unwrap();
    assert_eq!(SceneBundle::read(&path).unwrap(), whole);
    bare.write(&path, b"new").unwrap();
    assert!(path.join(PICTURE).exists() && !aside.exists());
}

#[test]
fn damage_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene");
    bundle().write(&path, b"").unwrap();
    let (json, tensors) = (path.join(DESCRIPTION), path.join(TENSORS));
    let (text, bytes) = (fs::read_to_string(&json).unwrap(), fs::read(&tensors).unwrap());
    let read = || SceneBundle::read(&path).unwrap_err().to_string();
    let edited = |change: fn(&mut Value)| {
        let mut value: Value = serde_json::from_str(&text).unwrap();
        change(&mut value);
        fs::write(&json, value.to_string()).unwrap();
        read()
    };
    for (change, word) in [
        ((|v| v["wals"] = 3.into()) as fn(&mut Value), "wals"),
        (|v| v["format"] = 9.into(), "format 9"),
        (|v| v["units"] = "feet".into(), "units 'feet'"),
        (|v| v["walkable"]["exterior"] = serde_json::json!([[0, 0], [2, 2], [2, 0], [0, 1]]), "crosses or touches itself"),
        (|v| v["walkable"]["exterior"] = serde_json::json!([[0, 0], [2, null], [2, 0]]), "null"),
        (|v| v["tensors"] = "00".into(), "another SHA-256"),
        (|v| drop(v.as_object_mut().map(|o| o.remove("sdf"))), "'sdf'"),
        (|v| v["objects"] = serde_json::json!(["floor"]), "tensor 'object' entry"),
        (|v| v["blocked"]["cell"] = 0.into(), "cells of 0 m"),
    ] {
        let e = edited(change);
        assert!(e.contains(word) && e.contains("scene."), "{word}: {e}");
    }
    fs::write(&json, &text).unwrap();
    fs::write(&tensors, &bytes[..bytes.len() / 2]).unwrap();
    assert!(read().contains("scene.safetensors: not a whole safetensors file"));
    let odd = pack_raw(&[("chairs", Dtype::U8, vec![1], vec![1])], &BTreeMap::new()).unwrap();
    fs::write(&tensors, &odd).unwrap();
    fs::write(&json, text.replace(&content_hash(&bytes), &content_hash(&odd))).unwrap();
    assert!(read().contains("unknown tensor 'chairs'"));
}
