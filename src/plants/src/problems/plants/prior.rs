//! What a prior of the plants' places is, and the built-in ones: none, rows, or a grid of rows and columns.

use super::{
    lines::{Axes, Family},
    options::{Form, Model, Prior},
    quadratic::Quadratic,
};
use rowgram_optim::engine::SolveError;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::fmt::Debug;

/// What is known of the plants' places before the pixels are seen: a density of the positions given some latent variables (lines, a
/// lattice), which are fitted with the plants.
///
/// The set is open: a planting of your own is one more type with this trait
/// ([`Plants::with_prior`](super::Plants::with_prior)). In the joint form every method that changes the latent variables lowers
/// the prior's part of the objective or leaves it as it is, at the positions given; then no sweep of the descent raises the
/// objective.
pub trait PlantPrior: Clone + Debug + Send + Sync {
    /// What is fitted with the plants; part of the iterate and of its checkpoints.
    type Latent: Clone + Debug + Send + Serialize + DeserializeOwned;

    /// Whether the latent variables belong to so many plants and are usable numbers.
    fn is_sound(&self, latent: &Self::Latent, plants: usize) -> bool;

    /// Adds the prior of the plant at `at_px`, as a function of its offset from there, to `quadratic`.
    fn add_to(
        &self,
        latent: &Self::Latent,
        plant: usize,
        at_px: [f64; 2],
        quadratic: &mut Quadratic,
    );

    /// Adds the prior's part of the objective to `cost`.
    fn add_cost(&self, latent: &Self::Latent, positions_px: &[[f64; 2]], cost: &mut f64);

    /// Fits the latent variables to the plants.
    fn refit(&self, latent: &mut Self::Latent, positions_px: &[[f64; 2]]);

    /// Whether plants and latent variables have one joint objective.
    fn is_joint(&self) -> bool {
        true
    }

    /// Whether it says nothing of any plant.
    fn is_flat(&self) -> bool {
        false
    }

    /// Named numbers for the trace, always the same names in the same order.
    fn metrics(&self, _latent: &Self::Latent) -> Vec<(&'static str, f64)> {
        Vec::new()
    }
}

/// The built-in priors ([`Prior`]): nothing, rows, or rows and columns, in the forms of [`super::lines`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePrior {
    prior: Prior,
    form: Form,
    floor_px: f64,
    axes: Axes,
}

/// The lines that hold the plants.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Lines {
    /// The rows.
    pub rows: Family,
    /// The columns.
    pub columns: Family,
}

impl LinePrior {
    /// The prior that a model asks for, along these axes.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] for axes that are not finite.
    pub fn new(model: &Model, axes: Axes) -> Result<LinePrior, SolveError> {
        if ![axes.origin_px[0], axes.origin_px[1], axes.heading_rad].iter().all(|x| x.is_finite()) {
            return Err(SolveError::Misuse("the axes are not finite".to_owned()));
        }
        Ok(LinePrior { prior: model.prior, form: model.form, floor_px: model.floor_px, axes })
    }

    /// The axes along the rows.
    pub fn axes(&self) -> &Axes {
        &self.axes
    }

    /// Lines to start from: offsets across of the rows and along of the columns (those that the prior does not ask for are
    /// ignored).
    ///
    /// # Errors
    /// [`SolveError::Misuse`] where the prior asks for lines and none are given.
    pub fn lines(
        &self,
        positions_px: &[[f64; 2]],
        rows_px: &[f64],
        columns_px: &[f64],
    ) -> Result<Lines, SolveError> {
        let (rows_px, columns_px) = match self.prior {
            Prior::None => (&[][..], &[][..]),
            Prior::Rows => (rows_px, &[][..]),
            Prior::Grid => (rows_px, columns_px),
        };
        if (self.prior != Prior::None && rows_px.is_empty())
            || (self.prior == Prior::Grid && columns_px.is_empty())
        {
            return Err(SolveError::Misuse("the prior needs rows, and there are none".to_owned()));
        }
        let floor_px2 = self.floor_px * self.floor_px;
        let family = |offsets: &[f64], exchanged| {
            // A wide start: the descent narrows it.
            let gaps =
                offsets.windows(2).map(|w| (w[1] - w[0]).abs()).fold(f64::INFINITY, f64::min);
            let start_px = if gaps.is_finite() { gaps / 10.0 } else { 10.0 * self.floor_px };
            let variance_px2 = (start_px * start_px).max(floor_px2);
            Family::new(offsets, exchanged, variance_px2, floor_px2, positions_px, &self.axes)
        };
        Ok(Lines { rows: family(rows_px, false), columns: family(columns_px, true) })
    }

    /// Which plant belongs to which line, after plants have changed places.
    pub(super) fn reassign(&self, latent: &mut Lines, positions_px: &[[f64; 2]]) {
        for family in [&mut latent.rows, &mut latent.columns] {
            family.refit_members(positions_px, &self.axes);
            family.gather(positions_px, &self.axes);
        }
    }

    pub(super) fn refit_lines(&self, latent: &mut Lines) {
        latent.rows.refit_lines();
        latent.columns.refit_lines();
    }

    pub(super) fn refit_variances(&self, latent: &mut Lines) {
        latent.rows.refit_variances();
        latent.columns.refit_variances();
    }
}

impl PlantPrior for LinePrior {
    type Latent = Lines;

    fn is_sound(&self, latent: &Lines, plants: usize) -> bool {
        let sound = |family: &Family, wanted: bool| {
            family.lines.is_empty() != wanted && family.is_sound(plants)
        };
        sound(&latent.rows, self.prior != Prior::None)
            && sound(&latent.columns, self.prior == Prior::Grid)
    }

    fn add_to(&self, latent: &Lines, plant: usize, at_px: [f64; 2], quadratic: &mut Quadratic) {
        for family in [&latent.rows, &latent.columns] {
            family.add_to(quadratic, plant, at_px, &self.axes, self.is_joint_form());
        }
    }

    fn add_cost(&self, latent: &Lines, positions_px: &[[f64; 2]], cost: &mut f64) {
        for family in [&latent.rows, &latent.columns] {
            *cost += family.cost(positions_px, &self.axes, self.is_joint_form());
        }
    }

    fn refit(&self, latent: &mut Lines, positions_px: &[[f64; 2]]) {
        self.reassign(latent, positions_px);
        self.refit_lines(latent);
        self.refit_variances(latent);
    }

    fn is_joint(&self) -> bool {
        self.is_joint_form() || self.is_flat()
    }

    fn is_flat(&self) -> bool {
        self.prior == Prior::None
    }

    fn metrics(&self, latent: &Lines) -> Vec<(&'static str, f64)> {
        let across: Vec<f64> = latent.rows.lines.iter().map(|line| line.variance_px2).collect();
        let mean = across.iter().sum::<f64>() / across.len().max(1) as f64;
        vec![("across_px", mean.sqrt())]
    }
}

impl LinePrior {
    fn is_joint_form(&self) -> bool {
        self.form == Form::Joint
    }
}
