//! Engine two from Python: coordinate descent.

use crate::error::{from_solver, input, without_python};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods};
use pyo3::{prelude::*, types::PyDict};
use rowgram::{
    descent::{self, ActiveSet, BlockCost, CoordinateDescentOptions, Order},
    engine::SolveError,
};
use std::sync::Mutex;

/// A problem whose cost and updates are Python functions of one array.
struct PythonProblem {
    blocks: usize,
    /// All variables; the functions see and change this one array.
    x: Py<PyArray1<f64>>,
    cost: Py<PyAny>,
    update: Py<PyAny>,
    end_sweep: Option<Py<PyAny>>,
    monotone: bool,
    raised: Mutex<Option<PyErr>>,
}

impl PythonProblem {
    /// The outcome of a call; after the first exception nothing is called any more.
    fn call<T>(&self, other: T, work: impl FnOnce(Python<'_>) -> PyResult<T>) -> T {
        let is_raised = self.raised.lock().map_or(true, |raised| raised.is_some());
        if is_raised {
            return other;
        }
        Python::attach(|py| {
            work(py).unwrap_or_else(|error| {
                if let Ok(mut raised) = self.raised.lock() {
                    raised.get_or_insert(error);
                }
                other
            })
        })
    }

    fn read(&self, py: Python<'_>) -> PyResult<Vec<f64>> {
        Ok(self.x.bind(py).to_vec()?)
    }
}

impl BlockCost for PythonProblem {
    type Iterate = Vec<f64>;

    fn len(&self) -> usize {
        self.blocks
    }

    fn prepare(&self, x: &mut Vec<f64>) -> Result<(), SolveError> {
        match x.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(at) => {
                Err(SolveError::Misuse(format!("x[{at}] is {}, expected a finite number", x[at])))
            }
        }
    }

    fn cost(&self, _: &Vec<f64>) -> f64 {
        self.call(f64::NAN, |py| self.cost.bind(py).call1((self.x.bind(py),))?.extract())
    }

    fn monotone(&self) -> bool {
        self.monotone
    }

    fn update(&self, _: &mut Vec<f64>, block: usize, active: &mut ActiveSet) -> f64 {
        self.call(0.0, |py| {
            let found = self.update.bind(py).call1((self.x.bind(py), block))?;
            let (moved, marked): (f64, Vec<usize>) = found.extract().map_err(|_| {
                input("update: expected (distance moved, numbers of blocks to visit again)")
            })?;
            marked.into_iter().for_each(|block| active.mark(block));
            Ok(moved)
        })
    }

    fn end_sweep(&self, x: &mut Vec<f64>, active: &mut ActiveSet) {
        let values = self.call(None, |py| {
            if let Some(end) = &self.end_sweep {
                let marked: Vec<usize> = end.bind(py).call1((self.x.bind(py),))?.extract()?;
                marked.into_iter().for_each(|block| active.mark(block));
            }
            self.read(py).map(Some)
        });
        if let Some(values) = values {
            *x = values;
        }
    }
}

/// Descends: `(x, summary)`.
#[pyfunction]
#[pyo3(signature = (x, blocks, cost, update, end_sweep=None, monotone=true, shuffled=false, seed=0, max_sweeps=500, movement_tolerance=1e-2, cost_tolerance=1e-6))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of one Python function")]
pub(crate) fn coordinate_descent<'py>(
    py: Python<'py>,
    x: Vec<f64>,
    blocks: usize,
    cost: Py<PyAny>,
    update: Py<PyAny>,
    end_sweep: Option<Py<PyAny>>,
    monotone: bool,
    shuffled: bool,
    seed: u64,
    max_sweeps: u64,
    movement_tolerance: f64,
    cost_tolerance: f64,
) -> PyResult<(Bound<'py, PyArray1<f64>>, Bound<'py, PyDict>)> {
    let array = x.clone().into_pyarray(py);
    let raised = Mutex::new(None);
    let problem = PythonProblem {
        blocks,
        x: array.clone().unbind(),
        cost,
        update,
        end_sweep,
        monotone,
        raised,
    };
    let order = if shuffled { Order::Shuffled } else { Order::Cyclic };
    let options = CoordinateDescentOptions { order, seed, movement_tolerance, cost_tolerance };
    let mut x = x;
    let problem = &problem;
    let outcome =
        without_python(py, || descent::run(problem, &mut x, options, max_sweeps, |_, _| ()))?;
    if let Some(error) = problem.raised.lock().ok().and_then(|mut raised| raised.take()) {
        return Err(error);
    }
    let outcome = outcome.map_err(|error| from_solver(&error))?;
    let summary = PyDict::new(py);
    summary.set_item("initial_cost", outcome.initial_cost)?;
    summary.set_item("final_cost", outcome.final_cost)?;
    summary.set_item("sweeps", outcome.iterations)?;
    summary.set_item("stop", outcome.stop.word())?;
    summary.set_item("converged", outcome.stop.converged())?;
    Ok((array, summary))
}
