//! Files: atomic writes, content hashes and checked reading of safetensors.

pub(crate) mod numpy;
pub(crate) mod pickle;
pub(crate) mod zip;

use crate::{Error, Result};
use half::f16;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writes `bytes` to `path` so that a reader sees the old file or the whole new one, never a part.
///
/// The data goes to a temporary file beside `path`, is synced, and is renamed over it.
pub fn write_atomic(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let path = path.as_ref();
    if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        fs::create_dir_all(parent).map_err(|e| Error::io(parent, e))?;
    }
    let mut name = path.file_name().ok_or_else(|| Error::file(path, "is not a file name"))?.to_os_string();
    name.push(format!(".tmp{}", std::process::id()));
    let tmp = path.with_file_name(name);
    let put = || -> std::io::Result<()> {
        let mut file = fs::File::create(&tmp)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&tmp, path)?;
        sync_folder(path.parent().unwrap_or(Path::new("")))
    };
    put().map_err(|e| {
        let _ = fs::remove_file(&tmp);
        Error::io(path, e)
    })
}

/// Makes renames within `dir` outlive a loss of power, where the system can open folders.
pub fn sync_folder(dir: &Path) -> std::io::Result<()> {
    if !cfg!(unix) {
        return Ok(());
    }
    let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
    fs::File::open(dir)?.sync_all()
}

/// SHA-256 of `bytes` in lower-case hexadecimal; how derived files name what they come from.
pub fn content_hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// A named set of tensors read from safetensors, with checked access. Half-precision floats are widened.
pub struct Tensors {
    origin: PathBuf,
    bytes: Vec<u8>,
}

impl Tensors {
    /// Reads the file `path`.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::from_bytes(path, fs::read(path).map_err(|e| Error::io(path, e))?)
    }

    /// Takes the content of a file (or of an embedded asset); `origin` names it in errors.
    pub fn from_bytes(origin: impl AsRef<Path>, bytes: Vec<u8>) -> Result<Self> {
        let origin = origin.as_ref().to_path_buf();
        SafeTensors::deserialize(&bytes).map_err(|e| Error::file(&origin, format!("not a whole safetensors file: {e}")))?;
        Ok(Self { origin, bytes })
    }

    /// The name used in errors.
    pub fn origin(&self) -> &Path {
        &self.origin
    }

    /// SHA-256 of the file's content.
    pub fn hash(&self) -> String {
        content_hash(&self.bytes)
    }

    /// The metadata that [`pack_tensors`] wrote (empty when there is none).
    pub fn metadata(&self) -> BTreeMap<String, String> {
        SafeTensors::read_metadata(&self.bytes)
            .ok()
            .and_then(|(_, m)| m.metadata().clone())
            .and_then(|m| serde_json::from_str(m.get("egogen")?).ok())
            .unwrap_or_default()
    }

    /// Names of all tensors, sorted.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<_> = self.view().map(|v| v.names().iter().map(|s| s.to_string()).collect()).unwrap_or_default();
        names.sort();
        names
    }

    /// The shape of tensor `name`.
    pub fn shape(&self, name: &str) -> Result<Vec<usize>> {
        Ok(self.tensor(name)?.shape().to_vec())
    }

    /// Floats of tensor `name`, row-major; 0 in `shape` matches any size. Non-finite values are refused.
    pub fn f32s(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let t = self.checked(name, shape)?;
        let data = t.data();
        let out: Vec<f32> = match t.dtype() {
            Dtype::F32 => data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
            Dtype::F16 => data.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
            other => return Err(self.bad(name, format!("has type {other:?}, expected F32 or F16"))),
        };
        if let Some(i) = out.iter().position(|v| !v.is_finite()) {
            return Err(self.bad(name, format!("entry {i} is {}", out[i])));
        }
        Ok(out)
    }

    /// Whole numbers of tensor `name` (I32, U16 or U8), row-major; 0 in `shape` matches any size.
    pub fn ints(&self, name: &str, shape: &[usize]) -> Result<Vec<i32>> {
        let t = self.checked(name, shape)?;
        let data = t.data();
        Ok(match t.dtype() {
            Dtype::I32 => data.chunks_exact(4).map(|b| i32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
            Dtype::U16 => data.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]]) as i32).collect(),
            Dtype::U8 => data.iter().map(|&b| b as i32).collect(),
            other => return Err(self.bad(name, format!("has type {other:?}, expected I32, U16 or U8"))),
        })
    }

    /// Like [`Tensors::ints`] for indices, each checked to lie in `0..limit`.
    pub fn indices(&self, name: &str, shape: &[usize], limit: usize) -> Result<Vec<usize>> {
        let v = self.ints(name, shape)?;
        if let Some(i) = v.iter().position(|&x| x < 0 || x as usize >= limit) {
            return Err(self.bad(name, format!("entry {i} is {}, expected 0 to {}", v[i], limit - 1)));
        }
        Ok(v.into_iter().map(|x| x as usize).collect())
    }

    fn view(&self) -> Result<SafeTensors<'_>> {
        SafeTensors::deserialize(&self.bytes).map_err(|e| Error::file(&self.origin, e.to_string()))
    }

    fn tensor(&self, name: &str) -> Result<TensorView<'_>> {
        self.view()?.tensor(name).map_err(|_| self.bad(name, "is missing"))
    }

    fn checked(&self, name: &str, shape: &[usize]) -> Result<TensorView<'_>> {
        let t = self.tensor(name)?;
        let fits = t.shape().len() == shape.len() && t.shape().iter().zip(shape).all(|(&a, &b)| b == 0 || a == b);
        if !fits {
            let want: Vec<String> = shape.iter().map(|&s| if s == 0 { "any".into() } else { s.to_string() }).collect();
            return Err(self.bad(name, format!("has shape {:?}, expected [{}]", t.shape(), want.join(", "))));
        }
        Ok(t)
    }

    fn bad(&self, name: &str, what: impl std::fmt::Display) -> Error {
        Error::file(&self.origin, format!("tensor '{name}' {what}"))
    }
}

