//! A season over a synthetic field: a project folder per flight, the list of them, plots, and the truth over all dates.
//!
//! `season.toml` lists the flights for [`crate::season`], `plots.geojson` has the plots. Below `truth/` are what
//! belongs to no single flight: `plants.csv` (every plant with its emergence and its loss), `plant_days.csv` (its leaves on each
//! date), `plots.csv` (how each plot grows), `plot_days.csv` (plants, cover and height on each date) and `light.csv` (what comes back from a level
//! white surface on each date). `panels.geojson` has panels of known reflectance where there are any. The folder of a flight is
//! that of [`super::write_flight`], with the rows and sites of its plants that tell which plant of the season each is.

use super::refused;
use super::{FlightOptions, config_text, project::plots, write_flight};
use crate::{SETTINGS, season::SEASON_FILE};
use data_synth::{
    field::Plant,
    panels::Panel,
    photo::SurfaceGrid,
    render,
    season::SeasonDay,
    season_plan::SeasonConfig,
    twin::{Twin, TwinConfig},
};
use rowgram_base::{error::Error, monitor::Monitor};
use rowgram_files::polygons::{self, Outline};
use rowgram_optim::output::{self, FileError};
use rowgram_raster::{georeference::Crs, height_counts::HeightCounts};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, io::Write, path::Path};

/// What a season holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeasonSynthesis {
    /// Dates of the flights.
    pub dates: Vec<String>,
    /// Photos of each flight.
    pub photos: Vec<usize>,
    /// Plants that each flight sees.
    pub plants: Vec<usize>,
    /// Number of plots.
    pub plots: usize,
}

/// Names of the files beside the flights.
const FILES: [&str; 9] = [
    SEASON_FILE,
    "season-twin.toml",
    "plots.geojson",
    "truth/plants.csv",
    "truth/plant_days.csv",
    "truth/plots.csv",
    "truth/plot_days.csv",
    "truth/light.csv",
    PANELS,
];

/// Panels of known reflectance.
const PANELS: &str = "panels.geojson";

/// Writes a season into the folder `root`, which is made if missing.
///
/// # Errors
/// A parameter that cannot be used, a file that exists unless `force`, and writing.
pub fn write_season(
    config: &SeasonConfig,
    options: &FlightOptions,
    root: &Path,
    force: bool,
    monitor: &mut dyn Monitor,
) -> Result<SeasonSynthesis, Error> {
    config.check().map_err(refused)?;
    let truth = root.join("truth");
    std::fs::create_dir_all(&truth).map_err(|e| FileError::write(&truth, e))?;
    for name in FILES {
        output::check(&root.join(name), force)?;
    }
    let mut found =
        SeasonSynthesis { dates: Vec::new(), photos: Vec::new(), plants: Vec::new(), plots: 0 };
    let season = Truth::new(config)?;
    let (mut plant_days, mut plot_days, mut light) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..config.days.len() {
        let date = config.date(k);
        let folder = root.join(&date);
        let twin_config = config.flight(k).map_err(refused)?;
        let flight = write_flight(&twin_config, options, &folder, force, monitor)?;
        let settings = settings(&date, &twin_config);
        output::write(&folder.join(SETTINGS), force, |out| out.write_all(settings.as_bytes()))?;
        let twin = twin_config.build().map_err(refused)?;
        season.plant_rows(&date, &twin, &mut plant_days);
        season.plot_rows(&date, &twin, &mut plot_days);
        let [red, green, blue] = twin_config.image.level_light();
        light.push(format!("{date},{red:.6},{green:.6},{blue:.6}"));
        found.dates.push(date);
        found.photos.push(flight.photos);
        found.plants.push(flight.plants);
    }
    let drawn = plots(&root.join(&found.dates[0]).join("truth").join("plots.csv"))?;
    found.plots = drawn.len();
    let outlines: Vec<Outline> = drawn.iter().map(|plot| plot.outline(false)).collect();
    let crs = Crs::projected(config.twin.site.epsg);
    polygons::write(&root.join(FILES[2]), true, &outlines, Some(crs))?;
    let resolved = config_text(config)?;
    output::write(&root.join(FILES[1]), force, |out| out.write_all(resolved.as_bytes()))?;
    output::write(&root.join(FILES[3]), force, |out| season.plants_table(out))?;
    output::write(&root.join(FILES[4]), force, |out| {
        writeln!(out, "date,plant,plot,leaves,leaf_area_m2")?;
        plant_days.iter().try_for_each(|row| writeln!(out, "{row}"))
    })?;
    output::write(&root.join(FILES[5]), force, |out| season.plots_table(out))?;
    output::write(&root.join(FILES[6]), force, |out| {
        writeln!(out, "date,plot,plants,canopy_cover,crop_cover,canopy_height_m,leaf_area_m2")?;
        plot_days.iter().try_for_each(|row| writeln!(out, "{row}"))
    })?;
    output::write(&root.join(FILES[7]), force, |out| {
        writeln!(out, "date,red,green,blue")?;
        light.iter().try_for_each(|row| writeln!(out, "{row}"))
    })?;
    if !config.twin.panels.is_empty() {
        panels(&root.join(PANELS), &season.all)?;
    }
    let list = list(config, &found.dates);
    output::write(&root.join(SEASON_FILE), force, |out| out.write_all(list.as_bytes()))?;
    Ok(found)
}

