use super::*;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::PathBuf;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/scenes").join(name)
}

/// In the file's own axes and units.
const AS_IT_IS: MeshOptions = MeshOptions { up: Some(Up::Z), unit: Some(1.0) };

fn json(name: &str) -> serde_json::Map<String, Value> {
    serde_json::from_slice(&fs::read(fixture(name)).unwrap()).unwrap()
}

/// Compares a mesh with what another program read; `tolerance` is of counts and relative, of lengths and areas 1e-4.
fn same(mesh: &TriMesh, want: &Value, tolerance: f64, name: &str) {
    let number = |key: &str| want[key].as_f64().unwrap();
    let close = |key: &str, got: f64, tolerance: f64| {
        assert!((got - number(key)).abs() <= tolerance * number(key).abs(), "{name}: {key} {got}, expected {}", number(key));
    };
    close("triangles", mesh.triangles.len() as f64, tolerance);
    close("area", mesh.area().into(), 1e-4);
    let volume = (0..mesh.triangles.len()).map(|i| mesh.corners(i).map(|v| v.as_dvec3())).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum();
    close("volume", volume, 1e-4);
    let places: BTreeSet<[i64; 3]> = mesh.vertices.iter().map(|v| v.to_array().map(|x| (f64::from(x) * 1e3).round() as i64)).collect();
    close("places", places.len() as f64, tolerance);
    let (low, high) = mesh.bounds().unwrap();
    for (got, want) in [low, high].iter().zip(want["bounds"].as_array().unwrap()) {
        let want = Vec3::from([0, 1, 2].map(|axis| want[axis].as_f64().unwrap() as f32));
        assert!((got - want).length() <= 1e-5 * (1.0 + want.length()), "{name}: bounds {got}, expected {want}");
    }
}

#[test]
fn small_files_as_others_read_them() {
    for (name, want) in &json("meshes.json") {
        same(&read_mesh(fixture(name), &AS_IT_IS).unwrap().mesh, want, 0.0, name);
    }
}

#[test]
fn furniture_as_others_read_it() {
    let Some(dir) = crate::scene::furniture::unpacked() else { return };
    for (name, want) in &json("furniture.json") {
        // Where slivers and equal places end depends on rounding.
        same(&read_mesh(dir.path().join("scenes").join(name), &AS_IT_IS).unwrap().mesh, want, 2e-3, name);
        let metres = read_mesh(dir.path().join("scenes").join(name), &MeshOptions::default()).unwrap();
        let (low, high) = metres.mesh.bounds().unwrap();
        let size = high - low;
        assert!(size.max_element() < 3.0 && size.min_element() > 0.2, "{name} is {size}");
    }
}

#[test]
fn parts_of_an_obj() {
    let Imported { mesh, up, unit, degenerate, warnings } = read_mesh(fixture("table.obj"), &MeshOptions::default()).unwrap();
    // 135 units large: centimetres. Five corners make three triangles and four make two; one more has two corners in one place.
    assert_eq!((up, unit, degenerate, mesh.triangles.len(), mesh.vertices.len()), (Up::Y, 0.01, 1, 6, 9));
    assert!(warnings.len() == 1 && warnings[0].contains("135 units large and taken to be in centimetres"), "{warnings:?}");
    assert_eq!((mesh.objects.as_slice(), mesh.object.as_slice()), (&["top".to_string(), "leg".into()][..], &[0, 0, 0, 1, 1, 0][..]));
    let materials: Vec<(&str, [f32; 4])> = mesh.materials.iter().map(|m| (m.name.as_str(), m.color)).collect();
    assert_eq!(materials, [("oak", [0.6, 0.4, 0.2, 0.5]), ("steel", [0.5, 0.5, 0.6, 0.75]), ("none", GREY)]);
    // (75, 70, 0) with y up in centimetres; the top looks up.
    assert_eq!(mesh.vertices[3], Vec3::new(75.0, 0.0, 70.0) * 0.01);
    let [a, b, c] = mesh.corners(0);
    assert!((b - a).cross(c - a).normalize().z > 0.999);
}

