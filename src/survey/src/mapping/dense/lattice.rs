//! Heights on a square lattice that follow data and bend little.
//!
//! ```text
//! minimise  sum_i w_i (z_i - d_i)^2 + sum_k lambda_k sum (second differences of z along direction k)^2
//! ```
//!
//! Conjugate gradients, preconditioned on lattices of twice, four times, ... the distance of nodes:
//!
//! ```text
//! M^-1 = sum_l P_l D_l^-1 P_l^T + P_L A_L^+ P_L^T
//! ```
//!
//! `P_l` prolongs values of lattice `l` to the finest one, linear between nodes at each step, which in the limit gives quadratic splines: smooth
//! enough for second differences. `D_l` is the diagonal of `A_l = P_l^T A P_l`, with `A` the matrix of the normal equations and `L` the coarsest
//! lattice. The number of iterations then hardly depends on the number of nodes or on how far they are from data (J. H. Bramble,
//! J. E. Pasciak, J. Xu, *Parallel multilevel preconditioners*, Mathematics of Computation 1990).

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Nodes of the coarsest lattice in a direction, at most: its equations, 16 at most, are solved directly.
const FEW_NODES: usize = 4;
/// The error that counts as none, in the norm that is minimised and relative to the data. By arithmetic, a wood of 100 m by 30 m whose ground
/// hangs on the smallest weights is right within a centimetre then.
const SOLVED: f64 = 1e-7;
/// Iterations, at most. The tests of this file need fewer than 120.
const MAX_ITERATIONS: usize = 1000;
/// Eigenvalues of the coarsest equations below this, relative to the largest, belong to what no data determine: rounding leaves them at
/// about 1e-16.
const SINGULAR: f64 = 1e-12;

/// Data of a lattice, row by row.
pub(super) struct Lattice {
    /// Columns and rows.
    pub(super) size: [usize; 2],
    /// What nodes should be.
    pub(super) data: Vec<f64>,
    /// How much each counts.
    pub(super) weight: Vec<f64>,
    /// Of the second differences along rows (from column to column) and along columns.
    pub(super) stiffness: [f64; 2],
}

/// What `Lattice::solve` found.
pub(super) struct Solution {
    /// Value of each node.
    pub(super) value: Vec<f64>,
    /// How many iterations that took.
    #[cfg(test)]
    iterations: usize,
}

impl Lattice {
    /// The least sum, from `start`, or from 0 where that is empty.
    pub(super) fn solve(&self, start: Vec<f64>) -> Solution {
        // On a thread of the pool: from any other, each of many short loops would wait until one wakes.
        rayon::scope(|_| self.iterate(start))
    }

    fn iterate(&self, start: Vec<f64>) -> Solution {
        let nodes = self.weight.len();
        let mut value = if start.is_empty() { vec![0.0; nodes] } else { start };
        let right_side: Vec<f64> = self.data.iter().zip(&self.weight).map(|(d, w)| d * w).collect();
        let mut levels = Levels::new(Equations {
            size: self.size,
            weight: self.weight.clone(),
            stiffness: self.stiffness,
        });
        let (mut image, mut scaled) = (vec![0.0; nodes], vec![0.0; nodes]);
        levels.precondition(&right_side, &mut scaled);
        let enough = self.dot(&right_side, &scaled) * SOLVED * SOLVED;
        levels.finest.apply(&value, &mut image);
        let mut residual: Vec<f64> = right_side.iter().zip(&image).map(|(p, i)| p - i).collect();
        levels.precondition(&residual, &mut scaled);
        let mut direction = scaled.clone();
        let mut size = self.dot(&residual, &scaled);
        let mut iterations = 0;
        while size > enough && iterations < MAX_ITERATIONS {
            levels.finest.apply(&direction, &mut image);
            let along = self.dot(&direction, &image);
            if along <= 0.0 {
                break;
            }
            let step = size / along;
            value.iter_mut().zip(&direction).for_each(|(z, d)| *z += step * d);
            residual.iter_mut().zip(&image).for_each(|(r, i)| *r -= step * i);
            levels.precondition(&residual, &mut scaled);
            let next = self.dot(&residual, &scaled);
            let ratio = next / size;
            direction.iter_mut().zip(&scaled).for_each(|(d, s)| *d = s + ratio * *d);
            size = next;
            iterations += 1;
        }
        Solution {
            value,
            #[cfg(test)]
            iterations,
        }
    }

