//! Furniture that others made, for the tests.

use std::path::{Path, PathBuf};
use std::process::Command;

/// The unpacked archive of scenes where it is at hand; says where it was looked for otherwise.
pub fn unpacked() -> Option<tempfile::TempDir> {
    let shared = std::env::var_os("EGOGEN_SHARED").map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let archive = shared.join("data/scenes.tar.gz");
    if !archive.is_file() {
        println!("skipped: no {} (set EGOGEN_SHARED)", archive.display());
        return None;
    }
    let dir = tempfile::tempdir().unwrap();
    assert!(Command::new("tar").arg("xzf").arg(archive).arg("-C").arg(dir.path()).status().unwrap().success());
    Some(dir)
}
