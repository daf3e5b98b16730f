//! Damaged files of scenes: every reader answers with a value or an error, whatever the bytes are.

use super::bundle::tests::bundle;
use super::outline::parse_polygon;
use super::pairs::parse_pairs;
use super::{PICTURE, SceneBundle};
use crate::io::content_hash;
use crate::io::numpy::npy;
use crate::motion::fuzz::{config, damage, damaged};
use glam::Vec2;
use proptest::prelude::*;
use std::fs;
use std::path::Path;

const POLYGONS: [&str; 5] = [
    "[[[0, 0], [4, 0], [4, 3], [0, 3]], [[1, 1], [1, 2], [2, 1]]]",
    r#"{"exterior": [[0, 0], [4, 0], [4, 3], [0, 3]], "holes": [[[1, 1], [1, 2], [2, 1]]]}"#,
    r#"{"type": "MultiPolygon", "coordinates": [[[[9,9],[10,9],[9,10],[9,9]]], [[[0,0,7],[4,0,7],[4,3,7],[0,3,7],[0,0,7]]]]}"#,
    "POLYGON ((0 0, 4 0, 4 3, 0 3, 0 0), (1 1, 1 2, 2 1, 1 1))",
    "SRID=4326; MULTIPOLYGON z(((9 9 1, 10 9 1, 9 10 1, 9 9 1)), ((0 0 1, 4 0 1, 4 3 1, 0 3 1, 0 0 1)))",
];

/// Python's `pickle.dumps([[[0.5, 1.0], [2.0, -0.5]]], 2)`.
const PICKLE: &[u8] = b"\x80\x02]q\0]q\x01(]q\x02(G?\xe0\0\0\0\0\0\0G?\xf0\0\0\0\0\0\0e]q\x03(G@\0\0\0\0\0\0\0G\xbf\xe0\0\0\0\0\0\0eea.";

proptest! {
    #![proptest_config(config())]

    #[test]
    fn damaged_polygons(changes in damage(), which in 0..POLYGONS.len()) {
        let path = Path::new("area.txt");
        parse_polygon(path, POLYGONS[which].as_bytes()).unwrap();
        if let Err(error) = parse_polygon(path, &damaged(POLYGONS[which].into(), &changes)) {
            prop_assert!(error.to_string().contains("area.txt"), "{error}");
        }
    }

    #[test]
    fn damaged_pairs(changes in damage(), which in 0..2usize) {
        let values: Vec<u8> = [0.5f32, 1.0, 2.0, -0.5].iter().flat_map(|v| v.to_le_bytes()).collect();
        let bytes = [npy("<f4", &[1, 2, 2], &values), PICKLE.to_vec()][which].clone();
        let path = Path::new("pairs.npy");
        prop_assert_eq!(parse_pairs(path, &bytes).unwrap(), [[Vec2::new(0.5, 1.0), Vec2::new(2.0, -0.5)]]);
        match parse_pairs(path, &damaged(bytes, &changes)) {
            Ok(pairs) => prop_assert!(pairs.as_flattened().iter().all(|p| p.is_finite())),
            Err(error) => prop_assert!(error.to_string().contains("pairs.npy"), "{error}"),
        }
    }

    /// Either file, and the tensors under the hash that they then have.
    #[test]
    fn damaged_bundles(changes in damage(), which in 0..3usize) {
        thread_local!(static WHOLE: [Vec<u8>; 2] = {
            let dir = tempfile::tempdir().unwrap();
            bundle().write(&dir.path().join("scene"), b"").unwrap();
            ["scene.json", "scene.safetensors"].map(|name| fs::read(dir.path().join("scene").join(name)).unwrap())
        });
        let dir = tempfile::tempdir().unwrap();
        let [mut json, mut tensors] = WHOLE.with(Clone::clone);
        let hash = content_hash(&tensors);
        match which {
            0 => json = damaged(json, &changes),
            1 => tensors = damaged(tensors, &changes),
            _ => {
                tensors = damaged(tensors, &changes);
                json = String::from_utf8(json).unwrap().replace(&hash, &content_hash(&tensors)).into_bytes();
            }
        }
        fs::write(dir.path().join("scene.json"), json).unwrap();
        fs::write(dir.path().join("scene.safetensors"), tensors).unwrap();
        fs::write(dir.path().join(PICTURE), b"").unwrap();
        match SceneBundle::read(dir.path()) {
            Ok(bundle) => prop_assert!(bundle.mesh.is_none_or(|mesh| mesh.check().is_ok())),
            Err(error) => prop_assert!(error.to_string().contains("scene."), "{error}"),
        }
    }
}
