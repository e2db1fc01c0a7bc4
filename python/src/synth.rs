//! Synthetic fields and flights with their ground truth.

use crate::{
    arrays::table,
    error::{from_library, input, result, without_python},
    monitor::PythonMonitor,
    options,
};
use data_synth::{
    scenario::{Preset, Scenario},
    twin::{FlightPreset, TwinConfig},
};
use numpy::{IntoPyArray, PyArray3, PyArrayMethods};
use pyo3::{prelude::*, types::PyDict};
use rowgram::pipeline::synth::{FlightOptions, MapOptions, write_flight, write_map};
use std::path::PathBuf;

/// A usual field with other parameters.
fn scenario(
    preset: &str,
    field: Option<&Bound<'_, PyDict>>,
    corruption: Option<&Bound<'_, PyDict>>,
) -> PyResult<Scenario> {
    let preset: Preset =
        preset.parse().map_err(|why| input(format!("preset {preset:?}: {why}")))?;
    let mut scenario = Scenario::preset(preset);
    scenario.field = options::plain("field", &scenario.field, field)?;
    scenario.corruption = options::plain("corruption", &scenario.corruption, corruption)?;
    Ok(scenario)
}

/// A field from straight above: mask, picture, true plants, and the configuration.
#[pyfunction]
#[pyo3(signature = (preset, field=None, corruption=None))]
pub(crate) fn synth_field<'py>(
    py: Python<'py>,
    preset: &str,
    field: Option<&Bound<'py, PyDict>>,
    corruption: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let scenario = scenario(preset, field, corruption)?;
    let scene = scenario.build().map_err(input)?;
    let (mask, picture) = without_python(py, || scene.mask_and_picture())?;
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let out = PyDict::new(py);
    let leaf = mask.into_raw().into_iter().map(|pixel| pixel != 0).collect();
    out.set_item("mask", table(py, width, leaf)?)?;
    let picture = picture.into_raw().into_pyarray(py).reshape([height, width, 3])?;
    let picture: Bound<'py, PyArray3<u8>> = picture;
    out.set_item("image", picture)?;
    let plants = &scene.field.plants;
    out.set_item(
        "plants_px",
        table(py, 2, plants.iter().flat_map(|p| [p.u_px, p.v_px]).collect())?,
    )?;
    out.set_item("plants_m", table(py, 2, plants.iter().flat_map(|p| [p.x_m, p.y_m]).collect())?)?;
    let rows: Vec<i64> = plants.iter().map(|plant| plant.row as i64).collect();
    out.set_item("row", rows.into_pyarray(py))?;
    out.set_item("gsd_m", scenario.field.gsd_m)?;
    out.set_item("config", result(py, &scenario)?)?;
    Ok(out)
}

/// An orthomosaic of five bands of known reflectance as a project folder.
#[pyfunction]
#[pyo3(signature = (folder, preset, field=None, corruption=None, samples="u16", force=false))]
pub(crate) fn synth_map<'py>(
    py: Python<'py>,
    folder: PathBuf,
    preset: &str,
    field: Option<&Bound<'py, PyDict>>,
    corruption: Option<&Bound<'py, PyDict>>,
    samples: &str,
    force: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let scenario = scenario(preset, field, corruption)?;
    let samples = samples.parse().map_err(|why| input(format!("samples {samples:?}: {why}")))?;
    let options = MapOptions { samples, ..MapOptions::default() };
    let made = without_python(py, || write_map(&scenario, &options, &folder, force))?;
    result(py, &made.map_err(|error| from_library(&error))?)
}

/// A flight over a synthetic field as a project folder.
#[pyfunction]
#[pyo3(signature = (folder, preset, sections=None, photos=true, photo_truth=false, boards=0, force=false, progress=None))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of one Python function")]
pub(crate) fn synth_flight<'py>(
    py: Python<'py>,
    folder: PathBuf,
    preset: &str,
    sections: Option<&Bound<'py, PyDict>>,
    photos: bool,
    photo_truth: bool,
    boards: u16,
    force: bool,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let preset: FlightPreset =
        preset.parse().map_err(|why| input(format!("preset {preset:?}: {why}")))?;
    let mut config = TwinConfig::preset(preset);
    for (name, keys) in sections.into_iter().flatten() {
        let name: String = name.extract()?;
        let keys = keys
            .cast::<PyDict>()
            .map_err(|_| input(format!("{name}: expected a dictionary, as {name}={{...}}")))?;
        let keys = Some(keys);
        match name.as_str() {
            "field" => config.field = options::plain("field", &config.field, keys)?,
            "corruption" => {
                config.corruption = options::plain("corruption", &config.corruption, keys)?
            }
            "clutter" => config.clutter = options::plain("clutter", &config.clutter, keys)?,
            "site" => config.site = options::plain("site", &config.site, keys)?,
            "camera" => config.camera = options::plain("camera", &config.camera, keys)?,
            "flight" => config.flight = options::plain("flight", &config.flight, keys)?,
            "targets" => config.targets = options::plain("targets", &config.targets, keys)?,
            "image" => config.image = options::plain("image", &config.image, keys)?,
            "tie_points" => {
                config.tie_points = options::plain("tie_points", &config.tie_points, keys)?
            }
            _ => {
                return Err(input(format!(
                    "{name}: expected field, corruption, clutter, site, camera, flight, targets, image or tie_points"
                )));
            }
        }
    }
    let options = FlightOptions { photos, photo_truth, boards };
    let mut monitor = PythonMonitor::new(progress);
    let made =
        without_python(py, || write_flight(&config, &options, &folder, force, &mut monitor))?;
    monitor.finish()?;
    result(py, &made.map_err(|error| from_library(&error))?)
}
