//! A room in pictures: its floor plan, and its mesh with what would hide the people cut away.

use super::stage::encode;
use super::{Mesh, Rgb, TopView, colour};
use crate::Result;
use crate::scene::{Grid, Polygon, TriMesh};
use glam::{DVec2, Vec2, Vec3, Vec4};

/// Laid over what can be walked on.
const FREE: Rgb = [120, 190, 130];
/// What lies wholly above this height is cut away, metres.
const CEILING: f32 = 2.2;
/// A face this near to where people walk, metres, still stands in front of them.
const NEAR: f64 = 0.02;

impl TopView {
    /// Draws a room: what stands there as far as it is known, and where people may walk.
    pub(super) fn room(&mut self, mesh: Option<&TriMesh>, walkable: &Polygon) -> Result<()> {
        if let Some(mesh) = mesh {
            let colours = colours(mesh);
            self.relief((0..mesh.triangles.len()).map(|i| (mesh.corners(i), colours[usize::from(mesh.material[i])])));
        }
        let grid = Grid::of_polygon(walkable, f64::from(self.metres()))?;
        self.tint(FREE, 0.3, |p| grid.holds(p.as_dvec2()));
        for ring in walkable.rings() {
            let closed: Vec<Vec2> = ring.iter().chain(ring.first()).map(|p| p.as_vec2()).collect();
            self.path(&closed, 1.5, colour::GREEN);
        }
        Ok(())
    }
}

/// The triangles of `mesh` to which `keep` says yes, by colour; no two share a vertex, so that edges are sharp.
pub(crate) fn by_colour(mesh: &TriMesh, keep: impl Fn([Vec3; 3]) -> bool) -> Vec<(Mesh, Rgb)> {
    let mut parts: Vec<(Mesh, Rgb)> = colours(mesh).into_iter().map(|c| (Mesh::default(), c)).collect();
    for i in (0..mesh.triangles.len()).filter(|&i| keep(mesh.corners(i))) {
        let part = &mut parts[usize::from(mesh.material[i])].0;
        let first = part.vertices.len() as u32;
        part.vertices.extend(mesh.corners(i));
        part.faces.push([first, first + 1, first + 2]);
    }
    parts.retain(|p| !p.0.faces.is_empty());
    parts
}

/// What a camera looks past: ceilings, and whatever stands between it and all floor that can be walked on.
pub(super) struct CutAway {
    floor: Polygon,
    eye: DVec2,
}

impl CutAway {
    /// For a camera at `eye`.
    pub fn new(walkable: &Polygon, eye: Vec3) -> Result<Self> {
        Ok(Self { floor: Polygon::new(walkable.exterior().to_vec(), Vec::new())?, eye: eye.truncate().as_dvec2() })
    }

    /// Whether a triangle is to be seen: some floor lies between it and the camera.
    pub fn shows(&self, corners: [Vec3; 3]) -> bool {
        let middle = (corners.iter().sum::<Vec3>() / 3.0).truncate().as_dvec2();
        let ahead = (self.eye - middle).normalize_or_zero();
        let from = middle + NEAR * ahead;
        let crosses = || self.floor.first_hit(from, ahead).is_some_and(|d| d < from.distance(self.eye));
        corners.iter().any(|c| c.z < CEILING) && (self.floor.contains(from) || crosses())
    }
}

/// Of each material.
fn colours(mesh: &TriMesh) -> Vec<Rgb> {
    mesh.materials.iter().map(|m| encode(Vec4::from(m.color).truncate())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Rooms;

    #[test]
    fn the_near_wall_is_cut_away_and_furniture_is_not() {
        let walkable = Polygon::new([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)].map(DVec2::from).to_vec(), Vec::new()).unwrap();
        let cut = CutAway::new(&walkable, Vec3::new(2.0, -5.0, 4.0)).unwrap();
        let upright = |x: f32, y: f32| [Vec3::new(x - 0.1, y, 0.0), Vec3::new(x + 0.1, y, 0.0), Vec3::new(x, y, 2.0)];
        assert!(!cut.shows(upright(2.0, 0.0)) && !cut.shows(upright(2.0, -0.12)) && !cut.shows(upright(3.9, -0.1)));
        assert!(cut.shows(upright(2.0, 3.0)) && cut.shows(upright(2.0, 0.5)) && cut.shows(upright(2.0, 3.4)));
        assert!(!cut.shows(upright(2.0, 1.0).map(|v| v + 2.4 * Vec3::Z)), "a ceiling");
    }

    #[test]
    fn triangles_keep_their_colours() {
        let room = Rooms::default().draw(3).unwrap();
        let parts = by_colour(&room.mesh, |_| true);
        assert_eq!(parts.iter().map(|p| p.0.faces.len()).sum::<usize>(), room.mesh.triangles.len());
        assert!(parts.len() > 3 && parts.len() <= room.mesh.materials.len());
        assert!(by_colour(&room.mesh, |_| false).is_empty());
    }
}
