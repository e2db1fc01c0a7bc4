//! The stand of a field whose plants are told by their leaf mass: young crops, broadcast crops, trees.
//!
//! The plants are those of [`plant_mass`](super::plant_mass); nothing of that needs rows. Where the photo shows rows, each plant belongs
//! to the nearest, and the gaps between neighbours give the spacing and the places where plants are missing. Rows are
//! looked for twice: in the leaf mask, and in the plants, where a thin plant counts as much as a thick one; the rows that
//! hold more of the plants than chance does are taken.
//!
//! Where there are rows, components whose plants all grow between them are weeds, more probably than not ([`row_membership`](super::row_membership)):
//! they are left out, and everything is done again without them.
//!
//! What carries over to the row model is the share of the rows that is covered by leaf ([`covered`]): the mass of a
//! component tells the number of its plants as long as there is soil between components.

use super::{
    broad_leaves,
    isolated_plants::covered_share,
    plant_mass::{MassCount, Parts, Plant},
    plant_spacing::Spacing,
    row_membership::RowMembership,
    row_parts::is_alley,
    row_peaks,
    rows::{self, Detection, Rows},
    rows_of_plants::{LONE_ROW_HALF_WIDTH, rows_of},
    stand::{BETWEEN, BetweenRows, Gap, LEAST_MISSING, LeafMass, Stalk, Stand, Weed},
};
use crate::score::tree::Tree;
use rowgram_optim::robust::median;
use rowgram_raster::Mask;

/// The smallest components with this share of the leaf mass are left out when the covered share of rows is measured: specks of residue
/// cover soil and have next to no mass.
const SPECKS: f64 = 0.05;
/// Rows are closed from this share of their length on that is covered by leaf: 25 photos of young maize have 0.51
/// to 0.69, synthetic masks from the first leaves at 20 cm on 0.85 and more.
const CLOSED: f64 = 0.78;
/// Closed rows are this many times longer than they are apart; shorter ones may be plants.
const LONG: f64 = 3.0;
/// Gaps longer than this many spacings may be alleys: as many as the bare stretch at which closed rows are cut (`row_parts`).
const LONG_GAP: f64 = 4.0;
/// Standard deviation of a place along each axis, in square roots of a plant's mass: of a plant alone in its component, and of each of
/// several. Found 0.11 to 0.15 and 0.10 to 0.23 on maize plots, seedling clips and maize on straw, a shift common to the photos of
/// a set left out.
const PLACE: (f64, f64) = (0.14, 0.20);

/// Share of weeds between the rows among all plants above which votes along leaf axes tell crop from weeds better than mass: on synthetic
/// seedlings with 1, 2 and 5 weeds per square metre (an eighth to half of all plants), number not told, F1 is 0.96, 0.96 and 0.86
/// instead of 0.91, 0.79 and 0.64 (the fields of `experiments/specs/locate-weeds.toml`, seeds 1 to 6, method `row-model-auto`).
const WEEDY: f64 = 0.1;
/// Plants in the rows, at least, from which votes learn the spacing and what is usual of a plant: in a synthetic field of 46 plants amid
/// weeds they found 57, mass 48 (second date of `rowgram synth season --preset tiny`).
const LEAST_CROP: usize = 60;
/// Counts by mass and by votes contradict each other from this ratio on: halfway, by ratios, between agreement and a double.
const CONTRADICTS: f64 = std::f64::consts::SQRT_2;
/// From this covered share on neighbours touch so often that two plants may pass for the usual one: on the last date of `rowgram synth season`
/// (less than 0.78) mass counts 174 of 340 plants, votes 353. Not searched for: only counts that contradict each other depend on it.
const HALF_CLOSED: f64 = 0.5;

/// From this share of missing and double plants on components may be leaves: 14 plots of beans have 0.35 to 0.70, 100 maize plots 0.34 at most, all but two
/// of 50 seedling clips 0.34 at most. Chosen with the beans in view.
const MIN_IRREGULAR: f64 = 0.345;
/// Plants are peaks of leaf where those have this share of the missing and double plants, at most, that components have: on 14 plots of beans 0.36
/// to 0.77; in sparse sorghum, whose plants are components, 0.87 to 0.93. Chosen between these two, so neither is a set left out.
const MAX_IRREGULAR_RATIO: f64 = 0.8;

