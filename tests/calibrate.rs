//! `rowgram camera calibrate`, `undistort` and `camera convert`, as a user meets them.

use crate::{
    boards::{CLEAN, Look, corners, photo, poses, wide},
    data,
    program::rowgram,
};
use image::GrayImage;
use rowgram::{
    camera::{Interior, Lens, Model},
    io::camera as camera_file,
    target::Board,
};
use serde_json::Value;
use std::{fmt::Write as _, fs, path::Path};

const SIZE: [u32; 2] = [640, 480];
const BOARD: Board = Board { columns: 7, rows: 6 };
const TERMS: &str = "--board 7x6 --square-m 0.025 --lens brown --free k1,k2";

/// Corners of 12 photos as a table, without noise but for a rounding to hundredths of a pixel.
fn table(folder: &Path, name: &str) -> String {
    let lens = wide(SIZE);
    let mut text = "image,column,row,u_px,v_px\n".to_owned();
    for (k, pose) in poses(BOARD, &lens, 12, 8).iter().enumerate() {
        for (c, at) in corners(BOARD, &lens, pose).into_iter().enumerate() {
            let [u, v] = at.unwrap();
            let _ = writeln!(text, "{k:02}.jpg,{},{},{u:.2},{v:.2}", c % 7, c / 7);
        }
    }
    fs::write(folder.join(name), &text).unwrap();
    text
}

fn photos(folder: &Path, count: usize, look: Look) -> Vec<GrayImage> {
    let lens = wide(SIZE);
    let all: Vec<GrayImage> = poses(BOARD, &lens, count, 8)
        .iter()
        .enumerate()
        .map(|(k, pose)| photo(BOARD, &lens, pose, look, k as u64))
        .collect();
    for (k, photo) in all.iter().enumerate() {
        photo.save(folder.join(format!("{k:02}.png"))).unwrap();
    }
    all
}

fn value(report: &Value, name: &str) -> (f64, f64) {
    let all = report["parameters"].as_array().unwrap();
    let p = all.iter().find(|p| p["name"] == name).unwrap();
    (p["value"].as_f64().unwrap(), p["standard_deviation"].as_f64().unwrap())
}

fn statuses(report: &Value) -> Vec<&str> {
    report["photos"].as_array().unwrap().iter().map(|p| p["status"].as_str().unwrap()).collect()
}

#[test]
fn photos_become_a_camera_and_a_report() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let images = photos(here, 7, Look { noise: 2.0, ..CLEAN });
    // The same photo twice, one without a board, and one that is out of focus.
    images[2].save(here.join("07.png")).unwrap();
    GrayImage::from_pixel(640, 480, image::Luma([90])).save(here.join("08.png")).unwrap();
    let blurred = photo(
        BOARD,
        &wide(SIZE),
        &poses(BOARD, &wide(SIZE), 8, 8)[7],
        Look { blur_px: 3.5, noise: 2.0, shade: 0.0 },
        9,
    );
    blurred.save(here.join("09.png")).unwrap();
    let names: Vec<String> = (0..10).map(|k| format!("{k:02}.png")).collect();
    let run = rowgram(
        here,
        &format!(
            "camera calibrate {} {TERMS},p1,p2,k3 -o camera.toml --figures figures --tables tables --json",
            names.join(" ")
        ),
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let report: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(
        statuses(&report),
        ["used", "used", "used", "used", "used", "used", "used", "duplicate", "no-board", "used"]
    );
    assert!(run.stderr.contains("07.png: left out: the same as 02.png"), "{}", run.stderr);
    assert!(run.stderr.contains("08.png: left out: no chessboard"), "{}", run.stderr);
    assert!(run.stderr.contains("09.png: blurred"), "{}", run.stderr);
    assert!(report["rms_px"].as_f64().unwrap() < 0.12, "{}", report["rms_px"]);
    for (name, truth) in ["f_px", "aspect", "cx_px", "cy_px", "k1"].iter().zip(wide(SIZE).values())
    {
        let (value, sigma) = value(&report, name);
        assert!((value - truth).abs() < 4.0 * sigma, "{name}: {value} +- {sigma}, not {truth}");
    }
    for name in [
        "tables/calibration.json",
        "tables/parameters.csv",
        "tables/correlation.csv",
        "tables/photos.csv",
        "tables/corners.csv",
        "tables/residuals.csv",
        "tables/residuals_by_radius.csv",
        "tables/distortion.csv",
        "tables/models.csv",
        "figures/correlation.svg",
        "figures/residuals.svg",
        "figures/residuals_by_radius.svg",
        "figures/distortion.svg",
        "figures/before.png",
        "figures/after.png",
    ] {
        let size = fs::metadata(here.join(name)).unwrap().len();
        assert!(size > 100, "{name} has {size} bytes");
    }
    // The corners that were written lead to the same camera, whatever the number of threads.
    let again = format!(
        "--threads 1 camera calibrate --corners tables/corners.csv --size-px 640,480 {TERMS},p1,p2,k3 -o again.toml --json"
    );
    let second = rowgram(here, &again);
    assert_eq!(second.code, 0, "{}", second.stderr);
    assert_eq!(
        fs::read(here.join("camera.toml")).unwrap(),
        fs::read(here.join("again.toml")).unwrap()
    );
    // Outputs are not replaced unasked.
    let second = rowgram(here, &again);
    assert_eq!(second.code, 2, "{}", second.stderr);
    assert!(second.stderr.contains("again.toml") && second.stderr.contains("--force"));
}

