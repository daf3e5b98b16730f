//! The program `train`.

use crate::checkpoint::is_leftover;
use crate::job::Job;
use crate::program::{self, Given, INTERRUPTED};
use crate::recipe::{EMBEDDED, Plan, Recipe, of_run};
use crate::registry::{Purpose, Registry};
use crate::report::{Group, page};
use crate::seeds::Seeds;
use crate::select::select;
use crate::stages::Scheme;
use crate::start::{initial, policy_spec};
use crate::sweep::{Folder, Manifest, Standing, Sweep};
use crate::trainer::{Outcome, Trainer, export};
use crate::{Error, Result};
use clap::{Parser, Subcommand};
use egogen::agent::ActionSpace;
use egogen::agent::bundle::Bundle;
use egogen::io::write_atomic;
use egogen::kernels::keep_memory;
use std::fs::DirEntry;
use std::num::{NonZeroU64, NonZeroUsize};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Trains a policy from a recipe.
#[derive(Debug, Parser)]
#[command(
    name = "train",
    version,
    args_conflicts_with_subcommands = true,
    after_help = "Examples:
  train                                   train the recipe `quick` into runs/quick
  train point --set run.epochs=4          a recipe with a changed value
  train my.toml --out runs/mine --seed 3  a recipe of your own
  train cartpole --seeds 5                five seeds, and a table of their last tests
  train --resume runs/mine                continue bit for bit where it stopped
  train my.toml --init runs/mine/policy   start from the weights of a trained policy
  train paper --dry-run                   show what would be done, and how long it would take
  train crowded --set stages.pretrain.run.epochs=9   a recipe of stages, with a changed value of one of them
  train report runs/mine                  one page with curves, reward terms, selection and pictures
  train sweep sweep.toml --out runs/sweep --jobs 2   many settings and seeds of a recipe, and a table
  train select runs/mine                  choose among a run's checkpoints by return, success, pose and KL

Exit codes: 0 done, 1 failed while running, 2 bad usage or recipe, 130 interrupted (after saving)."
)]
struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    /// An embedded recipe (see --list) or a path ending in .toml
    #[arg(default_value = "quick")]
    recipe: String,
    /// List the embedded recipes
    #[arg(long)]
    list: bool,
    /// Show the resolved recipe, its size and an estimate of time and memory; train nothing
    #[arg(long)]
    dry_run: bool,
    /// Folder of the run; must be new or empty [default: runs/<name>, numbered when taken; with --seeds runs/<name>-seeds]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Seed instead of the recipe's
    #[arg(long)]
    seed: Option<u64>,
    /// Train this many seeds, counted up from the run's, one after another into <out>/seed-K, and tabulate their last tests in
    /// <out>/seeds.csv; the same command again goes on where it stopped
    #[arg(long, value_name = "N", conflicts_with_all = ["resume", "list"])]
    seeds: Option<NonZeroU64>,
    /// Change a value of the recipe, e.g. ppo.clip=0.2; repeatable
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    set: Vec<String>,
    /// Continue the run in this folder; can change only run.epochs, checkpoint.*, test.* and select.*
    #[arg(long, value_name = "DIR", conflicts_with_all = ["recipe", "out", "seed", "list"])]
    resume: Option<PathBuf>,
    /// Start from the weights of this policy bundle; its network must be the recipe's
    #[arg(long, value_name = "POLICY_DIR", conflicts_with_all = ["resume", "list"])]
    init: Option<PathBuf>,
    /// Do one task of this manifest, which `train sweep` has written: nothing where it is done, the rest where it was begun
    #[arg(long, value_name = "MANIFEST", requires = "index", conflicts_with_all = ["recipe", "out", "seed", "seeds", "list", "set", "resume", "init", "dry_run"])]
    task: Option<PathBuf>,
    /// Which task, from 0
    #[arg(long, value_name = "N", requires = "task")]
    index: Option<usize>,
    /// Save and stop, as on Ctrl-C, when standard input ends: with whoever holds its other end
    #[arg(long, requires = "task")]
    until_eof: bool,
    /// Threads to use; results do not depend on it [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Play a run's checkpoints from the same starts, choose one by the rule [select] of its recipe (or the rule's defaults), write
    /// selection.json and pack it into policy/
    Select {
        /// A run folder; of a run in stages, the folder of one of them
        dir: PathBuf,
        /// Change a value of the rule, e.g. select.starts=400; repeatable
        #[arg(long = "set", value_name = "select.KEY=VALUE")]
        set: Vec<String>,
        /// Threads to use; results do not depend on it [default: all cores]
        #[arg(long)]
        threads: Option<usize>,
    },
    /// Train many settings and seeds of a recipe; the same command again goes on where it stopped
    Sweep {
        /// The sweep, a TOML file
        file: PathBuf,
        /// Its folder
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Tasks at a time, each in a process of its own
        #[arg(long, value_name = "N", default_value = "1")]
        jobs: NonZeroUsize,
        /// Threads of each task
        #[arg(long, value_name = "N", default_value = "1")]
        threads: NonZeroUsize,
        /// Train nothing: write the manifest of tasks (of the next rung, once the one before is done) and the table of what is done
        #[arg(long)]
        plan: bool,
    },
    /// Write one HTML page on one or several runs: curves, reward terms, losses, time, stages, selection, and the chosen policy at work
    Report {
        /// Run folders, or folders of `train --seeds`
        #[arg(required = true)]
        runs: Vec<PathBuf>,
        /// Held-out starts on which chosen policies are filmed; 0: none
        #[arg(long, value_name = "N", default_value_t = 8)]
        films: usize,
        /// The page [default: report.html in the first folder]
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
        /// Threads to use; results do not depend on it [default: all cores]
        #[arg(long)]
        threads: Option<usize>,
    },
}

