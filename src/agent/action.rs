//! What an action is.

use serde::{Deserialize, Serialize};

/// What an action is. Written as a number for continuous ones, as `{"discrete": k}` for choices.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Written", into = "Written")]
pub enum ActionSpace {
    /// A vector of that many unbounded floats.
    Continuous(usize),
    /// One of that many choices, given as a float holding the index.
    Discrete(usize),
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Written {
    Continuous(usize),
    Discrete { discrete: usize },
}

impl ActionSpace {
    /// Floats per action in a step's batch.
    pub fn width(&self) -> usize {
        match self {
            Self::Continuous(n) => *n,
            Self::Discrete(_) => 1,
        }
    }

    /// Floats of a continuous action, or choices.
    pub fn count(&self) -> usize {
        match self {
            Self::Continuous(n) | Self::Discrete(n) => *n,
        }
    }
}

impl From<usize> for ActionSpace {
    fn from(n: usize) -> Self {
        Self::Continuous(n)
    }
}

impl From<Written> for ActionSpace {
    fn from(written: Written) -> Self {
        match written {
            Written::Continuous(n) => Self::Continuous(n),
            Written::Discrete { discrete } => Self::Discrete(discrete),
        }
    }
}

impl From<ActionSpace> for Written {
    fn from(action: ActionSpace) -> Self {
        match action {
            ActionSpace::Continuous(n) => Self::Continuous(n),
            ActionSpace::Discrete(discrete) => Self::Discrete { discrete },
        }
    }
}
