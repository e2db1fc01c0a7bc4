//! Parts of the steps that look at photos and compare them; see [`crate::batches`].

use super::{AlignOptions, AlignTask, Task, features, inputs, inputs::Inputs, matches::Matching};
use crate::{Project, Stage, batches::Part, record::Store};
use rowgram_base::{error::Error, monitor::Monitor};

fn prepare(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<(Inputs, Store), Error> {
    AlignTask::inputs(project, options)?;
    let store = project.store(Stage::Align);
    let inputs = inputs::inspect(project, options, Some(&store), monitor)?;
    Ok((inputs, store))
}

/// Finds the features of a part of the photos and keeps them for [`super::align`]. Gives the number of these photos.
///
/// # Errors
/// As [`super::align`].
pub fn find_features(
    project: &Project,
    options: &AlignOptions,
    part: Part,
    monitor: &mut dyn Monitor,
) -> Result<usize, Error> {
    let (inputs, store) = prepare(project, options, monitor)?;
    let search = (&options.detection(), options.enlarge);
    features::find_part(&inputs, search, part, &store, monitor)
}

/// Matches a part of the pairs of photos and keeps the matches for [`super::align`]; features that are not kept are looked for. Gives the
/// number of sets of pairs.
///
/// # Errors
/// As [`super::align`].
pub fn match_pairs(
    project: &Project,
    options: &AlignOptions,
    part: Part,
    monitor: &mut dyn Monitor,
) -> Result<usize, Error> {
    let (inputs, store) = prepare(project, options, monitor)?;
    let search = (&options.detection(), options.enlarge);
    let extracted = features::features(&inputs, search, false, &store, monitor)?;
    Matching::new(&inputs, &extracted, options.seed, &store).part(part, monitor, drop)
}
