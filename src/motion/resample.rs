//! Frame rates of recordings and how they become 40 frames per second.

use super::FPS;
use crate::{Error, Result};
use std::path::Path;

/// Frame rates a recording may have.
const RATES: std::ops::RangeInclusive<f32> = 10.0..=1000.0;
/// Part by which a rate may miss a multiple of 40 and still count as one (119.88 does).
const TOLERANCE: f32 = 2e-3;

/// `fps` if it is a rate that recordings have; the error names the file and the `key` that holds it.
pub fn check_fps(path: &Path, key: &str, fps: f32) -> Result<f32> {
    if !RATES.contains(&fps) {
        let what = format!("'{key}' means {fps} frames per second, expected {} to {}", RATES.start(), RATES.end());
        return Err(Error::file(path, what));
    }
    Ok(fps)
}

/// Frames at 40 per second from frames at `fps`.
///
/// A multiple of 40 is thinned out, so that each frame stays as recorded; for any other rate frame i lies at i fps / 40 between two
/// recorded ones and is made by `between(a, b, s)`, s in 0..1. Errors name the clip when its rate is out of bounds.
pub fn resample<T: Clone>(name: &str, frames: &[T], fps: f32, between: fn(&T, &T, f32) -> T) -> Result<Vec<T>> {
    if !RATES.contains(&fps) {
        return Err(Error::invalid(format!("clip {name}: {fps} frames per second, expected {} to {}", RATES.start(), RATES.end())));
    }
    let step = (fps / FPS).round();
    if step > 0.0 && (fps - FPS * step).abs() <= TOLERANCE * fps {
        return Ok(frames.iter().step_by(step as usize).cloned().collect());
    }
    let Some(last) = frames.len().checked_sub(1) else { return Ok(Vec::new()) };
    let ratio = f64::from(fps) / f64::from(FPS);
    let count = (last as f64 / ratio + 1e-6) as usize + 1;
    let at = |i: usize| {
        let t = i as f64 * ratio;
        let k = (t as usize).min(last);
        between(&frames[k], &frames[(k + 1).min(last)], (t - k as f64) as f32)
    };
    Ok((0..count).map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(frames: usize, fps: f32) -> Vec<f32> {
        let frames: Vec<f32> = (0..frames).map(|t| t as f32).collect();
        resample("line", &frames, fps, |a, b, s| a + s * (b - a)).unwrap()
    }

    #[test]
    fn multiples_are_thinned_and_other_rates_interpolated() {
        assert_eq!(line(7, 120.0), [0.0, 3.0, 6.0]);
        assert_eq!(line(7, 119.88), [0.0, 3.0, 6.0]);
        assert_eq!(line(3, 40.0), [0.0, 1.0, 2.0]);
        assert_eq!(line(7, 60.0), [0.0, 1.5, 3.0, 4.5, 6.0]);
        assert_eq!(line(3, 25.0), [0.0, 0.625, 1.25, 1.875]);
        assert_eq!(line(1, 24.0), [0.0]);
        assert!(line(0, 24.0).is_empty());
    }

    #[test]
    fn absurd_rates_are_refused() {
        for fps in [0.0, -40.0, f32::NAN, f32::INFINITY, 5.0] {
            let message = resample("walk", &[0.0], fps, |a, _, _| *a).unwrap_err().to_string();
            assert!(message.contains("clip walk") && message.contains("expected 10 to 1000"), "{message}");
            let message = check_fps(Path::new("a.npz"), "mocap_framerate", fps).unwrap_err().to_string();
            assert!(message.contains("a.npz: 'mocap_framerate'"), "{message}");
        }
    }
}