    /// Row by row, so that the sum does not depend on the number of threads.
    fn dot(&self, a: &[f64], b: &[f64]) -> f64 {
        let width = self.size[0];
        let of = |(a, b): (&[f64], &[f64])| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let rows: Vec<f64> = a.par_chunks(width).zip(b.par_chunks(width)).map(of).collect();
        rows.iter().sum()
    }
}

/// The left-hand side of the normal equations of a lattice.
struct Equations {
    size: [usize; 2],
    weight: Vec<f64>,
    stiffness: [f64; 2],
}

/// Share of the second differences of `n` values in the equation of value `k`: weights of the values `k - 2` to `k + 2`.
fn bending(k: usize, n: usize) -> [f64; 5] {
    let mut out = [0.0; 5];
    for middle in k.saturating_sub(1).max(1)..(k + 2).min(n.saturating_sub(1)) {
        let own = if middle == k { -2.0 } else { 1.0 };
        for (other, factor) in [(middle - 1, 1.0), (middle, -2.0), (middle + 1, 1.0)] {
            out[other + 2 - k] += own * factor;
        }
    }
    out
}

impl Equations {
    fn apply(&self, z: &[f64], out: &mut [f64]) {
        let [width, height] = self.size;
        let across: Vec<[f64; 5]> =
            (0..width).map(|k| bending(k, width).map(|b| b * self.stiffness[0])).collect();
        out.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
            let start = row * width;
            let line = &z[start..start + width];
            let weight = &self.weight[start..start + width];
            for (column, out) in out.iter_mut().enumerate() {
                *out = weight[column] * line[column];
            }
            for (column, out) in out.iter_mut().enumerate() {
                let (low, high) = (column.saturating_sub(2), (column + 3).min(width));
                let factors = &across[column][low + 2 - column..high + 2 - column];
                *out += line[low..high].iter().zip(factors).map(|(z, f)| z * f).sum::<f64>();
            }
            for (k, factor) in bending(row, height).into_iter().enumerate() {
                if factor != 0.0 {
                    let factor = factor * self.stiffness[1];
                    let from = (row + k - 2) * width;
                    let other = &z[from..from + width];
                    out.iter_mut().zip(other).for_each(|(out, z)| *out += factor * z);
                }
            }
        });
    }

    /// The diagonal of the equations of a coarser lattice, whose nodes spread over those of this one as `bases` says.
    fn diagonal(&self, bases: &[Basis; 2]) -> Vec<f64> {
        let [x, y] = bases;
        let mut between = vec![0.0; x.nodes * self.size[1]];
        between.par_chunks_mut(x.nodes).zip(self.weight.par_chunks(self.size[0])).for_each(
            |(out, weight)| {
                for (shares, w) in x.shares.iter().zip(weight) {
                    shares.iter().for_each(|&(to, share)| out[to] += share * share * w);
                }
            },
        );
        let mut out = vec![0.0; x.nodes * y.nodes];
        for (shares, line) in y.shares.iter().zip(between.chunks(x.nodes)) {
            for &(to, share) in shares {
                let out = &mut out[to * x.nodes..(to + 1) * x.nodes];
                out.iter_mut().zip(line).for_each(|(out, w)| *out += share * share * w);
            }
        }
        let [across, down] = bases.each_ref().map(Basis::bending_energies);
        let [wide, high] = bases.each_ref().map(Basis::squared_norms);
        for (at, out) in out.iter_mut().enumerate() {
            let (column, row) = (at % x.nodes, at / x.nodes);
            *out += self.stiffness[0] * across[column] * high[row]
                + self.stiffness[1] * wide[column] * down[row];
        }
        out
    }
}

/// The basis functions of a coarser line: how its nodes spread over those of the finest.
struct Basis {
    /// Coarse nodes.
    nodes: usize,
    /// Of each fine node: coarse nodes and how much of its value is theirs.
    shares: Vec<Vec<(usize, f64)>>,
}

impl Basis {
    /// The finest line itself.
    fn finest(nodes: usize) -> Basis {
        Basis { nodes, shares: (0..nodes).map(|k| vec![(k, 1.0)]).collect() }
    }

