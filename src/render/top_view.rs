//! Top views: what happens in the plane, drawn to scale with x to the right and y up.

use super::canvas::{Canvas, text_extent};
use super::{Image, Rgb, colour, ramp};
use crate::{Error, Result};
use glam::Vec2;

const MARGIN: f32 = 24.0;
const LABEL: usize = 2;
/// Pixels of a person's path.
pub const PATH_WIDTH: f32 = 3.0;

/// A plan of a rectangle of the world, drawn in metres.
pub struct TopView {
    canvas: Canvas,
    low: Vec2,
    scale: f32,
}

impl TopView {
    /// A plan of the rectangle from `low` to `high`, metres, on an image `width` pixels wide with a small margin.
    ///
    /// Errors: an empty or endless rectangle, or an image that would be higher than 8192 pixels.
    pub fn new(low: Vec2, high: Vec2, width: usize) -> Result<Self> {
        let size = high - low;
        if !(size.min_element() > 0.0 && size.is_finite()) || width as f32 <= 4.0 * MARGIN {
            return Err(Error::invalid(format!("a top view from {low} to {high} on {width} pixels cannot be drawn")));
        }
        let scale = (width as f32 - 2.0 * MARGIN) / size.x;
        // The scale bar stands in a strip below the plan.
        let height = size.y * scale + 3.0 * MARGIN;
        if height > 8192.0 {
            return Err(Error::invalid(format!("a top view from {low} to {high} would be {height:.0} pixels high, at most 8192")));
        }
        let mut view = Self { canvas: Canvas::new(width, height as usize, [246, 246, 243]), low, scale };
        view.scale_bar(size.x);
        Ok(view)
    }

    /// The rectangle around `points` with `border` metres to spare, not higher than wide; a unit square for no points.
    pub fn around(points: impl IntoIterator<Item = Vec2>, border: f32, width: usize) -> Result<Self> {
        let (low, high) = points.into_iter().fold((Vec2::MAX, Vec2::MIN), |(l, h), p| (l.min(p), h.max(p)));
        let (low, high) = if low.x > high.x { (Vec2::ZERO, Vec2::ONE) } else { (low, high) };
        let side = Vec2::new(0.5 * (high.y - low.y - high.x + low.x).max(0.0), 0.0);
        Self::new(low - border - side, high + border + side, width)
    }

    /// Pixel position of the world point `p`.
    pub fn pixel(&self, p: Vec2) -> Vec2 {
        let up = self.canvas.image.height as f32 - 2.0 * MARGIN - (p.y - self.low.y) * self.scale;
        Vec2::new(MARGIN + (p.x - self.low.x) * self.scale, up)
    }

    /// Fills rings by the even-odd rule and outlines them: the walkable polygon with its holes.
    pub fn polygon(&mut self, rings: &[Vec<Vec2>], fill: Rgb, edge: Rgb) {
        let rings: Vec<Vec<Vec2>> = rings.iter().map(|r| r.iter().map(|&p| self.pixel(p)).collect()).collect();
        self.canvas.fill(&rings, fill);
        self.canvas.outline(&rings, 2.0, edge);
    }

    /// A line through `points`, `width` pixels wide.
    pub fn path(&mut self, points: &[Vec2], width: f32, colour: Rgb) {
        // In pieces, so that the cost of a long path is that of the pixels near it.
        let points: Vec<Vec2> = points.iter().map(|&p| self.pixel(p)).collect();
        points.windows(2).for_each(|s| self.canvas.line(s, width, colour));
    }

    /// A line through `points` whose colour runs from dark to light with time.
    pub fn timed_path(&mut self, points: &[Vec2], width: f32) {
        let last = points.len().saturating_sub(2).max(1) as f32;
        for (i, s) in points.windows(2).enumerate() {
            self.path(s, width, ramp(i as f32 / last));
        }
    }

    /// A dot of `radius` pixels.
    pub fn dot(&mut self, p: Vec2, radius: f32, colour: Rgb) {
        let at = self.pixel(p);
        self.canvas.disk(at, radius, colour);
    }

    /// A start: a small disk with a white rim.
    pub fn start(&mut self, p: Vec2, colour: Rgb) {
        self.dot(p, 7.0, colour::WHITE);
        self.dot(p, 5.0, colour);
    }

    /// A goal: a circle of `radius` metres, within which it counts as reached, and a cross in its middle.
    pub fn goal(&mut self, p: Vec2, radius: f32, colour: Rgb) {
        let at = self.pixel(p);
        self.canvas.ring(at, (radius * self.scale).max(4.0), 2.0, colour);
        for d in [Vec2::new(5.0, 5.0), Vec2::new(5.0, -5.0)] {
            self.canvas.line(&[at - d, at + d], 2.0, colour);
        }
    }