/// The share of the rows that leaves cover, of rows that may be closed.
fn covered(parts: &Parts<'_>, detection: &Detection) -> f64 {
    let Some(rows) = detection.rows() else { return 0.0 };
    let longest = rows.rows.iter().map(|row| row.length_px()).fold(0.0, f64::max);
    let is_long = rows.spacing_px.is_none_or(|spacing| longest > LONG * spacing);
    if is_long { covered_share(&parts.without_smallest(SPECKS), rows) } else { 0.0 }
}

/// What the leaf mass of a mask says.
pub(super) enum ByMass {
    /// Its plants.
    Found(Box<Stand>),
    /// Nothing: leaves have closed along rows, or the number of plants that was told says that many have merged.
    Nothing,
    /// What mass says may be wrong, and votes along the axes of blades can tell.
    Doubtful(Box<Doubtful>),
}

/// A field that mass may count wrongly.
pub(super) struct Doubtful {
    /// Its mask without the weeds between the rows, and the rows of that; nothing where none were left out.
    pub(super) crop: Option<(Mask, Detection)>,
    /// What mass says.
    pub(super) by_mass: Stand,
    /// Weeds grow between the rows in such numbers that many must grow within them, too, which mass does not tell from the crop.
    is_weedy: bool,
    /// Leaves cover so much of the rows that two plants may pass for one.
    is_half_closed: bool,
}

impl Doubtful {
    /// Whether so many plants, found by votes along leaf axes, are nearer to the truth. A spacing that is a half or a double of the true
    /// one stands out even where weeds within rows are counted, and only plants that have merged make a double of the mass.
    pub(super) fn prefers(&self, plants: usize) -> bool {
        let ratio = plants as f64 / self.by_mass.plants.len().max(1) as f64;
        let agrees = (1.0 / CONTRADICTS..=CONTRADICTS).contains(&ratio);
        let are_merged = self.is_half_closed && plants >= LEAST_CROP && ratio > CONTRADICTS;
        self.is_weedy && agrees || are_merged
    }
}

/// The plants of a mask by their mass: `count` of them, or as many as there seem to be.
/// `posterior` is the probability of vegetation of each pixel in 1/255, where it is known.
pub(super) fn locate(
    mask: &Mask,
    posterior: Option<&[u8]>,
    detection: &Detection,
    count: Option<usize>,
) -> ByMass {
    let mut parts = Parts::new(mask, posterior);
    let share = covered(&parts, detection);
    if share >= CLOSED {
        return ByMass::Nothing;
    }
    // Weeds are told among as many plants as there seem to be.
    let without_specks;
    let seen = match detection {
        Detection::Found(_) => detection,
        // Noise all over a photo hides faint rows.
        Detection::NoRows { .. } => {
            without_specks = rows::detect(&parts.without_smallest(SPECKS));
            &without_specks
        }
    };
    let (found, rows) = count_in_rows(mask, &mut parts, seen);
    let left_out = LeftOut { specks: parts.specks(), weeds: weeds(&found.plants, &rows) };
    if !left_out.weeds.is_empty() {
        let crop = parts.mask_of(|part| left_out.weeds.iter().all(|weed| weed.component != part));
        let detection = rows::detect(&crop);
        let mut parts = Parts::new(&crop, posterior);
        let share = covered(&parts, &detection);
        if share >= CLOSED {
            return ByMass::Nothing;
        }
        let (all, weeds) = (found.plants.len(), left_out.weeds.len());
        let is_weedy = weeds as f64 > WEEDY * all as f64 && all - weeds >= LEAST_CROP;
        let (found, rows) = count_in_rows(&crop, &mut parts, &detection);
        if is_merged(&found, count, share) {
            return ByMass::Nothing;
        }
        let found = if count.is_some() { parts.count(count) } else { found };
        let middle_px = parts.middle_px();
        drop(parts);
        let by_mass = plants_or_leaves(&crop, found, rows, count, left_out, middle_px);
        let crop = Some((crop, detection));
        return judged(mask, by_mass, crop, (is_weedy, share), count);
    }
    if is_merged(&found, count, share) {
        return ByMass::Nothing;
    }
    let found = if count.is_some() { parts.count(count) } else { found };
    let by_mass = plants_or_leaves(mask, found, rows, count, left_out, parts.middle_px());
    judged(mask, by_mass, None, (false, share), count)
}

/// As many plants as there seem to be, and their rows; where there are rows, plants are told by how long components are along them.
fn count_in_rows(mask: &Mask, parts: &mut Parts<'_>, seen: &Detection) -> (MassCount, Rows) {
    let found = parts.count(None);
    let rows = rows_of(mask, &found.plants, found.plant_px, seen);
    if rows.rows.is_empty() {
        return (found, rows);
    }
    parts.stand_along(rows.axes.heading_rad);
    (parts.count(None), rows)
}

