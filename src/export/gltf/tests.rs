//! The file is taken apart and evaluated by the rules of glTF alone.

use super::*;
use crate::body::BETAS;
use crate::body::tests::random_params;
use crate::scene::Scene;
use glam::{Vec2, Vec4};

/// A file taken apart.
struct File {
    json: Value,
    bin: Vec<u8>,
}

fn number(v: &Value) -> usize {
    v.as_u64().unwrap() as usize
}

impl File {
    fn new(bytes: &[u8]) -> Self {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let text = 20 + word(12);
        assert_eq!((&bytes[16..20], &bytes[text + 4..text + 8], bytes.len() - text - 8), (&b"JSON"[..], &b"BIN\0"[..], word(text)));
        Self { json: serde_json::from_slice(&bytes[20..text]).unwrap(), bin: bytes[text + 8..].to_vec() }
    }

    /// Numbers of accessor `a` in rows.
    fn rows(&self, a: &Value) -> Vec<Vec<f32>> {
        let accessor = &self.json["accessors"][number(a)];
        let view = &self.json["bufferViews"][number(&accessor["bufferView"])];
        let data = &self.bin[number(&view["byteOffset"])..][..number(&view["byteLength"])];
        let width = match accessor["type"].as_str().unwrap() {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let words = data.as_chunks::<4>().0.iter();
        let numbers: Vec<f32> = match number(&accessor["componentType"]) {
            5121 => data.iter().map(|&b| f32::from(b)).collect(),
            5125 => words.map(|&w| u32::from_le_bytes(w) as f32).collect(),
            _ => words.map(|&w| f32::from_le_bytes(w)).collect(),
        };
        assert_eq!(numbers.len(), width * number(&accessor["count"]));
        numbers.chunks_exact(width).map(<[f32]>::to_vec).collect()
    }

    /// Matrices of all nodes at keyframe `t`.
    fn globals(&self, t: usize) -> Vec<Mat4> {
        let nodes = self.json["nodes"].as_array().unwrap();
        let floats = |v: &Value| v.as_array().map(|a| a.iter().map(|x| x.as_f64().unwrap() as f32).collect::<Vec<_>>());
        let mut parts: Vec<[Option<Vec<f32>>; 2]> = nodes.iter().map(|n| [floats(&n["translation"]), floats(&n["rotation"])]).collect();
        let animation = &self.json["animations"][0];
        for channel in animation["channels"].as_array().unwrap() {
            let values = self.rows(&animation["samplers"][number(&channel["sampler"])]["output"]);
            let part = usize::from(channel["target"]["path"] == "rotation");
            parts[number(&channel["target"]["node"])][part] = Some(values[t].clone());
        }
        let mut globals = vec![Mat4::IDENTITY; nodes.len()];
        let mut open: Vec<(usize, Mat4)> =
            self.json["scenes"][0]["nodes"].as_array().unwrap().iter().map(|n| (number(n), Mat4::IDENTITY)).collect();
        while let Some((n, up)) = open.pop() {
            let [shift, turn] = &parts[n];
            let turn = turn.as_ref().map_or(Quat::IDENTITY, |q| Quat::from_slice(q));
            let shift = shift.as_ref().map_or(Vec3::ZERO, |p| Vec3::from_slice(p));
            globals[n] = up * Mat4::from_rotation_translation(turn, shift);
            open.extend(nodes[n]["children"].as_array().into_iter().flatten().map(|c| (number(c), globals[n])));
        }
        globals
    }

    /// Corners of the triangles of skinned person `i` at keyframe `t`, y up.
    fn corners(&self, i: usize, t: usize) -> Vec<Vec3> {
        let node = self.json["nodes"].as_array().unwrap().iter().filter(|n| !n["skin"].is_null()).nth(i).unwrap();
        let (skin, mesh) = (&self.json["skins"][number(&node["skin"])], &self.json["meshes"][number(&node["mesh"])]);
        let globals = self.globals(t);
        let bind = self.rows(&skin["inverseBindMatrices"]);
        let joints = skin["joints"].as_array().unwrap().iter().zip(&bind);
        let bones: Vec<Mat4> = joints.map(|(j, m)| globals[number(j)] * Mat4::from_cols_slice(m)).collect();
        let primitive = &mesh["primitives"][0];
        let attribute = |name: &str| self.rows(&primitive["attributes"][name]);
        let (positions, joints, weights) = (attribute("POSITION"), attribute("JOINTS_0"), attribute("WEIGHTS_0"));
        let vertex = |v: usize| -> Vec3 {
            let p: Vec4 = Vec3::from_slice(&positions[v]).extend(1.0);
            (0..4).map(|b| weights[v][b] * (bones[joints[v][b] as usize] * p)).sum::<Vec4>().truncate()
        };
        self.rows(&primitive["indices"]).iter().map(|c| vertex(c[0] as usize)).collect()
    }
}

/// Three frames of random poses within a step of the origin.
fn frames(seed: u64) -> Vec<f32> {
    (0..3).flat_map(|t| random_params(seed + t)).collect()
}

#[test]
fn skinning_by_the_rules_of_the_format_is_ours() {
    let model = BodyModel::embedded();
    let shapes = [[0.0; BETAS], [1.5, -1.0, 0.5, 0.0, 0.8, 0.0, -0.6, 0.0, 0.3, 1.0]];
    let (a, b) = (frames(1), frames(20));
    let walkers = [(&a, &shapes[0]), (&b, &shapes[1])].map(|(frames, betas)| Walker { frames, betas, goal: None });
    let episode = Episode { walkers: &walkers, scene: &Scene::default(), room: None, reach: 0.1 };
    let bytes = glb(&model, &episode).unwrap();
    assert!(bytes == glb(&model, &episode).unwrap());
    let file = File::new(&bytes);
    for (i, walker) in walkers.iter().enumerate() {
        let body = model.shape(walker.betas);
        for (t, params) in walker.frames.chunks_exact(PARAMS).enumerate() {
            let mut want = Vec::new();
            model.skin(&body, &body.pose(params), &mut want);
            let corners = file.corners(i, t);
            assert_eq!(corners.len(), 3 * model.faces().len());
            for (got, &v) in corners.iter().zip(model.faces().as_flattened()) {
                let p = want[v as usize];
                assert!(got.distance(Vec3::new(p.x, p.z, -p.y)) < 1e-4, "person {i}, frame {t}, vertex {v}: {got}, {p}");
            }
        }
    }
}

#[test]
fn textures_stay_and_keyframes_turn_the_short_way() {
    let model = BodyModel::embedded();
    // The orientation passes half a turn about x, where the axis of its vector jumps to -x.
    let mut frames = vec![0.0; 3 * PARAMS];
    [3.0, 3.1, 3.2 - std::f32::consts::TAU].iter().enumerate().for_each(|(t, &angle)| frames[t * PARAMS + ORIENT.start] = angle);
    let walkers = [Walker { frames: &frames, betas: &[0.0; BETAS], goal: None }];
    let file = File::new(&glb(&model, &Episode { walkers: &walkers, scene: &Scene::default(), room: None, reach: 0.1 }).unwrap());
    let primitive = &file.json["meshes"][0]["primitives"][0];
    let uv = file.rows(&primitive["attributes"]["TEXCOORD_0"]);
    for (corner, &t) in file.rows(&primitive["indices"]).iter().zip(model.uv_faces().as_flattened()) {
        let [u, v] = model.uv()[t as usize];
        assert_eq!(uv[corner[0] as usize], [u, 1.0 - v]);
    }
    let animation = &file.json["animations"][0];
    let sampler = |k: usize, end: &str| file.rows(&animation["samplers"][k][end]);
    assert_eq!(sampler(1, "input"), [[0.0], [0.025], [0.05]]);
    for (t, q) in sampler(1, "output").iter().enumerate() {
        let half = (3.0 + 0.1 * t as f32) / 2.0;
        assert!((Vec4::from_slice(q) - Vec4::new(half.sin(), 0.0, 0.0, half.cos())).length() < 1e-6, "{t}: {q:?}");
    }
    // 22 joints turn and the pelvis moves; the eyes are fixed to the head.
    assert_eq!(animation["channels"].as_array().unwrap().len(), 23);
    assert_eq!(file.json["nodes"].as_array().unwrap().len(), 27);
}

#[test]
fn boxes_stand_on_the_floor_facing_out() {
    let model = BodyModel::embedded();
    let block = BoxObstacle { centre: Vec2::new(1.0, -1.0), size: Vec2::new(0.8, 0.4), yaw: 0.5, height: 1.2 };
    let scene = Scene::with_boxes(4.0, vec![block]).unwrap();
    let frames = [0.0; PARAMS];
    let walkers = [Walker { frames: &frames, betas: &[0.0; BETAS], goal: None }];
    let file = File::new(&glb(&model, &Episode { walkers: &walkers, scene: &scene, room: None, reach: 0.1 }).unwrap());
    let attributes = &file.json["meshes"][1]["primitives"][0]["attributes"];
    let (positions, normals) = (file.rows(&attributes["POSITION"]), file.rows(&attributes["NORMAL"]));
    assert_eq!(positions.len(), 36);
    let middle = Vec3::new(1.0, -1.0, 0.6);
    for (p, n) in positions.iter().zip(&normals) {
        let out = (Vec3::from_slice(p) - middle).dot(Vec3::from_slice(n));
        assert!([0.4, 0.2, 0.6].iter().any(|half| (out - half).abs() < 1e-5), "{out}");
    }
    // The world's root turns the top of the box upwards.
    let node = file.json["nodes"].as_array().unwrap().iter().position(|n| n["name"] == "boxes").unwrap();
    assert!((file.globals(0)[node].transform_point3(middle) - Vec3::new(1.0, 0.6, 1.0)).length() < 1e-6);
}

#[test]
fn bad_recordings_are_refused() {
    let write = |walkers: &[Walker]| {
        glb(&BodyModel::embedded(), &Episode { walkers, scene: &Scene::default(), room: None, reach: 0.1 })
            .map(|_| ())
            .unwrap_err()
            .to_string()
    };
    let walker = |frames| Walker { frames, betas: &[0.0; BETAS], goal: None };
    assert!(write(&[]).contains("without walkers"));
    assert!(write(&[walker(&[0.0; PARAMS]), walker(&[0.0; 92])]).contains("walker 1: 92 frame values"));
    assert!(write(&[walker(&[f32::NAN; PARAMS])]).contains("walker 0: frame 0"));
}

#[test]
fn colours_become_linear() {
    assert_eq!((linear(0), linear(255)), (0.0, 1.0));
    // The standard's curve at 188 / 255.
    assert!((linear(188) - 0.502_886).abs() < 1e-5);
}
