//! What an epoch takes by the clock.

use crate::stats::Row;

/// Wall-clock seconds of an epoch.
#[derive(Default)]
pub(crate) struct Clock {
    pub collect: f64,
    pub learn: f64,
    pub test: f64,
}

impl Clock {
    pub fn total(&self) -> f64 {
        self.collect + self.learn + self.test
    }

    pub fn row(&self, steps: u64) -> Row {
        let figures = [
            ("steps_per_second", steps as f64 / self.total()),
            ("collect_seconds", self.collect),
            ("learn_seconds", self.learn),
            ("test_seconds", self.test),
        ];
        figures.into_iter().map(|(n, v)| (n.to_string(), Some(v))).collect()
    }
}
