//! `rowgram synth flight` as a person or a script calls it, and the twin's camera against the estimators'.

use crate::program::{Run, contents, rowgram};
use data_synth::{
    camera::{Camera, CameraConfig},
    twin::{FlightPreset, TwinConfig},
};
use rowgram::{
    camera::{Camera as Description, Lens},
    geometry::rotation,
    io::photo,
    scene::gimbal_rotation,
};
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

fn run(words: &str) -> Run {
    rowgram(Path::new("."), words)
}

fn succeed(words: &str) -> Run {
    let output = run(words);
    assert!(output.code == 0, "{words}: {}", output.stderr);
    output
}

/// A configuration of few tiny photos, written into `folder`.
fn tiny(folder: &Path) -> PathBuf {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.field.rows = 6;
    config.field.row_length_m = 6.0;
    config.field.plots = Default::default();
    config.camera = CameraConfig::wide(240, 180, 150.0);
    config.flight.height_m = 8.0;
    config.flight.margin_m = -1.0;
    config.flight.strips = 2;
    config.flight.photos_per_strip = 3;
    config.tie_points.per_photo = 60;
    let path = folder.join("tiny.toml");
    fs::write(&path, toml::to_string(&config).unwrap()).unwrap();
    path
}

const ALWAYS: [&str; 21] = [
    "field.toml",
    "gcps.csv",
    "geolocation.csv",
    "marks.csv",
    "truth/camera.toml",
    "truth/dem.asc",
    "truth/dem.prj",
    "truth/exterior_orientation.csv",
    "truth/gcps.csv",
    "truth/leaf_axes.csv",
    "truth/leaves.csv",
    "truth/light.csv",
    "truth/marks.csv",
    "truth/mask.pgw",
    "truth/mask.png",
    "truth/picture.pgw",
    "truth/picture.png",
    "truth/plants.csv",
    "truth/plots.csv",
    "truth/rows.csv",
    "truth/weeds.csv",
];

#[test]
fn a_project_folder_is_complete_and_the_same_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let config = tiny(folder.path());
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let output = succeed(&format!(
        "synth flight --config {} --photo-truth -o {}",
        config.display(),
        first.display()
    ));
    assert!(output.stdout.is_empty());
    let found = contents(&first);
    let mut expected: Vec<String> = ALWAYS.map(str::to_owned).to_vec();
    expected.extend(["tie_points.csv", "truth/tie_points.csv"].map(str::to_owned));
    expected.extend(["truth/chm.tif", "truth/dsm.tif"].map(str::to_owned));
    expected.extend(["cameras", "images", "points3D"].map(|name| format!("model/{name}.txt")));
    for photo in 1..=6 {
        expected.push(format!("images/IMG_{photo:04}.JPG"));
        for end in ["_leaves.png", "_mask.png", "_plants.png", ".csv"] {
            expected.push(format!("truth/photos/IMG_{photo:04}{end}"));
        }
    }
    expected.sort();
    assert_eq!(found.keys().cloned().collect::<Vec<_>>(), expected);
    let photo = image::load_from_memory(&found["images/IMG_0001.JPG"]).unwrap();
    assert_eq!((photo.width(), photo.height()), (240, 180));
    assert_eq!(photo.color(), image::ColorType::Rgb8);

    // From the resolved configuration, with another number of threads.
    let resolved = first.join("field.toml");
    succeed(&format!(
        "synth flight --config {} --photo-truth --threads 1 -o {}",
        resolved.display(),
        second.display()
    ));
    assert!(found == contents(&second));

    let taken =
        run(&format!("synth flight --config {} -o {}", resolved.display(), first.display()));
    assert_eq!(taken.code, 2);
    assert!(taken.stderr.contains("--force"));
    let bare = folder.path().join("bare");
    succeed(&format!(
        "synth flight --config {} --tie-points 0 --no-photos -o {}",
        resolved.display(),
        bare.display()
    ));
    assert_eq!(contents(&bare).keys().map(String::as_str).collect::<Vec<_>>(), ALWAYS);
}

#[test]
fn the_truth_is_judged_perfect() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("field");
    let config = tiny(folder.path());
    succeed(&format!(
        "synth flight --config {} --no-photos -o {}",
        config.display(),
        out.display()
    ));
    let truth = out.join("truth/plants.csv");
    let output =
        succeed(&format!("evaluate {} {} --radius 3 --json", truth.display(), truth.display()));
    let score: serde_json::Value = serde_json::from_str(&output.stdout).unwrap();
    assert!(score.to_string().contains("\"f1\":1.0"), "{score}");
    // And the thresholds for which the picture from above was made find the mask.
    let mask = folder.path().join("mask.png");
    let picture = out.join("truth/picture.png");
    succeed(&format!("segment {} --hsv 30,79,30,163 -o {}", picture.display(), mask.display()));
    let (found, truth) = (
        image::open(&mask).unwrap().into_luma8(),
        image::open(out.join("truth/mask.png")).unwrap().into_luma8(),
    );
    let differ = found.iter().zip(truth.iter()).filter(|(a, b)| a != b).count();
    assert!(differ * 200 < truth.len(), "{differ} of {}", truth.len());
}

