//! Heights that another program or sensor made: the surface and the ground of a field beside its orthomosaic give the height of its plants.

use crate::{
    maps::{GSD_M, LATITUDE, LONGITUDE, collection, picture, plot, traits, write},
    program::rowgram,
};
use image::RgbImage;
use rowgram::{
    crs,
    io::{FileError, geotiff},
    raster::{
        georeference::{Crs, Georeference, Transfer},
        window::Window,
    },
};
use serde_json::json;
use std::{fs, path::Path};

/// Side of the cells of heights, metres.
const CELL_M: f64 = 0.03;
/// Height of the leaves over the ground, metres.
const PLANT_M: f64 = 0.4;
/// Height of the geoid over the ellipsoid, metres.
const GEOID_M: f64 = 47.25;

/// A field with what stands on it.
struct Field {
    picture: RgbImage,
    leaves: image::GrayImage,
    place: Georeference,
}

impl Field {
    fn new(folder: &Path) -> Field {
        let picture = picture(folder);
        let leaves = image::open(folder.join("grown/mask.png")).unwrap().into_luma8();
        let at = crs::Crs::of_code(32632).unwrap().from_wgs84(LATITUDE, LONGITUDE).unwrap();
        Field { picture, leaves, place: Georeference::north_up(at, GSD_M, Crs::projected(32632)) }
    }

    /// A slope with ridges.
    fn ground_m(&self, [x, y]: [f64; 2]) -> f64 {
        let [u, v] = [x - self.place.origin[0], self.place.origin[1] - y];
        400.0 + 0.03 * u - 0.02 * v + 0.02 * (u / 2.0).sin()
    }

    fn surface_m(&self, at: [f64; 2]) -> f64 {
        let [u, v] = self.place.pixel(at).unwrap().map(|x| x.round().max(0.0) as u32);
        let is_leaf = u < self.leaves.width()
            && v < self.leaves.height()
            && self.leaves.get_pixel(u, v).0[0] > 0;
        self.ground_m(at) + if is_leaf { PLANT_M } else { 0.0 }
    }

    /// Metres from west to east and from north to south.
    fn size_m(&self) -> [f64; 2] {
        [self.picture.width(), self.picture.height()].map(|n| GSD_M * f64::from(n))
    }

    /// A raster of heights over the field and a little more, in another system.
    fn raster(&self, path: &Path, (code, cell_m): (u32, f64), height_m: impl Fn([f64; 2]) -> f64) {
        let there = Crs::projected(code);
        let back = Transfer::between(&there, &self.place.crs);
        let corner = Transfer::between(&self.place.crs, &there).at(self.place.origin).unwrap();
        let size = self.size_m().map(|side| ((side + 4.0) / cell_m) as usize);
        let origin = [corner[0] - 2.0, corner[1] + 2.0];
        let place = Georeference::north_up(origin, cell_m, there);
        let value = |at: usize| {
            let cell = [at % size[0], at / size[0]].map(|n| n as f64);
            height_m(back.at(place.map(cell)).unwrap()) as f32
        };
        let values: Vec<f32> = (0..size[0] * size[1]).map(value).collect();
        let layout = geotiff::Layout {
            width: size[0],
            height: size[1],
            colour: geotiff::Colour::Values,
            georeference: Some(place),
            nodata: Some(-9999.0),
        };
        geotiff::write::<f32, FileError>(path, true, &layout, |writer| {
            writer.put(Window::whole(size[0], size[1]), &values)
        })
        .unwrap();
    }

    /// A cloud, three points on each cell, those of the ground classified where `is_classified`.
    fn cloud(&self, path: &Path, is_classified: bool) {
        let mut builder = las::Builder::from((1, 4));
        builder.point_format = las::point::Format::new(7).unwrap();
        builder.point_format.is_compressed = true;
        let axis = |offset: f64| las::Transform { scale: 1e-3, offset: offset.floor() };
        let [x, y] = self.place.origin;
        builder.transforms = las::Vector { x: axis(x), y: axis(y), z: axis(400.0) };
        let file = fs::File::create(path).unwrap();
        let mut writer = las::Writer::new(file, builder.into_header().unwrap()).unwrap();
        let [width, height] = self.size_m().map(|side| (side / 0.02) as usize);
        for at in 0..width * height {
            let place = [x + 0.02 * (at % width) as f64, y - 0.02 * (at / width) as f64];
            let (z, ground) = (self.surface_m(place), self.ground_m(place));
            let [u, v] = self.place.pixel(place).unwrap().map(|x| x.round() as u32);
            let on = [u.min(self.picture.width() - 1), v.min(self.picture.height() - 1)];
            let [red, green, blue] =
                self.picture.get_pixel(on[0], on[1]).0.map(|c| u16::from(c) * 257);
            let class = if is_classified && z == ground { 2 } else { 1 };
            let mut put = |z: f64, class: u8| {
                let point = las::Point {
                    x: place[0],
                    y: place[1],
                    z,
                    classification: las::point::Classification::new(class).unwrap(),
                    color: Some(las::Color { red, green, blue }),
                    gps_time: Some(0.0),
                    ..las::Point::default()
                };
                writer.write_point(point).unwrap();
            };
            put(z, class);
            // Birds.
            if at % 997 == 0 {
                put(z + 30.0, 18);
            }
        }
        writer.close().unwrap();
    }