/// Whether so many plants were told that two or more of them pass for one.
fn is_merged(found: &MassCount, count: Option<usize>, share: f64) -> bool {
    let most = CONTRADICTS * found.plants.len() as f64;
    share >= HALF_CLOSED && count.is_some_and(|count| count as f64 > most)
}

/// What mass says, with what may be wrong about it. Round leaves have no axes that could tell.
fn judged(
    mask: &Mask,
    by_mass: Stand,
    crop: Option<(Mask, Detection)>,
    (is_weedy, share): (bool, f64),
    count: Option<usize>,
) -> ByMass {
    let has_rows = crop.as_ref().is_none_or(|(_, detection)| detection.rows().is_some());
    let is_half_closed = count.is_none() && share >= HALF_CLOSED;
    let leaves = crop.as_ref().map_or(mask, |(crop, _)| crop);
    if has_rows && (is_weedy || is_half_closed) && !broad_leaves::is_broad(leaves) {
        return ByMass::Doubtful(Box::new(Doubtful { crop, by_mass, is_weedy, is_half_closed }));
    }
    ByMass::Found(Box::new(by_mass))
}

/// Leaf that belongs to no plant of the crop.
#[derive(Clone)]
struct LeftOut {
    /// Masses and middles of components too small to be plants.
    specks: Vec<(f64, [f64; 2])>,
    /// Plants between the rows.
    weeds: Vec<Plant>,
}

impl LeftOut {
    /// Leaf pixels of the weeds.
    fn weeds_px(&self) -> f64 {
        self.weeds.iter().map(|weed| weed.mass_px).sum()
    }

    fn weeds(&self) -> Vec<Weed> {
        let weed = |of: &Plant| Weed { position_px: [of.u_px, of.v_px], leaf_px: of.mass_px };
        self.weeds.iter().map(weed).collect()
    }
}

/// The plants of components in which all plants grow between the rows; none where rows say nothing.
fn weeds(plants: &[Plant], rows: &Rows) -> Vec<Plant> {
    let place = |plant: &Plant| rows.axes.aligned([plant.u_px, plant.v_px]);
    let places: Vec<[f64; 2]> = plants.iter().map(place).collect();
    let Some(membership) = RowMembership::fit(rows, &places) else { return Vec::new() };
    let order = (0..plants.len()).collect::<Vec<usize>>();
    let components = order.chunk_by(|&a, &b| plants[a].component == plants[b].component);
    let are_weeds = components
        .filter(|members| members.iter().all(|&k| membership.probability(places[k]) < 0.5));
    are_weeds.flatten().map(|&k| plants[k]).collect()
}

/// The stand of what was found by mass; or, where no crop stands like that and peaks of leaf along the rows are likelier to be plants, of those.
fn plants_or_leaves(
    mask: &Mask,
    found: MassCount,
    rows: Rows,
    count: Option<usize>,
    left_out: LeftOut,
    middle_px: f64,
) -> Stand {
    let by_mass = stand(mask, found, rows, count, left_out.clone());
    let irregular = |stand: &Stand| stand.spacing.missing + stand.spacing.doubles;
    if irregular(&by_mass) < MIN_IRREGULAR {
        return by_mass;
    }
    let rows = by_mass.rows.clone();
    let peaks = row_peaks::locate(mask, &rows, band_px(&rows, middle_px), middle_px, count);
    let Some(peaks) = peaks else { return by_mass };
    let by_peaks = stand(mask, peaks, rows, count, left_out);
    if irregular(&by_peaks) < MAX_IRREGULAR_RATIO * irregular(&by_mass) {
        by_peaks
    } else {
        by_mass
    }
}

