//! What a project lacks, before hours are spent on it.

use super::{
    Config, PHOTO_ENDINGS, Project, Stage,
    align::{inputs::is_same_camera, plan_m},
    evaluate,
    forecast::{self, Forecast},
    layers, leaf_count, orthomosaic,
    photo_folder::UNUSABLE_NAME,
    plots,
    run::LEAST_PHOTOS,
    surface,
};
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Collector, Diagnostic, Monitor, Severity},
};
use rowgram_files::{
    csv_table::CsvTable,
    field_design, images,
    photo::{self, Geotag, Metadata},
    polygons::{self, Named},
};
use rowgram_optim::output::name_of;
use std::path::{Path, PathBuf};

/// Forward overlap, percent, below which photos do not connect, and below which connections are weak.
const OVERLAP_PERCENT: [f64; 2] = [30.0, 55.0];

/// Checks photos, what their heads say, settings, tables and overlap; writes nothing. Information is what is well, a
/// warning is what makes results less than they could be, an error has to be put right first.
///
/// # Errors
/// A folder that is none.
pub fn doctor(
    root: &Path,
    environment: impl Iterator<Item = (String, String)>,
) -> Result<Vec<Diagnostic>, Error> {
    let mut found = Vec::new();
    let config = match Config::read(root, environment, &[]) {
        Ok(config) => {
            let message = "rowgram.toml and the environment are understood";
            found.push(Diagnostic::info("settings-valid", "settings", message));
            config
        }
        Err(error) => {
            found.push(Diagnostic::error("settings-refused", "settings", error.to_string()));
            Config::default()
        }
    };
    let project = Project::new(root, config)?;
    let photos = project.photos();
    for name in project.unusable_photos() {
        found.push(Diagnostic::error("photo-name-unusable", name, UNUSABLE_NAME));
    }
    if let Some(ortho) = project.given_orthomosaic() {
        let name = name_of(&ortho);
        found.extend(of_orthomosaic(&project, &ortho, &name));
        let mut others = project.rasters().map(|rasters| rasters.others).unwrap_or_default();
        let (heights, said) = surface::doctor(&project);
        found.extend(said);
        others.retain(|path| !heights.contains(path));
        if project.config().project.ortho.is_none() && !others.is_empty() {
            let names: Vec<_> =
                others.iter().filter_map(|path| path.file_name()?.to_str()).collect();
            let message = format!("not used beside {name}: {}", names.join(", "));
            found.push(
                Diagnostic::info("rasters-unused", "orthomosaic", message)
                    .with_remedy("another one: [project] ortho"),
            );
        }
    } else if let Some(message) = orthomosaic::undecided(&photos) {
        found.push(Diagnostic::error("orthomosaic-undecided", "orthomosaic", message));
    } else if photos.is_empty() {
        let message = format!("none {} ({})", project.photo_place(), PHOTO_ENDINGS.join(", "));
        found.push(Diagnostic::error("photos-missing", "photos", message));
    } else {
        let (said, places) = tables(&project);
        found.extend(of_photos(&project, &photos, places.as_deref()));
        let align = &project.config().align;
        let forecast = Forecast::new(photos.len(), align.max_features, align.max_tie_observations);
        let threads = rayon::current_num_threads();
        found.push(forecast.diagnostic(threads, forecast::available_bytes()));
        let free = forecast::free_disk_bytes(&project.folder(Stage::Align));
        found.extend(forecast.disk_diagnostic(free));
        found.extend(said);
        let control = project.config().project.control.as_ref();
        if project.given(control, &super::align::inputs::CONTROL).is_none() {
            let message = "no ground points: place and height are those of the camera positions, metres off, and nothing \
                           independent tells the error";
            found.push(
                Diagnostic::warning("control-missing", "control", message)
                    .with_remedy("give gcps.csv with marks.csv, or [project] control"),
            );
        }
    }
    found.extend(of_polygons(&project));
    if let Err(error) = orthomosaic::check_bands(&project) {
        found.push(Diagnostic::error("settings-refused", "settings", error.to_string()));
    }
    if let Some(unread) = layers::unread_plots(&project) {
        found.push(unread);
    } else if project.plots().is_none() && project.config().plots.rows_per_plot.is_none() {
        let message = "no plots.geojson, .gpkg or .shp: traits are of the whole field";
        found.push(
            Diagnostic::warning("plots-missing", "plots", message)
                .with_remedy("draw the plots, or say in [plots] how rows make plots"),
        );
    }
    Ok(found)
}

