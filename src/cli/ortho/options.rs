//! What `rowgram ortho` is asked for.

use super::project::Input;
use crate::{
    error::Error,
    io::{FileError, geotiff},
    mapping::{
        Surface,
        select::{Choice, Rules},
        surface::Heights,
    },
    raster::{
        georeference::{Crs, CrsKind},
        undistort::Interpolation,
        window::Window,
    },
};
use clap::ValueEnum;
use std::{
    path::{Path, PathBuf},
    str::FromStr,
};

/// Make an orthophoto mosaic, or orthophotos of single photos
///
/// Every cell of the map is taken to the ground by a surface, projected into the photos that may show it
/// (collinearity and lens), and takes its colour from the photo whose camera is closest. PROJECT is a folder that
/// rowgram align has been through, and rowgram dem; or give another program's model, or poses and a camera.
///
/// Writes a tiled, compressed GeoTIFF with overviews and an alpha channel (OUTPUT), and beside it, as
/// OUTPUT_provenance.tif, where each pixel came from: photo, column, row, view angle (degrees), distance to the
/// seam (metres; -1 where there is none); OUTPUT.json names the photos. rowgram query answers from them.
///
/// All options are off for the paper's form.
///
/// Examples:
///   rowgram ortho field --gsd 0.015
///   rowgram ortho --poses opk.csv --camera camera.toml --photos photos --dem dem.tif -o ortho.tif
///   rowgram ortho field --frames -o frames --gsd 0.02
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(in crate::cli) struct Args {
    #[command(flatten)]
    pub(super) input: Input,
    /// The surface: a GeoTIFF of heights in the mapping frame [default: PROJECT/rowgram/dem.tif].
    #[arg(long, value_name = "FILE")]
    pub(super) dem: Option<PathBuf>,
    /// The mosaic, or with --frames the folder [default: PROJECT/rowgram/ortho.tif].
    #[arg(short, long, value_name = "PATH")]
    pub(super) output: Option<PathBuf>,
    /// An orthophoto of each photo instead of a mosaic.
    #[arg(long)]
    pub(super) frames: bool,
    /// Only these photos, by name.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) only: Vec<String>,
    /// Side of a pixel, metres [default: the photos' median ground sampling distance].
    #[arg(long, value_name = "M")]
    pub(super) gsd: Option<f64>,
    /// What the map shows: least x, least y, greatest x, greatest y, metres [default: all that photos show].
    #[arg(
        long,
        value_name = "X,Y,X,Y",
        value_delimiter = ',',
        num_args = 4,
        allow_negative_numbers = true
    )]
    pub(super) bounds: Vec<f64>,
    /// The map has the grid of this GeoTIFF.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["gsd", "bounds"])]
    pub(super) like: Option<PathBuf>,
    /// Which photo a cell is taken from.
    #[arg(long, value_enum, default_value_t = ChoiceName::Closest)]
    pub(super) choice: ChoiceName,
    /// The largest angle between line of sight and vertical, degrees.
    #[arg(long, value_name = "DEG")]
    pub(super) max_angle: Option<f64>,
    /// Leave out photos from which the surface hides the cell; M metres above the line of sight hide nothing.
    #[arg(long, value_name = "M", num_args = 0..=1, default_missing_value = "0.05")]
    pub(super) visibility: Option<f64>,
    /// Pixels along the borders of photos that are not used.
    #[arg(long, value_name = "PX", default_value_t = 0.0)]
    pub(super) border: f64,
    /// Blend photos up to so many metres from the seams.
    #[arg(long, value_name = "M")]
    pub(super) feather: Option<f64>,
    /// Bring the colours of overlapping photos together.
    #[arg(long)]
    pub(super) balance: bool,
    /// How photos are read between their pixels.
    #[arg(long, value_enum, default_value_t = InterpolationName::Bilinear)]
    pub(super) interpolation: InterpolationName,
    /// Draw the map so far above the surface: metres, or auto for the height of the leaves, at which photos agree
    /// best about what is green. Leaves are then in their places, and the ground beside them is not.
    #[arg(long, value_name = "auto|M", default_value = "0", allow_hyphen_values = true)]
    pub(super) above: Above,
    /// How the surface is read between its cells.
    #[arg(long, value_enum, default_value_t = HeightsName::Bilinear)]
    pub(super) dem_interpolation: HeightsName,
    /// Do not write where the pixels came from.
    #[arg(long)]
    pub(super) no_provenance: bool,
    /// Folder for pictures: preview, sources and seams, coverage; with CSV.
    #[arg(long, value_name = "DIR")]
    pub(super) figures: Option<PathBuf>,
    /// Megabytes of decoded photos that are kept.
    #[arg(long, value_name = "MB", default_value_t = 600)]
    pub(super) memory: usize,
    /// Print what was done as one line of JSON.
    #[arg(long)]
    pub(super) json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    pub(super) force: bool,
}

/// How far above the surface a map is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Above {
    /// As high as the leaves.
    Leaves,
    /// So many metres.
    Metres(f64),
}

