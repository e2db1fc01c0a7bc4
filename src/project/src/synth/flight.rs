//! A flight over a synthetic field as a project folder: what a crew brings home, and the whole truth.
//!
//! What a crew brings home: `images/` (JPEG with EXIF), `gcps.csv`, `marks.csv`, `geolocation.csv`, and `field.toml`
//! (every parameter). What no crew knows is below `truth/`: camera, exterior orientation, plants, leaves, plots, targets,
//! surface, and the field from straight above. Positions are in a UTM zone on WGS84, heights above the ellipsoid.

use super::refused;
use super::{config_text, encode_png};
use data_synth::{
    board::{self, BOARD},
    exif, files,
    photo::{Photo, SurfaceGrid},
    start_model,
    twin::{Twin, TwinConfig},
};
use image::{ExtendedColorType, codecs::jpeg::JpegEncoder};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Monitor},
};
use rowgram_files::geotiff::{self, Colour, Layout};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{
    georeference::{Crs, Georeference},
    window::Window,
};
use serde::{Deserialize, Serialize};
use std::{io::Write, path::Path};

/// Which files of a flight are made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlightOptions {
    /// Photos; without them everything else is there in seconds.
    pub photos: bool,
    /// Leaf mask, plants, leaves and stalk bases of every photo, below `truth/photos`.
    pub photo_truth: bool,
    /// Photos of a chessboard by the same camera, below `calibration`.
    pub boards: u16,
}

impl Default for FlightOptions {
    fn default() -> FlightOptions {
        FlightOptions { photos: true, photo_truth: false, boards: 0 }
    }
}

/// What a flight holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FlightOutcome {
    /// Number of plants.
    pub plants: usize,
    /// Number of photos, made or planned.
    pub photos: usize,
    /// Number of targets on the ground.
    pub targets: usize,
    /// Number of image measurements of the targets.
    pub marks: usize,
}

/// Writes a flight into the folder `root`, which is made if missing.
///
/// # Errors
/// A parameter that cannot be used, a file that exists unless `force`, and writing.
pub fn write_flight(
    config: &TwinConfig,
    options: &FlightOptions,
    root: &Path,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<FlightOutcome, Error> {
    config.check().map_err(refused)?;
    if options.photo_truth && !options.photos {
        return Err(Error::Argument("photo_truth: expected photos, which are left out".into()));
    }
    let resolved = config_text(config)?;
    let twin = config.build().map_err(refused)?;
    let folder = Folder { root, force };
    folder.prepare(options, &twin)?;
    folder.text("field.toml", |out| out.write_all(resolved.as_bytes()))?;
    tables(&folder, &twin)?;
    from_above(&folder, &twin)?;
    boards(&folder, &twin, options.boards.into(), monitor)?;
    if options.photos {
        surfaces(&folder, &twin)?;
        photos(&folder, &twin, options.photo_truth, monitor)?;
    }
    Ok(FlightOutcome {
        plants: twin.field().plants.len(),
        photos: twin.shots.len(),
        targets: twin.targets.len(),
        marks: twin.marks.len(),
    })
}

/// The project folder.
struct Folder<'a> {
    root: &'a Path,
    force: bool,
}

/// A writer of one table.
type Table = fn(&Twin, &mut dyn Write) -> std::io::Result<()>;

/// Every table, by its place in the folder.
const TABLES: [(&str, Table); 16] = [
    ("gcps.csv", files::gcps),
    ("marks.csv", files::marks),
    ("geolocation.csv", files::geolocation),
    ("truth/gcps.csv", files::true_gcps),
    ("truth/marks.csv", files::true_marks),
    ("truth/camera.toml", files::camera),
    ("truth/exterior_orientation.csv", files::exterior_orientation),
    ("truth/light.csv", files::light),
    ("truth/plants.csv", files::plants),
    ("truth/leaves.csv", files::leaves),
    ("truth/leaf_axes.csv", files::leaf_axes),
    ("truth/rows.csv", files::rows),
    ("truth/plots.csv", files::plots),
    ("truth/weeds.csv", files::weeds),
    ("truth/dem.asc", files::dem),
    ("truth/dem.prj", |twin, out| out.write_all(files::projection(twin).as_bytes())),
];
const TIE_TABLES: [&str; 5] = [
    "tie_points.csv",
    "truth/tie_points.csv",
    "model/cameras.txt",
    "model/images.txt",
    "model/points3D.txt",
];
const FROM_ABOVE: [&str; 4] =
    ["truth/mask.png", "truth/picture.png", "truth/mask.pgw", "truth/picture.pgw"];

