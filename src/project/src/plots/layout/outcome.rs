//! What came of a layout, in numbers and in words.

use super::{Laid, LayoutOptions, few};
use rowgram_base::monitor::{Diagnostic, Monitor};
use rowgram_plants::{
    phenotype::layout::{
        Plan,
        design::FieldCorner,
        refine::{Alternative, PlotEvidence, Refinement},
    },
    problems::plot_layout::{AFFINE, BEND, Placement, corners::CornerFit, fit::Scatter},
};
use rowgram_raster::georeference::Crs;
use serde::{Deserialize, Serialize};

/// A surveyed corner against the layout that was fitted to all of them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CornerResidual {
    /// Which corner.
    pub corner: FieldCorner,
    /// Surveyed minus fitted along the rows, metres.
    pub along_m: f64,
    /// The same across the rows, to the left.
    pub across_m: f64,
}

/// A number with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// How a layout was moved onto the rows that were found: against where it was before, about its middle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefinedLayout {
    /// Shift along the rows, metres.
    pub shift_along_m: Estimate,
    /// Shift across the rows, to the left, metres.
    pub shift_across_m: Estimate,
    /// Rotation counter-clockwise, degrees.
    pub rotation_deg: Estimate,
    /// Stretch along the rows; of 0.01, a metre becomes 1.01 m.
    pub stretch_along: Estimate,
    /// Stretch across the rows.
    pub stretch_across: Estimate,
    /// Shear, degrees.
    pub shear_deg: Estimate,
    /// Numbers of the bend, metres: of the Legendre polynomials of degrees 2 to 4 over the length of the field.
    pub bend_m: [Estimate; BEND],
    /// How far the outermost plants stay from the ends of plots, metres.
    pub end_margin_m: Estimate,
    /// Scatter of pieces of rows about their row, metres.
    pub piece_scatter_m: f64,
    /// Scatter of rows about their places, metres.
    pub row_scatter_m: f64,
    /// Scatter of the outermost plants about the end of their row, metres.
    pub end_scatter_m: f64,
    /// Rows that were found, and those of them that lie on rows of the layout.
    pub found_rows: usize,
    /// Rows that were found on rows of the layout.
    pub used_rows: usize,
    /// Pieces of rows that took part.
    pub pieces: usize,
    /// Ends of rows that took part.
    pub ends: usize,
    /// Distance between the rows that were found, metres.
    pub row_spacing_m: Option<f64>,
    /// Other places where the layout may lie.
    pub alternatives: Vec<Alternative>,
}

/// A plot of a layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotOutcome {
    /// Its name.
    pub plot: String,
    /// The largest standard deviations of its corners along and across the rows, metres.
    pub sigma_m: Option<[f64; 2]>,
    /// What was found of it, where the layout was compared with rows.
    pub evidence: Option<PlotEvidence>,
}

/// A layout in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LayoutOutcome {
    /// The code of its reference system, where it has one.
    pub epsg: Option<u32>,
    /// Direction of the rows, degrees counter-clockwise from east.
    pub heading_deg: f64,
    /// Its corners, where it was made of some.
    pub corners: Vec<CornerResidual>,
    /// How it was moved onto rows, where it was.
    pub refined: Option<RefinedLayout>,
    /// Its plots.
    pub plots: Vec<PlotOutcome>,
}

/// Alternatives are told from these odds on.
const TOLD_ODDS: f64 = 0.05;
/// Corners are told from so many standard deviations on.
const TOLD_SIGMAS: f64 = 3.0;
/// Rows of a plot that are so much of the row spacing beside their places are told.
const TOLD_BESIDE: f64 = 0.2;
/// A plot with fewer plants than this share of the middle one is told.
const TOLD_EMPTY: f64 = 0.1;

pub(super) fn of(
    laid: &Laid,
    before: &Placement,
    refinement: Option<&Refinement>,
    crs: Crs,
) -> LayoutOutcome {
    let plots = laid.plan.plots.iter().enumerate().map(|(k, plot)| PlotOutcome {
        plot: plot.name.clone(),
        sigma_m: laid.covariance.as_ref().map(|covariance| {
            let corners = plot.rings.iter().flatten();
            corners.fold([0.0; 2], |worst: [f64; 2], &at| {
                let sigma = laid.placement.sigma_m(covariance, at);
                [worst[0].max(sigma[0]), worst[1].max(sigma[1])]
            })
        }),
        evidence: refinement.map(|of| of.plots[k]),
    });
    LayoutOutcome {
        epsg: crs.epsg,
        heading_deg: (laid.placement.heading_rad + laid.placement.affine[2]).to_degrees(),
        corners: laid.corners.clone(),
        refined: refinement.map(|found| refined(before, found)),
        plots: plots.collect(),
    }
}

