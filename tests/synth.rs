//! `rowgram synth` as a person or a script calls it.

use crate::program::{Run, rowgram};
use data_synth::block::{Block, BlockConfig, write_bal};
use rowgram::{camera, geometry::rotation, io::bal};
use std::{fs, path::Path};

fn synth(words: &str) -> Run {
    rowgram(Path::new("."), &format!("synth {words}"))
}

/// Refused as bad input, with a message that has all of `words` in it.
fn assert_refused(output: &Run, words: &[&str]) {
    let message = &output.stderr;
    assert_eq!(output.code, 2, "{message}");
    for word in words {
        assert!(message.contains(word), "{word:?} is not in {message:?}");
    }
}

const FILES: [&str; 4] = ["mask.png", "picture.png", "plants.csv", "field.toml"];

fn contents(folder: &Path) -> Vec<Vec<u8>> {
    FILES.iter().map(|name| fs::read(folder.join(name)).unwrap()).collect()
}

#[test]
fn mask_picture_and_truth_belong_together() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new/field");
    let words = "--spacing 0.2 --inter-row 0.6 --jitter 0.1 --missing 0 --doubles 0 --gsd 0.01";
    let output = synth(&format!(
        "mask --stage early --rows 3 --row-length 2 {words} --seed 7 -o {}",
        out.display()
    ));
    assert!(output.code == 0, "{}", output.stderr);
    assert!(output.stdout.is_empty());
    let mask = image::open(out.join("mask.png")).unwrap();
    assert_eq!(mask.color(), image::ColorType::L8);
    let mask = mask.into_luma8();
    assert!(mask.iter().all(|&pixel| pixel == 0 || pixel == 255));
    let picture = image::open(out.join("picture.png")).unwrap();
    assert_eq!(picture.color(), image::ColorType::Rgb8);
    assert_eq!((picture.width(), picture.height()), mask.dimensions());

    let mut table = csv::Reader::from_path(out.join("plants.csv")).unwrap();
    assert_eq!(table.headers().unwrap(), vec!["u_px", "v_px", "row", "x_m", "y_m"]);
    let plants: Vec<[f64; 5]> = table.deserialize().map(Result::unwrap).collect();
    assert_eq!(plants.len(), 30);
    for plant in &plants {
        let [u_px, v_px, _, x_m, y_m] = *plant;
        assert_eq!(mask.get_pixel(u_px.round() as u32, v_px.round() as u32).0, [255]);
        // Both positions of a plant say the same, to the digits written.
        let [u0, v0, _, x0, y0] = plants[0];
        assert!(((u_px - u0) * 0.01 - (x_m - x0)).abs() < 2e-5);
        assert!(((v_px - v0) * 0.01 + (y_m - y0)).abs() < 2e-5);
    }
}

#[test]
fn the_written_configuration_makes_the_same_files_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let output = synth(&format!("mask --preset mid20_dirty --seed 5 -o {}", first.display()));
    assert!(output.code == 0, "{}", output.stderr);
    let config = first.join("field.toml");
    let output =
        synth(&format!("mask --config {} --threads 1 -o {}", config.display(), second.display()));
    assert!(output.code == 0, "{}", output.stderr);
    assert!(contents(&first) == contents(&second));

    let third = folder.path().join("third");
    let output =
        synth(&format!("mask --config {} --spacing 0.3 -o {}", config.display(), third.display()));
    assert!(output.code == 0, "{}", output.stderr);
    let resolved = fs::read_to_string(third.join("field.toml")).unwrap();
    assert!(resolved.contains("spacing_m = 0.3\n"), "options come before the file: {resolved}");
    assert!(resolved.contains("weeds_per_m2 = 2.0\n"), "{resolved}");
}

#[test]
fn what_exists_is_refused_before_any_work_and_replaced_by_force() {
    let folder = tempfile::tempdir().unwrap();
    let taken = folder.path().join("plants.csv");
    fs::write(&taken, "mine").unwrap();
    let arguments = format!("mask --rows 1 --row-length 1 -o {}", folder.path().display());
    assert_refused(&synth(&arguments), &["plants.csv", "--force"]);
    assert_eq!(fs::read(&taken).unwrap(), b"mine");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else was written");
    let output = synth(&format!("{arguments} --force"));
    assert!(output.code == 0, "{}", output.stderr);
    assert!(contents(folder.path())[2].starts_with(b"u_px,v_px,row,x_m,y_m\n"));
}