/// Runs the program with the environments of `registry` and the process's arguments.
pub fn run(registry: &Registry) -> ExitCode {
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(e.exit_code() as u8);
        }
    };
    program::exit(act(&args, registry))
}

fn act(args: &Args, registry: &Registry) -> Result<u8> {
    keep_memory();
    match &args.command {
        Some(Command::Select { dir, set, threads }) => {
            start_threads(*threads)?;
            return choose(dir, set, registry);
        }
        Some(Command::Sweep { file, out, jobs, threads, plan }) => return sweep(file, out, [jobs.get(), threads.get()], *plan, registry),
        Some(Command::Report { runs, films, out, threads }) => {
            start_threads(*threads)?;
            return report(runs, *films, out.as_deref(), registry);
        }
        None => {}
    }
    if let (Some(path), Some(index)) = (&args.task, args.index) {
        let (manifest, threads, stop) = (Manifest::read(path)?, start_threads(args.threads)?, watch()?);
        if args.until_eof {
            watch_input(stop.clone());
        }
        return Ok(code(manifest.run(index, registry, threads, &stop)?));
    }
    if args.list {
        for (name, text) in EMBEDDED {
            println!("{name:<24} {}", Recipe::parse(name, text, &[])?.about);
        }
        return Ok(0);
    }
    let mut recipe = match &args.resume {
        Some(dir) => of_run(dir, &args.set)?,
        None => Recipe::load(&args.recipe, &args.set)?,
    };
    recipe.seed = args.seed.unwrap_or(recipe.seed);
    let scheme = Scheme::new(recipe)?;
    // Before anything computes, and reading a bundle does.
    let threads = start_threads(args.threads)?;
    let init = args.init.as_deref().map(Bundle::read).transpose().given()?;
    if args.dry_run {
        return describe(scheme, registry, init.as_ref(), threads, args.seeds);
    }
    let stop = watch()?;
    let name = &scheme.recipe.name;
    if let Some(count) = args.seeds {
        let dir = args.out.clone().unwrap_or_else(|| Path::new("runs").join(format!("{name}-seeds")));
        return Ok(code(Seeds { recipe: scheme.recipe, registry, dir, threads, init }.run(count, &stop)?));
    }
    let dir = match &args.resume {
        Some(dir) => dir.clone(),
        None => {
            let dir = run_folder(args.out.as_deref(), name)?;
            eprintln!("training '{name}' into {}", dir.display());
            dir
        }
    };
    let job = Job { scheme: &scheme, registry, dir: &dir, threads, init: init.as_ref() };
    Ok(code(job.run(args.resume.is_some(), &stop, &|_| Ok(()))?))
}

