//! `rowgram run` on a machine that has no data.

use crate::program::rowgram;
use std::{fs, path::Path};

const FILES: [&str; 10] = [
    "field/picture.png",
    "field/mask.png",
    "field/plants.csv",
    "field/field.toml",
    "segmented.png",
    "plants.csv",
    "found.png",
    "block.txt",
    "adjusted.txt",
    "run.json",
];

fn contents(folder: &Path) -> Vec<Vec<u8>> {
    FILES.iter().map(|name| fs::read(folder.join(name)).unwrap()).collect()
}

#[test]
fn the_main_job_needs_nothing_and_repeats_itself() {
    let folder = tempfile::tempdir().unwrap();
    let first = rowgram(folder.path(), "run -q --json");
    assert_eq!(first.code, 0, "{}", first.stderr);
    let report: serde_json::Value = serde_json::from_str(&first.stdout).unwrap();
    let (field, block) = (&report["field"], &report["block"]);
    assert_eq!(field["found"], field["truth"]);
    assert_eq!(field["rows"], 4);
    assert!(field["radii"][1]["f1"].as_f64().unwrap() > 0.3, "{field}");
    // Measurements have 0.5 px in each coordinate; an adjusted block explains all but that.
    let rmse_px = block["rmse_px"].as_f64().unwrap();
    assert!((0.3..0.8).contains(&rmse_px), "{block}");
    let written = contents(&folder.path().join("rowgram-run"));
    // The picture segments into its true mask: the two agree as pictures.
    let open = |name: &str| image::open(folder.path().join("rowgram-run").join(name)).unwrap();
    assert!(open("segmented.png").into_luma8() == open("field/mask.png").into_luma8());

    let again = rowgram(folder.path(), "run -q --threads 1 -o again");
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(again.stdout.contains("F1") && again.stdout.contains("found.png"), "{}", again.stdout);
    assert!(contents(&folder.path().join("again")) == written);

    let refused = rowgram(folder.path(), "run -q");
    assert_eq!(refused.code, 2);
    assert!(refused.stderr.contains("rowgram-run"), "{}", refused.stderr);
    let forced = rowgram(folder.path(), "run -q --force --seed 2");
    assert_eq!(forced.code, 0, "{}", forced.stderr);
    assert!(contents(&folder.path().join("rowgram-run")) != written);
}
