//! An episode as an animated glTF 2.0 binary: skinned people among boxes or in a room.

use super::buffer::Buffer;
use crate::body::{BODY_JOINTS, BodyModel, JOINT_NAMES, JOINTS, ORIENT, PARAMS, PARENTS, ShapedBody, TRANSL, check_motion};
use crate::io::write_atomic;
use crate::motion::FPS;
use crate::render::{Episode, Mesh, Rgb, Walker, by_colour, colour};
use crate::scene::BoxObstacle;
use crate::{Error, Result};
use glam::{Mat4, Quat, Vec3};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::f32::consts::FRAC_PI_2;
use std::path::Path;

/// The scene's root, which turns our z up into the format's y up.
const WORLD: usize = 0;

/// Writes [`glb`] to the file `path`, whole or not at all.
pub fn write_glb(path: impl AsRef<Path>, model: &BodyModel, episode: &Episode) -> Result<()> {
    write_atomic(path, &glb(model, episode)?)
}

/// A `.glb` of `episode`: one skinned body of 24 joints per walker, all boxes as one mesh or the room as one of each colour, and one animation at 40 keyframes per
/// second with a rotation per body joint and the pelvis' translation. Metres; the node `world` turns z up into y up.
///
/// Errors: no walker, frames or betas of a wrong length, non-finite values.
pub fn glb(model: &BodyModel, episode: &Episode) -> Result<Vec<u8>> {
    if episode.walkers.is_empty() {
        return Err(Error::invalid("an episode without walkers cannot be written"));
    }
    let mut file = Document::default();
    let world = Node { name: "world".into(), rotation: Some(Quat::from_rotation_x(-FRAC_PI_2).to_array()), ..Node::default() };
    file.nodes.push(world);
    let surface = Surface::new(model, &mut file.buffer);
    for (i, walker) in episode.walkers.iter().enumerate() {
        check_motion(walker.frames, walker.betas).map_err(|e| Error::invalid(format!("walker {i}: {e}")))?;
        file.person(model, &surface, walker, i);
    }
    match episode.room {
        Some(room) => by_colour(room, |_| true).iter().for_each(|(mesh, shade)| file.solid("room", mesh, *shade)),
        None => file.boxes(&episode.scene.obstacles),
    }
    Ok(file.pack())
}

