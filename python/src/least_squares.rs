//! Engine one from Python: sparse nonlinear least squares.

use crate::{
    arrays::array,
    error::{exception, from_solver, input, result, without_python},
    options,
    residuals::{CameraPosition, PythonBatch, Raised, Reprojection, Space, rows},
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyUntypedArrayMethods};
use pyo3::{prelude::*, types::PyDict};
use rowgram::{
    engine::SolveError,
    nlls::{
        self, BlockId, Euclidean, Factors, GaussianPrior, LinearSolver, Loss, Residuals,
        covariance::Covariance,
        manifold::{Pose, Rotation, Similarity, UnitVector},
    },
};

/// Parameter blocks and residuals.
#[pyclass(module = "rowgram._rowgram")]
pub(crate) struct Problem {
    problem: nlls::Problem,
    ids: Vec<BlockId>,
    spaces: Vec<Space>,
    x: Vec<f64>,
    raised: Raised,
}

fn loss(text: Option<&str>) -> PyResult<Loss> {
    text.map_or(Ok(Loss::Trivial), |text| {
        text.parse().map_err(|why| input(format!("loss {text:?}: {why}")))
    })
}

impl Problem {
    fn block_id(&self, index: usize) -> PyResult<BlockId> {
        self.ids.get(index).copied().ok_or_else(|| {
            input(format!("block {index}: expected one of the {} blocks", self.ids.len()))
        })
    }

    /// Numbers of blocks from an array of shape (n,) or (n, arity): flat, and the arity.
    fn block_ids(&self, given: &Bound<'_, PyAny>) -> PyResult<(Vec<usize>, usize)> {
        let wrong = || {
            input("blocks: expected numbers of blocks with shape (n,) or (n, blocks per residual)")
        };
        let array = array::<i64>(given, "int64").ok_or_else(wrong)?;
        let arity = match *array.shape() {
            [_] => 1,
            [_, arity @ 1..=8] => arity,
            _ => return Err(wrong()),
        };
        let known = |&index: &i64| {
            let found = usize::try_from(index).ok().filter(|&index| index < self.ids.len());
            found.ok_or_else(|| {
                input(format!("block {index}: expected one of the {} blocks", self.ids.len()))
            })
        };
        Ok((array.as_array().iter().map(known).collect::<PyResult<_>>()?, arity))
    }

    /// Blocks of a batch whose blocks live in these spaces.
    fn blocks_in<const K: usize>(
        &self,
        what: &str,
        given: &Bound<'_, PyAny>,
        expected: [(&str, usize); K],
    ) -> PyResult<Vec<[BlockId; K]>> {
        let (flat, arity) = self.block_ids(given)?;
        let names = expected.map(|(name, _)| name).join(", ");
        if arity != K {
            return Err(input(format!("{what}: expected {K} blocks each ({names}), not {arity}")));
        }
        let (chunks, _) = flat.as_chunks::<K>();
        for chunk in chunks {
            for (index, (name, ambient)) in chunk.iter().zip(expected) {
                if self.spaces[*index].ambient() != ambient {
                    return Err(input(format!(
                        "{what}: block {index} is to be {name} with {ambient} numbers, it has {}",
                        self.spaces[*index].ambient()
                    )));
                }
            }
        }
        Ok(chunks.iter().map(|chunk| chunk.map(|index| self.ids[index])).collect())
    }

    fn checked(&self, outcome: Result<(), SolveError>) -> PyResult<()> {
        outcome.map_err(|error| from_solver(&error))
    }

    /// What Python raised in a residual comes first.
    fn failed(&self, error: &SolveError) -> PyErr {
        let raised = self.raised.lock().ok().and_then(|mut raised| raised.take());
        raised.unwrap_or_else(|| from_solver(error))
    }
}

fn same_length(what: &str, found: usize, expected: usize) -> PyResult<()> {
    if found == expected {
        return Ok(());
    }
    Err(input(format!(
        "{what} has {found} rows, expected one for each of the {expected} residuals"
    )))
}

#[pymethods]
impl Problem {
    #[new]
    fn new() -> Problem {
        let (ids, spaces, x) = (Vec::new(), Vec::new(), Vec::new());
        Problem { problem: nlls::Problem::new(), ids, spaces, x, raised: Raised::default() }
    }

