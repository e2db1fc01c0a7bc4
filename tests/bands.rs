//! Orthomosaics with more bands than three: indices of plots and plants against the reflectances that are known of a synthetic field,
//! in any order and scale, with frames and alpha; and what cannot be.

use crate::{
    maps::{number, table},
    program::rowgram,
};
use rowgram::{
    io::{FileError, geotiff},
    raster::{spectral::Band, window::Window},
};
use std::{collections::BTreeMap, fs, path::Path};

/// A field of eight plots of two rows.
const FIELD: &str =
    "synth map --rows 8 --row-length 11 --plot-rows 2 --plot-length 5 --alley 1 --gsd 0.02 -q -o";

/// A synthetic orthomosaic as a project.
fn map(folder: &Path, name: &str, words: &str) {
    let made = rowgram(folder, &format!("{FIELD} {name} {words}"));
    assert_eq!(made.code, 0, "{}", made.stderr);
}

fn run(folder: &Path, name: &str, settings: &str) {
    fs::write(folder.join(name).join("rowgram.toml"), settings).unwrap();
    let done = rowgram(folder, &format!("run {name} -q"));
    assert!(matches!(done.code, 0 | 3), "{}{}", done.stdout, done.stderr);
}

/// Measured less true values of a trait of all plots, and the standard deviations.
fn errors(folder: &Path, name: &str, column: &str) -> Vec<[f64; 2]> {
    let project = folder.join(name);
    let truth = table(&project.join("truth/plots.csv"));
    let found = table(&project.join("rowgram/plots/traits.csv"));
    assert_eq!(truth.len(), 8);
    let error = |(plot, of): (&String, &BTreeMap<String, String>)| {
        let sd = number(&found[plot], &format!("{column}_sd"));
        [number(&found[plot], column) - number(of, column), sd]
    };
    truth.iter().map(error).collect()
}

fn check_errors(folder: &Path, name: &str) {
    for column in ["ndvi", "ndvi_leaf", "ndre", "ndre_leaf"] {
        let errors = errors(folder, name, column);
        let mean = errors.iter().map(|error| error[0]).sum::<f64>() / errors.len() as f64;
        let worst = errors.iter().map(|error| error[0].abs()).fold(0.0, f64::max);
        println!("{name} {column}: mean error {mean:.4}, worst {worst:.4}, sd {:.4}", errors[0][1]);
        assert!(mean.abs() <= 0.01 && worst <= 0.02, "{name} {column}: {errors:?}");
        assert!(errors.iter().all(|error| error[1] > 0.0 && error[1] < 0.1), "{errors:?}");
        let covered = errors.iter().filter(|[error, sd]| error.abs() < 2.0 * sd).count();
        assert!(covered >= 7, "{name} {column}: {covered} of 8 within two sd, {errors:?}");
    }
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn indices_of_plots_are_those_of_the_reflectances() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let bands = "bands = [\"nir\", \"red\", \"blue\", \"red-edge\", \"green\"]\n";
    let words = "indices = [\"ndvi\", \"(nir - red_edge) / (nir + red_edge)\", \"osavi\", \"mine = b1 / b2\"]\n";
    for (name, made, settings) in [
        ("named", "--samples u16 --seed 2", String::new()),
        ("float", "--samples float --seed 3", format!("[plots]\n{words}")),
        (
            "shuffled",
            "--samples float --unnamed --bands nir,red,blue,red-edge,green --seed 2",
            format!("[project]\n{bands}[plots]\n{words}"),
        ),
        (
            "overruled",
            "--samples u16 --bands nir,red,blue,red-edge,green --seed 2",
            format!("[project]\n{bands}reflectance_scale = 10000.0\n"),
        ),
    ] {
        map(folder, name, made);
        run(folder, name, &settings);
        check_errors(folder, name);
    }
    let traits = |name: &str| table(&folder.join(name).join("rowgram/plots/traits.csv"));
    // The same field in another order, other samples and by other means is the same.
    let (named, shuffled, overruled) = (traits("named"), traits("shuffled"), traits("overruled"));
    for (plot, of) in &named {
        for column in ["ndvi", "ndvi_leaf", "ndre", "canopy_cover"] {
            let [a, b, c] = [of, &shuffled[plot], &overruled[plot]].map(|of| number(of, column));
            assert!((a - b).abs() < 1e-3 && (a - c).abs() < 1e-9, "{plot} {column}: {a} {b} {c}");
        }
        let [ndvi, osavi] = ["ndvi", "osavi"].map(|name| number(&shuffled[plot], name));
        assert!(osavi > 0.2 && osavi < ndvi, "{plot}: {ndvi} {osavi}");
        assert!(number(&shuffled[plot], "mine_leaf") > 4.0);
    }
    // What differs between plots of one field is found.
    let truth = table(&folder.join("named/truth/plots.csv"));
    let spread = |of: &BTreeMap<String, BTreeMap<String, String>>| {
        let all: Vec<f64> = of.values().map(|plot| number(plot, "ndvi_leaf")).collect();
        all.iter().copied().fold(0.0, f64::max) - all.iter().copied().fold(1.0, f64::min)
    };
    assert!(
        (spread(&named) - spread(&truth)).abs() < 0.02,
        "{} {}",
        spread(&named),
        spread(&truth)
    );
    everything_has_them(&folder.join("named/rowgram/plots"));
    plants_have_theirs(&folder.join("named"));
}

