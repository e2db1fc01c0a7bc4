//! `rowgram calibrate target`: a camera from photos of a chessboard.

mod figures;
mod gather;
mod models;
mod pictures;
mod report;
mod residuals;

use crate::{
    camera::{Camera, CameraError, Correlation, Model},
    engine::SolveError,
    error::Error,
    io::{FileError, output},
    nlls::Loss,
    problems::calibration::{
        BoardShape, Request, Solution, View, calibrate,
        statistics::{Statistics, statistics},
    },
    target::{Board, Refinement},
};
use clap::{Args as ClapArgs, Subcommand, ValueEnum};
use gather::Photo;
use std::path::PathBuf;

/// Calibrate a camera: the interior orientation that its lens really has.
#[derive(Debug, ClapArgs)]
pub(super) struct Calibrate {
    #[command(subcommand)]
    verb: CalibrateVerb,
}

#[derive(Debug, Subcommand)]
enum CalibrateVerb {
    Target(Args),
}

impl Calibrate {
    /// Runs the verb.
    ///
    /// # Errors
    /// As the verb says.
    pub(super) fn run(&self) -> Result<(), Error> {
        match &self.verb {
            CalibrateVerb::Target(args) => run(args),
        }
    }
}

/// Calibrate from photos of a chessboard
///
/// Finds the inner corners of the board in every photo to a fraction of a pixel, or reads them
/// from a CSV file, and adjusts one interior orientation together with the pose of the board in
/// every photo. No value has to be known beforehand.
///
/// The report folder gets report.json, tables (parameters, correlation, photos, corners,
/// residuals, residuals by radius, distortion curve, lens models) and pictures of them, and a
/// photo before and after its distortion is removed.
///
/// Photos without the whole board, with a board of another size, twice the same, or that do not
/// fit the others are named and left out.
///
/// Example:
///   rowgram calibrate target photos/*.jpg --board 8x6 --square 0.025 -o camera.toml --report calibration
#[derive(Debug, ClapArgs)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Photos of the board (PNG, JPEG or TIFF), all by one camera at one focus and zoom.
    #[arg(required_unless_present = "corners", value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// Inner corners of the board, where four squares meet: of a row times of a column.
    #[arg(long, value_name = "COLUMNSxROWS")]
    board: Board,
    /// Side of a square, metres. It sets the scale of the poses, nothing of the lens.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    square: f64,
    /// The lens model.
    #[arg(long, value_enum, default_value_t = LensName::Smac)]
    lens: LensName,
    /// Distortion terms to estimate, besides principal distance and principal point, in the
    /// model's names in any case; "none" for no distortion. All but K0 (smac), k1,k2,p1,p2,k3
    /// (brown, which has k4,k5,k6 too), k1..k4 (fisheye) if not given.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    free: Option<Vec<String>>,
    /// Parameters to hold at their neutral value although they would be estimated.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    hold: Vec<String>,
    /// Hold the ratio of the pixels' sides at 1 (brown, fisheye; smac has none).
    #[arg(long)]
    square_pixels: bool,
    /// A constant of the smac model: the radius at which K1..K3 change nothing, pixels.
    #[arg(long, value_name = "PX", default_value_t = 0.0, allow_negative_numbers = true)]
    r0: f64,
    /// Whether the board is flat, or the height of every corner is estimated too.
    #[arg(long, value_enum, default_value_t = Shape::Flat)]
    board_shape: Shape,
    /// Robust loss of the final adjustment and its scale in pixels: trivial, huber:A, cauchy:A ...
    #[arg(long, default_value = "trivial", value_name = "LOSS")]
    loss: Loss,
    /// Corners from a CSV file (image,column,row,u_px,v_px) instead of looking for them.
    #[arg(long, value_name = "CSV")]
    corners: Option<PathBuf>,
    /// Size of the photos in pixels, where corners come from a file and no photo is given.
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    size: Option<String>,
    /// How corners are refined: by the gradients across their edges, or by a saddle surface.
    #[arg(long, value_enum, default_value_t = Refine::Gradients)]
    refine: Refine,
    /// Use what can be seen of a board that is not wholly in the photo.
    #[arg(long)]
    partial: bool,
    /// Keep photos that do not fit the others.
    #[arg(long)]
    keep_misfits: bool,
    /// Name of the camera in its file.
    #[arg(long, value_name = "NAME", default_value = "")]
    name: String,
    /// Where to write the camera.
    #[arg(short, long, value_name = "CAMERA.toml")]
    output: PathBuf,
    /// Folder for the report; made if it is not there.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Print the report as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LensName {
    /// Image-to-ideal correction K1, K2, K3, P1, P2 (and K0).
    Smac,
    /// Brown's model as OpenCV has it, with its rational terms.
    Brown,
    /// Equidistant fisheye with a polynomial, as OpenCV has it.
    Fisheye,
}