    /// A project with the orthomosaic and two plots.
    fn project(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        write(&folder.join("ortho.tif"), &self.picture, self.place);
        let halves = [("1", [0.0, 0.5]), ("2", [0.5, 1.0])];
        let plots =
            halves.map(|(name, part)| plot(&self.picture, self.place, part, json!({"plot": name})));
        let text = collection(Some(32632), plots.to_vec());
        fs::write(folder.join("plots.geojson"), text).unwrap();
    }
}

/// A grid of GTX with the same height everywhere.
fn geoid(path: &Path, height_m: f32) {
    let mut bytes: Vec<u8> = [LATITUDE.floor() - 1.0, LONGITUDE.floor() - 1.0, 1.0, 1.0]
        .iter()
        .flat_map(|x: &f64| x.to_be_bytes())
        .collect();
    bytes.extend([4i32, 4].iter().flat_map(|n| n.to_be_bytes()));
    bytes.extend((0..16).flat_map(|_| height_m.to_be_bytes()));
    fs::write(path, bytes).unwrap();
}

/// The 95th percentile of the height of the canopy of both plots.
fn heights(project: &Path, words: &str) -> [f64; 2] {
    let table = traits(project, words);
    ["1", "2"].map(|plot| table[plot]["canopy_height_m"].parse().unwrap())
}

#[test]
#[ignore = "slow; a field of other people's heights in nine forms"]
fn heights_of_other_programs_give_the_height_of_plants() {
    let folder = tempfile::tempdir().unwrap();
    let field = Field::new(folder.path());
    let surface = |at: [f64; 2]| field.surface_m(at);
    let ground = |at: [f64; 2]| field.ground_m(at);
    let close = |name: &str, found: [f64; 2], within_m: f64| {
        println!("{name}: {found:?}");
        for height in found {
            assert!((height - PLANT_M).abs() <= within_m, "{name}: {found:?}");
        }
    };
    let at = |name: &str| folder.path().join(name);
    let new = |name: &str| {
        field.project(&at(name));
        at(name)
    };

    // Beside the orthomosaic, by their names; each plot is half leaf, so its percentile is that of a leaf.
    let beside = new("beside");
    field.raster(&beside.join("north_dsm.tif"), (32632, CELL_M), surface);
    field.raster(&beside.join("north_dtm.tif"), (32632, CELL_M), ground);
    close("beside", heights(&beside, ""), 0.001);
    let doctor = rowgram(&beside, "doctor .");
    assert!(doctor.stdout.contains("north_dsm.tif"), "{}", doctor.stdout);
    // Cells are those of the file, and so are heights.
    let own = geotiff::Reader::open(&beside.join("rowgram/surface/dsm.tif")).unwrap();
    let given = geotiff::Reader::open(&beside.join("north_dsm.tif")).unwrap();
    assert_eq!(own.georeference(), given.georeference());
    let all = Window::whole(given.width(), given.height());
    assert_eq!(own.read_f32(all).unwrap(), given.read_f32(all).unwrap());
    assert!(!beside.join("rowgram/surface/photos.tif").exists(), "no photo was looked at");

    // As the folder of another program has them.
    let odm = at("odm");
    fs::create_dir_all(odm.join("odm_orthophoto")).unwrap();
    fs::create_dir_all(odm.join("odm_dem")).unwrap();
    field.project(&odm.join("odm_orthophoto"));
    fs::rename(odm.join("odm_orthophoto/plots.geojson"), odm.join("plots.geojson")).unwrap();
    field.raster(&odm.join("odm_dem/dsm.tif"), (32632, CELL_M), surface);
    field.raster(&odm.join("odm_dem/dtm.tif"), (32632, 0.5), ground);
    close("odm", heights(&odm, ""), 0.003);

    // In the next zone, in Web Mercator: through longitude and latitude.
    let elsewhere = new("elsewhere");
    field.raster(&elsewhere.join("dsm.tif"), (32631, CELL_M), surface);
    field.raster(&elsewhere.join("dtm.tif"), (3857, 0.3), ground);
    close("elsewhere", heights(&elsewhere, ""), 0.003);

    // Without a ground: fitted to what is bare in the orthomosaic.
    let fitted = new("fitted");
    field.raster(&fitted.join("dsm.tif"), (32632, CELL_M), surface);
    close("fitted", heights(&fitted, ""), 0.02);

    // Clouds: the ground by its class, by colours of the orthomosaic.
    for (name, is_classified) in [("classes", true), ("colours", false)] {
        let cloud = new(name);
        field.cloud(&cloud.join("points.laz"), is_classified);
        fs::write(cloud.join("rowgram.toml"), "[surface]\ndsm = \"points.laz\"\n").unwrap();
        close(name, heights(&cloud, ""), 0.02);
    }
    // The same cloud as the ground of a raster.
    let scan = new("scan");
    fs::copy(at("classes/points.laz"), scan.join("scan.laz")).unwrap();
    field.raster(&scan.join("dsm.tif"), (32632, CELL_M), surface);
    fs::write(scan.join("rowgram.toml"), "[surface]\ndtm = \"scan.laz\"\n").unwrap();
    close("scan", heights(&scan, ""), 0.02);

    // Heights of two vertical datums: a warning, and brought together by the geoid.
    let mixed = new("mixed");
    field.raster(&mixed.join("dsm.tif"), (32632, CELL_M), surface);
    field.raster(&mixed.join("dtm.tif"), (32632, 0.5), |at| ground(at) - GEOID_M);
    let run = rowgram(&mixed, "run . --until surface");
    assert!(run.stderr.contains("two vertical datums"), "{}", run.stderr);
    geoid(&mixed.join("geoid.gtx"), GEOID_M as f32);
    close("mixed", heights(&mixed, "--set surface.geoid=geoid.gtx"), 0.003);
    let other = new("other");
    field.raster(&other.join("dsm.tif"), (32632, CELL_M), surface);
    field.raster(&other.join("dtm.tif"), (32632, 0.5), |at| ground(at) + GEOID_M);
    fs::copy(mixed.join("geoid.gtx"), other.join("geoid.gtx")).unwrap();
    let words = "--set surface.geoid=geoid.gtx --set surface.ellipsoidal=dtm";
    close("other", heights(&other, words), 0.003);
}

