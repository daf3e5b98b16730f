//! Tests of shape, kinematics, skinning and the adjoint on a small made-up body.

use super::*;
use crate::rng::stream;
use glam::{Mat3, Vec3};
use proptest::prelude::*;
use rand::{Rng, RngExt};

/// A body with random proportions: pelvis off the origin, shape moving everything, one or four bones on each vertex.
pub(crate) fn toy() -> BodyModel {
    let mut rng = stream(1, "toy-body", 0);
    let v = 2 * MARKERS;
    let mut point = |scale: f32| vec3(&mut rng, scale);
    let template: Vec<Vec3> = (0..v).map(|_| point(0.8)).collect();
    let shapedirs = (0..v).map(|_| std::array::from_fn(|_| point(0.02))).collect();
    let joints = std::array::from_fn(|_| point(0.6));
    let joint_dirs = std::array::from_fn(|_| std::array::from_fn(|_| point(0.02)));
    let mut skin = model::Skinning::default();
    for i in 0..v {
        let weight = if i % 4 == 1 { [1.0, 0.0, 0.0, 0.0] } else { [0.4, 0.3, 0.2, 0.1] };
        skin.push([i % 22, (i * 7 + 3) % 24, (i * 5 + 1) % 24, 22].into_iter().zip(weight));
    }
    BodyModel {
        template,
        shapedirs,
        joints,
        joint_dirs,
        skin,
        extra: None,
        faces: vec![[0, 1, 2]],
        uv: vec![[0.0; 2]; 3],
        uv_faces: vec![[0, 1, 2]],
        part: vec![0; v],
        foot_vertices: vec![0],
        markers: std::array::from_fn(|i| 2 * i + 1),
        hash: "toy".into(),
    }
}

/// [`toy`] with a finger of two bones on the left wrist, which move some markers, and with pose correctives.
fn toy_with_fingers() -> BodyModel {
    let mut rng = stream(2, "toy-body", 0);
    let mut model = toy();
    let mut points = |n: usize, scale: f32| (0..n).map(|_| vec3(&mut rng, scale)).collect::<Vec<_>>();
    let mut skin = model::Skinning::default();
    for i in 0..model.template.len() {
        let finger = JOINTS + i % 2;
        let entries = model.skin.of(i).iter().map(|&(bone, w)| (bone, 0.5 * w)).chain([(finger, 0.3), (JOINTS, 0.2)]);
        skin.push(entries.collect::<Vec<_>>());
    }
    let extra = extra::Extra {
        parents: vec![20, JOINTS],
        joints: points(2, 0.3),
        joint_dirs: vec![[Vec3::splat(0.01); BETAS]; 2],
        mean: points(2, 0.5),
        components: points(2 * 24, 0.3),
        correctives: points(model.template.len() * 9 * 23, 0.01),
        marker_correctives: Vec::new(),
    };
    model.extra = Some(std::sync::Arc::new(extra.with_markers(&model.markers)));
    model.skin = skin;
    model
}

fn vec3(rng: &mut impl Rng, scale: f32) -> Vec3 {
    Vec3::from_array(std::array::from_fn(|_| rng.random_range(-scale..scale)))
}

pub(crate) fn random_params(seed: u64) -> [f32; PARAMS] {
    let mut rng = stream(seed, "params", 0);
    std::array::from_fn(|_| rng.random_range(-1.0..1.0))
}

fn random_betas(seed: u64) -> [f32; BETAS] {
    let mut rng = stream(seed, "betas", 0);
    std::array::from_fn(|_| rng.random_range(-2.0..2.0))
}

fn close(a: &[f32], b: &[f32], tolerance: f32) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance)
}

#[test]
fn rest_pose_gives_rest_markers_and_joints() {
    let model = toy();
    let body = model.shape(&random_betas(3));
    let mut params = [0.0; PARAMS];
    params[0..3].copy_from_slice(&[1.0, 2.0, 3.0]);
    let posed = body.pose(&params);
    let mut markers = [0.0; MARKER_DIM];
    body.markers(&posed, &mut markers);
    let shift = Vec3::new(1.0, 2.0, 3.0);
    for k in 0..JOINTS {
        assert!((posed.pos[k] - body.joints()[k] - shift).length() < 1e-5);
    }
    for (m, v) in markers.as_chunks::<3>().0.iter().zip(body.rest_markers()) {
        assert!((Vec3::from(*m) - *v - shift).length() < 1e-5);
    }
    // Shape: template + sum of beta x direction, by hand for one coordinate of one marker and one joint.
    let (b, id) = (random_betas(3), model.markers[5]);
    let hand = model.template[id].y + (0..BETAS).map(|k| b[k] * model.shapedirs[id][k].y).sum::<f32>();
    assert!((body.rest_markers()[5].y - hand).abs() < 1e-6);
    let hand = model.joints[0].x + (0..BETAS).map(|k| b[k] * model.joint_dirs[0][k].x).sum::<f32>();
    assert!((body.joints()[0].x - hand).abs() < 1e-6);
}

