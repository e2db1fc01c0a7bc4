//! `rowgram locate` as a user meets it.

use crate::program::rowgram;
use std::path::Path;

/// A mask of three rows of plants: discs 24 px apart, rows 60 px apart, turned by 10 degrees.
fn mask(folder: &Path) -> Vec<[f64; 2]> {
    let (s, c) = 10_f64.to_radians().sin_cos();
    let mut centres = Vec::new();
    for row in 0..3 {
        for k in 0..12 {
            let (along, across) = (24.0 * f64::from(k), 60.0 * f64::from(row));
            centres.push([60.0 + c * along - s * across, 30.0 + s * along + c * across]);
        }
    }
    let mut image = image::GrayImage::new(360, 240);
    for centre in &centres {
        for (u, v, pixel) in image.enumerate_pixels_mut() {
            if (f64::from(u) - centre[0]).hypot(f64::from(v) - centre[1]) < 8.0 {
                pixel.0 = [255];
            }
        }
    }
    image.save(folder.join("mask.png")).unwrap();
    centres
}

fn read(path: &Path) -> (Vec<String>, Vec<Vec<f64>>) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    let header = lines.next().unwrap().split(',').map(str::to_owned).collect();
    let number = |field: &str| field.parse().unwrap_or(f64::NAN);
    (header, lines.map(|line| line.split(',').map(number).collect()).collect())
}

fn farthest(plants: &[Vec<f64>], centres: &[[f64; 2]]) -> f64 {
    let nearest = |c: &[f64; 2]| {
        plants.iter().map(|p| (p[0] - c[0]).hypot(p[1] - c[1])).fold(f64::INFINITY, f64::min)
    };
    centres.iter().map(nearest).fold(0.0, f64::max)
}

#[test]
fn plants_in_a_mask_are_found_by_every_variant() {
    let folder = tempfile::tempdir().unwrap();
    let centres = mask(folder.path());
    for prior in ["none", "rows", "grid"] {
        for update in ["mean", "median"] {
            for (form, sigma) in
                [("joint", "paper"), ("conditional", "planar"), ("joint", "fixed:6")]
            {
                let words =
                    format!("--prior {prior} --update {update} --form {form} --sigma {sigma}");
                let run = rowgram(
                    folder.path(),
                    &format!(
                        "locate mask.png --method descent --plants 36 {words} --init rows --force -o plants.csv"
                    ),
                );
                assert!(run.code == 0, "{}", run.stderr);
                let (header, plants) = read(&folder.path().join("plants.csv"));
                assert_eq!(header, ["u_px", "v_px", "row"]);
                assert_eq!(plants.len(), 36);
                let error = farthest(&plants, &centres);
                assert!(error < 2.0, "{prior} {update} {form} {sigma}: {error}");
                assert!(plants.windows(2).all(|pair| pair[0][2] <= pair[1][2]));
            }
        }
    }
}

#[test]
fn the_summary_trace_overlay_and_metres_are_written() {
    let folder = tempfile::tempdir().unwrap();
    mask(folder.path());
    let run = rowgram(
        folder.path(),
        "locate mask.png --plants 36 --method descent --gsd-m 0.01 --json --quiet --trace trace.csv --figures figures -o plants.csv",
    );
    assert!(run.code == 0 && run.stderr.is_empty());
    let json: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!((json["plants"].as_u64(), json["rows"].as_u64()), (Some(36), Some(3)));
    assert!((json["heading_deg"].as_f64().unwrap() - 10.0).abs() < 0.5, "{json}");
    assert!((json["row_spacing_m"].as_f64().unwrap() - 0.6).abs() < 0.01, "{json}");
    assert!(json["final_cost"].as_f64() <= json["initial_cost"].as_f64());
    let (header, plants) = read(&folder.path().join("plants.csv"));
    assert_eq!(header, ["u_px", "v_px", "row", "x_m", "y_m"]);
    // Metres to the right and upwards, rounded to a tenth of a millimetre.
    let is_near = |a: f64, b: f64| (a - b).abs() < 1e-4;
    assert!(plants.iter().all(|p| is_near(0.01 * p[0], p[3]) && is_near(-0.01 * p[1], p[4])));
    assert!(std::fs::read_to_string(folder.path().join("trace.csv")).unwrap().contains("sigma_px"));
    assert_eq!(image::open(folder.path().join("figures/plants.png")).unwrap().width(), 360);
}

