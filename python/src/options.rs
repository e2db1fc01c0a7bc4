//! Options of the library from keyword arguments.

use crate::error::input;
use pyo3::{
    prelude::*,
    types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple},
};
use rowgram::options::{Field, Options};
use toml::{Table, Value};

/// A Python value as a value of an option; `name` is for messages.
pub(crate) fn value(name: &str, given: &Bound<'_, PyAny>) -> PyResult<Value> {
    // A bool is an int in Python.
    if given.is_instance_of::<PyBool>() {
        return Ok(Value::Boolean(given.extract()?));
    }
    if given.is_instance_of::<PyInt>() {
        let integer: i64 = given
            .extract()
            .map_err(|_| input(format!("{name}: expected a number of at most 64 bits")))?;
        return Ok(Value::Integer(integer));
    }
    if given.is_instance_of::<PyFloat>() {
        return Ok(Value::Float(given.extract()?));
    }
    if given.is_instance_of::<PyString>() {
        return Ok(Value::String(given.extract()?));
    }
    if given.is_instance_of::<PyList>() || given.is_instance_of::<PyTuple>() {
        let values = given.try_iter()?.map(|item| value(name, &item?));
        return Ok(Value::Array(values.collect::<PyResult<_>>()?));
    }
    if let Ok(group) = given.cast::<PyDict>() {
        return Ok(Value::Table(table(Some(group))?));
    }
    if given.hasattr("__fspath__")? {
        let path: std::path::PathBuf = given.extract()?;
        return Ok(Value::String(path.display().to_string()));
    }
    // Numbers of NumPy.
    if let Ok(scalar) = given.call_method0("item")
        && !scalar.hasattr("item")?
    {
        return value(name, &scalar);
    }
    let kind = given.get_type().name()?;
    Err(input(format!("{name}: expected a number, text, list or path, not {kind}")))
}

/// Keyword arguments as a table; those that are `None` stay as they are by default.
pub(crate) fn table(given: Option<&Bound<'_, PyDict>>) -> PyResult<Table> {
    let mut table = Table::new();
    let Some(given) = given else { return Ok(table) };
    for (key, item) in given {
        let name: String =
            key.extract().map_err(|_| input("names of options: expected text".to_owned()))?;
        if !item.is_none() {
            table.insert(name.clone(), value(&name, &item)?);
        }
    }
    Ok(table)
}

/// Options with keyword arguments put in.
pub(crate) fn with<T: Options>(base: &T, given: Option<&Bound<'_, PyDict>>) -> PyResult<T> {
    let options = base.with(&table(given)?).map_err(input)?;
    options.validate().map_err(input)?;
    Ok(options)
}

/// A serde struct with keyword arguments put in; `what` names it in messages, `names` are its fields.
pub(crate) fn plain<T: serde::Serialize + serde::de::DeserializeOwned>(
    what: &str,
    base: &T,
    given: Option<&Bound<'_, PyDict>>,
) -> PyResult<T> {
    let mut all = Table::try_from(base).map_err(input)?;
    let names: Vec<String> = all.keys().cloned().collect();
    for (name, item) in table(given)? {
        // Names in Python have underscores.
        let key = if all.contains_key(&name) { name.clone() } else { name.replace('_', "-") };
        if !all.contains_key(&key) {
            let known: Vec<&str> = names.iter().map(String::as_str).collect();
            let near = rowgram::options::nearest(&name, &known);
            let hint = near.map(|near| format!("; did you mean {near}?")).unwrap_or_default();
            let known = known.join(", ");
            return Err(input(format!("{what} has no option {name}{hint} (there are: {known})")));
        }
        let item = match (all.get(&key), item) {
            (Some(Value::Float(_)), Value::Integer(integer)) => Value::Float(integer as f64),
            (_, item) => item,
        };
        all.insert(key, item);
    }
    Value::Table(all).try_into().map_err(|error: toml::de::Error| input(error.message()))
}

/// The definition of an option.
pub(crate) fn describe<'py>(py: Python<'py>, field: &Field) -> PyResult<Bound<'py, PyDict>> {
    let entry = PyDict::new(py);
    entry.set_item("name", field.name)?;
    entry.set_item("about", field.doc.trim())?;
    entry.set_item("unit", field.unit())?;
    let default = serde_json::to_value(&field.default).unwrap_or(serde_json::Value::Null);
    entry.set_item("default", crate::error::to_python(py, &default)?)?;
    Ok(entry)
}
