//! Damaged files: every reader answers with a value or an error, whatever the bytes are.

use super::PosePrior;
use super::amass::parse_amass;
use super::asf::{parse_amc, parse_asf};
use super::authors::{read_predictor, read_regressor};
use super::bvh::{Bvh, parse_bvh};
use super::canonical::CanonicalPrimitive;
use super::cmu::parse_expmap;
use super::named::parse_named;
use super::samp::parse_samp;
use crate::agent::authors::read_policy;
use crate::body::smplx::parse;
use crate::body::tests::few_vertices;
use crate::io::numpy::{Array, Npz, parse_npy};
use crate::io::zip::{Archive, pack};
use crate::scene::SdfGrid;
use crate::scene::mesh::{Format, MeshOptions};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::path::Path;

pub(crate) fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)).unwrap()
}

/// The same 256 cases every time; `EGOGEN_FUZZ=20000` tries that many new ones.
pub(crate) fn config() -> ProptestConfig {
    let wanted = std::env::var("EGOGEN_FUZZ").ok().and_then(|n| n.parse().ok());
    let rng_seed = if wanted.is_some() { RngSeed::Random } else { RngSeed::Fixed(1) };
    ProptestConfig { cases: wanted.unwrap_or(256), rng_seed, failure_persistence: None, ..ProptestConfig::default() }
}

/// Up to six changes, each of one byte, a cut or a doubled stretch, at a part (0..1) of the file.
pub(crate) fn damage() -> impl Strategy<Value = Vec<(f64, u8, u8)>> {
    prop::collection::vec((0.0..1.0f64, any::<u8>(), any::<u8>()), 1..6)
}

pub(crate) fn damaged(mut bytes: Vec<u8>, changes: &[(f64, u8, u8)]) -> Vec<u8> {
    for &(place, kind, value) in changes {
        let at = (place * bytes.len() as f64) as usize;
        match kind % 8 {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(at..(at + usize::from(value)).min(bytes.len()))),
            2 => bytes.extend_from_within(at..(at + usize::from(value)).min(bytes.len())),
            // Letters, digits and signs keep texts readable for longer.
            3 | 4 if at < bytes.len() => bytes[at] = b"0123456789-.eN {}\n,:"[usize::from(value) % 20],
            _ if at < bytes.len() => bytes[at] = value,
            _ => {}
        }
    }
    bytes
}

fn text(name: &str, changes: &[(f64, u8, u8)]) -> String {
    String::from_utf8_lossy(&damaged(fixture(name), changes)).into_owned()
}

