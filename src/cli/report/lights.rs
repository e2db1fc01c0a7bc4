//! Traffic lights: what is well, what should be looked at, what should not be used as it is.

use super::{
    Limits,
    facts::{Facts, number},
};
use serde::Serialize;
use serde_json::Value;

/// Reprojection errors beyond these are not well, and bad, pixels.
const REPROJECTION_PX: [f64; 2] = [1.0, 2.0];
/// Shares of photos below these are not well, and bad.
const ORIENTED: [f64; 2] = [1.0, 0.9];
/// Factors between given and found standard deviations.
const SIGMA0: [f64; 2] = [2.0, 4.0];
/// Mean confidences of plants below these.
const CONFIDENCE: [f64; 2] = [0.7, 0.5];

/// A colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Colour {
    Green,
    Yellow,
    Red,
    /// Nothing is known.
    Grey,
}

impl Colour {
    pub(super) fn word(self) -> &'static str {
        match self {
            Colour::Green => "green",
            Colour::Yellow => "yellow",
            Colour::Red => "red",
            Colour::Grey => "grey",
        }
    }

    /// The same for those who do not tell colours apart.
    pub(super) fn meaning(self) -> &'static str {
        match self {
            Colour::Green => "good",
            Colour::Yellow => "look at it",
            Colour::Red => "bad",
            Colour::Grey => "not known",
        }
    }

    /// Green up to the first limit, yellow up to the second.
    fn rising(value: f64, [yellow, red]: [f64; 2]) -> Colour {
        if value <= yellow {
            Colour::Green
        } else if value <= red {
            Colour::Yellow
        } else {
            Colour::Red
        }
    }
}

/// A light.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Light {
    pub(super) name: &'static str,
    pub(super) colour: Colour,
    pub(super) why: String,
}

/// The lights of a run.
pub(super) fn lights(facts: &Facts, limits: &Limits) -> Vec<Light> {
    let mut lights = Vec::new();
    let mut add = |name, colour, why: String| lights.push(Light { name, colour, why });
    let align = facts.says("align");
    if let (Some(registered), Some(images)) =
        (number(align, "/registered"), number(align, "/images"))
    {
        let share = registered / images.max(1.0);
        let colour = Colour::rising(-share, ORIENTED.map(|limit| -limit));
        add("Photos oriented", colour, format!("{registered} of {images}"));
    }
    if let Some(rms) = number(align, "/reprojection_rms_px") {
        let colour = Colour::rising(rms, REPROJECTION_PX);
        add("Reprojection", colour, format!("rms {rms:.2} px"));
    }
    if facts.done("align") {
        let control = number(align, "/control_points/count").unwrap_or(0.0);
        let placed = align.get("georeferenced").and_then(Value::as_bool).unwrap_or(false);
        let (colour, why) = match (placed, control as usize) {
            (true, 3..) => (Colour::Green, format!("{control} control points")),
            (true, _) => (
                Colour::Yellow,
                "camera positions alone: metres off in place and height".to_owned(),
            ),
            (false, _) => (Colour::Red, "no scale, no place on the map".to_owned()),
        };
        add("Place on the map", colour, why);
        let errors: Vec<f64> = ["x", "y", "z"]
            .iter()
            .filter_map(|axis| number(align, &format!("/check_points/rmse_{axis}_m")))
            .collect();
        let gsd = number(align, "/gsd_m");
        match (errors.iter().copied().reduce(f64::max), gsd) {
            (Some(worst), Some(gsd)) => {
                let colour =
                    Colour::rising(worst / gsd, [limits.check_yellow_gsd, limits.check_red_gsd]);
                let why = format!(
                    "largest rmse {:.1} cm, {:.1} ground sampling distances",
                    100.0 * worst,
                    worst / gsd
                );
                add("Check points", colour, why);
            }
            _ => add(
                "Check points",
                Colour::Grey,
                "none: nothing independent tells the error".into(),
            ),
        }
    }
    if let Some(sigma0) = number(&facts.adjustment, "/sigma0") {
        let colour = Colour::rising(sigma0.max(1.0 / sigma0.max(1e-9)), SIGMA0);
        let why = format!("sigma0 {sigma0:.2}; 1 where errors are as large as assumed");
        add("Assumed accuracies", colour, why);
    }
    if let Some(same) = facts.adjustment.get("nearly_the_same").and_then(Value::as_array) {
        let (colour, why) = match same.len() {
            0 => (Colour::Green, "every parameter is told from the others".to_owned()),
            1 => (Colour::Yellow, "1 pair of parameters is nearly the same here".to_owned()),
            n => (Colour::Yellow, format!("{n} pairs of parameters are nearly the same here")),
        };
        add("Self-calibration", colour, why);
    }
    let map = facts.says("ortho").pointer("/maps/0");
    if let Some(map) = map
        && let (Some(coloured), Some(width), Some(height)) =
            (number(map, "/coloured_pixels"), number(map, "/width_px"), number(map, "/height_px"))
    {
        let share = coloured / (width * height).max(1.0);
        add("Map", Colour::Green, format!("{:.0} % of its frame is covered", 100.0 * share));
    }
    let locate = facts.says("locate");
    if let Some(confidence) = number(locate, "/mean_confidence") {
        let colour = Colour::rising(-confidence, CONFIDENCE.map(|limit| -limit));
        add("Plants", colour, format!("mean confidence {confidence:.2}"));
    }
    for (stage, why) in &facts.skipped {
        if why.starts_with("failed") {
            add("Stages", Colour::Red, format!("{stage} {why}"));
        }
    }
    lights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_belong_to_the_better_side() {
        assert_eq!(Colour::rising(1.0, [1.0, 2.0]), Colour::Green);
        assert_eq!(Colour::rising(2.0, [1.0, 2.0]), Colour::Yellow);
        assert_eq!(Colour::rising(2.1, [1.0, 2.0]), Colour::Red);
        // What is not a number is not well.
        assert_eq!(Colour::rising(f64::NAN, [1.0, 2.0]), Colour::Red);
    }
}