#[test]
fn the_twins_camera_is_the_estimators_camera() {
    for config in [
        CameraConfig::wide(1000, 750, 520.0),
        CameraConfig { k0: 0.01, r0_px: 300.0, ..CameraConfig::compact(1000, 750, 800.0) },
    ] {
        let twin = TwinConfig { camera: config.clone(), ..TwinConfig::preset(FlightPreset::Small) };
        let mut toml = Vec::new();
        data_synth::files::camera(&twin.build().unwrap(), &mut toml).unwrap();
        let theirs = Description::from_toml(&String::from_utf8(toml).unwrap()).unwrap().interior;
        let ours = Camera::new(&config).unwrap();
        for step in 0..400 {
            let (u, v) = (f64::from(step % 20) * 52.5, f64::from(step / 20) * 39.4);
            let ray = ours.direction(u, v);
            let pixel = theirs.project(ray.map(|part| 7.0 * part)).unwrap();
            assert!(f64::hypot(pixel[0] - u, pixel[1] - v) < 1e-8, "{pixel:?} for {u}, {v}");
            let back = ours.project(theirs.unproject([u, v]).unwrap()).unwrap();
            assert!(f64::hypot(back[0] - u, back[1] - v) < 1e-8, "{back:?} for {u}, {v}");
        }
    }
}

/// Truth files alone, read as an estimator would: the true places through the true orientations and the true camera
/// are the true pixels.
#[test]
fn the_truth_files_close_the_loop() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("field");
    let config = tiny(folder.path());
    succeed(&format!(
        "synth flight --config {} --no-photos -o {}",
        config.display(),
        out.display()
    ));
    let table = |name: &str| -> Vec<BTreeMap<String, String>> {
        let mut reader = csv::Reader::from_path(out.join("truth").join(name)).unwrap();
        reader.deserialize().map(|row| row.unwrap()).collect()
    };
    let number =
        |row: &BTreeMap<String, String>, column: &str| -> f64 { row[column].parse().unwrap() };
    let place = |row: &BTreeMap<String, String>| {
        ["easting_m", "northing_m", "height_m"].map(|c| number(row, c))
    };
    let lens = rowgram::io::camera::read(&out.join("truth/camera.toml")).unwrap().interior;
    let (points, shots) = (table("gcps.csv"), table("exterior_orientation.csv"));
    let marks = table("marks.csv");
    assert!(marks.len() > 5, "{}", marks.len());
    for mark in marks {
        let point = place(points.iter().find(|row| row["label"] == mark["label"]).unwrap());
        let shot = shots.iter().find(|row| row["image"] == mark["image"]).unwrap();
        let centre = place(shot);
        let [o, p, k] = ["omega_deg", "phi_deg", "kappa_deg"].map(|c| number(shot, c).to_radians());
        let about = |axis: nalgebra::Vector3<f64>, angle: f64| {
            nalgebra::Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(axis), angle)
        };
        let rotation = about(nalgebra::Vector3::x(), o)
            * about(nalgebra::Vector3::y(), p)
            * about(nalgebra::Vector3::z(), k);
        let away = nalgebra::Vector3::from_fn(|i, _| point[i] - centre[i]);
        let seen = rotation.inverse() * away;
        let [u, v] = lens.project([seen.x, seen.y, seen.z]).unwrap();
        // Files have hundredths of millimetres: a thousandth of a pixel at 8 m.
        let off_px = f64::hypot(u - number(&mark, "u_px"), v - number(&mark, "v_px"));
        assert!(off_px < 1e-3, "{off_px} px");
    }
}

#[test]
fn a_gimbal_and_a_receiver_with_corrections_are_in_the_photos_as_they_truly_are() {
    let folder = tempfile::tempdir().unwrap();
    let config = tiny(folder.path());
    let out = folder.path().join("out");
    succeed(&format!(
        "synth flight --config {} --gimbal 0 --mount-tilt 5 --rtk 0.02 -o {}",
        config.display(),
        out.display()
    ));
    let truth = fs::read_to_string(out.join("truth/exterior_orientation.csv")).unwrap();
    for row in truth.lines().skip(1) {
        let cells: Vec<&str> = row.split(',').collect();
        let [o, p, k] = [4, 5, 6].map(|at| cells[at].parse::<f64>().unwrap().to_radians());
        // From the mapping frame to the camera.
        let true_rotation = [[0.0, 0.0, -k], [0.0, -p, 0.0], [-o, 0.0, 0.0]]
            .into_iter()
            .map(rotation::exp)
            .reduce(rotation::multiply)
            .unwrap();
        let found = photo::read(&out.join("images").join(cells[0])).unwrap();
        let told = gimbal_rotation(found.gimbal_deg.unwrap());
        let apart = rotation::log(rotation::multiply(true_rotation, rotation::inverse(told)));
        // The camera is turned about its first axis against the gimbal; angles are written with hundredths of degrees.
        for (turn, expected_deg) in apart.iter().zip([-5.0, 0.0, 0.0]) {
            let off_deg = turn.to_degrees() - expected_deg;
            assert!(off_deg.abs() < 0.03, "{}: {:?}", cells[0], apart.map(f64::to_degrees));
        }
        assert_eq!(found.geotag.unwrap().sigma_m, Some([0.02; 3]));
    }
    let refused = run(&format!("synth flight --mount-tilt 9 -o {} --force", out.display()));
    let message = refused.stderr;
    assert!(message.contains("flight.mount_tilt_deg"), "{message}");
}

#[test]
fn bad_configurations_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.toml");
    for (wrong, words) in [
        ("[flight]\nheight_m = -3.0\n", ["flight.height_m", "expected"]),
        ("[flight]\nheigth_m = 3.0\n", ["heigth_m", "bad.toml"]),
        ("[site]\nepsg = 4326\n", ["site.epsg", "UTM"]),
    ] {
        fs::write(&path, wrong).unwrap();
        let out = folder.path().join("out");
        let output = run(&format!("synth flight --config {} -o {}", path.display(), out.display()));
        let message = output.stderr;
        assert_eq!(output.code, 2, "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
        assert!(!out.exists());
    }
}