/// The file that lists the flights.
fn list(config: &SeasonConfig, dates: &[String]) -> String {
    let mut text = format!(
        "# A season of one field: the flights and their dates. Later flights are added at the end.\n\
         name = \"Synthetic season {}\"\nsown = \"{}\"\nplots = \"plots.geojson\"\n",
        config.twin.field.seed, config.sown
    );
    if !config.twin.panels.is_empty() {
        text += &format!("panels = \"{PANELS}\"\n");
    }
    for date in dates {
        text += &format!("\n[[flights]]\nproject = \"{date}\"\ndate = \"{date}\"\n");
    }
    text
}

/// The panels as a crew would draw them on the map: within their edges, with what their maker says of them.
fn panels(path: &Path, twin: &Twin) -> Result<(), Error> {
    let outline = |panel: &Panel| {
        let corners = panel.shrunk(0.7).map(|corner| twin.site.grid_m(corner));
        let colours = ["red", "green", "blue"].into_iter().zip(panel.reflectance);
        Outline {
            name: panel.name.into(),
            rings: vec![corners.map(|[e, n, _]| [e, n]).to_vec()],
            attributes: colours.map(|(name, share)| (name.to_owned(), share.into())).collect(),
        }
    };
    let outlines: Vec<Outline> = twin.field().panels.iter().map(outline).collect();
    let crs = Crs::projected(twin.config.site.epsg);
    Ok(polygons::write(path, true, &outlines, Some(crs))?)
}

/// Settings of one flight.
fn settings(date: &str, twin: &TwinConfig) -> String {
    format!(
        "[project]\nname = \"Synthetic field {}, {date}\"\ncrs = \"EPSG:{}\"\n",
        twin.field.seed, twin.site.epsg
    )
}

/// The name of a plot in the files.
fn name_of(plot: usize) -> String {
    format!("P{:02}", plot + 1)
}

type Key = (usize, usize, bool);

fn key(plant: &Plant) -> Key {
    (plant.row, plant.site, plant.second)
}

/// What is true over all dates.
struct Truth<'a> {
    config: &'a SeasonConfig,
    day: SeasonDay,
    /// The field with all plants that ever emerge.
    all: Twin,
    number_of: BTreeMap<Key, usize>,
    plots: usize,
}

