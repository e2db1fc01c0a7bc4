//! Plants in a mask by a named method: the row model, the descent and its variants.
//!
//! [`prepare`] finds the rows and does all of the row model, or poses the descent from its start; [`find`] does the
//! descent too. Positions and lengths in pixels of the mask, centre of the top-left pixel at (0, 0).

use super::{
    locate::{Init, LocateError, Located, PlantFitOptions, Setup, locate_best},
    perspective::Perspective,
    row_model::{self, RowModelOptions},
    rows::{self, Detection},
    stand::{Stand, unsure_pixels},
};
use crate::problems::plants::{
    Form, Model, PlantUpdate, Prior, Proof, SigmaRule, index::PixelIndex,
};
use rowgram_base::options::{Auto, Options as _};
use rowgram_optim::{
    descent::{self, Order},
    engine::RunOutcome,
};
use rowgram_raster::Mask;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// A named way to locate plants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LocateMethod {
    /// Votes along leaf axes, a random field along curved rows.
    RowModel,
    /// The descent of the joint objective from regular spacing.
    Descent,
    /// The paper: row prior of the other plants, mean distance as scale, from k-means++.
    Paper,
    /// k-means from k-means++.
    Kmeans,
    /// Detected rows and regular spacing; nothing is fitted.
    Rows,
}

rowgram_base::choices!(LocateMethod: RowModel, Descent, Paper, Kmeans, Rows);

rowgram_base::options! {
    /// The paper's objective and its variants, for all methods but the row model. An option that is not set is as the method says.
    pub struct DescentOptions in "locate.paper" {
        /// Prior of a plant's position: none, its row (rows), its row and column (grid).
        pub prior: Option<Prior> = None, example "\"rows\"";
        /// How a plant is updated: the minimum of squared distances (mean), or the exact minimum of the stated cost
        /// (median).
        pub update: Option<PlantUpdate> = None, example "\"median\"";
        /// Scale of the distances: paper (mean distance), planar (half of it), fixed:PX.
        pub sigma: Option<SigmaRule> = None, example "\"planar\"";
        /// Form of the row prior: joint (latent lines, one objective), conditional (given the other plants of the
        /// row, as in the paper).
        pub form: Option<Form> = None, example "\"joint\"";
        /// Number of independent pixels per plant that the data count as; 0: all pixels, as in the paper.
        pub tempering: Option<f64> = None, limits NON_NEGATIVE, example "6.0";
        /// Distances are truncated at this length; 0: never, as in the paper.
        pub truncate_px: Option<f64> = None, limits NON_NEGATIVE, example "20.0";
        /// Start of the descent: far from each other (kmeans++), evenly along the rows (rows), anywhere (random),
        /// at the plants of the row model (votes).
        pub init: Option<Init> = None, example "\"rows\"";
        /// Fit the plants; otherwise they stay at their start.
        pub fit: bool = true;
        /// Order of the updates: cyclic, shuffled.
        pub order: Order = Order::Cyclic;
        /// Maximum number of sweeps over all plants.
        pub max_sweeps: u64 = 500;
        /// Number of starts with consecutive seeds; the plants with the smallest objective are kept.
        pub starts: u64 = 1, limits between(1.0, 10000.0);
        /// Solve the convex problem of every plant with an interior-point method, too, and report how far the
        /// descent is from its bound.
        pub certify: bool = false;
    }
}

rowgram_base::options! {
    /// The place of every plant.
    pub struct LocateOptions in "locate" with {
        /// The row model.
        pub row_model: RowModelOptions,
    } nested {
        /// The paper's objective and its variants.
        pub paper: DescentOptions,
    }, together go_together, main [plants, method] {
        /// Number of plants; auto estimates it.
        pub plants: Auto<usize> = Auto::Auto, limits at_least(1.0);
        /// How plants are located: row-model (votes along leaf axes, a random field along curved rows);
        /// descent, paper, kmeans (descents from other starts); rows (regular spacing).
        pub method: LocateMethod = LocateMethod::RowModel;
        /// Connected leaf areas of fewer pixels are ignored.
        pub min_pixels: usize = 0;
        /// Ground sampling distance, metres per pixel; that of the raster where not set. Without both, lengths are in pixels
        /// only.
        pub gsd_m: Option<f64> = None, limits GSD_M, example "0.015";
        /// Seed of everything random.
        pub seed: u64 = 0;
    }
}

