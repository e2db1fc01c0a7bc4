//! From options to what is estimated: names of parameters, the usual terms of each lens model.

use super::{CalibrateOptions, LensModel};
use rowgram_base::error::Error;
use rowgram_survey::{camera::Model, problems::calibration::Request};

/// What is to be estimated.
///
/// # Errors
/// A name that the lens model does not have, and nothing left to estimate.
pub(super) fn own(options: &CalibrateOptions, size_px: [u32; 2]) -> Result<Request, Error> {
    let free = (!options.free.is_empty()).then_some(options.free.as_slice());
    request(options, options.lens.model(), free, size_px)
}

/// The usual lens models on the same corners.
///
/// # Errors
/// As [`own`].
pub(super) fn comparisons(
    options: &CalibrateOptions,
    size_px: [u32; 2],
) -> Result<Vec<Request>, Error> {
    let rational: Vec<String> =
        "k1,k2,p1,p2,k3,k4,k5,k6".split(',').map(ToOwned::to_owned).collect();
    [
        (LensModel::Smac, None),
        (LensModel::Brown, None),
        (LensModel::Fisheye, None),
        (LensModel::Brown, Some(rational.as_slice())),
    ]
    .into_iter()
    .map(|(lens, free)| request(options, lens.model(), free, size_px))
    .collect()
}

fn request(
    options: &CalibrateOptions,
    model: Model,
    free: Option<&[String]>,
    size_px: [u32; 2],
) -> Result<Request, Error> {
    let parameters = model.parameters();
    let place = |name: &str| {
        let wanted = name.trim().to_lowercase();
        parameters.iter().position(|parameter| {
            let own = parameter.name.to_lowercase();
            own == wanted || own.strip_suffix("_px") == Some(&wanted)
        })
    };
    let names = || parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
    let find = |option: &str, name: &str| match place(name) {
        Some(place) if parameters[place].estimable => Ok(place),
        Some(_) => Err(Error::Argument(format!(
            "{option}: {name} is a constant of the {} model",
            model.word()
        ))),
        None => Err(Error::Argument(format!(
            "{option}: the {} model has no parameter {name:?}, only {}",
            model.word(),
            names()
        ))),
    };
    let mut is_free: Vec<bool> = parameters
        .iter()
        .map(|p| {
            matches!(p.name, "c_px" | "f_px" | "xp_px" | "yp_px" | "cx_px" | "cy_px" | "aspect")
        })
        .collect();
    match free {
        Some([none]) if none.eq_ignore_ascii_case("none") => {}
        Some(names) => {
            for name in names {
                is_free[find("free", name)?] = true;
            }
        }
        None => {
            for name in usual_terms(model) {
                is_free[find("free", name)?] = true;
            }
        }
    }
    // The lists may be about another model where models are compared.
    if free.is_some() || model == options.lens.model() {
        for name in &options.hold {
            is_free[find("hold", name)?] = false;
        }
    }
    let mut values: Vec<f64> = (0..parameters.len())
        .map(|k| model.default_value(k, size_px).unwrap_or(f64::from(size_px[0])))
        .collect();
    if let Some(aspect) = place("aspect").filter(|_| options.square_pixels) {
        is_free[aspect] = false;
    }
    if let Some(r0) = place("R0_px") {
        values[r0] = options.r0_px;
    }
    if !is_free.contains(&true) {
        return Err(Error::Argument("hold: nothing is left to estimate".into()));
    }
    Ok(Request {
        model,
        size_px,
        free: is_free,
        values,
        shape: options.board_shape,
        loss: options.loss.0,
    })
}

fn usual_terms(model: Model) -> &'static [&'static str] {
    match model {
        Model::Smac => &["K1", "K2", "K3", "P1", "P2"],
        Model::Brown => &["k1", "k2", "p1", "p2", "k3"],
        Model::Fisheye => &["k1", "k2", "k3", "k4"],
        Model::Bal => &["k1", "k2"],
    }
}
