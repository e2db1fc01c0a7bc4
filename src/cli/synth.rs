//! `rowgram synth`: synthetic fields and blocks with their truth.

mod flight;
mod season;

use clap::Subcommand;
use data_synth::{
    block::BlockConfig,
    collection::CollectionConfig,
    field::GrowthStage,
    scenario::{Preset, Scenario},
};
use rowgram_base::error::Error;
use rowgram_project::synth::{self, BlockPreset, BlockSource, MapOptions, MapSamples};
use rowgram_raster::spectral::Band;
use std::path::PathBuf;

/// Make synthetic data with known truth.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Leaf mask, picture and true plants of a field from straight above.
    ///
    /// Writes mask.png (255 leaf, 0 other), picture.png, plants.csv (u_px,v_px,row,x_m,y_m; the
    /// centre of the top-left pixel is at 0,0) and field.toml (every parameter, for --config).
    Mask(Box<MaskArgs>),
    Map(Box<MapArgs>),
    /// Measurements of a nadir aerial block or of a photo collection as a BAL text file, start values included.
    Bundle(BundleArgs),
    Flight(flight::Args),
    Season(season::Args),
}

/// Runs `rowgram synth`.
///
/// # Errors
/// A parameter that cannot be used, an output that exists, a file that cannot be read or written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    match &args.what {
        What::Mask(args) => mask(args),
        What::Map(args) => map(args),
        What::Bundle(args) => bundle(args),
        What::Flight(args) => flight::run(args),
        What::Season(args) => season::run(args),
    }
}

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram synth mask --preset mid20 --seed 3 -o field
  rowgram synth mask --stage late --rows 4 --row-length 6 --gsd 0.01 -o field")]
struct MaskArgs {
    /// Folder to write into, made if missing.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// Parameters from a field.toml; options given here come before it.
    #[arg(long, value_name = "FILE", conflicts_with = "preset")]
    config: Option<PathBuf>,
    /// Parameters of a usual scenario, such as early20, mid20_gaps or whole_field.
    #[arg(long, value_name = "NAME")]
    preset: Option<Preset>,
    #[command(flatten)]
    layout: LayoutArgs,
    #[command(flatten)]
    look: LookArgs,
    /// Seed of everything random [default: 1].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seed: Option<u64>,
}

/// An orthomosaic of five bands of known reflectance, with plots, as a project folder with its truth.
///
/// Writes ortho.tif (blue, green, red, red edge, near infrared), plots.geojson, field.toml (every parameter, for --config),
/// and under truth/ plots.csv (cover, NDVI and NDRE of all ground and of the leaves), plants.csv (place and NDVI) and mask.png.
///
/// Example: rowgram synth map --rows 8 --row-length 11 --plot-rows 2 --plot-length 5 --alley 1 -o field
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
struct MapArgs {
    #[command(flatten)]
    field: MaskArgs,
    /// Samples: u16 (reflectance times 10,000) or float.
    #[arg(long, value_name = "KIND", default_value = "u16")]
    samples: MapSamples,
    /// Order of the bands.
    #[arg(
        long,
        value_name = "BAND,...",
        value_delimiter = ',',
        default_value = "blue,green,red,red-edge,nir"
    )]
    bands: Vec<Band>,
    /// Leave the names of the bands out of the file.
    #[arg(long)]
    unnamed: bool,
    /// Rows of a plot [default: all].
    #[arg(long, value_name = "N")]
    plot_rows: Option<usize>,
    /// Length of a plot, metres [default: that of the rows].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    plot_length: Option<f64>,
    /// Bare alley between plots along the rows, metres [default: 0].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    alley: Option<f64>,
}

fn map(args: &MapArgs) -> Result<(), Error> {
    let mut scenario = args.field.scenario()?;
    let plots = &mut scenario.field.plots;
    plots.rows = args.plot_rows.unwrap_or(plots.rows);
    plots.length_m = args.plot_length.unwrap_or(plots.length_m);
    plots.alley_m = args.alley.unwrap_or(plots.alley_m);
    let options =
        MapOptions { samples: args.samples, bands: args.bands.clone(), named: !args.unnamed };
    let found = synth::write_map(&scenario, &options, &args.field.output, args.field.force)?;
    tracing::info!(
        "{}: {} plants in {} plots, {} x {} pixels of {} bands",
        args.field.output.display(),
        found.plants,
        found.plots,
        found.size_px[0],
        found.size_px[1],
        options.bands.len(),
    );
    Ok(())
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Layout")]
struct LayoutArgs {
    /// Number of rows [default: 6].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    rows: Option<usize>,
    /// Length of a row, metres [default: 5].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    row_length: Option<f64>,
    /// Distance between rows, metres [default: 0.76].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    inter_row: Option<f64>,
    /// Distance between planting sites along a row, metres [default: 0.2].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    spacing: Option<f64>,
    /// Standard deviation along the row, fraction of the spacing [default: 0.15].
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true)]
    jitter: Option<f64>,
    /// Fraction of empty sites [default: 0.05].
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true)]
    missing: Option<f64>,
    /// Fraction of planted sites with two plants, 3-6 cm apart [default: 0.03].
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true)]
    doubles: Option<f64>,
    /// How far the rows bow out in their middle, metres [default: 0].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    curve: Option<f64>,
    /// Direction of the rows, degrees counter-clockwise from the picture's u axis [default: 0].
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    heading: Option<f64>,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Plants and picture")]
struct LookArgs {
    /// Growth stage: early, mid or late [default: mid].
    #[arg(long, value_name = "STAGE")]
    stage: Option<GrowthStage>,
    /// Ground sampling distance, metres per pixel [default: 0.015].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    gsd: Option<f64>,
    /// Weeds per square metre [default: 0].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    weeds: Option<f64>,
}

