//! An adjustment that has a solution: what the observations leave undetermined is held or left out by name, so that the
//! rest of a block is there in any case.

use crate::{
    camera::Lens,
    problems::adjustment::{
        AdjustError, DataSnooping, DataSnoopingOptions, Settings, Undetermined, snoop, undetermined,
    },
    scene::Reconstruction,
    sfm::{
        block::Block,
        georeference::{Known, NEARLY_A_LINE, spread_across},
        tied::tied_groups,
    },
};
use rowgram_base::{error::Error, monitor::Diagnostic};
use rowgram_optim::engine::SolveError;
use std::collections::BTreeSet;

/// So many things are held or left out before an adjustment is given up.
const MOST_ATTEMPTS: usize = 12;
/// Fewer photos of one camera than this among many of another do not tell its lens.
const FEW_OF_CAMERA: usize = 3;
/// So many lens parameters that do not come to rest are held.
const MOST_HELD: usize = 2;
/// A group of images with so many positions or control points has a place of its own.
const OWN_DATUM: usize = 3;

/// Takes images out of a block that no points tie to most of it, unless positions or control points give their group a
/// place of its own.
pub(super) fn keep_tied(
    block: &mut Block<'_>,
    known: &Known,
    georeferenced: bool,
    found: &mut Vec<Diagnostic>,
) {
    for group in tied_groups(block).into_iter().skip(1) {
        if georeferenced && has_own_datum(&group, known) {
            continue;
        }
        for &image in &group {
            let subject = block.features[image].name.as_str();
            let message = match group.len() {
                1 => "too few points tie it to the rest of the block: left out".to_owned(),
                n => format!(
                    "too few points tie it and {} more to the rest of the block: left out",
                    n - 1
                ),
            };
            found.push(Diagnostic::warning("not-tied", subject, message));
            block.forget(image);
        }
    }
}

fn has_own_datum(group: &[usize], known: &Known) -> bool {
    let within = |image: u32| group.binary_search(&(image as usize)).is_ok();
    let of = known.positions.iter().filter(|position| within(position.image));
    let positions: Vec<[f64; 3]> = of.map(|position| position.position_m).collect();
    let control: BTreeSet<u32> = known
        .marks
        .iter()
        .filter(|mark| within(mark.image))
        .map(|mark| mark.ground)
        .filter(|&ground| known.ground[ground as usize].role == crate::scene::Role::Control)
        .collect();
    let spread = spread_across(&positions) > NEARLY_A_LINE;
    group.len() >= OWN_DATUM
        && (positions.len() >= OWN_DATUM && spread || control.len() >= OWN_DATUM)
}

/// [`snoop`], again and again without what the observations do not determine.
pub(super) fn snoop_determined(
    scene: &mut Reconstruction,
    settings: &mut Settings,
    snooping: &DataSnoopingOptions,
    found: &mut Vec<Diagnostic>,
) -> Result<DataSnooping, Error> {
    let nothing_left = |why: &str| {
        Error::Incomplete(format!("the photos fell apart while they were adjusted: {why}"))
    };
    let mut held = 0;
    for _ in 0..MOST_ATTEMPTS {
        if scene.images.len() < 2 {
            return Err(nothing_left("no two of them are tied to each other"));
        }
        let error = match snoop(scene, settings, snooping) {
            Ok(snooped) => match snooped.adjusted.creeping.last() {
                Some(&(camera, place)) if held < MOST_HELD && scene.cameras[camera].free[place] => {
                    held += 1;
                    hold(scene, camera, place, "does not come to rest", found);
                    continue;
                }
                _ => return Ok(snooped),
            },
            Err(error) => error,
        };
        if let AdjustError::Invalid(why) = &error
            && why.0.starts_with("no image is left")
        {
            return Err(nothing_left(&why.0));
        }
        let AdjustError::Solve(SolveError::RankDeficient(_)) = &error else {
            return Err(error.into());
        };
        // Points that hardly say how far away they are also make everything else look undetermined.
        let before = scene.observations.len();
        remove_flat_points(scene);
        if scene.observations.len() < before {
            tracing::debug!("{error}: points at small angles are left out");
            continue;
        }
        let what = undetermined(scene, settings).unwrap_or_default();
        tracing::debug!("{error}: {what:?}");
        if !leave_out(scene, settings, &what, found) {
            return Err(error.into());
        }
    }
    Ok(snoop(scene, settings, snooping)?)
}

