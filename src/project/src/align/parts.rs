//! Parts of the steps that look at photos and compare them; see [`crate::batches`].

use super::{AlignOptions, AlignTask, Task, features, inputs, inputs::Inputs, matches::Matching};
use crate::{CACHE, Project, Stage, batches::Part, record::Cache};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_optim::output::FileError;

fn prepare(
    project: &Project,
    options: &AlignOptions,
    monitor: &mut dyn Monitor,
) -> Result<(Inputs, Cache), Error> {
    AlignTask::inputs(project, options)?;
    let folder = project.folder(Stage::Align);
    std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
    let cache = Cache::new(&folder.join(CACHE))?;
    let inputs = inputs::inspect(project, options, Some(&cache), monitor)?;
    Ok((inputs, cache))
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
    let (inputs, cache) = prepare(project, options, monitor)?;
    let search = (&options.detection(), options.enlarge);
    features::find_part(&inputs, search, part, &cache, monitor)
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
    let (inputs, cache) = prepare(project, options, monitor)?;
    let search = (&options.detection(), options.enlarge);
    let extracted = features::features(&inputs, search, false, &cache, monitor)?;
    Matching::new(&inputs, &extracted, options.seed, &cache)?.part(part, monitor, drop)
}