#[test]
fn heights_that_are_none_are_refused_with_their_file() {
    let folder = tempfile::tempdir().unwrap();
    let field = Field::new(folder.path());
    let project = folder.path().join("field");
    field.project(&project);
    let surface = |at: [f64; 2]| field.surface_m(at);
    field.raster(&project.join("good.tif"), (32632, 0.1), surface);
    // A kilometre further east.
    let moved = Field {
        place: field.place.from_pixel((1000.0 / GSD_M) as usize, 0),
        picture: field.picture.clone(),
        leaves: field.leaves.clone(),
    };
    moved.raster(&project.join("moved.tif"), (32632, 0.1), |_| 400.0);
    field.raster(&project.join("nothing.tif"), (32632, 0.1), |_| -9999.0);
    fs::write(project.join("empty.laz"), "").unwrap();
    let cloud = project.join("unclassified.laz");
    field.cloud(&cloud, false);
    fs::write(project.join("short.gtx"), [0; 44]).unwrap();
    geoid(&project.join("geoid.gtx"), 40.0);
    for (words, file, said) in [
        ("--dsm ortho.tif", "ortho.tif", "one band"),
        ("--dsm away.tif", "away.tif", ""),
        (
            "--dsm moved.tif",
            "moved.tif",
            "shows nothing of the orthomosaic, whose middle is 1000 m away",
        ),
        ("--dsm nothing.tif", "nothing.tif", "none of its cells has a height"),
        ("--dsm empty.laz", "empty.laz", "no LAS or LAZ file"),
        ("--dsm good.tif --dtm moved.tif", "moved.tif", "has no height where good.tif has one"),
        ("--dsm good.tif --dtm unclassified.laz", "unclassified.laz", "class 2"),
        ("--dsm good.tif --dtm good.tif --geoid short.gtx", "short.gtx", "GTX"),
        ("--dsm good.tif --geoid geoid.gtx", "", "there is no dtm"),
        ("--dsm good.tif --cloud", "good.tif", "cloud"),
    ] {
        let run = rowgram(&project, &format!("surface . {words}"));
        assert_eq!(run.code, 2, "{words}: {}", run.stderr);
        assert!(run.stderr.contains(file) && run.stderr.contains(said), "{words}: {}", run.stderr);
    }
}

#[test]
fn heights_far_from_all_others_are_left_out_and_a_side_file_counts() {
    let folder = tempfile::tempdir().unwrap();
    let field = Field::new(folder.path());
    let project = folder.path().join("field");
    field.project(&project);
    let [x, y] = field.place.origin;
    let is_bird = |at: [f64; 2]| at[0] - x < 0.5 && y - at[1] < 0.5;
    let surface = |at: [f64; 2]| if is_bird(at) { 900.0 } else { field.surface_m(at) };
    field.raster(&project.join("dsm.tif"), (32632, 0.1), surface);
    field.raster(&project.join("dtm.tif"), (32632, 0.5), |at| field.ground_m(at));
    let said = || {
        let run = rowgram(&project, "surface .");
        assert_eq!(run.code, 0, "{}", run.stderr);
        ["far from all others", "kept"].map(|part| run.stderr.contains(part))
    };
    assert_eq!(said(), [true, false]);
    assert_eq!(said(), [true, true]);
    // What GDAL writes beside a raster counts as the raster does.
    let xml = "<PAMDataset><PAMRasterBand band=\"1\"><NoDataValue>900</NoDataValue></PAMRasterBand></PAMDataset>";
    fs::write(project.join("dsm.tif.aux.xml"), xml).unwrap();
    assert_eq!(said(), [false, false]);
    assert_eq!(said(), [false, true]);
}
