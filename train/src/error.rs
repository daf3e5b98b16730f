//! What can go wrong in training, and the exit code it leads to.

/// Shorthand for results of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Errors of the trainer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A recipe, an option or a run folder is not usable: exit code 2.
    #[error("{0}")]
    Config(String),
    /// The run failed: exit code 1.
    #[error("{0}")]
    Run(String),
    /// The environment refused.
    #[error("environment: {0}")]
    Env(#[from] egogen_envs::EnvError),
    /// A file or a value of the library.
    #[error(transparent)]
    Core(#[from] egogen::Error),
}

impl Error {
    /// A bad recipe or option; `what` names file, key, value and what would be right.
    pub fn config(what: impl Into<String>) -> Self {
        Self::Config(what.into())
    }

    /// A failure while running.
    pub fn run(what: impl Into<String>) -> Self {
        Self::Run(what.into())
    }

    /// The process's exit code.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Config(_) => 2,
            _ => 1,
        }
    }
}
