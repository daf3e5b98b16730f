//! Checkpoints that PyTorch wrote (`torch.save`).
//!
//! A checkpoint is a pickle, and a pickle is a program; it is taken as data by [`crate::io::pickle`], which runs nothing. Two containers
//! are read: the archive that PyTorch has written since 1.6 (`data.pkl`, and one entry `data/N` for each storage) and the stream before
//! that (five pickles, then the storages one behind the other). What a tensor claims is checked against its storage before memory is taken.

use crate::io::pickle::{Element, Pickle, TensorView};
use crate::io::zip::Archive;
use crate::io::{Precision, Tensors, pack_tensors};
use crate::{Error, Result};
use half::{bf16, f16};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::Path;

/// Extensions of PyTorch's files.
const EXTENSIONS: [&str; 4] = ["pt", "pth", "ckpt", "ckp"];
/// Dictionaries in which training programs keep the weights beside other things.
const INNER: [&str; 3] = ["model_state_dict.", "state_dict.", "model."];
/// Most floats that all wanted tensors together may have: a view can claim more than its storage holds.
const MAX_FLOATS: usize = 1 << 26;
/// How a stream begins: pickles of its magic number and of its version, 1001.
const STREAM: &[u8] = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\x02M\xe9\x03.";

/// Whether `path` is named like a checkpoint of PyTorch (`.pt`, `.pth`, `.ckpt`, `.ckp`).
pub fn is_checkpoint(path: &Path) -> bool {
    path.extension().and_then(|e| e.to_str()).is_some_and(|e| EXTENSIONS.contains(&e))
}

/// The floats of the checkpoint `path` whose names satisfy `wanted`.
///
/// A name is the keys of the dictionaries it lies in, joined by dots. Where the file keeps its weights in a dictionary `model_state_dict`,
/// `state_dict` or `model`, names are those within it and everything else (optimiser, counters, settings) is left out. Tensors of whole
/// numbers are left out too.
///
/// # Errors
/// A file that is damaged, no checkpoint, or without a wanted tensor; the message names the file and the tensor or what it holds.
pub fn read(path: impl AsRef<Path>, wanted: impl Fn(&str) -> bool) -> Result<Tensors> {
    let path = path.as_ref();
    parse(path, &fs::read(path).map_err(|e| Error::io(path, e))?, wanted)
}

/// [`read`] of the content of a file; `path` names it in errors.
pub(crate) fn parse(path: &Path, bytes: &[u8], wanted: impl Fn(&str) -> bool) -> Result<Tensors> {
    if bytes.starts_with(STREAM) {
        return parse_stream(path, bytes, wanted);
    }
    let bad = |what: String| Error::file(path, what);
    let archive = Archive::new(bytes).map_err(|e| bad(format!("is no checkpoint of PyTorch, neither archive nor stream: {e}")))?;
    let root = archive.names().find_map(|n| n.strip_suffix("data.pkl").map(String::from));
    let root = root.ok_or_else(|| bad("is an archive without data.pkl, so no checkpoint of PyTorch".into()))?;
    let entry = |name: String| archive.read(&name).map_err(|e| bad(format!("entry '{name}' {e}")));
    if archive.names().any(|n| n == format!("{root}byteorder")) && entry(format!("{root}byteorder"))? != b"little" {
        return Err(bad("was written on a big-endian machine, which is not read".into()));
    }
    let pickle = entry(format!("{root}data.pkl"))?;
    let tensors = Pickle::parse_torch(path, &pickle)?.0.tensors()?;
    collect(path, tensors, wanted, |name| entry(format!("{root}data/{name}")).map(Cow::Owned))
}

fn parse_stream(path: &Path, bytes: &[u8], wanted: impl Fn(&str) -> bool) -> Result<Tensors> {
    let (_, end) = Pickle::parse_torch(path, &bytes[STREAM.len()..])?;
    let rest = &bytes[STREAM.len() + end..];
    let (pickle, end) = Pickle::parse_torch(path, rest)?;
    let (names, length) = Pickle::parse_texts(path, &rest[end..])?;
    let (elements, mut rest) = (pickle.storages(), &rest[end + length..]);
    let mut storages = HashMap::new();
    for name in names {
        let bad = |what: &str| Error::file(path, format!("storage '{name}' {what}"));
        let element = elements.get(name).ok_or_else(|| bad("belongs to no tensor"))?;
        let (count, data) = rest.split_first_chunk::<8>().ok_or_else(|| bad("is missing"))?;
        let size = usize::try_from(i64::from_le_bytes(*count)).ok().and_then(|n| n.checked_mul(element.bytes()));
        let (data, after) = size.and_then(|n| data.split_at_checked(n)).ok_or_else(|| bad("is cut off"))?;
        storages.insert(name, data);
        rest = after;
    }
    let storage = |name: &str| storages.get(name).map(|&data| Cow::Borrowed(data));
    collect(path, pickle.tensors()?, wanted, |name| storage(name).ok_or_else(|| Error::file(path, format!("has no storage '{name}'"))))
}