#[test]
fn parts_of_a_gltf() {
    let Imported { mesh, unit, warnings, .. } = read_mesh(fixture("tree.gltf"), &MeshOptions::default()).unwrap();
    assert_eq!((unit, warnings.len(), mesh.objects.join(" ")), (1.0, 0, "pyramid mirrored sail".into()));
    assert_eq!(mesh.materials.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), ["brass", "default"]);
    assert_eq!((mesh.object[0], mesh.object[6], mesh.object[12], mesh.material[12]), (0, 1, 2, 1));
    // The tip (0.5, 0.5, 1) twice as large, turned by a right angle about y, (z, y, -x), moved by (1, 2, 3): (3, 3, 2); then z up.
    let tip = mesh.vertices.iter().find(|v| (**v - Vec3::new(3.0, -2.0, 3.0)).length() < 1e-5);
    assert!(tip.is_some(), "{:?}", mesh.vertices);
    let volume: f32 = (6..12).map(|i| mesh.corners(i)).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum();
    assert!((volume - 1.0 / 3.0).abs() < 1e-4, "a mirrored mesh faces outwards: {volume}");
}

#[test]
fn axes_and_units() {
    // All are rotations: y x z of the file stays right-handed, and the named axis ends on z.
    for (up, axis) in
        [(Up::X, Vec3::X), (Up::NegX, -Vec3::X), (Up::Y, Vec3::Y), (Up::NegY, -Vec3::Y), (Up::Z, Vec3::Z), (Up::NegZ, -Vec3::Z)]
    {
        assert_eq!(up.turn(axis), Vec3::Z);
        assert_eq!(up.turn(Vec3::X).cross(up.turn(Vec3::Y)), up.turn(Vec3::Z));
    }
    let read = |scale: f32, options: MeshOptions| {
        let text = format!("v 0 0 0\nv {scale} 0 0\nv 0 {} 0\nf 1 2 3\n", 0.5 * scale);
        Format::Obj.parse(Path::new("a.obj"), text.as_bytes(), &options)
    };
    let unit = |scale| read(scale, MeshOptions::default()).map(|i| (i.unit, i.warnings.len()));
    assert_eq!((unit(4.0).unwrap(), unit(400.0).unwrap(), unit(4000.0).unwrap()), ((1.0, 0), (0.01, 1), (0.001, 1)));
    for scale in [0.01, 1e6] {
        let message = unit(scale).unwrap_err().to_string();
        assert!(message.contains("a.obj") && message.contains("give unit"), "{message}");
    }
    let stated = read(0.01, MeshOptions { unit: Some(100.0), up: None }).unwrap();
    assert_eq!((stated.unit, stated.warnings.len()), (100.0, 0));
    assert!(read(400.0, MeshOptions { unit: Some(1.0), up: None }).unwrap().warnings[0].contains("400 m large"));
    assert!(read(1.0, MeshOptions { unit: Some(0.0), up: None }).unwrap_err().to_string().contains("unit = 0"));
    let text = fs::read_to_string(fixture("tree.gltf")).unwrap().replace("-1,\n    0", "-900,\n    0");
    let message = Format::Gltf.parse(&fixture("tree.gltf"), text.as_bytes(), &MeshOptions::default()).unwrap_err().to_string();
    assert!(message.contains("units large, which in metres would be no scene"), "{message}");
    let options: MeshOptions = serde_json::from_str(r#"{"up": "-y", "unit": 0.01}"#).unwrap();
    assert_eq!(options, MeshOptions { up: Some(Up::NegY), unit: Some(0.01) });
}

fn refused(format: Format, bytes: &[u8]) -> String {
    let path = fixture("bad.file");
    let message = format.parse(&path, bytes, &AS_IT_IS).unwrap_err().to_string();
    assert!(message.contains("bad.file"), "{message}");
    message
}

#[test]
fn bad_texts_are_refused() {
    for (text, want) in [
        ("", "has no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no triangles"),
        ("v 0 0\n", "line 1: vertex '0 0' has 2 coordinates"),
        ("v 0 0 nan\n", "line 1: coordinate 'nan' is no finite number"),
        ("v 0 0 x\n", "coordinate 'x'"),
        ("v 0 0 0\n\nf 1 2 3\n", "line 3: a face names vertex 2, but 1 vertices come before it"),
        ("v 0 0 0\nf 1 -2 1\n", "names vertex -2"),
        ("v 0 0 0\nf 0 1 1\n", "names vertex 0"),
        ("v 0 0 0\nf 1 a 1\n", "corner 'a' has no whole number"),
        ("v 0 0 0\nf 1 1 1\n", "only triangles without area (1)"),
        ("v 0 0 0\nf\n", "a face without corners"),
    ] {
        let message = refused(Format::Obj, text.as_bytes());
        assert!(message.contains(want), "{text:?}: {message}");
    }
    let path = Path::new("no/such.stl");
    assert!(read_mesh(path, &AS_IT_IS).unwrap_err().to_string().contains("expected .gltf, .glb, .obj or .ply"));
    assert!(read_mesh(fixture("none.ply"), &AS_IT_IS).unwrap_err().to_string().contains("none.ply"));
}

#[test]
fn bad_plys_are_refused() {
    let torus = fs::read(fixture("torus.ply")).unwrap();
    assert!(refused(Format::Ply, &torus[..torus.len() - 5]).contains("the file ends within it"));
    assert!(refused(Format::Ply, b"").contains("does not begin with 'ply'"));
    assert!(refused(Format::Ply, &torus[..100]).contains("has no 'end_header'"));
    let ascii = String::from_utf8(fs::read(fixture("cylinder.ply")).unwrap()).unwrap();
    for (from, to, want) in [
        ("format ascii", "format middle_endian", "has format 'middle_endian'"),
        ("element vertex 26", "element vertex many", "declares 'many' of element vertex"),
        ("property list uchar", "property list float9", "property that is not known"),
        ("element face 48", "element face 0", "has no triangles"),
        ("property double z", "property double w", "has no coordinate z"),
        ("\n3 0", "\n3 99", "names vertex 99, but there are 26"),
        ("\n3 0", "\n3 -1", "names vertex -1, expected a whole number from 0"),
        ("\n3 0", "\n3 0.5", "names vertex 0.5"),
        ("\n3 0", "\n3 none", "has 'none', expected a number"),
        ("\n0 0 0.5", "\n0 inf 0.5", "expected finite numbers"),
    ] {
        assert!(ascii.contains(from), "{from}");
        let message = refused(Format::Ply, ascii.replacen(from, to, 1).as_bytes());
        assert!(message.contains(want), "{to}: {message}");
    }
}

#[test]
fn bad_gltfs_are_refused() {
    let glb = fs::read(fixture("scene.glb")).unwrap();
    for (bytes, want) in [
        (&glb[..glb.len() - 4], "is cut off"),
        (&glb[..10], "is cut off within its header"),
        (b"glTF\x01\0\0\0\0\0\0\0", "is glTF 1"),
        (b"glTF\x02\0\0\0\x0c\0\0\0", "has no JSON chunk"),
        (b"{", "is no glTF 2.0"),
        (b"{}", "has no triangles"),
    ] {
        let message = refused(Format::Gltf, bytes);
        assert!(message.contains(want), "{message}");
    }
    let text = fs::read_to_string(fixture("tree.gltf")).unwrap();
    for (from, to, want) in [
        ("\"count\": 18", "\"count\": 19", "mesh 0 ('pyramid'), primitive 0: accessor 1 reaches beyond its buffer"),
        ("\"count\": 5", "\"count\": 4", "names vertex 4, but there are 4"),
        ("\"componentType\": 5126", "\"componentType\": 5130", "has component type 5130"),
        ("\"byteOffset\": 60", "\"byteOffset\": 600", "reaches beyond its buffer of 96 bytes"),
        ("\"byteLength\": 96", "\"byteLength\": 97", "buffer 0 has 96 bytes, expected 97"),
        ("\"mesh\": 1", "\"mesh\": 9", "names mesh 9, but has 2"),
        ("\"scene\": 1", "\"scene\": 2", "names scene 2, but has 2"),
        ("\"children\": [\n    1", "\"children\": [\n    0", "node 0 has two parents or is below itself"),
        ("base64,", "base32,", "buffer 1 is no base64"),
        ("tree.bin", "https://example.org/tree.bin", "only files on disk are read"),
        (
            "\"asset\"",
            "\"extensionsRequired\": [\"KHR_draco_mesh_compression\"],\n\"asset\"",
            "needs the extension KHR_draco_mesh_compression",
        ),
        ("\"bufferView\": 0", "\"sparse\": {}", "accessor 0 is sparse"),
        ("\"rotation\": [\n    0,", "\"rotation\": [\n    1e39,", "expected finite"),
        (
            "\"rotation\": [\n    0,\n    0.7071067811865476,\n    0,\n    0.7071067811865476",
            "\"rotation\": [0, 0, 0, 0",
            "expected finite",
        ),
    ] {
        assert!(text.contains(from), "{from}");
        let message = refused(Format::Gltf, text.replacen(from, to, 1).as_bytes());
        assert!(message.contains(want), "{to}: {message}");
    }
    let message = Format::Gltf.parse(Path::new("no/tree.gltf"), text.as_bytes(), &AS_IT_IS).unwrap_err().to_string();
    assert!(message.contains("no/tree.bin"), "{message}");
}

#[test]
fn strips_and_fans() {
    // Four corners of a unit square at z = 0, looking along +z: as a strip and as a fan.
    for (mode, corners) in [
        (5, "AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAACAPwAAgD8AAAAA"),
        (6, "AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAACAPwAAgD8AAAAAAAAAAAAAgD8AAAAA"),
    ] {
        let text = format!(
            r#"{{"nodes": [{{"mesh": 0}}], "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0}}, "mode": {mode}}}]}}],
            "accessors": [{{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4}}], "bufferViews": [{{"buffer": 0, "byteLength": 48}}],
            "buffers": [{{"byteLength": 48, "uri": "data:;base64,{corners}"}}]}}"#
        );
        let mesh = Format::Gltf.parse(Path::new("a.gltf"), text.as_bytes(), &AS_IT_IS).unwrap().mesh;
        assert_eq!((mesh.triangles.len(), mesh.area()), (2, 1.0));
        for i in 0..2 {
            let [a, b, c] = mesh.corners(i);
            assert_eq!((b - a).cross(c - a), Vec3::Z, "mode {mode}");
        }
    }
}

/// As many triangles as are read, and one more.
#[test]
#[ignore = "needs a gigabyte; run by name"]
fn ten_million_triangles() {
    let ply = |count: usize| {
        let header = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {0}\nproperty float x\nproperty float y\nproperty float z\nelement face {count}\nproperty list uchar int vertex_indices\nend_header\n",
            count + 2
        );
        let mut bytes = header.into_bytes();
        for i in 0..count + 2 {
            let (turn, height) = (i as f32 * 0.01, i as f32 * 2e-7);
            [turn.cos(), turn.sin(), height].iter().for_each(|v: &f32| bytes.extend(v.to_le_bytes()));
        }
        for i in 0..count as i32 {
            bytes.push(3);
            [i, i + 1, i + 2].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        bytes
    };
    assert_eq!(Format::Ply.parse(Path::new("a.ply"), &ply(MAX_TRIANGLES), &AS_IT_IS).unwrap().mesh.triangles.len(), MAX_TRIANGLES);
    assert!(refused(Format::Ply, &ply(MAX_TRIANGLES + 1)).contains("has more than 10000000 triangles, the most that are read"));
}
