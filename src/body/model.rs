//! The body asset: mesh, shape space, skinning weights and landmarks.

use super::extra::{Extra, correct};
use super::shaped::{Posed, ShapedBody};
use super::smplx;
use super::{BETAS, JOINTS, MARKERS, PARENTS};
use crate::io::{Tensors, write_atomic};
use crate::{Error, Result};
use glam::{Mat3, Vec3};
use rayon::prelude::*;
use std::path::Path;
use std::sync::{Arc, LazyLock};

/// Names of the body asset in a motion-model folder.
const FILES: [&str; 2] = ["body.npz", "body.safetensors"];
/// Bones of a vertex in this project's own asset, and for formats that hold that many.
pub(super) const BONES: usize = 4;

/// The bones that move each vertex and how much each weighs (sum 1): joints, and behind them the bones of [`Extra`].
#[derive(Clone, Debug, Default)]
pub(super) struct Skinning {
    /// Where each vertex's entries end.
    ends: Vec<usize>,
    entries: Vec<(usize, f32)>,
}

impl Skinning {
    /// Adds the next vertex.
    pub fn push(&mut self, entries: impl IntoIterator<Item = (usize, f32)>) {
        self.entries.extend(entries);
        self.ends.push(self.entries.len());
    }

    /// Bones and weights of vertex `i`.
    pub fn of(&self, i: usize) -> &[(usize, f32)] {
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        &self.entries[start..self.ends[i]]
    }

    /// What bone `k` weighs in vertex `i`.
    pub fn weight(&self, i: usize, k: usize) -> f32 {
        self.of(i).iter().filter(|e| e.0 == k).map(|e| e.1).sum()
    }

    /// Weights of vertex `i` by joint, bones counted to the joint that carries them; `carriers`: [`Extra::parents`].
    fn by_joint(&self, i: usize, carriers: &[usize]) -> [f32; JOINTS] {
        let mut weights = [0.0; JOINTS];
        for &(mut bone, weight) in self.of(i) {
            while let Some(extra) = bone.checked_sub(JOINTS) {
                bone = carriers[extra];
            }
            weights[bone] += weight;
        }
        weights
    }

    /// The joint that weighs most on each vertex.
    pub fn parts(&self, carriers: &[usize]) -> Vec<u8> {
        let top = |w: [f32; JOINTS]| (1..JOINTS).fold(0, |top, k| if w[k] > w[top] { k } else { top }) as u8;
        (0..self.ends.len()).map(|i| top(self.by_joint(i, carriers))).collect()
    }

    /// The joints that weigh most on vertex `i`, weights with sum 1; of a vertex with few bones all as they are.
    fn strongest(&self, i: usize, carriers: &[usize]) -> ([usize; BONES], [f32; BONES]) {
        let own = self.of(i);
        let mut entries = own.to_vec();
        if own.len() > BONES || own.iter().any(|e| e.0 >= JOINTS) {
            entries = self.by_joint(i, carriers).into_iter().enumerate().filter(|e| e.1 > 0.0).collect();
            entries.sort_by(|a, b| b.1.total_cmp(&a.1));
            entries.truncate(BONES);
            let sum: f32 = entries.iter().map(|e| e.1).sum();
            entries.iter_mut().for_each(|e| e.1 /= sum);
        }
        entries.resize(BONES, (0, 0.0));
        (std::array::from_fn(|b| entries[b].0), std::array::from_fn(|b| entries[b].1))
    }
}

/// A loaded body asset. Lengths in metres, in the rest frame of SMPL-X (x left, y up, z forward), T-pose; the shipped one has the pelvis of
/// the mean shape at the origin.
pub struct BodyModel {
    pub(super) template: Vec<Vec3>,
    /// V x 10 displacements per unit of each shape coefficient.
    pub(super) shapedirs: Vec<[Vec3; BETAS]>,
    pub(super) joints: [Vec3; JOINTS],
    pub(super) joint_dirs: [[Vec3; BETAS]; JOINTS],
    pub(super) skin: Skinning,
    /// What only SMPL-X has.
    pub(super) extra: Option<Arc<Extra>>,
    pub(super) faces: Vec<[u32; 3]>,
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) uv_faces: Vec<[u32; 3]>,
    pub(super) part: Vec<u8>,
    pub(super) foot_vertices: Vec<usize>,
    pub(super) markers: [usize; MARKERS],
    pub(super) hash: String,
}

