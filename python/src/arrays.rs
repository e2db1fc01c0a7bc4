//! Pictures, masks, features and positions as NumPy arrays.

use crate::{
    error::{from_library, input, result, without_python},
    options,
};
use image::{GrayImage, RgbImage};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArrayDyn,
    PyUntypedArrayMethods, ndarray::Array2,
};
use pyo3::{prelude::*, types::PyDict};
use rowgram::{
    Error,
    features::{self, Descriptors, FeatureOptions, matching},
    phenotype::{
        leaves::{self, LeafOptions},
        locator::{self, Found, LocateOptions},
        stand::Stalk,
    },
    raster::{
        Mask,
        mask::Thresholds,
        spectral::{Band, Index},
        vegetation,
    },
    score::Score,
};

type Array<'py, T> = Bound<'py, PyArray2<T>>;

/// An array of another kind than expected, in words.
fn unexpected(name: &str, expected: &str, given: &Bound<'_, PyAny>) -> PyErr {
    let of =
        |attribute: &str| given.getattr(attribute).and_then(|v| v.str()).map(|v| v.to_string());
    let found = match (of("dtype"), of("shape")) {
        (Ok(dtype), Ok(shape)) => format!("an array of {dtype} with shape {shape}"),
        _ => match given.get_type().name() {
            Ok(kind) => kind.to_string(),
            Err(_) => "something else".to_owned(),
        },
    };
    input(format!("{name}: expected {expected}, not {found}"))
}

/// A colour picture from an array of shape (rows, columns, 3), `uint8`.
fn photo(given: &Bound<'_, PyAny>) -> PyResult<RgbImage> {
    let wrong = || unexpected("image", "an array of uint8 with shape (rows, columns, 3)", given);
    let array: PyReadonlyArray3<'_, u8> = given.extract().map_err(|_| wrong())?;
    let &[rows, columns, 3] = array.shape() else { return Err(wrong()) };
    let size = |length: usize| u32::try_from(length).map_err(|_| wrong());
    let pixels: Vec<u8> = match array.as_slice() {
        Ok(slice) => slice.to_vec(),
        Err(_) => array.as_array().iter().copied().collect(),
    };
    RgbImage::from_raw(size(columns)?, size(rows)?, pixels).ok_or_else(wrong)
}

/// A leaf mask from an array of shape (rows, columns), `bool` or `uint8`; what is not 0 is leaf.
fn mask(given: &Bound<'_, PyAny>) -> PyResult<Mask> {
    let wrong =
        || unexpected("mask", "an array of bool or uint8 with shape (rows, columns)", given);
    let make =
        |rows: usize, columns: usize, data: Vec<u8>| Mask { width: columns, height: rows, data };
    if let Ok(array) = given.extract::<PyReadonlyArray2<'_, bool>>() {
        let view = array.as_array();
        return Ok(make(
            view.nrows(),
            view.ncols(),
            view.iter().map(|&leaf| leaf.into()).collect(),
        ));
    }
    let array: PyReadonlyArray2<'_, u8> = given.extract().map_err(|_| wrong())?;
    let view = array.as_array();
    Ok(make(view.nrows(), view.ncols(), view.iter().map(|&leaf| (leaf != 0).into()).collect()))
}

/// `numpy.asarray(given, kind)`, with any number of axes; `None` where it is no array of this type.
pub(crate) fn array<'py, T: numpy::Element>(
    given: &Bound<'py, PyAny>,
    kind: &str,
) -> Option<PyReadonlyArrayDyn<'py, T>> {
    let numpy = given.py().import("numpy").ok()?;
    numpy.call_method1("asarray", (given, kind)).ok()?.extract().ok()
}

/// Positions from an array of shape (n, 2), any kind of number.
fn positions(name: &str, given: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; 2]>> {
    let wrong = || unexpected(name, "an array of numbers with shape (n, 2)", given);
    let array = array::<f64>(given, "float64").ok_or_else(wrong)?;
    match *array.shape() {
        [_, 2] => {
            let flat: Vec<f64> = array.as_array().iter().copied().collect();
            Ok(flat.as_chunks().0.to_vec())
        }
        [0] | [0, _] => Ok(Vec::new()),
        _ => Err(wrong()),
    }
}

/// An array of `columns` columns from rows one after the other.
pub(crate) fn table<'py, T: numpy::Element + Clone>(
    py: Python<'py>,
    columns: usize,
    flat: Vec<T>,
) -> PyResult<Array<'py, T>> {
    let rows = flat.len() / columns.max(1);
    let array = Array2::from_shape_vec((rows, columns), flat)
        .map_err(|error| crate::error::exception("InternalError", error))?;
    Ok(array.into_pyarray(py))
}

