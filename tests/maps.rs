//! Orthomosaics and plots as other people have them: reference systems, pixels, bands, holes, names. The same field in each has the
//! same plants, areas and spacings.

use crate::program::rowgram;
use image::RgbImage;
use rowgram::{
    crs,
    io::{FileError, geotiff},
    raster::{
        georeference::{Crs, CrsKind, Georeference},
        window::Window,
    },
};
use serde_json::{Value, json};
use std::{collections::BTreeMap, fs, path::Path};

/// Ground sampling distance, metres.
pub(crate) const GSD_M: f64 = 0.015;
/// Where the field lies: a place far from the equator and in the middle of a UTM zone.
pub(crate) const LATITUDE: f64 = 48.5;
pub(crate) const LONGITUDE: f64 = 9.0;

/// A picture of a field of four rows.
pub(crate) fn picture(folder: &Path) -> RgbImage {
    let words = "synth mask --stage mid --rows 4 --row-length 5 --seed 3 -o grown -q";
    let grown = rowgram(folder, &format!("{words} --gsd {GSD_M}"));
    assert_eq!(grown.code, 0, "{}", grown.stderr);
    image::open(folder.join("grown/picture.png")).unwrap().into_rgb8()
}

pub(crate) fn write(path: &Path, picture: &RgbImage, place: Georeference) {
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let layout = geotiff::Layout {
        width,
        height,
        colour: geotiff::Colour::Rgb,
        georeference: Some(place),
        nodata: None,
    };
    geotiff::write::<u8, FileError>(path, false, &layout, |writer| {
        writer.put(Window::whole(width, height), picture.as_raw())
    })
    .unwrap();
}

/// A plot over a part of a picture, in map coordinates.
pub(crate) fn plot(
    picture: &RgbImage,
    place: Georeference,
    [left, right]: [f64; 2],
    properties: Value,
) -> Value {
    let [width, height] = [f64::from(picture.width()), f64::from(picture.height())];
    let corners = [[left, 0.0], [right, 0.0], [right, 1.0], [left, 1.0], [left, 0.0]];
    let ring = corners.map(|[u, v]| place.map([width * u - 0.5, height * v - 0.5]));
    json!({"type": "Feature", "properties": properties,
           "geometry": {"type": "Polygon", "coordinates": [ring]}})
}

pub(crate) fn collection(code: Option<u32>, features: Vec<Value>) -> String {
    let mut all = json!({"type": "FeatureCollection", "features": features});
    if let Some(code) = code {
        all["crs"] = json!({"type": "name", "properties": {"name": format!("urn:ogc:def:crs:EPSG::{code}")}});
    }
    all.to_string()
}

/// The table of traits of a project that is run up to its plots: plot, then trait.
pub(crate) fn traits(project: &Path, words: &str) -> BTreeMap<String, BTreeMap<String, String>> {
    let run = rowgram(project, &format!("run . -q {words}"));
    assert!(matches!(run.code, 0 | 3), "{}{}", run.stdout, run.stderr);
    table(&project.join("rowgram/plots/traits.csv"))
}

/// A table by its first column.
pub(crate) fn table(path: &Path) -> BTreeMap<String, BTreeMap<String, String>> {
    let mut table = csv::Reader::from_path(path).unwrap();
    let header = table.headers().unwrap().clone();
    let row = |record: csv::StringRecord| {
        let cells = header.iter().zip(&record).map(|(k, v)| (k.to_owned(), v.to_owned()));
        (record[0].to_owned(), cells.collect())
    };
    table.records().map(|record| row(record.unwrap())).collect()
}

pub(crate) fn number(of: &BTreeMap<String, String>, name: &str) -> f64 {
    of[name].parse().unwrap_or_else(|_| panic!("{name}: {of:?}"))
}

fn at(code: u32) -> [f64; 2] {
    crs::Crs::of_code(code).unwrap().from_wgs84(LATITUDE, LONGITUDE).unwrap()
}

/// The place of a raster with pixels of [`GSD_M`] on the ground in a system with so many units for a metre there.
pub(crate) fn placed(code: u32, kind: CrsKind, units_per_m: [f64; 2]) -> Georeference {
    let crs = Crs { kind, ..Crs::projected(code) };
    Georeference {
        origin: at(code),
        per_column: [GSD_M * units_per_m[0], 0.0],
        per_row: [0.0, -GSD_M * units_per_m[1]],
        crs,
    }
}

