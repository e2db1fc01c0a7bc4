//! `rowgram run`: the whole way on a field of its own, and everything that happens to runs.

use crate::{
    maps,
    program::{contents, rowgram},
};
use rowgram::raster::georeference::{Crs, Georeference};
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

#[path = "../examples/photos_to_plants.rs"]
#[allow(dead_code, reason = "its main is for the command line")]
mod photos_to_plants;

/// A project that is one orthomosaic of a synthetic field, with the truth and two plots.
pub(crate) fn orthomosaic(folder: &Path) {
    let parent = folder.parent().unwrap();
    let picture = maps::picture(parent);
    fs::create_dir(folder).unwrap();
    let place =
        Georeference::north_up([500_000.0, 4_480_000.0], maps::GSD_M, Crs::projected(32616));
    maps::write(&folder.join("field.tif"), &picture, place);
    let mut truth = "easting_m,northing_m,leaves\n".to_owned();
    for line in fs::read_to_string(parent.join("grown/plants.csv")).unwrap().lines().skip(1) {
        let numbers: Vec<f64> = line.split(',').take(2).map(|x| x.parse().unwrap()).collect();
        let [x, y] = place.map([numbers[0], numbers[1]]);
        truth += &format!("{x:.4},{y:.4},6\n");
    }
    fs::write(folder.join("truth.csv"), truth).unwrap();
    let plot = |name: &str, of: [f64; 2]| maps::plot(&picture, place, of, json!({"name": name}));
    let plots = vec![plot("West", [0.0, 0.5]), plot("East", [0.5, 1.0])];
    fs::write(folder.join("plots.geojson"), maps::collection(None, plots)).unwrap();
    let settings = "[project]\ntruth = \"truth.csv\"\n[leaf_count]\nrho_px = 40.0\n";
    fs::write(folder.join("rowgram.toml"), settings).unwrap();
}

/// Two projects of the same orthomosaic, named so.
pub(crate) fn two_alike(folder: &Path, names: [&str; 2]) -> [PathBuf; 2] {
    names.map(|name| {
        let project = folder.join(name);
        orthomosaic(&project);
        fs::remove_dir_all(folder.join("grown")).unwrap();
        project
    })
}

