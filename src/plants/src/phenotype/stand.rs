//! What stands in a field: plants with their uncertainty, spacings, gaps, counts.
//!
//! Positions and lengths in pixels of the mask, centre of the top-left pixel at (0, 0).

use super::{
    broad_leaves, evidence, perspective::Perspective, plant_spacing::Spacing, row_cover,
    row_evidence::LEAVES_APART, rows::Rows,
};
use rowgram_raster::Mask;
use serde::{Deserialize, Serialize};

/// The 97.5 % point of the standard normal distribution.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

/// The fewest plants that say where their row is.
const LEAST: f64 = 5.0;

/// Places where plants are missing with less probability are not told.
pub(super) const LEAST_MISSING: f64 = 0.05;

/// Plants farther from every row than this share of the distance between rows stand between rows.
pub(super) const BETWEEN: f64 = 0.25;

/// One plant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stalk {
    /// Position in the image.
    pub position_px: [f64; 2],
    /// Number of its row, counted across the rows; 0 where there are none.
    pub row: usize,
    /// Place along the rows.
    pub along_px: f64,
    /// Probability that a plant stands within a quarter of the spacing.
    pub confidence: f64,
    /// Standard deviation along the row.
    pub sigma_along_px: f64,
    /// Standard deviation across the row.
    pub sigma_across_px: f64,
}

/// A place between two plants of a row where some seem to be missing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gap {
    /// Its row.
    pub row: usize,
    /// The middle of the gap, in the image.
    pub position_px: [f64; 2],
    /// Length of the gap.
    pub length_px: f64,
    /// The most probable number of missing plants, at least 1.
    pub plants: usize,
    /// Probability that any is missing.
    pub probability: f64,
}

/// What the leaf mass says, where plants are told by it.
#[derive(Debug, Clone, PartialEq)]
pub struct LeafMass {
    /// Leaf pixels of one plant.
    pub plant_px: f64,
    /// Share of the leaf pixels that no plant explains: specks.
    pub unexplained: f64,
    /// Middles of leaf areas too small to be plants.
    pub specks_px: Vec<[f64; 2]>,
}

/// What grows between the rows.
#[derive(Debug, Clone, PartialEq)]
pub struct BetweenRows {
    /// Share of the leaf pixels that belong to plants between the rows; weeds that were left out among them.
    pub leaf_share: f64,
    /// Plants between the rows that were taken for weeds and left out.
    pub weeds: Vec<Weed>,
}

/// A plant that is none of the crop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weed {
    /// Its middle, pixels.
    pub position_px: [f64; 2],
    /// Its leaf pixels.
    pub leaf_px: f64,
}

/// Why what was found may be no plants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Doubt {
    /// No stand of a crop has so many places without a plant and as many with two.
    Uneven {
        /// Share of the places without a plant.
        missing: f64,
        /// Share of the gaps between two plants in one place.
        doubles: f64,
    },
    /// Plants of a row are nearer to each other than they are wide.
    Narrow {
        /// The distance between them.
        spacing_px: f64,
        /// Diameter of a disc with the leaf area of a plant; where leaf area tells no plants, the width of the rows.
        width_px: f64,
    },
    /// Leaves are so wide that they hardly tell how far apart plants are.
    Crowded {
        /// The distance between plants of a row.
        spacing_px: f64,
        /// Width of leaves, or of the areas of leaf where they lie over each other.
        leaf_px: f64,
    },
    /// Leaves have closed and show no blades, or cover most of a picture without rows: nothing tells plants apart.
    Closed,
    /// No rows stand out: patches of leaf are plants of some crop, or something else that is green.
    NoRows,
    /// No rows stand out, and plants are as small as noise.
    Specks {
        /// Leaf pixels of a plant.
        plant_px: f64,
    },
    /// Much of the picture has colours of which it cannot be told whether they are leaf: crowns over grass, bad light, noise.
    Unclear {
        /// Its share of the picture.
        share: f64,
        /// The share that is taken for leaf.
        leaf_share: f64,
    },
    /// Plants of a row, or rows, are farther apart than those of a field crop.
    Wide {
        /// The distance between plants.
        spacing_m: f64,
        /// The distance between rows, where there are several.
        rows_m: Option<f64>,
    },
    /// Plants of a row, or rows, are nearer to each other than those of a field crop.
    Tight {
        /// The distance between plants.
        spacing_m: f64,
        /// The distance between rows, where there are several.
        rows_m: Option<f64>,
    },
    /// Plants have more leaf than those of a field crop.
    Large {
        /// Leaf area of a plant, seen from above.
        plant_m2: f64,
    },
}