    /// Adds one block per row of `values`; their numbers.
    fn add_blocks<'py>(
        &mut self,
        py: Python<'py>,
        name: &str,
        values: Vec<Vec<f64>>,
        manifold: &str,
    ) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let first = self.ids.len();
        for values in values {
            let space = Space::read(manifold, values.len())?;
            let made = match space {
                Space::Euclidean(n) => self.problem.block(name, Euclidean(n), &values),
                Space::Rotation => self.problem.block(name, Rotation, &values),
                Space::Pose => self.problem.block(name, Pose, &values),
                Space::UnitVector => self.problem.block(name, UnitVector, &values),
                Space::Similarity => self.problem.block(name, Similarity, &values),
            };
            self.ids.push(made.map_err(|error| from_solver(&error))?);
            self.spaces.push(space);
            self.x.extend(values);
        }
        Ok((first as i64..self.ids.len() as i64).collect::<Vec<_>>().into_pyarray(py))
    }

    /// Keeps blocks, or some entries of their tangents, as they are.
    #[pyo3(signature = (blocks, entries=None))]
    fn fix(&mut self, blocks: &Bound<'_, PyAny>, entries: Option<Vec<usize>>) -> PyResult<()> {
        for index in self.block_ids(blocks)?.0 {
            let id = self.ids[index];
            match &entries {
                None => self.problem.fix(id),
                Some(entries) => {
                    let outcome = self.problem.fix_entries(id, entries);
                    self.checked(outcome)?;
                }
            }
        }
        Ok(())
    }

    /// Lets blocks move again.
    fn free(&mut self, blocks: &Bound<'_, PyAny>) -> PyResult<()> {
        for index in self.block_ids(blocks)?.0 {
            self.problem.free(self.ids[index]);
        }
        Ok(())
    }

    /// Eliminates blocks first (points of a bundle).
    fn eliminate(&mut self, blocks: &Bound<'_, PyAny>) -> PyResult<()> {
        for index in self.block_ids(blocks)?.0 {
            self.problem.eliminate(self.ids[index]);
        }
        Ok(())
    }

    /// Adds residuals of a Python function.
    #[pyo3(signature = (name, blocks, residual, rows, data, loss=None, jacobian=None))]
    #[allow(clippy::too_many_arguments, reason = "keyword arguments of one Python function")]
    fn add(
        &mut self,
        name: &str,
        blocks: &Bound<'_, PyAny>,
        residual: Py<PyAny>,
        rows: usize,
        data: Vec<Py<PyAny>>,
        loss: Option<&str>,
        jacobian: Option<Py<PyAny>>,
    ) -> PyResult<()> {
        let (flat, arity) = self.block_ids(blocks)?;
        if flat.is_empty() {
            return Err(input(format!("{name}: expected the blocks of one residual or more")));
        }
        let spaces: Vec<Space> = flat.iter().take(arity).map(|&k| self.spaces[k]).collect();
        let same = |(at, &block): (usize, &usize)| {
            let expected = &spaces[at % arity];
            std::mem::discriminant(&self.spaces[block]) == std::mem::discriminant(expected)
                && self.spaces[block].ambient() == expected.ambient()
        };
        if let Some((at, _)) = flat.iter().enumerate().find(|&entry| !same(entry)) {
            return Err(input(format!(
                "{name}: residual {} has a block of another kind than residual 0",
                at / arity
            )));
        }
        for array in &data {
            let count = Python::attach(|py| array.bind(py).len())?;
            same_length("an array of data", count, flat.len() / arity)?;
        }
        let blocks = flat.iter().map(|&index| self.ids[index]).collect();
        let raised = Raised::clone(&self.raised);
        let batch = PythonBatch { blocks, spaces, rows, residual, jacobian, data, raised };
        let outcome = self.problem.add(name, self::loss(loss)?, batch);
        self.checked(outcome)
    }

    /// Adds image measurements: blocks pose, point, `[f, k1, k2]`.
    #[pyo3(signature = (name, blocks, image_px, sigma_px, loss=None))]
    fn add_reprojection(
        &mut self,
        name: &str,
        blocks: &Bound<'_, PyAny>,
        image_px: &Bound<'_, PyAny>,
        sigma_px: f64,
        loss: Option<&str>,
    ) -> PyResult<()> {
        let expected = [("a pose", 7), ("a point", 3), ("[f, k1, k2]", 3)];
        let blocks = self.blocks_in(name, blocks, expected)?;
        let measured = rows("image_px", 2, image_px)?;
        same_length("image_px", measured.len(), blocks.len())?;
        let of = |at: Vec<f64>| Reprojection { image_px: [at[0], at[1]], sigma_px };
        let batch = Residuals::new(blocks.into_iter().zip(measured.into_iter().map(of)));
        let outcome = self.problem.add(name, self::loss(loss)?, batch);
        self.checked(outcome)
    }

    /// Adds measured positions of cameras: block pose.
    #[pyo3(signature = (name, blocks, positions, sigma, loss=None))]
    fn add_camera_positions(
        &mut self,
        name: &str,
        blocks: &Bound<'_, PyAny>,
        positions: &Bound<'_, PyAny>,
        sigma: [f64; 3],
        loss: Option<&str>,
    ) -> PyResult<()> {
        let blocks = self.blocks_in(name, blocks, [("a pose", 7)])?;
        let measured = rows("positions", 3, positions)?;
        same_length("positions", measured.len(), blocks.len())?;
        let of = |p: Vec<f64>| CameraPosition { position: [p[0], p[1], p[2]], sigma };
        let batch = Residuals::new(blocks.into_iter().zip(measured.into_iter().map(of)));
        let outcome = self.problem.add(name, self::loss(loss)?, batch);
        self.checked(outcome)
    }

    /// Adds what is known of vectors beforehand.
    #[pyo3(signature = (name, blocks, values, sigma, loss=None))]
    fn add_prior(
        &mut self,
        name: &str,
        blocks: &Bound<'_, PyAny>,
        values: Vec<Vec<f64>>,
        sigma: Vec<f64>,
        loss: Option<&str>,
    ) -> PyResult<()> {
        let (flat, arity) = self.block_ids(blocks)?;
        if arity != 1 {
            return Err(input(format!("{name}: expected 1 block each, not {arity}")));
        }
        same_length("values", values.len(), flat.len())?;
        let mut factors = Vec::with_capacity(flat.len());
        for (index, values) in flat.into_iter().zip(values) {
            let Space::Euclidean(length) = self.spaces[index] else {
                return Err(input(format!("{name}: block {index}: expected a euclidean block")));
            };
            if values.len() != length || sigma.len() != length {
                return Err(input(format!(
                    "{name}: expected {length} values and sigmas for block {index}"
                )));
            }
            let prior = GaussianPrior::new(&self.problem, self.ids[index], &values, &sigma);
            factors.push(prior.map_err(|error| input(format!("{name}: {error}")))?);
        }
        let outcome = self.problem.add(name, self::loss(loss)?, Factors(factors));
        self.checked(outcome)
    }

    /// Runs the engine from where the blocks are; the summary.
    #[pyo3(signature = (max_iterations=100, options=None))]
    fn solve<'py>(
        &mut self,
        py: Python<'py>,
        max_iterations: u64,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let options = options::plain("solve", &nlls::Options::default(), options)?;
        if let Ok(mut raised) = self.raised.lock() {
            *raised = None;
        }
        let (problem, mut x) = (&self.problem, self.x.clone());
        let outcome =
            without_python(py, || nlls::solve(problem, &mut x, &options, max_iterations))?;
        let raised = self.raised.lock().ok().and_then(|mut raised| raised.take());
        if let Some(raised) = raised {
            return Err(raised);
        }
        let summary = outcome.map_err(|error| self.failed(&error))?;
        self.x = x;
        let out = result(py, &summary)?;
        out.set_item("converged", summary.stop.converged())?;
        out.set_item("text", summary.to_string())?;
        Ok(out)
    }

    /// The values of blocks of one size, one row each.
    fn values<'py>(
        &self,
        py: Python<'py>,
        blocks: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (flat, _) = self.block_ids(blocks)?;
        let width = flat.first().map_or(0, |&index| self.spaces[index].ambient());
        if flat.iter().any(|&index| self.spaces[index].ambient() != width) {
            return Err(input("blocks: expected blocks of one size"));
        }
        let all = flat.iter().flat_map(|&k| self.problem.values(&self.x, self.ids[k])).copied();
        crate::arrays::table(py, width, all.collect())
    }

    /// The covariance of the tangents of two blocks.
    #[pyo3(signature = (first, second=None))]
    fn covariance<'py>(
        &self,
        py: Python<'py>,
        first: usize,
        second: Option<usize>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (a, b) = (self.block_id(first)?, self.block_id(second.unwrap_or(first))?);
        let (problem, x) = (&self.problem, &self.x);
        let found = without_python(py, || {
            Ok(Covariance::new(problem, x, LinearSolver::Sparse)?.cross(a, b))
        })?;
        let found = found.map_err(|error: SolveError| self.failed(&error))?;
        crate::arrays::table(py, self.problem.dimension(b), found)
    }

    /// The cost `1/2 sum rho(|r|^2)` of each batch where the blocks are.
    fn costs(&self, py: Python<'_>) -> PyResult<Vec<f64>> {
        let (problem, x) = (&self.problem, &self.x);
        let found = without_python(py, || problem.costs(x))?;
        found.map_err(|error| self.failed(&error))
    }

    fn __repr__(&self) -> String {
        let (blocks, residuals) = (self.problem.block_count(), self.problem.residual_count());
        format!("<rowgram.Problem: {blocks} blocks, {residuals} residuals>")
    }
}

/// An `InternalError` unless a length fits.
pub(crate) fn count(length: usize) -> PyResult<u32> {
    u32::try_from(length).map_err(|_| exception("InputError", "more than can be counted"))
}
