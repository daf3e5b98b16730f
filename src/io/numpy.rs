//! NumPy's arrays, the `.npy` form of one and `.npz` archives of several.

use super::zip::{Archive, pack};
use crate::{Error, Result};
use half::f16;
use std::path::{Path, PathBuf};

const MAGIC: &[u8] = b"\x93NUMPY";

/// Type of an array's elements, as NumPy writes it: order `<`, `>`, `|` or `=`, kind, and size in bytes (of `U` in characters).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Dtype {
    pub big: bool,
    pub kind: u8,
    pub size: usize,
}

/// Numbers with their shape, in C order.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Array {
    pub shape: Vec<usize>,
    pub data: Vec<f32>,
}

impl Dtype {
    /// A type such as `<f8`, `|b1`, `<U6` or, of pickles, `f4`.
    pub fn parse(text: &str) -> Option<Self> {
        let bare = text.trim_start_matches(['<', '>', '|', '=']);
        let (kind, digits) = (*bare.as_bytes().first()?, bare.get(1..)?);
        let size = digits.parse::<usize>().ok()?;
        let known = match kind {
            b'f' => [2, 4, 8].contains(&size),
            b'i' | b'u' => [1, 2, 4, 8].contains(&size),
            b'b' => size == 1,
            b'U' => size < 1 << 20,
            b'S' => size < 1 << 20,
            _ => false,
        };
        known.then_some(Self { big: text.starts_with('>'), kind, size })
    }

    fn bytes(&self) -> usize {
        if self.kind == b'U' { 4 * self.size } else { self.size }
    }

    fn number(&self, bytes: &[u8]) -> f32 {
        let mut le = [0; 8];
        le[..bytes.len()].copy_from_slice(bytes);
        if self.big {
            le[..bytes.len()].reverse();
        }
        let bits = u64::from_le_bytes(le);
        let shift = 64 - 8 * bytes.len() as u32;
        match (self.kind, self.size) {
            (b'f', 2) => f16::from_bits(bits as u16).to_f32(),
            (b'f', 4) => f32::from_bits(bits as u32),
            (b'f', _) => f64::from_bits(bits) as f32,
            (b'i', _) => ((bits << shift) as i64 >> shift) as f32,
            _ => bits as f32,
        }
    }

    fn text(&self, bytes: &[u8]) -> Option<String> {
        let text = match self.kind {
            b'U' => bytes
                .as_chunks::<4>()
                .0
                .iter()
                .map(|&c| char::from_u32(if self.big { u32::from_be_bytes(c) } else { u32::from_le_bytes(c) }))
                .collect::<Option<String>>()?,
            b'S' => String::from_utf8(bytes.to_vec()).ok()?,
            _ => return None,
        };
        Some(text.trim_end_matches('\0').to_string())
    }
}

impl Array {
    /// The array of `bytes`; `fortran` says that the first index runs fastest. The error says what does not fit.
    pub fn decode(dtype: &Dtype, shape: Vec<usize>, fortran: bool, bytes: &[u8]) -> std::result::Result<Self, String> {
        if matches!(dtype.kind, b'U' | b'S') {
            return Err("holds text, expected numbers".into());
        }
        let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        if count.and_then(|n| n.checked_mul(dtype.size)) != Some(bytes.len()) {
            return Err(format!("has {} bytes, not those of shape {}", bytes.len(), show(&shape)));
        }
        let data: Vec<f32> = bytes.chunks_exact(dtype.size).map(|b| dtype.number(b)).collect();
        Ok(Self { data: if fortran { c_order(&shape, &data) } else { data }, shape })
    }

    /// Refuses another shape than `want`, in which 0 stands for any number; the error names file and key.
    pub fn check(&self, path: &Path, key: &str, want: &[usize]) -> Result<()> {
        let fits = self.shape.len() == want.len() && self.shape.iter().zip(want).all(|(&a, &b)| b == 0 || a == b);
        let any = |text: String| text.replace("(0", "(T");
        match fits {
            true => Ok(()),
            false => Err(Error::file(path, format!("'{key}' has shape {}, expected {}", show(&self.shape), any(show(want))))),
        }
    }

    /// Refuses numbers that are not finite; the error names the frame, the first index.
    pub fn check_finite(&self, path: &Path, key: &str) -> Result<()> {
        match self.data.iter().position(|v| !v.is_finite()) {
            Some(i) => {
                let row = self.shape.iter().skip(1).product::<usize>().max(1);
                Err(Error::file(path, format!("'{key}' frame {} holds {}, expected finite numbers", i / row, self.data[i])))
            }
            None => Ok(()),
        }
    }

