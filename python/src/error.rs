//! Errors of the library as Python exceptions.

use pyo3::{IntoPyObjectExt, prelude::*};
use rowgram::{Error, engine::SolveError, error::Kind};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// An exception of `rowgram._errors`.
pub(crate) fn exception(class: &str, message: impl ToString) -> PyErr {
    Python::attach(|py| {
        let made = py
            .import("rowgram._errors")
            .and_then(|module| module.getattr(class))
            .and_then(|class| class.call1((message.to_string(),)));
        match made {
            Ok(value) => PyErr::from_value(value),
            Err(error) => error,
        }
    })
}

/// The input cannot be used as given.
pub(crate) fn input(message: impl ToString) -> PyErr {
    exception("InputError", message)
}

/// The exception that an error of the library becomes.
pub(crate) fn from_library(error: &Error) -> PyErr {
    let class = match error {
        Error::NothingToDo(_) => "NothingToDoError",
        Error::Solve(error) => return from_solver(error),
        _ => match error.kind() {
            Kind::BadInput => "InputError",
            Kind::Incomplete => "IncompleteError",
            Kind::Failure => "RowgramError",
        },
    };
    exception(class, error)
}

/// The exception that an error of an engine becomes.
pub(crate) fn from_solver(error: &SolveError) -> PyErr {
    let class = if matches!(error, SolveError::Misuse(_)) { "InputError" } else { "SolverError" };
    exception(class, error)
}

/// Does long work without holding the interpreter. A panic becomes an `InternalError`.
pub(crate) fn without_python<T: Send>(
    py: Python<'_>,
    work: impl FnOnce() -> T + Send,
) -> PyResult<T> {
    py.detach(|| catch_unwind(AssertUnwindSafe(work))).map_err(|panic| {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
        exception("InternalError", format!("internal error: {text}"))
    })
}

/// A value as plain Python objects: dictionaries, lists, strings, numbers.
pub(crate) fn to_python<'py>(
    py: Python<'py>,
    value: &serde_json::Value,
) -> PyResult<Bound<'py, PyAny>> {
    use serde_json::Value;
    match value {
        Value::Null => Ok(py.None().into_bound(py)),
        Value::Bool(flag) => flag.into_bound_py_any(py),
        Value::Number(number) => match (number.as_i64(), number.as_u64()) {
            (Some(integer), _) => integer.into_bound_py_any(py),
            (_, Some(integer)) => integer.into_bound_py_any(py),
            _ => number.as_f64().into_bound_py_any(py),
        },
        Value::String(text) => text.into_bound_py_any(py),
        Value::Array(values) => {
            let list = pyo3::types::PyList::empty(py);
            values.iter().try_for_each(|value| list.append(to_python(py, value)?))?;
            Ok(list.into_any())
        }
        Value::Object(entries) => {
            let dict = pyo3::types::PyDict::new(py);
            for (key, value) in entries {
                dict.set_item(key, to_python(py, value)?)?;
            }
            Ok(dict.into_any())
        }
    }
}

/// A result of the library as plain Python objects.
pub(crate) fn result<'py>(
    py: Python<'py>,
    value: &impl serde::Serialize,
) -> PyResult<Bound<'py, PyAny>> {
    let value = serde_json::to_value(value)
        .map_err(|error| exception("InternalError", format!("internal error: {error}")))?;
    to_python(py, &value)
}
