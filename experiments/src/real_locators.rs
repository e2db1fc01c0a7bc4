//! The locators that are compared on photos: the paper's, as it has them and with its open choices, rows with regular spacing,
//! today's, and that of an example with a leaf density of its own (`examples/leaf_density.rs`).
//!
//! Lengths are in spacings, for no photo says how many metres a pixel is: the spacing is the length of the detected rows over
//! the number of plants, which all but one are told. Found plants are right within a quarter of the true spacing.

use rowgram::{
    Error, descent,
    options::Auto,
    phenotype::{
        locate::{Init, LocateError, PlantFitOptions, Setup},
        locator::{self, LocateOptions, Work},
        rows::{self, Detection},
    },
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    raster::Mask,
    score::Score,
};

#[path = "../../examples/leaf_density.rs"]
#[allow(dead_code, reason = "the example's own field takes no part")]
mod leaf_density;

/// Most sweeps of a descent; a run that ends here says so.
pub(crate) const MOST_SWEEPS: u64 = 100;
/// Floor of the scatter about a row, over the spacing: 1 cm where plants are 20 cm apart.
const FLOOR: f64 = 0.05;
/// What the others are compared with.
pub(crate) const BASELINE: &str = "k-means";

/// Where the scale of the distances comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Scale {
    /// The mean distance, after every sweep.
    Estimated,
    /// This share of the spacing.
    Fixed(f64),
}

/// A descent with everything that can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Variant {
    prior: Prior,
    update: PlantUpdate,
    form: Form,
    scale: Scale,
    /// Pixels per plant that count; 0 is the paper, all.
    votes: f64,
    start: Init,
    fit: bool,
}

/// The paper's inter-row form.
const PAPER: Variant = Variant {
    prior: Prior::Rows,
    update: PlantUpdate::Median,
    form: Form::Conditional,
    scale: Scale::Estimated,
    votes: 0.0,
    start: Init::KmeansPlusPlus,
    fit: true,
};

/// A way to locate plants.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum How {
    /// A descent that is told the number of plants.
    Descent(Variant),
    /// A descent likewise, with the leaf density of the example.
    Example(Variant, leaf_density::Student),
    /// Today's locator, told the number or not.
    Today { told: bool },
}

/// The locators without a choice, by name.
pub(crate) const LOCATORS: [(&str, How); 8] = [
    (BASELINE, How::Descent(Variant { prior: Prior::None, update: PlantUpdate::Mean, ..PAPER })),
    ("k-median", How::Descent(Variant { prior: Prior::None, ..PAPER })),
    ("inter-row", How::Descent(PAPER)),
    ("full", How::Descent(Variant { prior: Prior::Grid, ..PAPER })),
    (
        "rows, regular spacing",
        How::Descent(Variant { prior: Prior::None, start: Init::Rows, fit: false, ..PAPER }),
    ),
    (
        "example, heavy tails",
        How::Example(
            Variant { form: Form::Joint, start: Init::Rows, ..PAPER },
            leaf_density::Student(2.0),
        ),
    ),
    ("today, number told", How::Today { told: true }),
    ("today", How::Today { told: false }),
];

/// The locators whose choices are made on other sets, with their priors.
pub(crate) const CHOSEN: [(&str, Prior); 2] =
    [("inter-row, chosen", Prior::Rows), ("full, chosen", Prior::Grid)];

/// What can be chosen for a prior: form, scale, votes, start.
pub(crate) fn candidates(prior: Prior) -> Vec<Variant> {
    let mut all = Vec::new();
    for form in [Form::Conditional, Form::Joint] {
        for scale in [Scale::Estimated, Scale::Fixed(0.1), Scale::Fixed(0.3)] {
            for votes in [0.0, 6.0] {
                for start in [Init::KmeansPlusPlus, Init::Rows] {
                    all.push(Variant { prior, form, scale, votes, start, ..PAPER });
                }
            }
        }
    }
    all
}