impl BodyModel {
    /// Reads a body asset from the file `path`: safetensors, or SMPL-X's own model file (`.npz`). Errors name the tensor and the entry that
    /// is not as it should be.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        if !is_npz(path) {
            return Self::from_tensors(&Tensors::read(path)?);
        }
        smplx::parse(path, &std::fs::read(path).map_err(|e| Error::io(path, e))?, &smplx::SSM2)
    }

    /// Reads a body asset from the content of a file; `origin` names it in errors.
    pub fn from_bytes(origin: impl AsRef<Path>, bytes: &[u8]) -> Result<Self> {
        Self::from_tensors(&Tensors::from_bytes(origin, bytes.to_vec())?)
    }

    /// The body that ships inside the library, read once.
    pub fn embedded() -> Arc<Self> {
        static BODY: LazyLock<Arc<BodyModel>> = LazyLock::new(|| {
            let bytes = include_bytes!("../../checkpoints/body/body.safetensors");
            Arc::new(BodyModel::from_bytes("checkpoints/body/body.safetensors", bytes).expect("the shipped asset is checked by a test"))
        });
        BODY.clone()
    }

    /// The body of the motion-model folder `dir`: the asset that lies in it, else the shipped one.
    pub fn beside(dir: impl AsRef<Path>) -> Result<Arc<Self>> {
        match FILES.iter().map(|name| dir.as_ref().join(name)).find(|path| path.exists()) {
            Some(path) => Ok(Arc::new(Self::load(path)?)),
            None => Ok(Self::embedded()),
        }
    }

    /// Copies the body asset at `path` into the motion-model folder `dir`, where [`BodyModel::beside`] finds it.
    pub fn put_beside(path: &Path, dir: &Path) -> Result<()> {
        let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
        write_atomic(dir.join(FILES[usize::from(!is_npz(path))]), &bytes)
    }

    fn from_tensors(t: &Tensors) -> Result<Self> {
        let template = vec3s(&t.f32s("v_template", &[0, 3])?);
        let v = template.len();
        let parents = t.ints("parents", &[JOINTS])?;
        if let Some(k) = (1..JOINTS).find(|&k| parents[k] != PARENTS[k] as i32) {
            let what =
                format!("tensor 'parents' entry {k} is {}, expected {} (SMPL-X's body joints, then the eyes)", parents[k], PARENTS[k]);
            return Err(Error::file(t.origin(), what));
        }
        let joint_dirs = directions(&t.f32s("joint_dirs", &[JOINTS, 3, BETAS])?);
        let uv: Vec<[f32; 2]> = t.f32s("uv", &[0, 2])?.as_chunks().0.to_vec();
        let markers = t.indices("markers", &[MARKERS], v)?;
        Ok(Self {
            shapedirs: directions(&t.f32s("shapedirs", &[v, 3, BETAS])?),
            joints: array(&vec3s(&t.f32s("joints_template", &[JOINTS, 3])?)),
            joint_dirs: array(&joint_dirs),
            skin: skin(t, v)?,
            extra: None,
            faces: triangles(&t.indices("faces", &[0, 3], v)?),
            uv_faces: triangles(&t.indices("uv_faces", &[0, 3], uv.len())?),
            uv,
            part: t.ints("part", &[v])?.into_iter().map(|p| p as u8).collect(),
            foot_vertices: t.indices("foot_vertices", &[0], v)?,
            markers: array(&markers),
            template,
            hash: t.hash(),
        })
    }

    /// Number of vertices V.
    pub fn vertex_count(&self) -> usize {
        self.template.len()
    }

    /// Triangles as vertex indices, counter-clockwise seen from outside.
    pub fn faces(&self) -> &[[u32; 3]] {
        &self.faces
    }

    /// Texture coordinates.
    pub fn uv(&self) -> &[[f32; 2]] {
        &self.uv
    }

    /// Triangles as indices into [`BodyModel::uv`], in the order of [`BodyModel::faces`].
    pub fn uv_faces(&self) -> &[[u32; 3]] {
        &self.uv_faces
    }

    /// Body part of each vertex.
    pub fn part(&self) -> &[u8] {
        &self.part
    }

    /// Vertices of both feet.
    pub fn foot_vertices(&self) -> &[usize] {
        &self.foot_vertices
    }

    /// The vertex of each of the 67 markers, in the SSM2 order.
    pub fn marker_vertices(&self) -> &[usize; MARKERS] {
        &self.markers
    }

    /// The four joints that weigh most on each vertex and their weights, which sum to 1; fingers count to the wrist. For formats that hold
    /// no more; the body itself moves by all its bones.
    pub fn skinning(&self) -> impl ExactSizeIterator<Item = ([usize; BONES], [f32; BONES])> + '_ {
        let carriers = self.extra.as_ref().map_or(&[][..], |e| &e.parents);
        (0..self.template.len()).map(|i| self.skin.strongest(i, carriers))
    }

    /// Rest joints of the mean shape.
    pub fn joints_template(&self) -> &[Vec3; JOINTS] {
        &self.joints
    }

    /// Displacement of each rest joint per unit of each shape coefficient.
    pub fn joint_dirs(&self) -> &[[Vec3; BETAS]; JOINTS] {
        &self.joint_dirs
    }

    /// SHA-256 of the asset; policies and motion models name it.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The body of shape `betas` (10 coefficients): rest joints and markers. Panics on another length.
    pub fn shape(&self, betas: &[f32]) -> ShapedBody {
        ShapedBody::new(self, betas)
    }

    /// Rest vertices of shape `betas` into `out`.
    pub fn rest_vertices(&self, betas: &[f32], out: &mut Vec<Vec3>) {
        out.clear();
        out.extend((0..self.template.len()).map(|i| self.rest_vertex(i, betas)));
    }

    /// All V vertices of `body` posed by `posed` into `out`, by linear blend skinning of the vertices at rest, corrected by the pose where
    /// the asset says how.
    pub fn skin(&self, body: &ShapedBody, posed: &Posed, out: &mut Vec<Vec3>) {
        out.clear();
        // x_k - R_k J_k, so that each bone costs one product and one sum.
        let bones: Vec<(Mat3, Vec3)> = posed.bones().zip(body.rest_bones()).map(|((rot, pos), j)| (rot, pos - rot * j)).collect();
        out.par_extend((0..self.template.len()).into_par_iter().map(|i| {
            let mut v = self.rest_vertex(i, &body.betas);
            if let Some(extra) = &self.extra {
                let n = extra.columns();
                v += correct(&extra.correctives[i * n..(i + 1) * n], &posed.extra.feature);
            }
            self.skin.of(i).iter().fold(Vec3::ZERO, |sum, &(k, weight)| sum + weight * (bones[k].0 * v + bones[k].1))
        }));
    }

    pub(super) fn rest_vertex(&self, i: usize, betas: &[f32]) -> Vec3 {
        blend(self.template[i], &self.shapedirs[i], betas)
    }
}

