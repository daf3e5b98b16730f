//! Walkable polygons from files: JSON rings, GeoJSON and WKT; and from navigation meshes.

use super::rings::{crossing, signed_area};
use super::walkable::outline;
use super::{Grid, Polygon, TriMesh};
use crate::{Error, Result};
use glam::DVec2;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Cells of a navigation mesh whose borders do not close, metres.
const NAVMESH_CELL: f64 = 0.02;

/// The rings of one polygon: the exterior, then its holes.
type Rings = Vec<Vec<DVec2>>;

/// Reads a walkable polygon: JSON (`[[x, y], ...]`, a list of such rings, `{"exterior", "holes"}`, or GeoJSON's Polygon or
/// MultiPolygon) or WKT (`POLYGON`, `MULTIPOLYGON`), metres. Of several polygons the one with the largest exterior is kept; closing
/// points and third coordinates are left out.
///
/// Errors: unknown forms, numbers that are not finite, rings that cross themselves.
pub fn read_polygon(path: &Path) -> Result<Polygon> {
    parse_polygon(path, &fs::read(path).map_err(|e| Error::io(path, e))?)
}

/// [`read_polygon`] of a file's content; `path` names it in errors.
pub(crate) fn parse_polygon(path: &Path, bytes: &[u8]) -> Result<Polygon> {
    let text = std::str::from_utf8(bytes).map_err(|e| Error::file(path, format!("is no text: {e}")))?;
    let text = text.trim_start_matches('\u{feff}').trim();
    let polygons = match text.starts_with(['[', '{']) {
        true => serde_json::from_str::<Value>(text).map_err(|e| format!("is no JSON: {e}")).and_then(|v| from_json(&v)),
        false => from_wkt(text),
    };
    polygons.and_then(largest).map_err(|e| Error::file(path, e))
}

/// The walkable polygon of a navigation mesh: the union of its triangles seen from above, the largest part of it.
pub fn navmesh_polygon(mesh: &TriMesh) -> Result<Polygon> {
    let triangles: Vec<[DVec2; 3]> = (0..mesh.triangles.len()).map(|i| mesh.corners(i).map(|v| v.truncate().as_dvec2())).collect();
    union(&triangles).map_err(|e| Error::invalid(format!("no navigation mesh: {e}")))
}

/// The union of triangles by their outer edges where these close to simple rings, by cells otherwise.
fn union(triangles: &[[DVec2; 3]]) -> Result<Polygon> {
    match border(triangles).map(largest) {
        Some(Ok(polygon)) => Ok(polygon),
        _ => {
            let all = || triangles.iter().flatten();
            let (low, high) = (all().fold(DVec2::INFINITY, |m, &p| m.min(p)), all().fold(DVec2::NEG_INFINITY, |m, &p| m.max(p)));
            let mut grid = Grid::covering(low, high, NAVMESH_CELL, 2.0 * NAVMESH_CELL)?;
            triangles.iter().for_each(|t| grid.fill(t, true));
            let part = grid.closed(NAVMESH_CELL).largest_part().ok_or_else(|| Error::invalid("it covers no floor"))?;
            outline(&part, 0.6 * NAVMESH_CELL)
        }
    }
}

/// The rings of the edges that only one triangle has, the triangles on their left; None where they branch.
fn border(triangles: &[[DVec2; 3]]) -> Option<Vec<Rings>> {
    let key = |p: DVec2| ((p.x * 1e4).round() as i64, (p.y * 1e4).round() as i64);
    let mut points = BTreeMap::new();
    let mut edges = BTreeSet::new();
    for t in triangles {
        let ccw = if signed_area(t) < 0.0 { [t[0], t[2], t[1]] } else { *t };
        points.extend(ccw.map(|p| (key(p), p)));
        for k in 0..3 {
            let (a, b) = (key(ccw[k]), key(ccw[(k + 1) % 3]));
            // The other side of an edge takes both away; the same side twice means that triangles lie on each other.
            if a != b && !edges.remove(&(b, a)) && !edges.insert((a, b)) {
                return None;
            }
        }
    }
    let mut next: BTreeMap<_, _> = BTreeMap::new();
    for (a, b) in edges {
        if next.insert(a, b).is_some() {
            return None;
        }
    }
    let mut rings: Vec<Vec<DVec2>> = Vec::new();
    while let Some((start, mut at)) = next.pop_first() {
        let mut ring = vec![points[&start]];
        while at != start {
            ring.push(points[&at]);
            at = next.remove(&at)?;
        }
        rings.push(ring);
    }
    Some(nest(rings))
}