impl Variant {
    /// The choices, for a table.
    pub(crate) fn words(&self) -> String {
        let form = if self.form == Form::Joint { "joint" } else { "conditional" };
        let start = if self.start == Init::Rows { "rows" } else { "k-means++" };
        let scale = match self.scale {
            Scale::Estimated => "sigma re-estimated".to_owned(),
            Scale::Fixed(share) => format!("sigma {share} spacing"),
        };
        let votes = if self.votes > 0.0 {
            format!("{} votes per plant", self.votes)
        } else {
            "every pixel a vote".to_owned()
        };
        format!("{form}; {scale}; {votes}; start {start}")
    }
}

/// A picture with its plants.
pub(crate) struct Case {
    pub(crate) set: String,
    pub(crate) photo: String,
    pub(crate) mask: Mask,
    /// Probability of vegetation in 1/255, where it is known.
    pub(crate) posterior: Option<Vec<u8>>,
    pub(crate) truth: Vec<[f64; 2]>,
    pub(crate) spacing_px: f64,
}

/// A case whose rows were looked for.
pub(crate) struct Ready<'a> {
    pub(crate) case: &'a Case,
    index: PixelIndex,
    pub(crate) detection: Detection,
}

/// How one locator did on one case.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Judged {
    pub(crate) found: usize,
    pub(crate) f1: f64,
    /// Median distance of the pairs within half a spacing, in spacings.
    pub(crate) median_error: Option<f64>,
    pub(crate) sweeps: u64,
    /// Why it ended, or why there is nothing.
    pub(crate) stop: String,
}

