//! The frame in which a reconstruction's coordinates are: horizontal, vertical, unit.

use rowgram_raster::{
    crs::{Crs, LocalPlane},
    georeference,
};
use serde::{Deserialize, Serialize};

/// Where X and Y live.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum HorizontalFrame {
    /// A projected coordinate reference system: X east, Y north.
    Projected {
        /// Its name as it was given, e.g. `EPSG:32616`.
        name: String,
        /// Its EPSG code, where it has one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        epsg: Option<u32>,
        /// Its PROJ string.
        definition: String,
    },
    /// That of the control points, whose system nobody named: X east, Y north.
    Unnamed,
    /// A plane that touches the ellipsoid WGS84: X east, Y north from this place.
    LocalPlane {
        /// Latitude of the origin, degrees.
        latitude_deg: f64,
        /// Longitude of the origin, degrees.
        longitude_deg: f64,
        /// Height of the origin above the ellipsoid, metres.
        height_m: f64,
    },
    /// None: position and orientation mean nothing.
    #[default]
    Free,
}

impl From<&Crs> for HorizontalFrame {
    fn from(crs: &Crs) -> HorizontalFrame {
        let (name, definition) = (crs.name().to_owned(), crs.definition().to_owned());
        HorizontalFrame::Projected { name, epsg: crs.epsg(), definition }
    }
}

impl From<&LocalPlane> for HorizontalFrame {
    fn from(plane: &LocalPlane) -> HorizontalFrame {
        let [latitude_deg, longitude_deg, height_m] = plane.origin();
        HorizontalFrame::LocalPlane { latitude_deg, longitude_deg, height_m }
    }
}

/// The system of the maps of a reconstruction, in metres: by its EPSG code, else by its PROJ string; a frame of its own without either.
impl From<&ReferenceFrame> for georeference::Crs {
    fn from(reference: &ReferenceFrame) -> georeference::Crs {
        let horizontal = match &reference.horizontal {
            HorizontalFrame::Projected { epsg: Some(epsg), .. } => {
                georeference::Crs::projected(*epsg)
            }
            _ => reference
                .definition()
                .and_then(|definition| Crs::of_definition(definition).ok())
                .map_or(georeference::Crs::LOCAL, |system| (&system).into()),
        };
        let vertical_epsg = match reference.vertical {
            VerticalFrame::Known { epsg } => Some(epsg),
            _ => None,
        };
        georeference::Crs { vertical_epsg, ..horizontal }
    }
}

/// What heights are above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum VerticalFrame {
    /// The surface of a vertical coordinate reference system.
    Known {
        /// Its EPSG code.
        epsg: u32,
    },
    /// Whatever the heights of the control points are above.
    ControlPoints,
    /// Whatever the heights of the camera positions are above: the ellipsoid, or a receiver's model of the geoid.
    CameraPositions,
    /// Nobody knows.
    #[default]
    Unknown,
}

/// The unit of lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LengthUnit {
    /// The metre.
    Metre,
    /// Some length: the reconstruction has no scale.
    #[default]
    Arbitrary,
}

/// The frame in which coordinates are. By default nothing is known of it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReferenceFrame {
    /// Where X and Y live.
    pub horizontal: HorizontalFrame,
    /// What Z is above.
    pub vertical: VerticalFrame,
    /// The unit of all three.
    pub unit: LengthUnit,
}

impl ReferenceFrame {
    /// Whether lengths are metres.
    pub fn has_scale(&self) -> bool {
        self.unit == LengthUnit::Metre
    }

    /// The PROJ string of the projected coordinate reference system, where there is one.
    pub fn definition(&self) -> Option<&str> {
        match &self.horizontal {
            HorizontalFrame::Projected { definition, .. } => Some(definition),
            _ => None,
        }
    }

    /// What people and files call the horizontal frame.
    pub fn name(&self) -> String {
        match &self.horizontal {
            HorizontalFrame::Projected { name, .. } => name.clone(),
            HorizontalFrame::Unnamed => "that of the control points (not named)".to_owned(),
            HorizontalFrame::LocalPlane { latitude_deg, longitude_deg, .. } => format!(
                "local east, north, up at latitude {latitude_deg:.7}, longitude {longitude_deg:.7} (WGS84)"
            ),
            HorizontalFrame::Free if self.has_scale() => "free (no north)".to_owned(),
            HorizontalFrame::Free => "free (no scale, no north)".to_owned(),
        }
    }

    /// What heights are above, for people.
    pub fn heights(&self) -> String {
        match self.vertical {
            VerticalFrame::Known { epsg } => format!("EPSG:{epsg}"),
            VerticalFrame::ControlPoints => "those of the control points (vertical datum unknown)".to_owned(),
            VerticalFrame::CameraPositions => "those of the camera positions (vertical datum unknown: in most photos the ellipsoid or a geoid model of the receiver)".to_owned(),
            VerticalFrame::Unknown => "unknown".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_of_a_frame_is_in_its_system_with_or_without_a_code() {
        let definition = "+proj=utm +zone=16 +datum=WGS84";
        let of = |words: &str| {
            let horizontal = HorizontalFrame::from(&Crs::from_words(words).unwrap());
            georeference::Crs::from(&ReferenceFrame { horizontal, ..Default::default() })
        };
        assert_eq!(of("EPSG:32616"), georeference::Crs::projected(32616));
        let own = of(definition);
        assert_eq!((own.epsg, own.definition), (None, Some(definition)));
        assert_eq!(own.kind, georeference::CrsKind::Projected);
    }

    #[test]
    fn a_frame_says_what_it_has() {
        let free = ReferenceFrame::default();
        assert!(!free.has_scale() && free.definition().is_none());
        assert_eq!(free.name(), "free (no scale, no north)");
        let grid = ReferenceFrame {
            horizontal: HorizontalFrame::Projected {
                name: "EPSG:32616".into(),
                epsg: Some(32616),
                definition: "+proj=utm +zone=16".into(),
            },
            vertical: VerticalFrame::Known { epsg: 5703 },
            unit: LengthUnit::Metre,
        };
        assert!(grid.has_scale());
        assert_eq!(grid.heights(), "EPSG:5703");
        let text = serde_json::to_string(&grid).unwrap();
        assert!(text.contains("\"kind\":\"projected\"") && text.contains("\"unit\":\"metre\""));
        assert_eq!(serde_json::from_str::<ReferenceFrame>(&text).unwrap(), grid);
    }
}
