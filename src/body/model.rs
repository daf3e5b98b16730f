//! The body asset: mesh, shape space, skinning weights and landmarks.

use super::shaped::{Posed, ShapedBody, Skin};
use super::{BETAS, JOINTS, MARKERS, PARENTS};
use crate::io::Tensors;
use crate::{Error, Result};
use glam::Vec3;
use std::path::Path;
use std::sync::{Arc, LazyLock};

/// Bones that move one vertex.
pub(super) const BONES: usize = 4;

/// A loaded body asset. Lengths in metres, in the rest frame of SMPL-X (x left, y up, z forward), T-pose, the pelvis of the
/// mean shape at the origin.
pub struct BodyModel {
    pub(super) template: Vec<Vec3>,
    /// V x 10 displacements per unit of each shape coefficient.
    pub(super) shapedirs: Vec<[Vec3; BETAS]>,
    pub(super) joints: [Vec3; JOINTS],
    pub(super) joint_dirs: [[Vec3; BETAS]; JOINTS],
    pub(super) skin: Vec<Skin>,
    pub(super) faces: Vec<[u32; 3]>,
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) uv_faces: Vec<[u32; 3]>,
    pub(super) part: Vec<u8>,
    pub(super) foot_vertices: Vec<usize>,
    pub(super) markers: [usize; MARKERS],
    pub(super) hash: String,
}

impl BodyModel {
    /// Reads a body asset from the file `path`. Errors name the tensor and the entry that is not as it should be.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        Self::from_tensors(&Tensors::read(path)?)
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

    /// The four bones of each vertex and their weights, which sum to 1.
    pub fn skinning(&self) -> impl ExactSizeIterator<Item = ([usize; BONES], [f32; BONES])> + '_ {
        self.skin.iter().map(|s| (s.bone, s.weight))
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

    /// All V vertices of `body` posed by `posed` into `out`, by linear blend skinning.
    pub fn skin(&self, body: &ShapedBody, posed: &Posed, out: &mut Vec<Vec3>) {
        out.clear();
        // x_k - R_k J_k, so that each bone costs one product and one sum.
        let shift: [Vec3; JOINTS] = std::array::from_fn(|k| posed.pos[k] - posed.rot[k] * body.joints[k]);
        out.extend(self.skin.iter().enumerate().map(|(i, s)| {
            let v = self.rest_vertex(i, &body.betas);
            (0..BONES).fold(Vec3::ZERO, |sum, b| {
                let k = s.bone[b];
                sum + s.weight[b] * (posed.rot[k] * v + shift[k])
            })
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

fn skin(t: &Tensors, v: usize) -> Result<Vec<Skin>> {
    let bone = t.indices("skin_index", &[v, BONES], JOINTS)?;
    let weight = t.f32s("skin_weight", &[v, BONES])?;
    let pairs = bone.as_chunks::<BONES>().0.iter().zip(weight.as_chunks::<BONES>().0);
    pairs
        .enumerate()
        .map(|(i, (&bone, weight))| {
            let sum: f32 = weight.iter().sum();
            if weight.iter().any(|&w| w < 0.0) || (sum - 1.0).abs() > 0.01 {
                let what = format!("tensor 'skin_weight' row {i} is {weight:?}, expected weights of at least 0 with sum 1");
                return Err(Error::file(t.origin(), what));
            }
            Ok(Skin { bone, weight: weight.map(|w| w / sum) })
        })
        .collect()
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
