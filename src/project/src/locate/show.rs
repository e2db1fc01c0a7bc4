//! What was found of plants, in words and as a picture.

use crate::figures::View;
use image::Rgb;
use rowgram_base::monitor::{Diagnostic, Monitor};
use rowgram_optim::robust::median;
use rowgram_plants::phenotype::{
    locator::Found,
    stand::{Doubt, Stalk, Stand},
};
use rowgram_raster::overlay;

/// From this share of the leaf area on, what stands between the rows is worth a warning.
const BETWEEN_ROWS: f64 = 0.05;
/// From this share of the leaf area on, what is too small to be a plant is worth a warning.
const UNEXPLAINED: f64 = 0.1;
/// A row is thin with less than this share of the plants of the middle row, for its length.
const THIN: f64 = 0.6;

/// Tells what was found in a few words, and what no plant in a row explains.
pub(super) fn tell(stand: &Stand, subject: &str, monitor: &mut dyn Monitor) {
    let rows = stand.rows.rows.len();
    let thin = thin_rows(stand);
    let what = match (rows, thin) {
        (0, _) => None,
        (1, _) => Some("1 row".to_owned()),
        (_, 0) => Some(format!("{rows} rows")),
        (_, thin) => Some(format!("{rows} rows, {thin} of them thin")),
    };
    if let Some(what) = what {
        monitor.diagnostic(&Diagnostic::info("rows-found", subject, what));
    }
    if let Some(perspective) = stand.perspective {
        let message = format!(
            "rows converge, so the photo was not taken straight down: the scale at its lower edge is {:.2} times that in its middle; distances are in pixels of the middle",
            1.0 + perspective.convergence
        );
        monitor.diagnostic(&Diagnostic::info("photo-tilted", subject, message));
    }
    if let Some(between) = stand.between_rows.as_ref().filter(|of| of.leaf_share >= BETWEEN_ROWS) {
        let message = format!(
            "{:.0} % of the leaf area lies between the rows: weeds? {} patches of it were left out and are not counted as plants",
            100.0 * between.leaf_share,
            between.weeds.len()
        );
        monitor.diagnostic(
            &Diagnostic::warning("leaf-between-rows", subject, message).with_remedy(
                "look at figures/plants.png, where plants between the rows are violet, small if they were left out",
            ),
        );
    }
    for doubt in &stand.doubts {
        let (message, remedy) = match *doubt {
            Doubt::Uneven { missing, doubles } => (
                format!(
                    "{:.0} % of the places in the rows are without a plant and {:.0} % of the gaps lie between two plants in one place: no crop stands like that, so leaves or weeds may have been taken for plants",
                    100.0 * missing,
                    100.0 * doubles
                ),
                "look at figures/plants.png; give the number of plants (plants) where it is known",
            ),
            Doubt::Narrow { spacing_px, width_px } => (
                format!(
                    "plants of a row are {spacing_px:.1} px apart and {width_px:.1} px wide: they are not told apart, or leaves are taken for plants"
                ),
                "look at figures/plants.png; count on an earlier photo, or give the number of plants (plants)",
            ),
            Doubt::Crowded { spacing_px, leaf_px } => (
                format!(
                    "plants are {spacing_px:.1} px apart and leaves {leaf_px:.1} px wide: leaves that lie over each other hardly tell how many plants there are"
                ),
                "count on an earlier photo, or give the number of plants (plants)",
            ),
            Doubt::Closed if rows == 0 => (
                "leaves cover most of the picture: nothing tells plants apart, and their places and their number are guesses"
                    .to_owned(),
                "count on an earlier photo, or give the number of plants (plants)",
            ),
            Doubt::Closed => (
                "leaves have closed and show no blades: nothing tells plants apart, their places and their number are guesses, and plots have row_cover and row_gap_share instead"
                    .to_owned(),
                "count on an earlier photo, or give the number of plants (plants)",
            ),
            Doubt::NoRows => (
                "no rows stand out: patches of leaf are counted, each of which may be a plant, several that have grown together, or anything else that is green"
                    .to_owned(),
                "look at figures/plants.png; count on an earlier photo, or give the number of plants (plants)",
            ),
            Doubt::Specks { plant_px } => (
                format!("plants have {plant_px:.0} px of leaf and stand in no rows: they may be nothing but noise"),
                "look at figures/plants.png; take photos from lower above",
            ),
            Doubt::Unclear { share, leaf_share } => (
                format!(
                    "of {:.0} % of the picture it cannot be told by colour whether it is leaf ({:.0} % are taken for leaf): plants over grass, bad light, or noise?",
                    100.0 * share,
                    100.0 * leaf_share
                ),
                "look at figures/plants.png; take photos in better light, or where the ground is bare",
            ),
            Doubt::Wide { spacing_m, rows_m } => (
                format!(
                    "plants are {spacing_m:.1} m apart in their rows{}: no field crop stands like that; hedges, trees, or no plants at all?",
                    rows_m.map_or(String::new(), |rows_m| format!(", and rows {rows_m:.1} m"))
                ),
                "look at figures/plants.png; check the ground sampling distance",
            ),
            Doubt::Tight { spacing_m, rows_m } => (
                format!(
                    "plants are {:.1} cm apart in their rows{}: no field crop stands so close",
                    100.0 * spacing_m,
                    rows_m.map_or(String::new(), |rows_m| format!(", and rows {:.1} cm", 100.0 * rows_m))
                ),
                "check the ground sampling distance; look at figures/plants.png",
            ),
            Doubt::Large { plant_m2 } => (
                format!("plants have {plant_m2:.1} m2 of leaf each: no field crop does; trees, lawn, or a canopy that has closed?"),
                "look at figures/plants.png; check the ground sampling distance; count on an earlier photo",
            ),
        };
        monitor.diagnostic(
            &Diagnostic::warning("plants-implausible", subject, message).with_remedy(remedy),
        );
    }
    let Some(mass) = &stand.leaf_mass else { return };
    if mass.unexplained >= UNEXPLAINED {
        let message = format!(
            "{:.0} % of the leaf area is in {} specks too small to be plants: weeds, or other colours taken for leaf?",
            100.0 * mass.unexplained,
            mass.specks_px.len()
        );
        monitor.diagnostic(
            &Diagnostic::warning("leaf-without-plant", subject, message)
                .with_remedy("look at figures/plants.png, where specks are blue"),
        );
    }
}

