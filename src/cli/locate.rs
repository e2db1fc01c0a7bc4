//! `rowgram locate`: plants in a photo or a leaf mask.

use super::{
    method::{Count, DescentSummary, Method, Summary, count, word},
    segment::same_file,
    stand::{self, StandSummary},
    tau::TauArgs,
};
use crate::{
    descent::{self, Descent, Order, Outcome},
    drive::{Drive, Limits},
    error::Error,
    io::{
        images::{self, Picture},
        output,
    },
    phenotype::{
        canopy, crops,
        locate::{Effort, Init, LocateError, Located, Options, Setup, locate_best},
        rows::{self, Detection},
        stand::Canopy,
    },
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    raster::{Mask, components},
};
use clap::Args;
use image::RgbImage;
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
    /// (tensor, or slices across the leaves), curved-rows, across, believed, votes, cover, heat, tally, beta, beta-compared, mean-place,
    /// estimate-spacing, crowns, tilt, apart.
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
    #[command(flatten)]
    tau: TauArgs,
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
    /// Descend from this many starts, with seeds one after the other, and keep the plants with the
    /// smallest objective.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=10_000))]
    starts: Option<u64>,
    /// After every descent, take away the plant that is least missed and put it where leaves are
    /// farthest from theirs, and keep that if the objective becomes smaller; at most this often.
    #[arg(long, value_name = "N")]
    swaps: Option<usize>,
    /// Solve the convex problem of every plant again with an interior-point method, and tell how far the
    /// descent is from its bound.
    #[arg(long)]
    certify: bool,
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
    /// Cut the mask into windows of this many pixels and locate in each on its own, as the paper does
    /// (full method; number of plants not given). For comparison.
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(64..))]
    crop: Option<u32>,
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
            Picture::Photo(photo) => (self.tau.of_photo(&photo).mask(&photo), Some(photo)),
        };
        components::remove_small(&mut mask, self.min_pixels);
        let clock = std::time::Instant::now();
        let index = PixelIndex::from_mask(mask.width, &mask.data);
        let pixels = index.len();
        let detection = rows::detect(&index);
        if let Some(crop_px) = self.crop {
            return self.crops(&mask, photo, &detection, crop_px as usize, clock);
        }
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
        let mut summary = Summary::new(pixels, detection.rows(), self.gsd);
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
                stand::write_located(&self.output, self.force, &located, self.gsd)?;
                if let Some(path) = &self.overlay {
                    let mut picture = photo.unwrap_or_else(|| mask.to_rgb());
                    stand::draw_located(&mut picture, &located);
                    images::write_photo(path, self.force, &picture)?;
                }
            }
        }
        Ok(summary)
    }

    /// The full method, crop by crop.
    fn crops(
        &self,
        mask: &Mask,
        photo: Option<RgbImage>,
        detection: &Detection,
        crop_px: usize,
        clock: std::time::Instant,
    ) -> Result<Summary, Error> {
        let rows = detection.rows();
        // Two rows on every side, several plants.
        let halo_px = 2.0 * rows.and_then(|rows| rows.spacing_px).unwrap_or(crop_px as f64 / 8.0);
        let options = self.canopy()?;
        let plants = crops::locate(mask, detection, &options, crop_px, halo_px as usize)?;
        let pixels = mask.data.iter().filter(|&&pixel| pixel != 0).count();
        let mut summary = Summary::new(pixels, rows, self.gsd);
        (summary.plants, summary.seconds) = (plants.len(), clock.elapsed().as_secs_f64());
        stand::write_plants(&self.output, self.force, &plants, self.gsd)?;
        if let Some(path) = &self.overlay {
            let mut picture = photo.unwrap_or_else(|| mask.to_rgb());
            stand::draw_plants(&mut picture, plants.iter().map(|plant| plant.position_px), 3);
            images::write_photo(path, self.force, &picture)?;
        }
        Ok(summary)
    }

    fn descend(&self, setup: Setup, options: &Options) -> Result<(Located, DescentSummary), Error> {
        let effort = Effort { starts: self.starts.unwrap_or(1), swaps: self.swaps.unwrap_or(0) };
        let (setup, outcome) = if effort == Effort::default() {
            self.drive(setup, options)?
        } else {
            let Setup { problem, field, detection } = setup;
            let index = problem.index();
            let start = (options.init == Init::Votes).then_some(&field.positions_px[..]);
            locate_best(index, options, &detection, start, effort)?
        };
        let Setup { problem, mut field, detection } = setup;
        let certificate = if self.certify { Some(problem.prove(&mut field)?) } else { None };
        let located = Setup { problem, field, detection }.finish();
        let summary = DescentSummary {
            sigma_px: located.sigma_px,
            mean_distance_px: located.mean_distance_px,
            plants_without_pixels: located.idle,
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            sweeps: outcome.sweeps,
            stop: outcome.stop.word(),
            certificate,
        };
        Ok((located, summary))
    }

    fn drive(&self, setup: Setup, options: &Options) -> Result<(Setup, Outcome), Error> {
        let Setup { problem, field, detection } = setup;
        let mut drive = Drive::new(&problem, Descent::new(options.descent), field)
            .limits(Limits::iterations(options.max_sweeps))
            .force(self.force);
        if let Some(trace) = &self.trace {
            drive = drive.trace(trace);
        }
        let outcome = drive.run()?.checked()?;
        let done = Outcome {
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            sweeps: outcome.iterations,
            stop: outcome.stop,
        };
        Ok((Setup { problem, field: outcome.x, detection }, done))
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
            ("--starts", self.starts.is_some()),
            ("--swaps", self.swaps.is_some()),
            ("--certify", self.certify),
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
        if self.crop.is_some() {
            if !full || self.plants != Count::Auto {
                return refuse("--crop", "goes with the method full and without --plants");
            }
            if self.gaps.is_some() || self.counts.is_some() {
                return refuse("--crop", "finds plants only: no --gaps, no --counts");
            }
        }
        if self.trace.is_some() && (self.starts.is_some() || self.swaps.is_some()) {
            return refuse("--trace", "follows one descent, without --starts and --swaps");
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
        stand::write_plants(&self.output, self.force, &canopy.plants, self.gsd)?;
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

    fn report(&self, summary: &Summary) -> Result<(), Error> {
        let Summary { plants, rows, pixels, .. } = summary;
        tracing::info!("{plants} plants in {rows} rows from {pixels} leaf pixels");
        if let Some(descent) = &summary.descent {
            let DescentSummary { sweeps, stop, mean_distance_px, .. } = descent;
            tracing::info!("{sweeps} sweeps, {stop}; mean distance {mean_distance_px:.2} px");
            if let Some(proof) = &descent.certificate {
                tracing::info!("{proof}");
            }
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
