//! TensorBoard event files: scalars only.
//!
//! A file is a sequence of TFRecords, each holding one `Event` of TensorFlow's `event.proto`.

use crate::logger::Logger;
use crate::stats::Row;
use crate::{Error, Result};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// One event file; every program that continues a run begins another.
pub struct TensorBoard {
    path: PathBuf,
    file: File,
}

impl TensorBoard {
    /// Begins an event file in `dir`.
    pub fn new(dir: &Path) -> Result<Self> {
        let time = now();
        let path = dir.join(format!("events.out.tfevents.{:010}.{}", time as u64, std::process::id()));
        std::fs::create_dir_all(dir).map_err(|e| egogen::Error::io(dir, e))?;
        let file = File::create(&path).map_err(|e| egogen::Error::io(&path, e))?;
        let mut new = Self { path, file };
        let mut event = time_field(time);
        bytes_field(&mut event, 3, b"brain.Event:2");
        new.write(&event)?;
        Ok(new)
    }

    fn write(&mut self, event: &[u8]) -> Result<()> {
        self.file.write_all(&record(event)).map_err(|e| Error::Core(egogen::Error::io(&self.path, e)))
    }
}

impl Logger for TensorBoard {
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()> {
        self.write(&scalars(now(), epoch, row))
    }
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// `Event { wall_time, step, summary { value { tag, simple_value } ... } }`.
fn scalars(time: f64, step: u64, row: &Row) -> Vec<u8> {
    let mut summary = Vec::new();
    for (name, value) in row.iter().filter_map(|(n, v)| v.map(|v| (n, v))) {
        let mut one = Vec::new();
        bytes_field(&mut one, 1, name.as_bytes());
        one.push(2 << 3 | 5);
        one.extend((value as f32).to_le_bytes());
        bytes_field(&mut summary, 1, &one);
    }
    let mut event = time_field(time);
    event.push(2 << 3);
    varint(&mut event, step);
    bytes_field(&mut event, 5, &summary);
    event
}

fn time_field(time: f64) -> Vec<u8> {
    [[1 << 3 | 1].as_slice(), &time.to_le_bytes()].concat()
}

fn bytes_field(out: &mut Vec<u8>, number: u8, bytes: &[u8]) {
    out.push(number << 3 | 2);
    varint(out, bytes.len() as u64);
    out.extend(bytes);
}

fn varint(out: &mut Vec<u8>, mut n: u64) {
    while n >= 0x80 {
        out.push(n as u8 | 0x80);
        n >>= 7;
    }
    out.push(n as u8);
}

/// Length, its checksum, data, its checksum.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    [&length, masked(&length).to_le_bytes().as_slice(), data, &masked(data).to_le_bytes()].concat()
}

/// The checksum as TFRecords store it.
fn masked(data: &[u8]) -> u32 {
    crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C (Castagnoli), bit by bit: a few kilobytes per epoch.
fn crc32c(data: &[u8]) -> u32 {
    !data.iter().fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |c, _| if c & 1 == 1 { c >> 1 ^ 0x82f6_3b78 } else { c >> 1 }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums() {
        // The check value of CRC-32C, and RFC 3720's 32 zeros.
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
    }

    /// The bytes that TensorFlow's protobuf definitions give, by hand.
    #[test]
    fn events_by_hand() {
        let row: Row = vec![("ab".into(), Some(1.0)), ("none".into(), None)];
        let event = scalars(2.0, 300, &row);
        let time = [9, 0, 0, 0, 0, 0, 0, 0, 0x40];
        let value = [0x0a, 2, b'a', b'b', 0x15, 0, 0, 0x80, 0x3f];
        assert_eq!(event, [time.as_slice(), &[0x10, 0xac, 2], &[0x2a, 11, 0x0a, 9], &value].concat());
        let record = record(&event);
        assert_eq!(record.len(), 8 + 4 + event.len() + 4);
        assert_eq!(record[..8], (event.len() as u64).to_le_bytes());
    }
}