/// Reads all of an archive that may be damaged.
fn read_npz(bytes: &[u8]) {
    let path = Path::new("damaged.npz");
    if let Ok(npz) = Npz::new(path, bytes) {
        let _ = parse_amass(path, &npz, "damaged", None);
        let _ = CanonicalPrimitive::parse(path, &npz);
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn damaged_texts(changes in damage()) {
        let path = Path::new("damaged");
        let _ = parse_bvh(path, &text("motion/small.bvh", &changes), "damaged");
        if let Ok(bvh) = Bvh::parse(path, &text("motion/named.bvh", &changes)) {
            let _ = parse_named(path, &bvh, "damaged");
        }
        let _ = parse_expmap(path, &text("motion/expmap.txt", &changes), "damaged");
        let good = parse_asf(path, &text("importers/small.asf", &[])).unwrap();
        let _ = parse_amc(path, &text("importers/small.amc", &changes), &good, "damaged", None);
        if let Ok(skeleton) = parse_asf(path, &text("importers/small.asf", &changes)) {
            let _ = parse_amc(path, &text("importers/small.amc", &[]), &skeleton, "damaged", None);
        }
    }

    #[test]
    fn damaged_pickles(changes in damage()) {
        for name in ["samp2.pkl", "samp4.pkl", "samp5.pkl", "samp_python2.pkl"] {
            let _ = parse_samp(Path::new(name), &damaged(fixture(&format!("importers/{name}")), &changes), "damaged", None);
        }
    }

    #[test]
    fn damaged_archives(changes in damage()) {
        for name in ["smplx.npz", "smplh.npz", "canonical.npz"] {
            read_npz(&damaged(fixture(&format!("importers/{name}")), &changes));
        }
    }

    /// Damage within entries whose checksums are right again.
    #[test]
    fn damaged_arrays(changes in damage(), which in 0..9usize) {
        for name in ["smplx.npz", "smplh.npz", "canonical.npz"] {
            let bytes = fixture(&format!("importers/{name}"));
            let archive = Archive::new(&bytes).unwrap();
            let names: Vec<String> = archive.names().map(String::from).collect();
            let mut entries: Vec<(String, Vec<u8>)> = names.into_iter().map(|n| (n.clone(), archive.read(&n).unwrap())).collect();
            let entry = &mut entries[which % archive.names().count()].1;
            *entry = damaged(std::mem::take(entry), &changes);
            read_npz(&pack(&entries));
        }
    }

    #[test]
    fn damaged_checkpoints(changes in damage(), which in 0..5usize) {
        let name = ["vposer_v1.pt", "vposer_v2.ckpt", "predictor.ckp", "regressor.ckp", "policy.pth"][which];
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        std::fs::write(&path, damaged(fixture(&format!("assets/{name}")), &changes)).unwrap();
        let error = match which {
            0 | 1 => PosePrior::load(&path).err(),
            2 => read_predictor(&path).err(),
            3 => read_regressor(&path).err(),
            _ => read_policy(&path).err(),
        };
        if let Some(error) = error {
            prop_assert!(error.to_string().contains(name), "{error}");
        }
    }

    /// The same of a body; its markers are among the few vertices.
    #[test]
    fn damaged_bodies(changes in damage(), which in 0..12usize) {
        let (bytes, markers) = few_vertices();
        let archive = Archive::new(&bytes).unwrap();
        let names: Vec<String> = archive.names().map(String::from).collect();
        let mut entries: Vec<(String, Vec<u8>)> = names.into_iter().map(|n| (n.clone(), archive.read(&n).unwrap())).collect();
        let at = which % entries.len();
        entries[at].1 = damaged(std::mem::take(&mut entries[at].1), &changes);
        for bytes in [pack(&entries), damaged(bytes.clone(), &changes)] {
            if let Err(error) = parse(Path::new("damaged.npz"), &bytes, &markers) {
                prop_assert!(error.to_string().contains("damaged.npz"), "{error}");
            }
        }
    }

    /// Meshes; the undamaged files beside them stay within reach.
    #[test]
    fn damaged_meshes(changes in damage()) {
        for name in ["table.obj", "cylinder.ply", "torus.ply", "wedge.ply", "tree.gltf", "scene.glb"] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/scenes").join(name);
            match Format::of(&path).unwrap().parse(&path, &damaged(fixture(&format!("scenes/{name}")), &changes), &MeshOptions::default()) {
                Ok(imported) => prop_assert!(imported.mesh.check().is_ok()),
                Err(error) => prop_assert!(error.to_string().contains("scenes"), "{error}"),
            }
        }
    }

    #[test]
    fn damaged_grids(changes in damage(), which in 0..2usize) {
        let name = ["authors.pkl", "authors.npz"][which];
        match SdfGrid::parse(Path::new(name), &damaged(fixture(&format!("scenes/{name}")), &changes)) {
            Ok(grid) => prop_assert!(grid.check().is_ok()),
            Err(error) => prop_assert!(error.to_string().contains(name), "{error}"),
        }
    }

    #[test]
    fn any_header(header in "\\{'descr': '[<>|]?[fiubSUOV][0-9]{0,20}', 'fortran_order': (True|False), 'shape': \\([0-9, ]{0,30}\\), \\}") {
        let bytes = [b"\x93NUMPY\x01\0".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes(), &[0; 64]].concat();
        if let Ok((dtype, shape, fortran, data)) = parse_npy(&bytes) {
            let _ = Array::decode(&dtype, shape, fortran, data);
        }
    }
}
