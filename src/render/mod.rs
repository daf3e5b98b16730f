//! Small pictures of what happens: a ray-cast preview, filmstrips and top views, written as PNG.

mod camera;
mod canvas;
mod episode;
mod film;
mod font;
mod image;
mod intersect;
mod mesh;
mod plan;
mod relief;
mod room;
mod stage;
mod top_view;

pub use camera::Camera;
pub use canvas::Canvas;
pub use episode::{Episode, Walker};
pub use film::{film, tile};
pub use image::{Image, Rgb, ramp};
pub use mesh::Mesh;
pub use plan::ScenePlan;
pub(crate) use room::by_colour;
pub use stage::{Hit, Shading, Stage, TracedStage};
pub use top_view::TopView;

/// Colours that read well on the pale floor and apart from each other.
pub mod colour {
    use super::Rgb;

    pub const WHITE: Rgb = [255, 255, 255];
    pub const BLACK: Rgb = [0, 0, 0];
    pub const INK: Rgb = [40, 44, 52];
    pub const SKIN: Rgb = [205, 178, 160];
    pub const STONE: Rgb = [150, 156, 166];
    pub const BLUE: Rgb = [47, 110, 186];
    pub const RED: Rgb = [204, 63, 54];
    pub const GREEN: Rgb = [52, 142, 84];
    pub const ORANGE: Rgb = [230, 140, 30];
    /// Of several people, from the first.
    pub const PEOPLE: [Rgb; 6] = [BLUE, ORANGE, GREEN, RED, [124, 84, 170], [70, 160, 170]];
}
