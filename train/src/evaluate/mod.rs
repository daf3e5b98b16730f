//! Policies and baselines on the same held-out starts: scenarios, who acts, what is measured, what is reported.

mod actors;
mod episodes;
mod estimate;
mod fate;
mod figures;
mod measure;
mod page;
mod people;
mod pictures;
mod rows;
mod scenario;
mod setup;
mod way;

pub use actors::{Actor, Greedy};
pub use episodes::{Film, Played, play};
pub use estimate::{Estimate, mean, proportion, ratio, share};
pub use fate::{Fate, THROUGH};
pub use figures::{Better, FIGURES, Figure, OF_STARTS};
pub use measure::{Measured, measure};
pub use page::{Outcome, add_meanings, add_scenario};
pub use pictures::write_motions;
pub use rows::{Row, differences, table};
pub use scenario::{Layout, Looks, Moving, Scenario, shipped};
pub use setup::{Setup, Solids};
