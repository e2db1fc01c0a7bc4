//! Seasons: the twin over several dates, its flights in one frame, plots and plants through the dates.

use crate::program::rowgram;
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