/// Options of the descent go with methods that descend.
fn go_together(options: &LocateOptions) -> Result<(), String> {
    let is_row_model = options.method == LocateMethod::RowModel;
    if let Some((name, _)) = options.paper.changed().first().filter(|_| is_row_model) {
        return Err(format!(
            "{name}: an option of the descent, which method = \"row-model\" does not use; choose another method"
        ));
    }
    Ok(())
}

impl LocateOptions {
    /// Refuses options beyond their limits, or that do not go together.
    ///
    /// # Errors
    /// [`LocateError::Option`]: which, and what was expected.
    pub fn check(&self) -> Result<(), LocateError> {
        self.validate().map_err(LocateError::Option)
    }

    /// Where the descent starts.
    fn init(&self) -> Init {
        self.paper.init.unwrap_or(match self.method {
            LocateMethod::RowModel => Init::Votes,
            LocateMethod::Descent if self.paper.prior == Some(Prior::None) => Init::KmeansPlusPlus,
            LocateMethod::Descent | LocateMethod::Rows => Init::Rows,
            LocateMethod::Paper | LocateMethod::Kmeans => Init::KmeansPlusPlus,
        })
    }

    /// The problem and the engine of the descent: what the method says, where no option says otherwise.
    fn posed(&self, gsd_m: Option<f64>, plants: usize) -> PlantFitOptions {
        let base = self.method.model();
        let given = &self.paper;
        let model = Model {
            prior: given.prior.unwrap_or(base.prior),
            update: given.update.unwrap_or(base.update),
            sigma: given.sigma.unwrap_or(base.sigma),
            form: given.form.unwrap_or(base.form),
            tempering: given.tempering.or(base.tempering).filter(|&votes| votes > 0.0),
            truncate_px: given.truncate_px.or(base.truncate_px).filter(|&px| px > 0.0),
            // As far as it is known how much that is.
            floor_px: gsd_m.map_or(Model::default().floor_px, |gsd| FLOOR_M / gsd),
            ..base
        };
        let fit = given.fit && self.method != LocateMethod::Rows;
        let (order, seed) = (given.order, self.seed);
        PlantFitOptions {
            plants,
            model,
            init: self.init(),
            seed,
            descent: descent::CoordinateDescentOptions {
                order,
                seed,
                ..descent::CoordinateDescentOptions::default()
            },
            max_sweeps: if fit { given.max_sweeps } else { 0 },
        }
    }
}

/// Floor of the standard deviation of plants about their row.
const FLOOR_M: f64 = 0.01;

impl LocateMethod {
    /// Its model.
    fn model(self) -> Model {
        match self {
            LocateMethod::RowModel | LocateMethod::Descent => Model::default(),
            LocateMethod::Paper => Model { form: Form::Conditional, ..Model::default() },
            LocateMethod::Kmeans => {
                Model { prior: Prior::None, update: PlantUpdate::Mean, ..Model::default() }
            }
            LocateMethod::Rows => Model { prior: Prior::None, ..Model::default() },
        }
    }
}

/// The rows of a mask, and its plants or the descent that finds them.
pub struct Prepared {
    /// Leaf pixels.
    pub leaf_pixels: usize,
    /// The rows, where there are any; of the level picture where a photo was levelled ([`Stand::perspective`]).
    pub detection: Detection,
    /// The plants, or how they are found.
    pub work: Work,
}

/// Plants, or how they are found.
pub enum Work {
    /// The plants of the row model.
    Stand(Box<Stand>),
    /// A descent that has not begun.
    Descent(Box<Descend>),
}

/// What was found.
#[derive(Debug, Clone)]
pub enum Found {
    /// By the row model.
    Stand(Box<Stand>),
    /// By a descent.
    Descent(Box<Descended>),
}

/// A descent that has not begun.
pub struct Descend {
    /// The problem and its start.
    pub setup: Setup,
    /// Engine, limits and start.
    pub options: PlantFitOptions,
}

/// What a descent found.
#[derive(Debug, Clone)]
pub struct Descended {
    /// The plants.
    pub located: Located,
    /// How it went.
    pub outcome: RunOutcome,
    /// How far plants are from the optima of their convex problems, where that was asked for.
    pub certificate: Option<Proof>,
}

