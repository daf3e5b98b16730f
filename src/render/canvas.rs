//! Smooth 2-D drawing in pixel coordinates (x right, y down, pixel centres at +0.5).

use super::font::{self, ADVANCE, HEIGHT};
use super::{Image, Rgb};
use glam::Vec2;

/// An image with anti-aliased shapes drawn over it.
#[derive(Clone, Debug)]
pub struct Canvas {
    /// What has been drawn so far.
    pub image: Image,
}

impl Canvas {
    /// A canvas of one colour.
    pub fn new(width: usize, height: usize, background: Rgb) -> Self {
        Self { image: Image::filled(width, height, background) }
    }

    /// A line of points, `width` pixels wide with round joints and ends.
    pub fn line(&mut self, points: &[Vec2], width: f32, colour: Rgb) {
        let reach = 0.5 * width;
        self.shade(points, reach, colour, |p| reach - points.windows(2).map(|s| to_segment(p, s[0], s[1])).fold(f32::MAX, f32::min));
    }

    /// A filled disk.
    pub fn disk(&mut self, centre: Vec2, radius: f32, colour: Rgb) {
        self.shade(&[centre], radius, colour, |p| radius - p.distance(centre));
    }

    /// A circle line, `width` pixels wide.
    pub fn ring(&mut self, centre: Vec2, radius: f32, width: f32, colour: Rgb) {
        self.shade(&[centre], radius + width, colour, |p| 0.5 * width - (p.distance(centre) - radius).abs());
    }

    /// Closed rings filled by the even-odd rule, so that a ring inside another is a hole.
    pub fn fill(&mut self, rings: &[Vec<Vec2>], colour: Rgb) {
        let all: Vec<Vec2> = rings.iter().flatten().copied().collect();
        self.shade(&all, 1.0, colour, |p| {
            let edges = rings.iter().flat_map(|r| (0..r.len()).map(|i| (r[i], r[(i + 1) % r.len()])));
            let (mut inside, mut distance) = (false, f32::MAX);
            for (a, b) in edges {
                distance = distance.min(to_segment(p, a, b));
                inside ^= (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x);
            }
            if inside { distance } else { -distance }
        });
    }

    /// Closed rings as lines.
    pub fn outline(&mut self, rings: &[Vec<Vec2>], width: f32, colour: Rgb) {
        for ring in rings {
            let closed: Vec<Vec2> = ring.iter().chain(ring.first()).copied().collect();
            self.line(&closed, width, colour);
        }
    }

    /// Text with its upper left corner at `at`; letters are 5 x 7 dots of `size` pixels.
    pub fn text(&mut self, at: Vec2, text: &str, size: usize, colour: Rgb) {
        let (x0, y0) = (at.x.round() as i64, at.y.round() as i64);
        for (i, c) in text.chars().enumerate() {
            for (row, bits) in font::glyph(c).iter().enumerate() {
                for column in (0..5).filter(|k| bits >> (4 - k) & 1 == 1) {
                    for dot in 0..size * size {
                        let x = x0 + (size * (i * ADVANCE + column) + dot % size) as i64;
                        let y = y0 + (size * row + dot / size) as i64;
                        self.image.blend(x, y, colour, 1.0);
                    }
                }
            }
        }
    }

    /// Lays `colour` over the pixels near `points`; `depth` tells how far inside the shape a pixel centre lies, in pixels.
    fn shade(&mut self, points: &[Vec2], reach: f32, colour: Rgb, depth: impl Fn(Vec2) -> f32) {
        let Some(low) = points.iter().copied().reduce(Vec2::min) else { return };
        let high = points.iter().copied().fold(low, Vec2::max);
        let size = Vec2::new(self.image.width as f32, self.image.height as f32);
        let low = (low - reach - 1.0).floor().clamp(Vec2::ZERO, size);
        let high = (high + reach + 1.0).ceil().clamp(Vec2::ZERO, size);
        for y in low.y as i64..high.y as i64 {
            for x in low.x as i64..high.x as i64 {
                let cover = (depth(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) + 0.5).clamp(0.0, 1.0);
                if cover > 0.0 {
                    self.image.blend(x, y, colour, cover);
                }
            }
        }
    }
}

/// Width and height of `text` in pixels for dots of `size` pixels.
pub fn text_extent(text: &str, size: usize) -> Vec2 {
    Vec2::new((text.chars().count() * ADVANCE * size) as f32, (HEIGHT * size) as f32)
}

fn to_segment(p: Vec2, a: Vec2, b: Vec2) -> f32 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
    p.distance(a + t * along)
}

#[cfg(test)]
mod tests {
    use super::*;

    const INK: Rgb = [0; 3];

    /// Drawn area in pixels, partial ones counted by their darkness.
    fn area(canvas: &Canvas) -> f32 {
        canvas.image.rgb.chunks_exact(3).map(|p| 1.0 - p[0] as f32 / 255.0).sum()
    }

    #[test]
    fn areas_by_hand() {
        let mut disk = Canvas::new(40, 40, [255; 3]);
        disk.disk(Vec2::new(20.3, 19.6), 10.0, INK);
        assert!((area(&disk) - 314.16).abs() < 2.0);
        let mut line = Canvas::new(60, 40, [255; 3]);
        line.line(&[Vec2::new(10.0, 10.0), Vec2::new(40.0, 10.0)], 4.0, INK);
        // 30 x 4 and two half disks of radius 2.
        assert!((area(&line) - 132.57).abs() < 1.5, "{}", area(&line));
        assert_eq!(line.image.pixel(20, 9), [0; 3]);
        assert_eq!(line.image.pixel(20, 13), [255; 3]);
    }

    #[test]
    fn a_ring_within_a_ring_is_a_hole() {
        let square = |low: f32, high: f32| vec![Vec2::new(low, low), Vec2::new(high, low), Vec2::new(high, high), Vec2::new(low, high)];
        let mut canvas = Canvas::new(40, 40, [255; 3]);
        canvas.fill(&[square(5.0, 35.0), square(15.0, 25.0)], INK);
        assert!((area(&canvas) - 800.0).abs() < 1.0, "{}", area(&canvas));
        assert_eq!(canvas.image.pixel(20, 20), [255; 3]);
        assert_eq!(canvas.image.pixel(10, 20), [0; 3]);
    }

    #[test]
    fn shapes_outside_are_left_out() {
        let mut canvas = Canvas::new(10, 10, [255; 3]);
        canvas.disk(Vec2::new(-30.0, 5.0), 4.0, INK);
        canvas.line(&[], 3.0, INK);
        canvas.fill(&[], INK);
        canvas.text(Vec2::new(200.0, 3.0), "FAR", 2, INK);
        assert_eq!(area(&canvas), 0.0);
    }

    #[test]
    fn text_has_the_shape_of_its_letters() {
        let mut canvas = Canvas::new(12, 9, [255; 3]);
        canvas.text(Vec2::new(1.0, 1.0), "L", 1, INK);
        // A stroke of seven dots down and four more along the foot.
        assert_eq!(area(&canvas), 11.0);
        assert_eq!(canvas.image.pixel(1, 1), [0; 3]);
        assert_eq!(canvas.image.pixel(5, 7), [0; 3]);
        assert_eq!(canvas.image.pixel(5, 1), [255; 3]);
        assert_eq!(text_extent("AB", 2), Vec2::new(24.0, 14.0));
    }
}
