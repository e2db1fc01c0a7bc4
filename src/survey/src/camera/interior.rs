//! An interior orientation: one of the built-in lens models with its values and its image size.

use super::{
    bal::Bal,
    brown::Brown,
    fisheye::Fisheye,
    lens::{Lens, MAX_PARAMETERS, Parameter, Projection},
    smac::Smac,
};
use serde::{Deserialize, Serialize};

/// What a built-in lens model says of itself; [`lens_models`] registers it.
pub(super) trait BuiltInLens: Lens + Copy {
    /// Its name in files.
    const NAME: &'static str;
    /// Its parameters, in the order of their values.
    const PARAMETERS: &'static [Parameter];
    /// Place of `cx_px`, followed by `cy_px`, where the principal point is counted from the corner
    /// of the image; `None` where it is counted from the image's centre, or there is none.
    const ABSOLUTE_PRINCIPAL_POINT: Option<usize> = None;

    /// The lens of the first of these values.
    fn from_values(values: &[f64], centre_px: [f64; 2]) -> Self;

    /// The same where [`Interior::valid_radius`] is known.
    fn with_valid_radius(values: &[f64], centre_px: [f64; 2], valid_radius: f64) -> Self;

    /// See [`Interior::valid_radius`].
    fn valid_radius(&self) -> f64;

    /// The centre of the images, where the lens knows it, pixels.
    fn centre_px(&self) -> Option<[f64; 2]> {
        None
    }

    /// See [`Interior::corrected_residual`].
    fn corrected_residual(&self, _: [f64; 3], _: [f64; 2]) -> Option<Projection> {
        None
    }

    /// See [`Interior::project_near`].
    fn project_near(&self, point: [f64; 3], _near_px: [f64; 2]) -> Option<[f64; 2]> {
        self.project(point)
    }

    /// See [`Interior::project_with_derivatives_near`].
    fn project_with_derivatives_near(
        &self,
        point: [f64; 3],
        _near_px: [f64; 2],
    ) -> Option<Projection> {
        self.project_with_derivatives(point)
    }
}

