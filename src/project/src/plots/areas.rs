//! The areas whose traits are measured: polygons that somebody drew, groups of rows, or the whole field; made smaller where
//! borders are left out.

use super::{PlotSource, PlotsOptions, Tables};
use crate::{Project, layers};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{csv_table::CsvTable, field_design, polygons::Named};
use rowgram_optim::output::{FileError, name_of};
use rowgram_plants::phenotype::row_plots::{plots_from_rows, row_direction, without_border_rows};
use rowgram_raster::{
    clip,
    georeference::Georeference,
    polygon::{Polygon, Positions},
};
use std::{collections::BTreeSet, path::Path};

/// A plot that nobody drew.
pub(super) fn named(name: String, polygon: Polygon) -> Named {
    Named { name, polygon, leaves: None, attributes: Vec::new() }
}

/// The plots in pixels; `None` where the whole field is one.
pub(super) fn areas(
    project: &Project,
    options: &PlotsOptions,
    tables: &Tables,
    (place, size): (Option<Georeference>, (usize, usize)),
    monitor: &mut dyn Monitor,
) -> Result<(PlotSource, Option<Vec<Named>>), Error> {
    let plants = tables.plants.as_deref().map(CsvTable::read).transpose()?;
    let of_rows = plants.and_then(|table| table.pairs("u_px", "v_px").zip(table.numbers("row")));
    let gsd_m = place.and_then(|place| place.gsd_m());
    let (source, mut areas) = if let Some(path) = project.plots() {
        let areas = layers::plots(project, &path, place.as_ref(), size, monitor)?;
        (PlotSource::Polygons, areas)
    } else {
        let (Some(rows), Some(alley_m)) = (options.rows_per_plot, options.alley_m) else {
            refuse_of_plots(options)?;
            layers::unread_plots(project).iter().for_each(|found| monitor.diagnostic(found));
            return Ok((PlotSource::WholeField, None));
        };
        let Some((plants, row_of)) = &of_rows else {
            let message = "there are no plants with rows, so the whole field is one plot";
            monitor.diagnostic(
                &Diagnostic::warning("plots-without-rows", "plots", message)
                    .with_remedy("locate plants with the row model, or draw the plots as polygons"),
            );
            refuse_of_plots(options)?;
            return Ok((PlotSource::WholeField, None));
        };
        let gsd_m = gsd_m.ok_or_else(|| no_scale("alley_m"))?;
        let areas = plots_from_rows(plants, row_of, rows, alley_m / gsd_m);
        say_rows_left(row_count(row_of), rows, monitor);
        (PlotSource::Rows, areas.into_iter().map(|(name, polygon)| named(name, polygon)).collect())
    };
    if let Some(path) = &options.field_book {
        join(&project.root().join(path), &mut areas, monitor)?;
    }
    let borders = Borders { options, of_rows, gsd_m };
    for area in &mut areas {
        borders.leave_out(area)?;
    }
    Ok((source, Some(areas)))
}

fn no_scale(option: &str) -> Error {
    Error::Argument(format!("[plots] {option}: the orthomosaic has no scale in metres"))
}

/// Refuses options that need plots where the whole field is one.
fn refuse_of_plots(options: &PlotsOptions) -> Result<(), Error> {
    let given = [
        ("inset_along_m", options.inset_along_m > 0.0),
        ("inset_across_m", options.inset_across_m > 0.0),
        ("border_rows", options.border_rows > 0),
        ("field_book", options.field_book.is_some()),
    ];
    match given.iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((name, _)) => Err(Error::Argument(format!(
            "[plots] {name}: the whole field is one plot, expected plots; draw them ([project] plots), give rows_per_plot and alley_m, or take {name} away"
        ))),
    }
}

/// Rows of which some plant was located.
fn row_count(row_of: &[f64]) -> usize {
    let rows: BTreeSet<u64> =
        row_of.iter().filter(|row| row.is_finite()).map(|&row| row as u64).collect();
    rows.len()
}

/// Says where the rows of the field are no whole number of plots.
fn say_rows_left(rows: usize, rows_per_plot: usize, monitor: &mut dyn Monitor) {
    let left = rows % rows_per_plot.max(1);
    if left > 0 {
        let message = format!(
            "{rows} rows in plots of {rows_per_plot} leave {left}: the last plots across have {left}, and plots may begin at the wrong row"
        );
        let remedy = "check rows_per_plot, or draw the plots as polygons";
        let found = Diagnostic::warning("plots-rows-left", "plots", message);
        monitor.diagnostic(&found.with_remedy(remedy));
    }
}

/// What is left out at the edges of plots.
struct Borders<'a> {
    options: &'a PlotsOptions,
    of_rows: Option<(Vec<[f64; 2]>, Vec<f64>)>,
    gsd_m: Option<f64>,
}

impl PlotsOptions {
    /// Whether plots are made smaller than they were drawn.
    pub(super) fn leaves_borders_out(&self) -> bool {
        self.inset_along_m > 0.0 || self.inset_across_m > 0.0 || self.border_rows > 0
    }
}