/// The first surface and its height over the ground, metres.
const SURFACES: [&str; 2] = ["truth/dsm.tif", "truth/chm.tif"];

impl Folder<'_> {
    /// Makes the folders and refuses what is there already, before any work is done.
    fn prepare(&self, options: &FlightOptions, twin: &Twin) -> Result<(), Error> {
        let mut folders = vec!["truth"];
        folders.extend(options.photos.then_some("images"));
        folders.extend((twin.config.tie_points.per_photo > 0).then_some("model"));
        folders.extend(options.photo_truth.then_some("truth/photos"));
        folders.extend((options.boards > 0).then_some("calibration"));
        for folder in folders {
            let path = self.root.join(folder);
            std::fs::create_dir_all(&path).map_err(|source| FileError::write(&path, source))?;
        }
        let mut names: Vec<String> = vec!["field.toml".to_owned()];
        names.extend(TABLES.iter().map(|(name, _)| (*name).to_owned()));
        names.extend(FROM_ABOVE.map(str::to_owned));
        if twin.config.tie_points.per_photo > 0 {
            names.extend(TIE_TABLES.map(str::to_owned));
        }
        if options.photos {
            names.extend(SURFACES.map(str::to_owned));
            names.extend(twin.shots.iter().map(|shot| format!("images/{}", shot.name)));
        }
        if options.photo_truth {
            let of = |shot: usize| PHOTO_TRUTH.map(|end| photo_truth_name(twin, shot, end));
            names.extend((0..twin.shots.len()).flat_map(of));
        }
        names.extend((0..options.boards.into()).map(board_name));
        for name in names {
            output::check(&self.root.join(name), self.force)?;
        }
        Ok(())
    }

    fn text(
        &self,
        name: &str,
        fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
    ) -> Result<(), FileError> {
        output::write(&self.root.join(name), self.force, fill)
    }

    fn png(
        &self,
        name: &str,
        pixels: &[u8],
        size: (u32, u32),
        colour: ExtendedColorType,
    ) -> Result<(), FileError> {
        self.text(name, |out| encode_png(out, pixels, size, colour))
    }
}

fn tables(folder: &Folder<'_>, twin: &Twin) -> Result<(), FileError> {
    for (name, table) in TABLES {
        folder.text(name, |out| table(twin, out))?;
    }
    if twin.config.tie_points.per_photo > 0 {
        let points = twin.tie_points();
        folder.text(TIE_TABLES[0], |out| files::tie_points(twin, &points, out))?;
        folder.text(TIE_TABLES[1], |out| files::true_tie_points(twin, &points, out))?;
        folder.text(TIE_TABLES[2], |out| start_model::cameras(twin, out))?;
        folder.text(TIE_TABLES[3], |out| start_model::images(twin, &points, out))?;
        folder.text(TIE_TABLES[4], |out| start_model::points(twin, &points, out))?;
    }
    Ok(())
}

/// What is highest at every pixel of the field seen from straight above, and by how much it is above the ground.
fn surfaces(folder: &Folder<'_>, twin: &Twin) -> Result<(), FileError> {
    let frame = &twin.field().frame;
    let cell_m = frame.gsd_m;
    let grid = SurfaceGrid {
        left_m: frame.left_m + 0.5 * cell_m,
        top_m: frame.top_m - 0.5 * cell_m,
        cell_m,
        width: frame.width_px as usize,
        height: frame.height_px as usize,
    };
    let found = twin.studio().first_surface(grid);
    let [east_m, north_m, _] = twin.site.grid_m([grid.left_m, grid.top_m, 0.0]);
    let site = twin.site.config();
    let top_m: Vec<f32> =
        found.top_m.iter().map(|&z| (site.height_m + f64::from(z)) as f32).collect();
    let above_m: Vec<f32> =
        found.top_m.iter().zip(&found.ground_m).map(|(top, ground)| top - ground).collect();
    let layout = Layout {
        width: grid.width,
        height: grid.height,
        colour: Colour::Values,
        georeference: Some(Georeference::north_up(
            [east_m, north_m],
            cell_m,
            Crs::projected(site.epsg),
        )),
        nodata: Some(-9999.0),
    };
    for (name, values) in SURFACES.into_iter().zip([top_m, above_m]) {
        let path = folder.root.join(name);
        geotiff::write::<f32, FileError>(&path, folder.force, &layout, |writer| {
            writer.put(Window::whole(grid.width, grid.height), &values)
        })?;
    }
    Ok(())
}