#[test]
fn a_camera_takes_the_distortion_out_of_photos() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    photos(here, 2, CLEAN);
    let camera = rowgram::camera::Camera::new("wide", wide(SIZE));
    fs::write(here.join("camera.toml"), camera.to_toml()).unwrap();
    let run = rowgram(
        here,
        "camera undistort 00.png 01.png --camera camera.toml --scale 0.6 -o flat --json",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let ideal = camera_file::read(&here.join("flat/camera.toml")).unwrap().interior;
    let rows = "--board 7x6 --square-m 0.025 --lens brown";
    // Corners lie where the camera without distortion sees them: rows are straight.
    let image = rowgram::io::images::read_grey(&here.join("flat/00.png")).unwrap();
    let found =
        rowgram::target::detect(&image, BOARD, &rowgram::target::DetectionOptions::default())
            .unwrap();
    let truth = corners(BOARD, &ideal, &poses(BOARD, &wide(SIZE), 2, 8)[0]);
    assert!(found.complete);
    for c in &found.corners {
        let p = truth[c.row * 7 + c.column].unwrap();
        let off = (p[0] - c.image_px[0]).hypot(p[1] - c.image_px[1]);
        assert!(off < 0.15, "{c:?}: {off}");
    }
    for (arguments, code, part) in [
        ("camera undistort 00.png --camera camera.toml -o flat", 2, "--force"),
        ("camera undistort 00.png --camera camera.toml -o .", 2, "it is an input"),
        ("camera undistort 00.png --camera none.toml -o b", 2, "none.toml"),
        ("camera undistort 00.png --camera camera.toml -o b --scale 0", 2, "scale 0"),
        ("camera undistort flat/00.png 00.png --camera camera.toml -o b", 2, "would both become"),
        ("camera undistort camera.toml --camera camera.toml -o b", 2, "camera.toml"),
    ] {
        let run = rowgram(here, arguments);
        assert_eq!(run.code, code, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(part), "{arguments}: {}", run.stderr);
    }
    let small = rowgram(here, &format!("camera calibrate 00.png 01.png {rows} -o few.toml"));
    assert_eq!(small.code, 2);
    assert!(small.stderr.contains("2 of 2 photos can be used"), "{}", small.stderr);
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    photos(here, 4, CLEAN);
    let whole = table(here, "corners.csv");
    fs::write(here.join("nan.csv"), whole.replacen("06.jpg,3,2,", "06.jpg,3,2,NaN", 1)).unwrap();
    fs::write(here.join("short.csv"), &whole[..whole.rfind(',').unwrap()]).unwrap();
    fs::write(here.join("outside.csv"), format!("{whole}99.jpg,0,0,640.2,3\n")).unwrap();
    let one: String = whole.lines().take(43).map(|line| format!("{line}\n")).collect();
    fs::write(here.join("one.csv"), one).unwrap();
    GrayImage::new(320, 240).save(here.join("small.png")).unwrap();
    fs::write(here.join("text.jpg"), "no picture").unwrap();
    let corners = "--size-px 640,480 -o camera.toml --corners";
    for (arguments, part) in [
        (format!("00.png {TERMS} -o camera.toml"), "1 of 1 photos can be used"),
        (
            format!("00.png 01.png small.png {TERMS} -o camera.toml"),
            "small.png has 320 x 240 pixels",
        ),
        (format!("00.png 01.png text.jpg {TERMS} -o camera.toml"), "text.jpg"),
        (format!("00.png missing.png {TERMS} -o camera.toml"), "missing.png"),
        (
            "00.png 01.png 02.png 03.png --board 8x6 --square-m 0.025 -o camera.toml".to_owned(),
            "show a board of 7x6 inner corners, expected 8x6",
        ),
        ("00.png --board 8 --square-m 0.025 -o camera.toml".to_owned(), "such as 8x6"),
        (
            "00.png --board 8x6 --square-m -1 -o camera.toml".to_owned(),
            "--square-m -1: expected a number greater than 0, in metres",
        ),
        (format!("00.png {TERMS},q9 -o camera.toml"), "no parameter \"q9\""),
        (format!("{TERMS} {corners} nan.csv"), "u_px is"),
        (
            format!("{TERMS} {corners} short.csv"),
            "line 505: expected 5 columns as in the header, found 4",
        ),
        (format!("{TERMS} {corners} outside.csv"), "outside the photo of 640 x 480"),
        (format!("{TERMS} {corners} one.csv"), "1 of 1 photos can be used"),
        (format!("{TERMS} -o camera.toml --corners corners.csv"), "or size_px (width, height)"),
        (format!("small.png {TERMS} {corners} corners.csv"), "small.png has 320 x 240 pixels"),
        (format!("00.png {TERMS} -o 00.png --force"), "is an input"),
    ] {
        let run = rowgram(here, &format!("camera calibrate {arguments}"));
        assert_eq!(run.code, 2, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(part), "{arguments}: {}", run.stderr);
        assert!(!here.join("camera.toml").exists(), "{arguments}");
    }
}

