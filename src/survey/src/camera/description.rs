//! What a calibration says of a physical camera: interior orientation, what of it may be adjusted,
//! how well it is known. The form of `camera.toml`:
//!
//! ```toml
//! name = "GoPro HERO3+"
//! model = "smac"
//! width_px = 4000
//! height_px = 3000
//! free = ["c_px", "xp_px", "yp_px", "K1", "K2"]
//!
//! [parameters]
//! c_px = 2650.0
//! K1 = -1.2e-8
//!
//! [standard_deviations]
//! c_px = 2.5
//!
//! [correlation]
//! names = ["c_px", "K1"]
//! matrix = [[1.0, 0.3], [0.3, 1.0]]
//! ```
//!
//! A parameter that is left out has its neutral value: 0, an aspect of 1, the image centre for
//! `cx_px` and `cy_px`; the principal distance must be given.

use super::{
    interior::{CameraError, Interior, Model},
    lens::Lens,
};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A camera and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// What it is called.
    pub name: String,
    /// Its interior orientation.
    pub interior: Interior,
    /// Which parameters an adjustment may change, in the order of the model's.
    pub free: Vec<bool>,
    /// Standard deviation of each parameter, where it is known, in its unit.
    pub standard_deviations: Vec<Option<f64>>,
    /// The values that these are about, in the order of the model's; those of `interior` where it is `None`.
    pub expected: Option<Vec<f64>>,
    /// Correlations between parameters that have a standard deviation.
    pub correlation: Option<Correlation>,
}

/// A correlation matrix of some parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Correlation {
    /// The parameters of rows and columns.
    pub names: Vec<String>,
    /// The matrix, row by row; ones on the diagonal.
    pub matrix: Vec<Vec<f64>>,
}

/// A camera as it stands in a file.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    name: String,
    model: Model,
    width_px: u32,
    height_px: u32,
    #[serde(default)]
    free: Vec<String>,
    parameters: BTreeMap<String, f64>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    standard_deviations: BTreeMap<String, f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    correlation: Option<Correlation>,
}

impl Camera {
    /// A camera of which only the interior orientation is known; nothing is free.
    pub fn new(name: &str, interior: Interior) -> Camera {
        let count = interior.parameters().len();
        Camera {
            name: name.to_owned(),
            interior,
            free: vec![false; count],
            standard_deviations: vec![None; count],
            expected: None,
            correlation: None,
        }
    }

    /// Frees the parameters of these names and holds all others.
    ///
    /// # Errors
    /// For a name that the model does not have, or a constant.
    pub fn set_free(&mut self, names: &[impl AsRef<str>]) -> Result<(), CameraError> {
        let mut free = vec![false; self.free.len()];
        for name in names {
            let place = self.place(name.as_ref())?;
            if !self.interior.parameters()[place].estimable {
                return Err(CameraError(format!(
                    "{} is a constant of the {} model and cannot be free",
                    name.as_ref(),
                    self.interior.model().word()
                )));
            }
            free[place] = true;
        }
        self.free = free;
        Ok(())
    }

    /// The covariance of the parameters that have a standard deviation, and their places; `None`
    /// where none has.
    pub fn covariance(&self) -> Option<(Vec<usize>, DMatrix<f64>)> {
        let known: Vec<(usize, f64)> = self
            .standard_deviations
            .iter()
            .enumerate()
            .filter_map(|(place, sigma)| sigma.map(|sigma| (place, sigma)))
            .collect();
        if known.is_empty() {
            return None;
        }
        let parameters = self.interior.parameters();
        let correlation = |i: usize, j: usize| -> f64 {
            if i == j {
                return 1.0;
            }
            let Some(table) = &self.correlation else { return 0.0 };
            let find =
                |place: usize| table.names.iter().position(|name| name == parameters[place].name);
            match (find(i), find(j)) {
                (Some(i), Some(j)) => table.matrix[i][j],
                _ => 0.0,
            }
        };
        let matrix = DMatrix::from_fn(known.len(), known.len(), |i, j| {
            known[i].1 * known[j].1 * correlation(known[i].0, known[j].0)
        });
        Some((known.into_iter().map(|(place, _)| place).collect(), matrix))
    }

    fn place(&self, name: &str) -> Result<usize, CameraError> {
        place(self.interior.model(), name)
    }

    /// The camera as TOML.
    pub fn to_toml(&self) -> String {
        let parameters = self.interior.parameters();
        let named = |values: &mut dyn Iterator<Item = (usize, f64)>| {
            values.map(|(place, value)| (parameters[place].name.to_owned(), value)).collect()
        };
        let file = File {
            name: self.name.clone(),
            model: self.interior.model(),
            width_px: self.interior.size_px()[0],
            height_px: self.interior.size_px()[1],
            free: (0..parameters.len())
                .filter(|&place| self.free[place])
                .map(|place| parameters[place].name.to_owned())
                .collect(),
            parameters: named(&mut self.interior.values().iter().copied().enumerate()),
            standard_deviations: named(
                &mut self
                    .standard_deviations
                    .iter()
                    .enumerate()
                    .filter_map(|(place, sigma)| sigma.map(|sigma| (place, sigma))),
            ),
            correlation: self.correlation.clone(),
        };
        // Names, numbers and lists of them can always be written.
        toml::to_string(&file).unwrap_or_default()
    }