#[test]
fn the_result_depends_on_the_seed_alone() {
    let folder = tempfile::tempdir().unwrap();
    mask(folder.path());
    let run = |name: &str, seed: &str, threads: &str| {
        let words = "locate mask.png --plants 30 --method descent --prior none --order shuffled";
        let run =
            rowgram(folder.path(), &format!("{words} --seed {seed} --threads {threads} -o {name}"));
        assert!(run.code == 0);
        std::fs::read(folder.path().join(name)).unwrap()
    };
    assert_eq!(run("a.csv", "1", "1"), run("b.csv", "1", "4"));
    assert_ne!(run("c.csv", "2", "1"), run("d.csv", "1", "1"));
}

#[test]
fn bad_input_is_refused_with_code_2_and_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    mask(at);
    image::GrayImage::new(50, 40).save(at.join("black.png")).unwrap();
    image::GrayImage::from_pixel(60, 60, image::Luma([255])).save(at.join("white.png")).unwrap();
    std::fs::write(at.join("text.png"), "no picture").unwrap();
    std::fs::write(at.join("there.csv"), "").unwrap();
    for (arguments, reason) in [
        ("mask.png --plants 0", "of at least 1"),
        ("mask.png --plants -3", "-3"),
        ("mask.png --plants 9999999", "leaf pixels"),
        ("black.png --plants 3", "no leaf pixel"),
        ("text.png --plants 3", "text.png"),
        ("/nonexistent.png --plants 3", "/nonexistent.png"),
        ("mask.png --plants 3 --gsd-m 0", "gsd-m"),
        ("mask.png --plants 3 --gsd-m nan", "gsd-m"),
        ("mask.png --plants 3 --prior columns", "one of: none, rows, grid"),
        ("mask.png --plants 3 --sigma fixed:-1", "fixed:PX"),
        ("mask.png --plants 3 --init kmeans", "kmeans++"),
        ("mask.png --plants 3 --hsv 30,79,30", "hsv"),
        ("mask.png --plants 3 --hsv 30,190,30,163", "180"),
        // Leaf all over is taken for a mask whose values are exchanged.
        ("white.png --plants 3", "exchanged"),
        ("mask.png --plants 3 --force -o mask.png", "is an input"),
        ("mask.png --plants 3 -o there.csv", "--force"),
    ] {
        let to = if arguments.contains("-o ") { "" } else { "-o out.csv" };
        let run = rowgram(at, &format!("locate {arguments} {to}"));
        assert_eq!(run.code, 2, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(reason), "{arguments}: {}", run.stderr);
        assert!(!at.join("out.csv").exists());
    }
}

#[test]
fn the_plants_of_a_young_field_are_found() {
    let Some(folder) = crate::data::path("field_masks/early20") else { return };
    let out = tempfile::tempdir().unwrap();
    let (_, truth) = read(&folder.join("1000.csv"));
    let truth: Vec<[f64; 2]> = truth.iter().map(|row| [row[0], row[1]]).collect();
    let (mask, count) = (folder.join("1000.png"), truth.len());
    let words = format!("locate {} --plants {count} --gsd-m 0.015 -o plants.csv", mask.display());
    let run = rowgram(out.path(), &words);
    assert!(run.code == 0, "{}", run.stderr);
    let (_, found) = read(&out.path().join("plants.csv"));
    let found: Vec<[f64; 2]> = found.iter().map(|row| [row[0], row[1]]).collect();
    let score = rowgram::score::Score::new(&found, &truth, &[10.0 / 1.5]).unwrap();
    // 141 of 142 plants are found; four more may change sides with the last digits of the scores.
    assert!(score.radii[0].f1.unwrap() > 0.96, "{score:?}");
}

