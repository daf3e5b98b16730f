//! A strict reader of Python pickles that hold plain values and NumPy arrays.
//!
//! A pickle is a program. Nothing of it is executed: the calls by which NumPy stores an array (`_reconstruct`, `_frombuffer`, `scalar`,
//! `dtype`, and `_codecs.encode`, by which protocol 2 stores bytes) are recognised as data; every other name and every opcode that NumPy
//! does not need is refused by name. Values live in one list and refer to each other by index, and bytes stay in the file.

use crate::io::numpy::{Array, Dtype};
use crate::{Error, Result};
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
}

/// A pickle that holds a dict.
pub(super) struct Pickle<'a> {
    path: PathBuf,
    nodes: Vec<Node<'a>>,
    items: Vec<(Id, Id)>,
}

/// The state of reading.
struct Machine<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
    nodes: Vec<Node<'a>>,
    stack: Vec<Id>,
    /// Heights of the stack at its marks.
    marks: Vec<usize>,
    memo: HashMap<usize, Id>,
}

impl<'a> Pickle<'a> {
    /// Takes the content of a file (protocols 2 to 5) that holds a dict; `path` names it in errors.
    pub fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        if !matches!(bytes, [0x80, 2..=5, ..]) {
            return Err(Error::file(path, "is no Python pickle of protocol 2 to 5"));
        }
        let mut machine = Machine { path, bytes, at: 0, nodes: Vec::new(), stack: Vec::new(), marks: Vec::new(), memo: HashMap::new() };
        while machine.step()? {}
        let root = machine.pop()?;
        match machine.nodes[root].clone() {
            Node::Dict(items) => Ok(Self { path: path.into(), nodes: machine.nodes, items }),
            _ => Err(Error::file(path, "holds no dict")),
        }
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

    fn decode(&self, dtype: Id, shape: Id, fortran: bool, data: Id) -> std::result::Result<Array, String> {
        let Node::Dtype { name, big } = self.nodes[dtype] else { return Err("has no element type".into()) };
        let dtype = Dtype::parse(name).ok_or_else(|| format!("has elements of type '{name}', expected numbers"))?;
        let Node::Tuple(dims) = &self.nodes[shape] else { return Err("has no shape".into()) };
        let dim = |id: &Id| match self.nodes[*id] {
            Node::Number(n) if n >= 0.0 && n < 2f64.powi(40) => Ok(n as usize),
            _ => Err("has a shape that is no tuple of whole numbers".to_string()),
        };
        let shape = dims.iter().map(dim).collect::<std::result::Result<Vec<_>, _>>()?;
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

/// A text, or bytes that are one (Python 2).
fn text<'a>(node: &Node<'a>) -> Option<&'a str> {
    match node {
        Node::Text(text) => Some(text),
        Node::Bytes(bytes) => std::str::from_utf8(bytes).ok(),
        _ => None,
    }
}

impl<'a> Machine<'a> {
    fn error(&self, what: impl AsRef<str>) -> Error {
        Error::file(self.path, format!("pickle byte {}: {}", self.at, what.as_ref()))
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        let slice = self.bytes[self.at..].get(..count).ok_or_else(|| self.error(format!("ends within a value of {count} bytes")))?;
        self.at += count;
        Ok(slice)
    }

    /// An unsigned little-endian number of `width` bytes.
    fn uint(&mut self, width: usize) -> Result<usize> {
        let value = self.take(width)?.iter().rev().fold(0u64, |n, &b| n << 8 | u64::from(b));
        usize::try_from(value).map_err(|_| self.error(format!("length {value}")))
    }