/// The register of lens models: all that is chosen by model is written here, once.
macro_rules! lens_models {
    ($($(#[doc = $doc:literal])* $model:ident: $lens:ty),+ $(,)?) => {
        /// The built-in lens models.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum Model {
            $($(#[doc = $doc])* $model),+
        }

        impl Model {
            /// All models.
            pub const ALL: [Model; [$(stringify!($model)),+].len()] = [$(Model::$model),+];

            /// Its parameters, in the order of their values.
            pub fn parameters(self) -> &'static [Parameter] {
                match self {
                    $(Model::$model => <$lens>::PARAMETERS),+
                }
            }

            /// The word used in files.
            pub fn word(self) -> &'static str {
                match self {
                    $(Model::$model => <$lens>::NAME),+
                }
            }

            /// Place of `cx_px`, followed by `cy_px`, where the principal point is counted from the
            /// corner of the image.
            pub(crate) fn absolute_principal_point(self) -> Option<usize> {
                match self {
                    $(Model::$model => <$lens>::ABSOLUTE_PRINCIPAL_POINT),+
                }
            }
        }

        /// A built-in lens with its values.
        #[derive(Debug, Clone, Copy, PartialEq)]
        enum BuiltIn {
            $($model($lens)),+
        }

        impl BuiltIn {
            #[inline]
            fn from_values(model: Model, values: &[f64], centre_px: [f64; 2]) -> BuiltIn {
                match model {
                    $(Model::$model => BuiltIn::$model(<$lens>::from_values(values, centre_px))),+
                }
            }

            #[inline]
            fn with_valid_radius(
                model: Model,
                values: &[f64],
                centre_px: [f64; 2],
                radius: f64,
            ) -> BuiltIn {
                match model {
                    $(Model::$model => BuiltIn::$model(
                        <$lens as BuiltInLens>::with_valid_radius(values, centre_px, radius),
                    )),+
                }
            }

            fn model(&self) -> Model {
                match self {
                    $(BuiltIn::$model(_) => Model::$model),+
                }
            }
        }
    };
}

lens_models! {
    /// Image-to-ideal correction, [`super::smac`].
    Smac: Smac,
    /// Brown's model as OpenCV has it, [`super::brown`].
    Brown: Brown,
    /// Equidistant fisheye with a polynomial, [`super::fisheye`].
    Fisheye: Fisheye,
    /// The camera of *Bundle Adjustment in the Large*, [`super::bal`].
    Bal: Bal,
}

/// An expression of a built-in lens, whichever it is.
macro_rules! with_lens {
    ($built_in:expr, $lens:ident => $expression:expr) => {
        match &$built_in {
            BuiltIn::Smac($lens) => $expression,
            BuiltIn::Brown($lens) => $expression,
            BuiltIn::Fisheye($lens) => $expression,
            BuiltIn::Bal($lens) => $expression,
        }
    };
}

impl Model {
    /// The place of a parameter by its name.
    pub fn place(self, name: &str) -> Option<usize> {
        self.parameters().iter().position(|parameter| parameter.name == name)
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
        Interior { size_px, lens: BuiltIn::from_values(model, values, centre_px) }
    }

    /// The lens of values whose range is known (see [`Interior::valid_radius`]).
    #[inline]
    pub(crate) fn with_valid_radius(
        model: Model,
        centre_px: [f64; 2],
        values: &[f64],
        radius: f64,
    ) -> Interior {
        let lens = BuiltIn::with_valid_radius(model, values, centre_px, radius);
        Interior { size_px: [0, 0], lens }
    }

    /// Up to which distance from the principal point the model is one to one: pixels (SMAC), the
    /// tangent of the angle from the axis (Brown, BAL), or that angle in radians (fisheye); infinite
    /// where it is so everywhere.
    pub fn valid_radius(&self) -> f64 {
        with_lens!(self.lens, lens => BuiltInLens::valid_radius(lens))
    }

    /// The model.
    pub fn model(&self) -> Model {
        self.lens.model()
    }

    /// `[width, height]` of the images, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// The centre of the images, pixels.
    pub fn centre_px(&self) -> [f64; 2] {
        with_lens!(self.lens, lens => BuiltInLens::centre_px(lens))
            .unwrap_or_else(|| centre_px(self.size_px))
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
        with_lens!(self.lens, lens => BuiltInLens::corrected_residual(lens, point, measured_px))
    }

    /// As [`Lens::project`] of a point whose image is near `near_px`, which finds it faster where a model is
    /// inverted by iteration.
    pub fn project_near(&self, point: [f64; 3], near_px: [f64; 2]) -> Option<[f64; 2]> {
        with_lens!(self.lens, lens => BuiltInLens::project_near(lens, point, near_px))
    }

    /// As [`Lens::project_with_derivatives`] of a point whose image is near `near_px`.
    pub fn project_with_derivatives_near(
        &self,
        point: [f64; 3],
        near_px: [f64; 2],
    ) -> Option<Projection> {
        with_lens!(self.lens, lens => BuiltInLens::project_with_derivatives_near(lens, point, near_px))
    }
}

/// The first `N` values.
pub(super) fn first<const N: usize>(values: &[f64]) -> [f64; N] {
    debug_assert!(values.len() >= N && N <= MAX_PARAMETERS);
    std::array::from_fn(|k| values[k])
}

impl Lens for Interior {
    fn parameters(&self) -> &'static [Parameter] {
        self.model().parameters()
    }

    fn values(&self) -> &[f64] {
        with_lens!(self.lens, lens => lens.values())
    }

    fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        with_lens!(self.lens, lens => lens.project(point))
    }

    fn project_with_derivatives(&self, point: [f64; 3]) -> Option<Projection> {
        with_lens!(self.lens, lens => lens.project_with_derivatives(point))
    }

    fn unproject(&self, image_px: [f64; 2]) -> Option<[f64; 3]> {
        with_lens!(self.lens, lens => lens.unproject(image_px))
    }
}