    /// Text beside the world point `p`, kept inside the image.
    pub fn label(&mut self, p: Vec2, text: &str, colour: Rgb) {
        let size = text_extent(text, LABEL);
        let room = Vec2::new(self.canvas.image.width as f32, self.canvas.image.height as f32) - size;
        let at = (self.pixel(p) + Vec2::new(10.0, -0.5 * size.y)).min(room).max(Vec2::ZERO);
        self.canvas.text(at, text, LABEL, colour);
    }

    /// Text in the lower right corner.
    pub fn caption(&mut self, text: &str) {
        let size = Vec2::new(self.canvas.image.width as f32, self.canvas.image.height as f32);
        let at = size - text_extent(text, LABEL) - Vec2::new(MARGIN, 0.5 * MARGIN);
        self.canvas.text(at, text, LABEL, colour::INK);
    }

    /// Side of a pixel, metres.
    pub fn metres(&self) -> f32 {
        1.0 / self.scale
    }

    /// Lays a colour with this opacity over all pixels whose middle `covers` says yes to, metres.
    pub fn tint(&mut self, colour: Rgb, opacity: f32, covers: impl Fn(Vec2) -> bool) {
        let [width, height] = self.size();
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let right = Vec2::new(x as f32 + 0.5 - MARGIN, height as f32 - 2.0 * MARGIN - y as f32 - 0.5);
            if covers(self.low + right / self.scale) {
                self.canvas.image.blend(x as i64, y as i64, colour, opacity);
            }
        }
    }

    /// Width and height of the image, pixels.
    pub(super) fn size(&self) -> [usize; 2] {
        [self.canvas.image.width, self.canvas.image.height]
    }

    /// What has been drawn so far.
    pub(super) fn image(&mut self) -> &mut Image {
        &mut self.canvas.image
    }

    /// The finished image.
    pub fn finish(self) -> Image {
        self.canvas.image
    }

    /// A bar of the longest round length that fits in a third of the width.
    fn scale_bar(&mut self, metres: f32) {
        let decade = 10f32.powf((metres / 3.0).log10().floor());
        let length = [5.0, 2.0, 1.0].map(|m| m * decade).into_iter().find(|&l| l <= metres / 3.0).unwrap_or(decade);
        let y = self.canvas.image.height as f32 - 0.75 * MARGIN;
        let end = Vec2::new(MARGIN + length * self.scale, y);
        self.canvas.line(&[Vec2::new(MARGIN, y), end], 3.0, colour::INK);
        let text = format!("{length} m");
        self.canvas.text(end + Vec2::new(8.0, -7.0), &text, LABEL, colour::INK);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(low: f32, high: f32) -> Vec<Vec2> {
        vec![Vec2::new(low, low), Vec2::new(high, low), Vec2::new(high, high), Vec2::new(low, high)]
    }

    #[test]
    fn drawn_to_scale_with_y_up() {
        let mut view = TopView::new(Vec2::ZERO, Vec2::splat(4.0), 448).unwrap();
        // 448 - 2 * 24 = 400 pixels for 4 m; the plan's lower edge lies two margins above the image's.
        assert_eq!(view.pixel(Vec2::new(1.0, 1.0)), Vec2::new(124.0, (400 + 72 - 48 - 100) as f32));
        view.polygon(&[square(0.0, 4.0), square(1.0, 2.0)], [200, 220, 200], colour::INK);
        view.path(&[Vec2::new(0.5, 3.0), Vec2::new(3.5, 3.0)], 6.0, colour::RED);
        view.start(Vec2::new(0.5, 0.5), colour::BLUE);
        let seen = |p: Vec2| view.pixel(p).as_uvec2();
        let (hole, free, path, start) =
            (seen(Vec2::splat(1.5)), seen(Vec2::new(3.0, 1.0)), seen(Vec2::new(2.0, 3.0)), seen(Vec2::splat(0.5)));
        let image = view.finish();
        let pixel = |at: glam::UVec2| image.pixel(at.x as usize, at.y as usize);
        assert_eq!(pixel(hole), [246, 246, 243]);
        assert_eq!(pixel(free), [200, 220, 200]);
        assert_eq!(pixel(path), colour::RED);
        assert_eq!(pixel(start), colour::BLUE);
    }

    #[test]
    fn impossible_plans_are_refused() {
        assert!(TopView::new(Vec2::ONE, Vec2::ZERO, 400).is_err());
        assert!(TopView::new(Vec2::ZERO, Vec2::new(1.0, 1e6), 400).is_err());
        assert!(TopView::new(Vec2::ZERO, Vec2::splat(f32::NAN), 400).is_err());
        assert!(TopView::around([], 0.5, 400).is_ok());
        // A way of 1 x 9 m is shown on 10 x 10 m.
        let tall = TopView::around([Vec2::ZERO, Vec2::new(1.0, 9.0)], 0.5, 448).unwrap();
        assert_eq!((tall.low, tall.scale), (Vec2::new(-4.5, -0.5), 40.0));
    }
}