/// What a run leaves that has to be the same again: all files of its stages.
pub(crate) fn results(project: &Path) -> BTreeMap<String, Vec<u8>> {
    let stages = ["segment", "leaf-density", "leaf-count", "locate", "leaves", "plots", "evaluate"];
    let is_of_stage =
        |name: &str| name.split_once('/').is_some_and(|(stage, _)| stages.contains(&stage));
    let mut found = contents(&project.join("rowgram"));
    found.retain(|name, _| is_of_stage(name));
    assert!(found.len() > 10, "{:?}", found.keys());
    found
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
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
    let outcome: Value = serde_json::from_str(&out).unwrap();
    let align = &outcome["stages"][1];
    assert_eq!(
        (align["stage"].as_str(), align["ending"].as_str()),
        (Some("align"), Some("left-out"))
    );
    assert!(align["reason"].as_str().unwrap().contains("orthomosaic"), "{align}");
    let score = &outcome["results"]["evaluate"]["score"];
    assert!(score["radii"][1]["f1"].as_f64().unwrap() > 0.6, "{score}");
    let plots = outcome["results"]["plots"]["plots"].as_array().unwrap();
    let sum: f64 = plots.iter().map(|plot| plot["plants"].as_f64().unwrap()).sum();
    assert_eq!(sum, score["found"].as_f64().unwrap(), "the plots are all of the field");
    let area: f64 = plots.iter().map(|plot| plot["area_m2"].as_f64().unwrap()).sum();
    let source = rowgram::io::rasters::Source::open(&project.join("field.tif")).unwrap();
    let (width, height) = source.size();
    // Plots have been rounded to six digits.
    approx::assert_relative_eq!(
        area,
        (width * height) as f64 * maps::GSD_M * maps::GSD_M,
        max_relative = 1e-5
    );
    let page = fs::read_to_string(project.join("rowgram/report.html")).unwrap();
    for text in ["Plants", "West", "SHA-256", "prefers-color-scheme", "data:image/jpeg;base64"] {
        assert!(page.contains(text), "{text}");
    }
    for outside in ["http://", "https://", "<script src", "src=\"/"] {
        assert!(!page.contains(outside), "the page needs nothing else: {outside}");
    }
    crate::browser::drive_map(folder.path(), &page);
    let first = results(&project);

    // Nothing has changed, so nothing is done; a setting changes what depends on it and no more.
    let (code, _, err) = run("");
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("segment: nothing has changed") && err.contains("leaves: nothing"),
        "{err}"
    );
    assert!(results(&project) == first);
    let (_, _, err) = run("--set leaf_density.window_px=21");
    assert!(!err.contains("leaf-density: nothing") && err.contains("locate: nothing"), "{err}");
    let (_, _, err) = run("--from locate");
    assert!(err.contains("segment: nothing") && !err.contains("locate: nothing"), "{err}");
    assert!(!err.contains("rowgram locate"), "messages are not buried by commands: {err}");
    let (_, plan, _) = run("--dry-run --set locate.plants=50");
    let of = |stage: &str| plan.lines().find(|line| line.starts_with(stage)).unwrap().to_owned();
    assert!(of("segment").contains("kept") && of("locate").contains("to be done"), "{plan}");
    assert!(of("locate").contains("rowgram locate . --plants=50"), "{plan}");
    assert!(of("evaluate").contains("afterwards") && of("dem").contains("left out"), "{plan}");
    assert!(results(&project) == first);

    // A file that is gone is made again.
    fs::remove_file(project.join("rowgram/locate/plants.csv")).unwrap();
    run("-q");
    assert!(results(&project) == first);

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
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_run_that_was_killed_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, killed] = two_alike(folder.path(), ["whole", "killed"]);
    let done = rowgram(folder.path(), "run whole -q");
    assert_eq!(done.code, 0, "{}", done.stderr);
    // Killed later and later, until a kill has met it with some stages done and others not.
    let mut wait_ms = 30;
    loop {
        let mut child = Command::new(env!("CARGO_BIN_EXE_rowgram"))
            .args(["run", "killed", "-q"])
            .current_dir(folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(wait_ms));
        child.kill().unwrap();
        let status = child.wait().unwrap();
        assert!(!status.success(), "the run was over within {wait_ms} ms: no kill has met it");
        let stage = |name: &str| killed.join("rowgram").join(name).exists();
        assert!(!stage("evaluate"), "after {wait_ms} ms the last stage was done");
        if stage("segment") {
            break;
        }
        wait_ms += wait_ms / 4;
    }
    let done = rowgram(folder.path(), "run killed -q");
    assert_eq!(done.code, 0, "{}", done.stderr);
    let (whole, killed) = (results(&whole), results(&killed));
    assert!(whole.keys().eq(killed.keys()), "{:?} {:?}", whole.keys(), killed.keys());
    for (name, bytes) in &whole {
        assert!(killed[name] == *bytes, "{name}");
    }
}

#[test]
fn a_second_run_is_refused_and_mistakes_leave_nothing() {
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
    assert!(second.stderr.contains("another rowgram process"), "{}", second.stderr);
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
    assert!(text.contains("lens = \"auto\"") && !text.contains("max_features"), "{text}");
    let init = rowgram(folder.path(), "init nothing --experts --force");
    assert_eq!(init.code, 0, "{}", init.stderr);
    let text = fs::read_to_string(nothing.join("rowgram.toml")).unwrap();
    assert!(text.contains("max_features = 6000"), "{text}");
    assert_eq!(rowgram(folder.path(), "init nothing").code, 2, "a file of somebody's stays");
    let sick = rowgram(folder.path(), "doctor nothing -q");
    assert_eq!(sick.code, 3);
    assert!(sick.stdout.contains("error ") && sick.stdout.contains("photos"), "{}", sick.stdout);
}

#[test]
fn shells_and_manuals_know_the_commands() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish"] {
        let script = rowgram(folder.path(), &format!("completions {shell}"));
        assert!(script.code == 0 && script.stdout.contains("calibrate"), "{shell}");
    }
    let page = rowgram(folder.path(), "completions --man");
    assert!(page.code == 0 && page.stdout.contains(".TH rowgram"), "{}", page.stdout);
    let pages = rowgram(folder.path(), "completions --man -o pages");
    assert_eq!(pages.code, 0, "{}", pages.stderr);
    assert!(folder.path().join("pages/rowgram-align.1").is_file());
}

