//! Seasons: the twin over several dates, its flights in one frame, plots and plants through the dates.

use crate::program::rowgram;
use data_synth::season_plan::{SeasonConfig, SeasonPreset};
use rowgram::{
    io::csv_table::CsvTable,
    monitor::{Collector, Silent},
    pipeline::{
        season::{self, SeasonFile, SeasonOutcome},
        synth::{FlightOptions, write_season},
    },
};
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// The number of a column in each row, by the texts of two others.
fn by_two(path: &Path, keys: [&str; 2], value: &str) -> BTreeMap<(String, String), f64> {
    let table = CsvTable::read(path).unwrap();
    let [first, second] = keys.map(|key| table.texts(key).unwrap());
    let values = table.numbers(value).unwrap();
    let key = |k: usize| (first[k].to_owned(), second[k].to_owned());
    values.iter().enumerate().map(|(k, &value)| (key(k), value)).collect()
}

#[test]
fn a_synthetic_season_has_the_truth_of_every_date() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let words = "synth season --preset tiny --seed 3 --no-photos -q -o";
    let made = rowgram(root, &format!("{words} a"));
    assert_eq!(made.code, 0, "{}", made.stderr);
    let again = rowgram(root, &format!("{words} a"));
    assert_eq!(again.code, 2, "{}", again.stderr);
    assert!(again.stderr.contains("exists already"), "{}", again.stderr);
    let other = rowgram(root, &format!("{words} b --threads 1"));
    assert_eq!(other.code, 0, "{}", other.stderr);
    let names = ["plants", "plant_days", "plots", "plot_days"];
    let names = names.map(|name| PathBuf::from("truth").join(name).with_extension("csv"));
    for name in names.iter().chain([&PathBuf::from("plots.geojson")]) {
        let [a, b] = ["a", "b"].map(|of| fs::read(root.join(of).join(name)).unwrap());
        assert_eq!(a, b, "{}", name.display());
    }
    crate::formats::assert_columns_are_documented(&root.join("a/truth"));
    let file = SeasonFile::read(&root.join("a/season.toml")).unwrap();
    let days: Vec<f64> = file.flights.iter().map(|flight| file.day(flight)).collect();
    assert_eq!(days, [10.0, 15.0, 21.0]);
    // What a date shows is what has emerged and is not lost.
    let plants = CsvTable::read(&root.join("a/truth/plants.csv")).unwrap();
    let (emergence, lost) =
        (plants.numbers("emergence_day").unwrap(), plants.numbers("lost_day").unwrap());
    let areas = by_two(&root.join("a/truth/plant_days.csv"), ["date", "plant"], "leaf_area_m2");
    let covers = by_two(&root.join("a/truth/plot_days.csv"), ["date", "plot"], "canopy_cover");
    let mut before = 0.0;
    for (flight, day) in file.flights.iter().zip(days) {
        let there = |k: &usize| emergence[*k] <= day && (lost[*k].is_nan() || day < lost[*k]);
        let expected: Vec<usize> = (0..plants.len()).filter(there).collect();
        let found = areas.keys().filter(|(date, _)| *date == flight.date).count();
        assert_eq!(found, expected.len(), "{}", flight.date);
        let of_flight =
            CsvTable::read(&root.join("a").join(&flight.project).join("truth/plants.csv"));
        assert_eq!(of_flight.unwrap().len(), expected.len());
        let cover = covers.iter().filter(|((date, _), _)| *date == flight.date).map(|(_, c)| c);
        let cover: f64 = cover.sum();
        assert!(cover > before, "cover grows: {cover} after {before}");
        before = cover;
    }
}

#[test]
fn a_season_without_maps_is_incomplete_and_says_why() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("a")).unwrap();
    fs::write(
        folder.path().join("season.toml"),
        "[[flights]]\nproject = \"a\"\ndate = \"2020-05-01\"\n",
    )
    .unwrap();
    let run = rowgram(folder.path(), "season season.toml");
    assert_eq!(run.code, 3, "{}", run.stderr);
    assert!(run.stderr.contains("none of its flights has a map"), "{}", run.stderr);
    assert!(run.stderr.contains("no photos"), "{}", run.stderr);
    let run = rowgram(folder.path(), "season nothing.toml");
    assert_eq!(run.code, 2, "{}", run.stderr);
}

#[test]
fn plots_and_panels_are_checked_before_any_flight_is_run() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    fs::create_dir(root.join("a")).unwrap();
    let square = |properties: &str| {
        format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","properties":{properties},"geometry":
            {{"type":"Polygon","coordinates":[[[0,0],[1,0],[1,1],[0,0]]]}}}}]}}"#
        )
    };
    let flight = "[[flights]]\nproject = \"a\"\ndate = \"2020-05-01\"\n";
    let (of_season, of_flight) =
        (format!("panels = \"p.geojson\"\n{flight}"), format!("{flight}panels = \"p.geojson\"\n"));
    let white = square(r#"{"name":"white","red":0.6,"green":0.6,"blue":60}"#);
    let off = format!("{of_season}[season]\ncolours = \"off\"\n");
    for (list, polygons, code, words) in [
        (&of_season, &white, 2, "at most 1; blue is 60"),
        (&of_flight, &white, 2, "p.geojson: panel white"),
        (&of_season, &"{".to_owned(), 2, "p.geojson"),
        (&format!("plots = \"p.geojson\"\n{flight}"), &"{".to_owned(), 2, "p.geojson"),
        // Panels that nobody uses are in nobody's way.
        (&off, &white, 3, "none of its flights has a map"),
    ] {
        fs::write(root.join("season.toml"), list).unwrap();
        fs::write(root.join("p.geojson"), polygons).unwrap();
        let run = rowgram(root, "season season.toml");
        assert_eq!(run.code, code, "{list}: {}", run.stderr);
        assert!(run.stderr.contains(words), "{list}: {}", run.stderr);
        let has_run = run.stderr.contains("it takes no part in the season");
        assert_eq!(has_run, code == 3, "{list}: {}", run.stderr);
    }
}

