//! A strict reader of Python pickles that hold plain values and NumPy arrays, or PyTorch's tensors.
//!
//! A pickle is a program. Nothing of it is executed: the calls by which NumPy stores an array (`_reconstruct`, `_frombuffer`, `scalar`,
//! `dtype`, and `_codecs.encode`, by which protocol 2 stores bytes) are recognised as data; every other name and every opcode that NumPy
//! does not need is refused by name. Values live in one list and refer to each other by index, and bytes stay in the file.
//!
//! A checkpoint of PyTorch may hold objects of any class beside its tensors. There the calls by which PyTorch stores tensors are recognised
//! (`_rebuild_tensor_v2`, `_rebuild_parameter`, `OrderedDict`, storages by name); what any other call would give is an opaque value.

mod machine;

use crate::io::numpy::{Array, Dtype};
use crate::{Error, Result};
use machine::Machine;
use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

type Id = usize;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Global {
    Reconstruct,
    FromBuffer,
    Scalar,
    Ndarray,
    Dtype,
    Encode,
    OrderedDict,
    RebuildTensor,
    RebuildParameter,
    /// A storage of elements of that type.
    Storage(Element),
    /// A name of a checkpoint that stands for nothing read here.
    Other,
}

/// Type of the elements of a tensor, as far as networks' weights go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Element {
    F64,
    F32,
    F16,
    BF16,
    /// Whole numbers of that many bytes.
    Whole(usize),
}

impl Element {
    /// The elements of a storage class of torch.
    fn of_storage(name: &str) -> Option<Self> {
        Some(match name {
            "DoubleStorage" => Self::F64,
            "FloatStorage" => Self::F32,
            "HalfStorage" => Self::F16,
            "BFloat16Storage" => Self::BF16,
            "LongStorage" => Self::Whole(8),
            "IntStorage" => Self::Whole(4),
            "ShortStorage" => Self::Whole(2),
            "CharStorage" | "ByteStorage" | "BoolStorage" => Self::Whole(1),
            _ => return None,
        })
    }

    /// Bytes of one element.
    pub fn bytes(self) -> usize {
        match self {
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::BF16 => 2,
            Self::Whole(n) => n,
        }
    }
}

/// A tensor: a view of a storage.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TensorView<'a> {
    pub element: Element,
    /// Name of the storage within its file.
    pub storage: &'a str,
    /// In elements, as the strides.
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