    /// That of half the nodes.
    fn coarser(&self, interpolation: &Interpolation) -> Basis {
        let of = |shares: &Vec<(usize, f64)>| {
            let mut out: Vec<(usize, f64)> = vec![];
            for &(k, share) in shares {
                for (to, part) in interpolation.of(k) {
                    match out.iter_mut().find(|(node, _)| *node == to) {
                        Some((_, sum)) => *sum += share * part,
                        None => out.push((to, share * part)),
                    }
                }
            }
            out
        };
        Basis { nodes: interpolation.coarse, shares: self.shares.iter().map(of).collect() }
    }

    /// The sum of squares of each basis function.
    fn squared_norms(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.nodes];
        self.shares.iter().flatten().for_each(|&(to, share)| out[to] += share * share);
        out
    }

    /// The sum of squares of its second differences.
    fn bending_energies(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.nodes];
        for three in self.shares.windows(3) {
            let nodes = three.iter().flatten().map(|&(to, _)| to);
            let (low, high) = (nodes.clone().min().unwrap_or(0), nodes.max().unwrap_or(0));
            for (node, out) in out.iter_mut().enumerate().take(high + 1).skip(low) {
                let share = |k: usize| {
                    three[k].iter().find(|(to, _)| *to == node).map_or(0.0, |&(_, share)| share)
                };
                *out += (share(0) - 2.0 * share(1) + share(2)).powi(2);
            }
        }
        out
    }
}

/// Linear interpolation from half as many nodes of a line: the places of its nodes among these.
struct Interpolation {
    fine: usize,
    coarse: usize,
    /// The nearer end of the pair of coarse nodes, and how far between them (beyond them at the ends of the line).
    at: Vec<(usize, f64)>,
}

impl Interpolation {
    fn new(fine: usize) -> Interpolation {
        if fine <= FEW_NODES {
            return Interpolation { fine, coarse: fine, at: (0..fine).map(|k| (k, 0.0)).collect() };
        }
        let coarse = fine.div_ceil(2);
        let of = |k: usize| {
            let at = 0.5 * k as f64 - 0.25;
            let low = (at.max(0.0) as usize).min(coarse - 2);
            (low, at - low as f64)
        };
        Interpolation { fine, coarse, at: (0..fine).map(of).collect() }
    }

    /// The coarse nodes of a fine one and their shares.
    fn of(&self, k: usize) -> impl Iterator<Item = (usize, f64)> + use<> {
        let (low, t) = self.at[k];
        [(low, 1.0 - t), (low + 1, t)].into_iter().filter(|(_, share)| *share != 0.0)
    }
}

struct Level {
    interpolation: [Interpolation; 2],
    inverse_diagonal: Vec<f64>,
    /// Of the coarse nodes: what is carried to them, and what comes back.
    residual: Vec<f64>,
    value: Vec<f64>,
    /// Coarse in one direction, row by row.
    between: Vec<f64>,
}

struct Levels {
    finest: Equations,
    inverse_diagonal: Vec<f64>,
    levels: Vec<Level>,
    /// The inverse of the equations of the coarsest lattice; what no data determine is left alone.
    last: DMatrix<f64>,
}

fn inverses(diagonal: Vec<f64>) -> Vec<f64> {
    diagonal.into_iter().map(|d| if d > 0.0 { 1.0 / d } else { 0.0 }).collect()
}

impl Levels {
    fn new(finest: Equations) -> Levels {
        let mut size = finest.size;
        let mut bases = size.map(Basis::finest);
        let inverse_diagonal = inverses(finest.diagonal(&bases));
        let mut levels = vec![];
        while size.iter().any(|&n| n > FEW_NODES) {
            let interpolation = size.map(Interpolation::new);
            bases = [0, 1].map(|k| bases[k].coarser(&interpolation[k]));
            let between = vec![0.0; interpolation[0].coarse * size[1]];
            size = [0, 1].map(|k| interpolation[k].coarse);
            let nodes = vec![0.0; size[0] * size[1]];
            levels.push(Level {
                interpolation,
                inverse_diagonal: inverses(finest.diagonal(&bases)),
                residual: nodes.clone(),
                value: nodes,
                between,
            });
        }
        let mut out = Levels { finest, inverse_diagonal, levels, last: DMatrix::zeros(0, 0) };
        out.last = pseudo_inverse(out.coarsest(size[0] * size[1]));
        out
    }