#[derive(Default, Serialize)]
struct Node {
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    translation: Option<[f32; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rotation: Option<[f32; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    skin: Option<usize>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    children: Vec<usize>,
}

/// What all people have in common: accessors, and the vertex of the body that each vertex of the file is.
struct Surface {
    vertices: Vec<usize>,
    uv: usize,
    joints: usize,
    weights: usize,
    indices: usize,
}

impl Surface {
    /// Splits vertices where the texture has a seam, because the format has one texture coordinate per vertex.
    fn new(model: &BodyModel, buffer: &mut Buffer) -> Self {
        let (mut known, mut pairs, mut indices) = (BTreeMap::new(), Vec::new(), Vec::new());
        for pair in model.faces().as_flattened().iter().zip(model.uv_faces().as_flattened()) {
            indices.push(*known.entry(pair).or_insert_with(|| {
                pairs.push(pair);
                pairs.len() as u32 - 1
            }));
        }
        let vertices: Vec<usize> = pairs.iter().map(|&(&v, _)| v as usize).collect();
        // The format counts v downwards.
        let uv: Vec<[f32; 2]> = pairs.iter().map(|&(_, &t)| model.uv()[t as usize]).map(|[u, v]| [u, 1.0 - v]).collect();
        let skinning: Vec<_> = model.skinning().collect();
        // A bone without weight has to be bone 0.
        let bones = |&v: &usize| -> [u8; 4] {
            let (bone, weight) = skinning[v];
            std::array::from_fn(|b| if weight[b] > 0.0 { bone[b] as u8 } else { 0 })
        };
        let weights: Vec<[f32; 4]> = vertices.iter().map(|&v| skinning[v].1).collect();
        Self {
            uv: buffer.vertices(&uv),
            joints: buffer.bytes(&vertices.iter().map(bones).collect::<Vec<_>>()),
            weights: buffer.vertices(&weights),
            indices: buffer.indices(&indices),
            vertices,
        }
    }
}

/// The parts of the file so far.
#[derive(Default)]
struct Document {
    buffer: Buffer,
    nodes: Vec<Node>,
    meshes: Vec<Value>,
    materials: Vec<Value>,
    skins: Vec<Value>,
    samplers: Vec<Value>,
    channels: Vec<Value>,
}

impl Document {
    /// A walker: its mesh, skeleton and motion.
    fn person(&mut self, model: &BodyModel, surface: &Surface, walker: &Walker, i: usize) {
        let name = format!("person-{i}");
        let body = model.shape(walker.betas);
        let mesh = self.skin_mesh(model, surface, walker, &name, i);
        let pelvis = self.skeleton(&body, &name);
        let shifts: [[f32; 16]; JOINTS] = body.joints().map(|j| Mat4::from_translation(-j).to_cols_array());
        let matrices = self.buffer.floats(&shifts);
        let joints: Vec<usize> = (pelvis..pelvis + JOINTS).collect();
        self.skins.push(json!({ "name": name, "skeleton": pelvis, "joints": joints, "inverseBindMatrices": matrices }));
        // A skinned mesh follows its joints alone, so its node stands outside the world.
        self.nodes.push(Node { name: format!("{name}-body"), mesh: Some(mesh), skin: Some(self.skins.len() - 1), ..Node::default() });
        self.motion(&body, walker.frames, pelvis);
    }

    fn skin_mesh(&mut self, model: &BodyModel, surface: &Surface, walker: &Walker, name: &str, i: usize) -> usize {
        let mut rest = Mesh { vertices: Vec::new(), faces: model.faces().to_vec() };
        model.rest_vertices(walker.betas, &mut rest.vertices);
        let normals = rest.normals();
        let split = |all: &[Vec3]| surface.vertices.iter().map(|&v| all[v].to_array()).collect::<Vec<_>>();
        let (positions, normals) = (self.buffer.vertices(&split(&rest.vertices)), self.buffer.vertices(&split(&normals)));
        let attributes = json!({
            "POSITION": positions, "NORMAL": normals, "TEXCOORD_0": surface.uv, "JOINTS_0": surface.joints, "WEIGHTS_0": surface.weights,
        });
        self.mesh(name, attributes, Some(surface.indices), colour::PEOPLE[i % colour::PEOPLE.len()])
    }

    /// A mesh of one colour; returns its number.
    fn mesh(&mut self, name: &str, attributes: Value, indices: Option<usize>, shade: Rgb) -> usize {
        let [r, g, b] = shade.map(linear);
        let surface = json!({ "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8 });
        self.materials.push(json!({ "name": name, "pbrMetallicRoughness": surface }));
        let mut primitive = json!({ "attributes": attributes, "material": self.materials.len() - 1 });
        if let Some(indices) = indices {
            primitive["indices"] = json!(indices);
        }
        self.meshes.push(json!({ "name": name, "primitives": [primitive] }));
        self.meshes.len() - 1
    }

    /// The nodes of a body's joints at rest, under a node of their own; returns the pelvis'.
    fn skeleton(&mut self, body: &ShapedBody, name: &str) -> usize {
        let root = self.nodes.len();
        self.nodes[WORLD].children.push(root);
        self.nodes.push(Node { name: name.into(), children: vec![root + 1], ..Node::default() });
        let pelvis = root + 1;
        for k in 0..JOINTS {
            let parent = if k == 0 { Vec3::ZERO } else { body.joints()[PARENTS[k]] };
            let children = (1..JOINTS).filter(|&c| PARENTS[c] == k).map(|c| pelvis + c).collect();
            let translation = Some((body.joints()[k] - parent).to_array());
            self.nodes.push(Node { name: JOINT_NAMES[k].into(), translation, children, ..Node::default() });
        }
        pelvis
    }

    /// Keyframes of all frames; at rest the joints stand as in the first.
    fn motion(&mut self, body: &ShapedBody, frames: &[f32], pelvis: usize) {
        let rows = || frames.chunks_exact(PARAMS);
        let times: Vec<[f32; 1]> = (0..rows().len()).map(|t| [t as f32 / FPS]).collect();
        let times = self.buffer.floats(&times);
        let way: Vec<[f32; 3]> = rows().map(|f| (body.joints()[0] + Vec3::from_slice(&f[TRANSL])).to_array()).collect();
        self.nodes[pelvis].translation = way.first().copied();
        let values = self.buffer.floats(&way);
        self.channel(times, values, pelvis, "translation");
        for k in 0..BODY_JOINTS {
            let turns = one_way(rows().map(|f| Quat::from_scaled_axis(Vec3::from_slice(&f[ORIENT.start + 3 * k..]))));
            self.nodes[pelvis + k].rotation = turns.first().copied();
            let values = self.buffer.floats(&turns);
            self.channel(times, values, pelvis + k, "rotation");
        }
    }

    fn channel(&mut self, times: usize, values: usize, node: usize, path: &str) {
        self.samplers.push(json!({ "input": times, "output": values, "interpolation": "LINEAR" }));
        self.channels.push(json!({ "sampler": self.samplers.len() - 1, "target": { "node": node, "path": path } }));
    }

    /// All boxes as one mesh.
    fn boxes(&mut self, boxes: &[BoxObstacle]) {
        let mut mesh = Mesh::default();
        boxes.iter().for_each(|b| mesh.append(&Mesh::cuboid(b.centre, b.size / 2.0, b.yaw, b.height)));
        self.solid("boxes", &mesh, colour::STONE);
    }

    /// A mesh that stands still, unless it is empty; its triangles share no vertex, so that the edges look sharp.
    fn solid(&mut self, name: &str, mesh: &Mesh, shade: Rgb) {
        let corners: Vec<Vec3> = mesh.faces.as_flattened().iter().map(|&i| mesh.vertices[i as usize]).collect();
        if corners.is_empty() {
            return;
        }
        let faces = (0..corners.len() as u32).collect::<Vec<_>>().as_chunks().0.to_vec();
        let flat = Mesh { vertices: corners, faces };
        let floats = |all: &[Vec3]| all.iter().map(Vec3::to_array).collect::<Vec<_>>();
        let (positions, normals) = (self.buffer.vertices(&floats(&flat.vertices)), self.buffer.vertices(&floats(&flat.normals())));
        let mesh = self.mesh(name, json!({ "POSITION": positions, "NORMAL": normals }), None, shade);
        let node = self.nodes.len();
        self.nodes[WORLD].children.push(node);
        self.nodes.push(Node { name: name.into(), mesh: Some(mesh), ..Node::default() });
    }

    fn pack(self) -> Vec<u8> {
        let skinned = (0..self.nodes.len()).filter(|&n| self.nodes[n].skin.is_some());
        let roots: Vec<usize> = std::iter::once(WORLD).chain(skinned).collect();
        self.buffer.pack(json!({
            "asset": { "version": "2.0", "generator": concat!("egogen ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{ "nodes": roots }],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": self.materials,
            "skins": self.skins,
            "animations": [{ "name": "motion", "samplers": self.samplers, "channels": self.channels }],
        }))
    }
}

/// Unit quaternions (x, y, z, w), each of the sign that lies nearer to the one before: viewers interpolate without looking.
fn one_way(turns: impl Iterator<Item = Quat>) -> Vec<[f32; 4]> {
    let mut last = Quat::IDENTITY;
    turns
        .map(|q| {
            last = if q.dot(last) < 0.0 { -q } else { q }.normalize();
            last.to_array()
        })
        .collect()
}

/// A channel of an sRGB colour as the format wants it, linear in light.
fn linear(channel: u8) -> f32 {
    let c = f32::from(channel) / 255.0;
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests;