/// Where the adjustment of a flight puts its ground points, in the frame of the season, minus where they truly are, metres.
fn plan_errors(root: &Path, outcome: &SeasonOutcome, flight: usize) -> Vec<[f64; 2]> {
    let flight = &outcome.flights[flight];
    let folder = root.join(&flight.project);
    let truth = CsvTable::read(&folder.join("truth/gcps.csv")).unwrap();
    let (labels, places) =
        (truth.texts("label").unwrap(), truth.pairs("easting_m", "northing_m").unwrap());
    let text = fs::read(folder.join("rowgram/align/report/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&text).unwrap();
    let similarity = &flight.placement.as_ref().unwrap().transform;
    let adjusted: BTreeMap<&str, [f64; 2]> = report["ground"]
        .as_array()
        .unwrap()
        .iter()
        .map(|point| {
            let at = |k: usize| point["adjusted_m"][k].as_f64().unwrap();
            (point["name"].as_str().unwrap(), similarity.apply([at(0), at(1)]))
        })
        .collect();
    let error = |(label, place): (&&str, &[f64; 2])| {
        adjusted.get(label).map_or([f64::NAN; 2], |at| [at[0] - place[0], at[1] - place[1]])
    };
    labels.iter().zip(&places).map(error).collect()
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn a_season_without_control_after_its_first_flight_is_in_one_frame() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let config = SeasonConfig::preset(SeasonPreset::Tiny);
    write_season(&config, &FlightOptions::default(), root, false, &mut Silent).unwrap();
    let path = root.join("season.toml");
    // Dense surfaces take most of the time and are not needed here.
    let settings = ["stages.skip=[\"surface\", \"leaves\"]", "leaf_count.rho_px=60"];
    let settings = settings.map(str::to_owned);
    let mut first = Collector::default();
    let all = SeasonFile::read(&path).unwrap();
    let mut two = all.clone();
    two.flights.truncate(2);
    let before = season::season(&two, &[], &settings, false, &mut first).unwrap();
    let outcome = season::season(&all, &[], &settings, false, &mut first).unwrap();
    // The third flight changes nothing of the others.
    assert_eq!(before.flights[..], outcome.flights[..2]);
    let frames: Vec<bool> = outcome
        .flights
        .iter()
        .map(|flight| flight.placement.as_ref().unwrap().fit.is_some())
        .collect();
    assert_eq!(frames, [false, true, true], "only the first flight has control");
    for k in 1..3 {
        let (a, b) = (plan_errors(root, &outcome, k - 1), plan_errors(root, &outcome, k));
        let apart: Vec<f64> = a
            .iter()
            .zip(&b)
            .map(|(a, b)| (b[0] - a[0]).hypot(b[1] - a[1]))
            .filter(|d| d.is_finite())
            .collect();
        assert!(apart.len() >= 4, "{a:?} {b:?}");
        let rms = (apart.iter().map(|d| d * d).sum::<f64>() / apart.len() as f64).sqrt();
        let gsd_m = outcome.flights[k].gsd_m.unwrap();
        println!("dates {k} and {}: {:.2} GSD apart", k - 1, rms / gsd_m);
        assert!(rms < gsd_m, "dates {k}: {rms} m of {gsd_m} m");
    }
    assert_eq!(outcome.plots.len(), 2);
    let covers = &outcome.traits[0];
    assert_eq!(covers.name, "canopy_cover");
    for plot in &covers.plots {
        assert_eq!(plot.samples.len(), 3);
        assert!(plot.samples.windows(2).all(|pair| pair[0].value < pair[1].value), "{plot:?}");
        assert!(plot.curve.is_none() && plot.untold.is_some(), "three dates are too few");
    }
    crate::formats::assert_columns_are_documented(&root.join("season"));
    assert_eq!(SeasonOutcome::read(&all).unwrap(), outcome);
    // Doing it again gives the same bytes.
    let tables = ["flights.csv", "traits_long.csv", "plants_long.csv", "growth.csv"];
    let read = || tables.map(|name| fs::read(root.join("season").join(name)).unwrap());
    let kept = read();
    season::season(&all, &[], &settings, false, &mut Silent).unwrap();
    assert_eq!(kept, read());
    // And nothing is done again: every flight is measured in the plots of the season only.
    for flight in &outcome.flights {
        let text = fs::read(root.join(&flight.project).join("rowgram/stats.json")).unwrap();
        let stats: serde_json::Value = serde_json::from_slice(&text).unwrap();
        let stages = stats["stages"].as_array().unwrap();
        assert!(stages.iter().all(|stage| stage["ending"] != "done"), "{stats}");
        let count = stages.iter().find(|stage| stage["stage"] == "leaf-count").unwrap();
        assert_eq!(count["ending"], "kept", "{stats}");
    }
}