fn refined(before: &Placement, found: &Refinement) -> RefinedLayout {
    let fit = &found.fit;
    let sigma = |k: usize| fit.covariance[k][k].max(0.0).sqrt();
    let of = |k: usize, unit: f64| Estimate {
        value: (fit.placement.affine[k] - before.affine[k]) * unit,
        sigma: sigma(k) * unit,
    };
    let degrees = 1f64.to_degrees();
    let Scatter { sample_m, row_m, end_m, .. } = fit.scatter;
    RefinedLayout {
        shift_along_m: of(0, 1.0),
        shift_across_m: of(1, 1.0),
        rotation_deg: of(2, degrees),
        stretch_along: of(3, 1.0),
        stretch_across: of(4, 1.0),
        shear_deg: of(5, degrees),
        bend_m: std::array::from_fn(|k| Estimate {
            value: fit.placement.bend_m[k],
            sigma: sigma(AFFINE + k),
        }),
        end_margin_m: Estimate { value: fit.margin_m, sigma: fit.margin_sigma_m },
        piece_scatter_m: sample_m,
        row_scatter_m: row_m,
        end_scatter_m: end_m,
        found_rows: found.found_rows,
        used_rows: found.used_rows,
        pieces: found.observations.rows.len(),
        ends: found.observations.ends.len(),
        row_spacing_m: found.row_spacing_m,
        alternatives: found.alternatives.clone(),
    }
}

/// Says where corners and design contradict each other.
pub(super) fn tell_corners(
    file: &str,
    residuals: &[CornerResidual],
    fitted: &CornerFit,
    options: &LayoutOptions,
    monitor: &mut dyn Monitor,
) {
    let far =
        |of: &&CornerResidual| of.along_m.hypot(of.across_m) > TOLD_SIGMAS * options.corner_sigma_m;
    let far: Vec<String> = residuals
        .iter()
        .filter(far)
        .map(|of| format!("{} {:.2} m", of.word(), of.along_m.hypot(of.across_m)))
        .collect();
    let [_, _, _, along, across, shear] = fitted.placement.affine;
    let stretched =
        [along, across].into_iter().any(|a| a.abs() > TOLD_SIGMAS * options.stretch_sigma);
    let sheared = shear.abs() > TOLD_SIGMAS * options.shear_sigma_deg.to_radians();
    if far.is_empty() && !stretched && !sheared {
        return;
    }
    let misfit = match far.is_empty() {
        true => String::new(),
        false => format!(", corners are off by {}", far.join(", ")),
    };
    let message = format!(
        "the corners do not fit the design: stretch along {:+.1} %, across {:+.1} %, shear {:+.2} degrees{misfit}",
        100.0 * along,
        100.0 * across,
        shear.to_degrees()
    );
    monitor.diagnostic(&Diagnostic::warning("layout-corners-misfit", file, message).with_remedy(
        "check the names of the corners, plots_to, alley_m, plot_gap_m and the lengths of the design",
    ));
}

impl LayoutOutcome {
    /// Says what of the layout is doubtful.
    pub(super) fn tell(
        &self,
        plan: &Plan,
        refinement: Option<&Refinement>,
        monitor: &mut dyn Monitor,
    ) {
        let Some(found) = refinement else { return };
        let mut tell = |code: &'static str, message: String, remedy: &str| {
            monitor.diagnostic(&Diagnostic::warning(code, "layout", message).with_remedy(remedy));
        };
        let likely: Vec<String> = found
            .alternatives
            .iter()
            .filter(|other| other.odds > TOLD_ODDS)
            .map(|other| {
                let (metres, direction) = match other.along_m == 0.0 {
                    true => (other.across_m, "across"),
                    false => (other.along_m, "along"),
                };
                let share = other.odds / (1.0 + other.odds);
                format!("{metres:+.2} m {direction} the rows (probability {:.0} %)", 100.0 * share)
            })
            .collect();
        if !likely.is_empty() {
            tell(
                "layout-ambiguous",
                format!(
                    "the rows fit the layout nearly as well with a shift of {}",
                    likely.join(", ")
                ),
                "survey the corners better and say so (position_sigma_m), or look at figures/layout.png",
            );
        }
        if found.observations.ends.is_empty() {
            tell(
                "layout-ends-unseen",
                "no ends of plots show, so the place along the rows is that of the corners or polygons".to_owned(),
                "map a larger area, or survey the corners better",
            );
        }
        let mut counts: Vec<usize> = found.plots.iter().map(|plot| plot.plants).collect();
        counts.sort_unstable();
        let middle = counts[counts.len() / 2] as f64;
        let names = |is: &dyn Fn(&PlotEvidence) -> bool| -> Vec<&str> {
            let plots = plan.plots.iter().zip(&found.plots).filter(|(_, of)| is(of));
            plots.map(|(plot, _)| plot.name.as_str()).collect()
        };
        let empty = names(&|of| (of.plants as f64) < TOLD_EMPTY * middle);
        if !empty.is_empty() {
            tell(
                "layout-plots-empty",
                format!("{} plots have next to no plants: {}", empty.len(), few(&empty)),
                "name places without a plot in missing_plots or missing_ranges",
            );
        }
        let beside = TOLD_BESIDE * plan.row_spacing_m;
        let off = names(&|of| of.pieces > 0 && of.across_m.abs() > beside);
        if !off.is_empty() {
            tell(
                "layout-plots-beside",
                format!("rows of {} plots lie beside their places: {}", off.len(), few(&off)),
                "set plot_shift_sigma_m so that plots move by themselves",
            );
        }
    }
}
