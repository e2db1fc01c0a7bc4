//! `rowgram locate`: plants in a photo or a leaf mask.

use super::{
    method::{Count, Method, count, word},
    segment::same_file,
    stand::{self, StandSummary},
};
use crate::{
    descent::{self, Descent, Order},
    drive::{Drive, Limits},
    error::Error,
    io::{
        images::{self, Picture},
        output, points,
    },
    phenotype::{
        canopy,
        locate::{Init, LocateError, Located, Options, Setup},
        rows,
        stand::Canopy,
    },
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    raster::{Mask, components, mask::Thresholds, overlay},
};
use clap::Args;
use image::{Rgb, RgbImage};
use serde::Serialize;
use std::path::PathBuf;

/// Locate plants in a photo or a leaf mask, and count them.
///
/// The default method finds stalks where the axes of leaves meet, follows the rows where they bend
/// and chooses the best plants along each row under a model of their spacing. It tells how sure it is
/// of each plant, of their number, and where plants are missing. The other methods, and all of the
/// options from --prior to --max-sweeps, are the paper's descent and its variants; without
/// --method, any of these options chooses it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  rowgram locate field.png --gsd 0.015 --json -o plants.csv --gaps gaps.csv
  rowgram locate field.png --plants 304 --method paper -o paper.csv")]
pub(super) struct Locate {
    /// A photo, or a mask as `rowgram segment` writes it (PNG, JPEG, TIFF).
    image: PathBuf,
    /// How many plants there are, or auto: as many as there seem to be.
    #[arg(long, default_value = "auto", value_parser = count, value_name = "N|auto")]
    plants: Count,
    /// A named way to locate: full (the default), refined, tempered, paper, kmeans, rows.
    #[arg(long, value_parser = word::<Method>, value_name = "NAME")]
    method: Option<Method>,
    /// An option of the methods full and refined, as in `--set leaf-axes=false`: leaf-axes, axes
    /// (tensor, or slices across the leaves),
    /// curved-rows, across, believed, votes, cover, heat, beta, beta-compared, mean-place,
    /// estimate-spacing.
    #[arg(long, value_name = "NAME=VALUE")]
    set: Vec<String>,
    /// What holds a plant: none, rows (near its row), grid (near its row and column).
    #[arg(long, value_parser = word::<Prior>, value_name = "WORD")]
    prior: Option<Prior>,
    /// How a plant moves: mean (squared distances), median (the stated cost, exactly).
    #[arg(long, value_parser = word::<PlantUpdate>, value_name = "WORD")]
    update: Option<PlantUpdate>,
    /// Scale of the distances: paper (mean distance), planar (half of it), fixed:PX.
    #[arg(long, value_name = "RULE")]
    sigma: Option<SigmaRule>,
    /// How the rows hold a plant: joint (latent lines, one objective), conditional (the other
    /// plants of its row).
    #[arg(long, value_parser = word::<Form>, value_name = "WORD")]
    form: Option<Form>,
    /// Let the data count as this many independent pixels per plant; 0 is the paper, all of them.
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    tempering: Option<f64>,
    /// Truncate distances at this many pixels; 0 is the paper, never.
    #[arg(long, value_name = "PX", allow_negative_numbers = true)]
    truncate: Option<f64>,
    /// Where to start: kmeans++, rows (regular spacing), random, votes (the plants of the full
    /// method). By default rows, or kmeans++ with `--prior none`.
    #[arg(long, value_parser = word::<Init>, value_name = "WORD")]
    init: Option<Init>,
    /// Leave the plants where they start.
    #[arg(long)]
    no_fit: bool,
    /// Order of the updates: cyclic, shuffled.
    #[arg(long, value_parser = word::<Order>, value_name = "WORD")]
    order: Option<Order>,
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
    #[arg(long, value_name = "N")]
    max_sweeps: Option<u64>,
    /// Write one line per sweep to this CSV file.
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Print a summary as one line of JSON on stdout.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Where to write the plants: u_px, v_px, row, and with the full method confidence and standard
    /// deviations along and across the row.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Write where plants are missing (full method): place, row, length, plants, probability.
    #[arg(long, value_name = "FILE")]
    gaps: Option<PathBuf>,
    /// Write the stand count of every row (full method), with its interval.
    #[arg(long, value_name = "FILE")]
    counts: Option<PathBuf>,
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
    #[serde(flatten)]
    descent: Option<DescentSummary>,
    #[serde(flatten)]
    stand: Option<StandSummary>,
    seconds: f64,
}