/// Exteriors, which turn counter-clockwise, each with the holes within.
fn nest(rings: Vec<Vec<DVec2>>) -> Vec<Rings> {
    let (outer, inner): (Vec<_>, Vec<_>) = rings.into_iter().partition(|r| signed_area(r) > 0.0);
    let mut polygons: Vec<Rings> = outer.into_iter().map(|r| vec![r]).collect();
    for hole in inner {
        let owner = polygons.iter_mut().filter(|p| Polygon::new(p[0].clone(), vec![]).is_ok_and(|p| p.contains(hole[0])));
        if let Some(owner) = owner.min_by(|p, q| signed_area(&p[0]).total_cmp(&signed_area(&q[0]))) {
            owner.push(hole);
        }
    }
    polygons
}

/// The checked polygon with the largest exterior.
fn largest(mut polygons: Vec<Rings>) -> std::result::Result<Polygon, String> {
    let mut size: Vec<(usize, f64)> = polygons.iter().map(|p| p.first().map_or(0.0, |r| signed_area(r).abs())).enumerate().collect();
    size.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut rings = polygons.swap_remove(size.first().ok_or("holds no polygon")?.0);
    for ring in &mut rings {
        if ring.len() > 1 && ring.first() == ring.last() {
            ring.pop();
        }
        ring.dedup();
    }
    let exterior = if rings.is_empty() { Vec::new() } else { rings.remove(0) };
    let polygon = Polygon::new(exterior, rings).map_err(|e| e.to_string())?;
    check_simple(&polygon)?;
    Ok(polygon)
}

/// Refuses rings that cross or touch themselves (two rings may overlap).
pub(crate) fn check_simple(polygon: &Polygon) -> std::result::Result<(), String> {
    for (i, ring) in polygon.rings().enumerate() {
        if let Some(p) = crossing(&[ring]) {
            let name = if i == 0 { "the exterior ring".to_string() } else { format!("hole {}", i - 1) };
            return Err(format!("{name} crosses or touches itself near ({}, {}), expected a simple ring", p.x, p.y));
        }
    }
    Ok(())
}

fn from_json(value: &Value) -> std::result::Result<Vec<Rings>, String> {
    if let Some(object) = value.as_object() {
        return match object.get("type").and_then(Value::as_str) {
            Some("Polygon") => Ok(vec![rings(&value["coordinates"])?]),
            Some("MultiPolygon") => list(&value["coordinates"])?.iter().map(rings).collect(),
            Some("Feature") => from_json(&value["geometry"]),
            Some(other) => Err(format!("has type '{other}', expected Polygon or MultiPolygon")),
            None => {
                if let Some(key) = object.keys().find(|k| !["exterior", "holes"].contains(&k.as_str())) {
                    return Err(format!("has the unknown key '{key}', expected exterior and holes, or GeoJSON's type and coordinates"));
                }
                let holes = object.get("holes").map_or_else(|| Ok(Vec::new()), rings)?;
                Ok(vec![std::iter::once(ring(&value["exterior"])?).chain(holes).collect()])
            }
        };
    }
    // One ring, or a list of rings.
    let nested = value[0][0].is_array();
    Ok(vec![if nested { rings(value)? } else { vec![ring(value)?] }])
}