#[test]
fn a_photo_that_contradicts_the_others_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let whole = table(here, "corners.csv");
    // One photo with its corners pulled about as another lens would, one with rows in disorder.
    let mut text = String::new();
    for line in whole.lines() {
        let fields: Vec<&str> = line.split(',').collect();
        let number = |k: usize| fields[k].parse::<f64>().unwrap();
        let _ = match fields[0] {
            "05.jpg" => {
                let (u, v) = (number(3), number(4));
                let bend = 4.0 * ((number(1) - 3.0) * (number(2) - 2.5)).sin();
                writeln!(text, "05.jpg,{},{},{},{}", fields[1], fields[2], u + bend, v - bend)
            }
            "09.jpg" => {
                let row = (number(2) as usize * 5) % 6;
                let row = if number(1) > 3.0 { number(2) as usize } else { row };
                writeln!(text, "09.jpg,{},{row},{},{}", fields[1], fields[3], fields[4])
            }
            _ => writeln!(text, "{line}"),
        };
    }
    fs::write(here.join("mixed.csv"), text).unwrap();
    let run = rowgram(
        here,
        &format!(
            "camera calibrate {TERMS},p1,p2,k3 --size-px 640,480 --corners mixed.csv -o camera.toml --json"
        ),
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let report: Value = serde_json::from_str(&run.stdout).unwrap();
    let found = statuses(&report);
    assert_eq!((found[5], found[9]), ("misfit", "no-plane"), "{}", run.stderr);
    assert_eq!(found.iter().filter(|s| **s == "used").count(), 10);
    assert!(report["rms_px"].as_f64().unwrap() < 0.01);
}

