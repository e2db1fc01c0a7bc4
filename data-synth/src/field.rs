//! What exists: rows of plants with their stalks and leaves.
//!
//! A row is a line of length `L` whose middle bows sideways by `c`. In the field's own axes, `s`
//! along the rows and `t` across them, with the origin in the middle of the field, site `k` of row
//! `r` (rows `r = 0..R-1`, distance `D`, spacing `d`) is planted at
//!
//! ```text
//! s = -L/2 + phase_r + k d + N(0, (jitter_along d)^2)
//! t = (r - (R-1)/2) D + c (1 - (2 s/L)^2) + N(0, jitter_across^2)
//! X = s cos(heading) + t sin(heading)
//! Y = s sin(heading) - t cos(heading)
//! ```
//!
//! with `phase_r` uniform in [0, d), the same for all rows of a grid. Metres; X east, Y north;
//! headings counter-clockwise from east, so that at heading 0 the rows follow the picture's columns
//! `u` from left to right and row 0 is the topmost. A site is missing with its probability, and
//! otherwise may hold a second plant 3 to 6 cm from the first.

use crate::{
    check::{self, ConfigError, within},
    habit::{Habit, PlotConfig, Stalk},
    leaf::{self, Leaf},
    panels::Panel,
    season::SeasonDay,
    streams::{Draw, Stage, pair, stream},
    terrain::{Terrain, TerrainConfig},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// Most plants of one field.
pub const MAX_PLANTS: f64 = 5e6;
/// Most pixels of one field's picture.
pub const MAX_PIXELS: f64 = 5e8;
/// Nearest and farthest that the two plants of a double are apart, metres.
pub const DOUBLE_DISTANCE_M: (f64, f64) = (0.03, 0.06);

/// How far the plants have grown; see [`GrowthStage::leaf_traits`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GrowthStage {
    /// 4-5 leaves of 8-18 cm.
    Early,
    /// 5-7 leaves of 18-38 cm.
    Mid,
    /// 7-9 leaves of 30-60 cm.
    Late,
}

/// How the leaves of a plant follow each other around the stalk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phyllotaxy {
    /// Alternately on opposite sides, in a plane of random azimuth (25 degrees of scatter).
    Distichous,
    /// In any direction.
    Random,
}

macro_rules! words {
    ($type:ident { $($word:literal = $variant:ident),+ }) => {
        impl FromStr for $type {
            type Err = String;
            fn from_str(word: &str) -> Result<Self, String> {
                match word {
                    $($word => Ok($type::$variant),)+
                    _ => Err(format!("expected one of: {}", [$($word),+].join(", "))),
                }
            }
        }
        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $($type::$variant => $word),+ })
            }
        }
    };
}
pub(crate) use words;
words!(GrowthStage { "early" = Early, "mid" = Mid, "late" = Late });
words!(Phyllotaxy { "distichous" = Distichous, "random" = Random });

/// The parameters of a field and of the raster over it. The default is six rows of 5 m at mid stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FieldConfig {
    /// Decides everything random.
    pub seed: u64,
    /// Number of rows.
    pub rows: usize,
    /// Length of a row, metres.
    pub row_length_m: f64,
    /// Distance between neighbouring rows, metres.
    pub inter_row_m: f64,
    /// Distance between neighbouring planting sites of a row, metres.
    pub spacing_m: f64,
    /// Standard deviation of a plant along its row, as a fraction of the spacing.
    pub jitter_along: f64,
    /// Standard deviation of a plant across its row, metres.
    pub jitter_across_m: f64,
    /// Probability that a site is empty.
    pub missing_fraction: f64,
    /// Probability that a site that is not empty holds two plants.
    pub doubles_fraction: f64,
    /// How far the middle of every row bows out sideways, metres.
    pub curve_m: f64,
    /// Direction of the rows, degrees counter-clockwise from east (the picture's u axis).
    pub heading_deg: f64,
    /// Whether the sites of all rows lie side by side.
    pub grid: bool,
    /// How far the plants have grown.
    pub stage: GrowthStage,
    /// How the leaves follow each other around the stalk.
    pub phyllotaxy: Phyllotaxy,
    /// How far stalks lean: root mean square horizontal distance from the base to the topmost
    /// collar, metres. Truth is the base.
    pub tilt_m: f64,
    /// Ground sampling distance, metres per pixel.
    pub gsd_m: f64,
    /// Bare ground shown around the rows, metres.
    pub margin_m: f64,
    /// How the rows are grouped into plots.
    pub plots: PlotConfig,
    /// The shape of the ground.
    pub terrain: TerrainConfig,
    /// Preferred directions, tillers, panicles, dying leaves, colours.
    pub habit: Habit,
    /// The day of a season on which the field is seen; without it the plants are as their stage says.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub season: Option<SeasonDay>,
}

