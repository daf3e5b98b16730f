//! SMPL-X's own model files, `SMPLX_{MALE,FEMALE,NEUTRAL}.npz`.
//!
//! Rest frame and joints are those of [`BodyModel`], up to the order: the jaw comes after the eyes here. Shape is the first ten
//! coefficients; hands are the first twelve components of each side about the mean hand, expressions and a turned jaw or eyes are not
//! used. Markers are the paper's vertices (SSM2), feet the vertices that ankle and foot move most (SMPL-X's own segmentation).

use super::extra::Extra;
use super::model::{BodyModel, Skinning};
use super::{BETAS, JOINTS, MARKERS, PARENTS, joint};
use crate::io::content_hash;
use crate::io::numpy::{Array, Npz};
use crate::{Error, Result};
use glam::Vec3;
use std::path::Path;
use std::sync::Arc;

/// SMPL-X's joints.
const ALL: usize = 55;
/// Rows of the pose correctives' last axis: the entries of all rotations but the first.
const CORRECTIVES: usize = 9 * (ALL - 1);
/// Joints of one hand, and the components of it that are used.
const HAND: usize = 15;
const HAND_COMPONENTS: usize = 12;
/// Weights below this move nothing by a hundredth of a millimetre.
const NO_WEIGHT: f32 = 1e-6;

/// SMPL-X's vertex of each marker, in the SSM2 order.
#[rustfmt::skip]
pub(super) const SSM2: [usize; MARKERS] = [
    3832, 5533, 5882, 3486, 3336, 4029, 4137, 5694, 3228, 2081, 4302, 4363, 4788, 4379, 3504, 3998,
    8846, 4726, 3682, 3688, 5890, 5901, 3260, 4722, 5697, 5838, 4481, 4088, 4839, 3745, 5787, 5942,
    8576, 6248, 6127, 6776, 7192, 8388, 8157, 8786, 7040, 7099, 7524, 7115, 7303, 6265, 6746, 8634,
    6443, 6449, 8584, 8595, 6023, 7458, 8391, 8532, 6627, 6832, 7575, 6503, 8481, 5531, 5487, 707,
    2026, 2198, 3066,
];

/// Our number of SMPL-X's joint `k`: the eyes come before the jaw.
fn ours(k: usize) -> usize {
    match k {
        22 => JOINTS,
        23 => joint::L_EYE,
        24 => joint::R_EYE,
        _ => k,
    }
}

/// Reads the file `path` with content `bytes`; markers are the vertices `markers`.
pub(crate) fn parse(path: &Path, bytes: &[u8], markers: &[usize; MARKERS]) -> Result<BodyModel> {
    let npz = Npz::new(path, bytes)?;
    let bad = |what: String| Err(Error::file(path, what));
    let get = |key: &str, shape: &[usize]| -> Result<Array> {
        let array = npz.array(key)?;
        array.check(path, key, shape)?;
        array.check_finite(path, key)?;
        Ok(array)
    };
    let template = points(&get("v_template", &[0, 3])?.data);
    let v = template.len();
    if let Some(i) = markers.iter().position(|&m| m >= v) {
        return bad(format!("'v_template' has {v} vertices, but marker {i} is vertex {}: expected SMPL-X's 10475", markers[i]));
    }
    let shapedirs = get("shapedirs", &[v, 3, 0])?;
    let coefficients = shapedirs.shape[2];
    if coefficients < BETAS {
        return bad(format!("'shapedirs' has {coefficients} coefficients, expected at least {BETAS}"));
    }
    let rows = shapedirs.data.chunks_exact(3 * coefficients);
    let row = |d: &[f32]| std::array::from_fn(|b| Vec3::new(d[b], d[coefficients + b], d[2 * coefficients + b]));
    let shapedirs: Vec<[Vec3; BETAS]> = rows.map(row).collect();
    let regressor = get("J_regressor", &[ALL, v])?.data;
    let parents = parents(path, &get("kintree_table", &[2, ALL])?.data)?;
    let skin = skinning(path, &get("weights", &[v, ALL])?.data)?;
    let faces = get("f", &[0, 3])?.data;
    if let Some(i) = faces.iter().position(|&f| !(0.0..v as f32).contains(&f)) {
        return bad(format!("'f' face {} names vertex {}, expected 0 to {}", i / 3, faces[i], v - 1));
    }
    let mut extra = Extra {
        parents: (JOINTS..ALL).map(|k| parents[k]).collect(),
        joints: Vec::new(),
        joint_dirs: Vec::new(),
        mean: vec![Vec3::ZERO; ALL - JOINTS],
        components: vec![Vec3::ZERO; 2 * HAND_COMPONENTS * (ALL - JOINTS)],
        correctives: correctives(&get("posedirs", &[v, 3, CORRECTIVES])?.data),
        marker_correctives: Vec::new(),
    };
    for (side, letter) in ["l", "r"].into_iter().enumerate() {
        let mean = get(&format!("hands_mean{letter}"), &[3 * HAND])?.data;
        let components = get(&format!("hands_components{letter}"), &[0, 3 * HAND])?.data;
        if components.len() < HAND_COMPONENTS * 3 * HAND {
            return bad(format!("'hands_components{letter}' has fewer than {HAND_COMPONENTS} rows"));
        }
        // The jaw is the first bone.
        let first = 1 + side * HAND;
        extra.mean[first..first + HAND].copy_from_slice(&points(&mean));
        for (k, row) in components.chunks_exact(3 * HAND).take(HAND_COMPONENTS).enumerate() {
            let at = (side * HAND_COMPONENTS + k) * (ALL - JOINTS) + first;
            extra.components[at..at + HAND].copy_from_slice(&points(row));
        }
    }
    let (mut joints, mut joint_dirs) = ([Vec3::ZERO; JOINTS], [[Vec3::ZERO; BETAS]; JOINTS]);
    let (mut more, mut more_dirs) = (vec![Vec3::ZERO; ALL - JOINTS], vec![[Vec3::ZERO; BETAS]; ALL - JOINTS]);
    for (k, weights) in regressor.chunks_exact(v).enumerate() {
        let mean = mix(weights, template.iter().copied());
        let dirs = std::array::from_fn(|b| mix(weights, shapedirs.iter().map(|d| d[b])));
        match ours(k).checked_sub(JOINTS) {
            None => (joints[ours(k)], joint_dirs[ours(k)]) = (mean, dirs),
            Some(i) => (more[i], more_dirs[i]) = (mean, dirs),
        }
    }
    (extra.joints, extra.joint_dirs) = (more, more_dirs);
    let part = skin.parts(&extra.parents);
    let feet = [joint::L_ANKLE, joint::R_ANKLE, joint::L_FOOT, joint::R_FOOT];
    let faces: Vec<[u32; 3]> = faces.as_chunks::<3>().0.iter().map(|f| f.map(|i| i as u32)).collect();
    Ok(BodyModel {
        foot_vertices: (0..v).filter(|&i| feet.contains(&usize::from(part[i]))).collect(),
        // The file's texture coordinates, where it has any, are of no use without SMPL-X's textures.
        uv: vec![[0.0; 2]],
        uv_faces: vec![[0; 3]; faces.len()],
        hash: content_hash(bytes),
        extra: Some(Arc::new(extra.with_markers(markers))),
        markers: *markers,
        template,
        shapedirs,
        joints,
        joint_dirs,
        skin,
        faces,
        part,
    })
}

