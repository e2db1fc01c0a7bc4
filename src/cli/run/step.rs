//! The verbs as stages: which command does a stage, from what, and whether it can be done at all.

use super::{
    command::Command,
    config::{Config, OrAuto},
};
use crate::{
    error::Error,
    io::{FileError, polygons, rasters::Source},
};
use std::path::{Path, PathBuf};

/// The stages in their order.
pub(in crate::cli) const STAGES: [&str; 12] = [
    "grow",
    "calibrate",
    "align",
    "dem",
    "ortho",
    "segment",
    "density",
    "count",
    "locate",
    "leaves",
    "plots",
    "evaluate",
];

/// What is to be done about a stage.
pub(super) enum Plan {
    /// This command.
    Do(Command),
    /// Nothing, for this reason.
    Nothing(String),
}

fn nothing(why: impl Into<String>) -> Result<Plan, Error> {
    Ok(Plan::Nothing(why.into()))
}

/// A project and where its results go.
pub(super) struct Place<'a> {
    pub(super) root: &'a Path,
    pub(super) results: &'a Path,
    pub(super) config: &'a Config,
}

/// Endings of photos.
const PHOTOS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

/// Files of a folder with one of these endings.
fn with_ending(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let ending = path.extension().and_then(|e| e.to_str()).map(str::to_lowercase);
            path.is_file() && ending.is_some_and(|e| endings.contains(&e.as_str()))
        })
        .collect();
    found.sort();
    found
}

