//! Checkpoints: everything a run needs to continue bit for bit.
//!
//! `checkpoints/epoch-NNNN/` (or `epoch-NNNN-update-MMMM/`, where a run was interrupted within the next epoch) holds
//! `model.safetensors`, `optimizer.safetensors`, `state.bin` (environments, counters, sums of a begun epoch), `recipe.toml` and
//! `checkpoint.json`, which describes the policy and carries the hashes of the other files.

use crate::course::Course;
use crate::ppo::Progress;
use crate::recipe::CheckpointConfig;
use crate::stats::EpochStats;
use crate::{AdamW, Error, Result, RewardScaling};
use egogen::agent::{ActionSpace, ObsLayout, PolicyConfig, PolicySpec};
use egogen::io::{Precision, Tensors, clear_folder, content_hash, discard_folder, pack_tensors, replace_folder, write_atomic};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

const FORMAT: u32 = 5;
/// Oldest format that is read: it has no `recipe.toml` and no [`State::last_epoch`]. No format below 4 has [`State::scaling`], none
/// below 5 [`State::course`].
const OLDEST: u32 = 2;
pub(crate) const DESCRIPTION: &str = "checkpoint.json";
const MODEL: &str = "model.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
pub(crate) const STATE: &str = "state.bin";
pub(crate) const RECIPE: &str = "recipe.toml";

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
    /// Figures of the last whole epoch.
    pub last_epoch: BTreeMap<String, f64>,
    /// Scale of rewards.
    pub scaling: RewardScaling,
    /// Curricula and convergence.
    pub course: Course,
}

/// A whole checkpoint in memory.
pub struct Checkpoint {
    pub description: Description,
    /// The run's recipe as TOML; `None` in checkpoints of format 2.
    pub recipe: Option<String>,
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

    /// Writes the checkpoint below `root`, whole or not at all.
    pub fn write(&self, root: &Path, spec: &PolicySpec) -> Result<()> {
        replace_folder(&root.join(self.name()), |dir| self.write_files(dir, spec))
    }

    fn write_files(&self, dir: &Path, spec: &PolicySpec) -> Result<()> {
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
            (RECIPE, self.recipe.clone().unwrap_or_default().into_bytes()),
        ];
        let mut description = self.description.clone();
        for (file, bytes) in &files {
            write_atomic(dir.join(file), bytes)?;
            description.files.insert(file.to_string(), content_hash(bytes));
        }
        let text = serde_json::to_string_pretty(&description).map_err(|e| Error::run(format!("cannot describe the checkpoint: {e}")))?;
        Ok(write_atomic(dir.join(DESCRIPTION), text.as_bytes())?)
    }

    /// Reads a checkpoint folder; every file must be whole and belong to the others.
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
        let mut state = checked(STATE)?;
        if description.format == OLDEST {
            // postcard writes fields one after the other, and an empty map as one zero.
            state.push(0);
        }
        let old = |e| Error::run(format!("cannot read an older checkpoint: {e}"));
        if description.format < 4 {
            state.extend(postcard::to_stdvec(&RewardScaling::default()).map_err(old)?);
        }
        if description.format < 5 {
            state.extend(postcard::to_stdvec(&Course::default()).map_err(old)?);
        }
        let state: State = postcard::from_bytes(&state).map_err(|e| egogen::Error::file(dir.join(STATE), e.to_string()))?;
        if (description.epoch, description.env_steps) != (state.epoch, state.env_steps) {
            let what = format!("is of epoch {}, but {STATE} is of epoch {}", description.epoch, state.epoch);
            return Err(egogen::Error::file(dir.join(DESCRIPTION), what).into());
        }
        let recipe = match description.format {
            OLDEST => None,
            _ => Some(String::from_utf8(checked(RECIPE)?).map_err(|e| egogen::Error::file(dir.join(RECIPE), e.to_string()))?),
        };
        let params = spec.from_tensors(&Tensors::from_bytes(dir.join(MODEL), checked(MODEL)?)?)?;
        let moments = Tensors::from_bytes(dir.join(OPTIMIZER), checked(OPTIMIZER)?)?;
        let size = [spec.learned()];
        let adam = AdamW { steps: state.adam_steps, first: moments.f32s("first", &size)?, second: moments.f32s("second", &size)? };
        Ok(Self { description, recipe, params, adam, state })
    }

    /// The description and the parameters alone.
    pub fn read_policy(dir: &Path) -> Result<(Description, PolicySpec, Vec<f32>)> {
        let whole = Self::read(dir)?;
        let d = &whole.description;
        let spec = PolicySpec::new(d.policy.clone(), d.layout.clone(), d.action)?;
        Ok((whole.description, spec, whole.params))
    }

    /// A folder under another checkpoint's name would be taken for newer or older than it is.
    fn check_name(&self, dir: &Path, name: &str) -> Result<()> {
        if position(name) == position(&self.name()) {
            return Ok(());
        }
        Err(egogen::Error::file(dir.join(DESCRIPTION), format!("is {}, in a folder of another name", self.name())).into())
    }

    fn describe(dir: &Path) -> Result<Description> {
        let path = dir.join(DESCRIPTION);
        let text = fs::read_to_string(&path).map_err(|e| egogen::Error::io(&path, e))?;
        let bad = |what: String| Error::Core(egogen::Error::file(&path, what));
        // Other formats have other keys, so this one is looked at first.
        #[derive(Deserialize)]
        struct Version {
            format: u32,
        }
        match serde_json::from_str::<Version>(&text).map_err(|e| bad(e.to_string()))?.format {
            OLDEST..=FORMAT => serde_json::from_str(&text).map_err(|e| bad(e.to_string())),
            newer if newer > FORMAT => {
                Err(bad(format!("format is {newer}, from a newer version of this program; expected at most {FORMAT}")))
            }
            older => Err(bad(format!("format is {older}, which can no longer be read; expected {OLDEST} to {FORMAT}"))),
        }
    }
}

