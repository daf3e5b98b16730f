//! Filmstrips: several pictures side by side.

use super::canvas::Canvas;
use super::{Camera, Image, Stage, colour};
use glam::Vec2;

/// Pixels between two pictures.
const GAP: usize = 4;

/// Sets pictures of one size in rows of `columns` on white.
pub fn tile(images: &[Image], columns: usize) -> Image {
    let columns = columns.clamp(1, images.len().max(1));
    let rows = images.len().div_ceil(columns);
    let (width, height) = images.iter().fold((0, 0), |(w, h), i| (w.max(i.width), h.max(i.height)));
    let gaps = |n: usize| GAP * n.saturating_sub(1);
    let mut sheet = Image::filled(columns * width + gaps(columns), rows * height + gaps(rows), colour::WHITE);
    for (i, image) in images.iter().enumerate() {
        sheet.paste(image, i % columns * (width + GAP), i / columns * (height + GAP));
    }
    sheet
}

/// Renders every stage with its camera, writes its label in the corner and sets the pictures in rows of `columns`.
pub fn film(frames: &[(Stage, Camera, String)], columns: usize) -> Image {
    let images: Vec<Image> = frames
        .iter()
        .map(|(stage, camera, label)| {
            let mut canvas = Canvas { image: stage.render(camera) };
            canvas.text(Vec2::splat(8.0), label, 2, colour::INK);
            canvas.image
        })
        .collect();
    tile(&images, columns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn panels_stand_in_rows() {
        let images: Vec<Image> = (0..3).map(|i| Image::filled(10, 6, [i * 50; 3])).collect();
        let sheet = tile(&images, 2);
        assert_eq!((sheet.width, sheet.height), (24, 16));
        assert_eq!(sheet.pixel(14, 0), [50; 3]);
        assert_eq!(sheet.pixel(9, 10), [100; 3]);
        assert_eq!(sheet.pixel(12, 3), colour::WHITE);
        assert_eq!(sheet.pixel(20, 12), colour::WHITE);
        assert_eq!(tile(&[], 3).width, 0);
    }

    #[test]
    fn a_film_carries_its_labels() {
        let camera = Camera::look_at(Vec3::new(0.0, -3.0, 1.0), Vec3::Z, 40, 30, 1.0).unwrap();
        let strip = film(&[(Stage::new(), camera.clone(), "L".into()), (Stage::new(), camera, String::new())], 2);
        assert_eq!(strip.width, 84);
        assert_eq!(strip.pixel(8, 8), colour::INK);
        assert_ne!(strip.pixel(44 + 8, 8), colour::INK);
    }
}
