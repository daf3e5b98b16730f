//! Where people may walk in a mesh: floor, less what stands on it up to a person's height.

use super::rings::{crossing, simplify};
use super::{Grid, Polygon, TriMesh};
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// How the walkable area of a mesh is found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WalkableOptions {
    /// Height of the floor, metres; found where it is not given.
    pub floor: Option<f32>,
    /// Side of the cells that what stands on the floor is entered into, metres.
    pub cell: f64,
    /// What lies lower above the floor can be stepped on, metres.
    pub low: f64,
    /// What lies higher above the floor can be walked under, metres.
    pub high: f64,
    /// Slits of twice this width are closed, in what stands there and in the floor, metres.
    pub close: f64,
    /// The polygon may be off the cells' border by this much, metres.
    pub simplify: f64,
}

impl Default for WalkableOptions {
    fn default() -> Self {
        Self { floor: None, cell: 0.025, low: 0.05, high: 2.0, close: 0.05, simplify: 0.019 }
    }
}

impl WalkableOptions {
    /// Refuses values with which nothing could be found.
    pub fn validate(&self) -> Result<()> {
        let bad = |key: &str, right: &str| Err(Error::invalid(format!("walkable.{key}: expected {right}")));
        match self {
            Self { floor: Some(z), .. } if !z.is_finite() => bad("floor", "a height in metres"),
            Self { cell, .. } if !(0.005..=0.2).contains(cell) => bad("cell", "0.005 to 0.2 m"),
            Self { low, high, .. } if !(*low > 0.0 && low < high && high.is_finite()) => bad("low", "more than 0 and less than high"),
            Self { close, .. } if !(0.0..=0.5).contains(close) => bad("close", "0 to 0.5 m"),
            Self { simplify, .. } if !(0.0..=0.2).contains(simplify) => bad("simplify", "0 to 0.2 m"),
            _ => Ok(()),
        }
    }
}

/// A walkable area with what it was found from.
#[derive(Clone, Debug, PartialEq)]
pub struct Walkable {
    /// The largest part of the free floor; its rings do not cross.
    pub polygon: Polygon,
    /// Height of the floor, metres.
    pub floor: f32,
    /// Cells that cannot be walked on: no floor, or something stands there.
    pub blocked: Grid,
}

impl Walkable {
    /// The walkable area of `mesh`. A cell that a surface touches between `low` and `high` above the floor is blocked, so borders
    /// lie up to a cell before what stands there and never behind it.
    ///
    /// Errors: no floor, nothing free on it, or bad options.
    pub fn of_mesh(mesh: &TriMesh, options: &WalkableOptions) -> Result<Self> {
        options.validate()?;
        mesh.check()?;
        let floor = options.floor.map_or_else(|| floor_height(mesh), Ok)?;
        let free = free_cells(mesh, floor, options)?;
        let part = free.largest_part().filter(|part| part.area() >= MIN_AREA);
        let part = part.ok_or_else(|| {
            let (low, high) = (options.low, options.high);
            Error::invalid(format!(
                "no walkable area: of the floor at z = {floor:.2} m less than {MIN_AREA} m2 is free from {low} to {high} m above it"
            ))
        })?;
        Ok(Self { polygon: outline(&part, options.simplify)?, floor, blocked: part.inverse() })
    }
}

/// Least area that counts as a floor, and as walkable, square metres.
const MIN_AREA: f64 = 0.25;

/// Floor that nothing stands on, closed.
fn free_cells(mesh: &TriMesh, floor: f32, options: &WalkableOptions) -> Result<Grid> {
    let corners = |i: usize| mesh.corners(i).map(|v| v.as_dvec3());
    let (z, close) = (f64::from(floor), options.close);
    let (low, high) = (z + options.low, z + options.high);
    let ground: Vec<[DVec3; 3]> = (0..mesh.triangles.len()).map(corners).filter(|t| is_floor(t, z, options.low)).collect();
    if ground.is_empty() {
        return Err(Error::invalid(format!("no floor: the mesh has no flat surface at z = {floor:.2} m")));
    }
    let plan = || ground.iter().flatten().map(|v| v.truncate());
    let (from, to) = (plan().fold(DVec2::INFINITY, DVec2::min), plan().fold(DVec2::NEG_INFINITY, DVec2::max));
    let mut floor = Grid::covering(from, to, options.cell, 2.0 * close)?;
    let mut solid = floor.clone();
    ground.iter().for_each(|t| floor.fill(&t.map(|v| v.truncate()), true));
    let mut buffers = <[Vec<DVec3>; 2]>::default();
    for t in (0..mesh.triangles.len()).map(corners) {
        buffers[0].clear();
        buffers[0].extend(t);
        clip(&mut buffers, DVec3::Z, low);
        clip(&mut buffers, DVec3::NEG_Z, -high);
        touch(&mut solid, &mut buffers);
    }
    let (mut free, solid) = (floor.closed(close), solid.closed(close));
    free.cells.iter_mut().zip(solid.cells).for_each(|(f, s)| *f &= !s);
    Ok(free)
}

