//! Residuals for `Problem`: written in Python over NumPy, or named ones in Rust.

use crate::{arrays::array, error::input};
use numpy::{PyArray1, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::{prelude::*, types::PyTuple};
use rowgram::nlls::{
    Batch, BlockId, Infeasible, InfeasibleFactor, Residual, Scalar, Values, Vector,
    manifold::{Euclidean, Manifold, Pose, Rotation, Similarity, UnitVector},
    residual::PoseBlock,
};
use std::{
    ops::Range,
    sync::{Arc, Mutex},
};

/// The first exception that a function raised while the engine ran.
pub(crate) type Raised = Arc<Mutex<Option<PyErr>>>;

/// Where a block lives.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Space {
    Euclidean(usize),
    Rotation,
    Pose,
    UnitVector,
    Similarity,
}

impl Space {
    /// By name; vectors have as many numbers as are given.
    pub(crate) fn read(name: &str, values: usize) -> PyResult<Space> {
        Ok(match name {
            "euclidean" => Space::Euclidean(values),
            "rotation" => Space::Rotation,
            "pose" => Space::Pose,
            "unit-vector" => Space::UnitVector,
            "similarity" => Space::Similarity,
            _ => {
                return Err(input(format!(
                    "manifold {name:?}: expected euclidean, rotation, pose, unit-vector or similarity"
                )));
            }
        })
    }

    pub(crate) fn manifold(&self) -> &dyn Manifold {
        // A vector's length is not known here, and nothing but `plus` of it is used.
        match self {
            Space::Euclidean(_) => &Euclidean(0),
            Space::Rotation => &Rotation,
            Space::Pose => &Pose,
            Space::UnitVector => &UnitVector,
            Space::Similarity => &Similarity,
        }
    }

    pub(crate) fn ambient(&self) -> usize {
        match self {
            Space::Euclidean(n) => *n,
            _ => self.manifold().ambient(),
        }
    }

    pub(crate) fn tangent(&self) -> usize {
        match self {
            Space::Euclidean(n) => *n,
            _ => self.manifold().tangent(),
        }
    }
}

/// Factors of one Python function that is evaluated for many of them at once.
pub(crate) struct PythonBatch {
    /// The blocks of each factor, one factor after the other.
    pub(crate) blocks: Vec<BlockId>,
    /// Where the blocks of a factor live.
    pub(crate) spaces: Vec<Space>,
    pub(crate) rows: usize,
    /// `residual(*blocks, *data)`: arrays of shape (n, ..) to an array of shape (n, rows).
    pub(crate) residual: Py<PyAny>,
    /// Derivatives by the tangents of the blocks, a tuple of arrays of shape (n, rows, tangent); differences without.
    pub(crate) jacobian: Option<Py<PyAny>>,
    /// Arrays whose first axis counts the factors.
    pub(crate) data: Vec<Py<PyAny>>,
    pub(crate) raised: Raised,
}

/// Steps of central differences, relative to 1 or to the value: the cube root of a rounding.
const STEP: f64 = 6e-6;

impl PythonBatch {
    fn arity(&self) -> usize {
        self.spaces.len()
    }

    /// The values of block `k` of the factors of a range, one after the other.
    fn gather(&self, k: usize, range: &Range<usize>, x: Values<'_>) -> Vec<f64> {
        let ids = range.clone().map(|factor| self.blocks[factor * self.arity() + k]);
        ids.flat_map(|id| x.block(id).iter().copied()).collect()
    }

    /// The arguments of a call: blocks, then data.
    fn arguments<'py>(
        &self,
        py: Python<'py>,
        range: &Range<usize>,
        values: &[Vec<f64>],
    ) -> PyResult<Bound<'py, PyTuple>> {
        let mut all: Vec<Bound<'py, PyAny>> = Vec::with_capacity(values.len() + self.data.len());
        for values in values {
            let array = PyArray1::from_slice(py, values);
            all.push(array.reshape([range.len(), values.len() / range.len()])?.into_any());
        }
        let slice = pyo3::types::PySlice::new(py, range.start as isize, range.end as isize, 1);
        for data in &self.data {
            all.push(data.bind(py).get_item(&slice)?);
        }
        PyTuple::new(py, all)
    }

    fn call(
        &self,
        py: Python<'_>,
        range: &Range<usize>,
        values: &[Vec<f64>],
        out: &mut [f64],
    ) -> PyResult<()> {
        let found = self.residual.bind(py).call1(self.arguments(py, range, values)?)?;
        copy("the residual", &found, &[range.len(), self.rows], out)
    }

    fn work(
        &self,
        py: Python<'_>,
        range: &Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> PyResult<()> {
        let mut values: Vec<Vec<f64>> =
            (0..self.arity()).map(|k| self.gather(k, range, x)).collect();
        self.call(py, range, &values, residual)?;
        let Some(jacobian) = jacobian else { return Ok(()) };
        let (count, rows) = (range.len(), self.rows);
        if let Some(function) = &self.jacobian {
            let found = function.bind(py).call1(self.arguments(py, range, &values)?)?;
            let mut first = 0;
            for (k, space) in self.spaces.iter().enumerate() {
                let tangent = space.tangent();
                let mut part = vec![0.0; count * rows * tangent];
                let name = format!("part {k} of the jacobian");
                copy(&name, &found.get_item(k)?, &[count, rows, tangent], &mut part)?;
                for (at, entries) in part.chunks_exact(tangent).enumerate() {
                    let row = at * width + first;
                    jacobian[row..row + tangent].copy_from_slice(entries);
                }
                first += tangent;
            }
            return Ok(());
        }
        let mut ends = [vec![0.0; residual.len()], vec![0.0; residual.len()]];
        let mut column = 0;
        for (k, space) in self.spaces.iter().enumerate() {
            let original = values[k].clone();
            let ambient = space.ambient();
            for entry in 0..space.tangent() {
                let mut steps = vec![0.0; count];
                for (sign, end) in [1.0, -1.0].into_iter().zip(&mut ends) {
                    for factor in 0..count {
                        let from = &original[factor * ambient..(factor + 1) * ambient];
                        // Rotations and directions have no size; vectors have.
                        let size = match space {
                            Space::Euclidean(_) => from[entry].abs().max(1.0),
                            _ => 1.0,
                        };
                        let mut d = vec![0.0; space.tangent()];
                        d[entry] = sign * STEP * size;
                        steps[factor] = STEP * size;
                        let to = &mut values[k][factor * ambient..(factor + 1) * ambient];
                        space.manifold().plus(from, &d, to);
                    }
                    self.call(py, range, &values, end)?;
                }
                for (at, (plus, minus)) in ends[0].iter().zip(&ends[1]).enumerate() {
                    jacobian[at * width + column] = (plus - minus) / (2.0 * steps[at / rows]);
                }
                column += 1;
            }
            values[k] = original;
        }
        Ok(())
    }
}

