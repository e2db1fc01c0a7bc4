//! `rowgram plan`: tasks one by one, in parts, and by Snakemake give what `rowgram run` and `rowgram season` give.

use crate::{
    program::rowgram,
    run::{orthomosaic, results},
};
use data_synth::season_plan::{SeasonConfig, SeasonPreset};
use rowgram::{
    monitor::Silent,
    pipeline::{
        season::SeasonFile,
        synth::{FlightOptions, write_season},
    },
};
use serde_json::Value;
use std::{collections::BTreeMap, fs, path::Path, process::Command};

/// Does the tasks of a plan one by one, each only once what it needs is there.
fn do_tasks(workflow: &Path) {
    let plan: Value =
        serde_json::from_slice(&fs::read(workflow.join("plan.json")).unwrap()).unwrap();
    let tasks = plan["tasks"].as_array().unwrap();
    assert!(tasks.len() >= 6, "{plan}");
    for task in tasks {
        for input in task["inputs"].as_array().unwrap() {
            assert!(Path::new(input.as_str().unwrap()).is_file(), "{task}");
        }
        let words = task["arguments"].as_array().unwrap().iter().map(|word| word.as_str().unwrap());
        let output =
            Command::new(env!("CARGO_BIN_EXE_rowgram")).args(words).arg("-q").output().unwrap();
        assert!(output.status.success(), "{task}: {}", String::from_utf8_lossy(&output.stderr));
        let done = Path::new(task["done"].as_str().unwrap());
        fs::create_dir_all(done.parent().unwrap()).unwrap();
        fs::write(done, "").unwrap();
    }
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_plan_gives_what_a_run_gives() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    orthomosaic(&whole);
    let copy = |name: &str| {
        let project = folder.path().join(name);
        fs::create_dir(&project).unwrap();
        for entry in fs::read_dir(&whole).unwrap().map(|entry| entry.unwrap().path()) {
            if entry.is_file() {
                fs::copy(&entry, project.join(entry.file_name().unwrap())).unwrap();
            }
        }
        project
    };
    let (first, second) = (copy("12 May"), copy("12-May"));
    let run = rowgram(folder.path(), "run whole -q");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let plan = |output: &str, projects: &[&Path]| {
        let status = Command::new(env!("CARGO_BIN_EXE_rowgram"))
            .arg("plan")
            .args(projects)
            .args(["-o", output])
            .current_dir(folder.path())
            .status()
            .unwrap();
        status.code().unwrap()
    };
    assert_eq!(plan("work", &[&first, &second]), 0);
    assert_eq!(plan("work", &[&first, &second]), 2, "files that exist");
    assert_eq!(plan("other", &[&first, &first]), 2, "a project given twice");
    do_tasks(&folder.path().join("work"));
    let expected = results(&whole);
    for project in [&first, &second] {
        assert_eq!(results(project), expected);
        assert!(project.join("rowgram/report.html").is_file());
    }
    // A project without photos has nothing to do for features, and says so.
    let nothing = rowgram(folder.path(), "run whole --only features:1/2");
    assert_eq!(nothing.code, 0, "{}", nothing.stderr);
    assert!(nothing.stdout.contains("left out, the orthomosaic"), "{}", nothing.stdout);
    fs::create_dir(folder.path().join("empty")).unwrap();
    let refused = rowgram(folder.path(), "run empty --only features:1/2");
    assert_eq!(refused.code, 2);
    assert!(refused.stderr.contains("no photos"), "{}", refused.stderr);
    by_snakemake(folder.path(), &copy("third"), &expected);
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_season_in_parts_gives_what_a_season_gives() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = SeasonConfig::preset(SeasonPreset::Tiny);
    config.days.truncate(1);
    for name in ["whole", "parts"] {
        let root = folder.path().join(name);
        write_season(&config, &FlightOptions::default(), &root, false, &mut Silent).unwrap();
    }
    let set = "--set stages.skip=[\"leaves\"]";
    let whole = rowgram(folder.path(), &format!("season whole/season.toml -q {set}"));
    assert_eq!(whole.code, 0, "{}", whole.stderr);
    let plan = rowgram(
        folder.path(),
        &format!("plan parts/season.toml -o work --photos-per-task 3 --json {set}"),
    );
    assert_eq!(plan.code, 0, "{}", plan.stderr);
    let plan: Value = serde_json::from_str(&plan.stdout).unwrap();
    let batches = plan["tasks"].as_array().unwrap().iter().filter(|task| {
        task["arguments"]
            .as_array()
            .unwrap()
            .iter()
            .any(|argument| argument.as_str().is_some_and(|text| text.contains(':')))
    });
    assert!(batches.count() >= 4 * 2, "four steps, two parts or more: {plan}");
    do_tasks(&folder.path().join("work"));
    let tables = |root: &str| {
        let names = ["flights.csv", "traits_long.csv", "plants_long.csv"];
        names.map(|name| fs::read(folder.path().join(root).join("season").join(name)).unwrap())
    };
    assert_eq!(tables("parts"), tables("whole"));
    let names = [
        "align/reconstruction.json",
        "align/cloud.laz",
        "surface/dsm.tif",
        "surface/chm.tif",
        "ortho/ortho.tif",
        "locate/plants.csv",
        "plots/traits.csv",
    ];
    for flight in SeasonFile::read(&folder.path().join("whole/season.toml")).unwrap().flights {
        for name in names {
            let of = |root: &str| {
                let path = folder.path().join(root).join(&flight.project).join("rowgram");
                fs::read(path.join(name)).unwrap_or_else(|e| panic!("{root} {name}: {e}"))
            };
            assert!(of("parts") == of("whole"), "{} {name}", flight.date);
        }
    }
    // What was done is not done again, and parts that do not exist are refused.
    let project = "parts/2015-05-30";
    let again = rowgram(folder.path(), &format!("run {project} --only features:1/2 --json {set}"));
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(again.stdout.contains("\"stage_is_current\":true"), "{}", again.stdout);
    let wrong = rowgram(folder.path(), &format!("run {project} --only features:3/2"));
    assert_eq!(wrong.code, 2);
    assert!(wrong.stderr.contains("expected a part such as 2/8"), "{}", wrong.stderr);
}

/// The same by Snakemake; says so where there is none.
fn by_snakemake(folder: &Path, project: &Path, expected: &BTreeMap<String, Vec<u8>>) {
    if Command::new("snakemake").arg("--version").output().is_err() {
        crate::data::tool_is_missing("Snakemake");
        return;
    }
    let made = rowgram(folder, "plan third -o third-work -q");
    assert_eq!(made.code, 0, "{}", made.stderr);
    let again = || {
        Command::new("snakemake")
            .args(["--snakefile", "third-work/Snakefile", "--profile", "third-work/profiles/local"])
            .args(["--config", &format!("program={}", env!("CARGO_BIN_EXE_rowgram")), "threads=2"])
            .current_dir(folder)
            .output()
            .unwrap()
    };
    let output = again();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(results(project), *expected);
    // A task that is lost is done again.
    fs::remove_file(project.join("rowgram/plan/locate.done")).unwrap();
    fs::remove_dir_all(project.join("rowgram/locate")).unwrap();
    let output = again();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(results(project), *expected);
}