/// Whether plots and regions can be read, and lie on the orthomosaic where there is one.
fn of_polygons(project: &Project) -> Vec<Diagnostic> {
    let ortho = project.orthomosaic().ok().and_then(|path| project.open_picture(&path).ok());
    let mut found = Collector::default();
    let mut names = Vec::new();
    for path in [project.plots(), project.regions()].into_iter().flatten() {
        let subject = path.display().to_string();
        // Without a map their place cannot be checked, but everything else can.
        let read = match &ortho {
            Some(ortho) => {
                let place = ortho.georeference();
                let layer = layers::layer(project, &path, place.as_ref(), Some(ortho.size()));
                layer.map_err(|error| error.to_string())
            }
            None => {
                let is_of_plots = project.plots().as_ref() == Some(&path);
                let of_photos = match is_of_plots {
                    true => orthomosaic::among_photos(project).map(drop),
                    false => Ok(()),
                };
                of_photos.map_err(|error| error.to_string()).and_then(|()| {
                    let key = project.config().project.plot_key.as_deref();
                    let key = key.filter(|_| is_of_plots);
                    polygons::check(&path, key).map_err(|error| error.to_string())
                })
            }
        };
        let is_of_leaves = project.regions().as_ref() == Some(&path)
            && project.config().leaf_count.rho_px.is_none();
        let read = read.and_then(|layer| {
            let mut regions = layer.polygons.iter().filter(|_| is_of_leaves);
            match regions.find(|region| region.leaves.is_none()) {
                Some(region) => Err(leaf_count::without_leaves(&region.name)),
                None => Ok(layer),
            }
        });
        match read {
            Err(error) => {
                found.diagnostic(&Diagnostic::error("polygons-unreadable", subject, error));
            }
            Ok(layer) => {
                if project.plots().as_ref() == Some(&path) {
                    names.extend(layer.polygons.iter().map(|plot| plot.name.clone()));
                }
                layers::say_unused(project, &path, &mut found);
                layers::say(&path, &layer.notes, &mut found);
                let count = layer.polygons.len();
                let message = match &ortho {
                    None => format!("{count} polygons"),
                    Some(ortho) => beside(&layer.polygons, ortho.size()),
                };
                let is_well = !message.contains(';');
                found.diagnostic(&match is_well {
                    true => Diagnostic::info("polygons-readable", subject, message),
                    false => Diagnostic::warning("polygons-beside", subject, message),
                });
            }
        }
    }
    if let Some(book) = &project.config().plots.field_book {
        let path = project.root().join(book);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        // Plots that are made of rows have no names yet.
        let read = match names.is_empty() {
            true => CsvTable::read(&path).map(|table| format!("{} rows", table.len())),
            false => field_design::read_field_book(&path, &names).map(|book| {
                let (joined, all) = (book.map.plots.len(), names.len());
                format!("joined by its column {}: {joined} of {all} plots", book.key)
            }),
        };
        found.diagnostic(&table(&path, "field-book", read.map_err(Error::from)));
    }
    if let Some((path, read)) = evaluate::doctor(project) {
        found.diagnostic(&table(
            &path,
            "truth-readable",
            read.map(|count| format!("{count} true plants")),
        ));
    }
    found.diagnostics
}

/// What a table of a project holds, or why it cannot be used.
fn table(path: &Path, code: &'static str, read: Result<String, Error>) -> Diagnostic {
    match read {
        Ok(message) => Diagnostic::info(code, name_of(path), message),
        Err(error) => Diagnostic::error("table-unreadable", name_of(path), error.to_string()),
    }
}

/// How many polygons there are, and which of them lie beside the raster or hold no pixel.
fn beside(polygons: &[Named], size: (usize, usize)) -> String {
    let (mut outside, mut narrow) = (Vec::new(), Vec::new());
    for Named { name, polygon, .. } in polygons {
        if !plots::is_on(polygon, size) {
            outside.push(name.as_str());
        } else if polygon.pixels() == 0 {
            narrow.push(name.as_str());
        }
    }
    let mut message = format!("{} polygons", polygons.len());
    for (which, what) in
        [(outside, "outside of the orthomosaic"), (narrow, "narrower than a pixel")]
    {
        if !which.is_empty() {
            message += &format!("; {what}: {}", which.join(", "));
        }
    }
    message
}