/// The same field in metres, web metres, degrees and feet, turned, from south to north and with oblong pixels.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn metres_are_metres() {
    let folder = tempfile::tempdir().unwrap();
    let square = picture(folder.path());
    let flat =
        RgbImage::from_fn(square.width(), square.height() / 2, |u, v| *square.get_pixel(u, 2 * v));
    let utm = placed(32632, CrsKind::Projected, [1.0; 2]);
    let scale = 1.0 / (LATITUDE.to_radians().cos());
    // Metres of a degree at 48.5 degrees on WGS84.
    let degrees = placed(4326, CrsKind::Geographic, [1.0 / 73_903.7, 1.0 / 111_200.4]);
    let (sin, cos) = 0.35f64.sin_cos();
    let turned = Georeference {
        per_column: [GSD_M * cos, GSD_M * sin],
        per_row: [GSD_M * sin, -GSD_M * cos],
        ..utm
    };
    let south_up = Georeference { per_row: [0.0, GSD_M], ..utm };
    let oblong = Georeference { per_row: [0.0, -2.0 * GSD_M], ..utm };
    let feet = 3937.0 / 1200.0;
    // A system of the USA; the field is where its numbers are.
    let state = Georeference {
        origin: [980_000.0, 190_000.0],
        per_column: [GSD_M * feet, 0.0],
        per_row: [0.0, -GSD_M * feet],
        crs: Crs { kind: CrsKind::SurveyFeet, ..Crs::projected(2263) },
    };
    let all = [
        ("utm", &square, utm),
        ("web", &square, placed(3857, CrsKind::Projected, [scale; 2])),
        ("degrees", &square, degrees),
        (
            "oblong degrees",
            &flat,
            Georeference { per_row: degrees.per_row.map(|x| 2.0 * x), ..degrees },
        ),
        ("turned", &square, turned),
        ("south", &square, south_up),
        ("oblong", &flat, oblong),
        ("feet", &square, state),
    ];
    let mut expected: Option<BTreeMap<String, String>> = None;
    for (name, picture, place) in all {
        let project = folder.path().join(name);
        fs::create_dir(&project).unwrap();
        write(&project.join("ortho.tif"), picture, place);
        let features = vec![
            plot(picture, place, [0.0, 0.5], json!({"plot": 101})),
            plot(picture, place, [0.5, 1.0], json!({"plot": 102})),
        ];
        fs::write(project.join("plots.geojson"), collection(place.crs.epsg, features)).unwrap();
        let doctor = rowgram(&project, "doctor .");
        assert_eq!(doctor.code, 0, "{name}: {}", doctor.stdout);
        let of = traits(&project, "").remove("101").unwrap();
        let area = f64::from(square.width()) * f64::from(square.height()) / 2.0 * GSD_M * GSD_M;
        let is_near = |a: f64, b: f64, by: f64| (a / b - 1.0).abs() < by;
        assert!(is_near(number(&of, "area_m2"), area, 0.01), "{name}: {of:?}");
        let Some(expected) = &expected else {
            expected = Some(of);
            continue;
        };
        // Half of the rows of pixels show as much of a plant as the eye needs; plants are within some per cent.
        let by = if name.starts_with("oblong") { 0.05 } else { 0.01 };
        for trait_name in ["plants", "plants_per_ha", "plant_spacing_m"] {
            let [a, b] = [number(&of, trait_name), number(expected, trait_name)];
            assert!(is_near(a, b, by), "{name} {trait_name}: {a}, expected {b}");
        }
    }
}

