//! glTF 2.0, as text with buffers beside it or within it, and as `.glb`: the triangles of its scene where the nodes put them.
//!
//! Textures, skins, morphs and animations are left out: what is read is the rest pose in the materials' base colours.

mod buffer;

use super::import::{GREY, Raw};
use crate::{Error, Result};
use buffer::{Accessor, Buffer, BufferView, View, load};
use glam::{Mat4, Quat, Vec3};
use serde::Deserialize;
use std::borrow::Cow;
use std::collections::{HashMap, HashSet};
use std::path::Path;

/// Extensions that may be required and still change nothing that is read here.
const HARMLESS: [&str; 5] = ["KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_mesh_quantization"];

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Document {
    scene: Option<usize>,
    scenes: Vec<Scene>,
    nodes: Vec<Node>,
    meshes: Vec<Mesh>,
    materials: Vec<Material>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: Vec<Buffer>,
    extensions_required: Vec<String>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Scene {
    nodes: Vec<usize>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Node {
    name: Option<String>,
    mesh: Option<usize>,
    children: Vec<usize>,
    matrix: Option<[f32; 16]>,
    translation: Option<[f32; 3]>,
    rotation: Option<[f32; 4]>,
    scale: Option<[f32; 3]>,
}

impl Node {
    fn place(&self) -> Mat4 {
        let parts = || {
            let rotation = self.rotation.map_or(Quat::IDENTITY, |r| Quat::from_array(r).normalize());
            let (scale, translation) = (self.scale.map_or(Vec3::ONE, Vec3::from), self.translation.map_or(Vec3::ZERO, Vec3::from));
            Mat4::from_scale_rotation_translation(scale, rotation, translation)
        };
        self.matrix.map_or_else(parts, |m| Mat4::from_cols_array(&m))
    }
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Mesh {
    name: Option<String>,
    primitives: Vec<Primitive>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Primitive {
    attributes: HashMap<String, usize>,
    indices: Option<usize>,
    material: Option<usize>,
    mode: Option<u32>,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Material {
    name: Option<String>,
    pbr_metallic_roughness: Pbr,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Pbr {
    base_color_factor: Option<[f32; 4]>,
}

/// Reads a glTF; every node with a mesh becomes an object. Positions are as in the file, y up.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Raw> {
    let error = |what: String| Error::file(path, what);
    let (json, binary) = chunks(bytes).map_err(error)?;
    let document: Document = serde_json::from_slice(json).map_err(|e| error(format!("is no glTF 2.0: {e}")))?;
    if let Some(name) = document.extensions_required.iter().find(|name| !HARMLESS.iter().any(|h| name.starts_with(h))) {
        return Err(error(format!("needs the extension {name}, which is not read; export it without (no compression, no instancing)")));
    }
    let buffers = load(path, &document.buffers, binary)?;
    let mut reader = Reader { document: &document, buffers: &buffers, raw: Raw::default() };
    reader.scene().map_err(error)?;
    Ok(reader.raw)
}

/// The JSON and the binary part of a file.
fn chunks(bytes: &[u8]) -> std::result::Result<(&[u8], Option<&[u8]>), String> {
    let Some(rest) = bytes.strip_prefix(b"glTF") else { return Ok((bytes, None)) };
    let word = |bytes: &[u8]| bytes.split_first_chunk().map(|(&w, _)| u32::from_le_bytes(w) as usize);
    let (Some(version), Some(length)) = (word(rest), rest.get(4..).and_then(word)) else {
        return Err("is cut off within its header".into());
    };
    if version != 2 {
        return Err(format!("is glTF {version}, expected version 2"));
    }
    if length > bytes.len() {
        return Err(format!("is cut off: it has {} bytes, but its header says {length}", bytes.len()));
    }
    let (mut at, mut found) = (12, [None, None]);
    while let Some(size) = bytes.get(at..).and_then(word) {
        let kind = bytes.get(at + 4..at + 8);
        let data = bytes.get(at + 8..).and_then(|rest| rest.get(..size)).ok_or("is cut off within a chunk")?;
        match kind {
            Some(b"JSON") => found[0] = found[0].or(Some(data)),
            Some(b"BIN\0") => found[1] = found[1].or(Some(data)),
            _ => {}
        }
        at += 8 + size;
    }
    Ok((found[0].ok_or("has no JSON chunk")?, found[1]))
}

struct Reader<'a> {
    document: &'a Document,
    buffers: &'a [Cow<'a, [u8]>],
    raw: Raw,
}

impl Reader<'_> {
    /// Walks the nodes of the scene; without scenes, all that are no child of another.
    fn scene(&mut self) -> std::result::Result<(), String> {
        let nodes = &self.document.nodes;
        let (scenes, first) = (&self.document.scenes, self.document.scene.unwrap_or(0));
        let roots = if scenes.is_empty() {
            let children: HashSet<usize> = nodes.iter().flat_map(|n| n.children.iter().copied()).collect();
            (0..nodes.len()).filter(|i| !children.contains(i)).collect()
        } else {
            scenes.get(first).ok_or_else(|| format!("names scene {first}, but has {}", scenes.len()))?.nodes.clone()
        };
        let mut open: Vec<(usize, Mat4)> = roots.iter().rev().map(|&i| (i, Mat4::IDENTITY)).collect();
        let mut seen = vec![false; nodes.len()];
        while let Some((i, parent)) = open.pop() {
            let node = nodes.get(i).ok_or_else(|| format!("names node {i}, but has {}", nodes.len()))?;
            if std::mem::replace(&mut seen[i], true) {
                return Err(format!("node {i} has two parents or is below itself, expected a tree"));
            }
            let place = parent * node.place();
            if let Some(mesh) = node.mesh {
                self.mesh(mesh, node, place)?;
            }
            open.extend(node.children.iter().rev().map(|&child| (child, place)));
        }
        Ok(())
    }

    fn mesh(&mut self, number: usize, node: &Node, place: Mat4) -> std::result::Result<(), String> {
        let document = self.document;
        let mesh = document.meshes.get(number).ok_or_else(|| format!("names mesh {number}, but has {}", document.meshes.len()))?;
        let name = node.name.as_ref().or(mesh.name.as_ref()).cloned().unwrap_or_else(|| format!("mesh {number}"));
        let object = self.raw.mesh.add_object(&name);
        for (k, primitive) in mesh.primitives.iter().enumerate() {
            self.primitive(primitive, object, place).map_err(|what| format!("mesh {number} ('{name}'), primitive {k}: {what}"))?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, object: u16, place: Mat4) -> std::result::Result<(), String> {
        let mode = primitive.mode.unwrap_or(4);
        let Some(&position) = primitive.attributes.get("POSITION").filter(|_| (4..=6).contains(&mode)) else { return Ok(()) };
        let positions = view(self.document, self.buffers, position, "VEC3")?;
        let indices = primitive.indices.map(|i| view(self.document, self.buffers, i, "SCALAR")).transpose()?;
        let corner = |i: usize| indices.as_ref().map_or(i, |view| view.number(i, 0) as usize);
        let material = self.material(primitive.material)?;
        let mirrored = place.determinant() < 0.0;
        // Only vertices of triangles are taken over, so that a small file cannot become a large mesh.
        let mut number = vec![u32::MAX; positions.count];
        for [a, b, c] in triangles(mode, indices.as_ref().map_or(positions.count, |v| v.count)) {
            let mut triangle = [0; 3];
            for (slot, v) in triangle.iter_mut().zip(if mirrored { [a, c, b] } else { [a, b, c] }.map(corner)) {
                let number = number.get_mut(v).ok_or_else(|| format!("names vertex {v}, but there are {}", positions.count))?;
                if *number == u32::MAX {
                    *number = self.raw.mesh.vertices.len() as u32;
                    let p = Vec3::from([0, 1, 2].map(|axis| positions.number(v, axis) as f32));
                    self.raw.mesh.vertices.push(place.transform_point3(p));
                }
                *slot = *number;
            }
            self.raw.push(triangle, object, material)?;
        }
        Ok(())
    }

    fn material(&mut self, number: Option<usize>) -> std::result::Result<u16, String> {
        let Some(number) = number else { return Ok(self.raw.mesh.add_material("default", GREY)) };
        let materials = &self.document.materials;
        let material = materials.get(number).ok_or_else(|| format!("names material {number}, but there are {}", materials.len()))?;
        let name = material.name.clone().unwrap_or_else(|| format!("material {number}"));
        let color = material.pbr_metallic_roughness.base_color_factor.unwrap_or([1.0; 4]);
        Ok(self.raw.mesh.add_material(&name, color.map(|c| c.clamp(0.0, 1.0))))
    }
}

/// Which corners make the triangles of a list (mode 4), a strip (5) or a fan (6).
fn triangles(mode: u32, corners: usize) -> impl Iterator<Item = [usize; 3]> {
    let count = if mode == 4 { corners / 3 } else { corners.saturating_sub(2) };
    (0..count).map(move |t| match mode {
        4 => [3 * t, 3 * t + 1, 3 * t + 2],
        5 => [t, t + 1 + t % 2, t + 2 - t % 2],
        _ => [0, t + 1, t + 2],
    })
}

fn view<'a>(document: &Document, buffers: &'a [Cow<'a, [u8]>], accessor: usize, shape: &str) -> std::result::Result<View<'a>, String> {
    let found = document.accessors.get(accessor);
    let found = found.ok_or_else(|| format!("names accessor {accessor}, but there are {}", document.accessors.len()))?;
    found.view(shape, &document.buffer_views, buffers).map_err(|what| format!("accessor {accessor} {what}"))
}