/// A mean plus its displacements weighed by `betas`.
pub(super) fn blend(mean: Vec3, dirs: &[Vec3; BETAS], betas: &[f32]) -> Vec3 {
    dirs.iter().zip(betas).fold(mean, |v, (&d, &b)| v + b * d)
}

fn is_npz(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "npz")
}

fn skin(t: &Tensors, v: usize) -> Result<Skinning> {
    let bone = t.indices("skin_index", &[v, BONES], JOINTS)?;
    let weight = t.f32s("skin_weight", &[v, BONES])?;
    let mut skin = Skinning::default();
    for (i, (bone, weight)) in bone.as_chunks::<BONES>().0.iter().zip(weight.as_chunks::<BONES>().0).enumerate() {
        let sum: f32 = weight.iter().sum();
        if weight.iter().any(|&w| w < 0.0) || (sum - 1.0).abs() > 0.01 {
            let what = format!("tensor 'skin_weight' row {i} is {weight:?}, expected weights of at least 0 with sum 1");
            return Err(Error::file(t.origin(), what));
        }
        skin.push(bone.iter().zip(weight).map(|(&b, w)| (b, w / sum)));
    }
    Ok(skin)
}

fn vec3s(data: &[f32]) -> Vec<Vec3> {
    data.as_chunks::<3>().0.iter().map(|&p| p.into()).collect()
}

/// (n, 3, 10) floats to n x 10 vectors.
fn directions(data: &[f32]) -> Vec<[Vec3; BETAS]> {
    let rows = data.chunks_exact(3 * BETAS);
    rows.map(|d| std::array::from_fn(|b| Vec3::new(d[b], d[BETAS + b], d[2 * BETAS + b]))).collect()
}

fn triangles(indices: &[usize]) -> Vec<[u32; 3]> {
    indices.as_chunks::<3>().0.iter().map(|f| f.map(|i| i as u32)).collect()
}

/// The first N entries; the caller has checked the length.
fn array<T: Copy, const N: usize>(data: &[T]) -> [T; N] {
    std::array::from_fn(|i| data[i])
}