#[test]
fn bad_parameters_are_named_and_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    for (option, value, words) in [
        ("--rows", "0", ["rows", "1 to 100000"]),
        ("--spacing", "-1", ["spacing_m", "0.01 to 10"]),
        ("--spacing", "NaN", ["spacing_m", "NaN"]),
        ("--gsd", "inf", ["gsd_m", "inf"]),
        ("--gsd", "0", ["gsd_m", "0.0005 to 1"]),
        ("--missing", "1.5", ["missing_fraction", "0 to 1"]),
        ("--weeds", "-2", ["weeds_per_m2", "0 to 1000"]),
        ("--stage", "old", ["--stage", "early, mid, late"]),
        ("--preset", "mid21", ["--preset", "mid20_gaps"]),
        ("--seed", "18446744073709551615", ["seed", "9223372036854775807"]),
    ] {
        assert_refused(&synth(&format!("mask {option} {value} -o {}", out.display())), &words);
        assert!(!out.exists());
    }
}

#[test]
fn bad_configurations_are_refused_by_name_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let (config, out) = (folder.path().join("field.toml"), folder.path().join("out"));
    for (content, words) in [
        ("[field]\nrows = 3\nspacing = 0.2\n", ["line 3", "unknown field `spacing`"]),
        ("[feild]\nrows = 3\n", ["line 1", "unknown field `feild`"]),
        ("[field]\nrows = \"three\"\n", ["line 2", "invalid type"]),
        ("[field]\nstage = \"old\"\n", ["line 2", "unknown variant `old`"]),
        ("[field\n", ["line 1", "field.toml"]),
        ("[field]\nspacing_m = nan\n", ["spacing_m", "expected a number"]),
        ("[corruption]\nfalse_fraction = 2.0\n", ["false_fraction", "0 to 1"]),
    ] {
        fs::write(&config, content).unwrap();
        let output = synth(&format!("mask --config {} -o {}", config.display(), out.display()));
        assert_refused(&output, &words);
        assert!(!out.exists());
    }
    let missing = folder.path().join("none.toml");
    let output = synth(&format!("mask --config {} -o {}", missing.display(), out.display()));
    assert_refused(&output, &["none.toml"]);
}

#[test]
fn bundle_writes_a_block_and_its_truth() {
    let folder = tempfile::tempdir().unwrap();
    let (start, truth) = (folder.path().join("block.txt"), folder.path().join("truth.txt"));
    let arguments = format!(
        "bundle --images 12 --strips 3 --points 200 --sigma-px 0 -o {} --truth {}",
        start.display(),
        truth.display()
    );
    let output = synth(&arguments);
    assert!(output.code == 0, "{}", output.stderr);
    let (start, truth) = (fs::read_to_string(&start).unwrap(), fs::read_to_string(&truth).unwrap());
    let header: Vec<usize> =
        start.lines().next().unwrap().split(' ').map(|word| word.parse().unwrap()).collect();
    assert_eq!(header[..2], [12, 200]);
    assert_eq!(start.lines().count(), 1 + header[2] + 9 * 12 + 3 * 200);
    let measured = |text: &str| text.lines().take(1 + header[2]).map(str::to_owned).collect();
    let (a, b): (Vec<String>, Vec<String>) = (measured(&start), measured(&truth));
    assert_eq!(a, b);
    assert_ne!(start, truth);

    assert_refused(&synth(&arguments), &["block.txt", "--force"]);
    assert!(synth(&format!("{arguments} --force")).code == 0);
}

/// The generator's camera and the estimator's were written apart from each other; they agree.
#[test]
fn both_cameras_see_the_same() {
    let config = BlockConfig { images: 30, points: 3000, sigma_px: 0.0, ..BlockConfig::default() };
    let block = Block::fly(&config).unwrap();
    let mut file = Vec::new();
    write_bal(&block.cameras_true, &block.points_true, &block.observations, &mut file).unwrap();
    let network = bal::parse(std::str::from_utf8(&file).unwrap()).unwrap();
    assert_eq!(network.observations.len(), block.observations.len());
    for observation in &network.observations {
        let of = &network.cameras[observation.camera as usize];
        let point = network.points[observation.point as usize];
        let turned = rotation::rotate(rotation::exp(of.rotation_rad), point);
        let camera_m = [0, 1, 2].map(|i| turned[i] + of.translation[i]);
        let image_px = camera::bal::project(camera_m, of.interior);
        for (seen, measured) in image_px.into_iter().zip(observation.image_px) {
            assert!((seen - measured).abs() < 1e-8, "{seen} is not {measured}");
        }
    }
}

#[test]
fn bundle_names_bad_parameters() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("block.txt");
    for (option, value, word) in [
        ("--images", "1", "images"),
        ("--points", "5", "points"),
        ("--strips", "900", "strips"),
        ("--sigma-px", "-1", "sigma_px"),
        ("--sigma-px", "nan", "sigma_px"),
        ("--outliers", "2", "outlier_fraction"),
    ] {
        assert_refused(
            &synth(&format!("bundle {option} {value} -o {}", out.display())),
            &[word, "expected"],
        );
        assert!(!out.exists());
    }
    let twice = format!("bundle -o {0} --truth {0}", out.display());
    assert_refused(&synth(&twice), &["--truth"]);
}
