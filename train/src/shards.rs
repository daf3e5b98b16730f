//! A batch split over a fixed number of pieces, each with a thread and a graph of its own.

use crate::{Error, Result};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::ops::Range;

/// A fixed number of single-threaded workers.
///
/// The split is part of the recipe, not of the machine, so sums over shards come out the same on any number of cores; whatever
/// runs in a shard (burn's products) sees one thread and stays on its core.
pub struct Shards {
    pools: Vec<ThreadPool>,
    parallel: bool,
}

impl Shards {
    /// `count` shards, run side by side when `threads` allows it.
    pub fn new(count: usize, threads: usize) -> Result<Self> {
        let pool = |_| ThreadPoolBuilder::new().num_threads(1).build().map_err(|e| Error::run(format!("cannot start a thread: {e}")));
        Ok(Self { pools: (0..count).map(pool).collect::<Result<_>>()?, parallel: threads > 1 })
    }

    /// Every shard's part of `rows` rows; fewer rows than shards leave some of them out.
    pub fn ranges(&self, rows: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        let count = self.pools.len().min(rows);
        (0..count).map(move |i| i * rows / count..(i + 1) * rows / count)
    }

    /// Runs `work` on every shard's part of `rows` rows; results in the order of the shards.
    pub fn map<T: Send>(&self, rows: usize, work: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
        let (work, parts) = (&work, self.pools.iter().zip(self.ranges(rows)));
        if !self.parallel {
            return parts.map(|(pool, part)| pool.install(|| work(part))).collect();
        }
        std::thread::scope(|scope| {
            let start = |(pool, part)| scope.spawn(move || ThreadPool::install(pool, || work(part)));
            let running: Vec<_> = parts.map(start).collect();
            running.into_iter().map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
        })
    }
}
