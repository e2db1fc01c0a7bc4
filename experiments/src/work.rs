//! Does tasks: each leaves one record, whole or not at all.
//!
//! A record is a line of JSON and a line with its checksum, written beside its place, flushed to the
//! disk and renamed. A task that has a sound record is not repeated, whoever wrote it; one whose stage
//! fails or panics has a record with the reason.

use crate::{
    fail::Fail,
    plan::{Plan, Planned, Task, sha256},
    stage::Measured,
};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    io::Write,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    str::FromStr,
    time::Instant,
};

/// Which of how many shards, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shard {
    pub(crate) index: usize,
    pub(crate) count: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Shard, String> {
        let parts =
            text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, count)) if (1..=count).contains(&index) => Ok(Shard { index, count }),
            _ => Err(format!("{text:?}: expected I/N with I from 1 to N, such as 2/8")),
        }
    }
}

impl Shard {
    /// All tasks in one.
    pub(crate) const WHOLE: Shard = Shard { index: 1, count: 1 };

    /// Whether a task is this shard's. Neighbours go to different shards, for neighbouring cells
    /// take about as long.
    pub(crate) fn has(self, task: usize) -> bool {
        task % self.count == self.index - 1
    }
}

/// What is left of a task that was done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Record {
    /// The plan it belongs to.
    pub(crate) plan: String,
    /// The task.
    pub(crate) task: usize,
    /// Why it failed, if it did.
    pub(crate) reason: Option<String>,
    /// What it measured.
    pub(crate) measured: Measured,
    /// How long it took.
    pub(crate) seconds: f64,
    /// Where it ran.
    pub(crate) host: String,
}

/// What the tasks folder holds.
#[derive(Debug, Default)]
pub(crate) struct Found {
    /// Sound records by task.
    pub(crate) records: BTreeMap<usize, Record>,
    /// Files that are not sound records of this plan, each with the reason.
    pub(crate) damaged: Vec<String>,
    /// Tasks with more than one record.
    pub(crate) duplicate: Vec<String>,
}

fn record_name(task: usize, shard: Shard) -> String {
    format!("task-{task:06}.{}-of-{}.json", shard.index, shard.count)
}

/// The task that a file name says it is of.
fn task_of(name: &str) -> Option<usize> {
    name.strip_prefix("task-")?.split_once('.')?.0.parse().ok()
}

fn read_record(path: &Path, hash: &str) -> Result<Record, String> {
    let text = std::fs::read_to_string(path).map_err(|e| e.to_string())?;
    let mut lines = text.lines();
    let (Some(body), Some(sum)) = (lines.next(), lines.next()) else {
        return Err("cut short".to_owned());
    };
    if sum != sha256(body.as_bytes()) {
        return Err("the checksum does not fit".to_owned());
    }
    let record: Record = serde_json::from_str(body).map_err(|e| e.to_string())?;
    if record.plan != hash {
        return Err("it belongs to another plan".to_owned());
    }
    let named = path.file_name().and_then(|name| task_of(name.to_str()?));
    if named != Some(record.task) {
        return Err(format!("it is the record of task {}", record.task));
    }
    Ok(record)
}

/// Reads all records of a plan.
pub(crate) fn find(planned: &Planned) -> Result<Found, Fail> {
    let folder = planned.tasks_folder();
    let mut found = Found::default();
    let entries = match std::fs::read_dir(&folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(found),
        Err(error) => return Err(Fail::io(&folder, &error)),
    };
    let mut paths: Vec<PathBuf> = entries.filter_map(Result::ok).map(|e| e.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "json"));
    paths.sort();
    for path in paths {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match read_record(&path, &planned.hash) {
            Ok(record) if record.task >= planned.count() => {
                found.damaged.push(format!("{name}: the plan has no such task"));
            }
            Ok(record) => {
                if found.records.insert(record.task, record).is_some() {
                    found.duplicate.push(name);
                }
            }
            Err(reason) => found.damaged.push(format!("{name}: {reason}")),
        }
    }
    Ok(found)
}

