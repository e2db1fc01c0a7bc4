//! Brings the maps of all dates into one frame.
//!
//! Flights with ground control of their own stay as they are; without any, the first one does. The others follow in the order of their
//! distance in time from one that is placed: each is tied by plants, or by what does not grow, to the placed flights nearest in time, and a
//! similarity or an affine map ([`rowgram_survey::problems::map_transform`]) puts it into their frame. A flight that is added at the end changes no other.

use super::{SeasonOptions, file::Frame};
use crate::{
    Project, Stage,
    record::{Key, Store},
};
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_files::{
    csv_table::CsvTable,
    geotiff::{Reader, Reading},
};
use rowgram_optim::output::FileError;
use rowgram_raster::{
    georeference::{Georeference, Transfer},
    spectral::Band,
    window::Window,
};
use rowgram_survey::{
    mapping::{
        map_ties::{self, MapFeatures},
        plant_ties::plant_ties,
    },
    problems::map_transform::{self, MapFit, MapTie, MapTransform},
};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::PathBuf};

/// Placed flights that another one is tied to.
const NEIGHBOURS: usize = 2;

/// How a flight came into the frame of the season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// From its map into the frame of the season.
    pub transform: MapTransform,
    /// Dates that it is tied to; none where it is in its own frame.
    pub tied_to: Vec<String>,
    /// How well; `None` where it is in its own frame.
    pub fit: Option<MapFit>,
}

/// The map of a flight.
pub(super) struct DateMap {
    pub(super) date: String,
    pub(super) day: f64,
    pub(super) frame: Frame,
    pub(super) ortho: PathBuf,
    pub(super) reading: Reading,
    pub(super) mask: PathBuf,
    pub(super) place: Georeference,
    pub(super) gsd_m: f64,
    pub(super) size: (usize, usize),
    /// Plants that are sure, metres on the map.
    plants_m: Vec<[f64; 2]>,
    /// What decides orthomosaic, mask and plants.
    pub(super) key: String,
}

impl DateMap {
    /// The orthomosaic and leaf mask of a project.
    ///
    /// # Errors
    /// Where there are none, or the map has no place in metres.
    pub(super) fn of(
        project: &Project,
        date: &str,
        day: f64,
        frame: Frame,
    ) -> Result<DateMap, Error> {
        let (ortho, mask) = (project.orthomosaic()?, project.mask()?);
        let reading = project.reading(&ortho);
        let reader = Reader::open_with(&ortho, &reading)?;
        // Places of dates are compared on the map, so that its metres have to be those on the ground.
        let is_in_metres = |place: &Georeference| {
            let is_metre = place.crs.kind.metres_per_unit() == Some(1.0);
            is_metre && place.map_scale().is_some_and(|scale| (scale - 1.0).abs() < 1e-3)
        };
        let place = reader.georeference().filter(is_in_metres);
        let placed = place.and_then(|place| Some((place, place.gsd_m()?)));
        let (place, gsd_m) = placed.ok_or_else(|| {
            let message =
                "it has no place on the map in metres, so it cannot be compared with other dates";
            FileError::malformed(&ortho, None, message)
        })?;
        let key = |stage: Stage| {
            let record = project.records().read(stage);
            record.map(|record| record.key).unwrap_or_default()
        };
        let key = [Stage::Segment, Stage::Locate].map(key).concat();
        let size = (reader.width(), reader.height());
        let plants_m = sure_plants(project, &place)?;
        let date = date.to_owned();
        Ok(DateMap { date, day, frame, ortho, reading, mask, place, gsd_m, size, plants_m, key })
    }

    /// Whether it has red, green, blue and no other band: bytes of such a map are light by the curve of sRGB, others are reflectances.
    ///
    /// # Errors
    /// A map that cannot be read.
    pub(super) fn is_plain_rgb(&self) -> Result<bool, Error> {
        let roles = Reader::open_with(&self.ortho, &self.reading)?.filled_roles()?;
        let is_colour = |band: &Band| matches!(band, Band::Red | Band::Green | Band::Blue);
        let bands = roles.into_iter().flatten().filter(|band| *band != Band::Alpha);
        Ok(bands.clone().all(|band| is_colour(&band)) && bands.count() == 3)
    }

