//! The locator: plants from leaf pixels, by coordinate descent.
//!
//! Leaf pixels `Z_n` and plants `X_p` are image positions in pixels, centre of the top-left pixel
//! at (0, 0); `d_n = min_p |Z_n - X_p|` (where the paper prints an argmin). The objective in its
//! joint form, with `m` the dimension of the density (1 as in the paper, 2 for the planar rule) and
//! the prior of [`lines`] (or one of your own, [`PlantPrior`]):
//!
//! `J(X, lines, sigma, R) = m N ln sigma + (1/sigma) sum_n d_n
//!   + sum_p [1/2 |X_p - mu_p(lines)|^2_{R^-1} + 1/2 ln det R] + sum_lines slope^2 / (2 tau^2)`
//!
//! and for the `mean` update `d_n^2 / (2 sigma^2)` in place of `d_n / sigma`: the paper's closed
//! form minimises squares, not the stated distances. Any other density of leaf about a plant goes in their place
//! ([`LeafDensity`]).
//!
//! One update takes the pixels that the plant wins, moves it to the exact optimum for them
//! ([`rowgram_optim::convex`] certifies it) and lets every pixel choose again. The cost for held pixels lies
//! above the true, non-convex objective and touches it where the plant was, so `J` never increases
//! (majorise-minimise). A long step goes beyond that optimum, as far as the cost for the held pixels
//! stays below that of not moving: the pixels to come lie ahead. The last steps are exact, as are all
//! of the conditional form. Only pixels near the plant are read ([`assignment`]). After each sweep
//! memberships, lines, variances and `sigma` are refitted, each by its exact minimiser.
//!
//! Two remedies for closed canopies, off by default because the paper has neither: *tempering*
//! multiplies the data terms (those with `sigma`) by `T = min(1, v P / N)`, because the pixels of one
//! leaf are not independent; *truncation* replaces `d_n` by `min(d_n, t)`. Both keep the objective and
//! its decrease: a pixel beyond `t` holds its plant with no force, and its cost cannot rise.
//!
//! In the paper's conditional form the prior of a plant is taken from the other plants and there is
//! no joint objective; the cost is then only a number for the trace.
//!
//! Reference: Ribera et al. 2016, section "Plant Location Model".

pub mod assignment;
mod buckets;
mod density;
pub mod index;
mod inner;
pub mod lines;
mod options;
mod prior;
mod proof;
mod quadratic;
pub mod start;

pub use density::{Distances, Held, LeafDensity};
pub use inner::{mean as inner_mean, median as inner_median};
pub use options::{Form, Model, PlantUpdate, Prior, SigmaRule};
pub use prior::{LinePrior, Lines, PlantPrior};
pub use proof::Proof;
pub use quadratic::Quadratic;

use assignment::Assignment;
use index::PixelIndex;
use lines::Axes;
use rowgram_optim::{
    descent::{ActiveSet, BlockCost},
    engine::SolveError,
};
use serde::{Deserialize, Serialize};

/// `sigma` is never less than this, in pixels: every pixel its own plant would make it zero.
const SIGMA_FLOOR_PX: f64 = 0.1;
/// Steps longer than this many pixels go beyond the optimum, which saves half of the sweeps.
const RELAXED_PX: f64 = 0.1;
/// Positions beyond this many pixels are refused: no picture is as large.
const FARTHEST_PX: f64 = 1e9;

/// The pixels of one mask and the model that explains them.
#[derive(Debug, Clone)]
pub struct Plants<P = LinePrior, D = PlantUpdate> {
    index: PixelIndex,
    model: Model,
    prior: P,
    density: D,
    plants: usize,
}

/// Everything the descent moves. What follows from the positions is not serialised.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Field<L = Lines> {
    /// The plants, image positions in pixels.
    pub positions_px: Vec<[f64; 2]>,
    /// Scale of the distances, in pixels.
    pub sigma_px: f64,
    /// What the prior fits with the plants.
    pub latent: L,
    /// Gradient of the prior over the weight of the data at the last visit of each plant: with the
    /// same pixels its optimum moves only as this changes.
    balance: Vec<[f64; 2]>,
    #[serde(skip)]
    work: Work,
}