/// The field from straight above: mask and picture as of `write_field`.
fn from_above(folder: &Folder<'_>, twin: &Twin) -> Result<(), FileError> {
    let (mask, picture) = twin.scene.mask_and_picture();
    folder.png(FROM_ABOVE[0], mask.as_raw(), mask.dimensions(), ExtendedColorType::L8)?;
    folder.png(FROM_ABOVE[1], picture.as_raw(), picture.dimensions(), ExtendedColorType::Rgb8)?;
    for name in &FROM_ABOVE[2..] {
        folder.text(name, |out| files::world(twin, &twin.field().frame, out))?;
    }
    Ok(())
}

const PHOTO_TRUTH: [&str; 4] = ["_mask.png", "_plants.png", ".csv", "_leaves.png"];

fn photo_truth_name(twin: &Twin, shot: usize, end: &str) -> String {
    let name = &twin.shots[shot].name;
    let stem = name.split_once('.').map_or(name.as_str(), |(stem, _)| stem);
    format!("truth/photos/{stem}{end}")
}

fn board_name(number: usize) -> String {
    format!("calibration/BOARD_{:03}.JPG", number + 1)
}

fn boards(
    folder: &Folder<'_>,
    twin: &Twin,
    count: usize,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let seed = twin.config.field.seed;
    let counter = Counter::new(monitor, "photographing the board", count, "photos");
    for (k, pose) in
        board::poses(BOARD, &twin.camera, count, seed).map_err(refused)?.iter().enumerate()
    {
        let photo = board::photo(BOARD, &twin.camera, pose, seed, k);
        folder.text(&board_name(k), |out| {
            JpegEncoder::new_with_quality(out, 95)
                .encode_image(&photo)
                .map_err(std::io::Error::other)
        })?;
        counter.tick();
    }
    Ok(())
}

/// Renders photo after photo; while one is rendered, the one before is encoded and written.
fn photos(
    folder: &Folder<'_>,
    twin: &Twin,
    with_truth: bool,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let studio = twin.studio();
    let counter = Counter::new(monitor, "rendering", twin.shots.len(), "photos");
    let mut waiting: Option<(usize, Photo)> = None;
    for shot in 0..=twin.shots.len() {
        let (written, next) = rayon::join(
            || {
                waiting
                    .as_ref()
                    .map_or(Ok(()), |(at, photo)| save(folder, twin, *at, photo, with_truth))
            },
            || twin.shots.get(shot).map(|from| (shot, studio.photo(from, shot))),
        );
        written?;
        if waiting.is_some() {
            counter.tick();
        }
        waiting = next;
    }
    Ok(())
}

fn save(
    folder: &Folder<'_>,
    twin: &Twin,
    shot: usize,
    photo: &Photo,
    with_truth: bool,
) -> Result<(), FileError> {
    let from = &twin.shots[shot];
    folder.text(&format!("images/{}", from.name), |out| {
        let quality = twin.config.image.jpeg_quality;
        let camera = twin.camera.config();
        out.write_all(&exif::jpeg(&photo.image, quality, from, camera, &twin.site)?)
    })?;
    if with_truth {
        let name = |which: usize| photo_truth_name(twin, shot, PHOTO_TRUTH[which]);
        let size = photo.mask.dimensions();
        folder.png(&name(0), photo.mask.as_raw(), size, ExtendedColorType::L8)?;
        folder.png(&name(1), photo.plants.as_raw(), size, ExtendedColorType::Rgb8)?;
        folder.text(&name(2), |out| files::photo_plants(twin, twin.field(), shot, out))?;
        let coded: Vec<u8> =
            photo.leaves.iter().flat_map(|label| label.to_le_bytes().into_iter().take(3)).collect();
        folder.png(&name(3), &coded, size, ExtendedColorType::Rgb8)?;
    }
    Ok(())
}