    /// The equations of the coarsest lattice, of `nodes` nodes.
    fn coarsest(&mut self, nodes: usize) -> DMatrix<f64> {
        let mut matrix = DMatrix::zeros(nodes, nodes);
        let all = self.finest.weight.len();
        let (mut value, mut image) = (vec![0.0; all], vec![0.0; all]);
        for node in 0..nodes {
            let unit: Vec<f64> = (0..nodes).map(|k| f64::from(u8::from(k == node))).collect();
            value.fill(0.0);
            self.levels.iter_mut().for_each(|level| level.value.fill(0.0));
            match self.levels.last_mut() {
                Some(level) => level.value.copy_from_slice(&unit),
                None => value.copy_from_slice(&unit),
            }
            self.prolong_all(&mut value, |_| {});
            self.finest.apply(&value, &mut image);
            self.restrict_all(&image);
            let column = self.levels.last().map_or(&image, |level| &level.residual);
            matrix.set_column(node, &DVector::from_column_slice(column));
        }
        matrix
    }

    /// Restricts a residual of the finest lattice to all others.
    fn restrict_all(&mut self, residual: &[f64]) {
        for k in 0..self.levels.len() {
            let (before, rest) = self.levels.split_at_mut(k);
            rest[0].restrict(before.last().map_or(residual, |level| &level.residual));
        }
    }

    /// Adds the values of the coarsest lattice to those of the next, which `prepare` has set before, and so on to `out`, of the finest.
    fn prolong_all(&mut self, out: &mut [f64], prepare: impl Fn(&mut Level)) {
        for k in (0..self.levels.len()).rev() {
            let (before, rest) = self.levels.split_at_mut(k);
            match before.last_mut() {
                Some(finer) => {
                    prepare(finer);
                    rest[0].prolong(&mut finer.value);
                }
                None => rest[0].prolong(out),
            }
        }
    }

    fn precondition(&mut self, residual: &[f64], out: &mut [f64]) {
        scale(&self.inverse_diagonal, residual, out);
        self.restrict_all(residual);
        let right = self.levels.last().map_or(residual, |level| &level.residual);
        let coarsest = &self.last * DVector::from_column_slice(right);
        match self.levels.last_mut() {
            Some(level) => level.value.copy_from_slice(coarsest.as_slice()),
            None => out.copy_from_slice(coarsest.as_slice()),
        }
        self.prolong_all(out, |level| {
            scale(&level.inverse_diagonal, &level.residual, &mut level.value)
        });
    }
}

fn pseudo_inverse(matrix: DMatrix<f64>) -> DMatrix<f64> {
    let eigen = matrix.symmetric_eigen();
    let largest = eigen.eigenvalues.amax();
    let inverse = eigen.eigenvalues.map(|v| if v > SINGULAR * largest { 1.0 / v } else { 0.0 });
    &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}

fn scale(factor: &[f64], values: &[f64], out: &mut [f64]) {
    out.iter_mut().zip(factor).zip(values).for_each(|((out, f), v)| *out = f * v);
}

impl Level {
    /// Restricts the residual of the finer lattice to this one: the transpose of `prolong`.
    fn restrict(&mut self, fine: &[f64]) {
        let [x, y] = &self.interpolation;
        self.between.par_chunks_mut(x.coarse).zip(fine.par_chunks(x.fine)).for_each(
            |(out, fine)| {
                out.fill(0.0);
                for (&(low, t), value) in x.at.iter().zip(fine) {
                    out[low] += (1.0 - t) * value;
                    if t != 0.0 {
                        out[low + 1] += t * value;
                    }
                }
            },
        );
        let between = &self.between;
        self.residual.par_chunks_mut(x.coarse).enumerate().for_each(|(row, out)| {
            out.fill(0.0);
            let near = (2 * row).saturating_sub(4)..(2 * row + 6).min(y.fine);
            let near = if y.coarse < y.fine { near } else { row..row + 1 };
            for from in near {
                let (low, t) = y.at[from];
                let factor = match row.checked_sub(low) {
                    Some(0) => 1.0 - t,
                    Some(1) => t,
                    _ => continue,
                };
                let line = &between[from * x.coarse..(from + 1) * x.coarse];
                out.iter_mut().zip(line).for_each(|(out, v)| *out += factor * v);
            }
        });
    }