    /// The only number.
    pub fn scalar(&self, path: &Path, key: &str) -> Result<f32> {
        match self.data[..] {
            [value] => Ok(value),
            _ => Err(Error::file(path, format!("'{key}' has shape {}, expected one number", show(&self.shape)))),
        }
    }
}

fn c_order(shape: &[usize], data: &[f32]) -> Vec<f32> {
    let mut index = vec![0; shape.len()];
    let mut out = Vec::with_capacity(data.len());
    for _ in 0..data.len() {
        out.push(data[index.iter().zip(shape).rev().fold(0, |at, (i, d)| at * d + i)]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            if index[axis] < shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    out
}

/// A shape as Python writes it.
fn show(shape: &[usize]) -> String {
    match shape {
        [n] => format!("({n},)"),
        _ => format!("({})", shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    }
}

/// Type, shape, whether the first index runs fastest, and bytes.
type Npy<'a> = (Dtype, Vec<usize>, bool, &'a [u8]);

/// Takes `.npy` data apart.
pub(crate) fn parse_npy(bytes: &[u8]) -> std::result::Result<Npy<'_>, String> {
    let cut = || "is cut off within its header".to_string();
    let rest = bytes.strip_prefix(MAGIC).ok_or("is no NumPy array")?;
    let (&[major, _], rest) = rest.split_first_chunk().ok_or_else(cut)?;
    let (length, rest) = if major == 1 {
        rest.split_first_chunk().map(|(n, rest)| (u16::from_le_bytes(*n) as usize, rest)).ok_or_else(cut)?
    } else {
        rest.split_first_chunk().map(|(n, rest)| (u32::from_le_bytes(*n) as usize, rest)).ok_or_else(cut)?
    };
    let (header, data) = rest.split_at_checked(length).ok_or_else(cut)?;
    let header = std::str::from_utf8(header).map_err(|_| "has a header that is no text")?;
    let after = |key: &str| header.split_once(key).map(|(_, rest)| rest.trim_start()).ok_or(format!("has no {key} in its header"));
    let descr = after("'descr':")?;
    let descr = descr.strip_prefix('\'').and_then(|d| d.split_once('\'')).map_or(descr, |d| d.0);
    let dtype = Dtype::parse(descr).ok_or_else(|| format!("has elements of type '{descr}', expected numbers or text"))?;
    let shape = after("'shape':")?.strip_prefix('(').and_then(|s| s.split_once(')')).ok_or("has a shape that is no tuple")?.0;
    let dims =
        shape.split(',').map(str::trim).filter(|d| !d.is_empty()).map(|d| d.parse::<usize>().map_err(|_| format!("has shape ({shape})")));
    Ok((dtype, dims.collect::<std::result::Result<_, _>>()?, after("'fortran_order':")?.starts_with("True"), data))
}

/// The numbers of an `.npy` file; `path` names it in errors.
pub(crate) fn read_npy(path: &Path, bytes: &[u8]) -> Result<Array> {
    parse_npy(bytes).and_then(|(dtype, shape, fortran, data)| Array::decode(&dtype, shape, fortran, data)).map_err(|e| Error::file(path, e))
}

/// The `.npy` form of an array: its header as NumPy pads it, to a multiple of 64 with a newline at its end, and its elements.
pub(crate) fn npy(descr: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let dict = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {}, }}", show(shape));
    let padded = (MAGIC.len() + 4 + dict.len() + 1).next_multiple_of(64) - MAGIC.len() - 4;
    let header = format!("{dict:<width$}\n", width = padded - 1);
    [MAGIC, &[1, 0], &(padded as u16).to_le_bytes(), header.as_bytes(), data].concat()
}

/// An `.npz` archive; entries are read when asked for, so that others may hold anything.
pub(crate) struct Npz<'a> {
    path: PathBuf,
    zip: Archive<'a>,
}

impl<'a> Npz<'a> {
    /// Takes the content of a file; `path` names it in errors.
    pub fn new(path: &Path, bytes: &'a [u8]) -> Result<Self> {
        let zip = Archive::new(bytes).map_err(|e| Error::file(path, format!("is no npz archive: {e}")))?;
        Ok(Self { path: path.into(), zip })
    }

