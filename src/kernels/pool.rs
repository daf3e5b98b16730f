//! Work spread over threads in blocks of rows, with scratch memory that is kept between calls.

use crate::{Error, Result};
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Scratch buffers, handed out and taken back.
#[derive(Debug, Default)]
pub(super) struct Pool(Mutex<Vec<Vec<f32>>>);

impl Pool {
    /// Runs `work` with a buffer of `len` floats of any content.
    pub fn with(&self, len: usize, work: impl FnOnce(&mut [f32])) {
        let mut buffer = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        if buffer.len() < len {
            buffer.resize(len, 0.0);
        }
        work(&mut buffer[..len]);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(buffer);
    }

    /// Calls `work(first row, rows, their part of out, scratch)` for blocks of at most `most` rows of `out`, in parallel.
    ///
    /// A row's result may not depend on its block, since the blocks depend on the number of threads.
    pub fn blocks(
        &self,
        out: &mut [f32],
        width: usize,
        most: usize,
        scratch: usize,
        work: impl Fn(usize, usize, &mut [f32], &mut [f32]) + Sync,
    ) {
        let rows = out.len() / width;
        let block = rows.div_ceil(rayon::current_num_threads()).clamp(1, most);
        out.par_chunks_mut(block * width).enumerate().for_each(|(b, out)| {
            let rows = out.len() / width;
            self.with(scratch * rows, |scratch| work(b * block, rows, out, scratch));
        });
    }
}

/// Cuts the first `len` floats off `scratch`.
pub(super) fn take<'a>(scratch: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    let (head, tail) = std::mem::take(scratch).split_at_mut(len);
    *scratch = tail;
    head
}

/// The error of an array `what` that is not as long as it should be.
pub(super) fn check(what: &str, have: usize, want: usize) -> Result<()> {
    if have == want { Ok(()) } else { Err(Error::invalid(format!("{what} has {have} floats, expected {want}"))) }
}