#[test]
fn one_bent_knee_by_hand() {
    let body = toy().shape(&[0.0; BETAS]);
    let mut params = [0.0; PARAMS];
    // Left knee a quarter turn about x: y to z, z to -y.
    params[3 + 3 * joint::L_KNEE] = std::f32::consts::FRAC_PI_2;
    let posed = body.pose(&params);
    let rest = body.joints();
    for k in 0..JOINTS {
        let o = rest[k] - rest[joint::L_KNEE];
        let below = k == joint::L_ANKLE || k == joint::L_FOOT;
        let want = if below { rest[joint::L_KNEE] + Vec3::new(o.x, -o.z, o.y) } else { rest[k] };
        assert!((posed.pos[k] - want).length() < 1e-6, "joint {k}");
    }
    assert_eq!(posed.view(), Vec3::Z);
    assert!((posed.eye_centre() - 0.5 * (rest[22] + rest[23])).length() < 1e-6);
}

#[test]
fn markers_are_vertices_of_the_skinned_mesh() {
    markers_are_vertices(toy());
    markers_are_vertices(toy_with_fingers());
}

fn markers_are_vertices(model: BodyModel) {
    let body = model.shape(&random_betas(1));
    let params = random_params(2);
    let posed = body.pose(&params);
    let mut mesh = Vec::new();
    model.skin(&body, &posed, &mut mesh);
    let mut markers = [0.0; MARKER_DIM];
    body.markers(&posed, &mut markers);
    for (m, &id) in markers.as_chunks::<3>().0.iter().zip(model.marker_vertices()) {
        assert!((Vec3::from(*m) - mesh[id]).length() < 5e-6);
    }
    let two: Vec<f32> = [params, random_params(9)].concat();
    let mut batch = vec![0.0; 2 * MARKER_DIM];
    body.markers_batch(&two, &mut batch);
    assert_eq!(batch[..MARKER_DIM], markers);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn transformed_parameters_move_every_marker(seed in 0u64..1000, turn in [-3.0f32..3.0, -3.0f32..3.0, -3.0f32..3.0], shift in [-5.0f32..5.0, -5.0f32..5.0, -5.0f32..5.0]) {
        let body = toy().shape(&random_betas(seed));
        prop_assert!(body.joints()[0].length() > 1e-3);
        let frame = Frame { rot: rotation::from_axis_angle(turn.into()), transl: shift.into() };
        let mut params = random_params(seed);
        let mut before = [0.0; MARKER_DIM];
        body.markers(&body.pose(&params), &mut before);
        body.transform_params(&mut params, &frame);
        let mut after = [0.0; MARKER_DIM];
        let posed = body.pose(&params);
        body.markers(&posed, &mut after);
        let moved: Vec<f32> = before.as_chunks::<3>().0.iter().flat_map(|&p| frame.point(p.into()).to_array()).collect();
        prop_assert!(close(&moved, &after, 1e-5));
    }
}

/// The scalar of the gradient test, in double precision to leave room for small differences.
fn weighted(body: &ShapedBody, local: &[Mat3; BODY_JOINTS], transl: Vec3, grad: &[f32]) -> f64 {
    let mut markers = [0.0; MARKER_DIM];
    body.markers(&body.pose_rotations(local, transl), &mut markers);
    markers.iter().zip(grad).map(|(&m, &g)| m as f64 * g as f64).sum()
}

#[test]
fn adjoint_matches_differences() {
    adjoint_of(toy());
    adjoint_of(toy_with_fingers());
}

fn adjoint_of(model: BodyModel) {
    let body = model.shape(&random_betas(4));
    let params = random_params(5);
    let (mut local, transl) = (local_rotations(&params), Vec3::from_slice(&params));
    let mut rng = stream(6, "grad", 0);
    let grad: [f32; MARKER_DIM] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
    let (g_transl, g_rot) = body.markers_backward(&body.pose_rotations(&local, transl), &local, &grad);
    // The markers are linear in each single entry, with correctives quadratic, so a large step has no truncation error.
    let h = 0.5f32;
    let mut largest = 0.0f64;
    for (k, gradients) in g_rot.iter().enumerate() {
        for (e, &g) in gradients.iter().enumerate() {
            let mut at = |d: f32| {
                local[k].col_mut(e % 3)[e / 3] += d;
                let value = weighted(&body, &local, transl, &grad);
                local[k].col_mut(e % 3)[e / 3] -= d;
                value
            };
            let difference = (at(h) - at(-h)) / (2.0 * h as f64);
            assert!((difference - g as f64).abs() < 2e-4, "joint {k} entry {e}: {difference} {g}");
            largest = largest.max(difference.abs());
        }
    }
    assert!(largest > 1.0);
    for (axis, &g) in Vec3::AXES.iter().zip(&g_transl) {
        let difference = weighted(&body, &local, transl + *axis, &grad) - weighted(&body, &local, transl, &grad);
        assert!((difference - g as f64).abs() < 2e-4);
    }
}