impl LensName {
    fn model(self) -> Model {
        match self {
            LensName::Smac => Model::Smac,
            LensName::Brown => Model::Brown,
            LensName::Fisheye => Model::Fisheye,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Shape {
    /// Flat.
    Flat,
    /// Heights are unknowns.
    Free,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Refine {
    /// Gradients across the edges.
    Gradients,
    /// A saddle surface.
    Saddle,
}

impl Refine {
    fn method(self) -> Refinement {
        match self {
            Refine::Gradients => Refinement::Gradients,
            Refine::Saddle => Refinement::Saddle,
        }
    }
}

/// A calibration and what it came from.
struct Outcome {
    request: Request,
    photos: Vec<Photo>,
    /// Which photos took part, in the order of the views.
    used: Vec<usize>,
    views: Vec<View>,
    solution: Solution,
    statistics: Statistics,
    models: Vec<models::ModelRow>,
    bend: Option<models::Bend>,
    camera: Camera,
}

fn run(args: &Args) -> Result<(), Error> {
    check(args)?;
    let gathered = gather::gather(args)?;
    let outcome = work(args, gathered)?;
    let text = outcome.camera.to_toml();
    if let Some(folder) = &args.report {
        report::write(folder, args, &outcome)?;
    }
    output::write(&args.output, args.force, |out| out.write_all(text.as_bytes()))?;
    if args.json {
        super::print_json(&report::json(args, &outcome))
    } else {
        super::print(&report::text(&outcome))
    }
}

/// Refuses what would fail after the work is done.
fn check(args: &Args) -> Result<(), Error> {
    if !(args.square.is_finite() && args.square > 0.0) {
        return Err(Error::Argument(format!(
            "--square {}: expected the side of a square in metres, such as 0.025",
            args.square
        )));
    }
    if !(args.r0.is_finite() && args.r0 >= 0.0) {
        return Err(Error::Argument(format!("--r0 {}: expected a radius in pixels", args.r0)));
    }
    if args.board_shape == Shape::Free && args.partial {
        return Err(Error::Argument(
            "--board-shape free needs to know which corner is which: not with --partial".into(),
        ));
    }
    output::check(&args.output, args.force)?;
    if args.images.iter().any(|image| super::segment::same_file(image, &args.output)) {
        return Err(Error::Argument(format!(
            "{} is a photo, expected another output",
            args.output.display()
        )));
    }
    let Some(folder) = &args.report else { return Ok(()) };
    if folder.exists() && !folder.is_dir() {
        return Err(FileError::Unusable { path: folder.clone(), message: "it is no folder" }.into());
    }
    for name in report::FILES {
        let path = folder.join(name);
        if path.exists() && !args.force {
            return Err(FileError::Exists { path }.into());
        }
    }
    // Bad names are found before any photo is read.
    request(args, args.lens.model(), args.free.as_deref(), [640, 480]).map(|_| ())
}

/// What is to be estimated for a model.
fn request(
    args: &Args,
    model: Model,
    free: Option<&[String]>,
    size_px: [u32; 2],
) -> Result<Request, Error> {
    let parameters = model.parameters();
    let place = |name: &str| {
        let wanted = name.trim().to_lowercase();
        parameters.iter().position(|parameter| {
            let own = parameter.name.to_lowercase();
            own == wanted || own.strip_suffix("_px") == Some(&wanted)
        })
    };
    let names = || parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
    let find = |option: &str, name: &str| match place(name) {
        Some(place) if parameters[place].estimable => Ok(place),
        Some(_) => Err(Error::Argument(format!(
            "{option}: {name} is a constant of the {} model",
            model.word()
        ))),
        None => Err(Error::Argument(format!(
            "{option}: the {} model has no parameter {name:?}, only {}",
            model.word(),
            names()
        ))),
    };
    let mut is_free: Vec<bool> = parameters
        .iter()
        .map(|p| {
            matches!(p.name, "c_px" | "f_px" | "xp_px" | "yp_px" | "cx_px" | "cy_px" | "aspect")
        })
        .collect();
    match free {
        Some([none]) if none.eq_ignore_ascii_case("none") => {}
        Some(names) => {
            for name in names {
                is_free[find("--free", name)?] = true;
            }
        }
        None => {
            for name in default_terms(model) {
                is_free[find("--free", name)?] = true;
            }
        }
    }
    // The lists may be about another model where models are compared.
    if free.is_some() || model == args.lens.model() {
        for name in &args.hold {
            is_free[find("--hold", name)?] = false;
        }
    }
    let mut values: Vec<f64> = (0..parameters.len())
        .map(|k| model.default_value(k, size_px).unwrap_or(f64::from(size_px[0])))
        .collect();
    if let Some(aspect) = place("aspect").filter(|_| args.square_pixels) {
        is_free[aspect] = false;
    }
    if let Some(r0) = place("R0_px") {
        values[r0] = args.r0;
    }
    if !is_free.contains(&true) {
        return Err(Error::Argument("--hold: nothing is left to estimate".into()));
    }
    Ok(Request {
        model,
        size_px,
        free: is_free,
        values,
        shape: match args.board_shape {
            Shape::Flat => BoardShape::Flat,
            Shape::Free => BoardShape::Free,
        },
        loss: args.loss,
    })
}

fn default_terms(model: Model) -> &'static [&'static str] {
    match model {
        Model::Smac => &["K1", "K2", "K3", "P1", "P2"],
        Model::Brown => &["k1", "k2", "p1", "p2", "k3"],
        Model::Fisheye => &["k1", "k2", "k3", "k4"],
        Model::Bal => &["k1", "k2"],
    }
}

/// What the photos cannot determine is a matter of the photos and of what is asked of them.
fn fault(error: SolveError) -> Error {
    match error {
        SolveError::RankDeficient(words) | SolveError::InfeasibleStart(words) => {
            Error::Argument(words)
        }
        other => other.into(),
    }
}

/// A photo that is this many times worse than the usual one does not fit.
const MISFIT_RATIO: f64 = 5.0;
/// Nor does one within this distance, pixels, whatever the others do.
const MISFIT_PX: f64 = 1.0;

fn work(args: &Args, gathered: gather::Gathered) -> Result<Outcome, Error> {
    let gather::Gathered { mut photos, size_px } = gathered;
    let request = request(args, args.lens.model(), args.free.as_deref(), size_px)?;
    let (mut used, mut views, mut solution, mut found);
    loop {
        used = (0..photos.len()).filter(|&k| photos[k].status.is_used()).collect::<Vec<_>>();
        views = used.iter().map(|&k| gather::view(&photos[k], args)).collect::<Vec<_>>();
        gather::enough(&photos, &used, args)?;
        solution = calibrate(&views, &request).map_err(fault)?;
        found = statistics(&views, &request, &solution).map_err(fault)?;
        let mut sorted: Vec<f64> = found.views.iter().map(|view| view.rms_px).collect();
        sorted.sort_by(f64::total_cmp);
        let usual = sorted[sorted.len() / 2];
        let worst = (0..used.len())
            .max_by(|&a, &b| found.views[a].rms_px.total_cmp(&found.views[b].rms_px));
        let Some(worst) = worst.filter(|&k| {
            let rms = found.views[k].rms_px;
            rms > MISFIT_RATIO * usual && rms > MISFIT_PX
        }) else {
            break;
        };
        let photo = &mut photos[used[worst]];
        let rms_px = found.views[worst].rms_px;
        if args.keep_misfits || used.len() < 4 {
            tracing::warn!(
                "{} does not fit the other photos: {rms_px:.2} px rms against {usual:.2} px of the usual one; kept",
                photo.name
            );
            break;
        }
        tracing::warn!(
            "{} does not fit the other photos: {rms_px:.2} px rms against {usual:.2} px of the usual one; \
             left out (another board, corners in another order, a moved zoom?)",
            photo.name
        );
        photo.status = gather::Status::Misfit { rms_px, usual_px: usual };
    }
    gather::name_blurred(&mut photos, &used);
    let models = models::compare(args, &views, &request, &found)?;
    let bend = models::bend(args, &views, &request, &solution, &found);
    let camera = camera(args, &request, &solution, &found).map_err(|e| {
        Error::Incomplete(format!("the calibrated camera cannot be described: {e}"))
    })?;
    if !solution.stop.converged() {
        tracing::warn!("the adjustment did not converge: {}", solution.stop.explain());
    }
    Ok(Outcome { request, photos, used, views, solution, statistics: found, models, bend, camera })
}

fn camera(
    args: &Args,
    request: &Request,
    solution: &Solution,
    found: &Statistics,
) -> Result<Camera, CameraError> {
    let mut camera = Camera::new(&args.name, solution.state.interior);
    camera.free.clone_from(&request.free);
    for (sigma, parameter) in camera.standard_deviations.iter_mut().zip(&found.parameters) {
        *sigma = parameter.free.then_some(parameter.standard_deviation);
    }
    camera.correlation = Some(Correlation {
        names: found.free.iter().map(|name| (*name).to_owned()).collect(),
        // Symmetric to the last bit, as the file asks for.
        matrix: (0..found.free.len())
            .map(|i| (0..found.free.len()).map(|j| found.correlation[i.max(j)][i.min(j)]).collect())
            .collect(),
    });
    Ok(camera)
}