    /// Whether there is an array `key`.
    pub fn has(&self, key: &str) -> bool {
        self.zip.names().any(|n| n.strip_suffix(".npy") == Some(key))
    }

    /// The numbers of array `key`.
    pub fn array(&self, key: &str) -> Result<Array> {
        let bytes = self.entry(key)?;
        parse_npy(&bytes)
            .and_then(|(dtype, shape, fortran, data)| Array::decode(&dtype, shape, fortran, data))
            .map_err(|e| self.error(key, &e))
    }

    /// The text that is the only element of array `key`.
    pub fn text(&self, key: &str) -> Result<String> {
        let bytes = self.entry(key)?;
        let (dtype, _, _, data) = parse_npy(&bytes).map_err(|e| self.error(key, &e))?;
        let one = data.len() == dtype.bytes();
        one.then(|| dtype.text(data)).flatten().ok_or_else(|| self.error(key, "is no single text"))
    }

    fn entry(&self, key: &str) -> Result<Vec<u8>> {
        if !self.has(key) {
            let names: Vec<&str> = self.zip.names().take(20).map(|n| n.trim_end_matches(".npy")).collect();
            return Err(Error::file(&self.path, format!("has no array '{key}'; it has: {}", names.join(", "))));
        }
        self.zip.read(&format!("{key}.npy")).map_err(|e| self.error(key, &e))
    }

    fn error(&self, key: &str, what: &str) -> Error {
        Error::file(&self.path, format!("'{key}' {what}"))
    }
}

/// Collects arrays for an `.npz` archive, which NumPy reads; the same arrays give the same bytes.
#[derive(Default)]
pub(crate) struct NpzWriter(Vec<(String, Vec<u8>)>);

impl NpzWriter {
    /// Adds numbers in C order as single precision.
    pub fn f32s(&mut self, key: &str, shape: &[usize], data: &[f32]) {
        self.entry(key, "<f4", shape, &data.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>());
    }

    /// Adds one number in double precision.
    pub fn number(&mut self, key: &str, value: f64) {
        self.entry(key, "<f8", &[], &value.to_le_bytes());
    }

    /// Adds one text.
    pub fn text(&mut self, key: &str, text: &str) {
        let bytes: Vec<u8> = text.chars().flat_map(|c| (c as u32).to_le_bytes()).collect();
        self.entry(key, &format!("<U{}", bytes.len() / 4), &[], &bytes);
    }

    fn entry(&mut self, key: &str, descr: &str, shape: &[usize], data: &[u8]) {
        self.0.push((format!("{key}.npy"), npy(descr, shape, data)));
    }

    /// The content of the file.
    pub fn finish(self) -> Vec<u8> {
        pack(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_by_hand() {
        for (text, bytes, want) in [
            ("<f8", &1.5f64.to_le_bytes()[..], 1.5),
            (">f4", &(-2.5f32).to_be_bytes(), -2.5),
            ("<f2", &[0x00, 0x3e], 1.5),
            ("<i2", &[0xfe, 0xff], -2.0),
            ("|i1", &[0x80], -128.0),
            ("|u1", &[0x80], 128.0),
            (">u4", &[0, 0, 1, 2], 258.0),
            ("<i8", &(-7i64).to_le_bytes(), -7.0),
            ("|b1", &[1], 1.0),
        ] {
            let array = Array::decode(&Dtype::parse(text).unwrap(), vec![], false, bytes).unwrap();
            assert_eq!(array.data, [want], "{text}");
        }
        for text in ["|O", "<c16", "<f3", "V8", "", "<f", "<U99999999999"] {
            assert_eq!(Dtype::parse(text), None, "{text}");
        }
    }

    #[test]
    fn fortran_order_and_shapes() {
        let bytes = |values: &[u8]| Array::decode(&Dtype::parse("|u1").unwrap(), vec![2, 3], true, values);
        assert_eq!(bytes(&[1, 4, 2, 5, 3, 6]).unwrap().data, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(bytes(&[1]).unwrap_err(), "has 1 bytes, not those of shape (2, 3)");
        let message = Array { shape: vec![3], data: vec![0.0; 3] }.check(Path::new("a.npz"), "trans", &[0, 3]).unwrap_err().to_string();
        assert_eq!(message, "a.npz: 'trans' has shape (3,), expected (T, 3)");
    }
}
