//! The Python module `rowgram._rowgram`: the library over plain objects and NumPy arrays.
//!
//! Nothing is computed here. The package `rowgram` around it has the documented names.

mod arrays;
mod bundle;
mod descent;
mod error;
mod least_squares;
mod monitor;
mod options;
mod project;
mod residuals;
mod synth;

use pyo3::prelude::*;

/// The most memory that the content of one file may take, megabytes; `None`: what the machine has free.
#[pyfunction]
fn limit_memory(megabytes: Option<u32>) {
    rowgram::io::memory::set_limit_bytes(
        megabytes.map(|megabytes| 1_000_000 * u64::from(megabytes)),
    );
}

/// What the package is made of.
#[pymodule]
fn _rowgram(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("BUILD", rowgram::BUILD)?;
    module.add_class::<project::Project>()?;
    module.add_class::<least_squares::Problem>()?;
    module.add_function(wrap_pyfunction!(limit_memory, module)?)?;
    module.add_function(wrap_pyfunction!(project::stage_names, module)?)?;
    module.add_function(wrap_pyfunction!(project::sections, module)?)?;
    module.add_function(wrap_pyfunction!(project::doctor, module)?)?;
    module.add_function(wrap_pyfunction!(project::season, module)?)?;
    module.add_function(wrap_pyfunction!(project::print_targets, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::segment, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::spectral_index, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::locate, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::find_leaves, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::sift, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::match_descriptors, module)?)?;
    module.add_function(wrap_pyfunction!(synth::synth_field, module)?)?;
    module.add_function(wrap_pyfunction!(synth::synth_flight, module)?)?;
    module.add_function(wrap_pyfunction!(synth::synth_map, module)?)?;
    module.add_function(wrap_pyfunction!(bundle::adjust_network, module)?)?;
    module.add_function(wrap_pyfunction!(bundle::read_bal, module)?)?;
    module.add_function(wrap_pyfunction!(bundle::adjust_file, module)?)?;
    module.add_function(wrap_pyfunction!(descent::coordinate_descent, module)?)?;
    Ok(())
}
