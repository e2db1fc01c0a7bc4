//! A block in the map, adjusted and judged: round by round with what is known, then the shutter, a last look at the
//! photos, and what of it all cannot be right.

use super::{
    Args, Finding,
    again::{self, Photos},
    finish::typical_px,
    project::Project,
    roll,
    stages::gsd_m,
};
use crate::{
    error::Error,
    nlls::Loss,
    problems::adjustment::{
        Adjusted, DataSnoopingOptions, Group, Removed, Settings, retained_suspects, snoop,
    },
    scene::{Reconstruction, Role},
    sfm::{
        block::Block,
        georeference::{self, Known, PositionFit, adjust, weigh_positions},
        growth::Growing,
        triangulate::Demands,
    },
};

/// Where a block comes from.
pub(super) struct Way {
    pub(super) georeferenced: bool,
    /// Standard deviations of camera positions that somebody has told, image by image.
    pub(super) told: Vec<Option<[f64; 3]>>,
    /// What control is off by at most before it is adjusted, metres.
    pub(super) loosest_m: f64,
}

/// The block as it was judged.
pub(super) struct Judged {
    pub(super) survey: Reconstruction,
    pub(super) adjusted: Adjusted,
    pub(super) removed: Vec<Removed>,
    pub(super) complete: bool,
    /// Check points as the project has them, not those that were made ones.
    pub(super) checks: Vec<String>,
}

/// Pixels, on the ground or in a photo, that control, marks and camera positions may be off by without
/// being taken out: what flights with a cheap lens leave at their borders.
const LEAST_ERROR_PX: f64 = 6.0;

/// Control that is this many times as far off as half of it is wrong.
const GROSS: f64 = 8.0;

/// Control that is believed to no better than `sigma_m`.
fn eased(known: &Known, sigma_m: f64) -> Known {
    let mut known = known.clone();
    for point in &mut known.ground {
        point.sigma_m = point.sigma_m.map(|sigma| sigma.max(sigma_m));
    }
    known
}

/// The control point that the block contradicts most, and by how many metres.
fn worst_control(block: &Block<'_>, known: &Known, sigma_m: f64) -> Option<(usize, f64)> {
    let left = georeference::control_left_m(block, known);
    if left.len() < 4 {
        return None;
    }
    let mut sorted: Vec<f64> = left.iter().map(|(_, left)| *left).collect();
    sorted.sort_by(f64::total_cmp);
    let half = sorted[sorted.len() / 2];
    let (place, most) = left.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let given = known.ground[place].sigma_m.iter().copied().fold(0.0, f64::max);
    (most > GROSS * half && most > GROSS * given && most > sigma_m).then_some((place, most))
}

/// What rays must be like.
pub(super) fn demands(tolerance_px: f64) -> Demands {
    Demands { tolerance_px, least_angle_rad: Growing::default().least_angle_rad }
}