/// Settings that cannot be, and what is said of each.
const NONSENSE: [(&str, &str); 23] = [
    ("align.seed=-1", "seed = -1: expected a whole number"),
    ("align.max_features=0", "max_features = 0: expected a whole number of at least 100"),
    ("align.max_features=1.5", "max_features = 1.5: expected a whole number"),
    ("align.tolerance_px=0", "tolerance_px = 0: expected a number greater than 0"),
    ("align.tolerance_px=-4", "tolerance_px = -4: expected a number greater than 0"),
    ("align.tolerance_px=nan", "tolerance_px = nan: expected a number greater than 0"),
    ("align.tolerance_px=inf", "tolerance_px = inf: expected a number greater than 0"),
    ("align.lens=fish", "lens = \"fish\": expected one of: auto, brown, smac"),
    ("align.solver=six-point", "solver = \"six-point\": expected one of: auto"),
    ("align.use_positions=maybe", "use_positions = \"maybe\": expected true or false"),
    ("dem.cell_m=-1", "cell_m = -1: expected a number greater than 0"),
    ("dem.outlier_ratio=0", "outlier_ratio = 0: expected a number greater than 0"),
    ("ortho.canopy_height_m=top", "canopy_height_m = \"top\": expected auto or a number"),
    ("ortho.border_px=-0.2", "border_px = -0.2: expected a number"),
    ("segment.hsv=30,79,30,300", "expected auto or 4 whole numbers from 0 to 255"),
    ("segment.hsv=30,79,30", "expected auto or 4 whole numbers"),
    ("leaf_density.window_px=40", "window_px = 40: expected an odd number"),
    ("leaf_count.rho_px=0", "rho_px = 0: expected a number greater than 0"),
    ("locate.plants=0", "plants = 0: expected auto or a whole number of at least 1"),
    ("locate.tempering=6", "tempering: it belongs into [locate.paper]"),
    ("calibrate.square_m=0.025", "board and square_m: expected both"),
    ("project.crs=EPSG:1", "[project] crs = \"EPSG:1\""),
    ("evaluate.radii_m=0.05,-0.1", "radii_m = [0.05, -0.1]: expected a list"),
];

#[test]
fn settings_that_cannot_be_are_refused_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let project = folder.path().join("field");
    orthomosaic(&project);
    let settings = fs::read_to_string(project.join("rowgram.toml")).unwrap();
    let refused = |run: crate::program::Run, what: &str, expected: &str| {
        let said = format!("{}{}", run.stdout, run.stderr);
        assert!(run.code == 2 || run.code == 3, "{what}: {said}");
        assert!(said.contains(expected), "{what}: {said}");
        assert!(!project.join("rowgram").exists(), "{what}");
    };
    for (setting, expected) in NONSENSE {
        let words = format!("run field --dry-run --set {setting}");
        refused(rowgram(folder.path(), &words), &words, expected);
        // The same in the file: TOML needs its quotes.
        let (name, value) = setting.split_once('=').unwrap();
        let (section, key) = name.split_once('.').unwrap();
        let value = match value {
            list if list.contains(',') => format!("[{list}]"),
            number if number.parse::<f64>().is_ok() => number.to_owned(),
            word => format!("\"{word}\""),
        };
        let text = match settings.split_once(&format!("[{section}]\n")) {
            Some((before, after)) => {
                format!("{before}[{section}]\n{key} = {value}\n{}", after.replace("rho_px", "#"))
            }
            None => format!("{settings}[{section}]\n{key} = {value}\n"),
        };
        fs::write(project.join("rowgram.toml"), text).unwrap();
        let doctor = rowgram(folder.path(), "doctor field");
        assert_eq!(doctor.code, 3);
        refused(doctor, &format!("doctor, {setting}"), expected);
        fs::write(project.join("rowgram.toml"), &settings).unwrap();
    }
    // Every command of a project reads all of the settings, not only its own.
    let text = format!("{settings}[align]\ntolerance_px = -4\n");
    fs::write(project.join("rowgram.toml"), text).unwrap();
    let commands = [
        "segment",
        "leaves density",
        "leaves count",
        "locate",
        "leaves",
        "plots",
        "align",
        "surface dem",
        "surface",
        "ortho",
        "camera calibrate",
    ];
    for command in commands.iter().chain(&["run", "verify"]) {
        let words = format!("{command} field");
        refused(rowgram(folder.path(), &words), &words, "tolerance_px = -4: expected");
    }
    fs::write(project.join("rowgram.toml"), &settings).unwrap();
    for (words, expected) in [
        ("run field --dry-run --set align.sede=1", "did you mean seed?"),
        ("run field --dry-run --set algin.seed=1", "did you mean [align]?"),
        ("run field --dry-run --set project.control=no.csv", "there is no such file"),
        ("run field --dry-run --from grow", "expected one of: calibrate"),
        ("run field --dry-run --from plots --until align", "--from plots --until align"),
        ("segment field --hsv 30,79,30,300", "expected auto or 4 whole numbers"),
    ] {
        refused(rowgram(folder.path(), words), words, expected);
    }
    let output = Command::new(env!("CARGO_BIN_EXE_rowgram"))
        .args(["run", "field", "--dry-run"])
        .env("ROWGRAM_ALIGN_SEEED", "2")
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("did you mean ROWGRAM_ALIGN_SEED?"), "{said}");
}