/// Float precision of written tensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 32-bit floats.
    Full,
    /// 16-bit floats; for shipped weights.
    Half,
}

/// Packs named float tensors (name, shape, row-major data) and metadata into safetensors bytes.
pub fn pack_tensors(
    tensors: &[(String, Vec<usize>, Vec<f32>)],
    metadata: &BTreeMap<String, String>,
    precision: Precision,
) -> Result<Vec<u8>> {
    let bytes = |data: &[f32]| match precision {
        Precision::Full => data.iter().flat_map(|v| v.to_le_bytes()).collect(),
        Precision::Half => data.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect(),
    };
    let dtype = if precision == Precision::Full { Dtype::F32 } else { Dtype::F16 };
    let raw: Vec<RawTensor> = tensors.iter().map(|(name, shape, data)| (name.as_str(), dtype, shape.clone(), bytes(data))).collect();
    pack_raw(&raw, metadata)
}

/// Name, type, shape and little-endian elements of a tensor.
pub(crate) type RawTensor<'a> = (&'a str, Dtype, Vec<usize>, Vec<u8>);

/// Packs tensors of any type and metadata into safetensors bytes.
pub(crate) fn pack_raw(tensors: &[RawTensor], metadata: &BTreeMap<String, String>) -> Result<Vec<u8>> {
    let mut views = BTreeMap::new();
    for (name, dtype, shape, bytes) in tensors {
        let view = TensorView::new(*dtype, shape.clone(), bytes)
            .map_err(|e| Error::invalid(format!("tensor '{name}' of shape {shape:?}: {e}")))?;
        views.insert(name.to_string(), view);
    }
    // The header's map is written in one order only when it holds one entry, so all metadata travels as one JSON text.
    let info = (!metadata.is_empty()).then(|| [("egogen".to_string(), serde_json::json!(metadata).to_string())].into_iter().collect());
    safetensors::serialize(views, info).map_err(|e| Error::invalid(format!("cannot pack tensors: {e}")))
}
