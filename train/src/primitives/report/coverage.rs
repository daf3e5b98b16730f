//! Where people go within one primitive.

use crate::primitives::gait::displacement;
use egogen::motion::clip::quantile;
use egogen::motion::{FPS, FRAMES, FUTURE, MotionSet};
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;

/// Bins to each side of a histogram.
pub const BINS: usize = 30;
/// What histograms cover; what lies outside counts in the outermost bin. Forward and sideways speed (to the right), m/s, and turn per
/// primitive, degrees (to the left).
pub const FORWARD: Range<f64> = -1.5..2.25;
pub const SIDEWAYS: Range<f64> = -1.2..1.2;
pub const TURN: Range<f64> = -90.0..90.0;
/// Who moves less than this in the plane, m/s, and turns less than this, degrees, stands still.
const STILL: (f32, f32) = (0.1, 10.0);
/// Frames between the primitives that are looked at in recordings.
const STRIDE: usize = 6;

/// Speeds and turns of many primitives.
#[derive(Clone, Debug, Serialize)]
pub struct Coverage {
    pub name: String,
    pub primitives: usize,
    /// 1, 5, 50, 95, 99 %.
    pub forward: [f32; 5],
    pub sideways: [f32; 5],
    pub turn: [f32; 5],
    /// Share that stands still.
    pub still: f32,
    /// Common area of the histograms with those of the training set, 0 to 1: forward and sideways speed, forward speed and turn.
    pub overlap: Option<[f64; 2]>,
    pub histograms: Histograms,
}

/// Counts; maps hold rows of [`BINS`] forward speeds, the first row that of the lowest sideways speed or turn.
#[derive(Clone, Debug, Serialize)]
pub struct Histograms {
    pub forward: Vec<f64>,
    pub sideways: Vec<f64>,
    pub turn: Vec<f64>,
    pub forward_sideways: Vec<f64>,
    pub forward_turn: Vec<f64>,
}

impl Coverage {
    /// Of displacements (right and ahead in metres, degrees).
    pub fn new(name: &str, ways: &[[f32; 3]]) -> Self {
        let rate = FPS / FUTURE as f32;
        let moves: Vec<[f32; 3]> = ways.iter().map(|[right, ahead, turn]| [ahead * rate, right * rate, *turn]).collect();
        let column = |k: usize| moves.iter().map(|m| m[k]).collect::<Vec<f32>>();
        let five = |k: usize| {
            let values = column(k);
            [0.01, 0.05, 0.5, 0.95, 0.99].map(|q| quantile(&values, q))
        };
        let still = moves.iter().filter(|m| m[0].hypot(m[1]) < STILL.0 && m[2].abs() < STILL.1).count();
        Self {
            name: name.into(),
            primitives: moves.len(),
            forward: five(0),
            sideways: five(1),
            turn: five(2),
            still: still as f32 / moves.len().max(1) as f32,
            overlap: None,
            histograms: Histograms::new(&moves),
        }
    }

    /// Of the primitives in recorded motion.
    pub fn recorded(name: &str, set: &MotionSet) -> Self {
        let windows = set.windows(FRAMES, STRIDE);
        let way = |&(clip, t): &(usize, usize)| displacement(&set.frame(clip, t), &set.frame(clip, t + FUTURE));
        Self::new(name, &windows.par_iter().map(way).collect::<Vec<_>>())
    }

    /// With the overlap with `other`.
    pub fn beside(mut self, other: &Self) -> Self {
        let (a, b) = (&self.histograms, &other.histograms);
        self.overlap = Some([overlap(&a.forward_sideways, &b.forward_sideways), overlap(&a.forward_turn, &b.forward_turn)]);
        self
    }
}

impl Histograms {
    fn new(moves: &[[f32; 3]]) -> Self {
        let empty = |n: usize| vec![0.0; n];
        let mut h = Self {
            forward: empty(BINS),
            sideways: empty(BINS),
            turn: empty(BINS),
            forward_sideways: empty(BINS * BINS),
            forward_turn: empty(BINS * BINS),
        };
        for [forward, sideways, turn] in moves {
            let (f, s, t) = (bin(*forward, &FORWARD), bin(*sideways, &SIDEWAYS), bin(*turn, &TURN));
            h.forward[f] += 1.0;
            h.sideways[s] += 1.0;
            h.turn[t] += 1.0;
            h.forward_sideways[s * BINS + f] += 1.0;
            h.forward_turn[t * BINS + f] += 1.0;
        }
        h
    }
}

fn bin(value: f32, range: &Range<f64>) -> usize {
    let at = (f64::from(value) - range.start) / (range.end - range.start) * BINS as f64;
    (at.max(0.0) as usize).min(BINS - 1)
}

/// Common area of two histograms, each scaled to a sum of 1.
fn overlap(a: &[f64], b: &[f64]) -> f64 {
    let sum = |v: &[f64]| v.iter().sum::<f64>();
    let (p, q) = (sum(a), sum(b));
    a.iter().zip(b).map(|(x, y)| (x / p).min(y / q)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_and_overlap_by_hand() {
        // 30 bins of 0.125 m/s from -1.5: 0 lies in bin 12, what is out of range in the outermost.
        assert_eq!([0.0, 0.1249, 0.125, -9.0, 9.0].map(|v| bin(v, &FORWARD)), [12, 12, 13, 0, 29]);
        assert!((overlap(&[1.0, 3.0], &[2.0, 2.0]) - 0.75).abs() < 1e-12);
    }

    #[test]
    fn speeds_and_standing_by_hand() {
        // 0.45 m ahead is 1 m/s; 4 cm and 9 degrees are standing, 11 degrees on the spot are not.
        let ways = [[0.0, 0.45, 0.0], [0.0, 0.04, 9.0], [0.0, 0.0, 11.0], [-0.09, 0.0, 0.0]];
        let c = Coverage::new("x", &ways);
        assert_eq!((c.primitives, c.still), (4, 0.25));
        assert!((c.forward[4] - 1.0).abs() < 1e-5 && (c.sideways[0] + 0.2).abs() < 1e-5 && c.turn[4] == 11.0);
        assert_eq!(c.histograms.forward_turn.iter().sum::<f64>(), 4.0);
        let row = bin(-0.2, &SIDEWAYS);
        assert_eq!(c.histograms.forward_sideways[row * BINS + 12], 1.0);
        assert_eq!(c.clone().beside(&c).overlap, Some([1.0, 1.0]));
    }
}
