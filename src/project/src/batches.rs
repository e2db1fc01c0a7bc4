//! Parts of the long steps, for several processes or machines that share the folder of a project.
//!
//! What a part finds goes to the cache of its stage, where the stage itself finds it: its result does not depend on which parts were
//! done before. Parts of one step may be done at the same time, each step after all parts of the one before.

use super::{Project, Stage, align, run, stage, surface};
use rowgram_base::{error::Error, monitor::Monitor, options::Choice};
use rowgram_survey::mapping::dense::Pass;
use serde::{Deserialize, Serialize};
use std::{fmt, ops::Range, str::FromStr};

/// A step that can be done in parts, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BatchStep {
    /// Features of photos, of the stage align.
    Features,
    /// Matches of pairs of photos, of the stage align.
    Matches,
    /// Tiles of the surface with cells of twice the side, for the ground.
    SurfaceCoarse,
    /// Tiles of the surface.
    SurfaceFine,
}

rowgram_base::choices!(BatchStep: Features, Matches, SurfaceCoarse, SurfaceFine);

impl BatchStep {
    /// The stage that uses what the parts have found.
    pub fn stage(self) -> Stage {
        match self {
            BatchStep::Features | BatchStep::Matches => Stage::Align,
            BatchStep::SurfaceCoarse | BatchStep::SurfaceFine => Stage::Surface,
        }
    }
}

/// One of so many parts of some work, nearly as large as each other: `2/8`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Part {
    /// Which, from 1.
    number: usize,
    /// Of how many.
    of: usize,
}

impl Part {
    /// All of it.
    pub const WHOLE: Part = Part { number: 1, of: 1 };

    /// Part `number` (from 1) of `of`; `None` where there is no such part.
    pub fn new(number: usize, of: usize) -> Option<Part> {
        (1..=of).contains(&number).then_some(Part { number, of })
    }

    /// Which of `items` belong to it; none where there are fewer items than parts.
    pub fn range(self, items: usize) -> Range<usize> {
        items * (self.number - 1) / self.of..items * self.number / self.of
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

impl FromStr for Part {
    type Err = String;
    fn from_str(text: &str) -> Result<Part, String> {
        let numbers = text
            .split_once('/')
            .and_then(|(number, of)| Part::new(number.parse().ok()?, of.parse().ok()?));
        numbers.ok_or_else(|| format!("{text:?}: expected a part such as 2/8"))
    }
}

/// A part of a step, written `features:2/8`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Batch {
    /// The step.
    pub step: BatchStep,
    /// The part.
    pub part: Part,
}

impl fmt::Display for Batch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.step, self.part)
    }
}

impl FromStr for Batch {
    type Err = String;
    fn from_str(text: &str) -> Result<Batch, String> {
        let Some((step, part)) = text.split_once(':') else {
            return Err(format!("{text:?}: expected a step and a part, such as features:2/8"));
        };
        Ok(Batch { step: BatchStep::read(step)?, part: part.parse()? })
    }
}

/// What came of a part.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BatchOutcome {
    /// Photos, sets of pairs, or tiles that were looked at.
    pub items: usize,
    /// Whether the stage is done already, so that nothing had to be.
    pub stage_is_current: bool,
    /// Why the project has nothing to do for the stage, where that is so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// Does a part of a step, unless its stage is done and current. Other parts may be done at the same time. Having nothing to do is no
/// error, as in [`run::only`].
///
/// # Errors
/// As [`run::run`], and what the step says; a project on which a whole stage is at work.
pub fn perform(
    project: &Project,
    batch: Batch,
    monitor: &mut dyn Monitor,
) -> Result<BatchOutcome, Error> {
    run::check_input(project)?;
    project.config().validate()?;
    match work(project, batch, monitor) {
        Ok(Some(items)) => Ok(BatchOutcome { items, stage_is_current: false, reason: None }),
        Ok(None) => Ok(BatchOutcome { items: 0, stage_is_current: true, reason: None }),
        Err(Error::NothingToDo(why)) => {
            Ok(BatchOutcome { items: 0, stage_is_current: false, reason: Some(why) })
        }
        Err(error) => Err(error),
    }
}

/// Gives the number of items; `None` where the stage is current.
fn work(
    project: &Project,
    batch: Batch,
    monitor: &mut dyn Monitor,
) -> Result<Option<usize>, Error> {
    let config = project.config();
    let state = match batch.step.stage() {
        Stage::Surface => stage::state::<surface::SurfaceTask>(project, &config.surface)?,
        _ => stage::state::<align::AlignTask>(project, &config.align)?,
    };
    if state.is_current {
        return Ok(None);
    }
    let _shared = project.share()?;
    let part = batch.part;
    let items = match batch.step {
        BatchStep::Features => align::find_features(project, &config.align, part, monitor)?,
        BatchStep::Matches => align::match_pairs(project, &config.align, part, monitor)?,
        BatchStep::SurfaceCoarse => {
            surface::match_tiles(project, &config.surface, (Pass::Coarse, part), monitor)?
        }
        BatchStep::SurfaceFine => {
            surface::match_tiles(project, &config.surface, (Pass::Fine, part), monitor)?
        }
    };
    Ok(Some(items))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_all_of_it_and_do_not_overlap() {
        for (items, of) in [(10, 3), (2, 5), (0, 4), (512, 1), (7, 7)] {
            let parts = (1..=of).map(|number| Part::new(number, of).unwrap());
            let all: Vec<usize> = parts.flat_map(|part| part.range(items)).collect();
            assert_eq!(all, (0..items).collect::<Vec<_>>());
        }
        assert!(Part::new(0, 3).is_none() && Part::new(4, 3).is_none());
    }

    #[test]
    fn a_batch_is_read_as_it_is_written() {
        for text in ["features:1/1", "matches:2/8", "surface-coarse:3/3", "surface-fine:1/2"] {
            assert_eq!(text.parse::<Batch>().unwrap().to_string(), text);
        }
        for text in ["features", "features:0/2", "features:3/2", "dem:1/2", "features:a/b"] {
            let why = text.parse::<Batch>().unwrap_err();
            assert!(why.contains("expected"), "{text}: {why}");
        }
    }
}