/// Does what is left of the sweep in `file`, or only plans and sums it up.
fn sweep(file: &Path, dir: &Path, [jobs, threads]: [usize; 2], plan: bool, registry: &Registry) -> Result<u8> {
    let sweep = Sweep::read(file)?;
    if !dir.join("manifest.jsonl").exists() {
        sweep.check_tasks(registry)?;
    }
    let folder = Folder { sweep: &sweep, dir };
    let stop = watch()?;
    let standing = if plan { None } else { Some(folder.run(jobs, threads, &stop)?) };
    for manifest in folder.manifests()? {
        eprintln!("{}: {} tasks", manifest.path.display(), manifest.tasks.len());
    }
    print!("{}", folder.sum_up()?);
    match standing {
        Some(Standing::Finished { failed }) if failed > 0 => Err(Error::run(format!(
            "{failed} tasks failed, see {}; the same command again tries them again",
            dir.join("sweep.html").display()
        ))),
        Some(Standing::Interrupted) => {
            eprintln!("interrupted; the same command again goes on");
            Ok(INTERRUPTED)
        }
        _ => Ok(0),
    }
}

/// Writes the report on the runs in these folders.
fn report(runs: &[PathBuf], films: usize, out: Option<&Path>, registry: &Registry) -> Result<u8> {
    let groups = runs.iter().map(|dir| Group::read(dir)).collect::<Result<Vec<_>>>().given()?;
    if groups.iter().flat_map(|g| &g.runs).flat_map(|r| &r.stages).all(|s| s.metrics.rows() == 0) {
        return Err(Error::config("none of the runs has a finished epoch"));
    }
    let out = out.map_or_else(|| runs[0].join("report.html"), Path::to_path_buf);
    let named: Vec<String> = runs.iter().map(|dir| dir.display().to_string()).collect();
    let page = page(&groups, registry, films, &format!("train report {}", named.join(" ")))?;
    write_atomic(&out, page.as_bytes())?;
    eprintln!("{}", out.display());
    Ok(0)
}

/// Selects among the checkpoints of the run in `dir`.
fn choose(dir: &Path, set: &[String], registry: &Registry) -> Result<u8> {
    if let Some(change) = set.iter().find(|c| !c.starts_with("select.")) {
        return Err(Error::config(format!("--set {change}: expected select.KEY=VALUE")));
    }
    let recipe = of_run(dir, set)?;
    if let Some(stage) = recipe.stages.last() {
        let folder = dir.join("stages").join(format!("{}-{}", recipe.stages.len(), stage.name));
        return Err(Error::config(format!("{}: is a run in stages; give one of them, such as {}", dir.display(), folder.display())));
    }
    let rule = recipe.select.clone().unwrap_or_default();
    rule.check()?;
    let stop = watch()?;
    let Some(selection) = select(dir, &recipe, &rule, registry, &stop)? else { return Ok(INTERRUPTED) };
    selection.write(dir)?;
    export(&dir.join("checkpoints").join(&selection.chosen), &dir.join("policy"))?;
    println!("{}: {}", selection.chosen, selection.why);
    Ok(0)
}

/// What Ctrl-C sets.
fn watch() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let (flag, mut asked) = (stop.clone(), false);
    ctrlc::set_handler(move || {
        // The second time, at once.
        if std::mem::replace(&mut asked, true) {
            std::process::exit(i32::from(INTERRUPTED));
        }
        flag.store(true, Ordering::SeqCst);
    })
    .map_err(|e| Error::run(format!("cannot watch for Ctrl-C: {e}")))?;
    Ok(stop)
}

/// Sets `stop` when standard input ends.
fn watch_input(stop: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        // An input that cannot be read has ended.
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        stop.store(true, Ordering::SeqCst);
    });
}