/// Our parents by our numbers; refused where they are not SMPL-X's or a bone comes before what carries it.
fn parents(path: &Path, table: &[f32]) -> Result<Vec<usize>> {
    let mut parents = vec![0; ALL];
    for k in 1..ALL {
        let theirs = table[k];
        let fits = (0.0..k as f32).contains(&theirs);
        let parent = if fits { ours(theirs as usize) } else { ALL };
        let want = PARENTS.get(ours(k)).copied();
        if !fits || want.is_some_and(|w| w != parent) {
            let what = format!("'kintree_table' says that joint {k} hangs on {theirs}, expected SMPL-X's joints in their order");
            return Err(Error::file(path, what));
        }
        parents[ours(k)] = parent;
    }
    Ok(parents)
}

fn skinning(path: &Path, weights: &[f32]) -> Result<Skinning> {
    let mut skin = Skinning::default();
    for (i, row) in weights.chunks_exact(ALL).enumerate() {
        let sum: f32 = row.iter().sum();
        if (sum - 1.0).abs() > 0.01 || row.iter().any(|&w| w < -NO_WEIGHT) {
            return Err(Error::file(path, format!("'weights' of vertex {i} have sum {sum}, expected weights of at least 0 with sum 1")));
        }
        skin.push(row.iter().enumerate().filter(|(_, w)| **w > NO_WEIGHT).map(|(k, &w)| (ours(k), w)));
    }
    Ok(skin)
}

/// (V, 3, 486) numbers to V x columns vectors: joints 1 to 21, then jaw and fingers; the eyes never turn.
fn correctives(data: &[f32]) -> Vec<Vec3> {
    let columns = |k: usize| 9 * (k - 1)..9 * k;
    let used: Vec<usize> = (1..ALL).filter(|&k| ours(k) >= JOINTS || k < 22).flat_map(columns).collect();
    let rows = data.chunks_exact(3 * CORRECTIVES);
    rows.flat_map(|d| used.iter().map(|&c| Vec3::new(d[c], d[CORRECTIVES + c], d[2 * CORRECTIVES + c]))).collect()
}

/// The sum of `points` times `weights`, in double precision: thousands of them.
fn mix(weights: &[f32], points: impl Iterator<Item = Vec3>) -> Vec3 {
    let add = |sum: glam::DVec3, (&w, p): (&f32, Vec3)| sum + f64::from(w) * p.as_dvec3();
    weights.iter().zip(points).filter(|(w, _)| **w != 0.0).fold(glam::DVec3::ZERO, add).as_vec3()
}

fn points(data: &[f32]) -> Vec<Vec3> {
    data.as_chunks::<3>().0.iter().map(|&p| p.into()).collect()
}