/// What an orthomosaic that is given lacks.
fn of_orthomosaic(project: &Project, path: &Path, name: &str) -> Vec<Diagnostic> {
    let source = match project.open_picture(path) {
        Ok(source) => source,
        Err(error) => {
            return vec![Diagnostic::error("orthomosaic-unreadable", name, error.to_string())];
        }
    };
    // A copy that was broken off lacks its end.
    let height = source.size().1;
    if let Err(error) = source.rgb_and_gaps(height.saturating_sub(1)..height)
        && source.is_photo()
    {
        return vec![Diagnostic::error("orthomosaic-unreadable", name, error.to_string())];
    }
    let given = match source.georeference().and_then(|place| place.gsd_m()) {
        Some(gsd_m) => {
            let message = format!(
                "traits come from this orthomosaic, {:.2} cm per pixel; photos are not used",
                100.0 * gsd_m
            );
            Diagnostic::info("orthomosaic-given", name, message)
        }
        None => {
            let message = "traits come from this orthomosaic, which does not say how large its pixels are: lengths and areas are in pixels";
            Diagnostic::warning("orthomosaic-given", name, message)
                .with_remedy("give a GeoTIFF in a projected reference system")
        }
    };
    let odd = orthomosaic::oddities(&source, path);
    let size = source.size();
    let memory = forecast::map_diagnostic(name, size, forecast::available_bytes());
    std::iter::once(given).chain(odd).chain(memory).collect()
}

/// What their heads say, whether all of them can be decoded, and where they were taken by what a run would use: `places`, a
/// photo's each; `None` where that cannot be read.
fn of_photos(
    project: &Project,
    photos: &[PathBuf],
    places: Option<&[Option<Geotag>]>,
) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    let heads: Vec<_> = photos
        .par_iter()
        .map(|path| {
            (photo::read(path), images::read_photo(path).map(|photo| photo.dimensions()).ok())
        })
        .collect();
    let mut cameras: Vec<((&Metadata, [u32; 2]), usize)> = Vec::new();
    let (mut unread, mut without_focal) = (Vec::new(), 0);
    let mut scales = Vec::new();
    for (path, (head, size)) in photos.iter().zip(&heads) {
        let (Ok(head), Some((width, height))) = (head, size) else {
            unread.push(project.photo_name(path));
            continue;
        };
        let camera = (head, [*width, *height]);
        match cameras.iter_mut().find(|(first, _)| is_same_camera(*first, camera)) {
            Some((_, count)) => *count += 1,
            None => cameras.push((camera, 1)),
        }
        let principal = head.principal_distance_px([*width, *height]);
        without_focal += usize::from(principal.is_none());
        if let (Some((distance, _)), Some(above)) = (principal, head.height_above_take_off_m) {
            scales.push(Scale {
                gsd_m: above / distance,
                sides_px: [*width.min(height), *width.max(height)].map(f64::from),
            });
        }
    }
    let all = photos.len();
    let opened = all - unread.len();
    if unread.is_empty() {
        let message = format!("{all}, all can be opened");
        found.push(Diagnostic::info("photos-readable", "photos", message));
    } else {
        let message = format!("{} of {all} cannot be opened: {}", unread.len(), unread.join(", "));
        found.push(Diagnostic::error("photos-unreadable", "photos", message));
    }
    if all < LEAST_PHOTOS {
        let message = format!("{all} are too few for a block, expected {LEAST_PHOTOS} or more");
        found.push(Diagnostic::error("photos-too-few", "photos", message));
    }
    let describe = |((head, [width, height]), n): &((&Metadata, [u32; 2]), usize)| {
        let focal = head.focal_mm.map_or(String::new(), |focal| format!(", {focal:.1} mm"));
        let name = format!("{} {} {width} x {height}{focal}", head.make, head.model);
        format!("{n} by {}", name.trim())
    };
    let list: Vec<String> = cameras.iter().map(describe).collect();
    match cameras.len() {
        0 => return found,
        1 => found.push(Diagnostic::info("cameras", "camera", list.join("; "))),
        _ => found.push(Diagnostic::warning("cameras-several", "camera", list.join("; "))),
    }
    if without_focal > 0 {
        let message = format!(
            "{without_focal} of {opened} photos state no focal length; it is estimated from the photos"
        );
        found.push(
            Diagnostic::warning("focal-length-missing", "camera", message)
                .with_remedy("give camera.toml, or photos of a chessboard for [calibrate]"),
        );
    }
    let Some(places) = places else { return found };
    let there: Vec<Geotag> = places.iter().flatten().copied().collect();
    let without_place = places.len() - there.len();
    if without_place > 0 {
        let message = format!(
            "{without_place} of {} photos have no position: what they show has to tell their neighbours",
            places.len()
        );
        found.push(
            Diagnostic::warning("positions-missing", "positions", message)
                .with_remedy("give geolocation.csv or geo.txt, or [project] positions"),
        );
    } else {
        let message = format!("all {} photos have one", places.len());
        found.push(Diagnostic::info("positions", "positions", message));
    }
    let at = plan_m(&there.iter().copied().map(Some).collect::<Vec<_>>());
    scales.retain(|scale| scale.gsd_m > 0.0);
    scales.sort_by(|a, b| a.gsd_m.total_cmp(&b.gsd_m));
    let scale = scales.get(scales.len() / 2).copied();
    found.extend(overlap(&at, scale));
    if let Some(pixels) = scale.and_then(|scale| map_pixels(&at, scale, project)) {
        let threads = rayon::current_num_threads();
        found.push(forecast::maps_diagnostic(pixels, threads, forecast::available_bytes()));
    }
    found
}