/// Finds rows, and plants by the row model; poses the descent of the other methods. `posterior` is the probability
/// of vegetation of each pixel of the mask in 1/255, where it is known: closed rows are looked at in pixels judged alone, and weeds
/// are less green than a crop. Without `gsd_m` the row model levels a tilted
/// photo ([`Perspective`]).
///
/// # Errors
/// As [`LocateOptions::check`] and [`row_model::locate`].
pub fn prepare(
    mask: &Mask,
    posterior: Option<Vec<u8>>,
    gsd_m: Option<f64>,
    options: &LocateOptions,
) -> Result<Prepared, LocateError> {
    options.check()?;
    let leaf_pixels = mask.count();
    let is_row_model = options.method == LocateMethod::RowModel;
    // One ground sampling distance for all of a picture means a map, or a photo taken straight down.
    let levelled = if is_row_model && gsd_m.is_none() { levelled(mask) } else { None };
    let perspective = levelled.as_ref().map(|(perspective, ..)| *perspective);
    let (mask, posterior, detection) = match levelled {
        None => (Cow::Borrowed(mask), posterior, rows::detect(mask)),
        Some((perspective, level, detection)) => {
            let posterior = posterior.map(|values| perspective.level(&values).0);
            (Cow::Owned(level), posterior, detection)
        }
    };
    let init = options.init();
    let counts = options.plants == Auto::Auto && leaf_pixels > 0;
    let stand = if is_row_model || init == Init::Votes || counts {
        let (count, options) = (options.plants.given(), &options.row_model);
        let unsure_px = posterior.as_deref().map_or(0, unsure_pixels);
        let mut stand = row_model::locate_in_detail(&mask, posterior, &detection, count, options)?;
        stand.doubt(gsd_m, Some(&mask), unsure_px);
        stand.set_told_number(count);
        perspective.into_iter().for_each(|perspective| stand.seen_in(perspective));
        Some(stand)
    } else {
        None
    };
    let work = match stand {
        Some(stand) if is_row_model => Work::Stand(Box::new(stand)),
        stand => {
            let start: Option<Vec<[f64; 2]>> =
                stand.map(|stand| stand.plants.iter().map(|plant| plant.position_px).collect());
            let plants = options.plants.given();
            let plants = plants.unwrap_or_else(|| start.as_ref().map_or(1, Vec::len));
            let posed = options.posed(gsd_m, plants);
            let start = start.filter(|_| init == Init::Votes);
            let index = PixelIndex::from_mask(mask.width, &mask.data);
            let setup = Setup::from(index, &posed, detection.clone(), start)?;
            Work::Descent(Box::new(Descend { setup, options: posed }))
        }
    };
    Ok(Prepared { leaf_pixels, detection, work })
}

/// The perspective of a tilted photo, its level picture and the rows in that; `None` where rows do not converge.
fn levelled(mask: &Mask) -> Option<(Perspective, Mask, Detection)> {
    let perspective = Perspective::of(mask)?;
    let level = perspective.level_mask(mask);
    let detection = rows::detect(&level);
    let has_rows = detection.rows().is_some_and(|rows| rows.rows.len() > 1);
    has_rows.then_some((perspective, level, detection))
}

impl Descend {
    /// Descends, from several starts where that is asked for.
    ///
    /// # Errors
    /// As [`locate_best`].
    pub fn run(self, options: &DescentOptions) -> Result<Descended, LocateError> {
        let Descend { mut setup, options: posed } = self;
        let (setup, outcome) = if options.starts == 1 {
            let Setup { problem, field, .. } = &mut setup;
            let outcome = descent::run(problem, field, posed.descent, posed.max_sweeps, |_, _| ())?;
            (setup, outcome)
        } else {
            let Setup { problem, field, detection } = setup;
            let start = (posed.init == Init::Votes).then_some(&field.positions_px[..]);
            locate_best(problem.index(), &posed, &detection, start, options.starts)?
        };
        Descended::finish(setup, outcome, options.certify)
    }
}

impl Descended {
    /// Reads the plants off a descent that has ended.
    ///
    /// # Errors
    /// Plants whose convex problem cannot be solved.
    pub fn finish(
        mut setup: Setup,
        outcome: RunOutcome,
        certify: bool,
    ) -> Result<Descended, LocateError> {
        let certificate = if certify { Some(setup.problem.prove(&mut setup.field)?) } else { None };
        Ok(Descended { located: setup.finish(), outcome, certificate })
    }
}