/// A mosaic in a black frame, with a part of a plot that nobody photographed.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn only_what_the_map_shows_counts() {
    let folder = tempfile::tempdir().unwrap();
    let square = picture(folder.path());
    let (width, height) = square.dimensions();
    let framed = RgbImage::from_fn(width + 200, height + 100, |u, v| {
        let inside = (100..100 + width).contains(&u) && (50..50 + height).contains(&v);
        let unseen = u > 100 + 3 * width / 4;
        if inside && !unseen { *square.get_pixel(u - 100, v - 50) } else { image::Rgb([0; 3]) }
    });
    let place = placed(32632, CrsKind::Projected, [1.0; 2]);
    let project = folder.path().join("framed");
    fs::create_dir(&project).unwrap();
    write(&project.join("ortho.tif"), &framed, place);
    // The whole field: the part of the picture that shows something.
    let of = traits(&project, "").remove("field").unwrap();
    let seen = 0.75 * f64::from(width) * f64::from(height) * GSD_M * GSD_M;
    assert!((number(&of, "area_m2") / seen - 1.0).abs() < 0.02, "{of:?} {seen}");
    assert_eq!(number(&of, "valid_share"), 1.0);
    let inner = place.from_pixel(100, 50);
    let features = vec![
        plot(&square, inner, [0.0, 0.5], json!({"plot": "A"})),
        plot(&square, inner, [0.5, 1.0], json!({"plot": "B"})),
        plot(&square, inner, [0.7, 1.0], json!({"plot": "C"})),
    ];
    fs::write(project.join("plots.geojson"), collection(Some(32632), features)).unwrap();
    let all = traits(&project, "");
    let half = seen / 1.5;
    let [a, b, c] = ["A", "B", "C"].map(|name| &all[name]);
    assert!((number(b, "valid_share") - 0.5).abs() < 0.1, "{b:?}");
    let area = number(b, "area_m2");
    assert!((area / half - number(b, "valid_share")).abs() < 0.02, "{b:?}");
    // A's side has the margin of the field in it: as many plants to the leaf as its neighbour.
    let to_leaf = |of| number(of, "plants_per_ha") / number(of, "canopy_cover");
    let ratio = to_leaf(b) / to_leaf(a);
    assert!((0.85..1.15).contains(&ratio), "{ratio}: {a:?} {b:?}");
    assert_eq!(c["plants"], "", "{c:?}");
    assert!(number(c, "valid_share") < 0.3, "{c:?}");
}

/// Plots in another zone and with exchanged axes are refused before anything is computed, with the cause; names, inset, field book.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn plots_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let square = picture(folder.path());
    let place = placed(32632, CrsKind::Projected, [1.0; 2]);
    let project = folder.path().join("field");
    fs::create_dir(&project).unwrap();
    write(&project.join("ortho.tif"), &square, place);
    let drawn = |left: f64, right: f64, of: Value| plot(&square, place, [left, right], of);
    let set = |text: String| fs::write(project.join("plots.geojson"), text).unwrap();
    let refused = |words: &[&str]| {
        for command in ["run . -q", "doctor ."] {
            let said = rowgram(&project, command);
            assert_eq!(said.code, if command.starts_with("run") { 2 } else { said.code });
            assert_ne!(said.code, 0, "{command}: {}", said.stdout);
            let text = said.stdout + &said.stderr;
            let flat = text.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(words.iter().all(|word| flat.contains(word)), "{command}: {text}");
        }
        assert!(!project.join("rowgram/segment").exists(), "stages were run");
    };
    let text = drawn(0.0, 1.0, json!({"plot": 1})).to_string();
    let moved = |to: &dyn Fn([f64; 2]) -> [f64; 2]| {
        let mut feature: Value = serde_json::from_str(&text).unwrap();
        for at in feature["geometry"]["coordinates"][0].as_array_mut().unwrap() {
            let [x, y] = to([at[0].as_f64().unwrap(), at[1].as_f64().unwrap()]);
            *at = json!([x, y]);
        }
        feature
    };
    let zone = |code: u32| crs::Crs::of_code(code).unwrap();
    let degrees = |[x, y]: [f64; 2]| zone(32632).to_wgs84(x, y).unwrap();
    let other = moved(&|at| {
        let [latitude, longitude] = degrees(at);
        zone(32633).from_wgs84(latitude, longitude).unwrap()
    });
    set(collection(None, vec![other]));
    refused(&["none of its 1 polygons lies on the map", "EPSG:32633"]);
    set(collection(None, vec![moved(&degrees)]));
    refused(&["latitude stands before longitude"]);
    set(collection(None, vec![moved(&|[x, y]| [y, x])]));
    refused(&["x and y are exchanged"]);
    // Genotypes repeat, plots do not; one has no geometry, one is a point, one is a sliver.
    let nothing = json!({"type": "Feature", "properties": {"PlotID": 109.0, "name": "B73"}, "geometry": null});
    let point = json!({"type": "Feature", "properties": {"PlotID": 108.0, "name": "B73"},
                       "geometry": {"type": "Point", "coordinates": [1.0, 2.0]}});
    let named = |id: f64| json!({"PlotID": id, "name": "B73"});
    // Between the centres of two columns of pixels.
    let width = f64::from(square.width());
    let between = |at: f64| ((0.5 * width).floor() + 0.5 + at) / width;
    set(collection(
        Some(32632),
        vec![
            drawn(0.0, 0.5, named(101.0)),
            drawn(0.5, 1.0, named(102.0)),
            drawn(between(0.2), between(0.4), named(103.0)),
            nothing,
            point,
        ],
    ));
    fs::write(project.join("book.csv"), "Parcel;Sorte\n102;Köln\n101;Señora\n").unwrap();
    let doctor = rowgram(&project, "doctor .");
    for said in
        ["feature 109 has no geometry", "feature 108 is a Point", "narrower than a pixel: 103"]
    {
        let flat = doctor.stdout.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(said), "{said}: {}", doctor.stdout);
    }
    let settings = "[plots]\nfield_book = \"book.csv\"\n";
    fs::write(project.join("rowgram.toml"), settings).unwrap();
    let whole = traits(&project, "");
    assert_eq!(whole["101"]["Sorte"], "Señora");
    assert_eq!(whole["102"]["name"], "B73");
    assert_eq!(whole["103"]["area_m2"], "0");
    let inset = "inset_along_m = 0.3\ninset_across_m = 0.3\n";
    set(collection(Some(32632), vec![drawn(0.0, 1.0, named(101.0))]));
    fs::write(project.join("rowgram.toml"), format!("{settings}{inset}")).unwrap();
    let inner = traits(&project, "");
    let [width, height] =
        [square.width(), square.height()].map(|pixels| f64::from(pixels) * GSD_M - 0.6);
    let ratio = number(&inner["101"], "area_m2") / (width * height);
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    fs::write(project.join("rowgram.toml"), format!("{settings}border_rows = 1\n")).unwrap();
    let inner = traits(&project, "");
    let ratio = number(&inner["101"], "plants") / number(&whole["101"], "plants");
    // Two of four rows, of both halves.
    assert!((0.8..1.2).contains(&ratio), "{ratio}");
}

