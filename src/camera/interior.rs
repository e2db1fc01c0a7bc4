//! An interior orientation: one of the built-in lens models with its values and its image size.

use super::{
    bal::{self, Bal},
    brown::{self, Brown},
    fisheye::{self, Fisheye},
    lens::{Lens, MAX_PARAMETERS, Parameter, Projection},
    smac::{self, Smac},
};
use serde::{Deserialize, Serialize};

/// The built-in lens models.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Model {
    /// Image-to-ideal correction, [`smac`].
    Smac,
    /// Brown's model as OpenCV has it, [`brown`].
    Brown,
    /// Equidistant fisheye with a polynomial, [`fisheye`].
    Fisheye,
    /// The camera of *Bundle Adjustment in the Large*, [`bal`].
    Bal,
}

impl Model {
    /// All models.
    pub const ALL: [Model; 4] = [Model::Smac, Model::Brown, Model::Fisheye, Model::Bal];

    /// Its parameters, in the order of their values.
    pub fn parameters(self) -> &'static [Parameter] {
        match self {
            Model::Smac => &smac::PARAMETERS,
            Model::Brown => &brown::PARAMETERS,
            Model::Fisheye => &fisheye::PARAMETERS,
            Model::Bal => &bal::PARAMETERS,
        }
    }

    /// The place of a parameter by its name.
    pub fn place(self, name: &str) -> Option<usize> {
        self.parameters().iter().position(|parameter| parameter.name == name)
    }

    /// The word used in files.
    pub fn word(self) -> &'static str {
        match self {
            Model::Smac => "smac",
            Model::Brown => "brown",
            Model::Fisheye => "fisheye",
            Model::Bal => "bal",
        }
    }

    /// The value a parameter has where nothing is said of it; `None` where something must be.
    pub fn default_value(self, place: usize, size_px: [u32; 2]) -> Option<f64> {
        let name = self.parameters().get(place)?.name;
        match name {
            "c_px" | "f_px" => None,
            "aspect" => Some(1.0),
            "cx_px" => Some(centre_px(size_px)[0]),
            "cy_px" => Some(centre_px(size_px)[1]),
            _ => Some(0.0),
        }
    }
}

/// What is wrong with an interior orientation or a camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct CameraError(pub String);

/// A built-in lens with its values.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BuiltIn {
    Smac(Smac),
    Brown(Brown),
    Fisheye(Fisheye),
    Bal(Bal),
}

/// One of the built-in lens models with its values and the size of its images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interior {
    size_px: [u32; 2],
    lens: BuiltIn,
}

/// The centre of an image, the centre of its top-left pixel being (0, 0).
pub fn centre_px(size_px: [u32; 2]) -> [f64; 2] {
    size_px.map(|n| 0.5 * (f64::from(n) - 1.0))
}

impl Interior {
    /// An interior orientation with the values of [`Model::parameters`], in their order, for images
    /// of `[width, height]` pixels.
    ///
    /// # Errors
    /// Where there are too many or too few values, one is not finite, the principal distance or the
    /// aspect is not positive, or an image has no pixels.
    pub fn new(model: Model, size_px: [u32; 2], values: &[f64]) -> Result<Interior, CameraError> {
        let parameters = model.parameters();
        let word = model.word();
        if values.len() != parameters.len() {
            return Err(CameraError(format!(
                "the {word} model has {} parameters, {} values were given",
                parameters.len(),
                values.len()
            )));
        }
        if size_px.contains(&0) {
            return Err(CameraError(format!(
                "the image size is {} x {} pixels, expected at least 1 x 1",
                size_px[0], size_px[1]
            )));
        }
        for (parameter, value) in parameters.iter().zip(values) {
            let name = parameter.name;
            if !value.is_finite() {
                return Err(CameraError(format!("{name} is {value}, expected a finite number")));
            }
            if matches!(name, "c_px" | "f_px" | "aspect") && *value <= 0.0 {
                return Err(CameraError(format!("{name} is {value}, expected a positive number")));
            }
        }
        Ok(Interior::unchecked(model, size_px, centre_px(size_px), values))
    }

    /// As [`Interior::new`], without the checks: for values that an adjustment tries. `values` may
    /// be longer than the model has parameters.
    pub(crate) fn unchecked(
        model: Model,
        size_px: [u32; 2],
        centre_px: [f64; 2],
        values: &[f64],
    ) -> Interior {
        let lens = match model {
            Model::Smac => BuiltIn::Smac(Smac::new(first(values), centre_px)),
            Model::Brown => BuiltIn::Brown(Brown::new(first(values))),
            Model::Fisheye => BuiltIn::Fisheye(Fisheye::new(first(values))),
            Model::Bal => BuiltIn::Bal(Bal::new(first(values), centre_px)),
        };
        Interior { size_px, lens }
    }