fn list(value: &Value) -> std::result::Result<&Vec<Value>, String> {
    value.as_array().ok_or_else(|| format!("holds {value}, expected a list"))
}

fn rings(value: &Value) -> std::result::Result<Rings, String> {
    list(value)?.iter().map(ring).collect()
}

fn ring(value: &Value) -> std::result::Result<Vec<DVec2>, String> {
    let point = |v: &Value| match v.as_array().map(Vec::as_slice) {
        Some([x, y] | [x, y, _]) => x.as_f64().zip(y.as_f64()).map(DVec2::from),
        _ => None,
    };
    list(value)?.iter().map(|v| point(v).ok_or_else(|| format!("holds {v}, expected a point [x, y]"))).collect()
}

/// `POLYGON ((x y, ...), ...)` or `MULTIPOLYGON (((x y, ...), ...), ...)`, with or without `SRID=...;` and `Z`.
fn from_wkt(text: &str) -> std::result::Result<Vec<Rings>, String> {
    let text = text.rsplit(';').next().unwrap_or(text).trim().to_ascii_uppercase();
    let (name, body) = text.find('(').map_or((text.as_str(), ""), |at| text.split_at(at));
    let multi = match name.trim().trim_end_matches(['Z', 'M']).trim() {
        "POLYGON" => false,
        "MULTIPOLYGON" => true,
        _ => return Err("is neither JSON nor WKT: expected [[x, y], ...], POLYGON ((...)) or MULTIPOLYGON (((...)))".into()),
    };
    let inner = within(body)?;
    let polygons = if multi { groups(inner)? } else { vec![body] };
    let ring = |text: &str| text.split(',').map(wkt_point).collect::<std::result::Result<Vec<_>, _>>();
    polygons.into_iter().map(|p| groups(within(p)?)?.into_iter().map(|r| ring(within(r)?)).collect()).collect()
}

fn wkt_point(text: &str) -> std::result::Result<DVec2, String> {
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|n| n.parse().ok()).collect();
    match numbers.as_deref() {
        Some([x, y] | [x, y, _] | [x, y, _, _]) => Ok(DVec2::new(*x, *y)),
        _ => Err(format!("holds '{}', expected a point as in 1.5 -2", text.trim())),
    }
}

/// What stands in the brackets that are all of `text`.
fn within(text: &str) -> std::result::Result<&str, String> {
    let text = text.trim();
    text.strip_prefix('(').and_then(|t| t.strip_suffix(')')).ok_or_else(|| "has brackets that do not close".into())
}