/// Whether a triangle is no steeper than 45 degrees and near the height `z`.
fn is_floor([a, b, c]: &[DVec3; 3], z: f64, slack: f64) -> bool {
    let normal = (b - a).cross(c - a);
    normal.z.abs() > 0.7 * normal.length() && [a, b, c].iter().all(|v| (v.z - z).abs() <= slack.max(0.1))
}

/// Cuts off what of the convex polygon in the first buffer lies below `bound` along `axis` (Sutherland and Hodgman 1974).
fn clip(buffers: &mut [Vec<DVec3>; 2], axis: DVec3, bound: f64) {
    let [from, to] = buffers;
    to.clear();
    for (i, &b) in from.iter().enumerate() {
        let a = from[(i + from.len() - 1) % from.len()];
        let (da, db) = (a.dot(axis) - bound, b.dot(axis) - bound);
        if (da >= 0.0) != (db >= 0.0) {
            to.push(a + (b - a) * (da / (da - db)));
        }
        if db >= 0.0 {
            to.push(b);
        }
    }
    buffers.swap(0, 1);
}

/// Sets every cell that the convex polygon in the first buffer touches, seen from above.
fn touch(grid: &mut Grid, buffers: &mut [Vec<DVec3>; 2]) {
    let whole = buffers[0].clone();
    let range = |values: &mut dyn Iterator<Item = f64>, lowest: f64, count: usize| {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = (((low - lowest) / grid.cell).floor(), ((high - lowest) / grid.cell).floor());
        let any = low <= high && high >= 0.0 && low < count as f64;
        any.then(|| low.max(0.0) as usize..=high.min(count as f64 - 1.0) as usize)
    };
    let Some(rows) = range(&mut whole.iter().map(|v| v.y), grid.lowest.y, grid.dims[1]) else { return };
    let mut set = Vec::new();
    for j in rows {
        let y = grid.lowest.y + j as f64 * grid.cell;
        buffers[0].clone_from(&whole);
        clip(buffers, DVec3::Y, y);
        clip(buffers, DVec3::NEG_Y, -(y + grid.cell));
        if let Some(columns) = range(&mut buffers[0].iter().map(|v| v.x), grid.lowest.x, grid.dims[0]) {
            let (first, last) = columns.into_inner();
            set.push(j * grid.dims[0] + first..=j * grid.dims[0] + last);
        }
    }
    set.into_iter().for_each(|cells| grid.cells[cells].fill(true));
}

/// The polygon of the set cells, which hang together; with fewer points as far as its rings then do not cross.
pub(crate) fn outline(part: &Grid, tolerance: f64) -> Result<Polygon> {
    let rings = part.contours();
    let mut tolerance = tolerance;
    loop {
        let fewer = |ring: &Vec<DVec2>| Some(simplify(ring, tolerance)).filter(|r| r.len() > 2).unwrap_or_else(|| ring.clone());
        let mut simple: Vec<Vec<DVec2>> = rings.iter().map(fewer).collect();
        let all: Vec<&[DVec2]> = simple.iter().map(Vec::as_slice).collect();
        if tolerance == 0.0 || crossing(&all).is_none() {
            let exterior = if simple.is_empty() { Vec::new() } else { simple.remove(0) };
            return Polygon::new(exterior, simple);
        }
        tolerance = if tolerance > 1e-3 { 0.5 * tolerance } else { 0.0 };
    }
}