    /// Bounds on the map: lowest and highest of each axis, metres.
    fn bounds_m(&self) -> [[f64; 2]; 2] {
        let (w, h) = (self.size.0 as f64 - 1.0, self.size.1 as f64 - 1.0);
        let corners = [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]].map(|at| self.place.map(at));
        [0, 1].map(|axis| {
            let values = corners.iter().map(|corner| corner[axis]);
            values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| {
                [low.min(x), high.max(x)]
            })
        })
    }

    /// Features of a square of the map, `cell` times its side from the origin of the frame.
    fn features(&self, cell: [i64; 2], options: &SeasonOptions) -> Result<MapFeatures, Error> {
        let side = options.tile_m;
        let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
            .map(|c| [0, 1].map(|k| (cell[k] as f64 + c[k]) * side))
            .map(|at| self.place.pixel(at).unwrap_or([f64::NAN; 2]));
        let range = |axis: usize, size: usize| {
            let values = corners.iter().map(|corner| corner[axis]);
            let (low, high) =
                values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            // Conversions saturate, so a tile beyond the map is empty.
            let (low, high) =
                (low.floor().max(0.0) as usize, (high.ceil().max(0.0) as usize).min(size));
            low..high.max(low)
        };
        let (columns, rows) = (range(0, self.size.0), range(1, self.size.1));
        let window =
            Window { u: columns.start, v: rows.start, width: columns.len(), height: rows.len() };
        const LEAST_SIDE: usize = 32;
        if window.width < LEAST_SIDE || window.height < LEAST_SIDE {
            return Ok(MapFeatures::default());
        }
        let (picture, gaps) =
            Reader::open_with(&self.ortho, &self.reading)?.read_rgb_and_gaps(window)?;
        let leaf = Reader::open(&self.mask)?.read::<u8>(window)?;
        let usable: Vec<bool> = leaf
            .iter()
            .enumerate()
            .map(|(k, &leaf)| leaf == 0 && gaps.as_ref().is_none_or(|gaps| !gaps[k]))
            .collect();
        let [u, v] = [window.u as f64, window.v as f64];
        let place = Georeference { origin: self.place.map([u, v]), ..self.place };
        Ok(map_ties::features(&picture, &usable, &place, options.features_per_tile))
    }
}

/// The plants of a project that are more likely there than not, metres on the map.
fn sure_plants(project: &Project, place: &Georeference) -> Result<Vec<[f64; 2]>, FileError> {
    let Some(path) = project.finished(Stage::Locate, "plants.csv") else { return Ok(Vec::new()) };
    let table = CsvTable::read(&path)?;
    let Some(at) = table.pairs("u_px", "v_px") else { return Ok(Vec::new()) };
    let confidence = table.numbers("confidence").unwrap_or_else(|| vec![1.0; at.len()]);
    let sure = at.into_iter().zip(confidence).filter(|(_, confidence)| *confidence > 0.5);
    Ok(sure.map(|(at, _)| place.map(at)).collect())
}

/// Features of the tiles of all maps, made when they are first asked for.
#[derive(Default)]
struct Features(BTreeMap<(usize, [i64; 2]), MapFeatures>);

impl Features {
    fn tile(
        &mut self,
        maps: &[DateMap],
        map: usize,
        cell: [i64; 2],
        options: &SeasonOptions,
    ) -> Result<&MapFeatures, Error> {
        use std::collections::btree_map::Entry;
        Ok(match self.0.entry((map, cell)) {
            Entry::Occupied(kept) => kept.into_mut(),
            Entry::Vacant(place) => place.insert(maps[map].features(cell, options)?),
        })
    }
}

/// The tiles that two maps share, thinned evenly where there are too many.
fn shared_tiles(a: &DateMap, b: &DateMap, options: &SeasonOptions) -> Vec<[i64; 2]> {
    let (a, b) = (a.bounds_m(), b.bounds_m());
    let range = |axis: usize| {
        let low = a[axis][0].max(b[axis][0]) / options.tile_m;
        let high = a[axis][1].min(b[axis][1]) / options.tile_m;
        low.floor() as i64..=high.floor() as i64
    };
    let all: Vec<[i64; 2]> =
        range(0).flat_map(|column| range(1).map(move |row| [column, row])).collect();
    let step = all.len().div_ceil(options.tiles).max(1);
    all.into_iter().step_by(step).collect()
}