/// The bracketed groups of a list of them.
fn groups(text: &str) -> std::result::Result<Vec<&str>, String> {
    let (mut depth, mut start, mut out) = (0usize, 0, Vec::new());
    for (i, c) in text.char_indices() {
        match c {
            '(' => {
                if depth == 0 {
                    start = i;
                }
                depth += 1;
            }
            ')' => {
                depth = depth.checked_sub(1).ok_or("has brackets that do not close")?;
                if depth == 0 {
                    out.push(&text[start..=i]);
                }
            }
            _ => {}
        }
    }
    if depth == 0 { Ok(out) } else { Err("has brackets that do not close".into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Polygon> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("polygon.txt");
        fs::write(&path, text).unwrap();
        read_polygon(&path)
    }

    #[test]
    fn the_same_polygon_in_every_form() {
        let want = read("[[[0, 0], [4, 0], [4, 3], [0, 3]], [[1, 1], [1, 2], [2, 1]]]").unwrap();
        assert_eq!((want.exterior().len(), want.holes().len()), (4, 1));
        for text in [
            r#"{"exterior": [[0, 0], [4, 0], [4, 3], [0, 3]], "holes": [[[1, 1], [1, 2], [2, 1]]]}"#,
            r#"{"type": "Polygon", "coordinates": [[[0,0],[4,0],[4,3],[0,3],[0,0]], [[1,1],[1,2],[2,1],[1,1]]]}"#,
            r#"{"type": "MultiPolygon", "coordinates": [[[[9,9],[10,9],[9,10],[9,9]]],
                [[[0,0,7],[4,0,7],[4,3,7],[0,3,7],[0,0,7]], [[1,1],[1,2],[2,1],[1,1]]]]}"#,
            "POLYGON ((0 0, 4 0, 4 3, 0 3, 0 0), (1 1, 1 2, 2 1, 1 1))",
            "SRID=4326; polygon z((0 0 5, 4 0 5, 4 3 5, 0 3 5, 0 0 5),(1 1 5, 1 2 5, 2 1 5, 1 1 5))",
            "MULTIPOLYGON (((9 9, 10 9, 9 10, 9 9)), ((0 0, 4 0, 4 3, 0 3, 0 0), (1 1, 1 2, 2 1, 1 1)))",
        ] {
            assert_eq!(read(text).unwrap(), want, "{text}");
        }
        assert!(read("[[0, 0], [4, 0], [4, 3]]").unwrap().holes().is_empty());
    }

    #[test]
    fn bad_polygons_are_named() {
        for (text, word) in [
            ("[[0, 0], [4, 0], [NaN, 3]]", "is no JSON"),
            ("POLYGON ((0 0, 4 0, nan 3, 0 0))", "finite"),
            ("[[0, 0], [2, 2], [2, 0], [0, 1]]", "the exterior ring crosses or touches itself near"),
            ("[[[0, 0], [4, 0], [4, 4]], [[1, 0], [3, 2], [3, 0], [1, 1]]]", "hole 0 crosses"),
            ("[[0, 0], [1, 1]]", "2 points"),
            ("[]", "0 points"),
            ("[[0, 0], [1], [2, 1]]", "holds [1], expected a point"),
            (r#"{"exterior": [[0, 0], [4, 0], [4, 3]], "hole": []}"#, "unknown key 'hole'"),
            (r#"{"type": "Point", "coordinates": [0, 0]}"#, "type 'Point'"),
            ("POLYGON ((0 0, 4 0, 4 x, 0 0))", "holds '4 X'"),
            ("POLYGON ((0 0, 4 0, 4 4, 0 0)", "do not close"),
            ("POLYGON EMPTY", "neither JSON nor WKT"),
            ("MULTIPOLYGON ()", "no polygon"),
            ("LINESTRING (0 0, 1 1)", "neither JSON nor WKT"),
        ] {
            let e = read(text).unwrap_err().to_string();
            assert!(e.contains("polygon.txt: ") && e.contains(word), "{text}: {e}");
        }
    }

    #[test]
    fn navmeshes_keep_their_holes_and_their_largest_part() {
        // A 3 x 3 m frame of 1 m around a hole, as 16 triangles of either turn, and a far triangle.
        let p = |x: i32, y: i32| DVec2::new(x.into(), y.into());
        let mut triangles = vec![[p(9, 9), p(10, 9), p(9, 10)]];
        for (x, y) in (0..3).flat_map(|x| (0..3).map(move |y| (x, y))).filter(|c| *c != (1, 1)) {
            triangles.push([p(x, y), p(x + 1, y), p(x + 1, y + 1)]);
            triangles.push([p(x, y), p(x, y + 1), p(x + 1, y + 1)]);
        }
        let polygon = union(&triangles).unwrap();
        assert_eq!((signed_area(polygon.exterior()), polygon.holes().len()), (9.0, 1));
        assert_eq!(signed_area(&polygon.holes()[0]), -1.0);
        // Without shared corners the cells decide.
        triangles.push([p(0, 0), p(2, 0), p(2, 2)]);
        let cells = union(&triangles).unwrap();
        assert!((signed_area(cells.exterior()) - 9.0).abs() < 0.15 && cells.holes().len() == 1, "{}", signed_area(cells.exterior()));
        assert!(union(&[]).is_err());
    }
}
