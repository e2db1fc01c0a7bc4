//! An orthomosaic of five bands with known reflectances, as a project folder with its truth.

use super::{config_text, encode_png, refused};
use data_synth::{
    scenario::Scenario,
    spectrum::{self, BANDS, PlotTruth, Spectra},
};
use image::ExtendedColorType;
use rowgram_base::error::Error;
use rowgram_files::{
    geotiff::{self, Colour, Layout, Sample, Writer},
    polygons::{self, Outline},
};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{
    georeference::{Crs, Georeference},
    spectral::Band,
    window::Window,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What the samples of the orthomosaic are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MapSamples {
    /// 16 bits, reflectance times 10,000.
    #[default]
    U16,
    /// Floating point, reflectance.
    Float,
}

rowgram_base::choices!(MapSamples: U16, Float);

/// How the orthomosaic is written.
#[derive(Debug, Clone, PartialEq)]
pub struct MapOptions {
    /// Its samples.
    pub samples: MapSamples,
    /// Its bands: blue, green, red, red edge and near infrared in any order.
    pub bands: Vec<Band>,
    /// Whether the file names them.
    pub named: bool,
}

impl Default for MapOptions {
    fn default() -> MapOptions {
        MapOptions { samples: MapSamples::default(), bands: ORDER.to_vec(), named: true }
    }
}

/// What an orthomosaic holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MapOutcome {
    /// Number of plants.
    pub plants: usize,
    /// Number of plots.
    pub plots: usize,
    /// `[width, height]`, pixels.
    pub size_px: [usize; 2],
}

/// The bands of the truth.
const ORDER: [Band; BANDS] = [Band::Blue, Band::Green, Band::Red, Band::RedEdge, Band::Nir];
/// The upper left corner, metres, in UTM zone 16 north.
const CORNER_M: [f64; 2] = [500_000.0, 4_480_000.0];
const EPSG: u32 = 32_616;
/// Width of the frame without data, pixels.
const FRAME_PX: usize = 12;

/// Writes `ortho.tif`, `plots.geojson` and `field.toml` into a folder, which is made if missing, and below `truth/`: `plots.csv` (cover,
/// NDVI and NDRE of all ground and of the leaves), `plants.csv` (place, and NDVI of what is seen of each) and `mask.png`.
///
/// # Errors
/// A parameter that cannot be used, bands that are not those five, a file that exists unless `force`, and writing.
pub fn write_map(
    scenario: &Scenario,
    options: &MapOptions,
    folder: &Path,
    force: bool,
) -> Result<MapOutcome, Error> {
    scenario.check().map_err(refused)?;
    let place_of = |band: &Band| ORDER.iter().position(|of| of == band);
    let order: Option<Vec<usize>> = options.bands.iter().map(place_of).collect();
    let is_whole =
        |order: &Vec<usize>| order.len() == BANDS && (0..BANDS).all(|k| order.contains(&k));
    let order = order.filter(is_whole).ok_or_else(|| {
        Error::Argument("bands: expected blue, green, red, red-edge, nir in any order".to_owned())
    })?;
    let truth = folder.join("truth");
    output::make_folder(&truth)?;
    let config = config_text(scenario)?;
    let scene = scenario.build().map_err(refused)?;
    let spectra = spectrum::spectra(&scene);
    let place = Georeference::north_up(CORNER_M, scenario.field.gsd_m, Crs::projected(EPSG));
    let ortho = folder.join("ortho.tif");
    match options.samples {
        MapSamples::U16 => {
            let layout = layout(&spectra, place, 65_535.0);
            let sample = |x: f32| (f64::from(x) * 1e4).round() as u16;
            write(&ortho, force, &layout, &samples(&spectra, &order, u16::MAX, sample), options)?;
        }
        MapSamples::Float => {
            let layout = layout(&spectra, place, -10_000.0);
            write(&ortho, force, &layout, &samples(&spectra, &order, -1e4, |x| x), options)?;
        }
    }
    let text =
        |path: &Path, text: &str| output::write(path, force, |out| out.write_all(text.as_bytes()));
    text(&folder.join("field.toml"), &config)?;
    let outline = |(number, plot): (usize, &PlotTruth)| Outline {
        name: (number + 1).to_string(),
        rings: vec![plot.corners_px.iter().map(|&at| place.map(at)).collect()],
        attributes: Vec::new(),
    };
    let outlines: Vec<Outline> = spectra.plots.iter().enumerate().map(outline).collect();
    polygons::write(&folder.join("plots.geojson"), force, &outlines, Some(place.crs))?;
    text(&truth.join("plots.csv"), &plot_table(&spectra.plots))?;
    let mut table = "easting_m,northing_m,u_px,v_px,plot,ndvi_leaf\n".to_owned();
    for (plant, ndvi) in scene.field.plants.iter().zip(&spectra.plants_ndvi) {
        let [u, v] = [plant.u_px, plant.v_px];
        let [easting, northing] = place.map([u, v]);
        let ndvi = ndvi.map(|ndvi| format!("{ndvi:.5}")).unwrap_or_default();
        table += &format!("{easting:.4},{northing:.4},{u:.4},{v:.4},{},{ndvi}\n", plant.plot + 1);
    }
    text(&truth.join("plants.csv"), &table)?;
    let size = (spectra.width as u32, spectra.height as u32);
    let mask: Vec<u8> = spectra.is_leaf.iter().map(|&leaf| 255 * u8::from(leaf)).collect();
    output::write(&truth.join("mask.png"), force, |out| {
        encode_png(out, &mask, size, ExtendedColorType::L8)
    })?;
    Ok(MapOutcome {
        plants: scene.field.plants.len(),
        plots: spectra.plots.len(),
        size_px: [spectra.width, spectra.height],
    })
}