/// Indices are in every form that traits come in.
fn everything_has_them(plots: &Path) {
    let text = |name: &str| fs::read_to_string(plots.join(name)).unwrap();
    for name in ["traits_long.csv", "trait_dictionary.csv", "traits.geojson"] {
        assert!(text(name).contains("ndvi_leaf"), "{name}");
    }
    assert!(text("trait_dictionary.csv").contains("Rouse"));
    assert!(text("variables.brapi.json").contains("\"ndre_leaf\""));
    assert!(text("traits.brapi.json").contains("\"observationVariableName\": \"ndvi\""));
    let report = fs::read_to_string(plots.join("../report.html")).unwrap();
    assert!(
        report.contains("ndvi of leaves") && report.contains("by their names: 1 blue"),
        "report"
    );
}

/// Plants get what their leaves show, drawn towards their neighbours where leaves overlap.
fn plants_have_theirs(project: &Path) {
    let truth = csv_rows(&project.join("truth/plants.csv"));
    let found = csv_rows(&project.join("rowgram/plots/plants.csv"));
    let mut pairs = Vec::new();
    for plant in &found {
        if plant["ndvi_leaf"].is_empty() {
            continue;
        }
        let distance = |of: &&BTreeMap<String, String>| {
            let d = ["u_px", "v_px"].map(|axis| number(of, axis) - number(plant, axis));
            d[0].hypot(d[1])
        };
        let near = truth.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        if distance(&near) < 3.0 && !near["ndvi_leaf"].is_empty() {
            pairs.push([number(plant, "ndvi_leaf"), number(near, "ndvi_leaf")]);
        }
    }
    assert!(pairs.len() > 200, "{}", pairs.len());
    let mean = pairs.iter().map(|[a, b]| a - b).sum::<f64>() / pairs.len() as f64;
    let rms = (pairs.iter().map(|[a, b]| (a - b).powi(2)).sum::<f64>() / pairs.len() as f64).sqrt();
    println!("{} plants: mean error {mean:.4}, root mean square {rms:.4}", pairs.len());
    assert!(mean.abs() < 0.01 && rms < 0.03, "{mean} {rms}");
}

fn csv_rows(path: &Path) -> Vec<BTreeMap<String, String>> {
    csv::Reader::from_path(path).unwrap().deserialize().map(Result::unwrap).collect()
}

/// A band of alpha, which the settings need not name, hides what it is 0 for.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn alpha_hides_and_infrared_makes_the_mask() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    map(folder, "field", "--samples u16 --seed 4");
    let project = folder.join("field");
    let reader = geotiff::Reader::open(&project.join("ortho.tif")).unwrap();
    let (width, height) = (reader.width(), reader.height());
    let samples = reader.read::<u16>(Window::whole(width, height)).unwrap();
    // What is transparent is not black but bright: it must not count.
    let pixel = |(k, pixel): (usize, &[u16])| -> [u16; 6] {
        let is_seen = k % width > width / 8 && pixel[0] != u16::MAX;
        std::array::from_fn(|band| match (band, is_seen) {
            (5, is_seen) => u16::from(is_seen) * u16::MAX,
            (_, true) => pixel[band],
            (_, false) => 9_000,
        })
    };
    let with_alpha: Vec<u16> = samples.chunks_exact(5).enumerate().flat_map(pixel).collect();
    let layout = geotiff::Layout {
        width,
        height,
        colour: geotiff::Colour::Records(6),
        georeference: reader.georeference(),
        nodata: None,
    };
    let names = [Band::Blue, Band::Green, Band::Red, Band::RedEdge, Band::Nir, Band::Alpha];
    geotiff::write::<u16, FileError>(&project.join("ortho.tif"), true, &layout, |writer| {
        writer.name_bands(&names);
        writer.put(Window::whole(width, height), &with_alpha)
    })
    .unwrap();
    run(folder, "field", "");
    check_errors_of_most(folder);
    // The mask by near infrared against the truth, and against that of the colours alone.
    let share = |of: &str| {
        let truth = image::open(project.join("truth/mask.png")).unwrap().into_luma8();
        let found = geotiff::Reader::open(&project.join(of)).unwrap();
        let found = found.read::<u8>(Window::whole(width, height)).unwrap();
        let (mut both, mut either) = (0, 0);
        for (k, (a, b)) in truth.as_raw().iter().zip(&found).enumerate() {
            if with_alpha[6 * k + 5] != 0 {
                both += usize::from(*a > 0 && *b > 0);
                either += usize::from(*a > 0 || *b > 0);
            }
        }
        both as f64 / either as f64
    };
    let with_infrared = share("rowgram/segment/mask.tif");
    run(
        folder,
        "field",
        "[project]\nbands = [\"blue\", \"green\", \"red\", \"other\", \"other\"]\n",
    );
    let with_colours = share("rowgram/segment/mask.tif");
    println!("mask over truth: {with_infrared:.3} by near infrared, {with_colours:.3} by colours");
    assert!(
        with_infrared > 0.85 && with_infrared >= with_colours,
        "{with_infrared} {with_colours}"
    );
    let header = fs::read_to_string(project.join("rowgram/plots/traits.csv")).unwrap();
    assert!(!header.contains("ndvi"), "without near infrared there is no index");
}