/// The README's first command: photos of a field of its own, to a report.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn the_main_job_needs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = rowgram(folder.path(), "run -q --json");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let outcome: Value = serde_json::from_str(&run.stdout).unwrap();
    let (align, truth) = (&outcome["results"]["align"], &outcome["results"]["evaluate"]);
    assert_eq!(align["registered"], align["images"], "{align}");
    let map = &outcome["results"]["ortho"];
    let gsd_m = map["gsd_m"].as_f64().unwrap();
    // Drawn at the height of the leaves, without which one plant in five is found beside its place.
    assert!((0.1..0.3).contains(&map["canopy_height_m"].as_f64().unwrap()), "{map}");
    for axis in ["x", "y", "z"] {
        // Targets are surveyed to 2 cm and marked to half a pixel of 1.5 cm.
        let rmse = align["check_points"][format!("rmse_{axis}_m")].as_f64().unwrap();
        assert!(rmse < 6.0 * gsd_m, "{axis}: {rmse} m");
    }
    let f1 = |radius: usize| truth["score"]["radii"][radius]["f1"].as_f64().unwrap();
    assert!(f1(0) > 0.85 && f1(1) > 0.9, "{truth}");
    // Leaves on a map of photos are wider than as drawn, and more so in the mask without its probabilities. Plants stand 20 cm apart.
    let plants = truth["score"]["truth"].as_f64().unwrap();
    let alone =
        rowgram(folder.path(), "locate rowgram-run/rowgram/segment/mask.tif --json -o alone.csv");
    let alone: Value = serde_json::from_str(&alone.stdout).unwrap();
    for (located, limit) in [(&outcome["results"]["locate"], 0.035), (&alone, 0.05)] {
        let found = located["plants"].as_f64().unwrap() / plants;
        assert!((found - 1.0).abs() < limit, "{found} times the plants");
        let spacing_m = located["spacing_m"].as_f64().unwrap();
        assert!((spacing_m - 0.2).abs() < 0.01, "{spacing_m}");
    }
    let project = folder.path().join("rowgram-run");
    crate::formats::assert_columns_are_documented(&project);
    crate::surface::assert_close_to_truth(&project);
    crate::browser::assert_map_is_served(&project);
    crate::crops::assert_photos_agree_with_the_map(&project);
    for other in ["colmap/cameras.txt", "opensfm/reconstruction.json"] {
        assert!(project.join("rowgram/align").join(other).is_file(), "{other}");
    }
    let page = fs::read_to_string(project.join("rowgram/report.html")).unwrap();
    for text in ["check points", "Correlations", "GCP01", "rowgram ortho", "pairs that match"] {
        assert!(page.contains(text), "{text}");
    }
    // Every check is in the page as it is in the outcome.
    for check in outcome["checks"].as_array().unwrap() {
        let subject = check["subject"].as_str().unwrap();
        assert!(page.contains(subject), "{check}");
    }
    // Plots whose leaves were counted by hand do not validate themselves.
    let by_hand = truth["plots"].as_array().unwrap().iter();
    let by_hand = by_hand.filter(|plot| plot["is_counted_by_hand"] == true).count();
    assert_eq!(by_hand, 3, "{truth}");
    assert_eq!(truth["leaf_validation"]["plots"], 5, "{truth}");
    // The same from a program.
    let plots = photos_to_plants::traits(&project).unwrap().plots;
    assert_eq!(serde_json::to_value(&plots).unwrap(), outcome["results"]["plots"]["plots"]);

    // A red check is the last word, and the exit code.
    let red = rowgram(
        folder.path(),
        "run rowgram-run --set checks.check_points_red_gsd=0.01 --set checks.check_points_yellow_gsd=0.001",
    );
    assert_eq!(red.code, 3, "{}", red.stderr);
    let last = red.stderr.trim_end().lines().last().unwrap();
    assert!(last.starts_with("error: check points: largest rmse"), "{last}");

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