impl Borders<'_> {
    fn leave_out(&self, area: &mut Named) -> Result<(), Error> {
        let Borders { options, of_rows, gsd_m } = self;
        if !options.leaves_borders_out() {
            return Ok(());
        }
        let name = &area.name;
        let rows = of_rows.as_ref();
        let direction = rows.and_then(|(plants, row_of)| row_direction(plants, row_of));
        if options.border_rows > 0 {
            let (Some((plants, row_of)), Some(direction)) = (rows, direction) else {
                let message = "[plots] border_rows: no rows of plants were found to leave out";
                return Err(Error::Argument(message.to_owned()));
            };
            let inside = Positions::new(plants.iter().copied()).inside(&area.polygon);
            let members: Vec<_> = inside.into_iter().map(|k| (plants[k], row_of[k])).collect();
            let inner =
                without_border_rows(&area.polygon, &members, direction, options.border_rows);
            area.polygon = inner.ok_or_else(|| {
                Error::Argument(format!(
                    "[plots] border_rows = {}: no row of plot {name} would be left",
                    options.border_rows
                ))
            })?;
        }
        if options.inset_along_m > 0.0 || options.inset_across_m > 0.0 {
            let gsd_m = gsd_m.ok_or_else(|| no_scale("inset_along_m, inset_across_m"))?;
            let direction = direction.or_else(|| longest_side(&area.polygon)).unwrap_or([1.0, 0.0]);
            let [along, across] =
                [options.inset_along_m, options.inset_across_m].map(|m| m / gsd_m);
            let inner = clip::inset(&area.polygon, direction, along, across).ok_or_else(|| {
                Error::Argument(format!(
                    "[plots] inset_along_m, inset_across_m: plot {name} is not convex or has holes; give a smaller outline instead"
                ))
            })?;
            if inner.rings.is_empty() {
                return Err(Error::Argument(format!(
                    "[plots] inset_along_m = {}, inset_across_m = {}: nothing of plot {name} would be left",
                    options.inset_along_m, options.inset_across_m
                )));
            }
            area.polygon = inner;
        }
        Ok(())
    }
}

/// The direction of the longest side of an outline.
fn longest_side(polygon: &Polygon) -> Option<[f64; 2]> {
    let ring = polygon.rings.first()?;
    let sides = (0..ring.len()).map(|k| {
        let (a, b) = (ring[k], ring[(k + 1) % ring.len()]);
        [b[0] - a[0], b[1] - a[1]]
    });
    let [du, dv] = sides.max_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])))?;
    let length = du.hypot(dv);
    (length > 0.0).then(|| [du / length, dv / length])
}

/// Adds what a field book says of the plots.
fn join(path: &Path, areas: &mut [Named], monitor: &mut dyn Monitor) -> Result<(), Error> {
    let names: Vec<&str> = areas.iter().map(|area| area.name.as_str()).collect();
    let book = field_design::read_field_book(path, &names)?;
    let subject = name_of(path);
    let mut without = Vec::new();
    let mut joined = 0;
    for area in areas.iter_mut() {
        let Some(values) = book.map.plots.get(&area.name) else {
            without.push(area.name.clone());
            continue;
        };
        joined += 1;
        for (column, value) in book.map.columns.iter().zip(values) {
            area.attributes.retain(|(name, _)| !name.eq_ignore_ascii_case(column));
            area.attributes.push((column.clone(), value.clone()));
        }
    }
    if joined == 0 {
        let message = "none of its columns has the names of the plots";
        return Err(FileError::malformed(path, None, message).into());
    }
    let message = format!("joined by its column {}: {joined} of {} plots", book.key, areas.len());
    let found = match without.is_empty() {
        true => Diagnostic::info("field-book", subject, message),
        false => {
            let message = format!("{message}; not there: {}", without.join(", "));
            Diagnostic::warning("field-book-incomplete", subject, message)
        }
    };
    monitor.diagnostic(&found);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::{monitor::Collector, options::Options};

    #[test]
    fn options_of_plots_are_refused_of_a_whole_field() {
        let with = |text: &str| PlotsOptions::default().with(&text.parse().unwrap()).unwrap();
        assert!(refuse_of_plots(&with("")).is_ok());
        for text in ["border_rows = 1", "inset_along_m = 0.5", "field_book = \"book.csv\""] {
            let error = refuse_of_plots(&with(text)).unwrap_err().to_string();
            let name = text.split(' ').next().unwrap();
            assert!(error.contains(name) && error.contains("expected plots"), "{error}");
        }
    }

    #[test]
    fn rows_that_are_no_whole_number_of_plots_are_told() {
        let told = |rows: usize| {
            let mut collector = Collector::default();
            say_rows_left(rows, 4, &mut collector);
            collector.diagnostics.len()
        };
        assert_eq!([told(8), told(9)], [0, 1]);
        assert_eq!(row_count(&[0.0, 1.0, 1.0, f64::NAN]), 2);
    }
}
