//! Stanford PLY: text and both byte orders, faces as lists of any number of corners; also what navigation meshes come in.

use super::import::{GREY, Raw};
use crate::{Error, Result};
use glam::Vec3;
use std::path::Path;

/// Reads a PLY; the whole of it is one object. Properties other than `x`, `y`, `z` and the faces' `vertex_indices` are left out.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Raw> {
    let error = |what: String| Error::file(path, what);
    let (elements, mut body) = header(bytes).map_err(error)?;
    let mut raw = Raw::default();
    let name = path.file_stem().map_or_else(|| "object".into(), |n| n.to_string_lossy());
    raw.mesh.add_object(&name);
    raw.mesh.add_material("default", GREY);
    for element in elements.iter().filter(|e| !e.properties.is_empty()) {
        for i in 0..element.count {
            element.read(&mut body, &mut raw).map_err(|what| error(format!("{} {i}: {what}", element.name)))?;
        }
    }
    Ok(raw)
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }
}

/// What is done with a property.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Role {
    Coordinate(usize),
    Corners,
    Skipped,
}

#[derive(Debug)]
struct Property {
    role: Role,
    /// Of a list: the type of its length.
    length: Option<Kind>,
    kind: Kind,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

impl Element {
    /// Reads one of these: a vertex, a face, or something else that is passed over.
    fn read(&self, body: &mut Body, raw: &mut Raw) -> std::result::Result<(), String> {
        let mut vertex = Vec3::ZERO;
        for property in &self.properties {
            let Some(length) = property.length else {
                let value = body.next(property.kind)?;
                if let Role::Coordinate(axis) = property.role {
                    vertex[axis] = value as f32;
                }
                continue;
            };
            let length = whole(body.next(length)?, "a list of length")?;
            let (mut first, mut last) = (0, 0);
            for corner in 0..length {
                let value = body.next(property.kind)?;
                if property.role != Role::Corners {
                    continue;
                }
                let index = whole(value, "names vertex")?;
                match corner {
                    0 => first = index,
                    1 => {}
                    _ => raw.push([first, last, index], 0, 0)?,
                }
                last = index;
            }
        }
        if self.name == "vertex" {
            if !vertex.is_finite() {
                return Err(format!("is {vertex}, expected finite numbers"));
            }
            raw.mesh.vertices.push(vertex);
        }
        Ok(())
    }
}

fn whole(value: f64, what: &str) -> std::result::Result<u32, String> {
    if value < 0.0 || value > f64::from(u32::MAX) || value.fract() != 0.0 {
        return Err(format!("{what} {value}, expected a whole number from 0"));
    }
    Ok(value as u32)
}

/// The values after the header.
enum Body<'a> {
    Ascii(std::str::SplitAsciiWhitespace<'a>),
    Binary { data: &'a [u8], big: bool },
}

impl Body<'_> {
    fn next(&mut self, kind: Kind) -> std::result::Result<f64, String> {
        let cut = || "the file ends within it".to_string();
        match self {
            Self::Ascii(words) => {
                let word = words.next().ok_or_else(cut)?;
                word.parse().map_err(|_| format!("has '{word}', expected a number"))
            }
            Self::Binary { data, big } => match kind {
                Kind::I8 => take(data, *big, i8::from_le_bytes),
                Kind::U8 => take(data, *big, u8::from_le_bytes),
                Kind::I16 => take(data, *big, i16::from_le_bytes),
                Kind::U16 => take(data, *big, u16::from_le_bytes),
                Kind::I32 => take(data, *big, i32::from_le_bytes),
                Kind::U32 => take(data, *big, u32::from_le_bytes),
                Kind::F32 => take(data, *big, f32::from_le_bytes),
                Kind::F64 => take(data, *big, f64::from_le_bytes),
            }
            .ok_or_else(cut),
        }
    }
}

/// Takes a number from the front of `data`.
fn take<const N: usize, T: Into<f64>>(data: &mut &[u8], big: bool, decode: impl Fn([u8; N]) -> T) -> Option<f64> {
    let (&bytes, rest) = data.split_first_chunk::<N>()?;
    *data = rest;
    let mut le = bytes;
    if big {
        le.reverse();
    }
    Some(decode(le).into())
}

/// The elements that a file declares, and its values.
fn header(bytes: &[u8]) -> std::result::Result<(Vec<Element>, Body<'_>), String> {
    if !bytes.starts_with(b"ply") {
        return Err("is no PLY file: it does not begin with 'ply'".into());
    }
    let (mut rest, mut elements, mut format) = (bytes, Vec::<Element>::new(), None);
    loop {
        let end = rest.iter().position(|&b| b == b'\n').ok_or("has no 'end_header'")?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| "has a header that is no text")?.trim();
        rest = &rest[end + 1..];
        match line.split_ascii_whitespace().collect::<Vec<_>>()[..] {
            ["end_header"] => break,
            ["format", name, _] => format = Some(name),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("declares '{count}' of element {name}, expected a whole number"))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", ref words @ ..] => {
                let element = elements.last_mut().ok_or("declares a property before any element")?;
                let property = property(&element.name, words).ok_or_else(|| format!("has a property that is not known: '{line}'"))?;
                element.properties.push(property);
            }
            _ => {}
        }
    }
    let text = |rest| std::str::from_utf8(rest).map_err(|_| "says that it is text, but is not");
    let body = match format {
        Some("ascii") => Body::Ascii(text(rest)?.split_ascii_whitespace()),
        Some("binary_little_endian") => Body::Binary { data: rest, big: false },
        Some("binary_big_endian") => Body::Binary { data: rest, big: true },
        other => return Err(format!("has format '{}', expected ascii, binary_little_endian or binary_big_endian", other.unwrap_or(""))),
    };
    for axis in 0..3 {
        if !elements.iter().flat_map(|e| &e.properties).any(|p| p.role == Role::Coordinate(axis)) {
            return Err(format!("has no coordinate {} of vertices", ["x", "y", "z"][axis]));
        }
    }
    Ok((elements, body))
}

fn property(element: &str, words: &[&str]) -> Option<Property> {
    let (length, kind, name) = match *words {
        ["list", length, kind, name] => (Some(Kind::parse(length)?), kind, name),
        [kind, name] => (None, kind, name),
        _ => return None,
    };
    let role = match (element, name, length) {
        ("vertex", "x", None) => Role::Coordinate(0),
        ("vertex", "y", None) => Role::Coordinate(1),
        ("vertex", "z", None) => Role::Coordinate(2),
        ("face", "vertex_indices" | "vertex_index", Some(_)) => Role::Corners,
        _ => Role::Skipped,
    };
    Some(Property { role, length, kind: Kind::parse(kind)? })
}