/// Bands by their names, in any order and unit; a fourth band that is no alpha; index maps by name.
#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn bands_are_what_they_are_called() {
    let folder = tempfile::tempdir().unwrap();
    let square = picture(folder.path());
    let place = placed(32632, CrsKind::Projected, [1.0; 2]);
    let write = |name: &str, samples: Samples, names: &[&str]| {
        let project = folder.path().join(name);
        fs::create_dir(&project).unwrap();
        fs::write(project.join("ortho.tif"), tiff(&square, place, samples, names)).unwrap();
        project
    };
    let plain =
        traits(&write("plain", Samples::Bytes([0, 1, 2], false), &[]), "").remove("field").unwrap();
    let cases = [
        ("bgr", Samples::Bytes([2, 1, 0], true), &["Blue", "Green", "Red", "NIR"][..]),
        ("nir", Samples::Bytes([0, 1, 2], true), &[]),
        ("reflectance", Samples::Reflectance, &[]),
        ("share", Samples::Share, &["Red", "Green", "Blue"]),
    ];
    for (name, samples, names) in cases {
        let of = traits(&write(name, samples, names), "").remove("field").unwrap();
        let [a, b] = [number(&of, "plants"), number(&plain, "plants")];
        assert!((a / b - 1.0).abs() < 0.03, "{name}: {a} {b}");
        let [a, b] = [number(&of, "ngrdi"), number(&plain, "ngrdi")];
        assert!((a - b).abs() < 0.02, "{name}: {a} {b}");
    }
    let index = write("index", Samples::Index, &[]);
    let said = rowgram(&index, "run . -q");
    assert_eq!(said.code, 2);
    assert!(said.stderr.contains("vegetation index"), "{}", said.stderr);
    let doctor = rowgram(&index, "doctor .");
    assert!(doctor.code != 0 && doctor.stdout.contains("vegetation index"), "{}", doctor.stdout);
}

/// What the samples of a file are.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Samples {
    /// Channels of the picture in this order, and a band of zeros that is no alpha.
    Bytes([usize; 3], bool),
    /// 16 bits, a reflectance of 0.4 for full brightness times 10,000.
    Reflectance,
    /// Floating point, 0 to 0.4.
    Share,
    /// One band of floating point.
    Index,
}

