//! `rowgram locate`: plants in a photo or a leaf mask.

use super::segment::same_file;
use crate::{
    descent::{self, Descent, Order},
    drive::{Drive, Limits},
    error::Error,
    io::{
        images::{self, Picture},
        output, points,
    },
    phenotype::locate::{Init, LocateError, Located, Options, Setup},
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    raster::{Mask, components, mask::Thresholds, overlay},
};
use clap::Args;
use image::{Rgb, RgbImage};
use serde::{
    Deserialize, Serialize,
    de::{IntoDeserializer, value},
};
use std::path::PathBuf;

/// Locate plants in a photo or a leaf mask, given how many there are.
#[derive(Debug, Args)]
pub(super) struct Locate {
    /// A photo, or a mask as `rowgram segment` writes it (PNG, JPEG, TIFF).
    image: PathBuf,
    /// How many plants there are.
    #[arg(long, value_name = "N")]
    plants: usize,
    /// What holds a plant: none, rows (near its row), grid (near its row and column).
    #[arg(long, default_value = "rows", value_parser = word::<Prior>, value_name = "WORD")]
    prior: Prior,
    /// How a plant moves: mean (squared distances), median (the stated cost, exactly).
    #[arg(long, default_value = "median", value_parser = word::<PlantUpdate>, value_name = "WORD")]
    update: PlantUpdate,
    /// Scale of the distances: paper (mean distance), planar (half of it), fixed:PX.
    #[arg(long, default_value = "paper", value_name = "RULE")]
    sigma: SigmaRule,
    /// How the rows hold a plant: joint (latent lines, one objective), conditional (the other
    /// plants of its row).
    #[arg(long, default_value = "joint", value_parser = word::<Form>, value_name = "WORD")]
    form: Form,
    /// Where to start: kmeans++, rows (regular spacing), random. By default rows, or kmeans++ with
    /// `--prior none`.
    #[arg(long, value_parser = word::<Init>, value_name = "WORD")]
    init: Option<Init>,
    /// Leave the plants where they start.
    #[arg(long)]
    no_fit: bool,
    /// Order of the updates: cyclic, shuffled.
    #[arg(long, default_value = "cyclic", value_parser = word::<Order>, value_name = "WORD")]
    order: Order,
    /// Thresholds of the leaf mask: hue from, hue to, least saturation, least value.
    #[arg(
        long,
        default_value = "30,79,30,163",
        value_name = "TAU1,TAU2,TAU3,TAU4",
        allow_hyphen_values = true
    )]
    tau: Thresholds,
    /// Leave out components of fewer pixels.
    #[arg(long, default_value_t = 0, value_name = "N")]
    min_pixels: usize,
    /// Ground sampling distance, metres per pixel: adds x_m and y_m to the output.
    #[arg(long, value_name = "M")]
    gsd: Option<f64>,
    /// Decides everything random.
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// Most sweeps to make.
    #[arg(long, default_value_t = 500, value_name = "N")]
    max_sweeps: u64,
    /// Write one line per sweep to this CSV file.
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Print a summary as one line of JSON on stdout.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Where to write the plants: u_px, v_px, row.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Draw the plants over the image, as a PNG.
    #[arg(long, value_name = "FILE")]
    overlay: Option<PathBuf>,
}

/// What is printed as JSON.
#[derive(Debug, Serialize)]
pub(super) struct Summary {
    plants: usize,
    pub(super) pixels: usize,
    pub(super) rows: usize,
    heading_deg: Option<f64>,
    row_spacing_px: Option<f64>,
    pub(super) row_spacing_m: Option<f64>,
    sigma_px: f64,
    mean_distance_px: f64,
    plants_without_pixels: usize,
    initial_cost: f64,
    final_cost: f64,
    sweeps: u64,
    stop: &'static str,
    seconds: f64,
}

/// A word as serde spells it, so that it is the same here as in TOML.
fn word<T: for<'de> Deserialize<'de>>(text: &str) -> Result<T, String> {
    let text: value::StrDeserializer<'_, value::Error> = text.into_deserializer();
    T::deserialize(text).map_err(|error| error.to_string())
}

impl Locate {
    /// Runs the verb.
    pub(super) fn run(self) -> Result<(), Error> {
        let summary = self.work()?;
        self.report(&summary)
    }

