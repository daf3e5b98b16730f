//! Plans of scenes: what stands there, where people may walk, and ways.

use super::{Image, TopView, colour};
use crate::Result;
use crate::scene::{Polygon, TriMesh};
use glam::{DVec2, Vec2};

/// Metres round the scene.
const BORDER: f32 = 0.3;

/// A scene from above.
pub struct ScenePlan<'a> {
    /// What stands there; the picture shows the walkable area alone without it.
    pub mesh: Option<&'a TriMesh>,
    pub walkable: &'a Polygon,
    /// Ways from starts to goals, metres.
    pub ways: &'a [Vec<DVec2>],
    /// Stands in the corner.
    pub caption: &'a str,
}

impl ScenePlan<'_> {
    /// The plan on an image `width` pixels wide.
    pub fn draw(&self, width: usize) -> Result<Image> {
        let mut view = TopView::around(self.walkable.exterior().iter().map(|p| p.as_vec2()), BORDER, width)?;
        view.room(self.mesh, self.walkable)?;
        for (way, colour) in self.ways.iter().zip(colour::PEOPLE.into_iter().cycle()) {
            let way: Vec<Vec2> = way.iter().map(|p| p.as_vec2()).collect();
            view.path(&way, 2.5, colour);
            if let [start, .., goal] = way[..] {
                view.start(start, colour);
                view.goal(goal, 0.1, colour);
            }
        }
        view.caption(self.caption);
        Ok(view.finish())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Rgb;
    use crate::scene::Rooms;

    #[test]
    fn a_room_has_its_floor_and_its_furniture() {
        let room = Rooms::default().draw(3).unwrap();
        let ways = [vec![DVec2::ZERO, DVec2::ONE, DVec2::X]];
        let plan = ScenePlan { mesh: Some(&room.mesh), walkable: &room.walkable, ways: &ways, caption: "ROOM 3" };
        let image = plan.draw(320).unwrap();
        let different: std::collections::BTreeSet<Rgb> = image.rgb.as_chunks::<3>().0.iter().copied().collect();
        assert!(different.len() > 100, "{}", different.len());
        let bare = ScenePlan { mesh: None, ways: &[], ..plan }.draw(320).unwrap();
        let tinted = bare.rgb.as_chunks::<3>().0.iter().filter(|p| p[1] > p[0] && p[1] > p[2]).count();
        assert!(tinted > 10_000, "{tinted}");
        // A corridor along y is no higher than wide.
        let tall = Polygon::new([(0.0, 0.0), (1.0, 0.0), (1.0, 30.0), (0.0, 30.0)].map(DVec2::from).to_vec(), Vec::new()).unwrap();
        let image = ScenePlan { mesh: None, walkable: &tall, ways: &[], caption: "" }.draw(320).unwrap();
        assert!(image.height <= image.width + 60, "{} x {}", image.width, image.height);
    }
}