/// Rebuilt from the positions, never stored.
#[derive(Debug, Clone, Default)]
struct Work {
    assignment: Assignment,
    u: Vec<f64>,
    v: Vec<f64>,
}

impl Plants {
    /// A problem over these pixels with a number of plants and the prior that the model asks for.
    ///
    /// # Errors
    /// As [`Plants::with_prior`] and [`LinePrior::new`].
    pub fn new(
        index: PixelIndex,
        plants: usize,
        model: Model,
        axes: Axes,
    ) -> Result<Plants, SolveError> {
        Plants::with_prior(index, plants, model, LinePrior::new(&model, axes)?)
    }

    /// The row-aligned axes.
    pub fn axes(&self) -> &Axes {
        self.prior.axes()
    }

    /// A field to start from: positions, and offsets across of the rows and along of the columns
    /// (those that the prior does not ask for are ignored).
    ///
    /// # Errors
    /// As [`LinePrior::lines`] and [`Plants::field_with`].
    pub fn field(
        &self,
        positions_px: Vec<[f64; 2]>,
        rows_px: &[f64],
        columns_px: &[f64],
    ) -> Result<Field, SolveError> {
        self.check(&positions_px)?;
        let lines = self.prior.lines(&positions_px, rows_px, columns_px)?;
        self.field_with(positions_px, lines)
    }
}

impl<P: PlantPrior> Plants<P> {
    /// A problem over these pixels with a number of plants and a prior; of the model all but [`Model::prior`],
    /// [`Model::form`] and [`Model::floor_px`], which are those of the built-in priors.
    ///
    /// # Errors
    /// [`SolveError::Misuse`] without pixels, without plants, with more plants than pixels, or with
    /// numbers in the model that are not positive.
    pub fn with_prior(
        index: PixelIndex,
        plants: usize,
        model: Model,
        prior: P,
    ) -> Result<Plants<P>, SolveError> {
        let misuse = |message: String| Err(SolveError::Misuse(message));
        if index.is_empty() {
            return misuse("there is no leaf pixel".to_owned());
        }
        if plants == 0 || plants > index.len() {
            return misuse(format!("{plants} plants cannot explain {} leaf pixels", index.len()));
        }
        let fixed = if let SigmaRule::Fixed(px) = model.sigma { px } else { 1.0 };
        let (votes, truncate) = (model.tempering.unwrap_or(1.0), model.truncate_px.unwrap_or(1.0));
        let positive = [model.floor_px, model.settle_px, fixed, votes, truncate];
        if positive.iter().any(|x| !(x.is_finite() && *x > 0.0)) {
            return misuse(
                "floor, settling distance, sigma, tempering and truncation have to be positive"
                    .to_owned(),
            );
        }
        if !(1.0..2.0).contains(&model.relaxation) {
            return misuse("the relaxation has to be at least 1 and less than 2".to_owned());
        }
        Ok(Plants { index, model, prior, density: model.update, plants })
    }
}

impl<P: PlantPrior, D: LeafDensity> Plants<P, D> {
    /// The same problem with another leaf density than that of [`Model::update`].
    pub fn with_density<E: LeafDensity>(self, density: E) -> Plants<P, E> {
        let Plants { index, model, prior, plants, .. } = self;
        Plants { index, model, prior, density, plants }
    }