impl<'a> Truth<'a> {
    fn new(config: &'a SeasonConfig) -> Result<Truth<'a>, Error> {
        let mut twin = config.flight(0).map_err(refused)?;
        let day = twin.field.season.take().unwrap_or_default();
        let all = twin.build().map_err(refused)?;
        let number_of =
            all.field().plants.iter().enumerate().map(|(k, plant)| (key(plant), k)).collect();
        let field = &twin.field;
        let plots = field.plots.count(field.rows, field.row_length_m).iter().product();
        Ok(Truth { config, day, all, number_of, plots })
    }

    fn plants_table(&self, out: &mut dyn Write) -> std::io::Result<()> {
        writeln!(out, "plant,row,site,second,plot,easting_m,northing_m,emergence_day,lost_day")?;
        let seed = self.config.twin.field.seed;
        for (k, plant) in self.all.field().plants.iter().enumerate() {
            let life = self.day.life(seed, plant);
            let [e, n, _] = self.all.site.grid_m([plant.x_m, plant.y_m, plant.z_m]);
            let (row, site, second) = key(plant);
            let lost = if life.lost_days.is_finite() {
                format!("{:.3}", life.lost_days)
            } else {
                String::new()
            };
            writeln!(
                out,
                "{k},{row},{site},{},{},{e:.5},{n:.5},{:.3},{lost}",
                u8::from(second),
                name_of(plant.plot),
                life.emergence_days
            )?;
        }
        Ok(())
    }

    /// A plot's emergence is the day on which half of its plants have emerged.
    fn plots_table(&self, out: &mut dyn Write) -> std::io::Result<()> {
        writeln!(out, "plot,plants,emergence_day,half_day,rate_per_day")?;
        let seed = self.config.twin.field.seed;
        for plot in 0..self.plots {
            let of_plot = self.all.field().plants.iter().filter(|plant| plant.plot == plot);
            let mut emergence: Vec<f64> =
                of_plot.map(|plant| self.day.life(seed, plant).emergence_days).collect();
            emergence.sort_unstable_by(f64::total_cmp);
            let middle = emergence.len() / 2;
            let half = emergence.get(middle).map(|day| format!("{day:.3}")).unwrap_or_default();
            let growth = self.day.plot(seed, plot);
            writeln!(
                out,
                "{},{},{half},{:.3},{:.4}",
                name_of(plot),
                emergence.len(),
                growth.emergence_days + growth.half_days,
                growth.rate_per_day
            )?;
        }
        Ok(())
    }

    fn plant_rows(&self, date: &str, twin: &Twin, rows: &mut Vec<String>) {
        for plant in &twin.field().plants {
            if let Some(number) = self.number_of.get(&key(plant)) {
                let area_m2: f64 = plant.leaves.iter().map(|leaf| leaf.area_m2()).sum();
                let (plot, leaves) = (name_of(plant.plot), plant.leaves.len());
                rows.push(format!("{date},{number},{plot},{leaves},{area_m2:.6}"));
            }
        }
    }

    fn plot_rows(&self, date: &str, twin: &Twin, rows: &mut Vec<String>) {
        let field = twin.field();
        let (frame, config) = (&field.frame, &field.config);
        let [crop, all] = [&[][..], twin.weeds()].map(|weeds| render::mask(field, weeds));
        let grid = SurfaceGrid {
            left_m: frame.left_m + 0.5 * frame.gsd_m,
            top_m: frame.top_m - 0.5 * frame.gsd_m,
            cell_m: frame.gsd_m,
            width: frame.width_px as usize,
            height: frame.height_px as usize,
        };
        let surface = twin.studio().first_surface(grid);
        // To the last digit that is written.
        let heights = HeightCounts::new(1e-4);
        let mut counted = vec![(0u32, 0u32, 0u32, heights); self.plots];
        for (index, (top_m, ground_m)) in surface.top_m.iter().zip(&surface.ground_m).enumerate() {
            let (u, v) = (index % grid.width, index / grid.width);
            let [x_m, y_m] = frame.ground(u as f64, v as f64);
            let [along_m, across_m] = config.along_across(x_m, y_m);
            if let Some(plot) = self.plot_at(along_m, across_m) {
                let sums = &mut counted[plot];
                let leaf = |mask: &image::GrayImage| u32::from(mask.as_raw()[index] != 0);
                sums.0 += 1;
                sums.1 += leaf(&all);
                sums.2 += leaf(&crop);
                sums.3.add(f64::from(top_m - ground_m));
            }
        }
        for (plot, (pixels, leaf, of_crop, heights)) in counted.into_iter().enumerate() {
            let of_plot = || field.plants.iter().filter(|plant| plant.plot == plot);
            let area_m2: f64 =
                of_plot().flat_map(|plant| &plant.leaves).map(|leaf| leaf.area_m2()).sum();
            let share = |count: u32| f64::from(count) / f64::from(pixels.max(1));
            let height_m = heights.percentile_m(0.95).unwrap_or(0.0);
            rows.push(format!(
                "{date},{},{},{:.6},{:.6},{height_m:.4},{area_m2:.5}",
                name_of(plot),
                of_plot().count(),
                share(leaf),
                share(of_crop)
            ));
        }
    }

    /// The plot whose rectangle in `plots.geojson` holds a place: half a row distance beyond its outer rows, and as long as
    /// the plot.
    fn plot_at(&self, along_m: f64, across_m: f64) -> Option<usize> {
        let config = &self.config.twin.field;
        let from_start_m = along_m + 0.5 * config.row_length_m;
        let q = 2.0 * along_m / config.row_length_m;
        let bow_m = config.curve_m * (1.0 - q * q);
        let row = (across_m - bow_m) / config.inter_row_m + 0.5 * (config.rows as f64 - 1.0);
        let inside = (0.0..config.row_length_m).contains(&from_start_m)
            && (-0.5..config.rows as f64 - 0.5).contains(&row);
        if !inside {
            return None;
        }
        let row = row.round() as usize;
        config.plots.plot(config.rows, config.row_length_m, row.min(config.rows - 1), from_start_m)
    }
}