/// What only the descent knows.
#[derive(Debug, Serialize)]
struct DescentSummary {
    sigma_px: f64,
    mean_distance_px: f64,
    plants_without_pixels: usize,
    initial_cost: f64,
    final_cost: f64,
    sweeps: u64,
    stop: &'static str,
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
        let method = self.method()?;
        let (mut mask, photo) = match images::read(&self.image)? {
            Picture::Mask(mask) => (mask, None),
            Picture::Photo(photo) => (self.tau.mask(&photo), Some(photo)),
        };
        components::remove_small(&mut mask, self.min_pixels);
        let clock = std::time::Instant::now();
        let index = PixelIndex::from_mask(mask.width, &mask.data);
        let pixels = index.len();
        let detection = rows::detect(&index);
        let init = self.init(method);
        let canopy = if method == Some(Method::Full)
            || init == Init::Votes
            || (self.plants == Count::Auto && pixels > 0)
        {
            let count = match self.plants {
                Count::Auto => None,
                Count::Given(count) => Some(count),
            };
            Some(canopy::locate(&mask, &detection, count, &self.canopy()?)?)
        } else {
            None
        };
        let found = detection.rows();
        let row_spacing_px = found.and_then(|rows| rows.spacing_px);
        let mut summary = Summary {
            plants: 0,
            pixels,
            rows: found.map_or(0, |rows| rows.rows.len()),
            heading_deg: found.map(|rows| rows.axes.heading_rad.to_degrees()),
            row_spacing_px,
            row_spacing_m: row_spacing_px.zip(self.gsd).map(|(px, gsd)| px * gsd),
            descent: None,
            stand: None,
            seconds: 0.0,
        };
        match canopy {
            Some(canopy) if method == Some(Method::Full) => {
                summary.plants = canopy.plants.len();
                summary.stand = Some(StandSummary::new(&canopy, self.gsd));
                summary.seconds = clock.elapsed().as_secs_f64();
                self.write_stand(&canopy, photo, &mask)?;
            }
            canopy => {
                let start: Option<Vec<[f64; 2]>> =
                    canopy.map(|canopy| canopy.plants.iter().map(|p| p.position_px).collect());
                let plants = match (self.plants, &start) {
                    (Count::Given(count), _) => count,
                    (Count::Auto, start) => start.as_ref().map_or(1, Vec::len),
                };
                let options = self.options(method, init, plants);
                let start = start.filter(|_| init == Init::Votes);
                let setup = Setup::from(index, &options, detection, start)?;
                let (located, descent) = self.descend(setup, &options)?;
                (summary.plants, summary.descent) = (located.plants.len(), Some(descent));
                summary.seconds = clock.elapsed().as_secs_f64();
                self.write(&located, photo, &mask)?;
            }
        }
        Ok(summary)
    }

    fn descend(&self, setup: Setup, options: &Options) -> Result<(Located, DescentSummary), Error> {
        let Setup { problem, field, detection } = setup;
        let mut drive = Drive::new(&problem, Descent::new(options.descent), field)
            .limits(Limits::iterations(options.max_sweeps))
            .force(self.force);
        if let Some(trace) = &self.trace {
            drive = drive.trace(trace);
        }
        let outcome = drive.run()?.checked()?;
        let located = Setup { problem, field: outcome.x, detection }.finish();
        let summary = DescentSummary {
            sigma_px: located.sigma_px,
            mean_distance_px: located.mean_distance_px,
            plants_without_pixels: located.idle,
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            sweeps: outcome.iterations,
            stop: outcome.stop.word(),
        };
        Ok((located, summary))
    }

    /// The method asked for; none is the descent as its options say.
    fn method(&self) -> Result<Option<Method>, Error> {
        let of_descent = [
            ("--prior", self.prior.is_some()),
            ("--update", self.update.is_some()),
            ("--sigma", self.sigma.is_some()),
            ("--form", self.form.is_some()),
            ("--tempering", self.tempering.is_some()),
            ("--truncate", self.truncate.is_some()),
            ("--init", self.init.is_some()),
            ("--no-fit", self.no_fit),
            ("--order", self.order.is_some()),
            ("--max-sweeps", self.max_sweeps.is_some()),
            ("--trace", self.trace.is_some()),
        ];
        let descent = of_descent.iter().find(|(_, given)| *given);
        let method = match (self.method, descent) {
            (None, None) => Some(Method::Full),
            (method, _) => method,
        };
        let refuse = |option: &str, why: &str| Err(Error::Argument(format!("{option}: {why}")));
        if let (Some(Method::Full), Some((option, _))) = (method, descent) {
            return refuse(option, "an option of the descent, which the method full does not use");
        }
        let full = method == Some(Method::Full);
        for (option, given) in [("--gaps", &self.gaps), ("--counts", &self.counts)] {
            if given.is_some() && !full {
                return refuse(option, "only the method full knows that");
            }
        }
        if let Some(gsd) = self.gsd.filter(|gsd| !(gsd.is_finite() && *gsd > 0.0)) {
            return refuse(
                "--gsd",
                &format!("a positive number of metres per pixel was expected, got: {gsd}"),
            );
        }
        for (option, given) in [("--tempering", self.tempering), ("--truncate", self.truncate)] {
            if given.is_some_and(|x| !(x.is_finite() && x >= 0.0)) {
                return refuse(option, "a number that is not negative was expected");
            }
        }
        if self.plants == Count::Given(0) {
            return Err(LocateError::NoPlants.into());
        }
        Ok(method)
    }

    /// Options of the full method.
    fn canopy(&self) -> Result<canopy::Options, Error> {
        toml::from_str(&self.set.join("\n"))
            .map_err(|error| Error::Argument(format!("--set: {}", error.message())))
    }

    /// Refuses what would fail, or destroy an input, after the work is done.
    fn check_outputs(&self) -> Result<(), Error> {
        let mut taken = vec![&self.image];
        let outputs = [
            Some(&self.output),
            self.overlay.as_ref(),
            self.trace.as_ref(),
            self.gaps.as_ref(),
            self.counts.as_ref(),
        ];
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

    fn init(&self, method: Option<Method>) -> Init {
        let of_method = match method {
            Some(method) => method.init(),
            None if self.prior == Some(Prior::None) => Init::KmeansPlusPlus,
            None => Init::Rows,
        };
        self.init.unwrap_or(of_method)
    }

    /// The descent: what the method says, where no option says otherwise.
    fn options(&self, method: Option<Method>, init: Init, plants: usize) -> Options {
        // One centimetre across the rows, as far as it is known how much that is.
        let floor_px = self.gsd.map_or(Model::default().floor_px, |gsd| 0.01 / gsd);
        let base = method.map_or(Model::default(), |method| method.model(self.gsd));
        let base = Model { floor_px, ..base };
        let model = Model {
            prior: self.prior.unwrap_or(base.prior),
            update: self.update.unwrap_or(base.update),
            sigma: self.sigma.unwrap_or(base.sigma),
            form: self.form.unwrap_or(base.form),
            tempering: self.tempering.or(base.tempering).filter(|&votes| votes > 0.0),
            truncate_px: self.truncate.or(base.truncate_px).filter(|&px| px > 0.0),
            ..base
        };
        let fit = !self.no_fit && method != Some(Method::Rows);
        Options {
            plants,
            model,
            init,
            seed: self.seed,
            descent: descent::Options {
                order: self.order.unwrap_or_default(),
                seed: self.seed,
                ..descent::Options::default()
            },
            max_sweeps: if fit { self.max_sweeps.unwrap_or(500) } else { 0 },
        }
    }

    fn write_stand(
        &self,
        canopy: &Canopy,
        photo: Option<RgbImage>,
        mask: &Mask,
    ) -> Result<(), Error> {
        stand::write_plants(&self.output, self.force, canopy, self.gsd)?;
        if let Some(path) = &self.gaps {
            stand::write_gaps(path, self.force, canopy, self.gsd)?;
        }
        if let Some(path) = &self.counts {
            stand::write_counts(path, self.force, canopy, self.gsd)?;
        }
        if let Some(path) = &self.overlay {
            let mut picture = photo.unwrap_or_else(|| mask.to_rgb());
            stand::draw(&mut picture, canopy);
            images::write_photo(path, self.force, &picture)?;
        }
        Ok(())
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
        let Summary { plants, rows, pixels, .. } = summary;
        tracing::info!("{plants} plants in {rows} rows from {pixels} leaf pixels");
        if let Some(descent) = &summary.descent {
            let DescentSummary { sweeps, stop, mean_distance_px, .. } = descent;
            tracing::info!("{sweeps} sweeps, {stop}; mean distance {mean_distance_px:.2} px");
            if descent.plants_without_pixels > 0 {
                tracing::warn!("{} plants have no leaf pixel", descent.plants_without_pixels);
            }
        }
        if let Some(stand) = &summary.stand {
            tracing::info!("{stand}");
        }
        if self.json {
            super::print_json(summary)?;
        }
        Ok(())
    }
}