/// The stand of plants that were found by their mass in a mask, in their rows.
fn stand(
    mask: &Mask,
    found: MassCount,
    rows: Rows,
    count: Option<usize>,
    left_out: LeftOut,
) -> Stand {
    let plant_px = found.plant_px;
    let [low, high] = match count {
        Some(count) => [count as f64; 2],
        None => found.interval(),
    };
    let weeds_px = left_out.weeds_px();
    let leaf = mask.count() as f64 + weeds_px;
    let mut stand = Stand {
        plants: Vec::new(),
        spacing: Spacing::new(nearest_px(&found.plants).unwrap_or(plant_px.sqrt())),
        spacing_sigma_px: 0.0,
        count_interval: [low, high],
        row_counts: vec![0.0; rows.rows.len()],
        row_count_sigmas: vec![0.0; rows.rows.len()],
        missing: Vec::new(),
        rows,
        leaf_mass: None,
        between_rows: None,
        doubts: Vec::new(),
        perspective: None,
    };
    let relative = found.sigma / found.expected.max(1.0);
    let (mut between_px, size) = (weeds_px, plant_px.sqrt());
    for plant in &found.plants {
        let position_px = [plant.u_px, plant.v_px];
        let [along_px, across_px] = stand.rows.axes.aligned(position_px);
        let (row, away_px) = stand.rows.nearest(across_px).unwrap_or((0, 0.0));
        if away_px > band_px(&stand.rows, plant_px) {
            between_px += plant.mass_px;
        }
        if let Some(count) = stand.row_counts.get_mut(row) {
            *count += plant.expected;
            stand.row_count_sigmas[row] += plant.variance;
        }
        let sigma_px = size * if plant.in_component > 1 { PLACE.1 } else { PLACE.0 };
        stand.plants.push(Stalk {
            position_px,
            row,
            along_px,
            confidence: plant.confidence,
            sigma_along_px: sigma_px,
            sigma_across_px: sigma_px,
        });
    }
    for (sigma, count) in stand.row_count_sigmas.iter_mut().zip(&stand.row_counts) {
        // What the model does not know is common to the field, at least.
        *sigma = (*sigma + (relative * count).powi(2)).sqrt();
    }
    stand.plants.sort_by(|a, b| a.row.cmp(&b.row).then(a.along_px.total_cmp(&b.along_px)));
    find_gaps(&mut stand);
    stand.between_rows = (!stand.rows.rows.is_empty())
        .then(|| BetweenRows { leaf_share: between_px / leaf.max(1.0), weeds: left_out.weeds() });
    stand.leaf_mass = Some(LeafMass {
        plant_px,
        unexplained: found.unexplained,
        specks_px: left_out.specks.into_iter().map(|(_, at)| at).collect(),
    });
    stand
}

/// The spacing within rows, its standard error, and the gaps in which plants are missing.
fn find_gaps(stand: &mut Stand) {
    let pairs = || stand.plants.windows(2).filter(|pair| pair[0].row == pair[1].row);
    if stand.rows.rows.is_empty() {
        return;
    }
    let gaps: Vec<f64> = pairs().map(|pair| pair[1].along_px - pair[0].along_px).collect();
    let Some(middle) = median(gaps.iter().copied()) else { return };
    let mut spacing = Spacing::new(middle);
    for _ in 0..4 {
        spacing = spacing.refit(&gaps);
    }
    let mut along: Vec<Vec<f64>> = vec![Vec::new(); stand.rows.rows.len()];
    for plant in &stand.plants {
        along[plant.row].push(plant.along_px);
    }
    let missing: Vec<Gap> = pairs()
        .filter_map(|pair| {
            let row = pair[0].row;
            let ends = [pair[0].along_px, pair[1].along_px];
            let length_px = ends[1] - ends[0];
            if length_px > LONG_GAP * spacing.spacing && is_alley_between(&along, row, ends) {
                return None;
            }
            let (plants, probability) = spacing.missing_plants(length_px);
            let position_px =
                [0, 1].map(|k| 0.5 * (pair[0].position_px[k] + pair[1].position_px[k]));
            let gap = Gap { row, position_px, length_px, plants, probability };
            (probability > LEAST_MISSING).then_some(gap)
        })
        .collect();
    stand.spacing_sigma_px = spacing.jitter * spacing.spacing / (gaps.len() as f64).sqrt();
    stand.spacing = spacing;
    stand.missing = missing;
}

/// Whether the rows beside have no plants in the middle half of a gap either. `along` has the places of each row's plants.
fn is_alley_between(along: &[Vec<f64>], row: usize, [from, to]: [f64; 2]) -> bool {
    let (middle, quarter) = (0.5 * (from + to), 0.25 * (to - from));
    let first_behind = |row: usize, at: f64| along[row].partition_point(|&place| place < at);
    let reaches = |row: usize| (1..along[row].len()).contains(&first_behind(row, middle));
    let is_bare = |row| first_behind(row, middle - quarter) == first_behind(row, middle + quarter);
    is_alley(along.len(), row, reaches, is_bare)
}

