//! `rowgram run`: the whole way on a field of its own, and everything that happens to runs.

use crate::program::rowgram;
use rowgram::{
    io::{FileError, geotiff},
    raster::{
        georeference::{Crs, Georeference},
        window::Window,
    },
};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

/// Ground sampling distance of the small orthomosaic, metres.
const GSD_M: f64 = 0.015;

/// A project that is one orthomosaic of a synthetic field, with the truth and two plots.
fn orthomosaic(folder: &Path) {
    let parent = folder.parent().unwrap();
    let words = "synth mask --stage mid --rows 4 --row-length 5 --seed 3 -o grown -q";
    let grown = rowgram(parent, &format!("{words} --gsd {GSD_M}"));
    assert_eq!(grown.code, 0, "{}", grown.stderr);
    fs::create_dir(folder).unwrap();
    let picture = image::open(parent.join("grown/picture.png")).unwrap().into_rgb8();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let place = Georeference::north_up([500_000.0, 4_480_000.0], GSD_M, Crs::projected(32616));
    let layout = geotiff::Layout {
        width,
        height,
        colour: geotiff::Colour::Rgb,
        georeference: Some(place),
        nodata: None,
    };
    geotiff::write::<u8, FileError>(&folder.join("field.tif"), false, &layout, |writer| {
        writer.put(Window::whole(width, height), picture.as_raw())
    })
    .unwrap();
    let mut truth = "easting_m,northing_m,leaves\n".to_owned();
    for line in fs::read_to_string(parent.join("grown/plants.csv")).unwrap().lines().skip(1) {
        let numbers: Vec<f64> = line.split(',').take(2).map(|x| x.parse().unwrap()).collect();
        let [x, y] = place.map([numbers[0], numbers[1]]);
        truth += &format!("{x:.4},{y:.4},6\n");
    }
    fs::write(folder.join("truth.csv"), truth).unwrap();
    let middle = width as f64 / 2.0;
    let plot = |name: &str, left: f64, right: f64| {
        let corners = [[left, 0.0], [right, 0.0], [right, height as f64], [left, height as f64]];
        let mut ring: Vec<[f64; 2]> = corners.iter().map(|at| place.map(*at)).collect();
        ring.push(ring[0]);
        serde_json::json!({
            "type": "Feature", "properties": {"name": name},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        })
    };
    let plots = serde_json::json!({
        "type": "FeatureCollection",
        "features": [plot("West", 0.0, middle), plot("East", middle, width as f64)],
    });
    fs::write(folder.join("plots.geojson"), plots.to_string()).unwrap();
    let settings = "[project]\ntruth = \"truth.csv\"\n[count]\nrho_px = 40.0\n";
    fs::write(folder.join("rowgram.toml"), settings).unwrap();
}

/// What a run leaves that has to be the same again: all files of its stages.
fn results(project: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let stages = ["segment", "density", "count", "locate", "leaves", "plots", "evaluate"];
    let mut found = BTreeMap::new();
    for stage in stages {
        let folder = project.join("rowgram").join(stage);
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{stage}: {e}")) {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(project).unwrap().to_owned();
            found.insert(name, fs::read(path).unwrap());
        }
    }
    assert!(found.len() > 10, "{:?}", found.keys());
    found
}

