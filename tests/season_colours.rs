//! One scale of colours over the dates of a season: maps of the twin from straight above under different light, without and with panels.

use crate::maps;
use data_synth::{
    camera::CameraConfig,
    panels::PanelConfig,
    photo::ImageConfig,
    season_plan::{SeasonConfig, SeasonPreset},
};
use rowgram::{
    monitor::{Collector, Silent},
    pipeline::season::{self, ColourSource, SeasonFile, SeasonOutcome},
    raster::georeference::{Crs, Georeference},
};
use serde_json::json;
use std::{fs, path::Path};

/// Side of the maps, and of their pixels.
const SIDE_PX: u32 = 760;
const GSD_M: f64 = 0.012;
/// A height from which everything is seen from straight above.
const HEIGHT_M: f64 = 40.0;

/// Writes a season of maps into a folder; gives the light of each date.
fn write(root: &Path) -> Vec<[f64; 3]> {
    let mut config = SeasonConfig::preset(SeasonPreset::Tiny);
    (config.light_spread, config.cast_spread, config.height_spread) = (0.2, 0.1, 0.0);
    let twin = &mut config.twin;
    twin.panels = PanelConfig { size_m: 0.5, green_plate: true };
    let camera = CameraConfig::compact(SIDE_PX, SIDE_PX, HEIGHT_M / GSD_M);
    twin.camera = CameraConfig { xp_px: 0.0, yp_px: 0.0, ..camera };
    (twin.flight.height_m, twin.targets.control, twin.targets.check) = (HEIGHT_M, 0, 0);
    let image = &mut twin.image;
    (image.exposure_spread, image.white_balance_spread, image.vignetting) = (0.0, 0.0, 0.0);
    *image = ImageConfig { motion_blur: false, ..image.clone() };
    let epsg = twin.site.epsg;
    let mut list = "plots = \"plots.geojson\"\npanels = \"panels.geojson\"\n".to_owned();
    let mut light = Vec::new();
    for k in 0..config.days.len() {
        let twin = config.flight(k).unwrap().build().unwrap();
        light.push(twin.config.image.level_light());
        let mut shot = twin.shots[0].clone();
        (shot.centre_m, shot.readout_s, shot.light) = ([0.0, 0.0, HEIGHT_M], 0.0, 1.0);
        shot.rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let photo = twin.studio().photo(&shot, k);
        let half_m = 0.5 * f64::from(SIDE_PX - 1) * GSD_M;
        let [e, n, _] = twin.site.grid_m([-half_m, half_m, 0.0]);
        let date = config.date(k);
        let folder = root.join(&date);
        fs::create_dir(&folder).unwrap();
        let place = Georeference::north_up([e, n], GSD_M, Crs::projected(epsg));
        maps::write(&folder.join("ortho.tif"), &photo.image, place);
        list += &format!("[[flights]]\nproject = \"{date}\"\ndate = \"{date}\"\nframe = \"own\"\n");
        if k > 0 {
            continue;
        }
        let feature = |name: &str, corners: Vec<[f64; 2]>, colour: [f64; 3]| {
            let mut ring: Vec<[f64; 2]> = corners
                .into_iter()
                .map(|[x, y]| twin.site.grid_m([x, y, 0.0]))
                .map(|[e, n, _]| [e, n])
                .collect();
            ring.push(ring[0]);
            json!({
                "type": "Feature",
                "properties": {"name": name, "red": colour[0], "green": colour[1], "blue": colour[2]},
                "geometry": {"type": "Polygon", "coordinates": [ring]},
            })
        };
        let collection = |features| maps::collection(Some(epsg), features);
        let panels = &twin.field().panels;
        let ring = |k: usize| panels[k].shrunk(0.7).map(|[x, y, _]| [x, y]).to_vec();
        let panel = |k: usize| feature(panels[k].name, ring(k), panels[k].reflectance);
        // The green one is no panel but a plot that does not grow; so is ground beyond the other end of the rows.
        let all = [0, 1, 2].map(panel).to_vec();
        fs::write(root.join("panels.geojson"), collection(all)).unwrap();
        let field = &twin.field().config;
        let soil = [[3.0, -1.0], [3.8, -1.0], [3.8, 1.0], [3.0, 1.0]];
        let soil = soil.map(|[along, across]| field.ground(along, across)).to_vec();
        let plots = vec![feature("green", ring(3), [0.1; 3]), feature("soil", soil, [0.1; 3])];
        fs::write(root.join("plots.geojson"), collection(plots)).unwrap();
    }
    fs::write(root.join("season.toml"), list).unwrap();
    light
}