pub(super) fn band_px(rows: &Rows, plant_px: f64) -> f64 {
    rows.spacing_px.map_or(LONE_ROW_HALF_WIDTH * plant_px.sqrt(), |spacing| BETWEEN * spacing)
}

/// The middle distance to the nearest plant.
fn nearest_px(plants: &[Plant]) -> Option<f64> {
    let places: Vec<[f64; 2]> = plants.iter().map(|plant| [plant.u_px, plant.v_px]).collect();
    let tree = Tree::new(&places);
    let of = |k: usize| tree.nearest(&places, places[k], Some(k)).map(|(_, distance)| distance);
    // Some of the plants tell enough.
    median((0..plants.len()).step_by(plants.len().div_ceil(500).max(1)).filter_map(of))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::row_model::{self, RowModelOptions};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Plants in rows, every second row of half the size; and weeds anywhere.
    fn field(seed: u64, weeds: usize) -> (Mask, Vec<[f64; 3]>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut plants = Vec::new();
        for row in 0..7 {
            let radius = if row % 2 == 0 { 11.0 } else { 8.5 };
            for k in 0..18 {
                let mut jitter = |by: f64| by * (rng.random::<f64>() - 0.5);
                let at = [40.0 + 40.0 * f64::from(k) + jitter(10.0), 60.0 + 90.0 * f64::from(row)];
                plants.push([at[0], at[1] + jitter(6.0), radius]);
            }
        }
        let mut all = plants.clone();
        all.extend(
            (0..weeds).map(|_| [760.0 * rng.random::<f64>(), 650.0 * rng.random::<f64>(), 3.0]),
        );
        let mask = Mask::from_fn(760, 650, |u, v| {
            all.iter().any(|p| (u as f64 - p[0]).hypot(v as f64 - p[1]) < p[2])
        });
        (mask, plants)
    }

    fn find(mask: &Mask, count: Option<usize>) -> Option<Stand> {
        let detection = rows::detect(mask);
        match locate(mask, None, &detection, count) {
            ByMass::Found(stand) => Some(*stand),
            ByMass::Nothing | ByMass::Doubtful(..) => None,
        }
    }

    #[test]
    fn alternately_thin_rows_are_all_found_and_specks_are_not_plants() {
        for weeds in [0, 60] {
            let (mask, plants) = field(1, weeds);
            let stand = find(&mask, None).unwrap();
            let n = plants.len() as f64;
            assert!((stand.plants.len() as f64 / n - 1.0).abs() < 0.04, "{}", stand.plants.len());
            assert_eq!(stand.rows.rows.len(), 7, "{weeds}");
            assert!((stand.rows.spacing_px.unwrap() - 90.0).abs() < 2.0);
            assert!((stand.spacing.spacing - 40.0).abs() < 2.0, "{:?}", stand.spacing);
            let mass = stand.leaf_mass.unwrap();
            assert_eq!(mass.specks_px.is_empty(), weeds == 0);
        }
    }

    #[test]
    fn weeds_between_the_rows_are_left_out_and_told() {
        let (mask, plants) = field(1, 0);
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        // As large as plants, in the middle third between two rows.
        let mut weeds: Vec<[f64; 2]> = Vec::new();
        while weeds.len() < 60 {
            let row = f64::from(rng.random_range(0..6u8));
            let across = 60.0 + 90.0 * (row + rng.random_range(0.35..0.65));
            let at = [rng.random_range(20.0..740.0), across];
            if weeds.iter().all(|w| (w[0] - at[0]).hypot(w[1] - at[1]) > 24.0) {
                weeds.push(at);
            }
        }
        let weedy = Mask::from_fn(760, 650, |u, v| {
            mask.get(u, v) || weeds.iter().any(|w| (u as f64 - w[0]).hypot(v as f64 - w[1]) < 9.0)
        });
        let detection = rows::detect(&weedy);
        let share = 1.0 - mask.count() as f64 / weedy.count() as f64;
        for count in [None, Some(plants.len())] {
            // So many that mass would not tell the crop from weeds within rows; but discs have no axes to vote along.
            let ByMass::Found(stand) = locate(&weedy, None, &detection, count) else { panic!() };
            let n = plants.len() as f64;
            assert!((stand.plants.len() as f64 / n - 1.0).abs() < 0.04, "{}", stand.plants.len());
            assert!((stand.spacing.spacing - 40.0).abs() < 2.0, "{:?}", stand.spacing);
            let between = stand.between_rows.unwrap();
            assert_eq!(between.weeds.len(), weeds.len(), "{count:?}");
            assert!((between.leaf_share - share).abs() < 0.02);
        }
        // The same, of so few pixels that the shape of leaves cannot be told.
        let small = Mask::from_fn(760 / 4, 650 / 4, |u, v| weedy.get(4 * u + 2, 4 * v + 2));
        let detection = rows::detect(&small);
        let stand =
            row_model::locate(&small, &detection, None, &RowModelOptions::default()).unwrap();
        let n = plants.len() as f64;
        assert!((stand.plants.len() as f64 / n - 1.0).abs() < 0.06, "{}", stand.plants.len());
        // A few.
        let few = &weeds[..10];
        let weedy = Mask::from_fn(760, 650, |u, v| {
            mask.get(u, v) || few.iter().any(|w| (u as f64 - w[0]).hypot(v as f64 - w[1]) < 9.0)
        });
        for count in [None, Some(plants.len())] {
            let stand = find(&weedy, count).unwrap();
            let n = plants.len() as f64;
            assert!((stand.plants.len() as f64 / n - 1.0).abs() < 0.04, "{}", stand.plants.len());
            let between = stand.between_rows.unwrap();
            assert_eq!(between.weeds.len(), few.len(), "{count:?}");
            let leaf_px: f64 = between.weeds.iter().map(|weed| weed.leaf_px).sum();
            let expected_px = (weedy.count() - mask.count()) as f64;
            assert!((leaf_px / expected_px - 1.0).abs() < 0.02, "{leaf_px} for {expected_px}");
            let share = 1.0 - mask.count() as f64 / weedy.count() as f64;
            assert!((between.leaf_share - share).abs() < 0.02, "{between:?}");
        }
    }

    #[test]
    fn plants_without_rows_few_plants_and_a_given_number() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for count in [1, 2, 3, 60] {
            let mut places: Vec<[f64; 2]> = Vec::new();
            while places.len() < count {
                let at = [0, 1].map(|_| 20.0 + 460.0 * rng.random::<f64>());
                if places.iter().all(|p| (p[0] - at[0]).hypot(p[1] - at[1]) > 32.0) {
                    places.push(at);
                }
            }
            let mask = Mask::from_fn(500, 500, |u, v| {
                places.iter().any(|p| (u as f64 - p[0]).hypot(v as f64 - p[1]) < 12.0)
            });
            let stand = find(&mask, None).unwrap();
            assert_eq!(stand.plants.len(), count);
            assert!(stand.rows.rows.is_empty() || count > 3, "{:?}", stand.rows);
            assert_eq!(find(&mask, Some(count + 2)).unwrap().plants.len(), count + 2);
        }
    }

    #[test]
    fn plants_exactly_in_line_are_a_row() {
        let mask = Mask::from_fn(400, 80, |u, v| {
            (0..12).any(|k| (u as f64 - 30.0 - 30.0 * f64::from(k)).hypot(v as f64 - 40.0) < 7.0)
        });
        let stand = find(&mask, None).unwrap();
        assert_eq!((stand.plants.len(), stand.rows.rows.len()), (12, 1));
        assert!((stand.spacing.spacing - 30.0).abs() < 0.5, "{:?}", stand.spacing);
    }

    #[test]
    fn next_to_nothing_and_full_cover_have_an_answer() {
        let full = find(&Mask::from_fn(120, 90, |_, _| true), None).unwrap();
        assert_eq!((full.plants.len(), full.rows.rows.len()), (1, 0));
        assert!(full.plants[0].position_px.iter().all(|x| x.is_finite()));
        let none = find(&Mask::empty(50, 40), None).unwrap();
        assert_eq!((none.plants.len(), none.count_interval), (0, [0.0; 2]));
        // Dust on bare soil is no plant: components of 1 to 3 pixels.
        let dust = find(&Mask::from_fn(200, 100, |u, v| u % 17 < 2 && v % 13 == 0), None).unwrap();
        assert_eq!(dust.plants.len(), 0);
        assert_eq!(dust.leaf_mass.unwrap().unexplained, 1.0);
    }

    #[test]
    fn closed_rows_are_left_to_the_row_model() {
        let mask = Mask::from_fn(600, 400, |u, v| {
            let edge = 22.0 + 4.0 * (u as f64 / 9.0).sin();
            (0..4).any(|row| (v as f64 - 50.0 - 100.0 * f64::from(row)).abs() < edge) && u % 97 != 0
        });
        assert!(find(&mask, None).is_none());
    }
}