/// Adjusts a block with what is known and judges it.
///
/// # Errors
/// Where it cannot be evaluated.
pub(super) fn judge(
    block: Block<'_>,
    mut known: Known,
    way: &Way,
    (project, photos): (&Project, &Photos<'_>),
    args: &Args,
    findings: &mut Vec<Finding>,
) -> Result<Judged, Error> {
    // Outlive the block that may be over them.
    let (tracks, measured);
    let mut block = block;
    let mut sigma_px: f64 = 1.0;
    for round in 0..4 {
        if way.georeferenced && !known.positions.is_empty() {
            let fit = weigh_positions(&block, &mut known, &way.told);
            if let Some(PositionFit { together: [across, up], .. }) = &fit {
                tracing::debug!(
                    "errors of camera positions are alike over {across:.1} photos, heights {up:.1}"
                );
            }
            for (image, distance) in fit.iter().flat_map(|fit| &fit.outliers) {
                findings.push(Finding::new(
                    &project.photos[*image as usize].name,
                    &format!(
                        "its position is {distance:.1} m from where the block puts it: not used"
                    ),
                ));
            }
        }
        let widest_px = if round == 0 { 2.0 * args.tolerance } else { args.tolerance };
        let tolerance = demands((6.0 * sigma_px).max(0.1 * args.tolerance).min(widest_px));
        // A free block is bent: control first draws it gently into shape, and what then still does
        // not fit is wrong, before the rest is taken at its word.
        let gentle = [1.0, 0.1, 0.01, 0.0][round] * way.loosest_m;
        adjust(&mut block, &eased(&known, gentle), sigma_px, &tolerance, 30)?;
        if round < 3 {
            while let Some((place, left)) = worst_control(&block, &known, gentle) {
                known.ground[place].role = Role::Check;
                findings.push(Finding::new(
                    &format!("control point {}", known.ground[place].name),
                    &format!(
                        "its coordinates are {left:.2} m from where the block puts it: not used as control"
                    ),
                ));
                adjust(&mut block, &eased(&known, gentle), sigma_px, &tolerance, 30)?;
            }
        }
        sigma_px = typical_px(&block).max(0.05);
        tracing::debug!(
            "adjusted: {:.3} px, {} points",
            sigma_px,
            block.points.iter().flatten().count()
        );
    }
    if way.georeferenced {
        roll::roll(&mut block, &mut known, project, args, &mut sigma_px, findings)?;
    }
    let flight = project.flight();
    let settled = |block: &mut Block<'_>,
                   sigma_px: &mut f64,
                   findings: &mut Vec<Finding>|
     -> Result<(), Error> {
        if let Some(drift) = again::settle(block, &known, &flight, args.tolerance, sigma_px)? {
            roll::renewed(&drift, args, findings);
        }
        Ok(())
    };
    if args.look_again.wanted(&known) {
        tracks = again::tracks(&block, photos);
        block = block.over(block.features, &tracks);
        settled(&mut block, &mut sigma_px, findings)?;
    }
    if args.remeasure.wanted(&known) {
        measured = again::remeasured(&block, &project.photos, findings)?;
        block = block.over(&measured.0, &measured.1);
        settled(&mut block, &mut sigma_px, findings)?;
    }
    let (mut survey, _, order) = block.survey(None);
    known.attach(&mut survey, &order);
    survey.tie_sigma_px = sigma_px;
    let checks = survey
        .ground
        .iter()
        .filter(|point| point.role == Role::Check)
        .filter(|point| {
            project.known.ground.iter().any(|p| p.name == point.name && p.role == Role::Check)
        })
        .map(|point| point.name.clone())
        .collect();
    // Without a map the first photo and the distance to the farthest one are the frame.
    let minimal_datum = !way.georeferenced;
    let settings = Settings { tie_loss: Loss::SoftL1(2.0), minimal_datum, ..Settings::default() };
    let snooping = DataSnoopingOptions {
        rounds: 8,
        least_error_m: LEAST_ERROR_PX * gsd_m(&survey),
        least_error_px: LEAST_ERROR_PX,
        ..DataSnoopingOptions::default()
    };
    let snooped = snoop(&mut survey, &settings, &snooping)?;
    for removed in &snooped.removed {
        if removed.group != Group::TiePoints {
            findings.push(Finding::new(
                &removed.name,
                &format!(
                    "the rest of the block puts it {} away: taken out ({:.1} times the critical value)",
                    far(removed),
                    removed.excess
                ),
            ));
        }
    }
    for doubt in retained_suspects(&snooped.adjusted, &settings, &snooping) {
        findings.push(Finding::new(
            &doubt.name,
            &format!(
                "the rest of the block puts it {} away, more than its accuracy says ({:.1} times the critical value); kept",
                far(&doubt),
                doubt.excess
            ),
        ));
    }
    Ok(Judged {
        survey,
        adjusted: snooped.adjusted,
        removed: snooped.removed,
        complete: snooped.complete,
        checks,
    })
}

/// How far off something is, in its unit.
fn far(removed: &Removed) -> String {
    let distance = removed.error.iter().map(|e| e * e).sum::<f64>().sqrt();
    if removed.group == Group::Marks {
        format!("{distance:.1} px")
    } else {
        format!("{distance:.3} m")
    }
}
