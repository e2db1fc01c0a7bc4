//! A plan onto the rows that were found: see [`super`] for the equations.

use super::{AFFINE, BEND, FREE, Placement, bend, unmoved};
use rowgram_optim::{
    engine::SolveError,
    nlls::{
        self, BlockId, Euclidean, Factors, GaussianPrior, Infeasible, LinearSolver, Loss, Options,
        Problem, Residual, Residuals, Scalar, Vector, covariance::Covariance,
    },
};

/// A piece of a row that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowSample {
    /// `q` of its middle, metres.
    pub q: [f64; 2],
    /// Ends of the row of the plan that it belongs to, `(s, t)` in metres.
    pub row: [[f64; 2]; 2],
    /// Number of the row that it was found in: its `d`.
    pub found_row: usize,
    /// Number of the plot: its `w`.
    pub plot: usize,
    /// How many samples of the usual size it is worth.
    pub weight: f64,
}

/// The outermost plant of a row of a plot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EndSample {
    /// `q` of the plant, metres.
    pub q: [f64; 2],
    /// `s` of the end of the plot, metres.
    pub s: f64,
    /// Whether the plot begins there (else it ends).
    pub begins: bool,
    /// Number of the line of ends: its `f`.
    pub line: usize,
    /// Number of the plot: its `w`.
    pub plot: usize,
}

/// What was observed.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Observations {
    /// Pieces of rows.
    pub rows: Vec<RowSample>,
    /// Ends of rows.
    pub ends: Vec<EndSample>,
    /// How many rows were found.
    pub found_rows: usize,
    /// How many lines of ends there are.
    pub lines: usize,
    /// How many plots there are.
    pub plots: usize,
}

/// Standard deviations of what is known beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Priors {
    /// Of `u, v, theta, a, b, k` about the start.
    pub affine: [f64; AFFINE],
    /// Of each of the numbers of the bend, metres.
    pub bend_m: f64,
    /// Mean and standard deviation of `g`, metres.
    pub margin_m: [f64; 2],
    /// Of each coordinate of `w`, metres; plots do not move by themselves where not given.
    pub plot_shift_m: Option<f64>,
}

/// The four standard deviations that are estimated, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scatter {
    /// Of a sample about its row.
    pub sample_m: f64,
    /// Of a row about its place.
    pub row_m: f64,
    /// Of the outermost plant about the end of its row.
    pub end_m: f64,
    /// Of a line of ends.
    pub line_m: f64,
}

/// A plan on the rows.
#[derive(Debug, Clone, PartialEq)]
pub struct RowFit {
    /// Where it lies.
    pub placement: Placement,
    /// Covariance of the affine numbers and the bend, row-major.
    pub covariance: super::Covariance,
    /// `g`, metres.
    pub margin_m: f64,
    /// Standard deviation of `g`, metres.
    pub margin_sigma_m: f64,
    /// What was estimated of the scatter.
    pub scatter: Scatter,
    /// `w` of each plot, along and across, metres; empty where plots do not move by themselves.
    pub plot_shifts_m: Vec<[f64; 2]>,
    /// Residuals of the samples of rows, metres.
    pub row_residuals_m: Vec<f64>,
    /// Cost at the end.
    pub cost: f64,
}

/// Scale of the loss in standard deviations: 96 % efficient for normal errors.
const HUBER: f64 = 1.5;
/// Mean of the squares of standard normal residuals that are cut at [`HUBER`].
const CUT_SQUARES: f64 = 0.7785;
/// Rounds of scatter and parameters. The scatter changes by less than a hundredth in the last ones.
const ROUNDS: usize = 12;
/// Least standard deviation that the scatter comes to, metres: nothing is planted to less.
const LEAST_M: f64 = 1e-3;

struct AcrossRow {
    sample: RowSample,
    half_length_m: f64,
    sigma_m: f64,
}

impl Residual<1> for AcrossRow {
    type Blocks = (Vector<AFFINE>, Vector<BEND>, Vector<1>, Vector<2>);

    fn evaluate<T: Scalar>(
        &self,
        (affine, bend_m, row, plot): ([T; AFFINE], [T; BEND], [T; 1], [T; 2]),
    ) -> Result<[T; 1], Infeasible> {
        let [along, across] = unmoved(&affine, self.sample.q);
        let s = along / (affine[3] + 1.0);
        let [from, to] = self.sample.row;
        let slope = (to[1] - from[1]) / (to[0] - from[0]);
        let t = (s - from[0]) * slope + from[1];
        let at = (affine[4] + 1.0) * t + affine[5] * s;
        let bent = bend(&bend_m, s / self.half_length_m);
        Ok([(across - at - bent - (row[0] + plot[1])) / self.sigma_m])
    }
}

struct AtEnd {
    sample: EndSample,
    sigma_m: f64,
}

impl Residual<1> for AtEnd {
    type Blocks = (Vector<AFFINE>, Vector<1>, Vector<1>, Vector<2>);

