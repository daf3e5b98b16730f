//! The machine that a pickle is a program for, as far as it only makes values.

use super::{Element, Global, Id, Node, TensorView, size, sizes, text};
use crate::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

/// The state of reading.
pub(super) struct Machine<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    pub at: usize,
    pub nodes: Vec<Node<'a>>,
    stack: Vec<Id>,
    /// Heights of the stack at its marks.
    marks: Vec<usize>,
    memo: HashMap<usize, Id>,
    /// Whether it is a checkpoint of PyTorch.
    torch: bool,
}

impl<'a> Machine<'a> {
    /// Reads one pickle; the state after it and what it holds.
    pub fn run(path: &'a Path, bytes: &'a [u8], torch: bool) -> Result<(Self, Id)> {
        let (nodes, stack, marks, memo) = (Vec::new(), Vec::new(), Vec::new(), HashMap::new());
        let mut machine = Self { path, bytes, at: 0, nodes, stack, marks, memo, torch };
        while machine.step()? {}
        let root = machine.pop()?;
        Ok((machine, root))
    }

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
            b'Q' if self.torch => self.storage()?,
            0x81 if self.torch => {
                self.pop()?;
                self.pop()?;
                self.push(Node::Opaque);
            }
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
            Node::Opaque => {}
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
            ("collections", "OrderedDict") if self.torch => Global::OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2") if self.torch => Global::RebuildTensor,
            ("torch._utils", "_rebuild_parameter") if self.torch => Global::RebuildParameter,
            ("torch", name) if self.torch => Element::of_storage(name).map_or(Global::Other, Global::Storage),
            _ if self.torch => Global::Other,
            _ => return Err(self.error(format!("'{module}.{name}' is refused: only NumPy's arrays are read"))),
        };
        self.push(Node::Global(global));
        Ok(())
    }

    /// The value that a call stands for.
    fn reduce(&mut self) -> Result<()> {
        let (args, callee) = (self.pop()?, self.pop()?);
        let callee = match self.nodes[callee] {
            Node::Global(callee) => callee,
            Node::Opaque => Global::Other,
            _ => return Err(self.error("calls what is no function")),
        };
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
            (Global::OrderedDict, _) => Node::Dict(self.pairs(&args)),
            (Global::RebuildTensor, &[storage, offset, shape, strides, ..]) => self.tensor([storage, offset, shape, strides])?,
            (Global::RebuildParameter, &[tensor, ..]) => self.nodes[tensor].clone(),
            _ if self.torch => Node::Opaque,
            _ => return Err(self.error(format!("{callee:?} with {} arguments that are not NumPy's", args.len()))),
        };
        self.push(node);
        Ok(())
    }

    /// Keys and values of a list of pairs, where that is the one argument.
    fn pairs(&self, args: &[Id]) -> Vec<(Id, Id)> {
        let [list] = args else { return Vec::new() };
        let Node::List(list) = &self.nodes[*list] else { return Vec::new() };
        let pair = |&id: &Id| match &self.nodes[id] {
            Node::Tuple(pair) | Node::List(pair) => pair.as_slice().try_into().ok().map(|[k, v]: [Id; 2]| (k, v)),
            _ => None,
        };
        list.iter().filter_map(pair).collect()
    }

    /// A storage from ('storage', class, name, device, elements): where its elements are.
    fn storage(&mut self) -> Result<()> {
        let id = self.pop()?;
        let Node::Tuple(fields) = &self.nodes[id] else { return Err(self.error("a storage whose description is no tuple")) };
        // Older files may describe a view of another storage in a sixth field; those are not read.
        let whole = fields.len() == 5 || fields.len() == 6 && matches!(self.nodes[fields[5]], Node::None);
        let node = match (&self.nodes[*fields.get(1).unwrap_or(&id)], fields.get(2).and_then(|&name| text(&self.nodes[name]))) {
            (Node::Global(Global::Storage(element)), Some(name)) if whole => Node::Storage { element: *element, name },
            _ => Node::Opaque,
        };
        self.push(node);
        Ok(())
    }

    fn tensor(&self, [storage, offset, shape, strides]: [Id; 4]) -> Result<Node<'a>> {
        let Node::Storage { element, name } = self.nodes[storage] else { return Ok(Node::Opaque) };
        let (offset, shape, strides) = (size(&self.nodes[offset]), sizes(&self.nodes, shape), sizes(&self.nodes, strides));
        let (Some(offset), Some(shape), Some(strides)) = (offset, shape, strides) else {
            return Err(self.error(format!("a tensor of storage {name} whose sizes are no whole numbers")));
        };
        if shape.len() != strides.len() {
            return Err(self.error(format!("a tensor of storage {name} with {} sizes and {} strides", shape.len(), strides.len())));
        }
        Ok(Node::Tensor(TensorView { element, storage: name, offset, shape, strides }))
    }

    /// Gives an array or an element type its content.
    fn build(&mut self) -> Result<()> {
        let state = self.pop()?;
        let target = self.top()?;
        if self.torch {
            return Ok(());
        }
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