/// Places that two maps share, from the first to the second: plants, or where they do not tell, features of what does not grow.
fn ties(
    maps: &[DateMap],
    [from, to]: [usize; 2],
    features: &mut Features,
    options: &SeasonOptions,
) -> Result<Vec<MapTie>, Error> {
    let plants = plant_ties(&maps[from].plants_m, &maps[to].plants_m, options.search_m);
    if plants.len() >= map_transform::LEAST_TIES {
        return Ok(plants);
    }
    let mut alike = Vec::new();
    for cell in shared_tiles(&maps[from], &maps[to], options) {
        let own = features.tile(maps, from, cell, options)?.clone();
        if own.at_m.is_empty() {
            continue;
        }
        // Receivers disagree, so the place may lie in the next tile.
        let rings = (options.search_m / options.tile_m).ceil() as i64;
        let side = options.tile_m;
        let near = |at: &[f64; 2]| {
            (0..2).all(|k| {
                let low = cell[k] as f64 * side - options.search_m;
                (low..low + side + 2.0 * options.search_m).contains(&at[k])
            })
        };
        let mut other = MapFeatures::default();
        let mut bytes = Vec::new();
        for column in -rings..=rings {
            for row in -rings..=rings {
                let tile = features.tile(maps, to, [cell[0] + column, cell[1] + row], options)?;
                let chosen: Vec<usize> =
                    (0..tile.at_m.len()).filter(|&k| near(&tile.at_m[k])).collect();
                other.at_m.extend(chosen.iter().map(|&k| tile.at_m[k]));
                bytes.extend_from_slice(tile.descriptors.select(&chosen).as_bytes());
            }
        }
        if let Some(descriptors) = rowgram_survey::features::Descriptors::from_bytes(bytes) {
            other.descriptors = descriptors;
            alike.extend(map_ties::alike(&own, &other));
        }
    }
    alike.retain(|tie| {
        let [dx, dy] = [0, 1].map(|k| tie.to_m[k] - tie.from_m[k]);
        dx.hypot(dy) <= options.search_m
    });
    let gsd_m = maps[from].gsd_m.max(maps[to].gsd_m);
    Ok(map_ties::consistent(&alike, options.tolerance_px * gsd_m, options.seed))
}

/// Whether all maps have one reference system: their places are compared as numbers.
///
/// # Errors
/// Names the map of another one.
pub(super) fn check_systems(maps: &[DateMap]) -> Result<(), FileError> {
    let Some((first, others)) = maps.split_first() else { return Ok(()) };
    for other in others {
        let (own, of_first) = (&other.place, &first.place);
        if !is_same_frame(own, of_first) {
            let name = |place: &Georeference| {
                let system = place.crs.system();
                system.map_or("no stated system".to_owned(), |system| system.name().to_owned())
            };
            let message = format!(
                "it is in {}, the map of {} in {}: expected all maps of a season in one reference system; bring them into one ([project] crs, or gdalwarp for a given map)",
                name(own),
                first.date,
                name(of_first)
            );
            return Err(FileError::malformed(&other.ortho, None, message));
        }
    }
    Ok(())
}

/// Whether numbers of two maps mean the same places, as far as their systems are known.
fn is_same_frame(own: &Georeference, other: &Georeference) -> bool {
    // Systems that differ in name only agree to rounding.
    const SAME_M: f64 = 0.01;
    let [x, y] = own.origin;
    let moved = Transfer::between(&own.crs, &other.crs).at([x, y]);
    moved.is_some_and(|at| (at[0] - x).hypot(at[1] - y) < SAME_M)
}

