//! What took no part in a reconstruction, and why.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Kinds of things that can be excluded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum ExcludedKind {
    /// A photo, with everything in it.
    #[serde(rename = "image")]
    Image,
    /// A tie point.
    #[serde(rename = "tie point")]
    TiePoint,
    /// A measurement of a tie point in an image.
    #[serde(rename = "observation")]
    Observation,
    /// A measurement of a ground point in an image.
    #[serde(rename = "mark")]
    Mark,
    /// A ground point, or its coordinates.
    #[serde(rename = "ground point")]
    GroundPoint,
    /// A measured distance.
    #[serde(rename = "scale bar")]
    ScaleBar,
    /// A measured camera position.
    #[serde(rename = "camera position")]
    CameraPosition,
}

rowgram_base::choices!(
    ExcludedKind: Image, TiePoint, Observation, Mark, GroundPoint, ScaleBar, CameraPosition
);

/// Something that takes no part in the adjustment, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Excluded {
    /// What it is.
    pub kind: ExcludedKind,
    /// The image it is about, if any.
    pub image: Option<String>,
    /// The tie point's number or the ground point's name, if any.
    pub point: Option<String>,
    /// Why.
    pub reason: String,
}

impl fmt::Display for Excluded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.kind)?;
        if let Some(point) = &self.point {
            write!(f, " {point}")?;
        }
        if let Some(image) = &self.image {
            let within = if self.kind == ExcludedKind::Image { "" } else { "in " };
            write!(f, " {within}{image}")?;
        }
        write!(f, ": {}", self.reason)
    }
}