/// The vegetation of a picture: `(mask, posterior or None)`.
#[pyfunction]
#[pyo3(signature = (image, hsv=None))]
pub(crate) fn segment<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    hsv: Option<[i64; 4]>,
) -> PyResult<(Array<'py, bool>, Option<Array<'py, f32>>)> {
    let photo = photo(image)?;
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let leaf =
        |mask: Mask| table(py, mask.width, mask.data.iter().map(|&leaf| leaf != 0).collect());
    if width == 0 || height == 0 {
        return Err(input(format!("image: expected pixels, not {height} x {width}")));
    }
    if let Some([from, to, saturation, value]) = hsv {
        let thresholds = Thresholds::new(from, to, saturation, value).map_err(input)?;
        let mask = without_python(py, || thresholds.mask(&photo))?;
        return Ok((leaf(mask)?, None));
    }
    let found = without_python(py, || vegetation::segment(&photo, None, &Default::default()))?;
    let found = found.map_err(input)?;
    let posterior = found.posterior.iter().map(|&p| f32::from(p) / 255.0).collect();
    Ok((leaf(found.mask)?, Some(table(py, width, posterior)?)))
}

/// An index of every pixel, from bands by name and samples of shape (pixels, bands).
#[pyfunction]
pub(crate) fn spectral_index<'py>(
    py: Python<'py>,
    index: &str,
    names: Vec<String>,
    samples: PyReadonlyArray2<'py, f32>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let band = |name: &String| {
        Band::named(name)
            .map(Some)
            .ok_or_else(|| input(format!("{name}: expected bands blue, green, red, red_edge, nir")))
    };
    let bands: Vec<Option<Band>> = names.iter().map(band).collect::<PyResult<_>>()?;
    let index = Index::list(&[index.to_owned()]).map_err(input)?.remove(0);
    let formula = index.bind(&bands).map_err(input)?;
    if samples.shape()[1] != bands.len() {
        return Err(input("samples: expected a column for each band"));
    }
    let flat: Vec<f32> = samples.as_array().iter().copied().collect();
    Ok(without_python(py, || formula.evaluate(&flat))?.into_pyarray(py))
}

fn stalks<'py>(py: Python<'py>, out: &Bound<'py, PyDict>, plants: &[Stalk]) -> PyResult<()> {
    let column =
        |of: fn(&Stalk) -> f64| plants.iter().map(of).collect::<Vec<f64>>().into_pyarray(py);
    let at: Vec<f64> = plants.iter().flat_map(|plant| plant.position_px).collect();
    out.set_item("positions_px", table(py, 2, at)?)?;
    out.set_item("confidence", column(|plant| plant.confidence))?;
    out.set_item("along_px", column(|plant| plant.along_px))?;
    out.set_item("sigma_along_px", column(|plant| plant.sigma_along_px))?;
    out.set_item("sigma_across_px", column(|plant| plant.sigma_across_px))?;
    let rows: Vec<i64> = plants.iter().map(|plant| plant.row as i64 + 1).collect();
    out.set_item("row", rows.into_pyarray(py))
}

/// The plants of a leaf mask: a dictionary of arrays and numbers.
#[pyfunction]
#[pyo3(signature = (mask, options=None))]
pub(crate) fn locate<'py>(
    py: Python<'py>,
    mask: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let mask = self::mask(mask)?;
    let options: LocateOptions = options::with(&LocateOptions::default(), options)?;
    let found = without_python(py, || locator::find(&mask, options.gsd_m, &options))?;
    let found = found.map_err(|error| from_library(&Error::from(error)))?;
    let out = PyDict::new(py);
    match &found {
        Found::Stand(stand) => {
            stalks(py, &out, &stand.plants)?;
            out.set_item("count_interval", stand.count_interval)?;
            out.set_item("rows", stand.rows.rows.len())?;
            out.set_item("spacing_px", stand.spacing.spacing)?;
            out.set_item("row_spacing_px", stand.rows.spacing_px)?;
            out.set_item("row_counts", stand.row_counts.clone().into_pyarray(py))?;
            let missing = stand.missing.iter().flat_map(|gap| gap.position_px).collect();
            out.set_item("missing_px", table(py, 2, missing)?)?;
        }
        Found::Descent(found) => {
            let plants = &found.located.plants;
            let at: Vec<f64> = plants.iter().flat_map(|plant| plant.position_px).collect();
            out.set_item("positions_px", table(py, 2, at)?)?;
            out.set_item("sigma_px", found.located.sigma_px)?;
            out.set_item("final_cost", found.outcome.final_cost)?;
            out.set_item("sweeps", found.outcome.iterations)?;
        }
    }
    Ok(out)
}