/// The height of the lowest large flat surface that faces up (either way in a mesh where none does), metres.
///
/// Large is at least half as large as the largest at one height, within 5 cm.
pub fn floor_height(mesh: &TriMesh) -> Result<f32> {
    const BAND: f64 = 0.05;
    let flat = |i: usize| {
        let [a, b, c] = mesh.corners(i).map(|v| v.as_dvec3());
        let normal = (b - a).cross(c - a);
        (normal.z.abs() > 0.95 * normal.length()).then_some((normal.z / 2.0, (a.z + b.z + c.z) / 3.0))
    };
    let all: Vec<(f64, f64)> = (0..mesh.triangles.len()).filter_map(flat).collect();
    let up: Vec<(f64, f64)> = all.iter().copied().filter(|f| f.0 > 0.0).collect();
    let enough = |flats: &[(f64, f64)]| flats.iter().map(|f| f.0.abs()).sum::<f64>() >= MIN_AREA;
    let mut flats = if enough(&up) { up } else { all };
    if !enough(&flats) {
        return Err(Error::invalid(format!(
            "no floor: the mesh has less than {MIN_AREA} m2 of flat surface; is z up, and are these metres?"
        )));
    }
    flats.sort_by(|p, q| p.1.total_cmp(&q.1));
    // Of each surface: where the ones end that are at most a band higher, and the area of these.
    let (mut end, mut area) = (0, 0.0);
    let bands: Vec<(usize, f64)> = (0..flats.len())
        .map(|start| {
            while end < flats.len() && flats[end].1 - flats[start].1 <= BAND {
                area += flats[end].0.abs();
                end += 1;
            }
            let band = (end, area);
            area -= flats[start].0.abs();
            band
        })
        .collect();
    let largest = bands.iter().map(|b| b.1).fold(0.0, f64::max);
    let first = bands.iter().position(|b| b.1 >= 0.5 * largest).unwrap_or(0);
    // The fullest of the bands that begin in this one.
    let start = (first..bands[first].0).reduce(|p, q| if bands[q].1 > bands[p].1 { q } else { p }).unwrap_or(first);
    let band = &flats[start..bands[start].0];
    // The median by area: a few stray surfaces do not move it.
    let mut sum = 0.0;
    let median = band.iter().find(|f| {
        sum += f.0.abs();
        sum >= 0.5 * bands[start].1
    });
    Ok(median.unwrap_or(&flats[first]).1 as f32)
}

#[cfg(test)]
mod tests {
    use super::super::rings::signed_area;
    use super::*;
    use glam::{Affine3A, Vec2, Vec3};
    use serde_json::Value;

    /// A floor of 4 x 4 m with its surface at `z`.
    fn floor(z: f32) -> TriMesh {
        let mut mesh = TriMesh::new();
        let (object, grey) = (mesh.add_object("floor"), mesh.add_material("grey", [0.5, 0.5, 0.5, 1.0]));
        mesh.add_box(object, grey, Vec3::new(0.0, 0.0, z - 0.05), Vec3::new(4.0, 4.0, 0.1), 0.0);
        mesh
    }

    /// A square of 4 m2 at `z` that faces up.
    fn sheet(z: f32) -> TriMesh {
        let mut mesh = TriMesh::new();
        let (object, grey) = (mesh.add_object("sheet"), mesh.add_material("grey", [0.5; 4]));
        mesh.add_quad(object, grey, [Vec3::ZERO, Vec3::X * 2.0, Vec3::new(2.0, 2.0, 0.0), Vec3::Y * 2.0].map(|p| p.with_z(z)));
        mesh
    }

    fn found(mesh: &TriMesh) -> Walkable {
        Walkable::of_mesh(mesh, &WalkableOptions::default()).unwrap()
    }

    #[test]
    fn a_table_by_hand() {
        let mut mesh = floor(1.0);
        // A table top on two legs blocks its whole area, a lamp above it and a rug nothing.
        for (centre, size) in [
            (Vec3::new(0.5, 0.0, 1.725), Vec3::new(1.2, 0.8, 0.05)),
            (Vec3::new(0.0, 0.0, 1.35), Vec3::new(0.1, 0.1, 0.7)),
            (Vec3::new(1.0, 0.0, 1.35), Vec3::new(0.1, 0.1, 0.7)),
            (Vec3::new(0.0, 0.0, 3.3), Vec3::new(3.0, 3.0, 0.4)),
            (Vec3::new(-1.0, -1.0, 1.01), Vec3::new(1.5, 1.5, 0.02)),
        ] {
            mesh.add_box(0, 0, centre, size, 0.0);
        }
        let w = found(&mesh);
        assert!((w.floor - 1.0).abs() < 1e-6, "{}", w.floor);
        let [outer, hole] = [w.polygon.exterior(), &w.polygon.holes()[0]].map(signed_area);
        // Whole cells of 2.5 cm: the floor's border is theirs, the table grows by up to one on each side.
        assert!(w.polygon.holes().len() == 1 && (outer - 16.0).abs() < 0.25, "{outer}");
        assert!(-hole >= 0.96 - 1e-3 && -hole < 1.25 * 0.85 + 1e-3, "{hole}");
        assert!((w.polygon.border_distance(DVec2::new(0.5, 1.0)) - 0.6).abs() < 0.026);
        assert!((w.blocked.inverse().area() - (outer + hole)).abs() < 0.02);
    }