    /// Adds the values, interpolated, to those of the finer lattice.
    fn prolong(&mut self, fine: &mut [f64]) {
        let [x, y] = &self.interpolation;
        let value = &self.value;
        self.between.par_chunks_mut(x.coarse).enumerate().for_each(|(row, out)| {
            let (low, t) = y.at[row];
            let next = if t == 0.0 { low } else { low + 1 };
            let line = |row: usize| &value[row * x.coarse..(row + 1) * x.coarse];
            for (out, (a, b)) in out.iter_mut().zip(line(low).iter().zip(line(next))) {
                *out = (1.0 - t) * a + t * b;
            }
        });
        fine.par_chunks_mut(x.fine).zip(self.between.par_chunks(x.coarse)).for_each(
            |(fine, line)| {
                for (out, &(low, t)) in fine.iter_mut().zip(&x.at) {
                    let next = if t == 0.0 { low } else { low + 1 };
                    *out += (1.0 - t) * line[low] + t * line[next];
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data of weight 1 in one corner, of a ten thousandth in some of the rest, a millionth elsewhere.
    fn corner(size: [usize; 2]) -> Lattice {
        let (mut data, mut weight) = (vec![], vec![]);
        for row in 0..size[1] {
            for column in 0..size[0] {
                let (x, y) = (column as f64 / 10.0, row as f64 / 10.0);
                data.push((x / 3.0).sin() + 0.1 * y);
                let near = 5 * column < size[0] && 5 * row < size[1];
                weight.push(match (near, (column * 7 + row * 3) % 11) {
                    (true, _) => 1.0,
                    (_, 0) => 1e-4,
                    _ => 1e-6,
                });
            }
        }
        Lattice { size, data, weight, stiffness: [0.02; 2] }
    }

    #[test]
    fn the_solution_is_that_of_the_dense_equations() {
        for size in [[23, 17], [40, 3], [2, 30], [1, 9], [4, 4]] {
            let lattice = corner(size);
            let n = lattice.weight.len();
            let mut matrix = DMatrix::from_diagonal(&DVector::from_column_slice(&lattice.weight));
            let mut bend = |nodes: [usize; 3], stiffness: f64| {
                for (i, a) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                    for (j, b) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                        matrix[(nodes[i], nodes[j])] += stiffness * a * b;
                    }
                }
            };
            for at in 0..n {
                if at % size[0] >= 2 {
                    bend([at - 2, at - 1, at], 0.02);
                }
                if at >= 2 * size[0] {
                    bend([at - 2 * size[0], at - size[0], at], 0.02);
                }
            }
            let right_side = (0..n).map(|k| lattice.weight[k] * lattice.data[k]);
            let truth = matrix.cholesky().unwrap().solve(&DVector::from_iterator(n, right_side));
            let found = lattice.solve(vec![]);
            for k in 0..n {
                let off = (found.value[k] - truth[k]).abs();
                assert!(off < 1e-4, "{size:?} node {k}: off by {off}");
            }
        }
    }

    #[test]
    fn the_number_of_iterations_does_not_grow_with_the_lattice() {
        let iterations =
            [[40, 30], [160, 120], [640, 480]].map(|size| corner(size).solve(vec![]).iterations);
        assert!(iterations.iter().all(|&n| n < 120), "{iterations:?}");
    }

    #[test]
    fn where_nothing_is_known_planes_go_on() {
        let size = [50, 40];
        let of = |at: usize| 3.0 + 0.2 * (at % 50) as f64 - 0.1 * (at / 50) as f64;
        let known = |at: usize| at % 50 < 8 && at / 50 < 8;
        let weight = (0..2000).map(|at| f64::from(u8::from(known(at)))).collect();
        let lattice =
            Lattice { size, data: (0..2000).map(of).collect(), weight, stiffness: [0.02; 2] };
        let found = lattice.solve(vec![]).value;
        for at in 0..2000 {
            assert!((found[at] - of(at)).abs() < 1e-3, "node {at}: {}", found[at] - of(at));
        }
    }
}
