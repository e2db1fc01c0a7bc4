//! One field as other people may have it, spoiled in several ways at once and at random: system, grid, frame, bands, container of the
//! orthomosaic; system, names and geometry of the plots. Its traits are those of the plain field, or what is wrong is refused.
//!
//! `FUZZ_SECONDS` says for how long, `FUZZ_SEED` (1) which cases; without it there are [`CASES`].

use crate::{
    maps::{GSD_M, LATITUDE, Samples, collection, number, picture, placed, plot, tiff, traits},
    program::rowgram,
};
use image::{Rgb, RgbImage};
use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    crs,
    io::{FileError, geotiff},
    raster::{
        georeference::{CrsKind, Georeference},
        window::Window,
    },
};
use serde_json::{Value, json};
use std::{collections::BTreeMap, fs, path::Path, time::Instant};

const CASES: usize = 12;

/// Where the raster lies.
#[derive(Debug, Clone, Copy, PartialEq)]
enum System {
    Utm,
    Web,
    Degrees,
    Turned,
    SouthUp,
    Oblong,
}

/// What is around the field.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Frame {
    Nothing,
    Colour([u8; 3]),
    Transparent,
}

/// How its pixels are stored.
#[derive(Debug, Clone, Copy)]
enum Stored {
    GeoTiff,
    /// With a world file and a `.prj`.
    Png,
    /// With bands in another order or unit.
    Bands(Samples, &'static [&'static str]),
}

/// What the coordinates of the plots are.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Plots {
    AsTheMap,
    /// Longitude and latitude without a word, as the standard has it.
    Degrees,
    /// The next zone, said.
    NextZone,
    /// The next zone, not said.
    NextZoneUnsaid,
    Exchanged,
    LatitudeFirst,
}

impl Plots {
    fn is_refused(self) -> bool {
        matches!(self, Plots::NextZoneUnsaid | Plots::Exchanged | Plots::LatitudeFirst)
    }
}

/// What names the plots.
const NAMES: [&str; 4] = ["plot", "PlotID", "plot_id", "name"];

#[derive(Debug, Clone, Copy)]
struct Case {
    system: System,
    frame: Frame,
    stored: Stored,
    plots: Plots,
    name: &'static str,
    /// Features that are none: without geometry, a point.
    odd: bool,
}

impl Case {
    const PLAIN: Case = Case {
        system: System::Utm,
        frame: Frame::Nothing,
        stored: Stored::GeoTiff,
        plots: Plots::AsTheMap,
        name: "plot",
        odd: false,
    };

    fn draw(rng: &mut ChaCha8Rng) -> Case {
        use System::{Degrees, Oblong, SouthUp, Turned, Utm, Web};
        let mut of = |share: f64| rng.random::<f64>() < share;
        let (framed, banded, png, odd) = (of(0.5), of(0.3), of(0.2), of(0.4));
        let system = *[Utm, Utm, Web, Degrees, Turned, SouthUp, Oblong].choose(rng).unwrap();
        let frames = [
            Frame::Colour([0; 3]),
            Frame::Colour([255; 3]),
            Frame::Colour([255, 0, 255]),
            Frame::Colour([128; 3]),
            Frame::Transparent,
        ];
        let frame = if framed { *frames.choose(rng).unwrap() } else { Frame::Nothing };
        let bands = [
            (Samples::Bytes([2, 1, 0], true), &["Blue", "Green", "Red", "NIR"][..]),
            (Samples::Bytes([1, 2, 0], true), &["Green", "Blue", "Red", "RedEdge"]),
            (Samples::Reflectance, &[]),
            (Samples::Share, &["red", "green", "blue"]),
        ];
        let (samples, names) = *bands.choose(rng).unwrap();
        // These are written in one system, without transparency.
        let (system, frame, stored) = match (banded, png) {
            (true, _) => (Utm, Frame::Nothing, Stored::Bands(samples, names)),
            (_, true) if system != Web && system != Degrees => (system, frame, Stored::Png),
            _ => (system, frame, Stored::GeoTiff),
        };
        let plots = [
            Plots::AsTheMap,
            Plots::AsTheMap,
            Plots::Degrees,
            Plots::NextZone,
            Plots::NextZoneUnsaid,
            Plots::Exchanged,
            Plots::LatitudeFirst,
        ];
        let mut plots = *plots.choose(rng).unwrap();
        if system == Degrees && plots != Plots::NextZone {
            plots = Plots::AsTheMap;
        }
        Case { system, frame, stored, plots, name: NAMES.choose(rng).unwrap(), odd }
    }

