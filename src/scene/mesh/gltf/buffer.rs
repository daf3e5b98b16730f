//! The numbers of a glTF: buffers, the views into them and the accessors that give them types.

use crate::{Error, Result};
use serde::Deserialize;
use std::borrow::Cow;
use std::fs;
use std::path::Path;

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Buffer {
    uri: Option<String>,
    byte_length: usize,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct BufferView {
    buffer: usize,
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Accessor {
    buffer_view: Option<usize>,
    byte_offset: usize,
    component_type: u32,
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    shape: String,
    sparse: Option<serde_json::Value>,
}

/// All buffers: the binary part, files beside `path`, or base64 within the document.
pub(super) fn load<'a>(path: &Path, buffers: &[Buffer], binary: Option<&'a [u8]>) -> Result<Vec<Cow<'a, [u8]>>> {
    let one = |(i, buffer): (usize, &Buffer)| {
        let error = |what: String| Error::file(path, format!("buffer {i} {what}"));
        let data = match buffer.uri.as_deref() {
            None => Cow::Borrowed(binary.ok_or_else(|| error("has no uri, and the file no binary part".into()))?),
            Some(uri) if uri.starts_with("data:") => {
                let text = uri.split_once(";base64,").ok_or_else(|| error("is no base64".into()))?.1;
                Cow::Owned(base64(text).ok_or_else(|| error("is no base64".into()))?)
            }
            Some(uri) if uri.contains("://") => return Err(error(format!("lies at {uri}; only files on disk are read"))),
            Some(uri) => {
                let name = percent(uri).ok_or_else(|| error(format!("has the name '{uri}', which is no uri")))?;
                let file = path.parent().unwrap_or(Path::new("")).join(name);
                Cow::Owned(fs::read(&file).map_err(|e| Error::io(file, e))?)
            }
        };
        if data.len() < buffer.byte_length {
            return Err(error(format!("has {} bytes, expected {}", data.len(), buffer.byte_length)));
        }
        Ok(data)
    };
    buffers.iter().enumerate().map(one).collect()
}

/// Typed elements of a buffer, checked to lie within it.
pub(super) struct View<'a> {
    data: &'a [u8],
    stride: usize,
    component: u32,
    normalized: bool,
    pub count: usize,
}

impl Accessor {
    /// The elements, which must be of type `shape`. The error says what does not fit.
    pub fn view<'a>(&self, shape: &str, views: &[BufferView], buffers: &'a [Cow<'a, [u8]>]) -> std::result::Result<View<'a>, String> {
        if self.sparse.is_some() {
            return Err("is sparse, which is not read".into());
        }
        if self.shape != shape {
            return Err(format!("has type {}, expected {shape}", self.shape));
        }
        let number = self.buffer_view.ok_or("has no buffer view")?;
        let view = views.get(number).ok_or_else(|| format!("names buffer view {number}, but there are {}", views.len()))?;
        let buffer = buffers.get(view.buffer).ok_or_else(|| format!("needs buffer {}, but there are {}", view.buffer, buffers.len()))?;
        let bytes = size(self.component_type).filter(|_| shape == "VEC3" || [5121, 5123, 5125].contains(&self.component_type));
        let bytes = bytes.ok_or_else(|| format!("has component type {}, which does not fit {shape}", self.component_type))?;
        let element = bytes * if shape == "VEC3" { 3 } else { 1 };
        let stride = view.byte_stride.unwrap_or(element).max(element);
        let outside = || format!("reaches beyond its buffer of {} bytes", buffer.len());
        let data = buffer.get(view.byte_offset..).and_then(|rest| rest.get(..view.byte_length)).ok_or_else(outside)?;
        let data = data.get(self.byte_offset..).ok_or_else(outside)?;
        let end = self.count.checked_sub(1).map_or(Some(0), |last| last.checked_mul(stride)?.checked_add(element));
        if end.is_none_or(|end| end > data.len()) {
            return Err(outside());
        }
        Ok(View { data, stride, component: self.component_type, normalized: self.normalized, count: self.count })
    }
}

impl View<'_> {
    /// Component `axis` of element `i`, which must be below the count.
    pub fn number(&self, i: usize, axis: usize) -> f64 {
        let width = size(self.component).unwrap_or(1);
        let b = &self.data[i * self.stride + axis * width..][..width];
        let (value, most) = match self.component {
            5120 => (f64::from(b[0] as i8), 127.0),
            5121 => (f64::from(b[0]), 255.0),
            5122 => (f64::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            5123 => (f64::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            5125 => (f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
            _ => (f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
        };
        if self.normalized { (value / most).max(-1.0) } else { value }
    }
}

/// Bytes of a component type: signed and unsigned bytes and shorts, unsigned words, floats.
fn size(component: u32) -> Option<usize> {
    match component {
        5120 | 5121 => Some(1),
        5122 | 5123 => Some(2),
        5125 | 5126 => Some(4),
        _ => None,
    }
}

fn base64(text: &str) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut held) = (0u32, 0);
    for c in text.bytes().filter(|&c| c != b'=') {
        let value = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => return None,
        };
        bits = (bits << 6) | u32::from(value);
        held += 6;
        if held >= 8 {
            held -= 8;
            out.push((bits >> held) as u8);
        }
    }
    Some(out)
}

/// A file name in which `%20` stands for a space, and so on.
fn percent(uri: &str) -> Option<String> {
    let mut bytes = uri.bytes();
    let mut out = Vec::new();
    while let Some(b) = bytes.next() {
        let digit = |b: Option<u8>| char::from(b?).to_digit(16);
        out.push(if b == b'%' { (16 * digit(bytes.next())? + digit(bytes.next())?) as u8 } else { b });
    }
    String::from_utf8(out).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_by_hand() {
        // RFC 4648, section 10.
        for (text, want) in [("", ""), ("Zg==", "f"), ("Zm8=", "fo"), ("Zm9v", "foo"), ("Zm9vYmFy", "foobar")] {
            assert_eq!(base64(text).unwrap(), want.as_bytes());
        }
        assert_eq!((base64("Z*=="), percent("a%20b%2Fc.bin").as_deref(), percent("a%2")), (None, Some("a b/c.bin"), None));
    }
}
