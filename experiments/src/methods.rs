//! The locators that are compared: the paper's variants, from both starts, and the baseline that
//! fits nothing.

use rowgram::{
    descent,
    phenotype::{
        locate::{Init, Located, PlantFitOptions, Setup},
        rows::Detection,
    },
    problems::plants::{Form, Model, PlantUpdate, Prior, SigmaRule, index::PixelIndex},
    score::Score,
};

/// A named locator.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Method {
    pub(crate) name: &'static str,
    prior: Prior,
    update: PlantUpdate,
    form: Form,
    sigma: SigmaRule,
    init: Init,
    fit: bool,
}

const PAPER: Method = Method {
    name: "",
    prior: Prior::Rows,
    update: PlantUpdate::Median,
    form: Form::Conditional,
    sigma: SigmaRule::Paper,
    init: Init::KmeansPlusPlus,
    fit: true,
};

/// All methods, the order of the tables' columns.
pub(crate) const METHODS: &[Method] = &[
    Method { name: "random pixels", prior: Prior::None, init: Init::Random, fit: false, ..PAPER },
    Method { name: "k-means", prior: Prior::None, update: PlantUpdate::Mean, ..PAPER },
    Method { name: "k-median", prior: Prior::None, ..PAPER },
    Method { name: "inter-row cond", ..PAPER },
    Method { name: "inter-row cond planar", sigma: SigmaRule::Planar, ..PAPER },
    Method { name: "inter-row joint", form: Form::Joint, ..PAPER },
    Method { name: "inter-row joint mean", form: Form::Joint, update: PlantUpdate::Mean, ..PAPER },
    Method { name: "full cond", prior: Prior::Grid, ..PAPER },
    Method { name: "full joint", prior: Prior::Grid, form: Form::Joint, ..PAPER },
    Method { name: "rows, k-median", prior: Prior::None, init: Init::Rows, ..PAPER },
    Method { name: "rows, inter-row cond", init: Init::Rows, ..PAPER },
    Method { name: "rows, inter-row joint", form: Form::Joint, init: Init::Rows, ..PAPER },
    Method {
        name: "rows, inter-row joint, sigma fixed",
        form: Form::Joint,
        sigma: SigmaRule::Fixed(500.0),
        init: Init::Rows,
        ..PAPER
    },
    Method {
        name: "rows, full joint",
        form: Form::Joint,
        prior: Prior::Grid,
        init: Init::Rows,
        ..PAPER
    },
    Method {
        name: "rows + regular spacing",
        init: Init::Rows,
        prior: Prior::None,
        fit: false,
        ..PAPER
    },
];

/// One method on one mask.
#[derive(Debug, Clone)]
pub(crate) struct Run {
    pub(crate) scenario: String,
    pub(crate) image: String,
    pub(crate) method: &'static str,
    pub(crate) plants: usize,
    pub(crate) pixels: usize,
    /// F1 at every radius; 0 where the method could not run (no rows found).
    pub(crate) f1: Vec<f64>,
    pub(crate) median_error_px: Option<f64>,
    pub(crate) sweeps: u64,
    pub(crate) stop: String,
}

/// Runs one method on a mask whose rows were looked for already.
pub(crate) fn run(
    method: &Method,
    (scenario, image): (&str, &str),
    index: &PixelIndex,
    detection: &Detection,
    truth: &[[f64; 2]],
    radii_px: &[f64],
    floor_px: f64,
) -> Result<Run, rowgram::Error> {
    let options = PlantFitOptions {
        plants: truth.len(),
        model: Model {
            prior: method.prior,
            update: method.update,
            form: method.form,
            sigma: method.sigma,
            floor_px,
            ..Model::default()
        },
        init: method.init,
        seed: 1,
        descent: descent::CoordinateDescentOptions::default(),
        max_sweeps: if method.fit { 300 } else { 0 },
    };
    let mut run = Run {
        scenario: scenario.to_owned(),
        image: image.to_owned(),
        method: method.name,
        plants: truth.len(),
        pixels: index.len(),
        f1: vec![0.0; radii_px.len()],
        median_error_px: None,
        sweeps: 0,
        stop: String::new(),
    };
    match descend(index, &options, detection) {
        Ok((located, outcome)) => {
            let found: Vec<[f64; 2]> = located.plants.iter().map(|p| p.position_px).collect();
            let score = Score::new(&found, truth, radii_px)?;
            run.f1 = score.radii.iter().map(|radius| radius.f1.unwrap_or(0.0)).collect();
            run.median_error_px = score.median_error_px;
            run.sweeps = outcome.iterations;
            outcome.stop.word().clone_into(&mut run.stop);
        }
        Err(error) => run.stop = error.to_string(),
    }
    Ok(run)
}

fn descend(
    index: &PixelIndex,
    options: &PlantFitOptions,
    detection: &Detection,
) -> Result<(Located, rowgram::engine::RunOutcome), rowgram::Error> {
    let mut setup = Setup::with_rows(index.clone(), options, detection.clone())?;
    let outcome = descent::run(
        &setup.problem,
        &mut setup.field,
        options.descent,
        options.max_sweeps,
        |_, _| (),
    )?;
    Ok((setup.finish(), outcome))
}
