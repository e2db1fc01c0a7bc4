//! Colours of a synthetic flight with vignetting, drifting light and a camera that follows it, against the same flight without.

use crate::program::rowgram;
use data_synth::{
    camera::CameraConfig,
    photo::ImageConfig,
    twin::{FlightPreset, TwinConfig},
};
use rowgram::{io::geotiff::Reader, raster::window::Window};
use serde_json::Value;
use std::{fs, path::Path};

/// Light and sensor of a bad day: thin clouds, exposure in steps, a lens that loses a third in the corners.
fn bad_day() -> ImageConfig {
    ImageConfig {
        exposure_spread: 0.05,
        white_balance_spread: 0.02,
        light_drift: 0.2,
        auto_exposure: true,
        vignetting: 0.35,
        ..ImageConfig::default()
    }
}

fn flight(folder: &Path, name: &str, image: ImageConfig) {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.camera = CameraConfig::compact(600, 450, 480.0);
    config.tie_points.per_photo = 0;
    config.image = image;
    fs::write(folder.join(format!("{name}.toml")), toml::to_string(&config).unwrap()).unwrap();
    run(folder, &format!("synth flight --config {name}.toml -o {name} -q"));
}

fn run(folder: &Path, arguments: &str) -> String {
    let run = rowgram(folder, arguments);
    assert_eq!(run.code, 0, "{arguments}: {}", run.stderr);
    run.stdout
}

/// The mosaic over the true surface with true poses; its outcome.
fn mosaic(folder: &Path, name: &str, options: &str) -> Value {
    let of = |file: &str| format!("{name}/truth/{file}");
    let text = run(
        folder,
        &format!(
            "ortho --poses {} --camera {} --photos {name}/images --dem {} --canopy-height-m 0 --gsd-m 0.025 \
             --json -q --force -o {name}.tif {options}",
            of("exterior_orientation.csv"),
            of("camera.toml"),
            of("dsm.tif"),
        ),
    );
    serde_json::from_str(&text).unwrap()
}

/// Mean colour of the plants in each square of 2 m: pixels whose excess green is large in the reference.
fn plots(folder: &Path, name: &str, reference: &str) -> Vec<([f64; 3], f64)> {
    let read = |name: &str| {
        let reader = Reader::open(&folder.join(format!("{name}.tif"))).unwrap();
        let size = [reader.width(), reader.height()];
        (size, reader.read::<u8>(Window::whole(size[0], size[1])).unwrap())
    };
    let ([width, height], pixels) = read(name);
    let (size, green) = read(reference);
    assert_eq!(size, [width, height]);
    const SIDE: usize = 80;
    let columns = width.div_ceil(SIDE);
    let mut sums = vec![([0.0; 3], 0.0); columns * height.div_ceil(SIDE)];
    for at in 0..width * height {
        let [r, g, b, a] = *green[4 * at..].first_chunk::<4>().unwrap();
        let leaf = 2 * i32::from(g) - i32::from(r) - i32::from(b) > 40;
        if a == 255 && leaf && pixels[4 * at + 3] == 255 {
            let (sum, n) = &mut sums[at / width / SIDE * columns + at % width / SIDE];
            (0..3).for_each(|c| sum[c] += f64::from(pixels[4 * at + c]));
            *n += 1.0;
        }
    }
    sums
}

fn excess_green([r, g, b]: [f64; 3]) -> f64 {
    (2.0 * g - r - b) / (r + g + b)
}

#[test]
#[ignore = "slow; renders two flights"]
fn a_flight_in_changing_light_has_the_colours_of_one_in_even_light() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let even = ImageConfig {
        exposure_spread: 0.0,
        white_balance_spread: 0.0,
        vignetting: 0.0,
        ..ImageConfig::default()
    };
    flight(at, "even", even);
    flight(at, "bad", bad_day());
    mosaic(at, "even", "--balance=false");
    let plain = mosaic(at, "bad", "--balance=false");
    assert!(plain["colour"].is_null());
    fs::copy(at.join("bad.tif"), at.join("plain.tif")).unwrap();
    let outcome = mosaic(at, "bad", "");
    let colour = &outcome["colour"];
    println!("{colour:#}");
    let number = |value: &Value| value.as_f64().unwrap();
    // Gains against the truth, with one factor for all.
    let record: Value =
        serde_json::from_str(&fs::read_to_string(at.join("bad.json")).unwrap()).unwrap();
    let truth = fs::read_to_string(at.join("bad/truth/light.csv")).unwrap();
    let truth: Vec<Vec<f64>> = truth
        .lines()
        .skip(1)
        .map(|line| line.split(',').skip(3).map(|v| v.parse::<f64>().unwrap().ln()).collect())
        .collect();
    let photos = record["photos"].as_array().unwrap();
    assert_eq!(photos.len(), truth.len());
    let (mut errors, mut over_sigma) = (Vec::new(), Vec::new());
    for c in 0..3 {
        let off: Vec<f64> = photos
            .iter()
            .zip(&truth)
            .map(|(photo, truth)| -number(&photo["colour"]["gain"][c]).ln() - truth[c])
            .collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        for (photo, off) in photos.iter().zip(off) {
            errors.push(off - mean);
            over_sigma.push((off - mean) / number(&photo["log_gain_sigma"][c]));
        }
    }
    let rms = |of: &[f64]| (of.iter().map(|v| v * v).sum::<f64>() / of.len() as f64).sqrt();
    println!("log gains: {} off, {} standard deviations", rms(&errors), rms(&over_sigma));
    let corner = number(&colour["cameras"][0]["corner_light"]);
    println!("light in the corners {corner}, true 0.65");
    // Excess green of plants, plot by plot.
    let (reference, balanced, plain) =
        (plots(at, "even", "even"), plots(at, "bad", "even"), plots(at, "plain", "even"));
    let ratios = |of: &[([f64; 3], f64)]| -> Vec<f64> {
        let pairs = of.iter().zip(&reference).filter(|(_, (_, n))| *n > 500.0);
        pairs.map(|(a, b)| excess_green(a.0) / excess_green(b.0) - 1.0).collect()
    };
    let (balanced, plain) = (ratios(&balanced), ratios(&plain));
    let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
    println!(
        "excess green of {} plots: bias {:.4}, rms {:.4}; not balanced {:.4}, {:.4}",
        balanced.len(),
        mean(&balanced),
        rms(&balanced),
        mean(&plain),
        rms(&plain)
    );
    assert!(number(&colour["difference"]["after"]) <= 1.5, "{colour}");
    assert!(number(&colour["difference"]["before"]) > 4.0, "{colour}");
    // A slope of brightness over the whole map is not told by overlaps: it is all of these eight hundredths.
    assert!(rms(&errors) < 0.1, "{}", rms(&errors));
    assert!((corner - 0.65).abs() < 0.02, "{corner}");
    assert!(mean(&balanced).abs() < 0.01, "{}", mean(&balanced));
}
