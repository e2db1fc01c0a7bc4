//! From records to tables.
//!
//! `runs.csv` has one row for each cell and seed, in the order of the plan, and hold
//! nothing that depends on time, machine or shards: the same plan gives the same bytes. Seconds and
//! hosts are in `timing.csv`, series in `traces/NAME.csv`, and `manifest.json` says where all of it
//! comes from.

use crate::{
    fail::{Fail, write_csv},
    plan::{Planned, sha256},
    work::{self, Found, Record, Shard},
};
use rowgram::io::output;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};

/// How far a plan has come.
pub(crate) fn status(planned: &Planned, shards: usize) -> Result<String, Fail> {
    let found = work::find(planned)?;
    let failed = found.records.values().filter(|record| record.reason.is_some()).count();
    let mut text = format!(
        "{}: {} of {} tasks done, {failed} of them failed, {} damaged, {} duplicate\n",
        planned.plan.spec.name,
        found.records.len(),
        planned.count(),
        found.damaged.len(),
        found.duplicate.len()
    );
    if shards > 1 {
        for index in 1..=shards {
            let shard = Shard { index, count: shards };
            let mine = || (0..planned.count()).filter(|&task| shard.has(task));
            let done = mine().filter(|task| found.records.contains_key(task)).count();
            text += &format!("shard {index}/{shards}: {done} of {} done\n", mine().count());
        }
    }
    Ok(text)
}

/// Merges all records into tables.
///
/// # Errors
/// [`Fail::Incomplete`] with a list where records are missing, duplicate or damaged; nothing is
/// written then.
pub(crate) fn merge(planned: &Planned) -> Result<(), Fail> {
    let found = work::find(planned)?;
    complete(planned, &found)?;
    let folder = &planned.folder;
    let records: Vec<&Record> = found.records.values().collect();
    let runs = runs(planned, &records)?;
    write_csv(&folder.join("runs.csv"), &runs)?;
    write_csv(&folder.join("timing.csv"), &timing(planned, &records))?;
    let traces = traces(planned, &records);
    for (name, rows) in &traces {
        let path = folder.join("traces");
        std::fs::create_dir_all(&path).map_err(|e| Fail::io(&path, &e))?;
        write_csv(&path.join(format!("{name}.csv")), rows)?;
    }
    manifest(planned, &records, &traces)
}

fn complete(planned: &Planned, found: &Found) -> Result<(), Fail> {
    let missing: Vec<usize> =
        (0..planned.count()).filter(|task| !found.records.contains_key(task)).collect();
    if missing.is_empty() && found.damaged.is_empty() && found.duplicate.is_empty() {
        return Ok(());
    }
    let mut text = String::new();
    if !missing.is_empty() {
        let names: Vec<String> = missing.iter().take(20).map(usize::to_string).collect();
        let more = if missing.len() > 20 { ", ..." } else { "" };
        text += &format!("{} tasks are missing: {}{more}\n", missing.len(), names.join(", "));
    }
    found.damaged.iter().for_each(|file| text += &format!("damaged: {file}\n"));
    found.duplicate.iter().for_each(|file| text += &format!("duplicate: {file}\n"));
    text += "nothing was merged; remove what is damaged or duplicate and run the shards again";
    Err(Fail::Incomplete(text))
}

/// A number as it stands in tables: the shortest that reads back the same.
fn number(value: f64) -> String {
    format!("{value}")
}

type Rows = Vec<Vec<String>>;

fn runs(planned: &Planned, records: &[&Record]) -> Result<Rows, Fail> {
    let kept = planned.plan.spec.kept(planned.stage()?);
    let axes = planned.plan.cells.first().map(|cell| cell.at.as_slice()).unwrap_or_default();
    let mut header = vec!["cell".to_owned()];
    header.extend(axes.iter().map(|(column, _)| column.clone()));
    header.extend(["seed", "status", "reason"].map(str::to_owned));
    header.extend(kept.iter().map(|&name| name.to_owned()));
    let mut rows = vec![header];
    for record in records {
        let mut row = place(planned, record);
        let status = if record.reason.is_some() { "failed" } else { "ok" };
        row.extend([status.to_owned(), record.reason.clone().unwrap_or_default()]);
        let values = &record.measured.values;
        row.extend(kept.iter().map(|&name| values.get(name).map_or(String::new(), |&v| number(v))));
        rows.push(row);
    }
    Ok(rows)
}