    fn evaluate<T: Scalar>(
        &self,
        (affine, margin, line, plot): ([T; AFFINE], [T; 1], [T; 1], [T; 2]),
    ) -> Result<[T; 1], Infeasible> {
        let [along, _] = unmoved(&affine, self.sample.q);
        let margin = if self.sample.begins { margin[0] } else { -margin[0] };
        let place = (affine[3] + 1.0) * (margin + self.sample.s);
        Ok([(along - place - (line[0] + plot[0])) / self.sigma_m])
    }
}

/// The problem and its blocks.
struct Posed {
    problem: Problem,
    affine: BlockId,
    bend: BlockId,
    margin: BlockId,
    rows: Vec<BlockId>,
    lines: Vec<BlockId>,
    plots: Vec<BlockId>,
}

/// Names of the batches.
const ROWS: &str = "rows";
const ENDS: &str = "ends";

/// Shifts of blocks about 0, all with one standard deviation.
fn shifts(
    problem: &Problem,
    blocks: &[BlockId],
    sigma: f64,
) -> Result<Factors<GaussianPrior>, SolveError> {
    let of = |&block: &BlockId| {
        let n = problem.dimension(block);
        GaussianPrior::new(problem, block, &vec![0.0; n], &vec![sigma; n])
    };
    Ok(Factors(blocks.iter().map(of).collect::<Result<_, _>>()?))
}

fn pose(
    start: &Placement,
    seen: &Observations,
    priors: &Priors,
    scatter: &Scatter,
) -> Result<Posed, SolveError> {
    let mut problem = Problem::new();
    let affine = problem.block("placement", Euclidean(AFFINE), &start.affine)?;
    let bend = problem.block("bend", Euclidean(BEND), &start.bend_m)?;
    let margin = problem.block("margin", Euclidean(1), &priors.margin_m[..1])?;
    let mut blocks = |kind: &str, count: usize, size: usize| {
        let zero = [0.0; 2];
        let of = |_| problem.block(kind, Euclidean(size), &zero[..size]);
        (0..count).map(of).collect::<Result<Vec<_>, _>>()
    };
    let rows = blocks("row", seen.found_rows, 1)?;
    let lines = blocks("line of ends", seen.lines, 1)?;
    // One that stays where it is stands for plots that do not move by themselves.
    let moves = priors.plot_shift_m.is_some();
    let plots = blocks("plot", if moves { seen.plots } else { 1 }, 2)?;
    let plot_of = |plot: usize| plots[if moves { plot } else { 0 }];
    for &plot in &plots {
        match moves {
            true => problem.eliminate(plot),
            false => problem.fix(plot),
        }
    }
    let known = |block, mean: &[f64], sigma: &[f64]| {
        Ok::<_, SolveError>(Factors(vec![GaussianPrior::new(&problem, block, mean, sigma)?]))
    };
    let placement = known(affine, &start.affine, &priors.affine)?;
    let [mean, sigma] = priors.margin_m;
    let margins = known(margin, &[mean], &[sigma])?;
    problem.add("placement", Loss::Trivial, placement)?;
    let bends = shifts(&problem, &[bend], priors.bend_m)?;
    problem.add("bend", Loss::Trivial, bends)?;
    problem.add("margin", Loss::Trivial, margins)?;
    if !rows.is_empty() {
        let offsets = shifts(&problem, &rows, scatter.row_m)?;
        problem.add("row offsets", Loss::Trivial, offsets)?;
    }
    if !lines.is_empty() {
        let offsets = shifts(&problem, &lines, scatter.line_m)?;
        problem.add("line offsets", Loss::Trivial, offsets)?;
    }
    if let Some(sigma_m) = priors.plot_shift_m.filter(|_| !plots.is_empty()) {
        let own = shifts(&problem, &plots, sigma_m)?;
        problem.add("plot shifts", Loss::Trivial, own)?;
    }
    let across = |sample: &RowSample| AcrossRow {
        sample: *sample,
        half_length_m: start.half_length_m,
        sigma_m: scatter.sample_m / sample.weight.sqrt(),
    };
    let at_end = |sample: &EndSample| AtEnd { sample: *sample, sigma_m: scatter.end_m };
    let loss = Loss::Huber(HUBER);
    if !seen.rows.is_empty() {
        let of = |sample: &RowSample| {
            let blocks = [affine, bend, rows[sample.found_row], plot_of(sample.plot)];
            (blocks, across(sample))
        };
        problem.add(ROWS, loss, Residuals::new(seen.rows.iter().map(of)))?;
    }
    if !seen.ends.is_empty() {
        let of = |sample: &EndSample| {
            let blocks = [affine, margin, lines[sample.line], plot_of(sample.plot)];
            (blocks, at_end(sample))
        };
        problem.add(ENDS, loss, Residuals::new(seen.ends.iter().map(of)))?;
    }
    Ok(Posed { problem, affine, bend, margin, rows, lines, plots })
}

