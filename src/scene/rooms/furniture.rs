//! Furniture as small closed meshes: every piece is boxes and prisms in a frame of its own, its back towards +y.

use crate::scene::rings::triangulate;
use crate::scene::{BoxObstacle, TriMesh};
use glam::{DVec2, Vec2, Vec3};
use rand::RngExt;
use std::f32::consts::TAU;

/// Corners of what is round.
const ROUND: usize = 16;

/// What a piece of furniture is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Table,
    RoundTable,
    Desk,
    Chair,
    Stool,
    Sofa,
    Bed,
    Shelf,
    Cabinet,
    Bench,
    Plant,
    Crate,
    Column,
    RoundColumn,
}

/// A piece of furniture in a room.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    pub kind: Kind,
    /// Width, depth and height, metres.
    pub size: Vec3,
    /// Middle of its footprint, metres.
    pub centre: Vec2,
    /// Turn about z, radians; at 0 its back is towards +y.
    pub yaw: f32,
}

/// Colours of a room.
pub struct Palette {
    wood: [f32; 4],
    fabric: [f32; 4],
}

impl Palette {
    /// Draws colours of wood and fabric.
    pub fn draw(rng: &mut impl RngExt) -> Self {
        const WOODS: [[f32; 3]; 4] = [[0.52, 0.34, 0.20], [0.67, 0.49, 0.31], [0.35, 0.22, 0.14], [0.78, 0.68, 0.54]];
        const FABRICS: [[f32; 3]; 6] =
            [[0.30, 0.38, 0.50], [0.55, 0.28, 0.26], [0.36, 0.45, 0.36], [0.60, 0.55, 0.48], [0.42, 0.34, 0.48], [0.70, 0.52, 0.28]];
        let opaque = |[r, g, b]: [f32; 3]| [r, g, b, 1.0];
        Self { wood: opaque(WOODS[rng.random_range(0..WOODS.len())]), fabric: opaque(FABRICS[rng.random_range(0..FABRICS.len())]) }
    }
}

impl Kind {
    /// The object's name in meshes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Table | Self::RoundTable => "table",
            Self::Desk => "desk",
            Self::Chair => "chair",
            Self::Stool => "stool",
            Self::Sofa => "sofa",
            Self::Bed => "bed",
            Self::Shelf => "shelf",
            Self::Cabinet => "cabinet",
            Self::Bench => "bench",
            Self::Plant => "plant",
            Self::Crate => "crate",
            Self::Column | Self::RoundColumn => "column",
        }
    }

    fn is_round(self) -> bool {
        matches!(self, Self::RoundTable | Self::Stool | Self::Plant | Self::RoundColumn)
    }

    /// Width, depth and height of a piece of ordinary size, drawn, metres.
    pub fn draw_size(self, rng: &mut impl RngExt) -> Vec3 {
        let mut within = |low: f32, high: f32| rng.random_range(low..high);
        match self {
            Self::Table => Vec3::new(within(1.2, 1.9), within(0.75, 0.95), within(0.72, 0.76)),
            Self::RoundTable => {
                let across = within(0.8, 1.2);
                Vec3::new(across, across, within(0.45, 0.75))
            }
            Self::Desk => Vec3::new(within(1.1, 1.6), within(0.6, 0.75), within(0.72, 0.76)),
            Self::Chair => Vec3::new(within(0.42, 0.5), within(0.44, 0.52), within(0.82, 0.98)),
            Self::Stool => {
                let across = within(0.32, 0.42);
                Vec3::new(across, across, within(0.42, 0.6))
            }
            Self::Sofa => Vec3::new(within(1.5, 2.2), within(0.82, 0.98), within(0.75, 0.9)),
            Self::Bed => Vec3::new(within(0.95, 1.7), within(1.95, 2.1), within(0.45, 0.55)),
            Self::Shelf => Vec3::new(within(0.7, 1.5), within(0.28, 0.4), within(1.5, 2.1)),
            Self::Cabinet => Vec3::new(within(0.7, 1.5), within(0.38, 0.5), within(0.6, 1.0)),
            Self::Bench => Vec3::new(within(1.0, 1.6), within(0.35, 0.45), within(0.42, 0.48)),
            Self::Plant => {
                let across = within(0.35, 0.55);
                Vec3::new(across, across, within(0.7, 1.5))
            }
            Self::Crate => Vec3::new(within(0.3, 0.6), within(0.3, 0.5), within(0.25, 0.6)),
            Self::Column => {
                let side = within(0.3, 0.55);
                Vec3::new(side, side, 2.6)
            }
            Self::RoundColumn => {
                let across = within(0.3, 0.6);
                Vec3::new(across, across, 2.6)
            }
        }
    }
}

