//! Checkpoints: everything a run needs to continue bit for bit.
//!
//! `checkpoints/epoch-NNNN/` (or `epoch-NNNN-update-MMMM/`, where a run was interrupted within the next epoch) holds
//! `model.safetensors`, `optimizer.safetensors`, `state.bin` (environments, counters, sums of a begun epoch) and
//! `checkpoint.json`, which describes the policy and carries the hashes of the other files.

use crate::ppo::Progress;
use crate::stats::EpochStats;
use crate::{AdamW, Error, Result};
use egogen::agent::{ActionSpace, ObsLayout, PolicyConfig, PolicySpec};
use egogen::io::{Precision, Tensors, content_hash, pack_tensors, write_atomic};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

const FORMAT: u32 = 2;
const DESCRIPTION: &str = "checkpoint.json";
const MODEL: &str = "model.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const STATE: &str = "state.bin";

/// What a checkpoint says about itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Version of the checkpoint format.
    pub format: u32,
    /// Recipe it comes from.
    pub recipe: String,
    /// Seed of the run.
    pub seed: u64,
    /// Whole epochs done.
    pub epoch: u64,
    /// Environment steps done.
    pub env_steps: u64,
    /// What the policy sees.
    pub layout: ObsLayout,
    /// Sizes of the policy.
    pub policy: PolicyConfig,
    /// What an action is.
    pub action: ActionSpace,
    /// Content hashes of what observations and actions stand on.
    pub origin: BTreeMap<String, String>,
    /// Figures of the last test before it.
    pub test: BTreeMap<String, f64>,
    /// Content hashes of the other files; filled in by [`Checkpoint::write`].
    pub files: BTreeMap<String, String>,
}

/// The checkpoint that did best in tests.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Best {
    /// Folder name.
    pub name: String,
    /// Value of the figure `checkpoint.best`.
    pub value: f64,
}

/// Counters and sums beside weights and environments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    pub epoch: u64,
    pub env_steps: u64,
    pub adam_steps: u64,
    pub best: Option<Best>,
    /// Figures of the last test.
    pub last_test: BTreeMap<String, f64>,
    /// Updates done, and what schedules and normalisers have come to.
    pub learning: Progress,
    /// Sums of the begun epoch.
    pub stats: EpochStats,
    /// What [`crate::Collector::save`] wrote.
    pub collector: Vec<u8>,
}

/// A whole checkpoint in memory.
pub struct Checkpoint {
    pub description: Description,
    pub params: Vec<f32>,
    pub adam: AdamW,
    pub state: State,
}

impl Checkpoint {
    /// Folder name within `checkpoints/`.
    pub fn name(&self) -> String {
        match self.state.stats.updates {
            0 => format!("epoch-{:04}", self.state.epoch),
            n => format!("epoch-{:04}-update-{n:04}", self.state.epoch),
        }
    }

    /// Writes the checkpoint below `root` under a temporary name and renames it.
    pub fn write(&self, root: &Path, spec: &PolicySpec) -> Result<()> {
        let metadata = BTreeMap::new();
        let moments: Vec<_> = [("first", &self.adam.first), ("second", &self.adam.second)]
            .into_iter()
            .map(|(name, v)| (name.to_string(), vec![v.len()], v.clone()))
            .collect();
        let state = postcard::to_stdvec(&self.state).map_err(|e| Error::run(format!("cannot save the counters: {e}")))?;
        let files = [
            (MODEL, pack_tensors(&spec.to_tensors(&self.params), &metadata, Precision::Full)?),
            (OPTIMIZER, pack_tensors(&moments, &metadata, Precision::Full)?),
            (STATE, state),
        ];
        let mut description = self.description.clone();
        let name = self.name();
        let (temporary, last) = (root.join(format!(".{name}.tmp")), root.join(&name));
        let io = |path: &Path, e| Error::Core(egogen::Error::io(path, e));
        remove(&temporary)?;
        for (file, bytes) in &files {
            write_atomic(temporary.join(file), bytes)?;
            description.files.insert(file.to_string(), content_hash(bytes));
        }
        let text = serde_json::to_string_pretty(&description).map_err(|e| Error::run(format!("cannot describe the checkpoint: {e}")))?;
        write_atomic(temporary.join(DESCRIPTION), text.as_bytes())?;
        remove(&last)?;
        fs::rename(&temporary, &last).map_err(|e| io(&last, e))
    }