    /// A camera from TOML.
    ///
    /// # Errors
    /// Names the key and says what was expected.
    pub fn from_toml(text: &str) -> Result<Camera, CameraError> {
        let file: File = toml::from_str(text)
            .map_err(|error| CameraError(error.to_string().trim_end().to_owned()))?;
        let model = file.model;
        let size_px = [file.width_px, file.height_px];
        let parameters = model.parameters();
        for name in file.parameters.keys() {
            place(model, name).map_err(|e| CameraError(format!("[parameters]: {e}")))?;
        }
        let values = parameters
            .iter()
            .enumerate()
            .map(|(at, parameter)| {
                let given = file.parameters.get(parameter.name).copied();
                given.or_else(|| model.default_value(at, size_px)).ok_or_else(|| {
                    CameraError(format!("[parameters]: {} is missing", parameter.name))
                })
            })
            .collect::<Result<Vec<f64>, CameraError>>()?;
        let interior = Interior::new(model, size_px, &values)
            .map_err(|e| CameraError(format!("[parameters]: {e}")))?;
        let mut camera = Camera::new(&file.name, interior);
        camera.set_free(&file.free).map_err(|e| CameraError(format!("free: {e}")))?;
        for (name, &sigma) in &file.standard_deviations {
            let at = place(model, name)
                .map_err(|e| CameraError(format!("[standard_deviations]: {e}")))?;
            if !(sigma.is_finite() && sigma > 0.0) {
                return Err(CameraError(format!(
                    "[standard_deviations]: {name} is {sigma}, expected a positive number"
                )));
            }
            camera.standard_deviations[at] = Some(sigma);
        }
        if let Some(correlation) = file.correlation {
            camera.check_correlation(&correlation)?;
            camera.correlation = Some(correlation);
        }
        if let Some((_, covariance)) = camera.covariance()
            && covariance.cholesky().is_none()
        {
            return Err(CameraError("[correlation]: the matrix is not positive definite".into()));
        }
        Ok(camera)
    }

    fn check_correlation(&self, correlation: &Correlation) -> Result<(), CameraError> {
        let wrong = |message: String| Err(CameraError(format!("[correlation]: {message}")));
        let count = correlation.names.len();
        for (k, name) in correlation.names.iter().enumerate() {
            let at = self.place(name).map_err(|e| CameraError(format!("[correlation]: {e}")))?;
            if self.standard_deviations[at].is_none() {
                return wrong(format!("{name} has no standard deviation"));
            }
            if correlation.names[..k].contains(name) {
                return wrong(format!("{name} is named twice"));
            }
        }
        if correlation.matrix.len() != count || correlation.matrix.iter().any(|r| r.len() != count)
        {
            return wrong(format!("the matrix is not {count} x {count}, one row per name"));
        }
        for i in 0..count {
            for j in 0..=i {
                let (a, b) = (correlation.matrix[i][j], correlation.matrix[j][i]);
                let expected = if i == j { a == 1.0 } else { a == b && a.abs() < 1.0 };
                if !expected {
                    return wrong(format!(
                        "the entry of {} and {} is {a}; expected a symmetric matrix of numbers within -1 and 1, ones on the diagonal",
                        correlation.names[i], correlation.names[j]
                    ));
                }
            }
        }
        Ok(())
    }
}

fn place(model: Model, name: &str) -> Result<usize, CameraError> {
    model.place(name).ok_or_else(|| {
        let names: Vec<&str> = model.parameters().iter().map(|p| p.name).collect();
        CameraError(format!(
            "the {} model has no parameter {name:?}, only {}",
            model.word(),
            names.join(", ")
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"
name = "kite"
model = "smac"
width_px = 400
height_px = 300
free = ["c_px", "K1"]
[parameters]
c_px = 350.25
K1 = -1.25e-8
P2 = 1e-7
[standard_deviations]
c_px = 2.5
K1 = 1e-9
[correlation]
names = ["K1", "c_px"]
matrix = [[1.0, 0.25], [0.25, 1.0]]
"#;

    #[test]
    fn what_is_written_is_read_back() {
        let camera = Camera::from_toml(TEXT).unwrap();
        assert_eq!(camera.interior.value("K1"), Some(-1.25e-8));
        assert_eq!(camera.interior.value("K2"), Some(0.0));
        assert_eq!(camera.free.iter().filter(|&&free| free).count(), 2);
        let (places, covariance) = camera.covariance().unwrap();
        assert_eq!(places, [0, 4]);
        assert!((covariance[(0, 1)] - 0.25 * 2.5 * 1e-9).abs() < 1e-20);
        assert_eq!(Camera::from_toml(&camera.to_toml()).unwrap(), camera);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (damage, part) in [
            (("c_px = 350.25", ""), "c_px is missing"),
            (("c_px = 350.25", "c_px = -1.0"), "expected a positive number"),
            (("c_px = 350.25", "c_px = nan"), "finite"),
            (("P2 = 1e-7", "k1 = 1e-7"), "no parameter \"k1\", only c_px"),
            (("\"K1\"]\n[", "\"R0_px\"]\n["), "constant"),
            (("model = \"smac\"", "model = \"fishy\""), "unknown variant `fishy`"),
            (("c_px = 2.5", "c_px = 0.0"), "expected a positive number"),
            (("[0.25, 1.0]", "[0.5, 1.0]"), "symmetric"),
            (("[0.25, 1.0]", "[0.25]"), "2 x 2"),
            (("names = [\"K1\"", "names = [\"K2\""), "no standard deviation"),
            (("width_px = 400", "width_px = 0"), "at least 1 x 1"),
            (("free =", "fre ="), "unknown field `fre`"),
        ] {
            assert!(TEXT.contains(damage.0), "{damage:?}");
            let error = Camera::from_toml(&TEXT.replacen(damage.0, damage.1, 1)).unwrap_err();
            assert!(error.to_string().contains(part), "{damage:?}: {error}");
        }
    }
}