#[test]
fn the_default_counts_and_tells_how_sure_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let grown = rowgram(
        folder.path(),
        "synth mask --stage early --rows 3 --row-length 4 --gsd 0.015 -o field",
    );
    assert!(grown.code == 0, "{}", grown.stderr);
    let (_, truth) = read(&folder.path().join("field/plants.csv"));
    let run = rowgram(
        folder.path(),
        "locate field/mask.png --gsd-m 0.015 --json --gaps gaps.csv --rows rows.csv --figures figures -o plants.csv",
    );
    assert!(run.code == 0, "{}", run.stderr);
    let json: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    let found = json["plants"].as_f64().unwrap();
    assert!((found / truth.len() as f64 - 1.0).abs() < 0.1, "{found} {}", truth.len());
    let interval = |name: &str| [0, 1].map(|end| json[name][end].as_f64().unwrap());
    let [low, high] = interval("plants_interval");
    assert!(low <= found && found <= high, "{json}");
    let [low, high] = interval("row_spacing_interval_m");
    assert!(low < 0.765 && high > 0.755, "{json}");
    let [low, high] = interval("spacing_interval_m");
    assert!(low < 0.21 && high > 0.19, "{json}");
    assert!(json["plants_per_hectare"].as_f64().unwrap() > 40_000.0, "{json}");
    let (header, plants) = read(&path("plants.csv"));
    let names =
        ["u_px", "v_px", "row", "x_m", "y_m", "confidence", "sigma_along_px", "sigma_across_px"];
    assert_eq!(header, names);
    assert_eq!(plants.len() as f64, found);
    assert!(plants.iter().all(|plant| (0.0..=1.0).contains(&plant[5]) && plant[6] > 0.0));
    let (header, counts) = read(&path("rows.csv"));
    let names = ["row", "plants", "expected", "low", "high", "length_px", "length_m"];
    assert_eq!(header[..7], names);
    assert_eq!(header[7..], ["start_u_px", "start_v_px", "end_u_px", "end_v_px"]);
    assert_eq!(counts.iter().map(|row| row[1]).sum::<f64>(), found);
    assert!(read(&path("gaps.csv")).0.contains(&"probability".to_owned()));
    assert!(image::open(path("figures/plants.png")).unwrap().width() > 100);

    // The named methods run on the same mask, also without being told the number.
    for method in ["descent", "paper", "kmeans", "rows"] {
        let words = format!("locate field/mask.png --method {method} --force -o plants.csv");
        let run = rowgram(folder.path(), &words);
        assert!(run.code == 0, "{method}: {}", run.stderr);
        assert_eq!(read(&path("plants.csv")).1.len() as f64, found, "{method}");
    }
    // Several starts end no worse, and certificates stand.
    let of = |extra: &str| {
        let words =
            "locate field/mask.png --method descent --tempering 6 --json --force -o plants.csv";
        let run = rowgram(folder.path(), &format!("{words} {extra}"));
        assert!(run.code == 0, "{extra}: {}", run.stderr);
        serde_json::from_str::<serde_json::Value>(&run.stdout).unwrap()
    };
    let (plain, tried) = (of(""), of("--init kmeans++ --starts 2"));
    assert!(tried["final_cost"].as_f64().unwrap().is_finite() && plain["certificate"].is_null());
    let proof = of("--certify")["certificate"].clone();
    assert!(proof["worst_gap"].as_f64().unwrap() < 0.05, "{proof}");
    assert!(proof["plants"].as_f64().unwrap() > 0.9 * found, "{proof}");
    for (words, reason) in [
        ("--certify --method=row-model", "certify"),
        ("--starts=0 --certify", "--starts"),
        ("--method row-model --prior rows", "prior"),
        ("--method paper --gaps gaps.csv", "only the method row-model"),
        ("--wishes 3 --plants 3", "wishes"),
        ("--tilt-sigma nan --plants 3", "--tilt-sigma nan"),
        ("--across-sigma 0 --plants 3", "--across-sigma 0"),
        ("--plants some --seed 1", "auto"),
        ("--tempering -1 --plants 3", "--tempering"),
    ] {
        let words = format!("locate field/mask.png --force -o plants.csv {words}");
        let run = rowgram(folder.path(), &words);
        assert_eq!(run.code, 2, "{words}: {}", run.stderr);
        assert!(run.stderr.contains(reason), "{words}: {}", run.stderr);
    }
}