    fn place(&self) -> Georeference {
        let utm = placed(32632, CrsKind::Projected, [1.0; 2]);
        match self.system {
            System::Utm => utm,
            System::Web => placed(3857, CrsKind::Projected, [1.0 / LATITUDE.to_radians().cos(); 2]),
            System::Degrees => placed(4326, CrsKind::Geographic, [1.0 / 73_903.7, 1.0 / 111_200.4]),
            System::Turned => {
                let (sin, cos) = 0.35f64.sin_cos();
                let per_column = [GSD_M * cos, GSD_M * sin];
                Georeference { per_column, per_row: [GSD_M * sin, -GSD_M * cos], ..utm }
            }
            System::SouthUp => Georeference { per_row: [0.0, GSD_M], ..utm },
            System::Oblong => Georeference { per_row: [0.0, -2.0 * GSD_M], ..utm },
        }
    }

    /// Writes the project.
    fn lay_out(&self, project: &Path, square: &RgbImage) {
        fs::create_dir(project).unwrap();
        let place = self.place();
        let picture = match self.system {
            System::Oblong => RgbImage::from_fn(square.width(), square.height() / 2, |u, v| {
                *square.get_pixel(u, 2 * v)
            }),
            _ => square.clone(),
        };
        // The field is at the same place in a larger raster.
        let margin = if self.frame == Frame::Nothing { [0, 0] } else { [150, 90] };
        let [width, height] = [picture.width() + 2 * margin[0], picture.height() + 2 * margin[1]];
        let around = match self.frame {
            Frame::Colour(colour) => colour,
            _ => [0; 3],
        };
        let inside = |u: u32, v: u32| {
            let [u, v] = [u.wrapping_sub(margin[0]), v.wrapping_sub(margin[1])];
            (u < picture.width() && v < picture.height()).then(|| *picture.get_pixel(u, v))
        };
        let framed = RgbImage::from_fn(width, height, |u, v| inside(u, v).unwrap_or(Rgb(around)));
        let corner = Georeference { origin: place.map(margin.map(|m| -f64::from(m))), ..place };
        match self.stored {
            Stored::Bands(samples, names) => {
                fs::write(project.join("ortho.tif"), tiff(&framed, corner, samples, names))
                    .unwrap();
            }
            Stored::Png => {
                let path = project.join("ortho.png");
                match self.frame {
                    Frame::Transparent => {
                        let alpha = |u, v| match inside(u, v) {
                            Some(Rgb([r, g, b])) => image::Rgba([r, g, b, 255]),
                            None => image::Rgba([0; 4]),
                        };
                        image::RgbaImage::from_fn(width, height, alpha).save(&path).unwrap();
                    }
                    _ => framed.save(&path).unwrap(),
                }
                let [[a, d], [b, e], [x, y]] = [corner.per_column, corner.per_row, corner.origin];
                let numbers = [a, d, b, e, x, y].map(|x| format!("{x:.12}")).join("\n");
                fs::write(project.join("ortho.pgw"), numbers).unwrap();
                fs::write(project.join("ortho.prj"), ZONE_32).unwrap();
                fs::write(project.join("rowgram.toml"), "[project]\northo = \"ortho.png\"\n")
                    .unwrap();
            }
            Stored::GeoTiff => {
                let has_alpha = self.frame == Frame::Transparent;
                let layout = geotiff::Layout {
                    width: width as usize,
                    height: height as usize,
                    colour: if has_alpha { geotiff::Colour::Rgba } else { geotiff::Colour::Rgb },
                    georeference: Some(corner),
                    nodata: None,
                };
                let samples = match has_alpha {
                    false => framed.into_raw(),
                    true => (0..height)
                        .flat_map(|v| (0..width).map(move |u| (u, v)))
                        .flat_map(|(u, v)| match inside(u, v) {
                            Some(Rgb([r, g, b])) => [r, g, b, 255],
                            None => [0; 4],
                        })
                        .collect(),
                };
                let path = project.join("ortho.tif");
                geotiff::write::<u8, FileError>(&path, false, &layout, |writer| {
                    writer.put(Window::whole(width as usize, height as usize), &samples)
                })
                .unwrap();
            }
        }
        fs::write(project.join("plots.geojson"), self.plots(&picture, place)).unwrap();
    }

