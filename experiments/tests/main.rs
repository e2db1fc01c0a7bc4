//! The program as people call it: shards, interruptions and damage end in the same bytes or in exit code 3.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};
use tempfile::TempDir;

const SPEC: &str = r#"
name = "toy"
title = "Toy"
stage = "arena"
seeds = { count = 2 }
base = { trace = true }

[[axis]]
key = "problem"
values = ["rosenbrock", "beale", "wood"]

[[axis]]
key = "solver"
values = ["levenberg-marquardt", "nelder-mead"]

[[figure]]
name = "profile"
look = "profile"
x = "problem"
y = "evaluations"
series = "solver"

[[table]]
name = "numbers"
rows = "problem"
columns = "solver"
values = ["evaluations"]

[finding]
text = "Levenberg-Marquardt takes {mean evaluations @ solver=levenberg-marquardt}."
claims = ["mean evaluations @ solver=levenberg-marquardt < mean evaluations @ solver=nelder-mead"]
"#;

/// A folder with a spec.
struct Place {
    folder: TempDir,
}

impl Place {
    fn new(spec: &str) -> Place {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("toy.toml"), spec).unwrap();
        Place { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn call(&self, arguments: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_experiments"))
            .args(arguments)
            .current_dir(self.folder.path())
            .output()
            .unwrap()
    }

    fn good(&self, arguments: &[&str]) -> String {
        let output = self.call(arguments);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{arguments:?}: {error}");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    fn bad(&self, code: i32, arguments: &[&str]) -> String {
        let output = self.call(arguments);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {error}");
        error
    }

    fn files(&self, folder: &str) -> Vec<Vec<u8>> {
        ["runs.csv", "traces/descent.csv"]
            .iter()
            .map(|name| std::fs::read(self.path(folder).join(name)).unwrap())
            .collect()
    }
}

fn records(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        std::fs::read_dir(folder.join("tasks")).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths
}

#[test]
fn shards_retries_and_jobs_end_in_the_same_bytes() {
    let place = Place::new(SPEC);
    place.good(&["run", "toy.toml", "--out", "one", "--jobs", "2"]);
    assert!(place.path("one/figures/profile.pdf").exists());
    assert!(place.path("one/figures/profile.tex").exists());
    assert!(place.path("one/figures/numbers.md").exists());
    let expected = place.files("one");
    let rows = String::from_utf8(expected[0].clone()).unwrap();
    assert_eq!(rows.lines().count(), 13);
    for shards in ["1", "3", "7"] {
        let out = format!("of{shards}");
        place.good(&["plan", "toy.toml", "--out", &out]);
        let missing = place.bad(3, &["merge", &out]);
        assert!(missing.contains("12 tasks are missing"), "{missing}");
        place.good(&["run", &out, "--shard", &format!("1/{shards}")]);
        // As after an interruption: the last record is gone, another sharding takes over.
        let last = records(&place.path(&out)).pop().unwrap();
        std::fs::remove_file(last).unwrap();
        for shard in ["1/2", "2/2"] {
            place.good(&["run", &out, "--shard", shard]);
        }
        place.good(&["merge", &out]);
        assert_eq!(place.files(&out), expected, "{shards} shards");
        let status = place.good(&["status", &out, "--shards", "2"]);
        assert!(status.contains("12 of 12 tasks done") && status.contains("shard 2/2: 6 of 6"));
    }
    // What is there is neither replaced nor repeated without being asked for.
    assert!(place.bad(2, &["run", "toy.toml", "--out", "one"]).contains("--resume"));
    place.good(&["run", "toy.toml", "--out", "one", "--resume"]);
    assert_eq!(place.files("one"), expected);
    let same = place.good(&["compare", "one", "of3", "--within", "0"]);
    assert!(same.contains(" 0 differ"), "{same}");
}

#[test]
fn damaged_and_duplicate_records_are_listed() {
    let place = Place::new(SPEC);
    place.good(&["plan", "toy.toml", "--out", "p"]);
    place.good(&["run", "p", "--shard", "1/1"]);
    let all = records(&place.path("p"));
    let text = std::fs::read_to_string(&all[3]).unwrap();
    std::fs::write(&all[3], text.replacen("\"task\":3", "\"task\":4", 1)).unwrap();
    std::fs::write(&all[5], &text[..text.len() / 2]).unwrap();
    std::fs::copy(&all[7], place.path("p/tasks/task-000007.2-of-2.json")).unwrap();
    let list = place.bad(3, &["merge", "p"]);
    for part in ["2 tasks are missing: 3, 5", "task-000003", "checksum", "duplicate: task-000007"] {
        assert!(list.contains(part), "{part}: {list}");
    }
    assert!(!place.path("p/runs.csv").exists());
    std::fs::remove_file(place.path("p/tasks/task-000007.2-of-2.json")).unwrap();
    // The sound ones stay as they are; the damaged ones are done again.
    let done = place.good(&["run", "p", "--shard", "1/1"]);
    assert!(done.contains("2 tasks done"), "{done}");
    place.good(&["merge", "p"]);
}

#[test]
fn a_cell_that_fails_is_a_row_with_its_reason() {
    // Where every leaf pixel is missed there is nothing to locate plants in.
    let spec = r#"
        name = "toy"
        title = "Toy"
        stage = "locate"
        seeds = { count = 1 }
        metrics = ["f1_5cm"]
        base = { scenario.field.rows = 5, scenario.field.row_length_m = 4.0 }
        [[axis]]
        key = "scenario.corruption.missed_fraction"
        values = [0.0, 1.0]
    "#;
    let place = Place::new(spec);
    place.good(&["run", "toy.toml", "--out", "o"]);
    let runs = std::fs::read_to_string(place.path("o/runs.csv")).unwrap();
    let lines: Vec<&str> = runs.lines().collect();
    assert!(lines[2].starts_with("1,1.0,1,failed,\"the mask has no leaf pixel"), "{runs}");
    assert!(lines[1].starts_with("0,0.0,1,ok,,"), "{runs}");
}

#[test]
fn mistakes_are_named_with_the_nearest_word() {
    let place = Place::new(&SPEC.replace("trace = true", "trac = true"));
    let error = place.bad(2, &["check", "toy.toml"]);
    assert!(error.contains("did you mean `trace`"), "{error}");
    let list = place.good(&["list", "locate"]);
    assert!(list.contains("model.prior") && list.contains("f1_5cm"), "{list}");
}

/// The specs and results that come with the project.
fn home() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn every_spec_is_valid_in_both_settings() {
    let place = Place::new(SPEC);
    let mut count = 0;
    for entry in std::fs::read_dir(home().join("specs")).unwrap() {
        let path = entry.unwrap().path();
        let path = path.to_str().unwrap();
        place.good(&["check", path]);
        place.good(&["check", path, "--small"]);
        count += 1;
    }
    assert!(count > 20, "{count}");
}

#[test]
fn the_question_of_the_documentation_is_ten_lines() {
    let page = std::fs::read_to_string(home().join("../docs/planning.md")).unwrap();
    let spec = page.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    assert!(spec.lines().count() <= 10, "{spec}");
    let place = Place::new(SPEC);
    std::fs::write(place.path("my-spacing.toml"), spec).unwrap();
    let told = place.good(&["check", "my-spacing.toml"]);
    assert!(told.contains("4 cells x 10 seeds of stage locate"), "{told}");
}

#[test]
fn the_findings_are_what_the_results_say() {
    let place = Place::new(SPEC);
    let path = |name: &str| home().join(name).to_str().unwrap().to_owned();
    let [specs, results, file] = ["specs", "results", "FINDINGS.md"].map(path);
    let folders = ["--specs", &specs, "--results", &results, "--output", &file];
    place.good(&[["findings", "--check"].as_slice(), &folders].concat());
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_small_run_gives_the_committed_numbers() {
    let place = Place::new(SPEC);
    // Instruction sets may sum in another order, and a descent then ends in other last digits.
    for (name, within) in [
        ("cost-neighbours", "0.001"),
        ("solver-arena", "0.05"),
        ("lens-models", "0.001"),
        ("segment-hue", "0.001"),
        ("paper-leaf", "0.001"),
    ] {
        let spec = home().join(format!("specs/{name}.toml"));
        let reference = home().join(format!("reference/{name}/runs.csv"));
        place.good(&["run", spec.to_str().unwrap(), "--small", "--out", name]);
        place.good(&["compare", reference.to_str().unwrap(), name, "--within", within]);
    }
    // Two of the full settings, which are as short.
    for (name, within) in [("bundle-solvers", "0.05"), ("lens-models", "0.001")] {
        let spec = home().join(format!("specs/{name}.toml"));
        let kept = home().join(format!("results/{name}/runs.csv"));
        let out = format!("{name}-full");
        place.good(&["run", spec.to_str().unwrap(), "--out", &out]);
        place.good(&["compare", kept.to_str().unwrap(), &out, "--within", within]);
    }
    // A picture is inside its figure, not beside it.
    let figure = place.path("paper-leaf/figures/leaf-crossing");
    let svg = std::fs::read_to_string(figure.with_extension("svg")).unwrap();
    assert!(svg.contains("href=\"data:image/png;base64,"));
    let png = image::open(figure.with_extension("png")).unwrap().to_rgb8();
    let orange = png.pixels().filter(|pixel| pixel.0 == [213, 94, 0]).count();
    assert!(orange > 1000, "{orange}");
}