fn hold(
    scene: &mut Reconstruction,
    camera: usize,
    place: usize,
    why: &str,
    found: &mut Vec<Diagnostic>,
) {
    let camera = &mut scene.cameras[camera];
    camera.free[place] = false;
    let name = camera.interior.parameters()[place].name;
    let subject = format!("{name} of camera {}", camera.name);
    let value = camera.interior.values()[place];
    let message = format!("it {why} in this block; held at {value:.6}");
    found.push(
        Diagnostic::warning("lens-parameter-held", subject, message)
            .with_remedy("calibrate the camera, or name what is free with [align] free"),
    );
}

/// Holds or leaves out what is undetermined; whether there was anything.
fn leave_out(
    scene: &mut Reconstruction,
    settings: &mut Settings,
    what: &Undetermined,
    found: &mut Vec<Diagnostic>,
) -> bool {
    // Of a few that cannot be told apart the one of the highest order goes.
    for (camera, places) in &what.lenses {
        let of = |k: &usize| scene.images[*k].camera == *camera;
        let own: Vec<usize> = (0..scene.images.len()).filter(of).collect();
        if own.len() < FEW_OF_CAMERA && own.len() + 3 <= scene.images.len() {
            for &image in &own {
                let subject = scene.images[image].name.as_str();
                let message =
                    "it has a camera of its own, and too little to find its lens: left out";
                found.push(Diagnostic::warning("not-tied", subject, message));
            }
            remove_images(scene, &own);
            return true;
        }
        let free = places.iter().copied().filter(|&place| scene.cameras[*camera].free[place]);
        if let Some(place) = free.max() {
            hold(scene, *camera, place, "cannot be told from others", found);
            return true;
        }
    }
    if !what.images.is_empty() && what.images.len() + 2 <= scene.images.len() {
        for &image in &what.images {
            let subject = scene.images[image].name.as_str();
            let message = "the observations do not determine its place in the block: left out";
            found.push(Diagnostic::warning("not-tied", subject, message));
        }
        remove_images(scene, &what.images);
        return true;
    }
    if what.datum > 0 && !settings.minimal_datum {
        settings.minimal_datum = true;
        let message = "camera positions and control do not fix how it lies: the first photo is held where it was found, and standard deviations are those against it";
        found.push(Diagnostic::error("datum-weak", "block", message));
        return true;
    }
    false
}

/// Rays that meet at less than this say little of how far away a point is, radians.
const FLAT_RAD: f64 = 0.01;

fn remove_flat_points(scene: &mut Reconstruction) {
    let centres: Vec<[f64; 3]> = scene.images.iter().map(|image| image.pose.centre_m()).collect();
    let mut of: Vec<Vec<[f64; 3]>> = vec![Vec::new(); scene.points.len()];
    for o in &scene.observations {
        of[o.point as usize].push(centres[o.image as usize]);
    }
    let wide: Vec<bool> = of
        .iter()
        .zip(&scene.points)
        .map(|(centres, point)| {
            crate::sfm::triangulate::widest_angle_rad(centres, point.position_m) >= FLAT_RAD
        })
        .collect();
    scene.observations.retain(|o| wide[o.point as usize]);
}

fn remove_images(scene: &mut Reconstruction, images: &[usize]) {
    let mut new = Vec::with_capacity(scene.images.len());
    let mut count = 0;
    for image in 0..scene.images.len() {
        let keeps = !images.contains(&image);
        new.push(keeps.then_some(count));
        count += u32::from(keeps);
    }
    let mut keeps = new.iter().map(Option::is_some);
    scene.images.retain(|_| keeps.next().unwrap_or(true));
    let place = |image: &mut u32| new[*image as usize].map(|place| *image = place).is_some();
    scene.observations.retain_mut(|o| place(&mut o.image));
    scene.marks.retain_mut(|m| place(&mut m.image));
    scene.positions.retain_mut(|p| place(&mut p.image));
    scene.orientations.retain_mut(|o| place(&mut o.image));
}