impl Doubt {
    /// What it makes of plants and their number. Not fitted: the sets have too few stands of each kind. Without rows potatoes are counted within their interval (`potato_uav`), and
    /// what is no crop has no number at all.
    fn weight(&self) -> DoubtWeight {
        let [confidence, wider, half_width] = match self {
            Doubt::NoRows => [0.7, 1.0, 0.0],
            // Plants at the likeliest distance, whatever that is.
            Doubt::Closed => [0.3, 4.0, 1.0],
            // Crowns over grass (`olive_trees`): 0.6 for a precision of 0.01 to 0.17 in three pictures, and of none to two thirds in three.
            Doubt::Unclear { .. } | Doubt::Specks { .. } => [0.2, 4.0, 1.0],
            // Their confidence is low enough: 0.61 for a precision of 0.89 on 16 masks of maps of fields of 12 to 15 cm.
            Doubt::Crowded { .. } => [1.0, 2.0, 0.0],
            // As few as if plants were as far apart as they are wide.
            Doubt::Narrow { spacing_px, width_px } => [0.7, 2.0, 1.0 - spacing_px / width_px],
            _ => [0.7, 2.0, 0.0],
        };
        DoubtWeight { confidence, wider, half_width }
    }
}

/// What a doubt makes of plants and their number.
struct DoubtWeight {
    /// Confidence of the plants as a share of what it is without doubt.
    confidence: f64,
    /// How many times as wide the interval of their number is.
    wider: f64,
    /// Half the width of that interval at least, as a share of the number.
    half_width: f64,
}

/// Plants of a field crop stand nearer than this within their row, metres. Bananas and melons need 2 to 3; vines, hedges and orchards are no field crops. Assumed,
/// not measured.
const WIDEST_SPACING_M: f64 = 3.0;
/// Rows of a field crop are nearer to each other than this, metres: bananas and pumpkins need 2 to 3.5. Assumed likewise.
const WIDEST_ROWS_M: f64 = 4.0;
/// Plants of a field crop stand farther apart than this within their row, metres: cereals drilled with 400 grains a square metre at 0.12 m between
/// rows have 0.02. Assumed likewise.
const NEAREST_SPACING_M: f64 = 0.01;
/// Rows of a field crop are farther apart than this, metres: drilled cereals have 0.1 to 0.15. Assumed likewise.
const NEAREST_ROWS_M: f64 = 0.05;
/// Leaf area of a plant of a field crop, seen from above, at most, m2: a disc 3 m wide. Assumed likewise.
const LARGEST_PLANT_M2: f64 = 7.0;
/// Colours are unclear where so many pixels may be leaf or not ([`unsure_pixels`]), as a share of the picture, or as a multiple of what is taken for
/// leaf. 40 maize plots, 40 seedling clips, 50 photos of young maize, potatoes, sorghum and soybean and 19 synthetic maps have 0.13 and 4.7 at most; of ten pictures of trees three have 0.18 to 0.32,
/// three others 5.5 to 18. Chosen with the trees in view.
const UNCLEAR: (f64, f64) = (0.16, 5.0);
/// Without rows, plants with less leaf are no larger than noise: grey noise of 20 levels (400 x 500 pixels, `rowgram locate`) has plants of 5 pixels, those of seedling clips 64 and more.
const MIN_PLANT_PX: f64 = 16.0;
/// Without rows, leaves that cover more of the picture have grown together: discs at random cover a third where most of them touch. Assumed.
const MAX_COVER: f64 = 0.5;

