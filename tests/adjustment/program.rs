//! `rowgram adjust` of a block with control, and `rowgram convert`, as a person or a script calls them.

use super::toy::{self, NOISE, Plan, measured, truth, with_positions};
use crate::program::{rowgram, rowgram_words};
use rowgram::{
    camera::{Interior, Model as LensModel},
    io::{colmap, model::Model},
    scene::{Reconstruction, Role},
};
use serde_json::Value;
use std::{fmt::Write, path::Path, process::Command};

/// A measured block: a COLMAP model in `sparse`, its control, marks and camera positions in CSV
/// files.
fn survey() -> Reconstruction {
    let interior = Interior::new(
        LensModel::Brown,
        toy::SIZE_PX,
        &[900.0, 1.0, 503.0, 371.0, -0.06, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    )
    .unwrap();
    measured(&with_positions(truth(&Plan { interior, ..Plan::default() })), 17, NOISE)
}

fn save(folder: &Path, survey: &Reconstruction) {
    let mut control = String::from(
        "label,easting_m,northing_m,height_m,Accuracy_Horizontal,Accuracy_Vertical,role\n",
    );
    for point in &survey.ground {
        let ([x, y, z], [sx, _, sz]) = (point.position_m, point.sigma_m);
        let role = if point.role == Role::Check { "check" } else { "control" };
        writeln!(control, "{},{x},{y},{z},{sx},{sz},{role}", point.name).unwrap();
    }
    let mut marks = String::from("image,label,u_px,v_px,sigma_px\n");
    for mark in &survey.marks {
        let name = &survey.images[mark.image as usize].name;
        let label = &survey.ground[mark.ground as usize].name;
        let [u, v] = mark.image_px;
        writeln!(marks, "{name},{label},{u},{v},{}", mark.sigma_px).unwrap();
    }
    let mut positions =
        String::from("image;easting_m;northing_m;height_m;sigma_xy_m;sigma_z_m\r\n");
    for position in &survey.positions {
        // Another program's names have no extension.
        let name = survey.images[position.image as usize].name.trim_end_matches(".JPG");
        let ([x, y, z], [sx, _, sz]) = (position.position_m, position.sigma_m);
        write!(positions, "{name};{x};{y};{z};{sx};{sz}\r\n").unwrap();
    }
    for (name, text) in [("gcps.csv", control), ("marks.csv", marks), ("gnss.csv", positions)] {
        std::fs::write(folder.join(name), text).unwrap();
    }
    let sparse = folder.join("sparse");
    std::fs::create_dir_all(&sparse).unwrap();
    let model = Model { survey: survey.clone(), ..Model::default() };
    colmap::write(&sparse, &model, colmap::Form::Binary, true).unwrap();
}

#[test]
fn a_block_with_control_is_adjusted_and_reported() {
    let folder = tempfile::tempdir().unwrap();
    let mut survey = survey();
    let wrong = survey.ground.iter().position(|point| point.name == "G03").unwrap();
    assert_eq!(survey.ground[wrong].role, Role::Control);
    survey.ground[wrong].position_m[0] += 1.0;
    save(folder.path(), &survey);
    std::fs::write(
        folder.path().join("block.toml"),
        "model = \"sparse\"\ncontrol = \"gcps.csv\"\nmarks = \"marks.csv\"\npositions = \"gnss.csv\"\n\
         free = [\"f_px\", \"cx_px\", \"cy_px\", \"k1\"]\ntie_sigma_px = 0.4\nreport = \"report\"\n",
    )
    .unwrap();
    let run = |more: &[&str]| {
        let output = rowgram_words(folder.path(), &[&["adjust", "block.toml"], more].concat());
        assert!(output.code == 0, "{}", output.stderr);
        output.stdout
    };
    let first = run(&["--json", "-o", "adjusted", "--to", "colmap-text"]);
    let report: Value = serde_json::from_str(&first).unwrap();
    let sigma0 = report["sigma0"].as_f64().unwrap();
    assert!((0.9..1.1).contains(&sigma0), "{sigma0}");
    let removed = report["removed"].as_array().unwrap();
    assert!(removed.iter().any(|r| r["name"] == "control point G03"), "{removed:?}");
    for axis in 0..3 {
        let rmse = report["check_rmse"][axis]["rmse_m"].as_f64().unwrap();
        // G03, whose coordinates are wrong, is among the check points now.
        assert_eq!(rmse > 0.2, axis == 0, "{rmse}");
    }
    let matrix = report["interiors"][0]["correlation"].as_array().unwrap();
    assert_eq!(matrix.len(), 4);
    // The report is the same bytes again, the pictures and tables too.
    let names = || {
        let mut all: Vec<_> = std::fs::read_dir(folder.path().join("report"))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .map(|path| (path.clone(), std::fs::read(path).unwrap()))
            .collect();
        all.sort();
        all
    };
    let before = names();
    let has = |name: &str| before.iter().any(|(path, _)| path.ends_with(name));
    for name in ["report.json", "summary.txt", "tie_points.csv", "marks.csv", "camera-1.toml"] {
        assert!(has(name), "{name}");
    }
    assert!(
        before.iter().filter(|(path, _)| path.extension() == Some("svg".as_ref())).count() >= 3
    );
    let second = Command::new(env!("CARGO_BIN_EXE_rowgram"))
        .args(["adjust", "block.toml", "--force"])
        .current_dir(folder.path())
        .env("RAYON_NUM_THREADS", "1")
        .output()
        .unwrap();
    assert!(second.status.success());
    assert!(before == names(), "a report depends on the run or the number of threads");
    let summary = String::from_utf8(second.stdout).unwrap();
    assert!(summary.contains("removed: control point G03"), "{summary}");
    assert!(summary.contains("check points Z: rmse"), "{summary}");
    // Tie points are eliminated on the fly; what ground points have stays in the reduced system.
    let path = |name: &str| {
        let all = report["batches"].as_array().unwrap();
        all.iter().find(|batch| batch["name"] == name).unwrap()["path"].clone()
    };
    assert_eq!(path("tie points"), "fused");
    assert!(path("marks")["stored"].is_string(), "{}", report["batches"]);
    // Options of BAL files are refused, unknown keys of a block.toml named.
    let foreign = rowgram(folder.path(), "adjust block.toml --solver dense");
    assert!(foreign.stderr.contains("only those are solved with it"), "{foreign:?}");
    // What exists is not replaced.
    let third = rowgram(folder.path(), "adjust block.toml");
    assert!(third.code != 0 && third.stderr.contains("--force"));
    // The calibrated camera can be taken again.
    let again =
        rowgram(folder.path(), "adjust adjusted --align=false --camera report/camera-1.toml");
    let message = again.stderr;
    assert_eq!(again.code, 2, "{message}");
    assert!(message.contains("whole block is free in 7 direction(s)"), "{message}");
}

/// What is done to a file.
type Damage<'a> = &'a dyn Fn(&str) -> String;

#[test]
fn bad_control_is_refused_by_file_line_and_name() {
    let folder = tempfile::tempdir().unwrap();
    save(folder.path(), &survey());
    let cases: [(&str, Damage<'_>, &[&str]); 11] = [
        (
            "gcps.csv",
            &|t| t.replace("easting_m", "offset"),
            &["gcps.csv, line 1:", "easting_m", "offset"],
        ),
        (
            "gcps.csv",
            &|t| t.replacen("easting_m,northing_m", "lon,lat", 1),
            &["latitude and longitude in degrees", "metres"],
        ),
        (
            "gcps.csv",
            &|t| {
                let rows = t.lines().skip(1).enumerate();
                let in_degrees = rows.map(|(k, _)| format!("P{k},-2.75{k},54.5{k},260.0"));
                let rows: Vec<String> = in_degrees.collect();
                format!("label,easting_m,northing_m,height_m\n{}\n", rows.join("\n"))
            },
            &["gcps.csv", "look like degrees"],
        ),
        (
            "gcps.csv",
            &|t| damaged(t, 3, 1, "nan"),
            &["gcps.csv, line 4:", "easting_m", "finite number"],
        ),
        ("gcps.csv", &|t| damaged(t, 3, 4, "-0.02"), &["gcps.csv, line 4:", "positive number"]),
        ("gcps.csv", &|t| damaged(t, 2, 0, "G00"), &["gcps.csv, line 3:", "G00 is there twice"]),
        (
            "gcps.csv",
            &|t| damaged(t, 2, 6, "chekc"),
            &["gcps.csv, line 3:", "control, check or tie"],
        ),
        (
            "marks.csv",
            &|t| damaged(t, 5, 1, "G99"),
            &["marks.csv, line 6:", "no ground point \"G99\""],
        ),
        (
            "marks.csv",
            &|t| format!("{t}{}\n", t.lines().nth(1).unwrap()),
            &["marks.csv, line ", "marked twice", "first in line 2"],
        ),
        (
            "marks.csv",
            &|t| t.replace("IMG_", "DJI_"),
            &["no row names an image of the block", "DJI_", "IMG_0001.JPG"],
        ),
        ("gnss.csv", &|t| damaged(t, 2, 3, "12;13"), &["gnss.csv, line 3:", "expected 6 columns"]),
    ];
    for (name, damage, parts) in cases {
        let path = folder.path().join(name);
        let whole = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, damage(&whole)).unwrap();
        let output = rowgram(
            folder.path(),
            "adjust sparse --control gcps.csv --marks marks.csv --positions gnss.csv",
        );
        let message = output.stderr;
        assert_eq!(output.code, 2, "{parts:?}: {message}");
        for part in parts {
            assert!(message.contains(part), "{part}: {message}");
        }
        assert!(output.stdout.is_empty());
        std::fs::write(&path, whole).unwrap();
    }
    // One image name that matches nothing costs its marks only, and is told.
    let path = folder.path().join("marks.csv");
    let whole = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, damaged(&whole, 1, 0, "IMG_9999.JPG")).unwrap();
    let arguments = ["adjust", "sparse", "--control", "gcps.csv", "--marks", "marks.csv", "--json"];
    let output = rowgram_words(folder.path(), &arguments);
    assert!(output.code == 0, "{}", output.stderr);
    assert!(output.stderr.contains("IMG_9999.JPG"), "{}", output.stderr);
    let report: Value = serde_json::from_str(&output.stdout).unwrap();
    let aside = report["excluded"].as_array().unwrap();
    assert!(aside.iter().any(|a| a["image"] == "IMG_9999.JPG"), "{aside:?}");
}

