//! Policies and baselines on the same held-out starts: who acts, what is measured, what is reported.

mod actors;
mod episodes;
mod report;

pub use actors::{Actor, Greedy};
pub use episodes::{Film, Played, play};
pub use report::{Estimate, Row, mean, proportion, ratio, table};