    /// The pixels.
    pub fn index(&self) -> &PixelIndex {
        &self.index
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The prior.
    pub fn prior(&self) -> &P {
        &self.prior
    }

    /// A field to start from: positions, and the latent variables of the prior.
    ///
    /// # Errors
    /// As [`BlockCost::prepare`].
    pub fn field_with(
        &self,
        positions_px: Vec<[f64; 2]>,
        latent: P::Latent,
    ) -> Result<Field<P::Latent>, SolveError> {
        let balance = vec![[0.0; 2]; positions_px.len()];
        let work = Work::default();
        let mut x = Field { positions_px, sigma_px: 1.0, latent, balance, work };
        self.prepare(&mut x)?;
        self.refit_sigma(&mut x);
        Ok(x)
    }

    fn check(&self, positions_px: &[[f64; 2]]) -> Result<(), SolveError> {
        if positions_px.len() != self.plants {
            return Err(SolveError::Misuse(format!(
                "{} positions for {} plants",
                positions_px.len(),
                self.plants
            )));
        }
        match positions_px.iter().position(|at| !at.iter().all(|x| x.abs() <= FARTHEST_PX)) {
            Some(p) => Err(SolveError::InfeasibleStart(format!("the position of plant {p}"))),
            None => Ok(()),
        }
    }

    /// How strongly the pixels of a plant pull.
    fn weight(&self, x: &Field<P::Latent>) -> f64 {
        self.density.weight(x.sigma_px, self.temperature())
    }

    /// `T`: how much of a pixel counts.
    fn temperature(&self) -> f64 {
        let share = |votes: f64| votes * self.plants as f64 / self.index.len() as f64;
        self.model.tempering.map_or(1.0, |votes| share(votes).min(1.0))
    }

    fn assign(&self, positions_px: &[[f64; 2]]) -> Assignment {
        Assignment::new(&self.index, positions_px).truncated(self.model.truncate_px)
    }

    /// The prior of a plant as a function of its offset from where it is.
    pub fn prior_of(&self, x: &Field<P::Latent>, plant: usize) -> Quadratic {
        let mut quadratic = Quadratic::default();
        self.prior.add_to(&x.latent, plant, x.positions_px[plant], &mut quadratic);
        quadratic
    }

    /// The plant with the pixels in `x.work`.
    fn held<'x>(&self, x: &'x Field<P::Latent>, plant: usize) -> Held<'x> {
        let Work { u, v, .. } = &x.work;
        let (sigma_px, share) = (x.sigma_px, self.temperature());
        Held { u_px: u, v_px: v, sigma_px, share, prior: self.prior_of(x, plant) }
    }

    /// Moves a plant to the optimum for the pixels in `x.work`, and returns its offset.
    fn solve(&self, x: &mut Field<P::Latent>, plant: usize) -> [f64; 2] {
        let held = self.held(x, plant);
        let mut offset = self.density.place(&held);
        if self.monotone() && offset[0].hypot(offset[1]) > RELAXED_PX {
            let beyond = offset.map(|step| step * self.model.relaxation);
            if self.density.cost_at(&held, beyond) <= self.density.cost_at(&held, [0.0; 2]) {
                offset = beyond;
            }
        }
        let (pull, weight) = (held.prior.gradient(offset), self.weight(x));
        x.balance[plant] = pull.map(|g| g / weight);
        let at = &mut x.positions_px[plant];
        *at = [at[0] + offset[0], at[1] + offset[1]];
        offset
    }

    /// The distances of the pixels from their plants.
    fn distances<'x>(&'x self, x: &'x Field<P::Latent>) -> Distances<'x> {
        let Field { positions_px, work, .. } = x;
        Distances { assignment: &work.assignment, index: &self.index, positions_px }
    }

    fn refit_sigma(&self, x: &mut Field<P::Latent>) {
        x.work.assignment.refresh(&self.index, &x.positions_px);
        x.sigma_px = match self.model.sigma {
            SigmaRule::Fixed(px) => px,
            SigmaRule::Paper | SigmaRule::Planar => {
                let dimension = self.model.sigma.dimension();
                self.density.scale_px(&self.distances(x), dimension, x.sigma_px).max(SIGMA_FLOOR_PX)
            }
        };
    }

    /// Marks the plants whose optimum the refits have moved noticeably, although they kept their
    /// pixels. With `r` the gradient left over, it moves by about `H^-1 r` at most, for the pixels
    /// only stiffen the prior's `H`.
    fn mark_unsettled(&self, x: &Field<P::Latent>, active: &mut ActiveSet) {
        if self.prior.is_flat() {
            return;
        }
        let weight = self.weight(x);
        for (plant, balance) in x.balance.iter().enumerate() {
            let prior = self.prior_of(x, plant);
            let gradient = prior.gradient([0.0; 2]);
            let pull = [0, 1].map(|k| weight * balance[k] - gradient[k]);
            let shift = Quadratic { pull, ..prior }.minimiser();
            if shift[0].hypot(shift[1]) > self.model.settle_px {
                active.mark(plant);
            }
        }
    }

    /// How many plants have no pixel.
    pub fn empty_clusters(&self, x: &Field<P::Latent>) -> usize {
        let mut empty = vec![true; self.plants];
        for pair in x.work.assignment.pairs() {
            empty[pair.near as usize] = false;
        }
        empty.iter().filter(|&&empty| empty).count()
    }

    /// Mean distance from a pixel to its plant, in pixels.
    pub fn mean_distance_px(&self, x: &Field<P::Latent>) -> f64 {
        self.distances(x).sums().distance / self.index.len() as f64
    }

    /// Nearest and second nearest plant of every pixel, in the order of [`PixelIndex`].
    pub fn pairs<'x>(&self, x: &'x Field<P::Latent>) -> &'x [assignment::NearestPlants] {
        x.work.assignment.pairs()
    }

    /// Puts the offsets of the plant's pixels into the working memory.
    fn gather(&self, x: &mut Field<P::Latent>, plant: usize) {
        let (at, index) = (x.positions_px[plant], &self.index);
        let Work { assignment, u, v } = &mut x.work;
        u.clear();
        v.clear();
        let farthest = self.model.truncate_px.unwrap_or(f64::INFINITY);
        assignment.won_by(index, plant as u32, at, |pixel| {
            let position = index.position(pixel);
            let (du, dv) = (position[0] - at[0], position[1] - at[1]);
            if du * du + dv * dv <= farthest * farthest {
                u.push(du);
                v.push(dv);
            }
        });
    }
}