#[test]
fn an_orthomosaic_alone_is_a_project() {
    let folder = tempfile::tempdir().unwrap();
    // A path that people have.
    let project = folder.path().join("Feld Süd 3");
    orthomosaic(&project);
    let run = |words: &str| {
        let output = Command::new(env!("CARGO_BIN_EXE_rowgram"))
            .arg("run")
            .arg(&project)
            .args(words.split_whitespace())
            .output()
            .unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let (out, err) = (text(output.stdout), text(output.stderr));
        assert!(!err.contains("panicked"), "{err}");
        (output.status.code().unwrap(), out, err)
    };
    let (code, plan, err) = run("--dry-run -q");
    assert_eq!(code, 0, "{err}");
    assert!(plan.contains("segment") && !project.join("rowgram").exists(), "{plan}");

    let (code, out, err) = run("--json -q");
    assert_eq!(code, 0, "{err}");
    let stats: Value = serde_json::from_str(&out).unwrap();
    assert!(stats["skipped"]["align"].as_str().unwrap().contains("orthomosaic"), "{stats}");
    let score = &stats["stages"]["evaluate"]["score"];
    assert!(score["radii"][1]["f1"].as_f64().unwrap() > 0.6, "{score}");
    let plots = stats["stages"]["plots"]["plots"].as_array().unwrap();
    let sum: f64 = plots.iter().map(|plot| plot["plants"].as_f64().unwrap()).sum();
    assert_eq!(sum, score["found"].as_f64().unwrap(), "the plots are all of the field");
    let area: f64 = plots.iter().map(|plot| plot["area_m2"].as_f64().unwrap()).sum();
    let source = rowgram::io::rasters::Source::open(&project.join("field.tif")).unwrap();
    let (width, height) = source.size();
    // Plots have been rounded to six digits.
    approx::assert_relative_eq!(area, (width * height) as f64 * GSD_M * GSD_M, max_relative = 1e-5);
    let page = fs::read_to_string(project.join("rowgram/report.html")).unwrap();
    for text in ["Plants", "West", "SHA-256", "prefers-color-scheme", "data:image/jpeg;base64"] {
        assert!(page.contains(text), "{text}");
    }
    for outside in ["http://", "https://", "<script", "src=\"/"] {
        assert!(!page.contains(outside), "the page needs nothing else: {outside}");
    }
    let first = results(&project);

    // Nothing has changed, so nothing is done; a setting changes what depends on it and no more.
    let (code, _, err) = run("");
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("segment: nothing has changed") && err.contains("leaves: nothing"),
        "{err}"
    );
    assert!(results(&project) == first);
    let (_, _, err) = run("--set density.window_px=21");
    assert!(err.contains("density: rowgram density") && err.contains("locate: nothing"), "{err}");
    let (_, _, err) = run("--from locate");
    assert!(err.contains("segment: nothing") && err.contains("locate: rowgram locate"), "{err}");
    assert!(results(&project) == first);

    // A file that somebody touched is made again.
    fs::write(project.join("rowgram/locate/plants.csv"), "u_px,v_px\n").unwrap();
    run("-q");
    assert!(results(&project) == first);

    // What another build of the same version wrote is kept, and said to be.
    let record = project.join("rowgram/stages/locate.json");
    let text = fs::read_to_string(&record).unwrap();
    let mut other: Value = serde_json::from_str(&text).unwrap();
    other["program"] = Value::from("0");
    fs::write(&record, other.to_string()).unwrap();
    let (_, _, err) = run("");
    assert!(err.contains("locate: kept") && err.contains("--from locate"), "{err}");
    fs::write(&record, text).unwrap();

    // Verified, moved, verified again, and a byte that is not as it was is told.
    let moved = folder.path().join("elsewhere");
    fs::rename(&project, &moved).unwrap();
    let same = rowgram(folder.path(), "verify elsewhere -q");
    assert_eq!(same.code, 0, "{} {}", same.stdout, same.stderr);
    let again = rowgram(folder.path(), "run elsewhere");
    assert!(again.stderr.contains("locate: nothing has changed"), "{}", again.stderr);
    fs::write(moved.join("rowgram/locate/plants.csv"), "u_px,v_px\n").unwrap();
    let differs = rowgram(folder.path(), "verify elsewhere -q --files");
    assert_eq!(differs.code, 3);
    assert!(differs.stdout.contains("plants.csv"), "{}", differs.stdout);
}

#[test]
fn a_run_that_was_killed_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    orthomosaic(&whole);
    fs::remove_dir_all(folder.path().join("grown")).unwrap();
    orthomosaic(&killed);
    let done = rowgram(folder.path(), "run whole -q");
    assert_eq!(done.code, 0, "{}", done.stderr);
    for wait_ms in [30, 60, 120, 240, 480] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_rowgram"))
            .args(["run", "killed", "-q"])
            .current_dir(folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(wait_ms));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let done = rowgram(folder.path(), "run killed -q");
    assert_eq!(done.code, 0, "{}", done.stderr);
    let (whole, killed) = (results(&whole), results(&killed));
    assert!(whole.keys().eq(killed.keys()), "{:?} {:?}", whole.keys(), killed.keys());
    for (name, bytes) in &whole {
        assert!(killed[name] == *bytes, "{}", name.display());
    }
}