    /// Reads a checkpoint folder; every file must be whole.
    pub fn read(dir: &Path) -> Result<Self> {
        let description = Self::describe(dir)?;
        let spec = PolicySpec::new(description.policy.clone(), description.layout.clone(), description.action)?;
        let checked = |name: &str| -> Result<Vec<u8>> {
            let path = dir.join(name);
            let bytes = fs::read(&path).map_err(|e| egogen::Error::io(&path, e))?;
            match description.files.get(name) {
                Some(hash) if *hash == content_hash(&bytes) => Ok(bytes),
                _ => Err(egogen::Error::file(&path, "is damaged: its content does not have the hash in checkpoint.json").into()),
            }
        };
        let state: State = postcard::from_bytes(&checked(STATE)?).map_err(|e| egogen::Error::file(dir.join(STATE), e.to_string()))?;
        let params = spec.from_tensors(&Tensors::from_bytes(dir.join(MODEL), checked(MODEL)?)?)?;
        let moments = Tensors::from_bytes(dir.join(OPTIMIZER), checked(OPTIMIZER)?)?;
        let size = [spec.learned()];
        let adam = AdamW { steps: state.adam_steps, first: moments.f32s("first", &size)?, second: moments.f32s("second", &size)? };
        Ok(Self { description, params, adam, state })
    }

    /// The description and the parameters alone.
    pub fn read_policy(dir: &Path) -> Result<(Description, PolicySpec, Vec<f32>)> {
        let whole = Self::read(dir)?;
        let d = &whole.description;
        let spec = PolicySpec::new(d.policy.clone(), d.layout.clone(), d.action)?;
        Ok((whole.description, spec, whole.params))
    }

    fn describe(dir: &Path) -> Result<Description> {
        let path = dir.join(DESCRIPTION);
        let text = fs::read_to_string(&path).map_err(|e| egogen::Error::io(&path, e))?;
        let description: Description = serde_json::from_str(&text).map_err(|e| egogen::Error::file(&path, e.to_string()))?;
        if description.format != FORMAT {
            return Err(egogen::Error::file(&path, format!("format is {}, expected {FORMAT}", description.format)).into());
        }
        Ok(description)
    }
}

impl Description {
    /// The format's current version, for new checkpoints.
    pub const FORMAT: u32 = FORMAT;
}

/// Names of all checkpoints below `root`, oldest first.
pub fn list(root: &Path) -> Vec<String> {
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.filter_map(|e| e.file_name().into_string().ok()).filter(|n| n.starts_with("epoch-")).collect();
    names.sort();
    names
}

/// The newest whole checkpoint below `root`; `warn` hears about each that is damaged.
pub fn newest(root: &Path, mut warn: impl FnMut(String)) -> Result<Checkpoint> {
    for name in list(root).into_iter().rev() {
        match Checkpoint::read(&root.join(&name)) {
            Ok(checkpoint) => return Ok(checkpoint),
            Err(e) => warn(format!("checkpoint {name} cannot be used: {e}")),
        }
    }
    Err(Error::run(format!("{}: holds no whole checkpoint", root.display())))
}

/// Removes all but the newest `keep` checkpoints and the best.
pub fn prune(root: &Path, keep: usize, best: Option<&Best>) -> Result<()> {
    let names = list(root);
    let old = names.len().saturating_sub(keep);
    for name in names[..old].iter().filter(|n| best.is_none_or(|b| b.name != **n)) {
        remove(&root.join(name))?;
    }
    Ok(())
}

fn remove(dir: &PathBuf) -> Result<()> {
    match fs::remove_dir_all(dir) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(egogen::Error::io(dir, e).into()),
        _ => Ok(()),
    }
}
