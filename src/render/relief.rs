//! Surfaces from above: the topmost of every pixel, with edges and short shadows where heights change.

use super::{Image, Rgb, TopView};
use glam::{Vec2, Vec3};

/// Samples along each side of a pixel.
const FINE: usize = 2;
/// A change of height that is drawn as an edge, metres.
const EDGE: f32 = 0.04;
/// Length of shadows, in samples for each metre of height and at most.
const SHADOW: f32 = 10.0;
const LONGEST: usize = 16;

impl TopView {
    /// Draws triangles (corners in the world, metres, and colour) that face up, the highest on top.
    pub fn relief(&mut self, triangles: impl IntoIterator<Item = ([Vec3; 3], Rgb)>) {
        let mut relief = Relief::new(self.size());
        for (corners, colour) in triangles {
            let flat = corners.map(|v| self.pixel(v.truncate()) * FINE as f32);
            relief.add(flat, corners.map(|v| v.z), colour);
        }
        relief.paint(self.image());
    }
}

/// Heights and colours of samples.
struct Relief {
    size: [usize; 2],
    top: Vec<(f32, Rgb)>,
}

impl Relief {
    fn new(size: [usize; 2]) -> Self {
        let size = size.map(|s| s * FINE);
        Self { size, top: vec![(f32::NEG_INFINITY, [0; 3]); size[0] * size[1]] }
    }

    /// A triangle in samples, y down, with the heights of its corners.
    fn add(&mut self, [a, b, c]: [Vec2; 3], z: [f32; 3], colour: Rgb) {
        // With y down what turns counter-clockwise in the world has a negative area.
        let area = (b - a).perp_dot(c - a);
        if area >= 0.0 {
            return;
        }
        let last = Vec2::new(self.size[0] as f32, self.size[1] as f32);
        let low = a.min(b).min(c).floor().clamp(Vec2::ZERO, last);
        let high = a.max(b).max(c).ceil().clamp(Vec2::ZERO, last);
        for y in low.y as usize..high.y as usize {
            for x in low.x as usize..high.x as usize {
                let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let weights = [(b, c), (c, a), (a, b)].map(|(from, to)| (to - from).perp_dot(p - from) / area);
                let height: f32 = weights.iter().zip(z).map(|(w, z)| w * z).sum();
                let top = &mut self.top[y * self.size[0] + x];
                if weights.iter().all(|&w| w >= 0.0) && height > top.0 {
                    *top = (height, colour);
                }
            }
        }
    }

    fn height(&self, x: usize, y: usize) -> f32 {
        self.top[y.min(self.size[1] - 1) * self.size[0] + x.min(self.size[0] - 1)].0
    }

    /// The colour of a sample, darker at edges and in shadow; None where there is nothing.
    fn sample(&self, x: usize, y: usize) -> Option<Rgb> {
        let (height, colour) = self.top[y * self.size[0] + x];
        if height == f32::NEG_INFINITY {
            return None;
        }
        let edge = [(x + 1, y), (x, y + 1), (x.saturating_sub(1), y), (x, y.saturating_sub(1))];
        let light = if edge.into_iter().any(|(i, j)| self.height(i, j) < height - EDGE) {
            0.62
        } else if (1..=LONGEST.min(x).min(y)).any(|k| self.height(x - k, y - k) > height + 0.03 + k as f32 / SHADOW) {
            0.8
        } else {
            1.0
        };
        Some(colour.map(|c| (f32::from(c) * light) as u8))
    }

    fn paint(&self, image: &mut Image) {
        for y in 0..image.height {
            for x in 0..image.width {
                for k in 0..FINE * FINE {
                    if let Some(colour) = self.sample(x * FINE + k % FINE, y * FINE + k / FINE) {
                        // Each of the samples so far has the same share.
                        image.blend(x as i64, y as i64, colour, 1.0 / (k + 1) as f32);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_face_that_looks_up_is_seen() {
        let sheet = |z: f32, low: f32, high: f32| {
            let [a, b, c, d] = [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| Vec3::new(x, y, z));
            [[a, b, c], [a, c, d]]
        };
        let mut view = TopView::new(Vec2::ZERO, Vec2::splat(4.0), 448).unwrap();
        let (red, green, blue) = ([200, 0, 0], [0, 200, 0], [0, 0, 200]);
        let down = sheet(3.0, 0.0, 4.0).map(|[a, b, c]| ([a, c, b], red));
        let parts = [sheet(1.0, 1.0, 2.0).map(|t| (t, green)), sheet(0.0, 0.0, 4.0).map(|t| (t, blue)), down];
        view.relief(parts.into_iter().flatten());
        let seen = |x: f32, y: f32| {
            let p = view.pixel(Vec2::new(x, y)).as_uvec2();
            [p.x as usize, p.y as usize]
        };
        let at = [(1.5, 1.5), (3.0, 3.0), (1.002, 1.5), (2.02, 0.98), (0.96, 1.5)].map(|(x, y)| seen(x, y));
        let image = view.finish();
        let [table, floor, rim, shadow, light] = at.map(|[x, y]| image.pixel(x, y));
        // The table's rim is darker, and so is the floor to its lower right, but not to its left.
        assert_eq!((table, floor, light), (green, blue, blue));
        assert!(rim[1] < 180 && shadow[2] < 180, "{rim:?} {shadow:?}");
    }
}