    fn plots(&self, picture: &RgbImage, place: Georeference) -> String {
        let name = |id: u32| match self.name {
            // As a spreadsheet has it.
            "PlotID" => json!({"PlotID": f64::from(id), "name": "B73"}),
            key => json!({key: id.to_string(), "genotype": "B73"}),
        };
        let mut features = vec![
            plot(picture, place, [0.0, 0.5], name(101)),
            plot(picture, place, [0.5, 1.0], name(102)),
        ];
        let map = place.crs;
        let system = |code: u32| crs::Crs::of_code(code).unwrap();
        let own = map.system().unwrap();
        let to_degrees = |[x, y]: [f64; 2]| own.to_wgs84(x, y).unwrap();
        let next = |at: [f64; 2]| {
            let [latitude, longitude] = to_degrees(at);
            system(32633).from_wgs84(latitude, longitude).unwrap()
        };
        let moved = |at: [f64; 2]| match self.plots {
            Plots::AsTheMap => at,
            Plots::Degrees => {
                let [latitude, longitude] = to_degrees(at);
                [longitude, latitude]
            }
            Plots::NextZone | Plots::NextZoneUnsaid => next(at),
            Plots::Exchanged => [at[1], at[0]],
            Plots::LatitudeFirst => to_degrees(at),
        };
        for feature in &mut features {
            for at in feature["geometry"]["coordinates"][0].as_array_mut().unwrap() {
                let [x, y] = moved([at[0].as_f64().unwrap(), at[1].as_f64().unwrap()]);
                *at = json!([x, y]);
            }
        }
        if self.odd {
            let nothing = |id: u32, geometry: Value| json!({"type": "Feature", "properties": name(id), "geometry": geometry});
            features.push(nothing(108, Value::Null));
            features.push(nothing(109, json!({"type": "Point", "coordinates": [1.0, 2.0]})));
        }
        let code = match self.plots {
            Plots::AsTheMap | Plots::Exchanged => map.epsg,
            Plots::NextZone => Some(32633),
            Plots::Degrees | Plots::NextZoneUnsaid | Plots::LatitudeFirst => None,
        };
        collection(code, features)
    }

    /// What is wrong with what comes out, where something is.
    fn judge(
        &self,
        project: &Path,
        plain: &BTreeMap<String, BTreeMap<String, String>>,
    ) -> Option<String> {
        if self.plots.is_refused() {
            let run = rowgram(project, "run . -q");
            let doctor = rowgram(project, "doctor .");
            let refused =
                run.code == 2 && doctor.code != 0 && !project.join("rowgram/segment").exists();
            return (!refused).then(|| format!("not refused: {} {}", run.code, run.stderr));
        }
        let doctor = rowgram(project, "doctor .");
        if doctor.code != 0 {
            return Some(format!("doctor refuses it: {}", doctor.stdout));
        }
        let found = traits(project, "");
        let names: Vec<_> = found.keys().collect();
        if names != ["101", "102"] {
            return Some(format!("plots are {names:?}"));
        }
        // Half of the rows of pixels show a plant less well; a frame, other units of colour and interpolated borders move some pixels.
        let is_blurred = self.system == System::Oblong
            || matches!(self.stored, Stored::Bands(Samples::Reflectance | Samples::Share, _));
        let by = if is_blurred { 0.06 } else { 0.03 };
        let mut wrong = Vec::new();
        for (plot, expected) in plain {
            for (name, by) in [
                ("area_m2", 0.01),
                ("plants", by),
                ("plants_per_ha", by),
                ("plant_spacing_m", by),
                ("canopy_cover", 0.1),
            ] {
                let [a, b] = [&found[plot], expected].map(|of| number(of, name));
                if (a / b - 1.0).abs() > by {
                    wrong.push(format!("{plot} {name} {a}, expected {b}"));
                }
            }
        }
        (!wrong.is_empty()).then(|| wrong.join("; "))
    }
}

/// UTM zone 32 north as Esri writes it.
const ZONE_32: &str = r#"PROJCS["WGS_1984_UTM_Zone_32N",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",9.0],PARAMETER["Scale_Factor",0.9996],PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]"#;

#[test]
#[ignore = "slow; a dozen projects"]
fn a_field_spoiled_at_random_is_right_or_refused() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let (begin, seconds) = (Instant::now(), number("FUZZ_SECONDS"));
    let mut rng = ChaCha8Rng::seed_from_u64(number("FUZZ_SEED").unwrap_or(1));
    let folder = tempfile::tempdir().unwrap();
    let square = picture(folder.path());
    let project = folder.path().join("plain");
    Case::PLAIN.lay_out(&project, &square);
    let plain = traits(&project, "");
    let mut wrong = Vec::new();
    let mut done = 0;
    let more = |done: usize| match seconds {
        Some(seconds) => begin.elapsed().as_secs() < seconds,
        None => done < CASES,
    };
    while more(done) {
        let case = Case::draw(&mut rng);
        let project = folder.path().join("field");
        case.lay_out(&project, &square);
        if let Some(why) = case.judge(&project, &plain) {
            println!("{case:?}: {why}");
            wrong.push(case);
        }
        fs::remove_dir_all(&project).unwrap();
        done += 1;
    }
    println!("{done} cases");
    assert!(wrong.is_empty(), "{} of {done}: {wrong:#?}", wrong.len());
}