fn run(root: &Path, change: impl Fn(String) -> String) -> SeasonOutcome {
    let path = root.join("season.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, change(text.clone())).unwrap();
    let file = SeasonFile::read(&path).unwrap();
    fs::write(&path, text).unwrap();
    let settings = [
        "stages.skip=[\"leaves\", \"leaf-count\"]",
        "plots.indices=[\"green_share = green / (red + green + blue)\"]",
    ];
    let settings = settings.map(str::to_owned);
    let mut monitor = Collector::default();
    let outcome = season::season(&file, &[], &settings, false, &mut monitor).unwrap();
    assert!(outcome.flights.iter().all(|of| of.placement.is_some()), "{:?}", outcome.flights);
    outcome
}

/// By how much a trait of a plot differs between dates, as a share of its mean.
fn spread(root: &Path, outcome: &SeasonOutcome, plot: &str, name: &str) -> f64 {
    let values: Vec<f64> = outcome
        .flights
        .iter()
        .map(|flight| {
            let table = root.join(&flight.project).join("rowgram/plots/traits_long.csv");
            let table = fs::read_to_string(table).unwrap();
            let start = format!("{plot},{name},");
            let line = table.lines().find_map(|line| line.strip_prefix(&start)).unwrap();
            line.split(',').next().unwrap().parse().unwrap()
        })
        .collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let [low, high] = [f64::min, f64::max].map(|pick| values.iter().copied().reduce(pick).unwrap());
    println!("{plot} {name}: {values:.4?}");
    (high - low) / mean
}

#[test]
fn plots_that_do_not_change_are_as_green_on_all_dates() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let light = write(root);
    let off = run(root, |list| format!("{list}[season]\ncolours = \"off\"\n"));
    assert!(off.flights.iter().all(|flight| flight.colours.is_none()));
    let spreads = |outcome: &SeasonOutcome| {
        [("green", "exg"), ("green", "gli"), ("soil", "green_share")]
            .map(|(plot, name)| spread(root, outcome, plot, name))
    };
    let [exg, _, share] = spreads(&off);
    assert!(exg > 0.05 && share > 0.01, "the light of dates differs: {exg} {share}");

    let panels = run(root, |list| list);
    for (flight, light) in panels.flights.iter().zip(&light) {
        let colours = flight.colours.as_ref().unwrap();
        assert_eq!((colours.source, colours.places), (ColourSource::Panels, 3));
        for c in 0..3 {
            let error = colours.gain[c] * light[c] - 1.0;
            let sigma = colours.gain_sigma[c] / colours.gain[c];
            println!(
                "{} channel {c}: gain {:.4}, {error:+.4} +- {sigma:.4}",
                flight.date, colours.gain[c]
            );
            assert!(error.abs() < 0.01 && sigma < 0.02, "{colours:?} {light:?}");
        }
    }
    for spread in spreads(&panels) {
        assert!(spread < 0.01, "panels: {spread}");
    }

    let ground = run(root, |list| format!("{list}[season]\ncolours = \"ground\"\n"));
    for (flight, of_date) in ground.flights.iter().zip(&light) {
        let colours = flight.colours.as_ref().unwrap();
        let is_first = flight.date == ground.flights[0].date;
        assert_eq!(colours.source == ColourSource::Reference, is_first);
        let error = [0, 1, 2].map(|c| (colours.gain[c] * of_date[c] / light[0][c]).ln());
        let sigma = [0, 1, 2].map(|c| colours.gain_sigma[c] / colours.gain[c]);
        println!("{}: {} squares, {error:+.4?} +- {sigma:.4?}", flight.date, colours.places);
        // Rough soil is darker under a low sun than a level surface, and a third of its unevenness is new; both in all channels.
        assert!(error.iter().all(|error| error.abs() < 0.08), "{error:?}");
        assert!(
            (error[0] - error[1]).abs() < 0.01 && (error[2] - error[1]).abs() < 0.01,
            "{error:?}"
        );
        assert!(is_first || sigma.iter().all(|sigma| (0.002..0.03).contains(sigma)), "{sigma:?}");
    }
    for spread in spreads(&ground) {
        assert!(spread < 0.01, "ground: {spread}");
    }
    crate::formats::assert_columns_are_documented(&root.join("season"));
    // A date that is added later changes nothing of the others, and panels of nothing are refused by name.
    fs::write(
        root.join("panels.geojson"),
        fs::read_to_string(root.join("panels.geojson")).unwrap().replace("\"red\"", "\"rot\""),
    )
    .unwrap();
    let file = SeasonFile::read(&root.join("season.toml")).unwrap();
    let error = season::season(&file, &[], &[], false, &mut Silent).unwrap_err().to_string();
    assert!(error.contains("panels.geojson") && error.contains("red is missing"), "{error}");
}