/// The wanted ones of `tensors`, whose storages `storage` gives.
fn collect<'s>(
    path: &Path,
    tensors: Vec<(String, TensorView)>,
    wanted: impl Fn(&str) -> bool,
    storage: impl Fn(&str) -> Result<Cow<'s, [u8]>>,
) -> Result<Tensors> {
    let bad = |what: String| Error::file(path, what);
    let inner = INNER.iter().copied().find(|p| tensors.iter().any(|(name, _)| name.starts_with(p))).unwrap_or("");
    let named = |name: &str| name.strip_prefix(inner).filter(|n| wanted(n)).map(String::from);
    let found = tensors.iter().filter(|(_, view)| !matches!(view.element, Element::Whole(_)));
    let found: BTreeMap<String, &TensorView> = found.filter_map(|(name, view)| Some((named(name)?, view))).collect();
    if found.is_empty() {
        return Err(bad(format!("holds none of the tensors looked for; it has: {}", some(&tensors))));
    }
    let count = |view: &TensorView| view.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
    let all = found.values().try_fold(0usize, |sum, view| sum.checked_add(count(view)?));
    if all.is_none_or(|n| n > MAX_FLOATS) {
        return Err(bad(format!("its tensors claim more than {MAX_FLOATS} numbers together")));
    }
    let mut data = Vec::with_capacity(found.len());
    for (name, view) in found {
        let floats = gather(view, &storage(view.storage)?).map_err(|e| bad(format!("tensor '{name}' {e}")))?;
        data.push((name, view.shape.clone(), floats));
    }
    Tensors::from_bytes(path, pack_tensors(&data, &BTreeMap::new(), Precision::Full)?)
}

/// A few names, sorted.
fn some(tensors: &[(String, TensorView)]) -> String {
    let mut names: Vec<&str> = tensors.iter().map(|(name, _)| name.as_str()).collect();
    names.sort_unstable();
    let more = if names.len() > 12 { ", ..." } else { "" };
    names.truncate(12);
    if names.is_empty() { "no tensor".into() } else { names.join(", ") + more }
}

