//! TensorBoard event files: scalars only.
//!
//! `tensorboard_rs::SummaryWriter` panics in a thread of its own where a file cannot be written; its record writer, used here, does not.

use crate::logger::Logger;
use crate::stats::Row;
use crate::{Error, Result};
use protobuf::Message;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};
use tensorboard_proto::event::Event;
use tensorboard_rs::record_writer::RecordWriter;
use tensorboard_rs::summary::scalar;

/// One event file; every program that continues a run begins another.
pub struct TensorBoard {
    path: PathBuf,
    writer: RecordWriter<File>,
}

impl TensorBoard {
    /// Begins an event file in `dir`.
    pub fn new(dir: &Path) -> Result<Self> {
        let mut begin = event();
        let path = dir.join(format!("events.out.tfevents.{:010}.{}", begin.wall_time as u64, std::process::id()));
        std::fs::create_dir_all(dir).map_err(|e| egogen::Error::io(dir, e))?;
        let file = File::create(&path).map_err(|e| egogen::Error::io(&path, e))?;
        let mut new = Self { path, writer: RecordWriter::new(file) };
        begin.set_file_version("brain.Event:2".into());
        new.write(&begin)?;
        Ok(new)
    }

    fn write(&mut self, event: &Event) -> Result<()> {
        let bytes = event.write_to_bytes().map_err(|e| Error::run(format!("{}: {e}", self.path.display())))?;
        self.writer.write(&bytes).map_err(|e| Error::Core(egogen::Error::io(&self.path, e)))
    }
}

impl Logger for TensorBoard {
    fn log(&mut self, epoch: u64, row: &Row) -> Result<()> {
        for (name, value) in row.iter().filter_map(|(n, v)| v.map(|v| (n, v))) {
            let mut event = event();
            event.set_step(epoch as i64);
            event.set_summary(scalar(name, value as f32));
            self.write(&event)?;
        }
        Ok(())
    }
}

/// An event of now.
fn event() -> Event {
    let mut event = Event::new();
    event.set_wall_time(SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64()));
    event
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_hold_what_was_logged() {
        let dir = tempfile::tempdir().unwrap();
        let row: Row = vec![("ab".into(), Some(1.5)), ("none".into(), None)];
        TensorBoard::new(dir.path()).unwrap().log(300, &row).unwrap();
        let file = std::fs::read_dir(dir.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(file).unwrap();
        let mut events: Vec<Event> = vec![];
        let mut at = 0;
        // A record: length (8 bytes), its checksum (4), data, its checksum (4).
        while at < bytes.len() {
            let n = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
            events.push(Event::parse_from_bytes(&bytes[at + 12..at + 12 + n]).unwrap());
            at += 16 + n;
        }
        assert_eq!(events.len(), 2);
        assert_eq!(events[0].get_file_version(), "brain.Event:2");
        let value = &events[1].get_summary().get_value()[0];
        assert_eq!((events[1].get_step(), value.get_tag(), value.get_simple_value()), (300, "ab", 1.5));
    }
}