impl Description {
    /// The format's current version, for new checkpoints.
    pub const FORMAT: u32 = FORMAT;
}

/// Epoch and update in a checkpoint's folder name.
fn position(name: &str) -> Option<(u64, u64)> {
    let (epoch, update) = name.strip_prefix("epoch-").map(|n| n.split_once("-update-").unwrap_or((n, "0")))?;
    Some((epoch.parse().ok()?, update.parse().ok()?))
}

/// Names of all checkpoints below `root`, oldest first.
pub fn list(root: &Path) -> Vec<String> {
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.filter_map(|e| e.file_name().into_string().ok()).filter(|n| position(n).is_some()).collect();
    names.sort_by_key(|n| position(n));
    names
}

/// The newest checkpoint below `root` that is whole and that `accept` takes; `None` where there is no checkpoint at all.
///
/// Newer ones that cannot be used are set aside as `refused-NAME`, and `warn` hears about each.
/// Fails with every checkpoint's reason where none can be used.
pub fn newest(root: &Path, mut accept: impl FnMut(&Checkpoint) -> Result<()>, mut warn: impl FnMut(String)) -> Result<Option<Checkpoint>> {
    let mut refused: Vec<(String, Error)> = Vec::new();
    for name in list(root).into_iter().rev() {
        let dir = root.join(&name);
        match Checkpoint::read(&dir).and_then(|c| c.check_name(&dir, &name).and_then(|()| accept(&c)).map(|()| c)) {
            Ok(checkpoint) => {
                for (bad, why) in refused {
                    let aside = root.join(format!("refused-{bad}"));
                    clear_folder(&aside)?;
                    fs::rename(root.join(&bad), &aside).map_err(|e| egogen::Error::io(&aside, e))?;
                    warn(format!("{why}; the run continues from {name}, and {bad} is now refused-{bad}"));
                }
                return Ok(Some(checkpoint));
            }
            Err(why) => refused.push((name, why)),
        }
    }
    if refused.is_empty() {
        return Ok(None);
    }
    let reasons: Vec<String> = refused.iter().map(|(_, why)| format!("\n  {why}")).collect();
    Err(Error::config(format!("{}: no checkpoint can be continued:{}", root.display(), reasons.concat())))
}

/// Removes checkpoints but for the newest `keep`, the best, and those of whole epochs that `keep_every` divides.
pub fn prune(root: &Path, rule: &CheckpointConfig, best: Option<&Best>) -> Result<()> {
    let names = list(root);
    let old = names.len().saturating_sub(rule.keep);
    for name in &names[..old] {
        let every = rule.keep_every.is_some_and(|n| position(name).is_some_and(|(epoch, update)| epoch.is_multiple_of(n) && update == 0));
        if !every && best.is_none_or(|b| b.name != *name) {
            discard_folder(&root.join(name))?;
        }
    }
    Ok(())
}

/// Whether a file or folder of that name was being written, or removed, when its program was killed.
pub fn is_leftover(name: &str) -> bool {
    name.rsplit_once(".tmp").is_some_and(|(_, process)| process.bytes().all(|b| b.is_ascii_digit()))
}

/// Removes what a killed program left half done in `dir`.
pub fn sweep(dir: &Path) -> Result<()> {
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let path = entry.path();
        if !entry.file_name().to_str().is_some_and(is_leftover) {
            continue;
        }
        if path.is_dir() {
            clear_folder(&path)?;
        } else {
            fs::remove_file(&path).map_err(|e| egogen::Error::io(&path, e))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_the_best_and_every_nth_are_kept() {
        let root = tempfile::tempdir().unwrap();
        let rule = |keep, keep_every| CheckpointConfig { every: 1, keep, keep_every, best: String::new(), max_kl_prior: None };
        let best = Best { name: "epoch-0003".into(), value: 1.0 };
        let names = ["epoch-0002", "epoch-0003", "epoch-0004", "epoch-0004-update-0002", "epoch-0005", "epoch-9999", "epoch-10000"];
        names.iter().for_each(|n| fs::create_dir(root.path().join(n)).unwrap());
        fs::create_dir(root.path().join("refused-epoch-0001")).unwrap();
        assert_eq!(list(root.path()), names, "by number, not by letter");
        prune(root.path(), &rule(3, Some(4)), Some(&best)).unwrap();
        assert_eq!(list(root.path()), ["epoch-0003", "epoch-0004", "epoch-0005", "epoch-9999", "epoch-10000"]);
        prune(root.path(), &rule(1, None), None).unwrap();
        assert_eq!(list(root.path()), ["epoch-10000"]);
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 2, "nothing half removed, and what was set aside stays");
    }

    #[test]
    fn only_what_was_half_done_is_swept() {
        let root = tempfile::tempdir().unwrap();
        for name in ["metrics.csv", "metrics.csv.tmp71", "a.tmpl"] {
            fs::write(root.path().join(name), "x").unwrap();
        }
        fs::create_dir_all(root.path().join(".epoch-0002.tmp/inner")).unwrap();
        sweep(root.path()).unwrap();
        let mut left: Vec<_> = fs::read_dir(root.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["a.tmpl", "metrics.csv"]);
    }
}