/// The first vertices stand for the markers of a file that has few.
pub(crate) fn few_vertices() -> (Vec<u8>, [usize; MARKERS]) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/assets/smplx.npz");
    (std::fs::read(path).unwrap(), std::array::from_fn(|i| (7 * i + 2) % 80))
}

#[test]
fn smplx_matches_torch() {
    let (bytes, markers) = few_vertices();
    let model = smplx::parse("smplx.npz".as_ref(), &bytes, &markers).unwrap();
    let t = crate::io::Tensors::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/assets/smplx_expected.safetensors")).unwrap();
    let get = |name: &str, shape: &[usize]| t.f32s(name, shape).unwrap();
    let (betas, params) = (get("betas", &[3, BETAS]), get("params", &[3, PARAMS]));
    let (vertices, joints) = (get("vertices", &[3, 80, 3]), get("joints", &[3, 55, 3]));
    let near = |have: &[Vec3], want: &[f32]| {
        let have: Vec<f32> = have.iter().flat_map(|p| p.to_array()).collect();
        assert!(close(&have, want, 1e-4), "{have:?} for {want:?}");
    };
    let mut mesh = Vec::new();
    for i in 0..3 {
        let body = model.shape(&betas[i * BETAS..][..BETAS]);
        let posed = body.pose(&params[i * PARAMS..][..PARAMS]);
        let want = &joints[i * 165..][..165];
        near(&posed.pos[..22], &want[..66]);
        near(&posed.pos[22..], &want[69..75]);
        let others: Vec<Vec3> = posed.bones().skip(JOINTS).map(|b| b.1).collect();
        near(&others[..1], &want[66..69]);
        near(&others[1..], &want[75..]);
        let want = &vertices[i * 240..][..240];
        model.skin(&body, &posed, &mut mesh);
        near(&mesh, want);
        let mut have = [0.0; MARKER_DIM];
        body.markers(&posed, &mut have);
        let want: Vec<f32> = markers.iter().flat_map(|&m| &want[3 * m..3 * m + 3]).copied().collect();
        assert!(close(&have, &want, 1e-4));
    }
    assert!(model.skinning().all(|(bone, weight)| bone.iter().all(|&b| b < JOINTS) && (weight.iter().sum::<f32>() - 1.0).abs() < 1e-5));
}