#[test]
fn what_cannot_be_told_apart_is_said_in_words() {
    let folder = tempfile::tempdir().unwrap();
    table(folder.path(), "corners.csv");
    let run = rowgram(
        folder.path(),
        "camera calibrate --board 7x6 --square-m 0.025 --free K0,K1,K2 --size-px 640,480 --corners corners.csv -o camera.toml",
    );
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("c_px") && run.stderr.contains("K0"), "{}", run.stderr);
    assert!(!folder.path().join("camera.toml").exists());
}

/// Ideal coordinates to pixels by Brown's formulas as the programs document them.
fn brown(x: f64, y: f64, k: [f64; 3], p: [f64; 2]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
    [
        x * radial + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x),
        y * radial + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * x * y,
    ]
}

#[test]
fn programs_see_the_same_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let lens = wide(SIZE);
    let camera = rowgram::camera::Camera::new("wide", lens);
    fs::write(here.join("camera.toml"), camera.to_toml()).unwrap();
    let convert = |program: &str, name: &str| {
        let run =
            rowgram(here, &format!("camera convert camera.toml --to {program} -o {name} --json"));
        assert_eq!(run.code, 0, "{}", run.stderr);
        let report: Value = serde_json::from_str(&run.stdout).unwrap();
        assert_eq!(report["exact"], true);
        fs::read_to_string(here.join(name)).unwrap()
    };
    let (opencv, colmap, metashape, opensfm) = (
        convert("opencv", "opencv.yml"),
        convert("colmap", "cameras.txt"),
        convert("metashape", "metashape.xml"),
        convert("opensfm", "camera_models.json"),
    );
    let list = |text: &str, after: &str| -> Vec<f64> {
        let rest = &text[text.find(after).unwrap()..];
        let inside = &rest[rest.find('[').unwrap() + 1..rest.find(']').unwrap()];
        inside.split(',').map(|n| n.trim().parse().unwrap()).collect()
    };
    let matrix = list(&opencv, "camera_matrix");
    let terms = list(&opencv, "distortion_coefficients");
    let line: Vec<f64> = colmap
        .lines()
        .find(|line| line.starts_with("1 FULL_OPENCV 640 480 "))
        .unwrap()
        .split(' ')
        .skip(4)
        .map(|n| n.parse().unwrap())
        .collect();
    assert_eq!(line.len(), 12);
    let tag = |name: &str| -> f64 {
        let begin = metashape.find(&format!("<{name}>")).unwrap() + name.len() + 2;
        let end = metashape.find(&format!("</{name}>")).unwrap();
        metashape[begin..end].parse().unwrap()
    };
    let sfm: Value = serde_json::from_str(&opensfm).unwrap();
    let sfm = |name: &str| sfm["wide"][name].as_f64().unwrap();
    for (x, y) in [(0.0, 0.0), (0.3, 0.2), (-0.5, 0.35), (0.45, -0.3)] {
        // Computer vision's frame: y down.
        let truth = lens.project([x, -y, -1.0]).unwrap();
        let d = brown(x, y, [terms[0], terms[1], terms[4]], [terms[2], terms[3]]);
        let by_opencv = [matrix[0] * d[0] + matrix[2], matrix[4] * d[1] + matrix[5]];
        let d = brown(x, y, [line[4], line[5], line[8]], [line[6], line[7]]);
        // COLMAP's pixel centres are at a half.
        let by_colmap = [line[0] * d[0] + line[2] - 0.5, line[1] * d[1] + line[3] - 0.5];
        // Metashape manual, "Camera models": P1 goes with r^2 + 2 x^2; u = w/2 + cx + x' f + x' B1.
        let d = brown(x, y, [tag("k1"), tag("k2"), tag("k3")], [tag("p2"), tag("p1")]);
        let by_metashape = [
            320.0 + tag("cx") + d[0] * (tag("f") + tag("b1")) - 0.5,
            240.0 + tag("cy") + d[1] * tag("f") - 0.5,
        ];
        let d = brown(x, y, [sfm("k1"), sfm("k2"), sfm("k3")], [sfm("p1"), sfm("p2")]);
        let by_opensfm = [
            640.0 * (sfm("focal_x") * d[0] + sfm("c_x")) + 319.5,
            640.0 * (sfm("focal_y") * d[1] + sfm("c_y")) + 239.5,
        ];
        for (program, found) in [
            ("OpenCV", by_opencv),
            ("COLMAP", by_colmap),
            ("Metashape", by_metashape),
            ("OpenSfM", by_opensfm),
        ] {
            let off = (found[0] - truth[0]).hypot(found[1] - truth[1]);
            assert!(off < 1e-9, "{program} at ({x}, {y}): {found:?}, not {truth:?}");
        }
    }
}

