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

/// The name beside the folder `dir` that a folder has while it is written (`tmp`), or while another takes its place (`old.tmp`).
fn beside(dir: &Path, suffix: &str) -> Result<PathBuf> {
    let name = dir.file_name().ok_or_else(|| Error::file(dir, "is not a folder's name"))?.to_string_lossy();
    Ok(dir.with_file_name(format!(".{name}.{suffix}")))
}

/// Removes a folder with all that it holds, if it is there.
pub fn clear_folder(dir: &Path) -> Result<()> {
    match fs::remove_dir_all(dir) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(dir, e)),
        _ => Ok(()),
    }
}

/// Removes the folder `dir` in one step, if it is there, so that a kill leaves it whole or not at all.
pub fn discard_folder(dir: &Path) -> Result<()> {
    let aside = beside(dir, "old.tmp")?;
    clear_folder(&aside)?;
    match fs::rename(dir, &aside) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(Error::io(dir, e)),
        Ok(()) => clear_folder(&aside),
    }
}

/// Puts a new folder with what `fill` writes into it in the place of `dir`. Where that fails `dir` is as it was, and nothing else is left;
/// after a kill it is as it was, new, or, between two renames, where [`kept_folder`] finds it.
pub fn replace_folder<E: From<Error>>(dir: &Path, fill: impl FnOnce(&Path) -> std::result::Result<(), E>) -> std::result::Result<(), E> {
    let (fresh, old) = (beside(dir, "tmp")?, beside(dir, "old.tmp")?);
    if kept_folder(dir)? == old {
        fs::rename(&old, dir).map_err(|e| Error::io(&old, e))?;
    }
    clear_folder(&fresh)?;
    clear_folder(&old)?;
    let swap = || -> Result<()> {
        let kept = dir.exists();
        if kept {
            fs::rename(dir, &old).map_err(|e| Error::io(dir, e))?;
        }
        fs::rename(&fresh, dir).map_err(|e| {
            if kept {
                let _ = fs::rename(&old, dir);
            }
            Error::io(dir, e)
        })?;
        sync_folder(dir.parent().unwrap_or(Path::new(""))).map_err(|e| Error::io(dir, e))
    };
    fill(&fresh).and_then(|()| Ok(swap()?)).inspect_err(|_| drop(fs::remove_dir_all(&fresh)))?;
    Ok(clear_folder(&old)?)
}

/// Where the content of the folder `dir` is: there, or under another name where a kill interrupted [`replace_folder`].
pub fn kept_folder(dir: &Path) -> Result<PathBuf> {
    if dir.exists() {
        return Ok(dir.to_path_buf());
    }
    let old = beside(dir, "old.tmp")?;
    Ok(if old.exists() { old } else { dir.to_path_buf() })
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
    pack_tensors_each(tensors, metadata, |_| precision)
}

/// [`pack_tensors`] with a precision for each name.
pub(crate) fn pack_tensors_each(
    tensors: &[(String, Vec<usize>, Vec<f32>)],
    metadata: &BTreeMap<String, String>,
    precision: impl Fn(&str) -> Precision,
) -> Result<Vec<u8>> {
    let pack = |name: &str, data: &[f32]| match precision(name) {
        Precision::Full => (Dtype::F32, data.iter().flat_map(|v| v.to_le_bytes()).collect()),
        Precision::Half => (Dtype::F16, data.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect()),
    };
    let raw = tensors.iter().map(|(name, shape, data)| {
        let (dtype, bytes) = pack(name, data);
        (name.as_str(), dtype, shape.clone(), bytes)
    });
    pack_raw(&Vec::from_iter(raw), metadata)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Names in a folder, sorted.
    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn writes(text: &'static str) -> impl Fn(&Path) -> Result<()> {
        move |dir| write_atomic(dir.join("a.txt"), text.as_bytes())
    }

    #[test]
    fn folders_are_replaced_as_a_whole_or_not_at_all() {
        let root = tempfile::tempdir().unwrap();
        let dir = root.path().join("one");
        let content = || fs::read_to_string(dir.join("a.txt")).unwrap();
        replace_folder(&dir, writes("first")).unwrap();
        fs::write(dir.join("b.txt"), "of the first").unwrap();
        replace_folder(&dir, writes("second")).unwrap();
        assert_eq!((content().as_str(), names(&dir), names(root.path())), ("second", vec!["a.txt".into()], vec!["one".into()]));
        // The content cannot be written, or the new folder is gone when it is to be renamed.
        let broken = |path: &Path| writes("third")(path).and(Err(Error::invalid("no more")));
        assert!(replace_folder(&dir, broken).unwrap_err().to_string().contains("no more"));
        assert_eq!((content().as_str(), names(root.path())), ("second", vec!["one".into()]));
        assert!(replace_folder(&dir, |path| writes("third")(path).and_then(|()| clear_folder(path))).is_err());
        assert_eq!((content().as_str(), names(root.path())), ("second", vec!["one".into()]));
    }

    #[test]
    fn what_a_kill_leaves_is_found_and_put_back() {
        let root = tempfile::tempdir().unwrap();
        let (dir, old) = (root.path().join("one"), root.path().join(".one.old.tmp"));
        assert_eq!((kept_folder(&dir).unwrap(), kept_folder(Path::new(".")).unwrap()), (dir.clone(), ".".into()));
        writes("first")(&old).unwrap();
        writes("half")(&root.path().join(".one.tmp")).unwrap();
        assert_eq!(kept_folder(&dir).unwrap(), old);
        // What fails before anything is renamed leaves the old content in its place.
        replace_folder(&dir, |_| Err(Error::invalid("no more"))).unwrap_err();
        assert_eq!((names(root.path()), fs::read_to_string(dir.join("a.txt")).unwrap()), (vec!["one".into()], "first".into()));
        // A kill after both renames leaves what is old beside what is new.
        writes("older")(&old).unwrap();
        assert_eq!(kept_folder(&dir).unwrap(), dir);
        replace_folder(&dir, writes("second")).unwrap();
        assert_eq!(names(root.path()), ["one"]);
        discard_folder(&dir).unwrap();
        discard_folder(&dir).unwrap();
        assert!(names(root.path()).is_empty());
    }
}