impl Default for FieldConfig {
    fn default() -> FieldConfig {
        FieldConfig {
            seed: 1,
            rows: 6,
            row_length_m: 5.0,
            inter_row_m: 0.76,
            spacing_m: 0.2,
            jitter_along: 0.15,
            jitter_across_m: 0.01,
            missing_fraction: 0.05,
            doubles_fraction: 0.03,
            curve_m: 0.0,
            heading_deg: 0.0,
            grid: false,
            stage: GrowthStage::Mid,
            phyllotaxy: Phyllotaxy::Distichous,
            tilt_m: 0.0,
            gsd_m: 0.015,
            margin_m: 0.8,
            plots: PlotConfig::default(),
            terrain: TerrainConfig::default(),
            habit: Habit::default(),
            season: None,
        }
    }
}

impl FieldConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        check::seed(self.seed)?;
        within("rows", self.rows, 1..=100_000)?;
        within("row_length_m", self.row_length_m, 0.1..=10_000.0)?;
        within("inter_row_m", self.inter_row_m, 0.05..=10.0)?;
        within("spacing_m", self.spacing_m, 0.01..=10.0)?;
        within("jitter_along", self.jitter_along, 0.0..=1.0)?;
        within("jitter_across_m", self.jitter_across_m, 0.0..=1.0)?;
        within("missing_fraction", self.missing_fraction, 0.0..=1.0)?;
        within("doubles_fraction", self.doubles_fraction, 0.0..=1.0)?;
        within("curve_m", self.curve_m, -10.0..=10.0)?;
        within("heading_deg", self.heading_deg, -360.0..=360.0)?;
        within("tilt_m", self.tilt_m, 0.0..=1.0)?;
        within("gsd_m", self.gsd_m, 0.0005..=1.0)?;
        within("margin_m", self.margin_m, 0.0..=100.0)?;
        self.plots.check()?;
        self.terrain.check()?;
        self.habit.check()?;
        self.season.as_ref().map_or(Ok(()), SeasonDay::check)?;
        let sites = self.rows as f64 * (self.row_length_m / self.spacing_m + 1.0);
        if sites > MAX_PLANTS {
            let expected = format!(
                "at most {MAX_PLANTS} planting sites (these rows have {sites:.0} at this spacing)"
            );
            return Err(ConfigError::new("rows", self.rows, expected));
        }
        let frame = Frame::around(self, std::iter::empty());
        let pixels = f64::from(frame.width_px) * f64::from(frame.height_px);
        if pixels > MAX_PIXELS {
            let expected = format!(
                "at most {MAX_PIXELS} pixels (this field has {pixels:.0} at this distance)"
            );
            return Err(ConfigError::new("gsd_m", self.gsd_m, expected));
        }
        Ok(())
    }

    /// The seed of what differs from one flight to the next over the same field: trajectory, receiver, exposure, noise, clicks,
    /// weeds. Without a season it is the field's.
    pub fn flight_seed(&self) -> u64 {
        self.season.as_ref().map_or(self.seed, |season| season.flight_seed(self.seed))
    }

    /// Direction of the rows, radians counter-clockwise from east.
    pub fn heading_rad(&self) -> f64 {
        self.heading_deg.to_radians()
    }

    /// From the field's axes (along, across), metres, to the mapping frame (X, Y), metres.
    pub fn ground(&self, along_m: f64, across_m: f64) -> [f64; 2] {
        let (sin, cos) = self.heading_rad().sin_cos();
        [along_m * cos + across_m * sin, along_m * sin - across_m * cos]
    }

    /// From the mapping frame (X, Y), metres, to the field's axes (along, across), metres.
    pub fn along_across(&self, x_m: f64, y_m: f64) -> [f64; 2] {
        let (sin, cos) = self.heading_rad().sin_cos();
        [x_m * cos + y_m * sin, x_m * sin - y_m * cos]
    }

    /// Where the middle line of `row` lies across the field at `along_m`, metres.
    pub fn row_across(&self, row: usize, along_m: f64) -> f64 {
        let q = 2.0 * along_m / self.row_length_m;
        (row as f64 - 0.5 * (self.rows as f64 - 1.0)) * self.inter_row_m
            + self.curve_m * (1.0 - q * q)
    }
}