impl MaskArgs {
    /// What to make: the defaults, then the preset or file, then the options.
    fn scenario(&self) -> Result<Scenario, Error> {
        fn set<T: Copy>(value: &mut T, option: Option<T>) {
            *value = option.unwrap_or(*value);
        }
        let mut scenario = match (&self.config, self.preset) {
            (Some(path), _) => synth::read_config(path)?,
            (None, Some(preset)) => Scenario::preset(preset),
            (None, None) => Scenario::default(),
        };
        let (field, layout, look) = (&mut scenario.field, &self.layout, &self.look);
        set(&mut field.seed, self.seed);
        set(&mut field.rows, layout.rows);
        set(&mut field.row_length_m, layout.row_length);
        set(&mut field.inter_row_m, layout.inter_row);
        set(&mut field.spacing_m, layout.spacing);
        set(&mut field.jitter_along, layout.jitter);
        set(&mut field.missing_fraction, layout.missing);
        set(&mut field.doubles_fraction, layout.doubles);
        set(&mut field.curve_m, layout.curve);
        set(&mut field.heading_deg, layout.heading);
        set(&mut field.stage, look.stage);
        set(&mut field.gsd_m, look.gsd);
        set(&mut scenario.corruption.weeds_per_m2, look.weeds);
        scenario.check().map_err(|error| Error::Argument(error.to_string()))?;
        Ok(scenario)
    }
}

fn mask(args: &MaskArgs) -> Result<(), Error> {
    let found = synth::write_field(&args.scenario()?, &args.output, args.force)?;
    tracing::info!(
        "{}: {} plants, {} x {} pixels, {} of them leaf",
        args.output.display(),
        found.plants,
        found.size_px[0],
        found.size_px[1],
        found.leaf_pixels,
    );
    Ok(())
}

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rowgram synth bundle --images 200 --points 40000 -o block.txt --truth truth.txt
  rowgram synth bundle --preset venice-1778 --seed 2 -o venice.txt --truth truth.txt")]
struct BundleArgs {
    /// BAL file to write, with the start values.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Also write the same measurements with the true values.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// A photo collection or a flight of the size of a known problem.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["images", "strips", "points"])]
    preset: Option<BlockPreset>,
    /// Number of images.
    #[arg(long, value_name = "N", default_value_t = 200, allow_negative_numbers = true)]
    images: usize,
    /// Number of strips; 0 makes the block about square.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    strips: usize,
    /// Number of ground points.
    #[arg(long, value_name = "N", default_value_t = 40_000, allow_negative_numbers = true)]
    points: usize,
    /// Standard deviation of each measured coordinate, pixels.
    #[arg(long, value_name = "PX", default_value_t = 0.5, allow_negative_numbers = true)]
    sigma_px: f64,
    /// Fraction of gross measurements.
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, allow_negative_numbers = true)]
    outliers: f64,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 1, allow_negative_numbers = true)]
    seed: u64,
}

fn bundle(args: &BundleArgs) -> Result<(), Error> {
    let named = args.preset.map(BlockSource::preset);
    let source = match named {
        Some(BlockSource::Collection(config)) => BlockSource::Collection(CollectionConfig {
            seed: args.seed,
            sigma_px: args.sigma_px,
            outlier_fraction: args.outliers,
            ..config
        }),
        Some(BlockSource::Flight(config)) => BlockSource::Flight(flight_errors(args, config)),
        None => BlockSource::Flight(flight_errors(
            args,
            BlockConfig {
                images: args.images,
                strips: args.strips,
                points: args.points,
                ..BlockConfig::default()
            },
        )),
    };
    let found = synth::write_block(&source, &args.output, args.truth.as_deref(), args.force)?;
    tracing::info!(
        "{}: {} images, {} points, {} observations",
        args.output.display(),
        found.images,
        found.points,
        found.observations,
    );
    Ok(())
}

fn flight_errors(args: &BundleArgs, config: BlockConfig) -> BlockConfig {
    BlockConfig {
        seed: args.seed,
        sigma_px: args.sigma_px,
        outlier_fraction: args.outliers,
        ..config
    }
}