/// How large photos show the ground.
#[derive(Clone, Copy)]
struct Scale {
    /// Ground sampling distance.
    gsd_m: f64,
    /// The shorter and the longer side of a photo.
    sides_px: [f64; 2],
}

/// Pixels of the map that photos from these places show, about: what lies within half a photo of a place, in a box along the axes.
fn map_pixels(at: &[[f64; 2]], scale: Scale, project: &Project) -> Option<f64> {
    let [shorter, longer] = scale.sides_px.map(|px| px * scale.gsd_m);
    let sides_m = [0, 1].map(|k| {
        let (least, most) =
            at.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), p| {
                (least.min(p[k]), most.max(p[k]))
            });
        most - least + 0.5 * (shorter + longer)
    });
    let cell_m = project.config().surface.cell_m.unwrap_or(scale.gsd_m);
    Some(sides_m[0] * sides_m[1] / (cell_m * cell_m)).filter(|pixels| pixels.is_finite())
}

/// How far photos are from their nearest neighbours, and what overlap that makes where the height is known.
fn overlap(at: &[[f64; 2]], scale: Option<Scale>) -> Option<Diagnostic> {
    if at.len() < 3 {
        return None;
    }
    let nearest = |k: usize| {
        let others = at.iter().enumerate().filter(|(j, _)| *j != k);
        others.map(|(_, p)| (p[0] - at[k][0]).hypot(p[1] - at[k][1])).fold(f64::INFINITY, f64::min)
    };
    let mut distances: Vec<f64> = (0..at.len()).map(nearest).collect();
    distances.sort_by(f64::total_cmp);
    let (median, last) = (distances[distances.len() / 2], distances[distances.len() - 1]);
    let mut message = format!("nearest neighbours are {median:.1} m apart, at most {last:.1} m");
    let Some(scale) = scale else {
        return Some(Diagnostic::info("overlap", "overlap", message));
    };
    let percent = 100.0 * (1.0 - median / (scale.sides_px[0] * scale.gsd_m));
    message += &format!("; about {percent:.0} % forward overlap by the heights in the photos");
    let remedy = "fly more slowly, or take photos at shorter intervals: 75 % or more";
    let [least, weak] = OVERLAP_PERCENT;
    Some(if percent < least {
        Diagnostic::error("overlap-too-small", "overlap", message).with_remedy(remedy)
    } else if percent < weak {
        Diagnostic::warning("overlap-small", "overlap", message).with_remedy(remedy)
    } else {
        Diagnostic::info("overlap", "overlap", message)
    })
}

/// Whether photos, control, image measurements and positions fit together, and where photos were taken as far as they do.
fn tables(project: &Project) -> (Vec<Diagnostic>, Option<Vec<Option<Geotag>>>) {
    let mut collector = Collector::default();
    let places = super::align::places(project, &project.config().align, &mut collector);
    let mut said = collector.diagnostics;
    match &places {
        Ok(_) => {
            let odd = said.iter().any(|found| found.severity > Severity::Info);
            let message = match odd {
                true => {
                    "photos, control, image measurements and positions can be read; what is odd about them is named"
                }
                false => "photos, control, image measurements and positions fit together",
            };
            said.push(Diagnostic::info("tables-consistent", "tables", message));
        }
        Err(error) => {
            said.push(Diagnostic::error("tables-inconsistent", "tables", error.to_string()))
        }
    }
    (said, places.ok())
}