#[test]
fn smplx_of_another_size_and_damaged_is_refused() {
    let (bytes, markers) = few_vertices();
    let refused = |bytes: &[u8], markers: &[usize; MARKERS], words: &[&str]| {
        let e = smplx::parse("smplx.npz".as_ref(), bytes, markers).err().unwrap().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    refused(&bytes, &smplx::SSM2, &["smplx.npz", "has 80 vertices", "10475"]);
    refused(&bytes[..bytes.len() / 2], &markers, &["smplx.npz"]);
    let old = crate::io::zip::Archive::new(&bytes).unwrap();
    let without = |key: &str| {
        let names = old.names().filter(|n| *n != format!("{key}.npy"));
        crate::io::zip::pack(&names.map(|n| (n.to_string(), old.read(n).unwrap())).collect::<Vec<_>>())
    };
    for key in ["posedirs", "kintree_table", "hands_componentsr", "J_regressor"] {
        refused(&without(key), &markers, &["has no array", key]);
    }
    // A kinematic tree of another body: the head hangs on the pelvis.
    let mut entries: Vec<(String, Vec<u8>)> = old.names().map(|n| (n.to_string(), old.read(n).unwrap())).collect();
    let tree = &mut entries.iter_mut().find(|(n, _)| n == "kintree_table.npy").unwrap().1;
    let at = tree.len() - 2 * 55 * 8 + 15 * 8;
    tree[at..at + 8].copy_from_slice(&0i64.to_le_bytes());
    refused(&crate::io::zip::pack(&entries), &markers, &["'kintree_table'", "joint 15 hangs on 0"]);
}

/// All sizes of the real file, and nothing in it but a line of vertices and the weights.
#[test]
fn markers_and_feet_of_a_full_size_file_are_the_papers() {
    const V: usize = 10475;
    let mut npz = crate::io::numpy::NpzWriter::default();
    let mut put = |key: &str, shape: &[usize], data: &[f32]| npz.f32s(key, shape, data);
    put("v_template", &[V, 3], &(0..3 * V).map(|i| i as f32 * 1e-4).collect::<Vec<_>>());
    put("shapedirs", &[V, 3, 400], &vec![0.0; V * 3 * 400]);
    put("posedirs", &[V, 3, 486], &vec![0.0; V * 3 * 486]);
    put("J_regressor", &[55, V], &vec![0.0; 55 * V]);
    // The last vertices are the toes', the one before them on the left thumb's tip, all others the pelvis'.
    let bone = |v: usize| {
        if v >= V - 2 {
            10 + v % 2
        } else if v == V - 3 {
            39
        } else {
            0
        }
    };
    put("weights", &[V, 55], &(0..V).flat_map(|v| (0..55).map(move |k| f32::from(k == bone(v)))).collect::<Vec<_>>());
    let parents = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15];
    let finger = |k: usize| if k % 3 == 1 { 20 + usize::from(k >= 40) } else { k - 1 };
    let tree = (0..55).map(|k| parents.get(k).copied().unwrap_or_else(|| finger(k)) as f32);
    put("kintree_table", &[2, 55], &tree.chain((0..55).map(|k| k as f32)).collect::<Vec<_>>());
    put("f", &[20908, 3], &vec![0.0; 20908 * 3]);
    for side in ["l", "r"] {
        put(&format!("hands_mean{side}"), &[45], &[0.0; 45]);
        put(&format!("hands_components{side}"), &[45, 45], &[0.0; 45 * 45]);
    }
    let model = smplx::parse("SMPLX_NEUTRAL.npz".as_ref(), &npz.finish(), &smplx::SSM2).unwrap();
    assert_eq!((model.vertex_count(), model.faces().len()), (V, 20908));
    let feet = FOOT_MARKERS.map(|m| model.marker_vertices()[m]);
    assert_eq!(feet, [8634, 8481, 8532, 8846, 5787, 5838]);
    assert_eq!(model.foot_vertices(), [V - 2, V - 1]);
    assert_eq!(model.part()[V - 3], 20, "a finger counts to its wrist");
}

#[test]
fn refuses_a_broken_asset() {
    let error = BodyModel::from_bytes("body.safetensors", b"not tensors").err().unwrap().to_string();
    assert!(error.contains("body.safetensors"), "{error}");
    let bytes =
        crate::io::pack_tensors(&[("v_template".into(), vec![2, 2], vec![0.0; 4])], &Default::default(), crate::io::Precision::Full);
    let error = BodyModel::from_bytes("b", &bytes.unwrap()).err().unwrap().to_string();
    assert!(error.contains("v_template") && error.contains("[2, 2]"), "{error}");
}

#[test]
fn embedded_body_matches_numpy() {
    let model = BodyModel::embedded();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/body_lbs.safetensors");
    let t = crate::io::Tensors::read(file).unwrap();
    let get = |name: &str, shape: &[usize]| t.f32s(name, shape).unwrap();
    let (betas, params, joints) = (get("betas", &[4, BETAS]), get("params", &[4, PARAMS]), get("joints", &[4, JOINTS, 3]));
    let (markers, vertices, mean) = (get("markers", &[4, MARKERS, 3]), get("vertices", &[4, 64, 3]), get("vertex_sum", &[4, 3]));
    let ids = t.indices("vertex_ids", &[64], model.vertex_count()).unwrap();
    for i in 0..4 {
        let body = model.shape(&betas[i * BETAS..][..BETAS]);
        let posed = body.pose(&params[i * PARAMS..][..PARAMS]);
        let mut out = vec![0.0; MARKER_DIM];
        body.markers(&posed, &mut out);
        assert!(close(&out, &markers[i * MARKER_DIM..][..MARKER_DIM], 1e-5), "markers {i}");
        posed.write_joints(&mut out[..3 * JOINTS]);
        assert!(close(&out[..3 * JOINTS], &joints[i * 3 * JOINTS..][..3 * JOINTS], 1e-5), "joints {i}");
        let mut mesh = Vec::new();
        model.skin(&body, &posed, &mut mesh);
        let picked: Vec<f32> = ids.iter().flat_map(|&id| mesh[id].to_array()).collect();
        assert!(close(&picked, &vertices[i * 192..][..192], 1e-5), "vertices {i}");
        let centre: Vec3 = mesh.iter().sum::<Vec3>() / mesh.len() as f32;
        assert!(close(&centre.to_array(), &mean[3 * i..][..3], 1e-4), "mean {i}");
    }
}
