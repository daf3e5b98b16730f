//! A small point-to-goal task for testing trainers.