#[test]
fn a_fit_says_what_it_leaves() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    let mut values = [0.0; 10];
    values[..9].copy_from_slice(&[700.0, 5.0, -4.0, 0.0, 2e-7, 1e-13, 0.0, 5e-7, -3e-7]);
    let lens = Interior::new(Model::Smac, SIZE, &values).unwrap();
    let camera = rowgram::camera::Camera::new("", lens);
    fs::write(here.join("camera.toml"), camera.to_toml()).unwrap();
    let run = rowgram(here, "camera convert camera.toml --to brown -o brown.toml --json");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let report: Value = serde_json::from_str(&run.stdout).unwrap();
    let (rms, most) = (report["rms_px"].as_f64().unwrap(), report["largest_px"].as_f64().unwrap());
    assert!(rms > 0.0 && rms < 0.02 && most < 0.1, "{}", run.stdout);
    // What it says is what there is.
    let fitted = camera_file::read(&here.join("brown.toml")).unwrap().interior;
    let mut largest: f64 = 0.0;
    for v in (0..480).step_by(7) {
        for u in (0..640).step_by(7) {
            let at = [f64::from(u), f64::from(v)];
            let back = fitted.project(lens.unproject(at).unwrap()).unwrap();
            largest = largest.max((back[0] - at[0]).hypot(back[1] - at[1]));
        }
    }
    assert!(largest < 1.2 * most + 1e-6 && largest > 0.5 * most, "{largest} {most}");
    let gate = rowgram(here, "camera convert camera.toml --to opencv --max-residual-px 1e-6");
    assert_eq!(gate.code, 3, "{}", gate.stderr);
    for (arguments, part) in [
        ("camera.toml --to opensfm --model rational", "no place for k4"),
        ("camera.toml --to brown -o brown.toml", "--force"),
        ("none.toml --to opencv", "none.toml"),
        ("camera.toml --to colmap --max-residual-px -1", "expected pixels"),
    ] {
        let run = rowgram(here, &format!("camera convert {arguments}"));
        assert_eq!(run.code, 2, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(part), "{arguments}: {}", run.stderr);
    }
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn real_photos_become_a_camera_that_opencv_agrees_with() {
    let Some(photos) = data::path("calib_opencv_left") else { return };
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = (1..=14)
        .filter(|k| *k != 10)
        .map(|k| photos.join(format!("left{k:02}.jpg")).display().to_string())
        .collect();
    let run = rowgram(
        folder.path(),
        &format!(
            "camera calibrate {} --board 9x6 --square-m 0.025 --lens brown -o camera.toml --json",
            names.join(" ")
        ),
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let report: Value = serde_json::from_str(&run.stdout).unwrap();
    assert!(statuses(&report).iter().all(|status| *status == "used"), "{}", run.stderr);
    assert!(report["rms_px"].as_f64().unwrap() < 0.1954, "{}", report["rms_px"]);
    for (name, theirs) in [("f_px", 532.8272), ("cx_px", 342.4868), ("cy_px", 233.8557)] {
        let (value, sigma) = value(&report, name);
        assert!((value - theirs).abs() < 3.0 * sigma, "{name}: {value} +- {sigma}");
    }
}
