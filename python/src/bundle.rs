//! Bundle adjustment of arrays, by the fused path of engine one.

use crate::{
    arrays::table,
    error::{exception, from_library, from_solver, input, result, without_python},
    least_squares::count,
    monitor::PythonMonitor,
    options,
    residuals::rows,
};
use numpy::{IntoPyArray, PyReadonlyArray1};
use pyo3::{prelude::*, types::PyDict};
use rowgram::{
    io::bal,
    nlls::{self, Loss},
    pipeline::adjust::{self, AdjustOptions, Outputs},
    problems::bundle::{Bundle, Camera, InteriorSharing, Network, Observation},
};
use std::path::PathBuf;

fn indices(name: &str, given: &Bound<'_, PyAny>) -> PyResult<Vec<u32>> {
    let wrong = || input(format!("{name}: expected an array of whole numbers with shape (n,)"));
    let array =
        given.py().import("numpy")?.call_method1("asarray", (given,)).map_err(|_| wrong())?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if !matches!(kind.as_str(), "i" | "u") {
        return Err(wrong());
    }
    let array: PyReadonlyArray1<'_, i64> =
        array.call_method1("astype", ("int64",))?.extract().map_err(|_| wrong())?;
    let whole = |&index: &i64| {
        u32::try_from(index).map_err(|_| input(format!("{name}: {index} is no index")))
    };
    array.as_array().iter().map(whole).collect()
}

fn arrays<'py>(py: Python<'py>, network: &Network) -> PyResult<Bound<'py, PyDict>> {
    let camera = |c: &Camera| [c.rotation_rad, c.translation, c.interior].concat();
    let out = PyDict::new(py);
    out.set_item("cameras", table(py, 9, network.cameras.iter().flat_map(camera).collect())?)?;
    out.set_item("points", table(py, 3, network.points.iter().flatten().copied().collect())?)?;
    Ok(out)
}

/// Adjusts cameras `(n, 9)` and points `(m, 3)`: both adjusted, and a summary.
#[pyfunction]
#[pyo3(signature = (cameras, points, camera_index, point_index, image_px, loss=None, shared=false, max_iterations=50, options=None))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of one Python function")]
pub(crate) fn adjust_network<'py>(
    py: Python<'py>,
    cameras: &Bound<'py, PyAny>,
    points: &Bound<'py, PyAny>,
    camera_index: &Bound<'py, PyAny>,
    point_index: &Bound<'py, PyAny>,
    image_px: &Bound<'py, PyAny>,
    loss: Option<&str>,
    shared: bool,
    max_iterations: u64,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let options = options::plain("bundle_adjust", &nlls::Options::default(), options)?;
    let loss: Loss =
        loss.map_or(Ok(Loss::Trivial), str::parse).map_err(|why| input(format!("loss: {why}")))?;
    let three = |row: &[f64], from: usize| [row[from], row[from + 1], row[from + 2]];
    let camera = |row: &Vec<f64>| Camera {
        rotation_rad: three(row, 0),
        translation: three(row, 3),
        interior: three(row, 6),
    };
    let (of, to) = (indices("camera_index", camera_index)?, indices("point_index", point_index)?);
    let measured = rows("image_px", 2, image_px)?;
    if of.len() != measured.len() || to.len() != measured.len() {
        return Err(input(format!(
            "camera_index, point_index and image_px have {}, {} and {} rows: expected as many of each",
            of.len(),
            to.len(),
            measured.len()
        )));
    }
    let observation = |((camera, point), at): ((u32, u32), Vec<f64>)| Observation {
        camera,
        point,
        image_px: [at[0], at[1]],
    };
    let mut network = Network {
        cameras: rows("cameras", 9, cameras)?.iter().map(camera).collect(),
        points: rows("points", 3, points)?.iter().map(|row| three(row, 0)).collect(),
        observations: of.into_iter().zip(to).zip(measured).map(observation).collect(),
    };
    count(network.observations.len())?;
    let sharing = if shared { InteriorSharing::Shared } else { InteriorSharing::PerImage };
    let summary = without_python(py, || {
        let bundle = Bundle::new(&network, sharing, loss)?;
        let mut x = bundle.problem.start();
        let summary = nlls::solve(&bundle.problem, &mut x, &options, max_iterations)?;
        bundle.update(&x, &mut network);
        Ok(summary)
    })?
    .map_err(|error| from_solver(&error))?;
    let out = arrays(py, &network)?;
    let found = result(py, &summary)?;
    found.set_item("converged", summary.stop.converged())?;
    found.set_item("text", summary.to_string())?;
    out.set_item("summary", found)?;
    Ok(out)
}

/// A file of Bundle Adjustment in the Large as arrays.
#[pyfunction]
pub(crate) fn read_bal(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let network =
        without_python(py, || bal::read(&path))?.map_err(|error| exception("InputError", error))?;
    let out = arrays(py, &network)?;
    let all = &network.observations;
    let of = |index: fn(&Observation) -> u32| {
        all.iter().map(|o| i64::from(index(o))).collect::<Vec<_>>().into_pyarray(py)
    };
    out.set_item("camera_index", of(|o| o.camera))?;
    out.set_item("point_index", of(|o| o.point))?;
    out.set_item("image_px", table(py, 2, all.iter().flat_map(|o| o.image_px).collect())?)?;
    Ok(out)
}

/// Adjusts the block of a file (COLMAP folder, Bundler, OpenSfM, rowgram, BAL): the report, and a summary for people.
#[pyfunction]
#[pyo3(signature = (file, output=None, force=false, options=None, progress=None))]
pub(crate) fn adjust_file<'py>(
    py: Python<'py>,
    file: PathBuf,
    output: Option<PathBuf>,
    force: bool,
    options: Option<&Bound<'py, PyDict>>,
    progress: Option<Py<PyAny>>,
) -> PyResult<(Bound<'py, PyAny>, String)> {
    let options = options::with(&AdjustOptions::default(), options)?;
    let outputs = Outputs { output, force, ..Outputs::default() };
    let mut monitor = PythonMonitor::new(progress);
    let outcome = without_python(py, || adjust::adjust(&file, &options, &outputs, &mut monitor))?;
    monitor.finish()?;
    let outcome = outcome.map_err(|error| from_library(&error))?;
    Ok((result(py, &outcome)?, outcome.to_string()))
}