impl<P: PlantPrior, D: LeafDensity> BlockCost for Plants<P, D> {
    type Iterate = Field<P::Latent>;

    fn len(&self) -> usize {
        self.plants
    }

    fn prepare(&self, x: &mut Field<P::Latent>) -> Result<(), SolveError> {
        self.check(&x.positions_px)?;
        let belongs = x.sigma_px.is_finite()
            && x.sigma_px > 0.0
            && x.balance.len() == self.plants
            && self.prior.is_sound(&x.latent, self.plants);
        if !belongs {
            return Err(SolveError::Misuse("the field does not belong to this problem".to_owned()));
        }
        x.work.assignment = self.assign(&x.positions_px);
        Ok(())
    }

    fn cost(&self, x: &Field<P::Latent>) -> f64 {
        let (count, dimension) = (self.index.len() as f64, self.model.sigma.dimension());
        let share = self.temperature();
        let data = self.density.total(&self.distances(x), x.sigma_px, share);
        let mut cost = share * dimension * count * x.sigma_px.ln() + data;
        self.prior.add_cost(&x.latent, &x.positions_px, &mut cost);
        cost
    }

    fn monotone(&self) -> bool {
        self.prior.is_joint()
    }

    fn update(&self, x: &mut Field<P::Latent>, plant: usize, active: &mut ActiveSet) -> f64 {
        self.gather(x, plant);
        let old = x.positions_px[plant];
        let offset = self.solve(x, plant);
        let step_norm = offset[0].hypot(offset[1]);
        if step_norm > RELAXED_PX {
            active.mark(plant);
        }
        if x.positions_px[plant] == old {
            return 0.0;
        }
        let Field { positions_px, work, .. } = x;
        work.assignment.follow(&self.index, positions_px, plant as u32, old, |p| {
            active.mark(p as usize);
        });
        step_norm
    }

    fn end_sweep(&self, x: &mut Field<P::Latent>, active: &mut ActiveSet) {
        self.prior.refit(&mut x.latent, &x.positions_px);
        self.refit_sigma(x);
        self.mark_unsettled(x, active);
    }

    fn metrics(&self, x: &Field<P::Latent>) -> Vec<(&'static str, f64)> {
        let mut metrics = vec![("sigma_px", x.sigma_px)];
        metrics.extend(self.prior.metrics(&x.latent));
        metrics
    }
}

#[cfg(test)]
mod tests;