    #[test]
    fn floors_are_found() {
        // A table top of 3 m2 is less than half the floor, a ceiling faces down; turned over, only the lowest counts.
        let mut mesh = floor(-2.0);
        mesh.add_box(0, 0, Vec3::new(0.0, 0.0, -1.2), Vec3::new(3.0, 1.0, 0.1), 0.0);
        mesh.add_box(0, 0, Vec3::new(0.0, 0.0, 0.8), Vec3::new(4.0, 4.0, 0.1), 0.0);
        assert!((floor_height(&mesh).unwrap() + 2.0).abs() < 1e-6);
        // Wherever it is, also where a float's steps are metres.
        for z in [-3e20, -70_000.0, -0.013, 1e9, 1e30] {
            assert_eq!(floor_height(&sheet(z)).unwrap(), z);
        }
        // Noise of 1 cm: squares at heights of 0.4 m plus or minus that, and a stray one below.
        let mut noisy = sheet(0.385);
        (0..64).for_each(|i| noisy.append(&sheet(0.4 + 0.01 * (i as f32 * 2.4).sin()), Affine3A::IDENTITY));
        noisy.append(&sheet(0.1), Affine3A::IDENTITY);
        assert!((floor_height(&noisy).unwrap() - 0.4).abs() < 0.003, "{}", floor_height(&noisy).unwrap());
        let (mut flat, wall) = (TriMesh::new(), Vec3::new(0.0, 0.0, 3.0));
        flat.add_object("sheet");
        flat.add_material("grey", [0.5; 4]);
        flat.add_quad(0, 0, [Vec3::Y, Vec3::new(2.0, 1.0, 0.3), Vec3::new(2.0, 0.0, 0.3), Vec3::ZERO].map(|p| p.with_z(0.3)));
        assert!((floor_height(&flat).unwrap() - 0.3).abs() < 1e-6);
        let mut upright = TriMesh::new();
        upright.add_object("wall");
        upright.add_material("grey", [0.5; 4]);
        upright.add_quad(0, 0, [Vec3::ZERO, Vec3::X, Vec3::X + wall, wall]);
        assert!(floor_height(&upright).unwrap_err().to_string().contains("no floor"));
    }

    #[test]
    fn what_is_no_scene_is_refused() {
        let refused = |mesh: &TriMesh, options: &WalkableOptions| Walkable::of_mesh(mesh, options).unwrap_err().to_string();
        let mut full = floor(0.0);
        full.add_box(0, 0, Vec3::new(0.0, 0.0, 0.5), Vec3::new(5.0, 5.0, 1.0), 0.0);
        let at_zero = WalkableOptions { floor: Some(0.0), ..Default::default() };
        assert!(refused(&full, &at_zero).contains("no walkable area"));
        assert!(refused(&floor(0.0), &WalkableOptions { floor: Some(7.0), ..Default::default() }).contains("no floor"));
        assert!(refused(&floor(0.0), &WalkableOptions { cell: 1e-6, ..Default::default() }).contains("walkable.cell"));
        assert!(refused(&TriMesh::new(), &WalkableOptions::default()).contains("no triangles"));
    }

    /// Values by shapely: tests/tools/scenes/walkable.py.
    #[test]
    fn agrees_with_shapely() {
        let cases: Vec<Value> = serde_json::from_str(include_str!("../../tests/fixtures/scenes/walkable.json")).unwrap();
        assert!(cases.len() >= 30);
        for (i, case) in cases.iter().enumerate() {
            let get = |v: &Value| serde_json::from_value::<Vec2>(v.clone()).unwrap();
            let mut mesh = TriMesh::new();
            mesh.add_object("scene");
            mesh.add_material("grey", [0.5; 4]);
            mesh.add_box(0, 0, Vec3::new(0.0, 0.0, -0.05), get(&case["floor"]).extend(0.1), 0.0);
            for b in case["boxes"].as_array().unwrap() {
                let (z, yaw) = (get(&b["z"]), b["yaw"].as_f64().unwrap() as f32);
                mesh.add_box(0, 0, get(&b["centre"]).extend((z.x + z.y) / 2.0), get(&b["size"]).extend(z.y - z.x), yaw);
            }
            let polygon = Walkable::of_mesh(&mesh, &WalkableOptions { floor: Some(0.0), ..Default::default() }).unwrap().polygon;
            for q in case["points"].as_array().unwrap() {
                let p: DVec2 = serde_json::from_value(q["p"].clone()).unwrap();
                assert_eq!(polygon.contains(p), q["inside"].as_bool().unwrap(), "case {i}: {p}");
            }
            let large = polygon.holes().iter().filter(|h| -signed_area(h) > 0.05);
            assert_eq!(large.count() as u64, case["holes"].as_u64().unwrap(), "case {i}");
            let area = signed_area(polygon.exterior()) + polygon.holes().iter().map(|h| signed_area(h)).sum::<f64>();
            let off = (case["area"].as_f64().unwrap() - area) / case["length"].as_f64().unwrap();
            // Up to a cell before what blocks; the floor's own border is off either way by half a cell.
            assert!((-0.013..0.03).contains(&off), "case {i}: {off}");
        }
    }
}
