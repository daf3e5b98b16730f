//! The binary part of a glTF file, and the container that holds it.

use serde::Serialize;
use serde_json::Value;

/// What a view is used for, by the numbers of the format.
const VERTICES: u32 = 34962;
const INDICES: u32 = 34963;
/// Types of numbers, likewise.
const U8: u32 = 5121;
const U32: u32 = 5125;
const F32: u32 = 5126;

/// Numbers that are packed one after the other, with a view and an accessor for each array. All elements have a multiple of four
/// bytes, so everything is aligned.
#[derive(Default)]
pub(super) struct Buffer {
    bytes: Vec<u8>,
    views: Vec<View>,
    accessors: Vec<Accessor>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    byte_offset: usize,
    byte_length: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    target: Option<u32>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    kind: &'static str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    min: Vec<f32>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    max: Vec<f32>,
}

impl Buffer {
    /// Adds one row per vertex and returns the accessor's number, as all of these do.
    pub fn vertices<const N: usize>(&mut self, rows: &[[f32; N]]) -> usize {
        self.f32s(rows, Some(VERTICES))
    }

    /// Adds floats that belong to no vertex: times, keyframes, matrices.
    pub fn floats<const N: usize>(&mut self, rows: &[[f32; N]]) -> usize {
        self.f32s(rows, None)
    }

    /// Adds four small numbers per vertex.
    pub fn bytes(&mut self, rows: &[[u8; 4]]) -> usize {
        self.bytes.extend(rows.as_flattened());
        self.add(U8, rows.len(), "VEC4", 4, Some(VERTICES))
    }

    /// Adds the corners of triangles.
    pub fn indices(&mut self, corners: &[u32]) -> usize {
        self.bytes.extend(corners.iter().flat_map(|i| i.to_le_bytes()));
        self.add(U32, corners.len(), "SCALAR", 4, Some(INDICES))
    }

    fn f32s<const N: usize>(&mut self, rows: &[[f32; N]], target: Option<u32>) -> usize {
        self.bytes.extend(rows.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
        let kind = match N {
            1 => "SCALAR",
            16 => "MAT4",
            _ => ["VEC2", "VEC3", "VEC4"][N - 2],
        };
        let index = self.add(F32, rows.len(), kind, 4 * N, target);
        let bound = |pick: fn(f32, f32) -> f32| rows.iter().copied().reduce(|a, b| std::array::from_fn(|i| pick(a[i], b[i])));
        self.accessors[index].min = bound(f32::min).map_or_else(Vec::new, |v| v.to_vec());
        self.accessors[index].max = bound(f32::max).map_or_else(Vec::new, |v| v.to_vec());
        index
    }

    /// The accessor of the last `count` elements of `size` bytes.
    fn add(&mut self, component_type: u32, count: usize, kind: &'static str, size: usize, target: Option<u32>) -> usize {
        let byte_length = count * size;
        self.views.push(View { buffer: 0, byte_offset: self.bytes.len() - byte_length, byte_length, target });
        self.accessors.push(Accessor { buffer_view: self.views.len() - 1, component_type, count, kind, min: Vec::new(), max: Vec::new() });
        self.accessors.len() - 1
    }

    /// The whole file: `document` with what describes this buffer, then the buffer.
    pub fn pack(self, mut document: Value) -> Vec<u8> {
        document["buffers"] = serde_json::json!([{ "byteLength": self.bytes.len() }]);
        document["bufferViews"] = serde_json::json!(self.views);
        document["accessors"] = serde_json::json!(self.accessors);
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let total = 12 + 8 + text.len() + 8 + self.bytes.len();
        let mut file = Vec::with_capacity(total);
        file.extend(b"glTF");
        file.extend(2u32.to_le_bytes());
        file.extend((total as u32).to_le_bytes());
        for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &self.bytes)] {
            file.extend((chunk.len() as u32).to_le_bytes());
            file.extend(kind);
            file.extend(chunk);
        }
        file
    }
}