/// Copies an array of the expected shape.
fn copy(name: &str, found: &Bound<'_, PyAny>, shape: &[usize], out: &mut [f64]) -> PyResult<()> {
    let wrong = || input(format!("{name}: expected an array of numbers"));
    let array = array::<f64>(found, "float64").ok_or_else(wrong)?;
    if array.shape() != shape {
        return Err(input(format!(
            "{name} has shape {:?}, expected {shape:?} (one entry per factor of the call, then its rows)",
            array.shape()
        )));
    }
    out.iter_mut().zip(array.as_array()).for_each(|(out, &value)| *out = value);
    Ok(())
}

impl Batch for PythonBatch {
    fn len(&self) -> usize {
        self.blocks.len() / self.arity()
    }

    fn rows(&self) -> usize {
        self.rows
    }

    fn blocks(&self, factor: usize) -> &[BlockId] {
        &self.blocks[factor * self.arity()..(factor + 1) * self.arity()]
    }

    fn linearize(
        &self,
        range: Range<usize>,
        x: Values<'_>,
        residual: &mut [f64],
        jacobian: Option<&mut [f64]>,
        width: usize,
    ) -> Result<(), InfeasibleFactor> {
        if range.is_empty() {
            return Ok(());
        }
        let outcome = Python::attach(|py| self.work(py, &range, x, residual, jacobian, width));
        outcome.map_err(|error| {
            if let Ok(mut raised) = self.raised.lock() {
                raised.get_or_insert(error);
            }
            InfeasibleFactor(range.start)
        })
    }
}

/// The image of a point, in pixels from the principal point, u right and v down, for a camera that looks along +z
/// (COLMAP's): blocks pose (`camera_from_world`), point, and `[f, k1, k2]`.
pub(crate) struct Reprojection {
    pub(crate) image_px: [f64; 2],
    pub(crate) sigma_px: f64,
}

impl Residual<2> for Reprojection {
    type Blocks = (PoseBlock, Vector<3>, Vector<3>);

    fn evaluate<T: Scalar>(
        &self,
        (pose, point, [f, k1, k2]): <Self::Blocks as rowgram::nlls::residual::Blocks>::Of<T>,
    ) -> Result<[T; 2], Infeasible> {
        let [x, y, z] = pose.transform(point);
        if z.value() <= 0.0 {
            return Err(Infeasible);
        }
        let (u, v) = (x / z, y / z);
        let r2 = u * u + v * v;
        let scale = f * (r2 * (k2 * r2 + k1) + 1.0);
        Ok([
            (u * scale - self.image_px[0]) / self.sigma_px,
            (v * scale - self.image_px[1]) / self.sigma_px,
        ])
    }
}

/// The measured place of a camera's projection centre: block pose (`camera_from_world`).
pub(crate) struct CameraPosition {
    pub(crate) position: [f64; 3],
    pub(crate) sigma: [f64; 3],
}

impl Residual<3> for CameraPosition {
    type Blocks = (PoseBlock,);

    fn evaluate<T: Scalar>(
        &self,
        (pose,): <Self::Blocks as rowgram::nlls::residual::Blocks>::Of<T>,
    ) -> Result<[T; 3], Infeasible> {
        let zero = pose.translation[0] * 0.0;
        let centre = pose.transform_back([zero; 3]);
        Ok(std::array::from_fn(|k| (centre[k] - self.position[k]) / self.sigma[k]))
    }
}

/// Rows of a two-dimensional array of numbers.
pub(crate) fn rows(
    name: &str,
    columns: usize,
    given: &Bound<'_, PyAny>,
) -> PyResult<Vec<Vec<f64>>> {
    let wrong = || input(format!("{name}: expected an array of numbers with shape (n, {columns})"));
    let array = array::<f64>(given, "float64").ok_or_else(wrong)?;
    if !matches!(*array.shape(), [_, found] if found == columns) {
        return Err(wrong());
    }
    Ok(array.as_array().outer_iter().map(|row| row.iter().copied().collect()).collect())
}