#[test]
fn two_runs_do_not_meet_and_mistakes_leave_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let project = folder.path().join("field");
    orthomosaic(&project);
    let wrong = rowgram(folder.path(), "run field --set locate.plant=3");
    assert_eq!(wrong.code, 2);
    assert!(wrong.stderr.contains("locate.plant"), "{}", wrong.stderr);
    assert!(!project.join("rowgram").exists());

    fs::create_dir(project.join("rowgram")).unwrap();
    let lock = fs::File::create(project.join("rowgram/.lock")).unwrap();
    lock.lock().unwrap();
    let second = rowgram(folder.path(), "run field -q");
    assert_eq!(second.code, 2);
    assert!(second.stderr.contains("another rowgram run"), "{}", second.stderr);
    drop(lock);

    let nothing = folder.path().join("nothing");
    fs::create_dir(&nothing).unwrap();
    let empty = rowgram(folder.path(), "run nothing -q");
    assert_eq!(empty.code, 2);
    assert!(empty.stderr.contains("no photos"), "{}", empty.stderr);
    let refused = rowgram(folder.path(), "run -o field -q");
    assert_eq!(refused.code, 2, "a folder of somebody's is no place for a synthetic field");
    assert!(!project.join("images").exists());

    let init = rowgram(folder.path(), "init nothing");
    assert_eq!(init.code, 0, "{}", init.stderr);
    let text = fs::read_to_string(nothing.join("rowgram.toml")).unwrap();
    assert!(text.contains("max_features = 6000"), "{text}");
    assert_eq!(rowgram(folder.path(), "init nothing").code, 2, "a file of somebody's stays");
    let sick = rowgram(folder.path(), "doctor nothing -q");
    assert_eq!(sick.code, 3);
    assert!(sick.stdout.contains("BAD") && sick.stdout.contains("photos"), "{}", sick.stdout);
}

#[test]
fn shells_and_manuals_know_the_verbs() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish"] {
        let script = rowgram(folder.path(), &format!("completions {shell}"));
        assert!(script.code == 0 && script.stdout.contains("calibrate"), "{shell}");
    }
    let page = rowgram(folder.path(), "man");
    assert!(page.code == 0 && page.stdout.contains(".TH rowgram"), "{}", page.stdout);
    let pages = rowgram(folder.path(), "man -o pages");
    assert_eq!(pages.code, 0, "{}", pages.stderr);
    assert!(folder.path().join("pages/rowgram-align.1").is_file());
}

/// The README's first command: photos of a field of its own, to a report.
#[test]
fn the_main_job_needs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = rowgram(folder.path(), "run -q --json");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let stats: Value = serde_json::from_str(&run.stdout).unwrap();
    let (align, truth) = (&stats["stages"]["align"], &stats["stages"]["evaluate"]);
    assert_eq!(align["registered"], align["images"], "{align}");
    let map = &stats["stages"]["ortho"]["maps"][0];
    let gsd_m = map["gsd_m"].as_f64().unwrap();
    // Drawn at the height of the leaves, without which one plant in five is found beside its place.
    assert!((0.1..0.3).contains(&map["above_m"].as_f64().unwrap()), "{map}");
    for axis in ["x", "y", "z"] {
        // Targets are surveyed to 2 cm and marked to half a pixel of 1.5 cm.
        let rmse = align["check_points"][format!("rmse_{axis}_m")].as_f64().unwrap();
        assert!(rmse < 6.0 * gsd_m, "{axis}: {rmse} m");
    }
    let f1 = |radius: usize| truth["score"]["radii"][radius]["f1"].as_f64().unwrap();
    assert!(f1(0) > 0.85 && f1(1) > 0.9, "{truth}");
    let project = folder.path().join("rowgram-run");
    crate::formats::assert_columns_are_documented(&project);
    for other in ["colmap/cameras.txt", "opensfm/reconstruction.json"] {
        assert!(project.join("rowgram/align").join(other).is_file(), "{other}");
    }
    let page = fs::read_to_string(project.join("rowgram/report.html")).unwrap();
    for text in ["Check points", "Correlations", "GCP01", "rowgram ortho", "Match graph"] {
        assert!(page.contains(text), "{text}");
    }
    // The same field again is this one, another is another.
    let again = rowgram(folder.path(), "run");
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(again.stderr.contains("align: nothing has changed"), "{}", again.stderr);
    let refused = rowgram(folder.path(), "run -q --seed 2");
    assert_eq!(refused.code, 2);
    assert!(refused.stderr.contains("rowgram-run"), "{}", refused.stderr);

    // Done once more at another place: the same bytes.
    fs::rename(&project, folder.path().join("moved")).unwrap();
    let same = rowgram(folder.path(), "verify moved -q");
    assert_eq!(same.code, 0, "{} {}", same.stdout, same.stderr);
}