/// The raster over a field: north up, `u` east, `v` south.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// X of the centre of the top-left pixel, metres.
    pub left_m: f64,
    /// Y of the centre of the top-left pixel, metres.
    pub top_m: f64,
    /// Ground sampling distance, metres per pixel.
    pub gsd_m: f64,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

impl Frame {
    /// The smallest frame that keeps the margin around all row ends, row middles and `stalks`.
    fn around(config: &FieldConfig, stalks: impl Iterator<Item = [f64; 2]>) -> Frame {
        let half = 0.5 * config.row_length_m;
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let corners = [0, config.rows - 1].into_iter().flat_map(|row| {
            [-half, 0.0, half].map(|along| config.ground(along, config.row_across(row, along)))
        });
        for point in corners.chain(stalks) {
            for axis in 0..2 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        let size = |axis: usize| {
            ((high[axis] - low[axis] + 2.0 * config.margin_m) / config.gsd_m).ceil() as u32 + 1
        };
        Frame {
            left_m: low[0] - config.margin_m,
            top_m: high[1] + config.margin_m,
            gsd_m: config.gsd_m,
            width_px: size(0),
            height_px: size(1),
        }
    }

    /// The pixel position (u, v) of a point of the mapping frame.
    pub fn pixel(&self, x_m: f64, y_m: f64) -> [f64; 2] {
        [(x_m - self.left_m) / self.gsd_m, (self.top_m - y_m) / self.gsd_m]
    }

    /// The point (X, Y) of the mapping frame at a pixel position, metres.
    pub fn ground(&self, u_px: f64, v_px: f64) -> [f64; 2] {
        [self.left_m + u_px * self.gsd_m, self.top_m - v_px * self.gsd_m]
    }
}

/// One plant.
#[derive(Debug, Clone, PartialEq)]
pub struct Plant {
    /// Row, from 0.
    pub row: usize,
    /// Planting site within the row, from 0.
    pub site: usize,
    /// Whether this is the second plant of its site.
    pub second: bool,
    /// Plot, from 0, numbered along the rows first.
    pub plot: usize,
    /// Stalk base, X in metres.
    pub x_m: f64,
    /// Stalk base, Y in metres.
    pub y_m: f64,
    /// Stalk base, Z in metres: the height of the ground there.
    pub z_m: f64,
    /// Stalk base, column in pixels.
    pub u_px: f64,
    /// Stalk base, row of the picture in pixels.
    pub v_px: f64,
    /// From the stalk base to the topmost collar, (X, Y) in metres.
    pub tilt_m: [f64; 2],
    /// The main stalk, then the tillers.
    pub stalks: Vec<Stalk>,
    /// Leaves, lowest first; those of the main stalk before those of the tillers. Heights are above the
    /// ground at the stalk's base; [`Field::leaf_axis_m`] places them in the mapping frame.
    pub leaves: Vec<Leaf>,
}

/// A field: the whole truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// What it was made from.
    pub config: FieldConfig,
    /// The raster over it.
    pub frame: Frame,
    /// The ground.
    pub terrain: Terrain,
    /// Plants by row, site, and first before second.
    pub plants: Vec<Plant>,
    /// Panels of known reflectance beside it.
    pub panels: Vec<Panel>,
}

impl Field {
    /// Plants a field.
    ///
    /// # Errors
    /// As [`FieldConfig::check`].
    pub fn plant(config: &FieldConfig) -> Result<Field, ConfigError> {
        config.check()?;
        let terrain = Terrain::new(config);
        let mut plants: Vec<Plant> =
            (0..config.rows).into_par_iter().flat_map_iter(|row| plant_row(config, row)).collect();
        let frame = Frame::around(config, plants.iter().map(|plant| [plant.x_m, plant.y_m]));
        plants.par_iter_mut().for_each(|plant| {
            [plant.u_px, plant.v_px] = frame.pixel(plant.x_m, plant.y_m);
            plant.z_m = terrain.height_m(plant.x_m, plant.y_m);
        });
        Ok(Field { config: config.clone(), frame, terrain, plants, panels: Vec::new() })
    }