/// The single leaves of a leaf mask: labels and one entry per leaf.
#[pyfunction]
#[pyo3(signature = (mask, options=None))]
pub(crate) fn find_leaves<'py>(
    py: Python<'py>,
    mask: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let mask = self::mask(mask)?;
    let options: LeafOptions = options::with(&LeafOptions::default(), options)?;
    let found = without_python(py, || leaves::find(&mask, &options))?;
    let mut labels = vec![0_i32; mask.width * mask.height];
    for (label, leaf) in (1_i32..).zip(&found.leaves) {
        for run in &leaf.runs {
            labels[run.pixels(mask.width)].fill(label);
        }
    }
    let all = &found.leaves;
    let column = |of: &dyn Fn(&leaves::Leaf) -> f64| -> Bound<'py, PyArray1<f64>> {
        all.iter().map(of).collect::<Vec<f64>>().into_pyarray(py)
    };
    let out = PyDict::new(py);
    out.set_item("labels", table(py, mask.width, labels)?)?;
    out.set_item("length_px", column(&|leaf| leaf.length_px))?;
    out.set_item("width_px", column(&|leaf| leaf.mean_width_px()))?;
    out.set_item("area_px", column(&|leaf| leaf.area_px as f64))?;
    out.set_item("angle_rad", column(&|leaf| leaf.angle_rad()))?;
    let middle = all.iter().flat_map(|leaf| leaf.middle_px()).collect();
    out.set_item("middle_px", table(py, 2, middle)?)?;
    let axes =
        all.iter().map(|leaf| table(py, 2, leaf.axis_px.iter().flatten().copied().collect()));
    out.set_item("axes_px", axes.collect::<PyResult<Vec<_>>>()?)?;
    out.set_item("usual_width_px", found.usual_width_px)?;
    Ok(out)
}

/// Found positions compared with true ones.
#[pyfunction]
pub(crate) fn evaluate<'py>(
    py: Python<'py>,
    found: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
    radii_px: Vec<f64>,
) -> PyResult<Bound<'py, PyAny>> {
    let (found, truth) = (positions("found", found)?, positions("true", truth)?);
    let score = without_python(py, || Score::new(&found, &truth, &radii_px))?;
    result(py, &score.map_err(|error| from_library(&error))?)
}

/// SIFT key points `(n, 5)` and descriptors `(n, 128)` of a picture.
#[pyfunction]
#[pyo3(signature = (image, options=None))]
pub(crate) fn sift<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<(Array<'py, f32>, Array<'py, u8>)> {
    let options = options::plain("sift", &FeatureOptions::default(), options)?;
    let grey = match image.extract::<PyReadonlyArray2<'_, u8>>() {
        Ok(array) => {
            let view = array.as_array();
            let size = |n: usize| u32::try_from(n).map_err(|_| input("image: too large"));
            let (columns, rows) = (size(view.ncols())?, size(view.nrows())?);
            let pixels = view.iter().copied().collect();
            GrayImage::from_raw(columns, rows, pixels).ok_or_else(|| input("image: too large"))?
        }
        Err(_) => features::grey(&photo(image)?),
    };
    let found = without_python(py, || features::detect(&grey, &options))?;
    let points = found.key_points.iter();
    let points =
        points.flat_map(|p| [p.u_px, p.v_px, p.sigma_px, p.angle_rad, p.response]).collect();
    let descriptors = found.descriptors.as_bytes().to_vec();
    Ok((table(py, 5, points)?, table(py, features::DESCRIPTOR_LENGTH, descriptors)?))
}

/// Correspondences `(m, 2)` of two sets of descriptors.
#[pyfunction]
#[pyo3(name = "match_descriptors", signature = (first, second, options=None))]
pub(crate) fn match_descriptors<'py>(
    py: Python<'py>,
    first: &Bound<'py, PyAny>,
    second: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Array<'py, u32>> {
    let options = options::plain("match", &matching::MatchOptions::default(), options)?;
    let read = |name: &str, given: &Bound<'py, PyAny>| -> PyResult<Descriptors> {
        let wrong = || unexpected(name, "an array of uint8 with shape (n, 128)", given);
        let array: PyReadonlyArray2<'_, u8> = given.extract().map_err(|_| wrong())?;
        if array.shape()[1] != features::DESCRIPTOR_LENGTH {
            return Err(wrong());
        }
        Descriptors::from_bytes(array.as_array().iter().copied().collect()).ok_or_else(wrong)
    };
    let (first, second) = (read("first", first)?, read("second", second)?);
    let found = without_python(py, || {
        if first.is_empty() || second.is_empty() {
            return Vec::new();
        }
        matching::match_descriptors(&first, &second, &options)
    })?;
    table(py, 2, found.iter().flat_map(|m| [m.first, m.second]).collect())
}
