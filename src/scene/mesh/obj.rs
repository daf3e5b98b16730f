//! Wavefront OBJ with its MTL: `v`, `f`, `o`, `g`, `usemtl`, `mtllib`; `newmtl`, `Kd`, `d`, `Tr`. Everything else is left out.

use super::import::{GREY, Raw};
use crate::{Error, Result};
use glam::Vec3;
use std::borrow::Cow;
use std::collections::HashMap;
use std::fs;
use std::path::Path;

/// Reads an OBJ. Faces of more than three corners become fans about their first; an index may count back from the newest vertex.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Raw> {
    let text = String::from_utf8_lossy(bytes);
    let mut reader = Reader { path, ..Reader::default() };
    let mut lines = text.lines().enumerate();
    while let Some((number, first)) = lines.next() {
        let mut line = Cow::Borrowed(first);
        while let Some(start) = line.strip_suffix('\\') {
            let next = lines.next().map_or("", |(_, next)| next);
            line = Cow::Owned(format!("{start} {next}"));
        }
        reader.line(&line).map_err(|what| Error::file(path, format!("line {}: {what}", number + 1)))?;
    }
    Ok(reader.raw)
}

struct Reader<'a> {
    path: &'a Path,
    raw: Raw,
    colours: HashMap<String, [f32; 4]>,
    objects: HashMap<String, u16>,
    materials: HashMap<String, u16>,
    object: String,
    material: String,
    /// Numbers of the object and the material above, once a face has them.
    current: Option<(u16, u16)>,
    /// Corners of the face that is being read.
    face: Vec<u32>,
}

impl Default for Reader<'_> {
    fn default() -> Self {
        let (object, material) = ("object".into(), "default".into());
        let (colours, objects, materials) = (HashMap::new(), HashMap::new(), HashMap::new());
        Self { path: Path::new(""), raw: Raw::default(), colours, objects, materials, object, material, current: None, face: Vec::new() }
    }
}

impl Reader<'_> {
    fn line(&mut self, line: &str) -> std::result::Result<(), String> {
        let line = line.split('#').next().unwrap_or("").trim();
        let (key, rest) = line.split_once(char::is_whitespace).map_or((line, ""), |(key, rest)| (key, rest.trim()));
        match key {
            "v" => self.vertex(rest)?,
            "f" => self.face(rest)?,
            "o" | "g" => {
                self.object = if rest.is_empty() { "object".into() } else { rest.into() };
                self.current = None;
            }
            "usemtl" => {
                self.material = rest.into();
                self.current = None;
            }
            "mtllib" => self.library(rest),
            _ => {}
        }
        Ok(())
    }

    fn vertex(&mut self, text: &str) -> std::result::Result<(), String> {
        let mut v = Vec3::ZERO;
        let mut words = text.split_whitespace();
        for k in 0..3 {
            let word = words.next().ok_or_else(|| format!("vertex '{text}' has {k} coordinates, expected 3"))?;
            v[k] = word.parse().ok().filter(|x: &f32| x.is_finite()).ok_or_else(|| format!("coordinate '{word}' is no finite number"))?;
        }
        self.raw.mesh.vertices.push(v);
        Ok(())
    }

    fn face(&mut self, text: &str) -> std::result::Result<(), String> {
        let count = self.raw.mesh.vertices.len();
        self.face.clear();
        for corner in text.split_whitespace() {
            let word = corner.split('/').next().unwrap_or("");
            let index: i64 = word.parse().map_err(|_| format!("corner '{corner}' has no whole number of a vertex"))?;
            let from_zero = if index < 0 { count as i64 + index } else { index - 1 };
            if from_zero < 0 || from_zero >= count as i64 {
                return Err(format!("a face names vertex {index}, but {count} vertices come before it"));
            }
            self.face.push(from_zero as u32);
        }
        let &[first, ref others @ ..] = &self.face[..] else { return Err("a face without corners".into()) };
        if others.len() < 2 {
            self.raw.degenerate += 1;
            return Ok(());
        }
        // An object and a material become part of the mesh with their first face.
        let (object, material) = *self.current.get_or_insert_with(|| {
            let (mesh, name, colour) = (&mut self.raw.mesh, &self.material, self.colours.get(&self.material));
            let object = *self.objects.entry(self.object.clone()).or_insert_with(|| mesh.add_object(&self.object));
            let material = self.materials.entry(name.clone()).or_insert_with(|| mesh.add_material(name, colour.copied().unwrap_or(GREY)));
            (object, *material)
        });
        others.windows(2).try_for_each(|pair| self.raw.push([first, pair[0], pair[1]], object, material))
    }

    /// Reads the materials of a file beside this one. Without it everything is still there, but grey.
    fn library(&mut self, name: &str) {
        let path = self.path.parent().unwrap_or(Path::new("")).join(name.replace('\\', "/"));
        let Ok(bytes) = fs::read(&path) else {
            self.raw.warnings.push(format!("cannot read the materials {}: all that has them is grey", path.display()));
            return;
        };
        let mut material = String::new();
        for line in String::from_utf8_lossy(&bytes).lines() {
            let mut words = line.split_whitespace();
            let key = words.next().unwrap_or("");
            if key == "newmtl" {
                material = words.collect::<Vec<_>>().join(" ");
                self.colours.insert(material.clone(), GREY);
                continue;
            }
            let Some(colour) = self.colours.get_mut(&material) else { continue };
            let mut numbers = words.filter_map(|w| w.parse::<f32>().ok()).filter(|x| x.is_finite()).map(|x| x.clamp(0.0, 1.0));
            match (key, numbers.next(), numbers.next(), numbers.next()) {
                ("Kd", Some(r), Some(g), Some(b)) => colour[..3].copy_from_slice(&[r, g, b]),
                ("d", Some(opacity), ..) => colour[3] = opacity,
                ("Tr", Some(transparency), ..) => colour[3] = 1.0 - transparency,
                _ => {}
            }
        }
    }
}