/// The elements of a view, row-major.
fn gather(view: &TensorView, storage: &[u8]) -> std::result::Result<Vec<f32>, String> {
    let count: usize = view.shape.iter().product();
    let farthest = view
        .shape
        .iter()
        .zip(&view.strides)
        .try_fold(view.offset, |at, (&d, &stride)| d.saturating_sub(1).checked_mul(stride).and_then(|way| at.checked_add(way)));
    let width = view.element.bytes();
    if count > 0 && farthest.is_none_or(|at| at >= storage.len() / width) {
        return Err(format!("reaches beyond its storage '{}' of {} bytes", view.storage, storage.len()));
    }
    let mut index = vec![0; view.shape.len()];
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let at = index.iter().zip(&view.strides).fold(view.offset, |at, (i, stride)| at + i * stride);
        out.push(float(view.element, &storage[at * width..(at + 1) * width]));
        for axis in (0..index.len()).rev() {
            index[axis] += 1;
            if index[axis] < view.shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    Ok(out)
}

fn float(element: Element, bytes: &[u8]) -> f32 {
    let mut le = [0; 8];
    le[..bytes.len()].copy_from_slice(bytes);
    let bits = u64::from_le_bytes(le);
    match element {
        Element::F64 => f64::from_bits(bits) as f32,
        Element::F32 => f32::from_bits(bits as u32),
        Element::F16 => f16::from_bits(bits as u16).to_f32(),
        Element::BF16 => bf16::from_bits(bits as u16).to_f32(),
        Element::Whole(_) => bits as f32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::zip::pack;

    fn view(element: Element, offset: usize, shape: &[usize], strides: &[usize]) -> TensorView<'static> {
        TensorView { element, storage: "0", offset, shape: shape.into(), strides: strides.into() }
    }

    #[test]
    fn views_by_hand() {
        let bytes: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
        // Transposed, and with an offset.
        assert_eq!(gather(&view(Element::F32, 0, &[3, 2], &[1, 3]), &bytes).unwrap(), [0.0, 3.0, 1.0, 4.0, 2.0, 5.0]);
        assert_eq!(gather(&view(Element::F32, 4, &[2], &[1]), &bytes).unwrap(), [4.0, 5.0]);
        assert_eq!(gather(&view(Element::F32, 5, &[], &[]), &bytes).unwrap(), [5.0]);
        assert!(gather(&view(Element::F32, 5, &[2], &[1]), &bytes).unwrap_err().contains("beyond its storage '0' of 24 bytes"));
        assert!(gather(&view(Element::F32, 0, &[2, 2], &[usize::MAX, 2]), &bytes).is_err());
        assert!(gather(&view(Element::F32, 9, &[0, 4], &[4, 1]), &bytes).unwrap().is_empty());
        let one = |element, bytes: &[u8]| gather(&view(element, 0, &[1], &[1]), bytes).unwrap();
        assert_eq!(one(Element::F64, &1.5f64.to_le_bytes()), [1.5]);
        assert_eq!(one(Element::F16, &[0x00, 0x3e]), [1.5]);
        assert_eq!(one(Element::BF16, &[0xc0, 0x3f]), [1.5]);
    }

    /// {"w": tensor of two floats, "n": tensor of a whole number, "x": object of some class}
    fn pickle(dtype: &str, class: &str) -> Vec<u8> {
        let tensor = |class: &str, key: &str, count: u8| {
            let mut out = b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storage".to_vec();
            out.extend(format!("ctorch\n{class}\n").bytes().chain(*b"X\x01\0\0\0").chain(key.bytes()));
            out.extend(b"X\x03\0\0\0cpuK".iter().chain(&[count]).chain(b"tQK\0K").chain(&[count]).chain(b"\x85K\x01\x85\x89NtR"));
            out
        };
        let mut out = b"\x80\x02}(X\x01\0\0\0w".to_vec();
        out.extend(tensor(dtype, "0", 2));
        out.extend(b"X\x01\0\0\0n");
        out.extend(tensor("LongStorage", "1", 1));
        out.extend(b"X\x01\0\0\0x".iter().copied().chain(format!("c{class}\n)R}}b").bytes()).chain(*b"u."));
        out
    }

    fn archive(pickle: Vec<u8>, floats: &[f32]) -> Vec<u8> {
        let data = floats.iter().flat_map(|v| v.to_le_bytes()).collect();
        pack(&[("a/data.pkl".into(), pickle), ("a/data/0".into(), data), ("a/data/1".into(), vec![0; 8])])
    }

    #[test]
    fn other_objects_are_passed_over_and_never_made() {
        // The class would end the process if it were called.
        let bytes = archive(pickle("FloatStorage", "os\n_exit"), &[1.0, -2.0]);
        let t = parse("a.pth".as_ref(), &bytes, |_| true).unwrap();
        assert_eq!(t.names(), ["w"]);
        assert_eq!(t.f32s("w", &[2]).unwrap(), [1.0, -2.0]);
    }

    #[test]
    fn bad_files_say_what_is_wrong() {
        let refused = |bytes: &[u8], words: &[&str]| {
            let e = parse("a.pth".as_ref(), bytes, |name| name == "w").err().unwrap().to_string();
            assert!(e.starts_with("a.pth: ") && words.iter().all(|w| e.contains(w)), "{e}");
        };
        refused(b"", &["is no checkpoint of PyTorch"]);
        refused(b"\x80\x02cos\nsystem\nU\x08echo bad\x85R.", &["is no checkpoint of PyTorch"]);
        refused(&pack(&[("a.npy".into(), vec![])]), &["without data.pkl"]);
        refused(&archive(pickle("FloatStorage", "os\n_exit"), &[1.0]), &["tensor 'w' reaches beyond its storage '0' of 4 bytes"]);
        refused(&archive(pickle("LongStorage", "os\n_exit"), &[1.0]), &["none of the tensors looked for; it has: n, w"]);
        refused(&archive(b"\x80\x02]q\0.".to_vec(), &[]), &["holds no dict"]);
        refused(STREAM, &["pickle byte"]);
        let mut big = pickle("FloatStorage", "os\n_exit");
        let at = big.windows(5).position(|w| w == b"K\x02\x85K\x01").unwrap();
        big.splice(at..at + 5, *b"J\xff\xff\xff\x7f\x85K\0");
        refused(&archive(big, &[1.0]), &["claim more than"]);
    }

    #[test]
    fn names_that_repeat_without_end_are_refused() {
        // Dictionaries each of which holds the one before it many times over.
        let mut bytes = b"\x80\x02}q\0".to_vec();
        for level in 1..12u8 {
            bytes.extend(b"}(");
            for key in 0..40u8 {
                bytes.extend([b'K', key, b'h', level - 1]);
            }
            bytes.extend([b'u', b'q', level]);
        }
        bytes.push(b'.');
        let e = parse("a.pth".as_ref(), &archive(bytes, &[]), |_| true).err().unwrap().to_string();
        assert!(e.contains("holds more than"), "{e}");
    }
}