/// Finds the plants of a mask. `gsd_m` scales what the methods say in metres.
///
/// # Errors
/// As [`prepare`] and [`Descend::run`].
pub fn find(
    mask: &Mask,
    gsd_m: Option<f64>,
    options: &LocateOptions,
) -> Result<Found, LocateError> {
    Ok(match prepare(mask, None, gsd_m, options)?.work {
        Work::Stand(stand) => Found::Stand(stand),
        Work::Descent(descend) => Found::Descent(Box::new(descend.run(&options.paper)?)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::stand::Doubt;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Two rows of discs, 20 px apart.
    fn mask() -> Mask {
        Mask::from_fn(300, 120, |u, v| {
            let near = |centre: f64, x: usize| (x as f64 - centre).powi(2);
            (0..13).any(|k| {
                let along = near(25.0 + 20.0 * f64::from(k), u);
                [30.0, 90.0].iter().any(|row| along + near(*row, v) < 36.0)
            })
        })
    }

    fn with(text: &str) -> LocateOptions {
        LocateOptions::default().with(&text.parse().unwrap()).unwrap()
    }

    #[test]
    fn every_method_finds_the_plants() {
        let plants = |options: &LocateOptions| match find(&mask(), Some(0.01), options).unwrap() {
            Found::Stand(stand) => stand.plants.iter().map(|plant| plant.position_px).collect(),
            Found::Descent(found) => {
                found.located.plants.iter().map(|plant| plant.position_px).collect::<Vec<_>>()
            }
        };
        for method in ["row-model", "descent"] {
            let found = plants(&with(&format!("method = \"{method}\"\nplants = 26")));
            assert_eq!(found.len(), 26, "{method}");
            for k in 0..13 {
                let at = [25.0 + 20.0 * f64::from(k), 30.0];
                let off = |p: &[f64; 2]| (p[0] - at[0]).hypot(p[1] - at[1]);
                let nearest = found.iter().map(off).fold(f64::INFINITY, f64::min);
                assert!(nearest < 3.0, "{method}: {nearest} px from {at:?}");
            }
        }
    }

    #[test]
    fn noise_unclear_colours_and_nothing_but_leaf_are_in_doubt() {
        let stand = |mask: &Mask, posterior: Option<Vec<u8>>| {
            let found = prepare(mask, posterior, None, &LocateOptions::default()).unwrap();
            let Work::Stand(stand) = found.work else { panic!("no plants") };
            *stand
        };
        let clear = mask();
        let leaf: Vec<u8> = clear.data.iter().map(|&pixel| u8::from(pixel != 0) * 255).collect();
        let sure = stand(&clear, Some(leaf.clone()));
        assert_eq!(sure.doubts, []);
        // One pixel of five.
        let grass = leaf.iter().enumerate().map(|(k, &p)| if k % 5 == 0 { 100 } else { p });
        let unclear = stand(&clear, Some(grass.collect()));
        let [Doubt::Unclear { share, .. }] = unclear.doubts[..] else {
            panic!("{:?}", unclear.doubts)
        };
        assert!((share - 0.2).abs() < 0.001, "{share}");
        assert!(unclear.plants[0].confidence < 0.25 * sure.plants[0].confidence);
        assert!(unclear.count_interval[0] == 0.0 && unclear.count_interval[1] > 50.0);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let noise: Vec<bool> = (0..300 * 200).map(|_| rng.random_bool(0.005)).collect();
        let specks = stand(&Mask::from_fn(300, 200, |u, v| noise[300 * v + u]), None);
        let doubts = &specks.doubts[..];
        assert!(matches!(doubts, [Doubt::NoRows, Doubt::Specks { .. }]), "{doubts:?}");
        let lawn = stand(&Mask::from_fn(300, 200, |_, _| true), None);
        assert_eq!(lawn.doubts, [Doubt::NoRows, Doubt::Closed]);
        assert!(lawn.count_interval[1] >= 2.0 * lawn.plants.len() as f64);
    }

    #[test]
    fn options_that_do_not_go_together_are_refused() {
        for (text, expected) in [
            ("prior = \"rows\"", "prior: an option of the descent"),
            ("starts = 2", "starts: an option of the descent"),
        ] {
            let error = find(&mask(), None, &with(text)).map(drop).unwrap_err();
            assert!(error.to_string().contains(expected), "{text}: {error}");
        }
        let wrong = RowModelOptions { shrinkage: f64::NAN, ..RowModelOptions::default() };
        let options = LocateOptions { row_model: wrong, ..LocateOptions::default() };
        let error = find(&mask(), None, &options).map(drop).unwrap_err();
        assert!(error.to_string().contains("shrinkage"), "{error}");
    }
}
