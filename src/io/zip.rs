//! The part of the zip format that NumPy's archives use: entries stored or deflated, below 4 GiB.

use flate2::Crc;
use flate2::read::DeflateDecoder;
use std::io::Read;

/// Most bytes one entry may have; ten minutes of SMPL-X at 120 frames per second are a tenth of it.
const MAX_BYTES: usize = 1 << 30;
const LOCAL: &[u8] = b"PK\x03\x04";
const CENTRAL: &[u8] = b"PK\x01\x02";
const END: &[u8] = b"PK\x05\x06";
/// Bytes of the three headers without their variable parts.
const LOCAL_LEN: usize = 30;
const CENTRAL_LEN: usize = 46;
const END_LEN: usize = 22;
/// 1 January 1980, so that the same entries give the same bytes.
const DATE: u16 = 0x21;

struct Entry {
    name: String,
    encrypted: bool,
    method: u16,
    crc: u32,
    packed: usize,
    size: usize,
    offset: usize,
}

/// An archive in memory. Errors say what is wrong with it.
pub(crate) struct Archive<'a> {
    bytes: &'a [u8],
    entries: Vec<Entry>,
}

fn u16_at(bytes: &[u8], at: usize) -> usize {
    usize::from(bytes[at]) | usize::from(bytes[at + 1]) << 8
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u16_at(bytes, at) | u16_at(bytes, at + 2) << 16
}

/// `count` bytes from `at`, when they begin with `signature`.
fn header<'a>(bytes: &'a [u8], at: usize, count: usize, signature: &[u8]) -> Option<&'a [u8]> {
    bytes.get(at..)?.get(..count).filter(|h| h.starts_with(signature))
}

impl<'a> Archive<'a> {
    /// Reads the directory at the end of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Result<Self, String> {
        let last = bytes.len().checked_sub(END_LEN).ok_or("it is too short")?;
        let first = last.saturating_sub(usize::from(u16::MAX));
        let end = (first..=last).rev().find_map(|at| header(bytes, at, END_LEN, END)).ok_or("it has no directory at its end")?;
        let (count, mut at) = (u16_at(end, 10), u32_at(end, 16));
        let mut entries = Vec::new();
        for i in 0..count {
            let bad = || format!("its directory is broken at entry {i}");
            let h = header(bytes, at, CENTRAL_LEN, CENTRAL).ok_or_else(bad)?;
            let (name, rest) = (u16_at(h, 28), u16_at(h, 30) + u16_at(h, 32));
            at += CENTRAL_LEN;
            let text = bytes.get(at..).and_then(|b| b.get(..name)).ok_or_else(bad)?;
            at += name + rest;
            entries.push(Entry {
                name: String::from_utf8_lossy(text).into_owned(),
                encrypted: u16_at(h, 8) & 1 == 1,
                method: u16_at(h, 10) as u16,
                crc: u32_at(h, 16) as u32,
                packed: u32_at(h, 20),
                size: u32_at(h, 24),
                offset: u32_at(h, 42),
            });
        }
        Ok(Self { bytes, entries })
    }

    /// Names of all entries.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.iter().map(|e| e.name.as_str())
    }

    /// The content of entry `name`, whose checksum is compared.
    pub fn read(&self, name: &str) -> Result<Vec<u8>, String> {
        let entry = self.entries.iter().find(|e| e.name == name).ok_or("is missing")?;
        if entry.size > MAX_BYTES || entry.encrypted {
            return Err(format!("has more than {MAX_BYTES} bytes or is encrypted"));
        }
        let cut = "is cut off";
        let local = header(self.bytes, entry.offset, LOCAL_LEN, LOCAL).ok_or(cut)?;
        let start = entry.offset + LOCAL_LEN + u16_at(local, 26) + u16_at(local, 28);
        let packed = self.bytes.get(start..).and_then(|b| b.get(..entry.packed)).ok_or(cut)?;
        let mut out = Vec::new();
        match entry.method {
            0 => out.extend_from_slice(packed),
            8 => drop(
                DeflateDecoder::new(packed)
                    .take(entry.size as u64 + 1)
                    .read_to_end(&mut out)
                    .map_err(|e| format!("cannot be unpacked: {e}"))?,
            ),
            method => return Err(format!("is packed by method {method}, expected 0 (stored) or 8 (deflated)")),
        }
        if out.len() != entry.size || crc(&out) != entry.crc {
            return Err("is damaged: its length or checksum differs".into());
        }
        Ok(out)
    }
}

fn crc(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes);
    crc.sum()
}

/// An archive of stored entries, each a name and its content, below 4 GiB in all.
pub(crate) fn pack(entries: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in entries {
        let offset = out.len() as u32;
        // Version 2.0, no flags, stored, midnight, date, checksum, sizes, length of the name, nothing extra.
        let mut fields = Vec::new();
        [20, 0, 0, 0, DATE].iter().for_each(|v| fields.extend(v.to_le_bytes()));
        [crc(content), content.len() as u32, content.len() as u32].iter().for_each(|v| fields.extend(v.to_le_bytes()));
        [name.len() as u16, 0].iter().for_each(|v| fields.extend(v.to_le_bytes()));
        out.extend([LOCAL, &fields, name.as_bytes(), content].concat());
        directory.extend([CENTRAL, &20u16.to_le_bytes(), &fields, &[0; 10], &offset.to_le_bytes(), name.as_bytes()].concat());
    }
    let (start, count) = (out.len() as u32, (entries.len() as u16).to_le_bytes());
    let size = (directory.len() as u32).to_le_bytes();
    out.extend(directory);
    out.extend([END, &[0; 4], &count, &count, &size, &start.to_le_bytes(), &[0; 2]].concat());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_entries_come_back_and_damage_shows() {
        let entries = [("a.npy".to_string(), b"first".to_vec()), ("b.npy".to_string(), vec![7; 300])];
        let bytes = pack(&entries);
        let archive = Archive::new(&bytes).unwrap();
        assert_eq!(archive.names().collect::<Vec<_>>(), ["a.npy", "b.npy"]);
        for (name, content) in &entries {
            assert_eq!(archive.read(name).unwrap(), *content);
        }
        assert_eq!(archive.read("c.npy").unwrap_err(), "is missing");
        let mut broken = bytes.clone();
        broken[LOCAL_LEN + 5] ^= 1;
        assert!(Archive::new(&broken).unwrap().read("a.npy").unwrap_err().contains("checksum"));
        assert!(Archive::new(&bytes[..bytes.len() - 1]).is_err() && Archive::new(b"").is_err());
    }
}