/// A TIFF file with one strip, as other programs write them.
pub(crate) fn tiff(
    picture: &RgbImage,
    place: Georeference,
    samples: Samples,
    names: &[&str],
) -> Vec<u8> {
    let (bits, format, bands) = match samples {
        Samples::Bytes(_, more) => (8u16, 1u16, if more { 4 } else { 3 }),
        Samples::Reflectance => (16, 1, 3),
        Samples::Share => (32, 3, 3),
        Samples::Index => (32, 3, 1),
    };
    let mut data: Vec<u8> = Vec::new();
    for pixel in picture.pixels() {
        match samples {
            Samples::Bytes(order, more) => {
                data.extend(order.map(|k| pixel.0[k]));
                data.extend(more.then_some(0));
            }
            Samples::Reflectance => {
                data.extend(pixel.0.iter().flat_map(|&x| (u16::from(x) * 16).to_le_bytes()));
            }
            Samples::Share => {
                data.extend(
                    pixel.0.iter().flat_map(|&x| (f32::from(x) / 255.0 * 0.4).to_le_bytes()),
                );
            }
            Samples::Index => data.extend((f32::from(pixel.0[1]) / 255.0).to_le_bytes()),
        }
    }
    let shorts = |values: &[u16]| {
        (
            3u16,
            values.len() as u32,
            values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let long = |value: u32| (4u16, 1u32, value.to_le_bytes().to_vec());
    let doubles = |values: &[f64]| {
        (
            12u16,
            values.len() as u32,
            values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let items: String = (names.iter().enumerate())
        .map(|(k, name)| {
            format!("<Item name=\"DESCRIPTION\" sample=\"{k}\" role=\"description\">{name}</Item>")
        })
        .collect();
    let xml = format!("<GDALMetadata>{items}</GDALMetadata>\0").into_bytes();
    let corner = place.map([-0.5, -0.5]);
    /// Type, number of values and bytes of a tag.
    type TagValue = (u16, u32, Vec<u8>);
    let mut tags: Vec<(u16, TagValue)> = vec![
        (256, long(picture.width())),
        (257, long(picture.height())),
        (258, shorts(&vec![bits; bands])),
        (259, shorts(&[1])),
        (262, shorts(&[1])),
        (273, long(8)),
        (277, shorts(&[bands as u16])),
        (278, long(picture.height())),
        (279, long(data.len() as u32)),
        (284, shorts(&[1])),
    ];
    if bands > 1 {
        tags.push((338, shorts(&vec![0; bands - 1])));
    }
    tags.push((339, shorts(&vec![format; bands])));
    tags.push((33550, doubles(&[place.per_column[0], -place.per_row[1], 0.0])));
    tags.push((33922, doubles(&[0.0, 0.0, 0.0, corner[0], corner[1], 0.0])));
    tags.push((34735, shorts(&[1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32632])));
    if !names.is_empty() {
        tags.push((42112, (2, xml.len() as u32, xml)));
    }
    tags.sort_by_key(|(tag, _)| *tag);
    data.resize(data.len().next_multiple_of(2), 0);
    let directory = 8 + data.len();
    let mut behind = directory + 2 + 12 * tags.len() + 4;
    let mut file = b"II*\0".to_vec();
    file.extend((directory as u32).to_le_bytes());
    file.extend(data);
    file.extend((tags.len() as u16).to_le_bytes());
    let mut values: Vec<u8> = Vec::new();
    for (tag, (kind, count, mut bytes)) in tags {
        file.extend(tag.to_le_bytes());
        file.extend(kind.to_le_bytes());
        file.extend(count.to_le_bytes());
        if bytes.len() > 4 {
            file.extend((behind as u32).to_le_bytes());
            bytes.resize(bytes.len().next_multiple_of(2), 0);
            behind += bytes.len();
            values.extend(bytes);
        } else {
            bytes.resize(4, 0);
            file.extend(bytes);
        }
    }
    file.extend(0u32.to_le_bytes());
    file.extend(values);
    file
}

#[test]
fn closed_rows_have_cover_and_gaps_in_place_of_plants() {
    let dir = tempfile::tempdir().unwrap();
    let project = dir.path().join("field");
    fs::create_dir(&project).unwrap();
    // Eight rows 30 px (45 cm) apart and 20 px wide with ragged edges; one row in two lacks 100 of 600 px (1.5 m).
    let map = image::RgbImage::from_fn(600, 240, |u, v| {
        let (row, away) = (v / 30, (v % 30).abs_diff(15));
        let edge = 9 + (u * 7 + row * 13) % 23 / 8;
        let is_gap = row % 2 == 1 && (200..300).contains(&u);
        let shade = ((u * 31 + v * 17) % 13) as u8;
        match away < edge && !is_gap {
            true => image::Rgb([60 + shade, 140 + shade, 50 + shade]),
            false => image::Rgb([140 + shade, 110 + shade, 80 + shade]),
        }
    });
    write(&project.join("map.tif"), &map, placed(32632, CrsKind::Projected, [1.0; 2]));
    fs::write(project.join("rowgram.toml"), "[project]\northo = \"map.tif\"\n").unwrap();
    let done = rowgram(dir.path(), "run field");
    assert_eq!(done.code, 0, "{}{}", done.stdout, done.stderr);
    assert!(
        done.stdout.contains("not told apart: leaves have closed along 8 rows"),
        "{}",
        done.stdout
    );
    assert!(done.stderr.contains("nothing tells plants apart"), "{}", done.stderr);
    let field = &table(&project.join("rowgram/plots/traits.csv"))["field"];
    assert!(
        ["plants", "missing_plants", "plant_spacing_m"].iter().all(|&name| field[name].is_empty())
    );
    let [cover, gaps] = ["row_cover", "row_gap_share"].map(|name| number(field, name));
    // Half of the rows lack a sixth.
    assert!(
        (cover - 11.0 / 12.0).abs() < 0.01 && (gaps - 1.0 / 12.0).abs() < 0.01,
        "{cover} {gaps}"
    );
}

#[test]
fn plots_have_their_cover_without_weeds_between_rows() {
    let dir = tempfile::tempdir().unwrap();
    let project = dir.path().join("field");
    fs::create_dir(&project).unwrap();
    // Ten rows of 29 plants 60 px (90 cm) apart, and 30 weeds as large as plants halfway between them, discs all.
    let jitter = |k: u32| (k * 37 + 11) % 7;
    let plants = (0..290).map(|k| [27 + 30 * (k % 29) + jitter(k), 40 + 60 * (k / 29)]);
    let weeds = (0..30).map(|k| [40 + 28 * k, 70 + 60 * (k * 7 % 9)]);
    let soil = |u: u32, v: u32| [140, 110, 80].map(|c| c + ((u * 31 + v * 17) % 13) as u8);
    let mut map = image::RgbImage::from_fn(900, 620, |u, v| image::Rgb(soil(u, v)));
    let mut disc_px = 0;
    for [x, y] in plants.chain(weeds) {
        disc_px = 0;
        for (u, v) in (y - 6..y + 7).flat_map(|v| (x - 6..x + 7).map(move |u| (u, v))) {
            if u.abs_diff(x).pow(2) + v.abs_diff(y).pow(2) < 36 {
                map.put_pixel(u, v, image::Rgb([60, 140, 50].map(|c| c + (u % 13) as u8)));
                disc_px += 1;
            }
        }
    }
    write(&project.join("map.tif"), &map, placed(32632, CrsKind::Projected, [1.0; 2]));
    fs::write(project.join("rowgram.toml"), "[project]\northo = \"map.tif\"\n").unwrap();
    let done = rowgram(dir.path(), "run field");
    assert_eq!(done.code, 0, "{}{}", done.stdout, done.stderr);
    let field = &table(&project.join("rowgram/plots/traits.csv"))["field"];
    let of = |name: &str| number(field, name);
    assert_eq!((of("plants"), of("weeds")), (290.0, 30.0));
    let share = |discs: u32| f64::from(discs * disc_px) / (900.0 * 620.0);
    for (name, discs) in [("canopy_cover", 320), ("crop_cover", 290)] {
        assert!(
            (of(name) / share(discs) - 1.0).abs() < 0.03,
            "{name} {} {}",
            of(name),
            share(discs)
        );
    }
    let weeds = fs::read_to_string(project.join("rowgram/locate/weeds.csv")).unwrap();
    assert_eq!(weeds.lines().count(), 31);
}