/// The first plots are cut by alpha; the others are as the truth has them.
fn check_errors_of_most(folder: &Path) {
    let errors = errors(folder, "field", "ndvi");
    let close = errors.iter().filter(|error| error[0].abs() < 0.01).count();
    assert!(close >= 4, "{errors:?}");
    assert!(errors.iter().all(|error| error[0].abs() < 0.1), "{errors:?}");
}

/// What cannot be is refused before any stage, and by doctor, with the key and what there is.
#[test]
fn what_cannot_be_measured_is_named_before() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let made = rowgram(folder, "synth map --rows 2 --row-length 2 --gsd 0.04 -q -o field");
    assert_eq!(made.code, 0, "{}", made.stderr);
    let project = folder.join("field");
    for (settings, expected) in [
        ("[plots]\nindices = [\"ndwvi\"]\n", "[plots] indices: \"ndwvi\" is neither a known index"),
        (
            "[plots]\nindices = [\"x = (nir - red\"]\n",
            "[plots] indices: \"(nir - red\" is no formula",
        ),
        ("[plots]\nindices = [\"x = nir - swir\"]\n", "\"swir\" in \"nir - swir\" is no band"),
        ("[plots]\nindices = [\"plants = nir\"]\n", "\"plants\" is a column already"),
        (
            "[plots]\nindices = [\"x = b6 / nir\"]\n",
            "x needs the band b6, and the orthomosaic has 1 blue, 2 green",
        ),
        (
            "[project]\nbands = [\"red\", \"green\"]\n",
            "[project] bands names 2 bands, the file has 5",
        ),
        (
            "[project]\nbands = [\"red\", \"green\", \"blue\", \"nir\", \"nir\"]\n",
            "[project] bands: nir stands twice",
        ),
        (
            "[project]\nbands = [\"infrared\"]\n",
            "expected a list of: blue, green, red, red-edge, nir",
        ),
        (
            "[project]\nbands = [\"red\", \"green\", \"blue\", \"other\", \"other\"]\n[plots]\nindices = [\"ndvi\"]\n",
            "ndvi needs the band nir, and the orthomosaic has 1 red, 2 green, 3 blue, 4 other",
        ),
    ] {
        fs::write(project.join("rowgram.toml"), settings).unwrap();
        let run = rowgram(folder, "run field -q");
        assert!(
            run.code == 2 && run.stderr.contains(expected),
            "{settings}{}: {}",
            run.code,
            run.stderr
        );
        assert!(!project.join("rowgram/segment").exists(), "{settings}");
        let doctor = rowgram(folder, "doctor field");
        let said = format!("{}{}", doctor.stdout, doctor.stderr);
        assert!(doctor.code != 0 && one_line(&said).contains(expected), "{settings}{said}");
    }
    fs::write(project.join("rowgram.toml"), "").unwrap();
    let doctor = one_line(&rowgram(folder, "doctor field").stdout);
    assert!(
        doctor.contains("its bands are, by their names: 1 blue, 2 green, 3 red, 4 red-edge, 5 nir"),
        "{doctor}"
    );
    assert!(doctor.contains("16-bit samples: 10000 is taken for a reflectance of 1"), "{doctor}");
}

/// Text without the breaks that a terminal makes.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
