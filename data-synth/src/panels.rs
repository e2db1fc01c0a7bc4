//! Panels of known reflectance that lie beside the field, as a crew would lay them out to compare the light of dates.
//!
//! Level plates of one colour in a line beyond the beginning of the rows, from the first row across.

use crate::{
    check::{ConfigError, within},
    field::Field,
};
use serde::{Deserialize, Serialize};

/// The panels of a field.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PanelConfig {
    /// Side of a panel, metres; 0: there are none.
    pub size_m: f64,
    /// Whether there is a plate as green as leaves, too: something green that does not grow. It is taken for leaf.
    pub green_plate: bool,
}

/// Names and reflectances, red, green, blue; the green plate last.
const PAINTS: [(&str, [f64; 3]); 4] = [
    ("black", [0.05; 3]),
    ("grey", [0.20; 3]),
    ("white", [0.50; 3]),
    ("green", [0.09, 0.21, 0.05]),
];
/// Distance from the beginning of the rows, within which leaves hang and cast shadows, metres.
const BEYOND_M: f64 = 0.8;
/// Distance from panel to panel, in sides.
const STEP: f64 = 1.5;
/// Height above the highest of uneven ground, about, metres.
const ABOVE_M: f64 = 0.06;
/// Distance from a panel in which no weed stands, metres.
const CLEARING_M: f64 = 0.3;

/// One panel.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Its name.
    pub name: &'static str,
    /// Its reflectance, red, green, blue.
    pub reflectance: [f64; 3],
    /// Its corners in turn, metres.
    pub corners_m: [[f64; 3]; 4],
}

impl Panel {
    /// Whether a place is so near that a crew would clear it.
    pub(crate) fn is_near(&self, [x_m, y_m]: [f64; 2]) -> bool {
        let [middle, corner] = [self.shrunk(0.0)[0], self.corners_m[0]];
        let from_middle_m = |x: f64, y: f64| f64::hypot(x - middle[0], y - middle[1]);
        from_middle_m(x_m, y_m) < from_middle_m(corner[0], corner[1]) + CLEARING_M
    }

    /// Its corners drawn towards its middle to this share of its size.
    pub fn shrunk(&self, share: f64) -> [[f64; 3]; 4] {
        let middle = [0, 1, 2].map(|i| 0.25 * self.corners_m.iter().map(|c| c[i]).sum::<f64>());
        self.corners_m.map(|corner| [0, 1, 2].map(|i| middle[i] + share * (corner[i] - middle[i])))
    }
}

impl PanelConfig {
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.size_m == 0.0
    }

    /// Checks every parameter.
    ///
    /// # Errors
    /// A size that cannot be used.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("panels.size_m", self.size_m, 0.0..=2.0)
    }

    /// The panels beside a field.
    pub(crate) fn lay_out(&self, field: &Field) -> Vec<Panel> {
        if self.is_empty() {
            return Vec::new();
        }
        let config = &field.config;
        let first_m = config.row_across(0, -0.5 * config.row_length_m);
        let panel = |(k, &(name, reflectance)): (usize, &(&'static str, [f64; 3]))| {
            let along_m = -0.5 * config.row_length_m - BEYOND_M - 0.5 * self.size_m;
            let across_m = first_m + STEP * self.size_m * k as f64;
            let half_m = 0.5 * self.size_m;
            let [x_m, y_m] = config.ground(along_m, across_m);
            let z_m = field.terrain.height_m(x_m, y_m) + ABOVE_M;
            let corners =
                [[-half_m, -half_m], [half_m, -half_m], [half_m, half_m], [-half_m, half_m]];
            let corners_m = corners.map(|[s, t]| {
                let [x_m, y_m] = config.ground(along_m + s, across_m + t);
                [x_m, y_m, z_m]
            });
            Panel { name, reflectance, corners_m }
        };
        let count = PAINTS.len() - usize::from(!self.green_plate);
        PAINTS.iter().take(count).enumerate().map(panel).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::FieldConfig;

    #[test]
    fn panels_lie_beyond_the_rows_and_apart() {
        let field = Field::plant(&FieldConfig::default()).unwrap();
        assert_eq!(PanelConfig::default().lay_out(&field), []);
        let panels = PanelConfig { size_m: 0.4, green_plate: true }.lay_out(&field);
        let grey = PanelConfig { size_m: 0.4, green_plate: false }.lay_out(&field);
        assert_eq!((panels.len(), &panels[..3]), (4, &grey[..]));
        let end_m = -0.5 * field.config.row_length_m - BEYOND_M + 1e-9;
        for panel in &panels {
            for [x_m, y_m, _] in panel.corners_m {
                assert!(field.config.along_across(x_m, y_m)[0] <= end_m, "{panel:?}");
            }
            let [a, b] = [0, 1].map(|k| panel.shrunk(0.5)[k]);
            assert!((f64::hypot(b[0] - a[0], b[1] - a[1]) - 0.2).abs() < 1e-9);
        }
        let middles = panels.windows(2).map(|pair| {
            let [a, b] = [0, 1].map(|k| pair[k].shrunk(0.0)[0]);
            f64::hypot(b[0] - a[0], b[1] - a[1])
        });
        assert!(middles.into_iter().all(|m| (m - 0.6).abs() < 1e-9));
    }
}