impl Place<'_> {
    /// The photos of the project.
    pub(super) fn photos(&self) -> Vec<PathBuf> {
        let images = self.root.join("images");
        if images.is_dir() {
            return with_ending(&images, &PHOTOS);
        }
        let photos = with_ending(self.root, &PHOTOS);
        match &self.given_ortho(&photos) {
            Some(ortho) => photos.into_iter().filter(|path| path != ortho).collect(),
            None => photos,
        }
    }

    /// An orthomosaic that is there from the beginning.
    fn given_ortho(&self, photos: &[PathBuf]) -> Option<PathBuf> {
        if let Some(path) = &self.config.project.ortho {
            return Some(self.root.join(path));
        }
        let [only] = photos else { return None };
        let tiff = crate::io::rasters::is_tiff_name(only);
        let placed = || Source::open(only).ok().and_then(|source| source.georeference());
        (tiff && placed().is_some()).then(|| only.clone())
    }

    /// The orthomosaic that traits come from, if it is given.
    pub(super) fn orthomosaic(&self) -> Option<PathBuf> {
        if self.config.project.ortho.is_some() {
            return self.given_ortho(&[]);
        }
        if self.root.join("images").is_dir() {
            return None;
        }
        self.given_ortho(&with_ending(self.root, &PHOTOS))
    }

    /// Where a file of a stage is.
    pub(super) fn at(&self, stage: &str, name: &str) -> PathBuf {
        self.results.join(stage).join(name)
    }

    /// A file that is named, or lies at its usual place.
    pub(super) fn named(&self, named: Option<&PathBuf>, usual: &str) -> Option<PathBuf> {
        match named {
            Some(path) => Some(self.root.join(path)),
            None => Some(self.root.join(usual)).filter(|path| path.is_file()),
        }
    }

    /// A file of polygons that is named, or lies at its usual place in one of the usual formats.
    pub(super) fn polygons(&self, named: Option<&PathBuf>, stem: &str) -> Option<PathBuf> {
        match named {
            Some(path) => Some(self.root.join(path)),
            None => polygons::find(self.root, stem),
        }
    }

    /// The orthomosaic, given or made.
    pub(super) fn ortho(&self) -> Option<PathBuf> {
        self.orthomosaic().or_else(|| Some(self.at("ortho", "ortho.tif")).filter(|p| p.is_file()))
    }

    fn mask(&self) -> Option<PathBuf> {
        Some(self.at("segment", "mask.tif")).filter(|path| path.is_file())
    }

    /// What does a stage.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub(super) fn plan(&self, stage: &str) -> Result<Plan, Error> {
        match stage {
            "calibrate" => self.calibrate(),
            "align" => self.align(),
            "dem" => self.dem(),
            "ortho" => self.mosaic(),
            "segment" => self.segment(),
            "density" => self.density(),
            "count" => self.count(),
            "locate" => self.locate(),
            "leaves" => self.leaves(),
            _ => nothing("there is no such stage"),
        }
    }

    fn calibrate(&self) -> Result<Plan, Error> {
        let config = &self.config.calibrate;
        let folder = self.root.join(&config.images);
        if self.orthomosaic().is_some() {
            return nothing("the orthomosaic is given");
        }
        if self.config.project.camera.is_some() {
            return nothing("the camera is given");
        }
        if !folder.is_dir() {
            return nothing(format!(
                "there is no folder {} with photos of a board; the block calibrates itself",
                config.images.display()
            ));
        }
        let (Some(board), Some(side)) = (&config.board, config.square_m) else {
            let message = format!(
                "{} has photos of a board: say its corners and the side of a square in rowgram.toml, [calibrate] board and square_m, or leave the stage out",
                folder.display()
            );
            return Err(Error::Argument(message));
        };
        let photos = with_ending(&folder, &PHOTOS);
        let command = photos
            .iter()
            .fold(Command::new(&["calibrate", "target"]), |command, photo| command.path(photo))
            .option("--board", board)
            .option("--square", side)
            .to("-o", &self.at("calibrate", "camera.toml"))
            .to("--report", &self.at("calibrate", "report"))
            .word("--json")
            .reads(photos);
        Ok(Plan::Do(command))
    }

    fn align(&self) -> Result<Plan, Error> {
        let (project, config) = (&self.config.project, &self.config.align);
        if self.orthomosaic().is_some() {
            return nothing("the orthomosaic is given");
        }
        let photos = self.photos();
        if photos.is_empty() {
            let message = format!(
                "no photos (in images/ or directly) and no orthomosaic; expected {}",
                PHOTOS.join(", ")
            );
            return Err(FileError::malformed(self.root, None, message).into());
        }
        let mut command = Command::new(&["align"])
            .path(self.root)
            .to("-o", &self.results.join("align"))
            .option("--lens", &config.lens)
            .option("--solver", &config.solver)
            .option("--max-features", config.max_features)
            .option("--tolerance", config.tolerance_px)
            .option("--rolling-shutter", &config.rolling_shutter)
            .option("--seed", config.seed)
            .maybe("--crs", project.crs.as_ref())
            .flag("--no-positions", !config.use_positions)
            .reads(photos);
        if !config.check.is_empty() {
            command = command.option("--check", config.check.join(","));
        }
        for (option, named) in [
            ("--control", &project.control),
            ("--marks", &project.marks),
            ("--geolocation", &project.geolocation),
        ] {
            if let Some(path) = named {
                command = command.from(option, &self.root.join(path));
            }
        }
        let calibrated = Some(self.at("calibrate", "camera.toml")).filter(|path| path.is_file());
        if let Some(camera) = self.named(project.camera.as_ref(), "camera.toml").or(calibrated) {
            command = command.from("--camera", &camera);
        }
        let usual = [
            "gcps.csv",
            "marks.csv",
            "gcp_list.txt",
            "ground_control_points.json",
            "geolocation.csv",
        ];
        command = command
            .reads(usual.map(|name| self.root.join(name)).into_iter().filter(|p| p.is_file()))
            .word("--json")
            .word("--force");
        command.resumes = true;
        Ok(Plan::Do(command))
    }

    /// What the mapping verbs read of the block.
    fn block(&self) -> Vec<PathBuf> {
        let names = [
            "exterior_orientation.csv",
            "crs.txt",
            "camera-1.toml",
            "report/points.csv",
            "colmap/cameras.txt",
            "colmap/images.txt",
        ];
        names.map(|name| self.at("align", name)).into_iter().filter(|p| p.is_file()).collect()
    }

    fn dem(&self) -> Result<Plan, Error> {
        if self.orthomosaic().is_some() {
            return nothing("the orthomosaic is given");
        }
        if self.block().is_empty() {
            return nothing("there is no block");
        }
        let config = &self.config.dem;
        let command = Command::new(&["dem"])
            .path(self.root)
            .to("--aligned", &self.results.join("align"))
            .to("-o", &self.at("dem", "dem.tif"))
            .option("--outlier", config.outlier)
            .maybe("--cell", config.cell_m)
            .to("--figures", &self.at("dem", "figures"))
            .word("--json")
            .reads(self.block());
        Ok(Plan::Do(command))
    }

    fn mosaic(&self) -> Result<Plan, Error> {
        if self.orthomosaic().is_some() {
            return nothing("the orthomosaic is given");
        }
        let dem = self.at("dem", "dem.tif");
        if !dem.is_file() {
            return nothing("there is no surface");
        }
        let config = &self.config.ortho;
        let command = Command::new(&["ortho"])
            .path(self.root)
            .to("--aligned", &self.results.join("align"))
            .from("--dem", &dem)
            .to("-o", &self.at("ortho", "ortho.tif"))
            .option("--above", &config.above)
            .maybe("--gsd", config.gsd_m)
            .maybe("--feather", config.feather_m)
            .flag("--balance", config.balance)
            .to("--figures", &self.at("ortho", "figures"))
            .word("--json")
            .reads(self.block())
            .reads(self.photos());
        Ok(Plan::Do(command))
    }

    fn tau(&self) -> String {
        match &self.config.segment.tau {
            OrAuto::Given(tau) => tau.map(|value| value.to_string()).join(","),
            OrAuto::Word(_) => "auto".to_owned(),
        }
    }

    fn segment(&self) -> Result<Plan, Error> {
        let Some(ortho) = self.ortho() else { return nothing("there is no orthomosaic") };
        let config = &self.config.segment;
        let command = Command::new(&["segment"])
            .path(&ortho)
            .option("--tau", self.tau())
            .option("--min-pixels", config.min_pixels)
            .option("--fill-holes", config.fill_holes)
            .to("-o", &self.at("segment", "mask.tif"))
            .word("--json")
            .reads([ortho]);
        Ok(Plan::Do(command))
    }

    fn density(&self) -> Result<Plan, Error> {
        let Some(mask) = self.mask() else { return nothing("there is no mask") };
        let command = Command::new(&["density"])
            .path(&mask)
            .option("--window", self.config.density.window_px)
            .to("-o", &self.at("density", "density.tif"))
            .to("--picture", &self.at("density", "density.png"))
            .word("--json")
            .reads([mask]);
        Ok(Plan::Do(command))
    }

    fn count(&self) -> Result<Plan, Error> {
        let Some(mask) = self.mask() else { return nothing("there is no mask") };
        let project = &self.config.project;
        let regions = self.polygons(project.regions.as_ref(), "regions");
        let command = Command::new(&["count"]).path(&mask).reads([mask]);
        let mut command = match (self.config.count.rho_px, regions) {
            (Some(rho), _) => command.option("--rho", rho),
            (None, Some(regions)) => {
                command.from("--calibrate", &regions).reads(polygons::files(&regions))
            }
            (None, None) => {
                return nothing(
                    "no leaves were counted by hand: give regions.geojson or [count] rho_px",
                );
            }
        };
        if let Some(plots) = self.polygons(project.plots.as_ref(), "plots") {
            command = command.from("--plots", &plots).reads(polygons::files(&plots));
        }
        Ok(Plan::Do(command.to("-o", &self.at("count", "counts.csv")).word("--json")))
    }

    fn gsd_m(&self, raster: &Path) -> Result<Option<f64>, Error> {
        Ok(Source::open(raster)?.georeference().and_then(|place| place.gsd_m()))
    }

    fn locate(&self) -> Result<Plan, Error> {
        let Some(mask) = self.mask() else { return nothing("there is no mask") };
        let config = &self.config.locate;
        let full = matches!(config.method.as_str(), "full");
        let mut command = Command::new(&["locate"])
            .path(&mask)
            .option("--plants", &config.plants)
            .option("--method", &config.method)
            .maybe("--gsd", self.gsd_m(&mask)?)
            .to("-o", &self.at("locate", "plants.csv"));
        if full {
            command = command
                .to("--gaps", &self.at("locate", "gaps.csv"))
                .to("--counts", &self.at("locate", "rows.csv"));
        }
        Ok(Plan::Do(command.word("--json").reads([mask])))
    }

    fn leaves(&self) -> Result<Plan, Error> {
        let (Some(ortho), Some(_)) = (self.ortho(), self.mask()) else {
            return nothing("there is no mask");
        };
        let mut command = Command::new(&["leaves"])
            .path(&ortho)
            .option("--tau", self.tau())
            .option("--min-pixels", self.config.leaves.min_pixels)
            .to("-o", &self.at("leaves", "leaves.csv"))
            .reads([ortho]);
        let plants = self.at("locate", "plants.csv");
        if plants.is_file() {
            command = command
                .from("--plants", &plants)
                .to("--per-plant", &self.at("leaves", "per_plant.csv"));
        }
        Ok(Plan::Do(command.word("--json")))
    }
}