    /// Every leaf of every plant, in their order.
    pub fn leaves(&self) -> impl Iterator<Item = &Leaf> {
        self.plants.iter().flat_map(|plant| &plant.leaves)
    }

    /// The axis of a leaf in the mapping frame (X, Y, Z), metres: raised to the ground at its plant, and
    /// kept above the ground along its way.
    pub fn leaf_axis_m(&self, base_z_m: f64, leaf: &Leaf) -> [[f64; 3]; leaf::NODES] {
        leaf.axis_m.map(|[x_m, y_m, z_m]| {
            let ground_m = self.terrain.height_m(x_m, y_m) + leaf::GROUND_M;
            [x_m, y_m, (base_z_m + z_m).max(ground_m)]
        })
    }
}

fn plant_row(config: &FieldConfig, row: usize) -> Vec<Plant> {
    let start = if config.grid { 0 } else { row as u64 };
    let phase_m = stream(config.seed, Stage::RowStart, start).between(0.0, config.spacing_m);
    let last = ((config.row_length_m - phase_m) / config.spacing_m).floor();
    // A row shorter than its first site is empty: a negative number becomes no site at all.
    let sites = (last + 1.0).max(0.0) as usize;
    (0..sites).flat_map(|site| plant_site(config, row, site, phase_m)).collect()
}

/// Draws always the same numbers in the same order, so that changing one parameter moves nothing
/// that does not depend on it.
fn plant_site(
    config: &FieldConfig,
    row: usize,
    site: usize,
    phase_m: f64,
) -> impl Iterator<Item = Plant> {
    let item = pair(row, site);
    let mut rng = stream(config.seed, Stage::Site, item);
    let missing = rng.unit() < config.missing_fraction;
    let along_m = phase_m - 0.5 * config.row_length_m + site as f64 * config.spacing_m;
    let along_m = along_m + config.jitter_along * config.spacing_m * rng.normal();
    let across_m = config.row_across(row, along_m) + config.jitter_across_m * rng.normal();
    let double = rng.unit() < config.doubles_fraction;
    let apart_m = rng.between(DOUBLE_DISTANCE_M.0, DOUBLE_DISTANCE_M.1);
    // The planter drops both seeds into the furrow: nearly along the row, either way.
    let apart_rad = 0.35 * rng.normal() + if rng.unit() < 0.5 { 0.0 } else { std::f64::consts::PI };
    let first = [along_m, across_m];
    let second = [along_m + apart_m * apart_rad.cos(), across_m + apart_m * apart_rad.sin()];
    let count = if missing { 0 } else { 1 + usize::from(double) };
    [first, second].into_iter().take(count).enumerate().filter_map(
        move |(index, [along, across])| {
            let from_start_m = along + 0.5 * config.row_length_m;
            let plot = config.plots.plot(config.rows, config.row_length_m, row, from_start_m)?;
            let base_m = config.ground(along, across);
            let mut rng = stream(config.seed, Stage::Plant, (item << 1) | index as u64);
            let lean_m = config.tilt_m * std::f64::consts::FRAC_1_SQRT_2;
            let tilt_m = [lean_m * rng.normal(), lean_m * rng.normal()];
            let mut habit_rng = stream(config.seed, Stage::Habit, (item << 1) | index as u64);
            let (stalks, leaves) = leaf::plant(config, base_m, tilt_m, &mut rng, &mut habit_rng);
            let [x_m, y_m] = base_m;
            let second = index == 1;
            // The raster and the ground give the rest once all plants are known.
            let (z_m, u_px, v_px) = (0.0, 0.0, 0.0);
            let plant = Plant {
                row,
                site,
                second,
                plot,
                x_m,
                y_m,
                z_m,
                u_px,
                v_px,
                tilt_m,
                stalks,
                leaves,
            };
            match &config.season {
                Some(season) => season.grown(config, plant),
                None => Some(plant),
            }
        },
    )
}