impl Piece {
    /// The box round the piece.
    pub fn bounds(&self) -> BoxObstacle {
        BoxObstacle { centre: self.centre, size: self.size.truncate(), yaw: self.yaw, height: self.size.z }
    }

    /// What it takes of the floor, counter-clockwise.
    pub fn footprint(&self) -> Vec<DVec2> {
        match self.kind.is_round() {
            true => circle(self.centre.as_dvec2(), 0.5 * f64::from(self.size.x), f64::from(self.yaw)),
            false => self.bounds().corners().to_vec(),
        }
    }

    /// Adds the piece to a mesh as an object of its own, standing on z = 0.
    pub fn add_to(&self, mesh: &mut TriMesh, palette: &Palette) {
        let object = mesh.add_object(self.kind.name());
        Maker { mesh, piece: *self, object, palette }.make();
    }
}

/// The corners of a regular polygon whose corners lie on a circle.
fn circle(centre: DVec2, radius: f64, yaw: f64) -> Vec<DVec2> {
    (0..ROUND).map(|i| centre + radius * DVec2::from_angle(yaw + f64::from(TAU) * i as f64 / ROUND as f64)).collect()
}

/// Adds the closed prism over a simple counter-clockwise ring from height `low` to `high`.
pub fn add_prism(mesh: &mut TriMesh, object: u16, material: u16, ring: &[DVec2], low: f32, high: f32) {
    let (first, n) = (mesh.vertices.len() as u32, ring.len() as u32);
    for z in [low, high] {
        mesh.vertices.extend(ring.iter().map(|p| p.as_vec2().extend(z)));
    }
    for [a, b, c] in triangulate(ring).into_iter().map(|t| t.map(|i| first + i)) {
        mesh.push([a, c, b], object, material);
        mesh.push([a + n, b + n, c + n], object, material);
    }
    for i in 0..n {
        let (a, b) = (first + i, first + (i + 1) % n);
        mesh.push([a, b, b + n], object, material);
        mesh.push([a, b + n, a + n], object, material);
    }
}

/// Builds one piece in its own frame.
struct Maker<'a> {
    mesh: &'a mut TriMesh,
    piece: Piece,
    object: u16,
    palette: &'a Palette,
}