    /// Reads, locates, writes the files; prints nothing.
    pub(super) fn work(&self) -> Result<Summary, Error> {
        self.check_outputs()?;
        let options = self.options()?;
        let (mut mask, photo) = match images::read(&self.image)? {
            Picture::Mask(mask) => (mask, None),
            Picture::Photo(photo) => (self.tau.mask(&photo), Some(photo)),
        };
        components::remove_small(&mut mask, self.min_pixels);
        let index = PixelIndex::from_mask(mask.width, &mask.data);
        let pixels = index.len();
        let Setup { problem, field, detection } = Setup::new(index, &options)?;
        let mut drive = Drive::new(&problem, Descent::new(options.descent), field)
            .limits(Limits::iterations(options.max_sweeps))
            .force(self.force);
        if let Some(trace) = &self.trace {
            drive = drive.trace(trace);
        }
        let outcome = drive.run()?.checked()?;
        let located = Setup { problem, field: outcome.x, detection }.finish();
        self.write(&located, photo, &mask)?;
        let rows = located.detection.rows();
        let row_spacing_px = rows.and_then(|rows| rows.spacing_px);
        Ok(Summary {
            plants: located.plants.len(),
            pixels,
            rows: rows.map_or(0, |rows| rows.rows.len()),
            heading_deg: rows.map(|rows| rows.axes.heading_rad.to_degrees()),
            row_spacing_px,
            row_spacing_m: row_spacing_px.zip(self.gsd).map(|(px, gsd)| px * gsd),
            sigma_px: located.sigma_px,
            mean_distance_px: located.mean_distance_px,
            plants_without_pixels: located.idle,
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            sweeps: outcome.iterations,
            stop: outcome.stop.word(),
            seconds: outcome.seconds,
        })
    }

    /// Refuses what would fail, or destroy an input, after the work is done.
    fn check_outputs(&self) -> Result<(), Error> {
        let mut taken = vec![&self.image];
        let outputs = [Some(&self.output), self.overlay.as_ref(), self.trace.as_ref()];
        for path in outputs.into_iter().flatten() {
            if taken.iter().any(|other| same_file(path, other)) {
                let path = path.display();
                return Err(Error::Argument(format!("{path} is given twice")));
            }
            taken.push(path);
            output::check(path, self.force)?;
        }
        Ok(())
    }

    fn options(&self) -> Result<Options, Error> {
        if let Some(gsd) = self.gsd.filter(|gsd| !(gsd.is_finite() && *gsd > 0.0)) {
            return Err(Error::Argument(format!(
                "--gsd has to be a positive number of metres per pixel, got: {gsd}"
            )));
        }
        if self.plants == 0 {
            return Err(LocateError::NoPlants.into());
        }
        // One centimetre across the rows, as far as it is known how much that is.
        let floor_px = self.gsd.map_or(Model::default().floor_px, |gsd| 0.01 / gsd);
        let init = self.init.unwrap_or(match self.prior {
            Prior::None => Init::KmeansPlusPlus,
            Prior::Rows | Prior::Grid => Init::Rows,
        });
        Ok(Options {
            plants: self.plants,
            model: Model {
                prior: self.prior,
                update: self.update,
                sigma: self.sigma,
                form: self.form,
                floor_px,
                ..Model::default()
            },
            init,
            seed: self.seed,
            descent: descent::Options {
                order: self.order,
                seed: self.seed,
                ..descent::Options::default()
            },
            max_sweeps: if self.no_fit { 0 } else { self.max_sweeps },
        })
    }

    fn write(&self, located: &Located, photo: Option<RgbImage>, mask: &Mask) -> Result<(), Error> {
        let positions: Vec<[f64; 2]> = located.plants.iter().map(|p| p.position_px).collect();
        let rows: Vec<f64> =
            located.plants.iter().map(|p| p.row.map_or(f64::NAN, |row| row as f64)).collect();
        let metres = |axis: usize| {
            let gsd = self.gsd.unwrap_or(f64::NAN);
            positions.iter().map(|at| at[axis] * gsd).collect::<Vec<f64>>()
        };
        let (x_m, y_m) = (metres(0), metres(1));
        let mut columns: Vec<(&str, &[f64])> = vec![("row", &rows)];
        if self.gsd.is_some() {
            columns.extend([("x_m", &x_m[..]), ("y_m", &y_m[..])]);
        }
        points::write(&self.output, self.force, &positions, &columns)?;
        if let Some(path) = &self.overlay {
            let mut picture = photo.unwrap_or_else(|| mask.to_rgb());
            let radius_px = (located.mean_distance_px / 3.0).clamp(2.0, 12.0) as u32;
            overlay::draw_points(&mut picture, &positions, Rgb([255, 40, 40]), radius_px);
            images::write_photo(path, self.force, &picture)?;
        }
        Ok(())
    }

    fn report(&self, summary: &Summary) -> Result<(), Error> {
        tracing::info!(
            "{} plants in {} rows from {} leaf pixels; {} sweeps, {}; mean distance {:.2} px",
            summary.plants,
            summary.rows,
            summary.pixels,
            summary.sweeps,
            summary.stop,
            summary.mean_distance_px,
        );
        if summary.plants_without_pixels > 0 {
            tracing::warn!("{} plants have no leaf pixel", summary.plants_without_pixels);
        }
        if self.json {
            super::print_json(summary)?;
        }
        Ok(())
    }
}
