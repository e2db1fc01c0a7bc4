//! A shutter that rolls, in a block that is in the map.

use super::{
    Args, Finding,
    finish::{MARK, mark_demands, mark_scales, name_wrong_marks, typical_px},
    judge::demands,
    project::Project,
};
use crate::{
    error::Error,
    sfm::{
        block::Block,
        georeference::{Known, adjust, review_marks},
        shutter::{self, Drift},
    },
};

/// What is known of the shutter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Shutter {
    /// Looked for.
    Auto,
    /// All rows at once.
    Off,
    /// From the first to the last row.
    Seconds(f64),
}

impl std::str::FromStr for Shutter {
    type Err = String;

    fn from_str(text: &str) -> Result<Shutter, String> {
        match text {
            "auto" => Ok(Shutter::Auto),
            "off" => Ok(Shutter::Off),
            _ => match text.parse::<f64>() {
                Ok(seconds) if seconds > 0.0 && seconds <= 1.0 => Ok(Shutter::Seconds(seconds)),
                _ => Err("expected auto, off or a readout time above 0 and up to 1 s".into()),
            },
        }
    }
}

/// A readout time where nobody has told it, seconds: it only turns ways into velocities.
const USUAL_READOUT_S: f64 = 0.03;

/// What findings are about.
const SUBJECT: &str = "rolling shutter";

fn finding(drift: &Drift, args: &Args) -> Finding {
    let certain = matches!(args.rolling_shutter, Shutter::Seconds(_));
    Finding::new(
        SUBJECT,
        &format!(
            "while a photo is read its camera flies {:.2} m, {:.1} px on the ground (single photos +- {:.3} m): part of the adjustment{}",
            drift.way_m,
            drift.way_px,
            drift.spread_m,
            if certain { "" } else { " (--rolling-shutter off leaves it out)" }
        ),
    )
}

/// Says of a drift that was found what it is now.
pub(super) fn renewed(drift: &Drift, args: &Args, findings: &mut [Finding]) {
    if let Some(said) = findings.iter_mut().rfind(|finding| finding.subject == SUBJECT) {
        *said = finding(drift, args);
    }
}

/// A rolling shutter, where there is one: looked for, believed where it explains much, and then everything is
/// judged again.
pub(super) fn roll(
    block: &mut Block<'_>,
    known: &mut Known,
    project: &Project,
    args: &Args,
    sigma_px: &mut f64,
    findings: &mut Vec<Finding>,
) -> Result<(), Error> {
    let (readout_s, certain) = match args.rolling_shutter {
        Shutter::Off => return Ok(()),
        Shutter::Auto => (USUAL_READOUT_S, false),
        Shutter::Seconds(seconds) => (seconds, true),
    };
    let found = shutter::find(block, known, &project.flight(), *sigma_px, readout_s, certain)?;
    let Some(drift) = found else {
        if certain {
            findings.push(Finding::new(
                SUBJECT,
                "too few photos on straight strips to tell how they moved: not modelled",
            ));
        }
        return Ok(());
    };
    shutter::adopt(block, &drift);
    findings.push(finding(&drift, args));
    // Marks that were off by what the shutter does are right after all.
    let mark = |finding: &Finding| finding.subject.starts_with(MARK);
    findings.retain(|finding| !mark(finding));
    known.marks.clone_from(&project.known.marks);
    let review = review_marks(block, known, &mark_scales(project), &mark_demands(args));
    name_wrong_marks(&review, known, project, findings);
    for factor in [2.0, 1.0, 1.0] {
        let tolerance_px = (6.0 * factor * *sigma_px).max(0.1 * args.tolerance);
        adjust(block, known, *sigma_px, &demands(tolerance_px), 30)?;
        *sigma_px = typical_px(block).max(0.05);
    }
    Ok(())
}