impl FromStr for Above {
    type Err = String;
    fn from_str(text: &str) -> Result<Above, String> {
        if text == "auto" {
            return Ok(Above::Leaves);
        }
        let metres = text.parse().ok().filter(|m: &f64| m.abs() <= 1000.0);
        metres.map(Above::Metres).ok_or_else(|| "expected metres, or auto".to_owned())
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum ChoiceName {
    /// Its camera is closest.
    Closest,
    /// It looks most straight down.
    Nadir,
    /// Its ground sampling distance is smallest.
    Gsd,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum InterpolationName {
    Bilinear,
    Bicubic,
    Lanczos,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum HeightsName {
    Bilinear,
    Bicubic,
}

impl Args {
    /// Refuses values that make no sense.
    ///
    /// # Errors
    /// Names the option.
    pub(super) fn check(&self) -> Result<(), Error> {
        let positive = |name: &str, value: Option<f64>| match value {
            Some(value) if !(value.is_finite() && value > 0.0) => {
                Err(Error::Argument(format!("--{name} {value}: expected a positive number")))
            }
            _ => Ok(()),
        };
        positive("gsd", self.gsd)?;
        positive("feather", self.feather)?;
        positive("max-angle", self.max_angle)?;
        if self.max_angle.is_some_and(|angle| angle >= 90.0) {
            return Err(Error::Argument("--max-angle: expected less than 90 degrees".into()));
        }
        if self.border < 0.0 || !self.border.is_finite() {
            return Err(Error::Argument(format!("--border {}: expected 0 or more", self.border)));
        }
        if let [left, bottom, right, top] = self.bounds[..]
            && !(left < right && bottom < top)
        {
            return Err(Error::Argument(format!(
                "--bounds {left},{bottom},{right},{top}: expected least x, least y, greatest x, greatest y"
            )));
        }
        Ok(())
    }

    /// The surface, in the coordinate reference system of the photos.
    ///
    /// # Errors
    /// As [`read_surface`]; where there is none, or it is in another system.
    pub(super) fn surface(&self, crs: Option<Crs>) -> Result<Surface, Error> {
        let path = match (&self.dem, self.input.results()) {
            (Some(path), _) => path.clone(),
            (None, Some(folder)) if folder.join("dem.tif").is_file() => folder.join("dem.tif"),
            _ => {
                return Err(Error::Argument(
                    "there is no surface: give --dem, or make one with rowgram dem".into(),
                ));
            }
        };
        let between = match self.dem_interpolation {
            HeightsName::Bilinear => Heights::Bilinear,
            HeightsName::Bicubic => Heights::Bicubic,
        };
        let mut surface = read_surface(&path, between)?;
        let known = surface.georeference.crs;
        match (known.epsg, crs.and_then(|crs| crs.epsg)) {
            (Some(a), Some(b)) if a != b => {
                return Err(FileError::malformed(
                    &path,
                    None,
                    format!("it is in EPSG:{a}, the photos in EPSG:{b}; reproject it (gdalwarp -t_srs EPSG:{b})"),
                )
                .into());
            }
            (None, Some(_)) => {
                surface.georeference.crs =
                    Crs { vertical_epsg: known.vertical_epsg, ..crs.unwrap_or(known) };
            }
            _ => {}
        }
        match (known.vertical_epsg, crs.and_then(|crs| crs.vertical_epsg)) {
            (Some(a), Some(b)) if a != b => {
                return Err(FileError::malformed(
                    &path,
                    None,
                    format!("its heights are in EPSG:{a}, those of the photos in EPSG:{b}"),
                )
                .into());
            }
            (None, vertical) => surface.georeference.crs.vertical_epsg = vertical,
            _ => {}
        }
        if surface.georeference.crs.kind == CrsKind::Unknown {
            tracing::warn!(
                "{} does not say its coordinate reference system; taken as metres of the photos' frame",
                path.display()
            );
        }
        Ok(surface)
    }

    pub(super) fn rules(&self) -> Rules {
        Rules {
            choice: match self.choice {
                ChoiceName::Closest => Choice::Closest,
                ChoiceName::Nadir => Choice::Nadir,
                ChoiceName::Gsd => Choice::Gsd,
            },
            max_angle_rad: self.max_angle.map(f64::to_radians),
            visibility_m: self.visibility,
            border_px: self.border,
        }
    }

    pub(super) fn interpolation(&self) -> Interpolation {
        match self.interpolation {
            InterpolationName::Bilinear => Interpolation::Bilinear,
            InterpolationName::Bicubic => Interpolation::Bicubic,
            InterpolationName::Lanczos => Interpolation::Lanczos,
        }
    }
}

/// Reads heights from a GeoTIFF.
///
/// # Errors
/// Names the file: no place on the map, degrees, no heights.
pub(in crate::cli) fn read_surface(path: &Path, between: Heights) -> Result<Surface, Error> {
    let reader = geotiff::Reader::open(path)?;
    let fault = |message: String| FileError::malformed(path, None, message);
    let place = reader.georeference().ok_or_else(|| {
        fault("it does not say where it lies on the map; expected a GeoTIFF of heights".into())
    })?;
    if reader.is_colour() {
        return Err(fault("it holds colours, expected heights (one band)".into()).into());
    }
    let size = [reader.width(), reader.height()];
    let heights = reader.read_f32(Window::whole(size[0], size[1]))?;
    Surface::new(place, size, heights, between).map_err(|error| fault(error.to_string()).into())
}
