//! 8-bit RGB images and their PNG form.

use crate::{Error, Result, io};
use std::path::Path;

/// An sRGB colour.
pub type Rgb = [u8; 3];

/// An 8-bit sRGB image, rows from top to bottom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// height x width x 3 bytes.
    pub rgb: Vec<u8>,
}

impl Image {
    /// An image of one colour.
    pub fn filled(width: usize, height: usize, colour: Rgb) -> Self {
        Self { width, height, rgb: colour.repeat(width * height) }
    }

    /// The pixel in column `x` and row `y`, both inside the image.
    pub fn pixel(&self, x: usize, y: usize) -> Rgb {
        let i = (y * self.width + x) * 3;
        [self.rgb[i], self.rgb[i + 1], self.rgb[i + 2]]
    }

    /// Lays `colour` over pixel (x, y) with `alpha` in 0..=1; a pixel outside the image is left out.
    pub fn blend(&mut self, x: i64, y: i64, colour: Rgb, alpha: f32) {
        if x < 0 || y < 0 || x >= self.width as i64 || y >= self.height as i64 {
            return;
        }
        let i = (y as usize * self.width + x as usize) * 3;
        for (old, new) in self.rgb[i..i + 3].iter_mut().zip(colour) {
            *old = (*old as f32 + (new as f32 - *old as f32) * alpha).round() as u8;
        }
    }

    /// Copies `other` with its upper left corner at (x, y); what does not fit is cut off.
    pub fn paste(&mut self, other: &Self, x: usize, y: usize) {
        let width = other.width.min(self.width.saturating_sub(x)) * 3;
        for row in 0..other.height.min(self.height.saturating_sub(y)) {
            let to = ((y + row) * self.width + x) * 3;
            let from = row * other.width * 3;
            self.rgb[to..to + width].copy_from_slice(&other.rgb[from..from + width]);
        }
    }

    /// The image as a PNG file's bytes.
    pub fn png(&self) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let write = |e: png::Encoder<'_, &mut Vec<u8>>| e.write_header()?.write_image_data(&self.rgb);
        write(encoder).map_err(|e| Error::invalid(format!("cannot write a PNG of {} x {} pixels: {e}", self.width, self.height)))?;
        Ok(bytes)
    }

    /// Writes the image to the PNG file `path`.
    pub fn write_png(&self, path: impl AsRef<Path>) -> Result<()> {
        io::write_atomic(path, &self.png()?)
    }
}

/// A colour for `t` in 0..=1, from dark blue over teal to yellow (nodes of the viridis map).
pub fn ramp(t: f32) -> Rgb {
    const NODES: [Rgb; 5] = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
    let s = t.clamp(0.0, 1.0) * (NODES.len() - 1) as f32;
    let i = (s as usize).min(NODES.len() - 2);
    let f = s - i as f32;
    std::array::from_fn(|k| (NODES[i][k] as f32 * (1.0 - f) + NODES[i + 1][k] as f32 * f).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_keeps_every_pixel() {
        let mut image = Image::filled(3, 2, [10, 20, 30]);
        image.blend(2, 1, [200, 100, 0], 1.0);
        image.blend(0, 0, [110, 120, 130], 0.5);
        image.blend(-1, 5, [9, 9, 9], 1.0);
        let bytes = image.png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut out = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut out).unwrap();
        assert_eq!(out, image.rgb);
        assert_eq!(&out[..3], [60, 70, 80]);
        assert_eq!(&out[15..], [200, 100, 0]);
    }

    #[test]
    fn an_empty_image_is_refused() {
        assert!(Image::filled(0, 4, [0; 3]).png().is_err());
    }

    #[test]
    fn paste_cuts_at_the_border() {
        let mut image = Image::filled(4, 4, [0; 3]);
        image.paste(&Image::filled(3, 3, [7; 3]), 2, 3);
        assert_eq!(image.rgb.iter().filter(|&&v| v == 7).count(), 2 * 3);
        assert_eq!(image.pixel(3, 3), [7; 3]);
        image.paste(&Image::filled(3, 3, [7; 3]), 9, 9);
    }

    #[test]
    fn ramp_hits_its_nodes() {
        assert_eq!(ramp(-1.0), [68, 1, 84]);
        assert_eq!(ramp(0.5), [33, 145, 140]);
        assert_eq!(ramp(1.0), [253, 231, 37]);
        assert_eq!(ramp(0.125), [64, 42, 112]);
    }
}
