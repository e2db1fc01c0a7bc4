//! A camera from photos of a chessboard.
//!
//! The inner corners of the board are found in every photo, or read from a table; one interior orientation is adjusted
//! together with the pose of the board in every photo. Photos that cannot be used are named and left out.

mod figures;
mod photos;
mod pictures;
mod request;
mod tables;

pub use photos::{Photo, PhotoStatus};
pub use tables::{CalibrateOutcome, PhotoOutcome};

use super::{
    Project, Stage, Task, photo_folder::UNUSABLE_NAME, photos_in, stage, unusable_names_in,
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
    options::{Kind, Options, Value},
};
use rowgram_optim::{
    engine::SolveError,
    nlls::Loss,
    output::{self, FileError},
};
use rowgram_survey::{
    camera::{Camera, CameraError, Correlation, Model},
    problems::calibration::{
        BoardShape, Request, Solution, View,
        comparison::{BoardBend, ModelFit, board_bend, compare_models},
        consistent::{Consistent, MIN_VIEWS, calibrate_consistent},
        statistics::Statistics,
    },
    target::Board,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A lens model that is estimated from a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensModel {
    /// Image-to-ideal correction K1, K2, K3, P1, P2 (and K0).
    Smac,
    /// Brown's model as OpenCV has it, with its rational terms.
    Brown,
    /// Equidistant fisheye with a polynomial, as OpenCV has it.
    Fisheye,
}

rowgram_base::choices!(LensModel: Smac, Brown, Fisheye);

impl LensModel {
    /// The model.
    pub fn model(self) -> Model {
        match self {
            LensModel::Smac => Model::Smac,
            LensModel::Brown => Model::Brown,
            LensModel::Fisheye => Model::Fisheye,
        }
    }
}

/// A robust loss as people write it: `trivial`, `huber:1.0`, `cauchy:2` and so on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct LossChoice(pub Loss);

impl From<LossChoice> for String {
    fn from(choice: LossChoice) -> String {
        choice.0.to_string()
    }
}

impl TryFrom<String> for LossChoice {
    type Error = String;

    fn try_from(text: String) -> Result<LossChoice, String> {
        text.parse().map(LossChoice)
    }
}

impl Value for LossChoice {
    fn kind() -> Kind {
        Kind::Text
    }
}

rowgram_base::options! {
    /// A camera from photos of a chessboard, all by one camera at one focus and zoom.
    pub struct CalibrateOptions in "calibrate", together go_together, main [board, square_m, lens] {
        /// Folder with the photos of the board; the stage is done where it exists.
        pub images: PathBuf = "calibration".into();
        /// Number of inner corners of the board, where four squares meet: per row x per column.
        pub board: Option<Board> = None, example "\"8x6\"";
        /// Side of a square. It sets the scale of the board poses and does not affect the lens.
        pub square_m: Option<f64> = None, limits POSITIVE, example "0.025";
        /// Lens model.
        pub lens: LensModel = LensModel::Smac;
        /// Distortion terms to estimate besides principal distance and principal point, in the model's names in any case;
        /// "none" for no distortion. Where empty: all but K0 (smac), k1,k2,p1,p2,k3 (brown, which has k4,k5,k6 too),
        /// k1..k4 (fisheye).
        pub free: Vec<String> = Vec::new();
        /// Parameters to hold at their neutral value instead of estimating them.
        pub hold: Vec<String> = Vec::new();
        /// Hold the ratio of the pixels' sides at 1 (brown, fisheye; smac has none).
        pub square_pixels: bool = false;
        /// Constant of the smac model: the radius at which K1..K3 have no effect.
        pub r0_px: f64 = 0.0, limits NON_NEGATIVE;
        /// Whether the board is flat, or the height of every corner is estimated too.
        pub board_shape: BoardShape = BoardShape::Flat;
        /// Robust loss of the final adjustment and its scale in pixels: trivial, huber:1, soft-l1:1, cauchy:1,
        /// geman-mcclure:1 or tukey:4.
        pub loss: LossChoice = LossChoice(Loss::Trivial);
        /// Use boards that are only partly visible.
        pub partial_boards: bool = false;
        /// Keep photos that contradict the others.
        pub keep_misfits: bool = false;
        /// Corners from a table (image, column, row, u_px, v_px) instead of looking for them.
        pub corners: Option<PathBuf> = None, example "\"corners.csv\"";
        /// Width and height of the photos, where corners come from a table and no photo is given.
        pub size_px: Option<[u32; 2]> = None, limits POSITIVE, example "[1280, 960]";
        /// Name of the camera in its file.
        pub camera_name: Option<String> = None, example "\"P4 8.8 mm\"";
    }
}

/// Board and square come together, and parameters are those of the lens.
fn go_together(options: &CalibrateOptions) -> Result<(), String> {
    if options.board.is_some() != options.square_m.is_some() {
        return Err(
            "board and square_m: expected both, the inner corners and the side of a square, or neither"
                .to_owned(),
        );
    }
    if options.board_shape == BoardShape::Free && options.partial_boards {
        return Err(
            "board_shape = free needs to know which corner is which: not with partial_boards"
                .to_owned(),
        );
    }
    // The size of the photos changes no name.
    request::own(options, [640, 480]).map(drop).map_err(|error| error.to_string())
}

/// A calibrated camera and what it came from.
#[derive(Debug)]
pub struct Calibration {
    /// The camera with standard deviations and correlation.
    pub camera: Camera,
    /// The board.
    pub board: Board,
    /// Side of a square, metres.
    pub square_m: f64,
    /// What was estimated.
    pub request: Request,
    /// All photos, in their order.
    pub photos: Vec<Photo>,
    /// Which photos took part, in the order of [`Calibration::views`].
    pub used: Vec<usize>,
    /// The corners that took part.
    pub views: Vec<View>,
    /// The adjustment.
    pub solution: Solution,
    /// How well everything is known.
    pub statistics: Statistics,
    /// Lens models on the same corners, the best first.
    pub models: Vec<ModelFit>,
    /// Whether the board is flat, where that can be tested.
    pub bend: Option<BoardBend>,
}

/// The stage.
pub struct Calibrate;

impl Task for Calibrate {
    type Options = CalibrateOptions;
    type Outcome = CalibrateOutcome;
    const STAGE: Stage = Stage::Calibrate;

    fn inputs(project: &Project, options: &CalibrateOptions) -> Result<Vec<PathBuf>, Error> {
        let nothing = |why: &str| Err(Error::NothingToDo(why.to_owned()));
        if project.given_orthomosaic().is_some() {
            return nothing("the orthomosaic is given");
        }
        if project.config().project.camera.is_some() {
            return nothing("the camera is given");
        }
        let folder = project.root().join(&options.images);
        let corners = options.corners.as_ref().map(|path| project.root().join(path));
        if corners.is_none() && !folder.is_dir() {
            return nothing(&format!(
                "there is no folder {} with photos of a board; the cameras are calibrated by the block itself",
                options.images.display()
            ));
        }
        if options.board.is_none() || options.square_m.is_none() {
            return Err(Error::Argument(format!(
                "{} has photos of a board: say its inner corners and the side of a square in rowgram.toml, [calibrate] board and square_m, or leave the stage out",
                folder.display()
            )));
        }
        Ok(photos_in(&folder).into_iter().chain(corners).collect())
    }

    fn work(
        project: &Project,
        options: &CalibrateOptions,
        folder: &Path,
        monitor: &mut dyn Monitor,
    ) -> Result<CalibrateOutcome, Error> {
        let mut options = options.clone();
        options.corners = options.corners.map(|path| project.root().join(path));
        let images = project.root().join(&options.images);
        for name in unusable_names_in(&images) {
            monitor.diagnostic(&Diagnostic::warning("photo-left-out", name, UNUSABLE_NAME));
        }
        let images = photos_in(&images);
        let found = calibrate_photos(&images, &options, monitor)?;
        let text = found.camera.to_toml();
        tables::write(folder, false, &found)?;
        write_figures(&folder.join("figures"), false, &found, monitor)?;
        let path = folder.join("camera.toml");
        output::write(&path, false, |out| out.write_all(text.as_bytes()))?;
        Ok(CalibrateOutcome::of(&found))
    }
}

/// Calibrates the camera of a project from its photos of a board: `camera.toml`, tables and pictures.
///
/// # Errors
/// [`Error::NothingToDo`] where there are no such photos or the camera is given; see [`calibrate_photos`].
pub fn calibrate(
    project: &Project,
    options: &CalibrateOptions,
    monitor: &mut dyn Monitor,
) -> Result<CalibrateOutcome, Error> {
    stage::perform::<Calibrate>(project, options, monitor)
}

/// Calibrates a camera from photos of a board.
///
/// With [`CalibrateOptions::corners`], photos only tell their size and become pictures; [`CalibrateOptions::images`] is
/// not looked at.
///
/// # Errors
/// Photos that cannot be read or differ in size, fewer than three that can be used, and parameters that they do not
/// determine: which.
pub fn calibrate_photos(
    images: &[PathBuf],
    options: &CalibrateOptions,
    monitor: &mut dyn Monitor,
) -> Result<Calibration, Error> {
    let (Some(board), Some(square_m)) = (options.board, options.square_m) else {
        return Err(Error::Argument(
            "board and square_m: expected the inner corners of the board and the side of a square"
                .into(),
        ));
    };
    Options::validate(options).map_err(Error::Argument)?;
    let photos::Gathered { mut photos, size_px } =
        photos::gather(images, board, square_m, options, monitor)?;
    let request = request::own(options, size_px)?;
    let candidates: Vec<usize> =
        (0..photos.len()).filter(|&k| photos[k].status.is_used()).collect();
    let all: Vec<View> =
        candidates.iter().map(|&k| photos::view(&photos[k], board, square_m)).collect();
    photos::refuse_too_few(&photos, &candidates, board)?;
    let Consistent { used, views, solution, statistics: found, misfits } =
        calibrate_consistent(&all, &request, options.keep_misfits).map_err(fault)?;
    let used: Vec<usize> = used.into_iter().map(|k| candidates[k]).collect();
    for misfit in misfits {
        let photo = &mut photos[candidates[misfit.view]];
        let (rms_px, median_px) = (misfit.rms_px, misfit.median_px);
        if !misfit.kept {
            photo.status = PhotoStatus::Misfit { rms_px, median_px };
        }
        let done = if misfit.kept { "kept" } else { "left out" };
        let message = format!(
            "{done}: it contradicts the other photos, {rms_px:.2} px rms, median of all photos {median_px:.2} px"
        );
        monitor.diagnostic(&Diagnostic::warning("photo-misfit", &photo.name, message).with_remedy(
            "look for another board, corners in another order, a changed zoom or focus",
        ));
    }
    photos::report_few(used.len(), monitor);
    photos::report_blurred(&mut photos, &used, monitor);
    let others = request::comparisons(options, size_px)?;
    let comparison = compare_models(&views, &request, &found, &others);
    for (model, error) in &comparison.undetermined {
        let message = format!("left out of the comparison of lens models: {error}");
        monitor.diagnostic(&Diagnostic::info("model-undetermined", model.word(), message));
    }
    let bend = board_bend(board.columns * board.rows, &views, &request, &solution, &found);
    if let Some(bend) = bend.filter(|bend| bend.bent) {
        let message = format!(
            "it is up to {:.2} mm off its plane; rms {:.3} px with the heights of its corners estimated, {:.3} px without",
            1e3 * bend.largest_m,
            bend.rms_px,
            found.rms_px
        );
        monitor.diagnostic(&Diagnostic::warning("board-not-flat", "board", message).with_remedy(
            "estimate the heights with board_shape = \"free\", or use a stiffer board",
        ));
    }
    if !solution.stop.converged() {
        let message = format!("the adjustment did not converge: {}", solution.stop.explain());
        monitor.diagnostic(&Diagnostic::warning("not-converged", "calibration", message));
    }
    let name = options.camera_name.as_deref().unwrap_or_default();
    let camera = camera(name, &request, &solution, &found).map_err(|e| {
        Error::Incomplete(format!("the calibrated camera cannot be described: {e}"))
    })?;
    Ok(Calibration {
        camera,
        board,
        square_m,
        request,
        photos,
        used,
        views,
        solution,
        statistics: found,
        models: comparison.models,
        bend,
    })
}

/// Writes the tables of a calibration and `calibration.json` into a folder, which is made if missing.
///
/// # Errors
/// A file that exists unless `force`, and writing.
pub fn write_tables(folder: &Path, force: bool, found: &Calibration) -> Result<(), Error> {
    std::fs::create_dir_all(folder).map_err(|source| FileError::write(folder, source))?;
    tables::write(folder, force, found)
}

/// Draws the pictures of a calibration into a folder, which is made if missing.
///
/// # Errors
/// A file that exists unless `force`, and writing.
pub fn write_figures(
    folder: &Path,
    force: bool,
    found: &Calibration,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    std::fs::create_dir_all(folder).map_err(|source| FileError::write(folder, source))?;
    figures::write(folder, force, found)?;
    pictures::write(folder, force, found, monitor)
}

/// The names of the files that [`write_tables`] and [`write_figures`] write.
pub const TABLES: [&str; 10] = [
    "calibration.json",
    "parameters.csv",
    "correlation.csv",
    "photos.csv",
    "corners.csv",
    "residuals.csv",
    "residuals_by_radius.csv",
    "distortion.csv",
    "models.csv",
    "board.csv",
];
/// See [`TABLES`].
pub const FIGURES: [&str; 6] = [
    "correlation.svg",
    "residuals.svg",
    "residuals_by_radius.svg",
    "distortion.svg",
    "before.png",
    "after.png",
];

const _: () = assert!(MIN_VIEWS == 3, "the messages say three");

/// What the photos cannot determine is a matter of the photos and of what is asked of them.
fn fault(error: SolveError) -> Error {
    match error {
        SolveError::RankDeficient(words) | SolveError::InfeasibleStart(words) => {
            Error::Argument(words)
        }
        other => other.into(),
    }
}

fn camera(
    name: &str,
    request: &Request,
    solution: &Solution,
    found: &Statistics,
) -> Result<Camera, CameraError> {
    let mut camera = Camera::new(name, solution.state.interior);
    camera.free.clone_from(&request.free);
    for (sigma, parameter) in camera.standard_deviations.iter_mut().zip(&found.parameters) {
        *sigma = parameter.free.then_some(parameter.standard_deviation);
    }
    camera.correlation = Some(Correlation {
        names: found.free.iter().map(|name| name.clone().into_owned()).collect(),
        // Symmetric to the last bit, as the file asks for.
        matrix: (0..found.free.len())
            .map(|i| (0..found.free.len()).map(|j| found.correlation[i.max(j)][i.min(j)]).collect())
            .collect(),
    });
    Ok(camera)
}