    /// Bytes behind their length of `width` bytes.
    fn sized(&mut self, width: usize) -> Result<&'a [u8]> {
        let count = self.uint(width)?;
        self.take(count)
    }

    fn utf8(&mut self, bytes: &'a [u8]) -> Result<&'a str> {
        std::str::from_utf8(bytes).map_err(|_| self.error("text that is not UTF-8"))
    }

    fn line(&mut self) -> Result<&'a str> {
        let end = self.bytes[self.at..].iter().position(|&b| b == b'\n').ok_or_else(|| self.error("ends within a name"))?;
        let line = self.take(end)?;
        self.at += 1;
        self.utf8(line)
    }

    fn push(&mut self, node: Node<'a>) {
        self.stack.push(self.nodes.len());
        self.nodes.push(node);
    }

    fn pop(&mut self) -> Result<Id> {
        if self.stack.len() <= self.marks.last().copied().unwrap_or(0) {
            return Err(self.error("takes a value where there is none"));
        }
        self.stack.pop().ok_or_else(|| self.error("takes a value where there is none"))
    }

    fn top(&mut self) -> Result<Id> {
        let id = self.pop()?;
        self.stack.push(id);
        Ok(id)
    }

    /// Values above the last mark.
    fn above_mark(&mut self) -> Result<Vec<Id>> {
        let height = self.marks.pop().ok_or_else(|| self.error("takes values up to a mark where there is none"))?;
        Ok(self.stack.split_off(height))
    }

    fn tuple(&mut self, count: usize) -> Result<()> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
        items.reverse();
        self.push(Node::Tuple(items));
        Ok(())
    }

    fn remember(&mut self, place: usize) -> Result<()> {
        let id = self.top()?;
        self.memo.insert(place, id);
        Ok(())
    }

    fn recall(&mut self, place: usize) -> Result<()> {
        let id = *self.memo.get(&place).ok_or_else(|| self.error(format!("recalls value {place}, which was not stored")))?;
        self.stack.push(id);
        Ok(())
    }

    /// Takes one opcode; false at the end.
    fn step(&mut self) -> Result<bool> {
        let op = self.take(1)?[0];
        match op {
            0x80 => drop(self.take(1)?), // PROTO
            0x95 => drop(self.take(8)?), // FRAME
            b'.' => return Ok(false),
            b'(' => self.marks.push(self.stack.len()),
            b'}' => self.push(Node::Dict(Vec::new())),
            b']' => self.push(Node::List(Vec::new())),
            b')' => self.push(Node::Tuple(Vec::new())),
            0x85..=0x87 => self.tuple(usize::from(op - 0x84))?,
            b't' => {
                let items = self.above_mark()?;
                self.push(Node::Tuple(items));
            }
            b's' | b'u' | b'a' | b'e' => self.fill(op)?,
            b'q' | b'r' => {
                let place = self.uint(if op == b'q' { 1 } else { 4 })?;
                self.remember(place)?;
            }
            0x94 => self.remember(self.memo.len())?,
            b'h' | b'j' => {
                let place = self.uint(if op == b'h' { 1 } else { 4 })?;
                self.recall(place)?;
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.global(module, name)?;
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (Some(module), Some(name)) = (text(&self.nodes[module]), text(&self.nodes[name])) else {
                    return Err(self.error("a global whose name is no text"));
                };
                self.global(module, name)?;
            }
            b'R' => self.reduce()?,
            b'b' => self.build()?,
            _ => self.plain(op)?,
        }
        Ok(true)
    }

    /// Opcodes of plain values.
    fn plain(&mut self, op: u8) -> Result<()> {
        let node = match op {
            b'N' => Node::None,
            0x88 => Node::Number(1.0),
            0x89 => Node::Number(0.0),
            b'J' => Node::Number(f64::from(self.uint(4)? as u32 as i32)),
            b'K' => Node::Number(self.uint(1)? as f64),
            b'M' => Node::Number(self.uint(2)? as f64),
            0x8a => {
                let bytes = self.sized(1)?;
                if bytes.len() > 8 {
                    return Err(self.error("a whole number of more than 64 bits"));
                }
                let value = bytes.iter().rev().fold(0u64, |n, &b| n << 8 | u64::from(b));
                let shift = 64 - 8 * bytes.len().max(1) as u32;
                Node::Number(((value << shift) as i64 >> shift) as f64)
            }
            b'G' => Node::Number(f64::from_be_bytes(std::array::from_fn(|i| self.bytes.get(self.at + i).copied().unwrap_or(0)))),
            b'X' | 0x8c | 0x8d => {
                let bytes = self.sized([4, 1, 8][usize::from(op.saturating_sub(0x8b))])?;
                Node::Text(self.utf8(bytes)?)
            }
            b'U' | b'C' => Node::Bytes(self.sized(1)?),
            b'T' | b'B' => Node::Bytes(self.sized(4)?),
            0x8e | 0x96 => Node::Bytes(self.sized(8)?),
            _ => return Err(self.error(format!("opcode {} is refused: plain values and NumPy arrays do not need it", opcode(op)))),
        };
        if op == b'G' {
            self.take(8)?;
        }
        self.push(node);
        Ok(())
    }

    /// Puts values into the dict or list below them.
    fn fill(&mut self, op: u8) -> Result<()> {
        let items = match op {
            b'u' | b'e' => self.above_mark()?,
            _ => {
                let mut items = (0..if op == b's' { 2 } else { 1 }).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
                items.reverse();
                items
            }
        };
        let target = self.top()?;
        match &mut self.nodes[target] {
            Node::Dict(dict) if matches!(op, b's' | b'u') => dict.extend(items.as_chunks::<2>().0.iter().map(|&[k, v]| (k, v))),
            Node::List(list) if matches!(op, b'a' | b'e') => list.extend(items),
            _ => return Err(self.error("puts items into what is no dict or list")),
        }
        Ok(())
    }

    fn global(&mut self, module: &str, name: &str) -> Result<()> {
        let global = match (module, name) {
            ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => Global::Reconstruct,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Global::Scalar,
            ("numpy.core.numeric" | "numpy._core.numeric", "_frombuffer") => Global::FromBuffer,
            ("numpy", "ndarray") => Global::Ndarray,
            ("numpy", "dtype") => Global::Dtype,
            ("_codecs", "encode") => Global::Encode,
            _ => return Err(self.error(format!("'{module}.{name}' is refused: only NumPy's arrays are read"))),
        };
        self.push(Node::Global(global));
        Ok(())
    }

    /// The value that a call stands for.
    fn reduce(&mut self) -> Result<()> {
        let (args, callee) = (self.pop()?, self.pop()?);
        let Node::Global(callee) = self.nodes[callee] else { return Err(self.error("calls what is no function")) };
        let Node::Tuple(args) = self.nodes[args].clone() else { return Err(self.error("calls without a tuple of arguments")) };
        let node = match (callee, &args[..]) {
            (Global::Reconstruct, [class, _, _]) if matches!(self.nodes[*class], Node::Global(Global::Ndarray)) => Node::EmptyArray,
            (Global::Scalar, &[dtype, data]) => {
                self.nodes.push(Node::Tuple(Vec::new()));
                Node::Array { dtype, shape: self.nodes.len() - 1, fortran: false, data }
            }
            (Global::FromBuffer, &[data, dtype, shape, order]) => {
                Node::Array { dtype, shape, fortran: text(&self.nodes[order]) == Some("F"), data }
            }
            (Global::Dtype, [name, ..]) => match text(&self.nodes[*name]) {
                Some(name) => Node::Dtype { name, big: false },
                None => return Err(self.error("numpy.dtype of what is no text")),
            },
            (Global::Encode, &[data, _]) => match self.nodes[data] {
                Node::Text(text) => Node::Latin(text),
                _ => return Err(self.error("_codecs.encode of what is no text")),
            },
            _ => return Err(self.error(format!("{callee:?} with {} arguments that are not NumPy's", args.len()))),
        };
        self.push(node);
        Ok(())
    }

    /// Gives an array or an element type its content.
    fn build(&mut self) -> Result<()> {
        let state = self.pop()?;
        let target = self.top()?;
        let Node::Tuple(state) = self.nodes[state].clone() else { return Err(self.error("a state that is no tuple")) };
        let built = match (&self.nodes[target], &state[..]) {
            (Node::EmptyArray, &[_version, shape, dtype, fortran, data]) => {
                Node::Array { dtype, shape, fortran: matches!(self.nodes[fortran], Node::Number(1.0)), data }
            }
            (Node::Dtype { name, .. }, [_version, order, ..]) => Node::Dtype { name, big: text(&self.nodes[*order]) == Some(">") },
            _ => return Err(self.error("gives a state to what is no NumPy array")),
        };
        self.nodes[target] = built;
        Ok(())
    }
}

/// Opcode `op` by its name where it is one that real pickles use.
fn opcode(op: u8) -> String {
    let name = match op {
        b'i' => "INST",
        b'o' => "OBJ",
        0x81 => "NEWOBJ",
        0x92 => "NEWOBJ_EX",
        b'P' => "PERSID",
        b'Q' => "BINPERSID",
        0x82..=0x84 => "EXT",
        0x97 => "NEXT_BUFFER",
        0x98 => "READONLY_BUFFER",
        0x8f => "EMPTY_SET",
        0x91 => "FROZENSET",
        _ => return format!("0x{op:02x}"),
    };
    name.into()
}
