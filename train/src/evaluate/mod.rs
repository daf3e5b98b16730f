//! Policies and baselines on the same held-out starts: who acts, what is measured, what is reported.

mod actors;
mod episodes;
mod report;
mod scenario;
mod setup;
mod way;

pub use actors::{Actor, Greedy};
pub use episodes::{Film, Played, play};
pub use report::{Estimate, Row, mean, proportion, ratio, table};
pub use scenario::{Layout, Looks, Moving, Scenario, shipped};
pub use setup::{Setup, Solids};