#[derive(Clone, Debug)]
enum Node<'a> {
    None,
    Number(f64),
    Text(&'a str),
    Bytes(&'a [u8]),
    /// Bytes stored as the characters of a text.
    Latin(&'a str),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Global(Global),
    Dtype {
        name: &'a str,
        big: bool,
    },
    /// An array whose content follows.
    EmptyArray,
    /// Element type, shape and bytes are values of their own.
    Array {
        dtype: Id,
        shape: Id,
        fortran: bool,
        data: Id,
    },
    Storage {
        element: Element,
        name: &'a str,
    },
    Tensor(TensorView<'a>),
    /// A value that is not read.
    Opaque,
}

/// A pickle that holds a dict.
pub(crate) struct Pickle<'a> {
    path: PathBuf,
    nodes: Vec<Node<'a>>,
    items: Vec<(Id, Id)>,
}

/// Values that one walk through a checkpoint may come by: a few bytes can refer to the same value without end.
const MAX_VALUES: usize = 1 << 20;
/// How deep its dictionaries may lie.
const MAX_DEPTH: usize = 16;

impl<'a> Pickle<'a> {
    /// Takes the content of a file (protocols 2 to 5) that holds a dict; `path` names it in errors.
    pub fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        if !matches!(bytes, [0x80, 2..=5, ..]) {
            return Err(Error::file(path, "is no Python pickle of protocol 2 to 5"));
        }
        Self::run(path, bytes, false).map(|(pickle, _)| pickle)
    }

    /// Takes a pickle of PyTorch's tensors that holds a dict, and says where it ends in `bytes`.
    pub fn parse_torch(path: &'a Path, bytes: &'a [u8]) -> Result<(Self, usize)> {
        Self::run(path, bytes, true)
    }

    /// The texts in the list that is the pickle at the start of `bytes`, and where it ends.
    pub fn parse_texts(path: &'a Path, bytes: &'a [u8]) -> Result<(Vec<&'a str>, usize)> {
        let (machine, root) = Machine::run(path, bytes, true)?;
        let Node::List(list) = &machine.nodes[root] else { return Err(Error::file(path, "holds no list of its storages")) };
        Ok((list.iter().filter_map(|&id| text(&machine.nodes[id])).collect(), machine.at))
    }

    fn run(path: &'a Path, bytes: &'a [u8], torch: bool) -> Result<(Self, usize)> {
        let (machine, root) = Machine::run(path, bytes, torch)?;
        match machine.nodes[root].clone() {
            Node::Dict(items) => Ok((Self { path: path.into(), nodes: machine.nodes, items }, machine.at)),
            _ => Err(Error::file(path, "holds no dict")),
        }
    }

    /// All tensors in the dict and the dicts within it, by their keys joined with dots.
    pub fn tensors(&self) -> Result<Vec<(String, TensorView<'a>)>> {
        let (mut found, mut open, mut seen) = (Vec::new(), vec![(String::new(), 0, &self.items)], 0);
        while let Some((prefix, depth, items)) = open.pop() {
            for &(key, value) in items {
                seen += 1;
                if seen > MAX_VALUES {
                    return Err(Error::file(&self.path, format!("holds more than {MAX_VALUES} values")));
                }
                let key = match &self.nodes[key] {
                    Node::Number(n) => n.to_string(),
                    other => text(other).unwrap_or("?").to_string(),
                };
                match &self.nodes[value] {
                    Node::Tensor(view) => found.push((format!("{prefix}{key}"), view.clone())),
                    Node::Dict(items) if depth < MAX_DEPTH => open.push((format!("{prefix}{key}."), depth + 1, items)),
                    _ => {}
                }
            }
        }
        Ok(found)
    }

    /// Element types of all storages by name.
    pub fn storages(&self) -> HashMap<&'a str, Element> {
        let storage = |node: &Node<'a>| match *node {
            Node::Storage { element, name } => Some((name, element)),
            _ => None,
        };
        self.nodes.iter().filter_map(storage).collect()
    }

    /// The numbers of the value of `key`: an array or a plain number.
    pub fn array(&self, key: &str) -> Result<Array> {
        let found = self.items.iter().rev().find(|(k, _)| text(&self.nodes[*k]) == Some(key));
        let Some(&(_, value)) = found else {
            let keys: Vec<&str> = self.items.iter().filter_map(|(k, _)| text(&self.nodes[*k])).take(20).collect();
            return Err(Error::file(&self.path, format!("has no key '{key}'; it has: {}", keys.join(", "))));
        };
        let array = match &self.nodes[value] {
            Node::Number(v) => Ok(Array { shape: Vec::new(), data: vec![*v as f32] }),
            Node::Array { dtype, shape, fortran, data } => self.decode(*dtype, *shape, *fortran, *data),
            _ => Err("is neither an array nor a number".to_string()),
        };
        array.map_err(|e| Error::file(&self.path, format!("'{key}' {e}")))
    }

    /// What a value and the values in it hold as one array; `seen` counts them.
    fn stacked(&self, id: Id, depth: usize, seen: &mut usize) -> std::result::Result<Array, String> {
        *seen += 1;
        if *seen > MAX_VALUES || depth > MAX_DEPTH {
            return Err(format!("holds more than {MAX_VALUES} values, or lists deeper than {MAX_DEPTH}"));
        }
        let items = match &self.nodes[id] {
            Node::Number(v) => return Ok(Array { shape: Vec::new(), data: vec![*v as f32] }),
            Node::Array { dtype, shape, fortran, data } => {
                let array = self.decode(*dtype, *shape, *fortran, *data)?;
                *seen += array.data.len();
                return Ok(array);
            }
            Node::List(items) | Node::Tuple(items) => items,
            _ => return Err("holds something else than arrays, lists and numbers".into()),
        };
        let parts = items.iter().map(|&i| self.stacked(i, depth + 1, seen)).collect::<std::result::Result<Vec<_>, _>>()?;
        let first = parts.first().map_or(Vec::new(), |p| p.shape.clone());
        match parts.iter().find(|p| p.shape != first) {
            Some(p) => Err(format!("holds arrays of shapes {first:?} and {:?} in one list", p.shape)),
            None => Ok(Array {
                shape: std::iter::once(parts.len()).chain(first).collect(),
                data: parts.into_iter().flat_map(|p| p.data).collect(),
            }),
        }
    }

    fn decode(&self, dtype: Id, shape: Id, fortran: bool, data: Id) -> std::result::Result<Array, String> {
        let Node::Dtype { name, big } = self.nodes[dtype] else { return Err("has no element type".into()) };
        let dtype = Dtype::parse(name).ok_or_else(|| format!("has elements of type '{name}', expected numbers"))?;
        let shape = sizes(&self.nodes, shape).ok_or("has a shape that is no tuple of whole numbers")?;
        let bytes: Cow<[u8]> = match &self.nodes[data] {
            Node::Bytes(bytes) => Cow::Borrowed(bytes),
            Node::Latin(text) => {
                text.chars().map(|c| u8::try_from(c).map_err(|_| "has bytes beyond latin-1")).collect::<std::result::Result<_, _>>()?
            }
            _ => return Err("does not hold its elements as bytes".into()),
        };
        Array::decode(&Dtype { big, ..dtype }, shape, fortran, &bytes)
    }
}

/// The numbers of a pickle that is an array, or a list or tuple of such or of numbers, all of one shape.
pub(crate) fn nested(path: &Path, bytes: &[u8]) -> Result<Array> {
    let (machine, root) = Machine::run(path, bytes, false)?;
    let pickle = Pickle { path: path.into(), nodes: machine.nodes, items: Vec::new() };
    let mut seen = 0;
    pickle.stacked(root, 0, &mut seen).map_err(|e| Error::file(path, e))
}

/// The whole numbers of a tuple.
fn sizes(nodes: &[Node], tuple: Id) -> Option<Vec<usize>> {
    let Node::Tuple(items) = &nodes[tuple] else { return None };
    items.iter().map(|&id| size(&nodes[id])).collect()
}

fn size(node: &Node) -> Option<usize> {
    match *node {
        Node::Number(n) if n >= 0.0 && n < 2f64.powi(40) => Some(n as usize),
        _ => None,
    }
}

/// A text, or bytes that are one (Python 2).
fn text<'a>(node: &Node<'a>) -> Option<&'a str> {
    match node {
        Node::Text(text) => Some(text),
        Node::Bytes(bytes) => std::str::from_utf8(bytes).ok(),
        _ => None,
    }
}