/// How many pixels may be leaf or not: their probability, in 1/255, is between a tenth and nine tenths.
pub(super) fn unsure_pixels(posterior: &[u8]) -> usize {
    posterior.iter().filter(|p| (26..230).contains(*p)).count()
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Stand {
    /// The plants, by row and along the row.
    pub plants: Vec<Stalk>,
    /// The rows, straight as detected, each through the middle of its plants; none where plants are told by their mass and no rows
    /// stand out.
    pub rows: Rows,
    /// The spacing of the plants within their rows; its length in pixels of the mask.
    pub spacing: Spacing,
    /// Standard error of the spacing.
    pub spacing_sigma_px: f64,
    /// 95 % interval of the number of plants; just the number where it was told.
    pub count_interval: [f64; 2],
    /// Expected number of plants in each row.
    pub row_counts: Vec<f64>,
    /// Standard deviation of the number of plants in each row.
    pub row_count_sigmas: Vec<f64>,
    /// Gaps in which plants seem to be missing, by row and along the row.
    pub missing: Vec<Gap>,
    /// What the leaf mass says, where plants are told by it.
    pub leaf_mass: Option<LeafMass>,
    /// What grows between the rows, where there are rows and soil between leaves tells.
    pub between_rows: Option<BetweenRows>,
    /// Why what was found may be no plants; nothing where it is like the stand of a crop.
    pub doubts: Vec<Doubt>,
    /// The perspective of a picture whose rows converge: rows and lengths are then those of its level picture.
    pub perspective: Option<Perspective>,
}

impl Stand {
    /// A position in the picture along and across the rows.
    pub fn aligned(&self, position_px: [f64; 2]) -> [f64; 2] {
        let level = self.perspective.map(|perspective| perspective.level_px(position_px));
        self.rows.axes.aligned(level.unwrap_or(position_px))
    }

    /// Where the picture shows a place along and across the rows.
    pub fn image(&self, aligned: [f64; 2]) -> [f64; 2] {
        let level = self.rows.axes.image(aligned);
        self.perspective.map_or(level, |perspective| perspective.photo_px(level))
    }

    /// Distance between rows and its standard error, where there is more than one.
    pub fn row_spacing_px(&self) -> Option<(f64, f64)> {
        let spacing = self.rows.spacing_px?;
        let errors: Vec<f64> = self
            .rows
            .rows
            .windows(2)
            .map(|pair| {
                let gap = pair[1].across_px - pair[0].across_px;
                gap - spacing * (gap / spacing).round()
            })
            .collect();
        let count = errors.len() as f64;
        let variance = errors.iter().map(|e| e * e).sum::<f64>() / (count - 1.0).max(1.0);
        Some((spacing, (variance / count).sqrt()))
    }

    /// Looks for what no stand of a crop is like; sizes only where a pixel is known to be `gsd_m` wide. Where there is such, plants are less
    /// sure and their number has a wider interval. Whether leaves have closed is looked for in the mask; `unsure_px` of its pixels may be leaf or not ([`unsure_pixels`]).
    pub(super) fn doubt(&mut self, gsd_m: Option<f64>, mask: Option<&Mask>, unsure_px: usize) {
        let Spacing { spacing, missing, doubles, .. } = self.spacing;
        if self.spacing.is_implausible() {
            self.doubts.push(Doubt::Uneven { missing, doubles });
        }
        match &self.leaf_mass {
            Some(mass) => {
                let width_px = 2.0 * (mass.plant_px / std::f64::consts::PI).sqrt();
                if !self.rows.rows.is_empty() && spacing < width_px {
                    self.doubts.push(Doubt::Narrow { spacing_px: spacing, width_px });
                }
            }
            None => {
                let solid = mask.and_then(|mask| row_cover::solid_rows(mask, &self.rows));
                let has_closed = solid.as_ref().is_some_and(|rows| rows.is_closed);
                if has_closed || mask.is_some_and(broad_leaves::is_broad) {
                    self.doubts.push(Doubt::Closed);
                } else if let Some(width_px) =
                    solid.map(|rows| rows.width_px).filter(|&width_px| spacing < width_px)
                {
                    self.doubts.push(Doubt::Narrow { spacing_px: spacing, width_px });
                }
                let leaf_px = mask.map_or(0.0, evidence::stroke_px);
                if spacing < LEAVES_APART * leaf_px {
                    self.doubts.push(Doubt::Crowded { spacing_px: spacing, leaf_px });
                }
            }
        }
        let shares =
            mask.map(|mask| [unsure_px, mask.count()].map(|n| n as f64 / mask.data.len() as f64));
        let [share, leaf_share] = shares.unwrap_or_default();
        if share > UNCLEAR.0.min(UNCLEAR.1 * leaf_share) {
            self.doubts.push(Doubt::Unclear { share, leaf_share });
        }
        if self.rows.rows.is_empty() {
            self.doubts.push(Doubt::NoRows);
            if leaf_share > MAX_COVER {
                self.doubts.push(Doubt::Closed);
            }
            let plant_px = self.leaf_mass.as_ref().map(|mass| mass.plant_px);
            if let Some(plant_px) = plant_px.filter(|&px| px < MIN_PLANT_PX) {
                self.doubts.push(Doubt::Specks { plant_px });
            }
        }
        if let Some(gsd_m) = gsd_m {
            let spacing_m = gsd_m * spacing;
            let rows_m = self.rows.spacing_px.map(|px| gsd_m * px);
            let are_wide = rows_m.is_some_and(|rows_m| rows_m > WIDEST_ROWS_M);
            let are_tight = rows_m.is_some_and(|rows_m| rows_m < NEAREST_ROWS_M);
            if (spacing_m > WIDEST_SPACING_M || are_wide) && !self.rows.rows.is_empty() {
                self.doubts.push(Doubt::Wide { spacing_m, rows_m });
            }
            if (spacing_m < NEAREST_SPACING_M || are_tight) && !self.rows.rows.is_empty() {
                self.doubts.push(Doubt::Tight { spacing_m, rows_m });
            }
            let plant_m2 = self.leaf_mass.as_ref().map(|mass| gsd_m * gsd_m * mass.plant_px);
            if let Some(plant_m2) = plant_m2.filter(|&area| area > LARGEST_PLANT_M2) {
                self.doubts.push(Doubt::Large { plant_m2 });
            }
        }
        let strongest = self.doubts.iter().map(Doubt::weight).reduce(|a, b| DoubtWeight {
            confidence: a.confidence.min(b.confidence),
            wider: a.wider.max(b.wider),
            half_width: a.half_width.max(b.half_width),
        });
        let Some(DoubtWeight { confidence, wider, half_width }) = strongest else { return };
        self.plants.iter_mut().for_each(|plant| plant.confidence *= confidence);
        self.row_count_sigmas.iter_mut().for_each(|sigma| *sigma *= wider);
        let [low, high] = self.count_interval;
        let half = 0.5 * (high - low);
        let more = ((wider - 1.0) * half).max(half_width * self.plants.len() as f64 - half);
        self.count_interval = [(low - more).max(0.0), high + more];
    }

    /// The number of plants is known where it was told.
    pub(super) fn set_told_number(&mut self, count: Option<usize>) {
        if let Some(count) = count {
            self.count_interval = [count as f64; 2];
        }
    }

    /// Puts the rows through the middle of their plants, [`LEAST`] or more, and fits the distance between rows to that.
    ///
    /// Rows are detected by leaf mass, whose middle is less exact than that of the plants.
    pub(super) fn refit_rows(&mut self) {
        let axes = self.rows.axes;
        let mut sums = vec![[0.0; 2]; self.rows.rows.len()];
        for plant in &self.plants {
            let [count, across] = &mut sums[plant.row];
            *count += 1.0;
            *across += axes.aligned(plant.position_px)[1];
        }
        for (row, [count, across]) in self.rows.rows.iter_mut().zip(&sums) {
            if *count >= LEAST {
                row.across_px = across / count;
            }
        }
        let Some(spacing) = self.rows.spacing_px else { return };
        let first = self.rows.rows.first().map_or(0.0, |row| row.across_px);
        let mut fit = [0.0; 5];
        for (row, [count, _]) in self.rows.rows.iter().zip(&sums) {
            let number = ((row.across_px - first) / spacing).round();
            let terms = [1.0, number, row.across_px, number * number, number * row.across_px];
            fit.iter_mut().zip(terms).for_each(|(sum, term)| *sum += count * term);
        }
        let [weight, number, across, square, product] = fit;
        let spread = weight * square - number * number;
        if spread > 0.0 {
            self.rows.spacing_px = Some((weight * product - number * across) / spread);
        }
    }

    /// Whether a plant told by its leaf mass stands between two rows, farther than a quarter of their distance from either.
    pub fn is_between_rows(&self, plant: &Stalk) -> bool {
        let row = self.rows.rows.get(plant.row).filter(|_| self.leaf_mass.is_some());
        let away = |at: f64| (self.aligned(plant.position_px)[1] - at).abs();
        row.zip(self.rows.spacing_px)
            .is_some_and(|(row, spacing)| away(row.across_px) > BETWEEN * spacing)
    }

    /// The ground that the rows stand on: their lengths times the distance between them.
    pub fn area_px2(&self) -> Option<f64> {
        let length: f64 = self.rows.rows.iter().map(|row| row.length_px()).sum();
        self.rows.spacing_px.map(|spacing| spacing * length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{phenotype::rows::Row, problems::plants::lines::Axes};

    #[test]
    fn rows_go_through_the_middle_of_their_plants() {
        let axes = Axes { heading_rad: 0.3, origin_px: [40.0, 90.0] };
        let row = |across_px| Row { across_px, start_px: 0.0, end_px: 100.0, pixels: 10 };
        // Detected 1 px off by turns; one place without a row; one row with next to no plants.
        let rows = Rows {
            axes,
            rows: vec![row(-1.0), row(51.0), row(149.0), row(203.0)],
            spacing_px: Some(50.5),
            contrast: 0.5,
        };
        let plant = |row: usize, along: f64, across: f64| Stalk {
            position_px: axes.image([along, across]),
            row,
            along_px: along,
            confidence: 1.0,
            sigma_along_px: 1.0,
            sigma_across_px: 1.0,
        };
        let mut plants = vec![plant(3, 20.0, 190.0)];
        for (row, across) in [0.0, 50.0, 150.0].into_iter().enumerate() {
            let both = [-2.0, 2.0].map(|off| across + off);
            plants.extend((0..10).map(|k| plant(row, 10.0 * k as f64, both[k % 2])));
        }
        let mut stand = Stand {
            plants,
            rows,
            spacing: Spacing::new(10.0),
            spacing_sigma_px: 0.1,
            count_interval: [25.0, 35.0],
            row_counts: vec![],
            row_count_sigmas: vec![],
            missing: vec![],
            leaf_mass: None,
            between_rows: None,
            doubts: vec![],
            perspective: None,
        };
        stand.refit_rows();
        let across: Vec<f64> = stand.rows.rows.iter().map(|row| row.across_px).collect();
        for (found, expected) in across.iter().zip([0.0, 50.0, 150.0, 203.0]) {
            approx::assert_relative_eq!(*found, expected, epsilon = 1e-9);
        }
        // Places 0, 1, 3, 4 at 0, 50, 150, 203, with ten plants each and one: 83240 / 1660 by the normal equations.
        approx::assert_relative_eq!(
            stand.rows.spacing_px.unwrap(),
            83240.0 / 1660.0,
            epsilon = 1e-9
        );
    }
}