/// Cell, axes and seed of a record.
fn place(planned: &Planned, record: &Record) -> Vec<String> {
    let task = planned.task(record.task);
    let mut row = vec![task.cell.to_string()];
    row.extend(planned.plan.cells[task.cell].at.iter().map(|(_, label)| label.clone()));
    row.push(task.seed.to_string());
    row
}

fn place_header(planned: &Planned) -> Vec<String> {
    let axes = planned.plan.cells.first().map(|cell| cell.at.as_slice()).unwrap_or_default();
    let mut header = vec!["cell".to_owned()];
    header.extend(axes.iter().map(|(column, _)| column.clone()));
    header.push("seed".to_owned());
    header
}

fn timing(planned: &Planned, records: &[&Record]) -> Rows {
    let parts: BTreeSet<&String> = records.iter().flat_map(|r| r.measured.seconds.keys()).collect();
    let mut header = place_header(planned);
    header.extend(["host".to_owned(), "seconds".to_owned()]);
    header.extend(parts.iter().map(|name| format!("{name}_seconds")));
    let mut rows = vec![header];
    for record in records {
        let mut row = place(planned, record);
        row.extend([record.host.clone(), format!("{:.6}", record.seconds)]);
        let part = |name: &&String| record.measured.seconds.get(*name);
        row.extend(
            parts.iter().map(|name| part(name).map_or(String::new(), |s| format!("{s:.6}"))),
        );
        rows.push(row);
    }
    rows
}

fn traces(planned: &Planned, records: &[&Record]) -> BTreeMap<String, Rows> {
    let mut tables: BTreeMap<String, Rows> = BTreeMap::new();
    for record in records {
        for trace in &record.measured.traces {
            let rows = tables.entry(trace.name.clone()).or_insert_with(|| {
                let mut header = place_header(planned);
                header.extend(trace.columns.iter().cloned());
                vec![header]
            });
            for values in &trace.rows {
                let mut row = place(planned, record);
                row.extend(values.iter().map(|&value| number(value)));
                rows.push(row);
            }
        }
    }
    tables
}

fn manifest(
    planned: &Planned,
    records: &[&Record],
    traces: &BTreeMap<String, Rows>,
) -> Result<(), Fail> {
    let plan = &planned.plan;
    let spec = serde_json::to_string(&plan.spec).map_err(|e| Fail::Failed(e.to_string()))?;
    let hosts: BTreeSet<&str> = records.iter().map(|record| record.host.as_str()).collect();
    let mut files = BTreeMap::new();
    let names = ["runs.csv".to_owned()];
    for name in names.into_iter().chain(traces.keys().map(|name| format!("traces/{name}.csv"))) {
        let path = planned.folder.join(&name);
        let bytes = std::fs::read(&path).map_err(|e| Fail::io(&path, &e))?;
        files.insert(name, sha256(&bytes));
    }
    let content = json!({
        "experiment": plan.spec.name,
        "stage": plan.spec.stage,
        "small": plan.small,
        "cells": plan.cells.len(),
        "tasks": planned.count(),
        "failed": records.iter().filter(|record| record.reason.is_some()).count(),
        "task_seconds": records.iter().map(|record| record.seconds).sum::<f64>().round(),
        "spec_sha256": sha256(spec.as_bytes()),
        "plan_sha256": planned.hash,
        "files_sha256": files,
        "planned_by_version": plan.version,
        "merged_by_version": env!("CARGO_PKG_VERSION"),
        "machine": {
            "hosts": hosts,
            "system": std::env::consts::OS,
            "architecture": std::env::consts::ARCH,
            "processors": std::thread::available_parallelism().map_or(0, usize::from),
            "processor": processor(),
        },
    });
    let text = serde_json::to_string_pretty(&content).map_err(|e| Fail::Failed(e.to_string()))?;
    output::write(&planned.folder.join("manifest.json"), true, |out| {
        out.write_all(text.as_bytes())?;
        out.write_all(b"\n")
    })?;
    Ok(())
}

/// What the processor calls itself, where the system says so.
fn processor() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    line.split_once(':').map(|(_, name)| name.trim().to_owned())
}