/// Writes a record: temporary file, flushed to the disk, renamed.
fn write_record(folder: &Path, name: &str, record: &Record) -> Result<(), Fail> {
    let body = serde_json::to_string(record).map_err(|e| Fail::Failed(format!("{name}: {e}")))?;
    let path = folder.join(name);
    let fail = |error: std::io::Error| Fail::io(&path, &error);
    let mut file = tempfile::Builder::new().suffix(".part").tempfile_in(folder).map_err(fail)?;
    write!(file, "{body}\n{}\n", sha256(body.as_bytes())).map_err(fail)?;
    file.as_file().sync_all().map_err(fail)?;
    file.persist(&path).map_err(|e| Fail::io(&path, &e.error))?;
    // The rename itself has to reach the disk too.
    std::fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(fail)
}

/// Does one task.
pub(crate) fn perform(plan: &Plan, hash: &str, task: Task, host: &str) -> Result<Record, Fail> {
    let stage = crate::stage::find(&plan.spec.stage).map_err(Fail::Input)?;
    let parameters = &plan.cells[task.cell].parameters;
    let clock = Instant::now();
    let done = catch_unwind(AssertUnwindSafe(|| (stage.run)(parameters, task.seed)));
    let seconds = clock.elapsed().as_secs_f64();
    let (measured, reason) = match done {
        Ok(Ok(measured)) => (measured, None),
        Ok(Err(reason)) => (Measured::default(), Some(reason)),
        Err(panic) => {
            let text = panic
                .downcast_ref::<String>()
                .map(String::as_str)
                .or_else(|| panic.downcast_ref::<&str>().copied())
                .unwrap_or("without a message");
            (Measured::default(), Some(format!("panicked: {text}")))
        }
    };
    let (plan, host) = (hash.to_owned(), host.to_owned());
    Ok(Record { plan, task: task.number, reason, measured, seconds, host })
}

/// Does all tasks of a shard that have no sound record, `jobs` at a time (0: as many as there are
/// processors), and returns how many it did.
pub(crate) fn run(planned: &Planned, shard: Shard, jobs: usize) -> Result<usize, Fail> {
    let found = find(planned)?;
    let folder = planned.tasks_folder();
    std::fs::create_dir_all(&folder).map_err(|e| Fail::io(&folder, &e))?;
    let todo: Vec<Task> = (0..planned.count())
        .filter(|&task| shard.has(task) && !found.records.contains_key(&task))
        .map(|task| planned.task(task))
        .collect();
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(todo.len() as u64).with_style(style);
    bar.set_message(planned.plan.spec.name.clone());
    let host = host();
    let one = |task: &Task| -> Result<(), Fail> {
        let record = perform(&planned.plan, &planned.hash, *task, &host)?;
        write_record(&folder, &record_name(task.number, shard), &record)?;
        bar.inc(1);
        Ok(())
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(jobs)
        .build()
        .map_err(|e| Fail::Failed(e.to_string()))?;
    let done = pool.install(|| todo.par_iter().with_max_len(1).try_for_each(one));
    bar.finish_and_clear();
    done.map(|()| todo.len())
}

/// The name of this machine.
pub(crate) fn host() -> String {
    std::env::var("SLURMD_NODENAME")
        .ok()
        .or_else(|| std::fs::read_to_string("/proc/sys/kernel/hostname").ok())
        .map_or_else(|| "unknown".to_owned(), |name| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_share_out_every_task_once() {
        for count in 1..6 {
            for task in 0..40 {
                let has = |index| Shard { index, count }.has(task);
                assert_eq!((1..=count).filter(|&index| has(index)).count(), 1);
            }
        }
        assert_eq!("2/8".parse(), Ok(Shard { index: 2, count: 8 }));
        for bad in ["0/3", "4/3", "1", "a/b", "1/0", ""] {
            assert!(bad.parse::<Shard>().is_err(), "{bad}");
        }
    }
}