/// Huber's proposal 2: the scale at which residuals that are cut have the mean square of normal ones.
fn scale(residuals: &[f64], sigma_m: f64, parameters: f64) -> f64 {
    let freedom = residuals.len() as f64 - parameters;
    if freedom < 1.0 {
        return sigma_m;
    }
    // Residuals come in the standard deviation of the round before.
    let cut: f64 = residuals.iter().map(|r| r.abs().min(HUBER).powi(2)).sum();
    (sigma_m * (cut / (CUT_SQUARES * freedom)).sqrt()).max(LEAST_M)
}

/// The variance of a group of offsets, and how many parameters they are worth.
fn of_group(values: &[f64], variances: &[f64], sigma_m: f64) -> (f64, f64) {
    let count = values.len() as f64;
    if values.is_empty() {
        return (sigma_m, 0.0);
    }
    let squares: f64 = values.iter().zip(variances).map(|(x, var)| x * x + var).sum();
    let worth: f64 = variances.iter().map(|var| (1.0 - var / (sigma_m * sigma_m)).max(0.0)).sum();
    ((squares / count).sqrt().max(LEAST_M), worth)
}

/// Fits a plan to the rows that were found, from a placement in which each of them is at its own row of the plan. The
/// priors are about `about`.
///
/// # Errors
/// Values that are not finite.
pub fn fit(
    about: &Placement,
    start: &Placement,
    seen: &Observations,
    priors: &Priors,
    first: &Scatter,
) -> Result<RowFit, SolveError> {
    // Plots meet only through the placement, rows and lines, which are few.
    let linear = match priors.plot_shift_m {
        Some(_) => LinearSolver::Schur,
        None => LinearSolver::Dense,
    };
    let options = Options { linear, ..Options::default() };
    let mut scatter = *first;
    let mut x: Vec<f64> = Vec::new();
    let mut round = 0;
    loop {
        let Posed { problem, affine, bend, margin, rows, lines, plots } =
            pose(about, seen, priors, &scatter)?;
        if x.is_empty() {
            x = problem.start();
            x[..AFFINE].copy_from_slice(&start.affine);
            x[AFFINE..FREE].copy_from_slice(&start.bend_m);
        }
        let summary = nlls::solve(&problem, &mut x, &options, 100)?;
        let mut covariance = Covariance::new(&problem, &x, linear)?;
        let residuals_of = |name: &str, is_there: bool| match is_there {
            true => problem.residuals(&x, name),
            false => Ok(Vec::new()),
        };
        let of_rows = residuals_of(ROWS, !seen.rows.is_empty())?;
        let of_ends = residuals_of(ENDS, !seen.ends.is_empty())?;
        round += 1;
        if round < ROUNDS {
            let first = FREE + 1;
            let mut variance = |blocks: &[BlockId]| -> Vec<f64> {
                blocks.iter().map(|&block| covariance.block(block)[0]).collect()
            };
            let (of_row, of_line) = (variance(&rows), variance(&lines));
            let (row_m, row_worth) =
                of_group(&x[first..first + rows.len()], &of_row, scatter.row_m);
            let at = first + rows.len();
            let (line_m, line_worth) = of_group(&x[at..at + lines.len()], &of_line, scatter.line_m);
            scatter = Scatter {
                // Shift, rotation, stretch, shear and bend across; shift, stretch and margin along.
                sample_m: scale(&of_rows, scatter.sample_m, row_worth + 7.0),
                row_m,
                end_m: scale(&of_ends, scatter.end_m, line_worth + 3.0),
                line_m,
            };
            continue;
        }
        let mut placement = *about;
        placement.affine.copy_from_slice(&x[..AFFINE]);
        placement.bend_m.copy_from_slice(&x[AFFINE..FREE]);
        let mut joint = [[0.0; FREE]; FREE];
        for (first, row) in [(affine, 0), (bend, AFFINE)] {
            for (second, column) in [(affine, 0), (bend, AFFINE)] {
                let width = if column == 0 { AFFINE } else { BEND };
                let block = covariance.cross(first, second);
                for (k, value) in block.into_iter().enumerate() {
                    joint[row + k / width][column + k % width] = value;
                }
            }
        }
        let margin_sigma_m = covariance.block(margin)[0].sqrt();
        let shifts = match priors.plot_shift_m {
            Some(_) => &x[x.len() - 2 * plots.len()..],
            None => &[],
        };
        let sigma_of = |sample: &RowSample| scatter.sample_m / sample.weight.sqrt();
        return Ok(RowFit {
            placement,
            covariance: joint,
            margin_m: x[FREE],
            margin_sigma_m,
            scatter,
            plot_shifts_m: shifts.chunks_exact(2).map(|w| [w[0], w[1]]).collect(),
            row_residuals_m: of_rows
                .iter()
                .zip(&seen.rows)
                .map(|(r, sample)| r * sigma_of(sample))
                .collect(),
            cost: summary.final_cost,
        });
    }
}