    /// The lens of values whose range is known (see [`Interior::limit`]).
    #[inline]
    pub(crate) fn with_limit(
        model: Model,
        centre_px: [f64; 2],
        values: &[f64],
        limit: f64,
    ) -> Interior {
        let lens = match model {
            Model::Smac => BuiltIn::Smac(Smac::with_limit(first(values), centre_px, limit)),
            Model::Brown => BuiltIn::Brown(Brown::with_limit(first(values), limit)),
            Model::Fisheye => BuiltIn::Fisheye(Fisheye::with_limit(first(values), limit)),
            Model::Bal => BuiltIn::Bal(Bal::with_limit(first(values), centre_px, limit)),
        };
        Interior { size_px: [0, 0], lens }
    }

    /// How far the model is one to one: a radius in pixels (SMAC), a tangent (Brown, BAL) or an
    /// angle in radians (fisheye); infinite where it is so everywhere.
    pub fn limit(&self) -> f64 {
        match &self.lens {
            BuiltIn::Smac(lens) => lens.valid_radius_px(),
            BuiltIn::Brown(lens) => lens.valid_radius(),
            BuiltIn::Fisheye(lens) => lens.valid_angle_rad(),
            BuiltIn::Bal(lens) => lens.valid_radius(),
        }
    }

    /// The model.
    pub fn model(&self) -> Model {
        match &self.lens {
            BuiltIn::Smac(_) => Model::Smac,
            BuiltIn::Brown(_) => Model::Brown,
            BuiltIn::Fisheye(_) => Model::Fisheye,
            BuiltIn::Bal(_) => Model::Bal,
        }
    }

    /// `[width, height]` of the images, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// The centre of the images, pixels.
    pub fn centre_px(&self) -> [f64; 2] {
        match &self.lens {
            BuiltIn::Smac(lens) => lens.centre_px(),
            BuiltIn::Bal(lens) => lens.centre_px(),
            BuiltIn::Brown(_) | BuiltIn::Fisheye(_) => centre_px(self.size_px),
        }
    }

    /// The value of the parameter of this name.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.model().place(name).map(|place| self.values()[place])
    }

    /// The same model and images with other values.
    ///
    /// # Errors
    /// As [`Interior::new`].
    pub fn with_values(&self, values: &[f64]) -> Result<Interior, CameraError> {
        Interior::new(self.model(), self.size_px, values)
    }

    /// The principal distance, pixels.
    pub fn principal_distance_px(&self) -> f64 {
        self.values()[0]
    }

    /// For a SMAC lens, the residual in the corrected domain ([`Smac::corrected_residual`]).
    pub fn corrected_residual(&self, point: [f64; 3], measured_px: [f64; 2]) -> Option<Projection> {
        match &self.lens {
            BuiltIn::Smac(lens) => lens.corrected_residual(point, measured_px),
            _ => None,
        }
    }

    /// As [`Lens::project`] of a point whose image is near `near_px`, which finds it faster where a model is
    /// inverted by iteration.
    pub fn project_near(&self, point: [f64; 3], near_px: [f64; 2]) -> Option<[f64; 2]> {
        match &self.lens {
            BuiltIn::Smac(lens) => lens.project_near(point, Some(near_px)),
            _ => self.project(point),
        }
    }

    /// As [`Lens::project_with_derivatives`] of a point whose image is near `near_px`.
    pub fn project_with_derivatives_near(
        &self,
        point: [f64; 3],
        near_px: [f64; 2],
    ) -> Option<Projection> {
        match &self.lens {
            BuiltIn::Smac(lens) => lens.project_with_derivatives_near(point, Some(near_px)),
            _ => self.project_with_derivatives(point),
        }
    }

    #[inline]
    fn as_lens(&self) -> &dyn Lens {
        match &self.lens {
            BuiltIn::Smac(lens) => lens,
            BuiltIn::Brown(lens) => lens,
            BuiltIn::Fisheye(lens) => lens,
            BuiltIn::Bal(lens) => lens,
        }
    }
}

fn first<const N: usize>(values: &[f64]) -> [f64; N] {
    debug_assert!(values.len() >= N && N <= MAX_PARAMETERS);
    std::array::from_fn(|k| values[k])
}

impl Lens for Interior {
    fn parameters(&self) -> &'static [Parameter] {
        self.model().parameters()
    }

    fn values(&self) -> &[f64] {
        self.as_lens().values()
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        self.as_lens().project(point)
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection> {
        self.as_lens().project_with_derivatives(point)
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        self.as_lens().unproject(image_px)
    }
}