/// Places every map; `None` for one that shares too little with the others.
///
/// # Errors
/// Maps that cannot be read.
pub(super) fn place(
    maps: &[DateMap],
    options: &SeasonOptions,
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Option<Placement>>, Error> {
    let own = || Placement { transform: MapTransform::IDENTITY, tied_to: Vec::new(), fit: None };
    let mut placed: Vec<Option<Placement>> =
        maps.iter().map(|map| (map.frame == Frame::Own).then(own)).collect();
    if placed.iter().all(Option::is_none)
        && let Some(first) = placed.first_mut()
    {
        *first = Some(own());
        let message = "no flight has ground control: the first one gives the frame of the season";
        monitor.diagnostic(
            &Diagnostic::info("season-without-control", &maps[0].date, message).with_remedy(
                "coordinates are as good as its receiver; add ground control to one flight",
            ),
        );
    }
    let waiting = placed.iter().filter(|placed| placed.is_none()).count();
    let mut features = Features::default();
    let mut failed = vec![false; maps.len()];
    let mut notes = Vec::new();
    {
        let counter = Counter::new(monitor, "tying dates", waiting, "flights");
        while let Some(next) = nearest_in_time(maps, &placed, &failed) {
            let mut near: Vec<usize> = (0..maps.len()).filter(|&k| placed[k].is_some()).collect();
            let apart = |k: usize| (maps[k].day - maps[next].day).abs();
            near.sort_by(|&a, &b| apart(a).total_cmp(&apart(b)).then(a.cmp(&b)));
            near.truncate(NEIGHBOURS);
            let (mut all, mut tied_to) = (Vec::new(), Vec::new());
            for other in near {
                let found = kept_ties(maps, [next, other], &mut features, options, store)?;
                if let Some(placement) =
                    placed[other].as_ref().filter(|_| found.len() >= map_transform::LEAST_TIES)
                {
                    let into =
                        |tie: MapTie| MapTie { to_m: placement.transform.apply(tie.to_m), ..tie };
                    all.extend(found.into_iter().map(into));
                    tied_to.push(maps[other].date.clone());
                }
            }
            match map_transform::fit(&all) {
                Some(fit) => {
                    placed[next] =
                        Some(Placement { transform: fit.transform, tied_to, fit: Some(fit) });
                }
                None => {
                    failed[next] = true;
                    let message = format!(
                        "its map shares only {} places with the flights before and after, too few to bring it into their frame",
                        all.len()
                    );
                    notes.push(
                        Diagnostic::warning("season-not-tied", &maps[next].date, message).with_remedy(
                            "raise search_m in [season] where receivers disagree by more, fly at dates between, or add ground control",
                        ),
                    );
                }
            }
            counter.tick();
        }
    }
    notes.iter().for_each(|note| monitor.diagnostic(note));
    Ok(placed)
}

/// The map without a place that is nearest in time to one that has it.
fn nearest_in_time(
    maps: &[DateMap],
    placed: &[Option<Placement>],
    failed: &[bool],
) -> Option<usize> {
    let apart = |k: usize| {
        let others = (0..maps.len()).filter(|&other| placed[other].is_some());
        others.map(|other| (maps[k].day - maps[other].day).abs()).fold(f64::INFINITY, f64::min)
    };
    let waiting = (0..maps.len()).filter(|&k| placed[k].is_none() && !failed[k]);
    waiting.min_by(|&a, &b| apart(a).total_cmp(&apart(b)).then(a.cmp(&b)))
}

/// As [`ties`], kept until one of the maps or an option changes.
fn kept_ties(
    maps: &[DateMap],
    pair: [usize; 2],
    features: &mut Features,
    options: &SeasonOptions,
    store: &Store,
) -> Result<Vec<MapTie>, Error> {
    let [from, to] = pair.map(|k| &maps[k]);
    let options_text = serde_json::to_string(options).unwrap_or_default();
    let key = Key::begin().text(&from.key).text(&to.key).text(&options_text).finish();
    let name = format!("ties-{}--{}", from.date, to.date);
    let is_known = !from.key.is_empty() && !to.key.is_empty();
    if let Some(kept) = store.load(&name, key).filter(|_| is_known) {
        return Ok(kept);
    }
    let found = ties(maps, pair, features, options)?;
    store.save(&name, key, &found)?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::georeference::Crs;

    #[test]
    fn maps_of_other_systems_have_other_frames() {
        let map =
            |epsg| Georeference::north_up([500_000.0, 5_300_000.0], 0.01, Crs::projected(epsg));
        assert!(is_same_frame(&map(32632), &map(32632)));
        assert!(!is_same_frame(&map(32632), &map(32633)));
        let local = Georeference { crs: Crs::LOCAL, ..map(32632) };
        assert!(is_same_frame(&local, &map(32632)), "a system that is not stated is not refused");
    }
}