/// Rows with far fewer plants for their length than the middle one.
fn thin_rows(stand: &Stand) -> usize {
    let rows = stand.row_counts.iter().zip(&stand.rows.rows);
    let density: Vec<f64> = rows.map(|(count, row)| count / row.length_px().max(1.0)).collect();
    let Some(middle) = median(density.iter().copied()) else { return 0 };
    density.iter().filter(|&&of| of < THIN * middle).count()
}

/// Plants in red, doubtful ones in orange, those between the rows in violet, small where they were left out as weeds; yellow where plants are missing; specks in blue;
/// rows as dotted white lines.
pub(super) fn draw(view: &mut View, found: &Found) {
    const SURE: Rgb<u8> = Rgb([255, 40, 40]);
    const DOUBTFUL: Rgb<u8> = Rgb([255, 150, 0]);
    const MISSING: Rgb<u8> = Rgb([255, 230, 60]);
    const BETWEEN: Rgb<u8> = Rgb([200, 60, 255]);
    const SPECK: Rgb<u8> = Rgb([60, 120, 255]);
    const ROW: Rgb<u8> = Rgb([255, 255, 255]);
    let step = view.step as f64;
    let radius = |px: f64| (px / step).clamp(2.0, 12.0) as u32;
    let mut points = |at_px: Vec<[f64; 2]>, colour, radius_px| {
        let at: Vec<[f64; 2]> = at_px.into_iter().map(|at| view.position(at)).collect();
        overlay::draw_points(&mut view.picture, &at, colour, radius_px);
    };
    match found {
        Found::Stand(stand) => {
            let radius_px = radius(stand.spacing.spacing / 4.0);
            points(stand.missing.iter().map(|gap| gap.position_px).collect(), MISSING, radius_px);
            if let Some(mass) = &stand.leaf_mass {
                points(mass.specks_px.clone(), SPECK, 2);
            }
            if let Some(between) = &stand.between_rows {
                points(between.weeds.iter().map(|weed| weed.position_px).collect(), BETWEEN, 2);
            }
            for row in &stand.rows.rows {
                let dots = (row.length_px() / (8.0 * step)).ceil() as usize;
                let at = |k: usize| [row.start_px + 8.0 * step * k as f64, row.across_px];
                points((0..=dots).map(|k| stand.image(at(k))).collect(), ROW, 1);
            }
            let (between, inside): (Vec<Stalk>, Vec<Stalk>) =
                stand.plants.iter().partition(|plant| stand.is_between_rows(plant));
            let (sure, doubtful): (Vec<Stalk>, Vec<Stalk>) =
                inside.into_iter().partition(|plant| plant.confidence >= 0.5);
            for (plants, colour) in [(between, BETWEEN), (sure, SURE), (doubtful, DOUBTFUL)] {
                points(plants.iter().map(|p| p.position_px).collect(), colour, radius_px);
            }
        }
        Found::Descent(found) => {
            let plants = found.located.plants.iter().map(|p| p.position_px).collect();
            points(plants, SURE, radius(found.located.mean_distance_px / 3.0));
        }
    }
}