/// A table with one field (row and column from 0, the header being row 0) replaced.
fn damaged(table: &str, row: usize, column: usize, by: &str) -> String {
    let separator = if table.contains(';') { ";" } else { "," };
    let lines = table.lines().enumerate().map(|(k, line)| {
        let mut fields: Vec<&str> = line.split(separator).collect();
        if k == row {
            fields[column] = by;
        }
        fields.join(separator)
    });
    lines.collect::<Vec<String>>().join("\n") + "\n"
}

#[test]
fn reconstructions_are_converted() {
    let folder = tempfile::tempdir().unwrap();
    let survey = survey();
    save(folder.path(), &survey);
    for (from, to, out) in [
        ("sparse", "opensfm", "sfm/reconstruction.json"),
        ("sfm/reconstruction.json", "colmap-text", "text"),
        ("text", "colmap-binary", "binary"),
    ] {
        std::fs::create_dir_all(folder.path().join("sfm")).unwrap();
        let output = rowgram_words(folder.path(), &["convert", from, "--to", to, "-o", out]);
        assert!(output.code == 0, "{}", output.stderr);
        let message = output.stdout;
        assert!(message.starts_with("1 cameras, 12 images"), "{message}");
    }
    let back = colmap::read(&folder.path().join("binary")).unwrap().survey;
    let centre = |s: &Reconstruction, name: &str| {
        s.images.iter().find(|image| image.name == name).unwrap().pose.centre_m()
    };
    for image in &survey.images {
        let other = centre(&back, &image.name);
        for (a, b) in image.pose.centre_m().iter().zip(other) {
            assert!((a - b).abs() < 1e-7);
        }
    }
    assert_eq!(back.observations.len(), survey.observations.len());
    assert_eq!(back.cameras[0].interior.model(), LensModel::Brown);
    // Bundler has no principal point: refused, and nothing is written.
    let output = rowgram(folder.path(), "convert sparse --to bundler -o bundle.out");
    assert_eq!(output.code, 2);
    assert!(!folder.path().join("bundle.out").exists());
}