impl<'a> Ready<'a> {
    pub(crate) fn new(case: &'a Case) -> Ready<'a> {
        let index = PixelIndex::from_mask(case.mask.width, &case.mask.data);
        let detection = rows::detect(&case.mask);
        Ready { case, index, detection }
    }

    /// Locates and judges. What cannot be located is found nowhere: the photo counts, with all its plants missed.
    pub(crate) fn run(&self, how: How) -> Result<Judged, Error> {
        let located = match how {
            How::Descent(variant) => self.descend(&variant, None),
            How::Example(variant, density) => self.descend(&variant, Some(density)),
            How::Today { told } => self.today(told),
        };
        let (found, sweeps, stop) =
            located.unwrap_or_else(|error| (Vec::new(), 0, error.to_string()));
        let radii_px = [0.25, 0.5].map(|share| share * self.case.spacing_px);
        let score = Score::new(&found, &self.case.truth, &radii_px)?;
        Ok(Judged {
            found: found.len(),
            f1: score.radii[0].f1.unwrap_or(0.0),
            median_error: score.median_error_px.map(|px| px / self.case.spacing_px),
            sweeps,
            stop,
        })
    }

    fn descend(
        &self,
        variant: &Variant,
        density: Option<leaf_density::Student>,
    ) -> Result<(Vec<[f64; 2]>, u64, String), LocateError> {
        let plants = self.case.truth.len();
        let rows = self.detection.rows();
        let length: f64 = rows.map_or(0.0, |rows| rows.rows.iter().map(|r| r.length_px()).sum());
        let spacing_px = (length / plants.max(1) as f64).max(4.0);
        let sigma = match variant.scale {
            Scale::Estimated => SigmaRule::Paper,
            Scale::Fixed(share) => SigmaRule::Fixed(share * spacing_px),
        };
        let options = PlantFitOptions {
            plants,
            model: Model {
                prior: variant.prior,
                update: variant.update,
                form: variant.form,
                sigma,
                tempering: (variant.votes > 0.0).then_some(variant.votes),
                floor_px: FLOOR * spacing_px,
                ..Model::default()
            },
            init: variant.start,
            seed: 1,
            descent: descent::CoordinateDescentOptions::default(),
            max_sweeps: if variant.fit { MOST_SWEEPS } else { 0 },
        };
        let mut setup = Setup::new(self.index.clone(), &options, self.detection.clone())?;
        let Setup { problem, field, .. } = &mut setup;
        let (how, most) = (options.descent, options.max_sweeps);
        let outcome = match density {
            Some(density) => {
                descent::run(&problem.clone().with_density(density), field, how, most, |_, _| ())?
            }
            None => descent::run(problem, field, how, most, |_, _| ())?,
        };
        let places = setup.finish().plants.iter().map(|plant| plant.position_px).collect();
        let stop = if variant.fit { outcome.stop.word() } else { "no fit" };
        Ok((places, outcome.iterations, stop.to_owned()))
    }

    fn today(&self, told: bool) -> Result<(Vec<[f64; 2]>, u64, String), LocateError> {
        let plants = if told { Auto::Given(self.case.truth.len()) } else { Auto::Auto };
        let options = LocateOptions { plants, ..LocateOptions::default() };
        let prepared =
            locator::prepare(&self.case.mask, self.case.posterior.clone(), None, &options)?;
        let places = match prepared.work {
            Work::Stand(stand) => stand.plants.iter().map(|plant| plant.position_px).collect(),
            Work::Descent(_) => Vec::new(),
        };
        Ok((places, 0, "done".to_owned()))
    }
}

/// The candidate with the largest mean over sets of the mean over photos; `scores` has set, candidate and F1.
pub(crate) fn choose(scores: &[(&str, usize, f64)], left_out: &str, count: usize) -> usize {
    let mut sets: Vec<&str> = scores.iter().map(|s| s.0).filter(|set| *set != left_out).collect();
    sets.sort_unstable();
    sets.dedup();
    let mean_of = |candidate: usize| -> f64 {
        let of_set = |set: &str| {
            let mine = scores.iter().filter(|s| s.0 == set && s.1 == candidate).map(|s| s.2);
            let (sum, count) = mine.fold((0.0, 0.0_f64), |(sum, n), f1| (sum + f1, n + 1.0));
            sum / count.max(1.0)
        };
        sets.iter().map(|set| of_set(set)).sum()
    };
    (1..count).fold(0, |best, k| if mean_of(k) > mean_of(best) { k } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_does_not_see_the_set_that_is_left_out() {
        let scores = [("a", 0, 0.2), ("a", 1, 0.9), ("b", 0, 0.6), ("b", 1, 0.5), ("b", 1, 0.4)];
        assert_eq!(choose(&scores, "a", 2), 0);
        assert_eq!(choose(&scores, "b", 2), 1);
        assert_eq!(choose(&scores, "", 2), 1);
    }

    #[test]
    fn separate_plants_in_rows_are_found_by_all() {
        let mut mask = Mask::empty(440, 130);
        let mut truth = Vec::new();
        for row in 0..3 {
            for k in 0..20 {
                // Not quite regular, so that a fit has something to do, and no columns.
                let (u, v) = (20 + 20 * k + (k * 7) % 5 + 7 * row, 25 + 40 * row);
                for (du, dv) in (0..25).map(|n| (n % 5, n / 5)) {
                    mask.data[(v + dv - 2) * 440 + u + du - 2] = 1;
                }
                truth.push([u as f64, v as f64]);
            }
        }
        let (set, photo) = ("made".to_owned(), "rows".to_owned());
        let case = Case { set, photo, mask, posterior: None, truth, spacing_px: 20.0 };
        let ready = Ready::new(&case);
        for (name, how) in LOCATORS {
            let done = ready.run(how).unwrap();
            // A start by k-means++ has two plants in some places and none in others, which no descent repairs.
            let least = if name.starts_with("today") { 0.9 } else { 0.6 };
            assert!(done.f1 >= least, "{name}: {done:?}");
        }
        let empty = Case { mask: Mask::empty(440, 130), ..case };
        let nothing = Ready::new(&empty).run(LOCATORS[0].1).unwrap();
        assert!(nothing.found == 0 && nothing.f1 == 0.0 && nothing.stop.contains("leaf pixel"));
    }
}
