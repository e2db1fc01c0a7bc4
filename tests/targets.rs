//! `rowgram targets`: what is found in the photos of a synthetic flight, against where it truly is, and what it is worth.

use crate::program::rowgram;
use std::{collections::HashMap, fs, path::Path};

/// Image and label to column and row.
fn marks(path: &Path) -> HashMap<(String, String), [f64; 2]> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    let rows = reader.deserialize().map(|row: Result<HashMap<String, String>, _>| row.unwrap());
    rows.map(|row| {
        let at = ["u_px", "v_px"].map(|column| row[column].parse().unwrap());
        ((row["image"].clone(), row["label"].clone()), at)
    })
    .collect()
}

/// Makes a project without marks, and aligns it.
fn aligned(folder: &Path, pattern: &str, size: &str) {
    let options = format!(
        "synth flight -o field --seed 4 --targets {pattern} --target-size {size} --config tiny.toml"
    );
    let settings = "[field]\nrows = 16\nrow_length_m = 12.0\n[camera]\nwidth_px = 1000\nheight_px = 750\nc_px = 800.0\n\
        [flight]\nheight_m = 12.0\nstrips = 3\nphotos_per_strip = 4\nmargin_m = -2.0\nspeed_m_s = 4.0\n\
        [flight.gnss]\nhorizontal_m = 0.7\nvertical_m = 1.0\n[targets]\ncontrol = 6\ncheck = 3\n";
    fs::write(folder.join("tiny.toml"), settings).unwrap();
    for arguments in [options.as_str(), "align field --json"] {
        let run = match arguments.starts_with("align") {
            true => {
                fs::remove_file(folder.join("field/marks.csv")).unwrap();
                rowgram(folder, arguments)
            }
            false => rowgram(folder, arguments),
        };
        assert_eq!(run.code, 0, "{}", run.stderr);
    }
}

/// Root mean square errors of the check points, metres.
fn check_errors(folder: &Path) -> [f64; 3] {
    let run = rowgram(folder, "align field --json");
    assert!(run.code == 0 || run.code == 3, "{}", run.stderr);
    let found: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    ["rmse_x_m", "rmse_y_m", "rmse_z_m"]
        .map(|key| found["check_points"][key].as_f64().unwrap_or(f64::NAN))
}

#[test]
#[ignore = "slow; aligns photos of four flights"]
fn targets_are_found_where_they_are_and_are_worth_as_much_as_true_marks() {
    // A code that a leaf covers in part is not read.
    for (pattern, size, share) in [
        ("chequered", "0.3", 0.98),
        ("cross", "0.4", 0.98),
        ("disc", "0.25", 0.98),
        ("apriltag", "0.45", 0.95),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        aligned(folder, pattern, size);
        let run =
            rowgram(folder, &format!("targets field --size-m {size} --kind {pattern} --json"));
        assert_eq!(run.code, 0, "{}", run.stderr);
        let outcome: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
        let (found, truth) =
            (marks(&folder.join("field/marks.csv")), marks(&folder.join("field/truth/marks.csv")));
        let mut errors: Vec<f64> = (truth.iter())
            .filter_map(|(key, at)| Some((found.get(key)?, at)))
            .map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]))
            .collect();
        errors.sort_by(f64::total_cmp);
        let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
        let said = format!(
            "{pattern}: {} of {} found, median {median:.3} px, worst {worst:.3} px, {outcome}",
            errors.len(),
            truth.len()
        );
        println!("{said}");
        assert!(errors.len() as f64 >= share * truth.len() as f64, "{said}");
        assert!(median <= 0.15 && worst <= 1.0, "{said}");
        for name in ["targets.csv", "targets.png"] {
            assert!(folder.join("field/rowgram/targets").join(name).is_file(), "{name}");
        }
        // Marks are never replaced unasked.
        let again = rowgram(folder, &format!("targets field --size-m {size}"));
        assert_eq!(again.code, 2);
        assert!(again.stderr.contains("--force"), "{}", again.stderr);
        if pattern == "chequered" {
            let with_found = check_errors(folder);
            fs::copy(folder.join("field/truth/marks.csv"), folder.join("field/marks.csv")).unwrap();
            let with_true = check_errors(folder);
            println!("check points {with_found:.3?} m, with true marks {with_true:.3?} m");
            for (found, truth) in with_found.iter().zip(with_true) {
                assert!(*found < 1.3 * truth + 0.005, "{with_found:?} {with_true:?}");
            }
        }
    }
}

#[test]
fn a_sheet_of_targets_is_a_file_that_says_what_it_needs() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let run = rowgram(folder, "targets --print sheet.pdf --kind aruco --size-m 0.3 --count 3");
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(fs::read(folder.join("sheet.pdf")).unwrap().starts_with(b"%PDF-1.4"));
    for (arguments, part) in [
        ("--print sheet.pdf --kind aruco --size-m 0.3", "--force"),
        ("--print other.pdf --size-m 0.3", "--kind"),
        ("--print other.pdf --kind aruco --size-m 0.3 --first 50", "codes 0 to 49"),
        ("--print other.png --kind aruco --size-m 0.3", ".pdf"),
        ("nowhere", "nowhere"),
        (". --size-m 0", "--size-m 0"),
    ] {
        let run = rowgram(folder, &format!("targets {arguments}"));
        assert_eq!(run.code, 2, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(part), "{arguments}: {}", run.stderr);
    }
}