fn layout(spectra: &Spectra, place: Georeference, nodata: f64) -> Layout {
    Layout {
        width: spectra.width,
        height: spectra.height,
        colour: Colour::Records(BANDS),
        georeference: Some(place),
        nodata: Some(nodata),
    }
}

/// What is stored: measured reflectances in the order of the bands, nothing in the frame.
fn samples<T: Copy>(
    spectra: &Spectra,
    order: &[usize],
    nothing: T,
    sample: impl Fn(f32) -> T,
) -> Vec<T> {
    let (width, height) = (spectra.width, spectra.height);
    let is_inside = |at: usize, size: usize| at >= FRAME_PX && at + FRAME_PX < size;
    let measured = spectra.measured();
    let pixel = |(k, pixel): (usize, &[f32; BANDS])| -> [T; BANDS] {
        let is_seen = is_inside(k % width, width) && is_inside(k / width, height);
        std::array::from_fn(|band| if is_seen { sample(pixel[order[band]]) } else { nothing })
    };
    measured.iter().enumerate().flat_map(pixel).collect()
}

fn write<T: Sample>(
    path: &Path,
    force: bool,
    layout: &Layout,
    samples: &[T],
    options: &MapOptions,
) -> Result<(), FileError> {
    geotiff::write(path, force, layout, |writer: &mut Writer<T>| {
        if options.named {
            writer.name_bands(&options.bands);
        }
        writer.put(Window::whole(layout.width, layout.height), samples)
    })
}

fn plot_table(all: &[PlotTruth]) -> String {
    let mut table = "plot,canopy_cover,ndvi,ndvi_leaf,ndre,ndre_leaf\n".to_owned();
    for (number, PlotTruth { leaf_share, ndvi, ndre, .. }) in all.iter().enumerate() {
        let values = [*leaf_share, ndvi[0], ndvi[1], ndre[0], ndre[1]].map(|x| format!("{x:.5}"));
        table += &format!("{},{}\n", number + 1, values.join(","));
    }
    table
}