fn code(outcome: Outcome) -> u8 {
    match outcome {
        Outcome::Finished => 0,
        Outcome::Interrupted => {
            eprintln!("interrupted and saved; `--resume` continues (with --seeds: the same command again)");
            INTERRUPTED
        }
    }
}

fn start_threads(wanted: Option<usize>) -> Result<usize> {
    if wanted == Some(0) {
        return Err(Error::config("--threads is 0, expected at least 1"));
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(wanted.unwrap_or(0));
    pool.build_global().map_err(|e| Error::run(format!("cannot start threads: {e}")))?;
    Ok(rayon::current_num_threads())
}

/// The given folder, which must be new or empty; or the first free one below `runs`.
pub(crate) fn run_folder(given: Option<&Path>, name: &str) -> Result<PathBuf> {
    // A run that was killed at once leaves a folder in which nothing is whole.
    let whole = |entry: std::io::Result<DirEntry>| !entry.is_ok_and(|e| e.file_name().to_str().is_some_and(is_leftover));
    let free = |dir: &Path| std::fs::read_dir(dir).map_or(!dir.exists(), |mut entries| !entries.any(whole));
    match given {
        Some(dir) if free(dir) => Ok(dir.into()),
        Some(dir) => Err(Error::config(format!("--out {}: is not empty; give a new folder, or --resume to continue there", dir.display()))),
        None => {
            let numbered = (2..).map(|i| Path::new("runs").join(format!("{name}-{i}")));
            let mut all = std::iter::once(Path::new("runs").join(name)).chain(numbered);
            all.find(|dir| free(dir)).ok_or_else(|| Error::run("no free folder below runs"))
        }
    }
}

fn describe(scheme: Scheme, registry: &Registry, init: Option<&Bundle>, threads: usize, seeds: Option<NonZeroU64>) -> Result<u8> {
    println!("{}", scheme.recipe.to_toml()?);
    let (mut seconds, staged) = (0.0, scheme.staged());
    for (i, part) in scheme.parts.into_iter().enumerate() {
        if staged {
            println!("# stage {}, {}", i + 1, part.name);
        }
        seconds += describe_part(part.plan, registry, init.filter(|_| i == 0), threads)?;
    }
    let runs = seeds.map_or(String::new(), |n| format!(", {:.1} minutes for {n} seeds", seconds * n.get() as f64 / 60.0));
    println!("# time: about {:.1} minutes on {threads} threads{runs}", seconds / 60.0);
    if let Some(peak) = peak_memory() {
        println!("# memory: about {peak}");
    }
    Ok(0)
}

/// Sizes of a stage; gives the seconds that it would take.
fn describe_part(plan: Plan, registry: &Registry, init: Option<&Bundle>, threads: usize) -> Result<f64> {
    let recipe = &plan.recipe;
    let made = registry.make(&recipe.env, &recipe.env_options, 1, Purpose::Test)?;
    let spec = policy_spec(&plan, made.env.spec())?;
    init.map(|bundle| initial("--init", bundle, &spec, &made.origin)).transpose()?;
    let per_epoch = plan.updates_per_epoch * recipe.run.collect_steps as u64;
    let action = match spec.action {
        ActionSpace::Continuous(n) => format!("{n} floats"),
        ActionSpace::Discrete(k) => format!("one of {k}"),
    };
    println!("# observation: {} floats, action: {action}", spec.layout.dim());
    println!("# parameters: {}", spec.params());
    println!("# updates: {} per epoch, each from {} environments x {} steps", plan.updates_per_epoch, recipe.run.envs, plan.horizon);
    println!("# environment steps: {per_epoch} per epoch, {} in all", per_epoch * recipe.run.epochs);
    Trainer::estimate(plan, registry, threads)
}

/// The most memory that this process has had so far, as Linux states it; `None` on other systems.
fn peak_memory() -> Option<String> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let kib: f64 = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().strip_suffix(" kB")?.parse().ok()?;
    Some(format!("{:.0} MiB", kib / 1024.0))
}