impl Maker<'_> {
    fn make(&mut self) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let wood = self.mesh.add_material("wood", self.palette.wood);
        match self.piece.kind {
            Kind::Table => self.table(wood, 0.06),
            Kind::Desk => self.desk(wood),
            Kind::RoundTable | Kind::Stool => self.pedestal(wood),
            Kind::Chair => self.chair(wood),
            Kind::Sofa => self.sofa(),
            Kind::Bed => self.bed(wood),
            Kind::Shelf => self.shelf(wood),
            Kind::Cabinet => self.cabinet(wood),
            Kind::Bench => self.table(wood, 0.08),
            Kind::Plant => self.plant(),
            Kind::Crate => {
                let card = self.mesh.add_material("cardboard", [0.72, 0.58, 0.40, 1.0]);
                self.part(card, [-w / 2.0, -d / 2.0, 0.0], [w / 2.0, d / 2.0, h]);
            }
            Kind::Column | Kind::RoundColumn => {
                let stone = self.mesh.add_material("stone", [0.72, 0.72, 0.70, 1.0]);
                add_prism(self.mesh, self.object, stone, &self.piece.footprint(), 0.0, h);
            }
        }
    }

    /// A box from `low` to `high` in the frame of the piece.
    fn part(&mut self, material: u16, low: [f32; 3], high: [f32; 3]) {
        let (low, high) = (Vec3::from(low), Vec3::from(high));
        let middle = 0.5 * (low + high);
        let centre = self.piece.centre + Vec2::from_angle(self.piece.yaw).rotate(middle.truncate());
        self.mesh.add_box(self.object, material, centre.extend(middle.z), high - low, self.piece.yaw);
    }

    /// A round part about the middle.
    fn disk(&mut self, material: u16, radius: f32, low: f32, high: f32) {
        let ring = circle(self.piece.centre.as_dvec2(), radius.into(), self.piece.yaw.into());
        add_prism(self.mesh, self.object, material, &ring, low, high);
    }

    /// Four legs `thick` wide up to height `top`, `inset` from the sides.
    fn legs(&mut self, material: u16, thick: f32, top: f32, inset: f32) {
        let (x, y) = (self.piece.size.x / 2.0 - inset, self.piece.size.y / 2.0 - inset);
        for (low, high) in [(-x, -x + thick), (x - thick, x)] {
            self.part(material, [low, -y, 0.0], [high, -y + thick, top]);
            self.part(material, [low, y - thick, 0.0], [high, y, top]);
        }
    }

    fn table(&mut self, wood: u16, leg: f32) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        self.part(wood, [-w / 2.0, -d / 2.0, h - 0.04], [w / 2.0, d / 2.0, h]);
        self.legs(wood, leg, h - 0.04, 0.04);
    }

    fn desk(&mut self, wood: u16) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let screen = self.mesh.add_material("plastic", [0.12, 0.12, 0.13, 1.0]);
        self.part(wood, [-w / 2.0, -d / 2.0, h - 0.03], [w / 2.0, d / 2.0, h]);
        // Drawers on one side, a panel on the other.
        self.part(wood, [w / 2.0 - 0.4, -d / 2.0 + 0.05, 0.0], [w / 2.0 - 0.02, d / 2.0 - 0.02, h - 0.03]);
        self.part(wood, [-w / 2.0 + 0.02, -d / 2.0 + 0.05, 0.0], [-w / 2.0 + 0.05, d / 2.0 - 0.02, h - 0.03]);
        self.part(screen, [-0.26, d / 2.0 - 0.2, h + 0.08], [0.26, d / 2.0 - 0.16, h + 0.4]);
        self.part(screen, [-0.08, d / 2.0 - 0.24, h], [0.08, d / 2.0 - 0.14, h + 0.08]);
    }

    fn pedestal(&mut self, wood: u16) {
        let Vec3 { x: w, z: h, .. } = self.piece.size;
        let metal = self.mesh.add_material("metal", [0.30, 0.31, 0.33, 1.0]);
        self.disk(metal, 0.3 * w, 0.0, 0.03);
        self.disk(metal, 0.04, 0.03, h - 0.04);
        self.disk(wood, 0.5 * w, h - 0.04, h);
    }

    fn chair(&mut self, wood: u16) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let seat = 0.45;
        self.part(wood, [-w / 2.0, -d / 2.0, seat - 0.04], [w / 2.0, d / 2.0, seat]);
        self.legs(wood, 0.04, seat - 0.04, 0.0);
        self.part(wood, [-w / 2.0, d / 2.0 - 0.04, seat], [w / 2.0, d / 2.0, h]);
    }

    fn sofa(&mut self) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let fabric = self.mesh.add_material("fabric", self.palette.fabric);
        let cushion = self.mesh.add_material("cushion", self.palette.fabric.map(|c| (c * 1.25).min(1.0)));
        let (x, y, arm) = (w / 2.0, d / 2.0, 0.18);
        self.part(fabric, [-x, -y, 0.06], [x, y, 0.28]);
        self.part(fabric, [-x, y - 0.22, 0.28], [x, y, h]);
        for side in [-x, x - arm] {
            self.part(fabric, [side, -y, 0.28], [side + arm, y - 0.22, 0.6]);
        }
        let seats = ((w - 2.0 * arm) / 0.6).round().max(1.0);
        let each = (w - 2.0 * arm) / seats;
        for k in 0..seats as usize {
            let left = -x + arm + k as f32 * each;
            self.part(cushion, [left + 0.01, -y, 0.28], [left + each - 0.01, y - 0.23, 0.44]);
        }
        self.legs(fabric, 0.06, 0.06, 0.05);
    }

    fn bed(&mut self, wood: u16) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let sheet = self.mesh.add_material("sheet", [0.88, 0.87, 0.83, 1.0]);
        let blanket = self.mesh.add_material("fabric", self.palette.fabric);
        let (x, y) = (w / 2.0, d / 2.0);
        self.part(wood, [-x, -y, 0.12], [x, y - 0.06, h - 0.2]);
        self.part(wood, [-x, y - 0.06, 0.0], [x, y, 1.0]);
        self.part(sheet, [-x + 0.02, -y + 0.02, h - 0.2], [x - 0.02, y - 0.06, h]);
        self.part(blanket, [-x, -y, h], [x, y - 0.75, h + 0.03]);
        let pillows = if w > 1.3 { 2 } else { 1 };
        for k in 0..pillows {
            let middle = (k as f32 + 0.5) / pillows as f32 * w - x;
            self.part(sheet, [middle - 0.27, y - 0.55, h], [middle + 0.27, y - 0.15, h + 0.1]);
        }
        self.legs(wood, 0.08, 0.12, 0.06);
    }

    fn shelf(&mut self, wood: u16) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let (x, y, t) = (w / 2.0, d / 2.0, 0.025);
        self.part(wood, [-x, -y, 0.0], [-x + t, y, h]);
        self.part(wood, [x - t, -y, 0.0], [x, y, h]);
        self.part(wood, [-x + t, y - 0.015, 0.0], [x - t, y, h]);
        let boards = (h / 0.36).round();
        let books = self.mesh.add_material("books", self.palette.fabric.map(|c| (c * 0.8).min(1.0)));
        for k in 0..=boards as usize {
            let top = t + k as f32 * (h - t) / boards;
            self.part(wood, [-x + t, -y, top - t], [x - t, y - 0.015, top]);
            // Books stand on every board but the topmost, now on the left, now on the right.
            if k < boards as usize {
                let (from, to) = if k % 2 == 0 { (-x + t, 0.3 * x) } else { (-0.4 * x, x - t) };
                self.part(books, [from, -y + 0.04, top], [to, y - 0.015, top + 0.24]);
            }
        }
    }

    fn cabinet(&mut self, wood: u16) {
        let Vec3 { x: w, y: d, z: h } = self.piece.size;
        let front = self.mesh.add_material("front", self.palette.wood.map(|c| (c * 1.3).min(1.0)));
        let (x, y) = (w / 2.0, d / 2.0);
        self.legs(wood, 0.04, 0.08, 0.03);
        self.part(wood, [-x, -y + 0.03, 0.08], [x, y, h - 0.03]);
        self.part(wood, [-x, -y, h - 0.03], [x, y, h]);
        for (low, high) in [(-x + 0.02, -0.01), (0.01, x - 0.02)] {
            self.part(front, [low, -y + 0.01, 0.1], [high, -y + 0.03, h - 0.05]);
        }
    }

    fn plant(&mut self) {
        let Vec3 { x: w, z: h, .. } = self.piece.size;
        let pot = self.mesh.add_material("pot", [0.62, 0.36, 0.26, 1.0]);
        let leaves = self.mesh.add_material("leaves", [0.24, 0.46, 0.22, 1.0]);
        self.disk(pot, 0.32 * w, 0.0, 0.3);
        self.disk(leaves, 0.4 * w, 0.3, 0.45 * (h + 0.3));
        self.disk(leaves, 0.5 * w, 0.45 * (h + 0.3), 0.85 * h);
        self.disk(leaves, 0.3 * w, 0.85 * h, h);
    }
}
