//! Polygons of all formats.

use super::*;
use rowgram_raster::{crs, georeference::Crs};

fn parse(text: &str, place: Option<&Georeference>) -> Result<Vec<Named>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    std::fs::write(&path, text).unwrap();
    read(&path, place).map_err(|error| error.to_string())
}

const PLOTS: &str = r#"{"type":"FeatureCollection",
    "crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::32616"}},"features":[
    {"type":"Feature","properties":{"name":"A","leaves":12},
     "geometry":{"type":"Polygon","coordinates":[[[100,200],[110,200],[110,190],[100,200]]]}},
    {"type":"Feature","id":7,"properties":null,
     "geometry":{"type":"MultiPolygon","coordinates":[[[[0,0,5],[1,0,5],[1,1,5]]]]}}]}"#;

#[test]
fn plots_are_named_and_in_pixels() {
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    let plots = parse(PLOTS, Some(&place)).unwrap();
    assert_eq!((plots[0].name.as_str(), plots[0].leaves), ("A", Some(12.0)));
    assert_eq!(plots[0].polygon.rings, [[[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]]]);
    assert_eq!((plots[1].name.as_str(), plots[1].leaves), ("7", None));
    let leaves = |text: &str| parse(&PLOTS.replace("12", text), Some(&place)).unwrap()[0].leaves;
    assert_eq!([leaves("\"230\""), leaves("\"n/a\"")], [Some(230.0), None]);
    let unnamed = PLOTS.replace("\"crs\"", "\"other\"");
    assert_eq!(parse(&unnamed, None).unwrap()[0].polygon.rings[0][0], [100.0, 200.0]);
}

#[test]
fn a_plot_without_a_name_takes_none_of_another() {
    let text = PLOTS.replace("\"id\":7,", "").replace("\"A\"", "2");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    std::fs::write(&path, text.replace("\"crs\"", "\"other\"")).unwrap();
    let layer = check(&path, None).unwrap();
    let names: Vec<&str> = layer.polygons.iter().map(|of| of.name.as_str()).collect();
    assert_eq!(names, ["2", "unnamed 2"]);
    assert!(layer.notes[0].starts_with("polygons have no name"), "{:?}", layer.notes);
}

#[test]
fn json_as_other_programs_write_it_is_read() {
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    let code = "urn:ogc:def:crs:EPSG::32616";
    let expected = parse(PLOTS, Some(&place)).unwrap();
    // Compound systems, missing numbers; a path that ends in a backslash, and NaN in a text.
    for (from, to) in [
        (code, "urn:ogc:def:crs,crs:EPSG::32616,crs:EPSG::5773"),
        (code, "EPSG:32616+5703"),
        ("null", r#"{"dir":"NaN\\","b":NaN,"c":-Infinity}"#),
    ] {
        let mut read = parse(&PLOTS.replace(from, to), Some(&place)).unwrap();
        let attributes = std::mem::take(&mut read[1].attributes);
        assert_eq!(read, expected, "{to}");
        assert!(attributes.iter().all(|(_, value)| value == r"NaN\"), "{attributes:?}");
    }
    assert!(parse(&PLOTS.replace("[100,200]", "[NaN,200]"), Some(&place)).is_err());
    // UTF-16 and Latin-1.
    let text = PLOTS.replace("\"A\"", "\"Köln\"");
    let wide = format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    let latin: Vec<u8> = text.chars().map(|c| u8::try_from(u32::from(c)).unwrap()).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    for bytes in [wide, latin] {
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path, Some(&place)).unwrap()[0].name, "Köln");
    }
}

#[test]
fn what_cannot_be_used_is_told() {
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32617));
    let error = parse(&PLOTS.replace("32616", "999999"), Some(&place)).unwrap_err();
    assert!(error.contains("EPSG:999999 is not a known"), "{error}");
    let nowhere = Georeference { crs: Crs::LOCAL, ..place };
    let error = parse(PLOTS, Some(&nowhere)).unwrap_err();
    assert!(error.contains("EPSG:32616") && error.contains("does not say"), "{error}");
    assert!(parse(PLOTS, None).unwrap_err().contains("in pixels"));
    let plots = PLOTS.replace("\"crs\"", "\"other\"");
    for (text, expected) in [
        ("", "expected GeoJSON"),
        ("{\"type\":\"Topology\"}", "expected GeoJSON"),
        (&plots.replace("12", "\"many\""), "expected a number"),
        (&plots.replace("12", "\"inf\""), "expected a number"),
        (&plots.replace("[110,200],[110,190],", ""), "fewer than three points"),
        (&plots.replace("[110,200]", "[110]"), "fewer than two numbers"),
        (&plots.replace("\"Polygon\"", "\"Point\"").replace("MultiPolygon", "Point"), "is a Point"),
    ] {
        let error = parse(text, None).unwrap_err();
        assert!(error.contains(expected) && error.contains("plots.geojson"), "{error}");
    }
}

#[test]
fn what_nobody_meant_to_draw_is_refused() {
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    let square = "[[100,200],[110,200],[110,190],[100,200]]";
    for (text, expected) in [
        (
            PLOTS.replace(square, "[[100,200],[110,190],[110,200],[100,190],[100,200]]"),
            "crosses itself at 105.00, 195.00",
        ),
        (PLOTS.replace(square, "[[100,200],[105,195],[110,190],[100,200]]"), "on one line"),
        (PLOTS.replace("\"id\":7", "\"id\":\"A\""), "two polygons are named \"A\""),
        (r#"{"type":"FeatureCollection","features":[]}"#.to_owned(), "no polygons"),
    ] {
        let error = parse(&text, Some(&place)).unwrap_err();
        assert!(error.contains(expected) && error.contains("plots.geojson"), "{error}");
    }
}

#[test]
fn properties_come_along_and_names_do_not() {
    let text = PLOTS.replace(
        "\"leaves\":12",
        "\"leaves\":12,\"genotype\":\"B73\",\"block\":2,\"fid\":9,\"note\":null",
    );
    let plots = parse(&text, None).unwrap_err();
    assert!(plots.contains("in pixels"), "{plots}");
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    let plots = parse(&text, Some(&place)).unwrap();
    let kept: Vec<&str> = plots[0].attributes.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(kept, ["block", "genotype"]);
    assert!(plots[1].attributes.is_empty());
}

#[test]
fn a_file_is_checked_without_a_map() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    std::fs::write(&path, PLOTS).unwrap();
    assert_eq!(check(&path, None).unwrap().polygons.len(), 2);
    std::fs::write(&path, PLOTS.replace("\"id\":7", "\"id\":\"A\"")).unwrap();
    assert!(check(&path, None).unwrap_err().to_string().contains("two polygons"));
}

/// The same corner of a field in three systems comes to the same pixel.
#[test]
fn other_systems_are_transformed() {
    let corner = [500_670.0, 4_480_143.0];
    let zone_16 = crs::Crs::from_epsg(32616).unwrap();
    let place = Georeference::north_up(corner, 0.02, Crs::projected(32616));
    let [latitude, longitude] = zone_16.to_wgs84(corner[0] + 1.0, corner[1] - 2.0).unwrap();
    let [x, y] = crs::Crs::from_epsg(32617).unwrap().from_wgs84(latitude, longitude).unwrap();
    let text = |crs: &str, x: f64, y: f64| {
        format!(
            r#"{{"type":"FeatureCollection"{crs},"features":[{{"type":"Feature","geometry":
            {{"type":"Polygon","coordinates":[[[{x},{y}],[{},{y}],[{x},{}],[{x},{y}]]]}}}}]}}"#,
            x + 1e-4,
            y + 1e-4
        )
    };
    let named = |code: &str| {
        format!(r#","crs":{{"type":"name","properties":{{"name":"urn:ogc:def:crs:{code}"}}}}"#)
    };
    for text in [
        text("", longitude, latitude),
        text(&named("OGC:1.3:CRS84"), longitude, latitude),
        text(&named("EPSG::4326"), longitude, latitude),
        text(&named("EPSG::32617"), x, y),
    ] {
        let [u, v] = parse(&text, Some(&place)).unwrap()[0].polygon.rings[0][0];
        assert!((u - 50.0).abs() < 0.01 && (v - 100.0).abs() < 0.01, "{u} {v}: {text}");
    }
}

#[test]
fn a_shapefile_is_read() {
    use shapefile::{
        Point, Polygon, PolygonRing,
        dbase::{FieldValue, Record, TableWriterBuilder},
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.shp");
    let table = TableWriterBuilder::new()
        .add_character_field("PLOT".try_into().unwrap(), 20)
        .add_numeric_field("LEAVES".try_into().unwrap(), 10, 1);
    let mut writer = shapefile::Writer::from_path(&path, table).unwrap();
    let ring = [(100.0, 200.0), (100.0, 190.0), (110.0, 190.0), (100.0, 200.0)];
    let polygon = Polygon::new(PolygonRing::Outer(ring.map(|(x, y)| Point::new(x, y)).into()));
    let mut record = Record::default();
    record.insert("PLOT".into(), FieldValue::Character(Some("7 b".into())));
    record.insert("LEAVES".into(), FieldValue::Numeric(Some(12.0)));
    writer.write_shape_and_record(&polygon, &record).unwrap();
    drop(writer);
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    let plots = read(&path, Some(&place)).unwrap();
    assert_eq!((plots[0].name.as_str(), plots[0].leaves), ("7 b", Some(12.0)));
    assert_eq!(plots[0].polygon.rings[0].len(), 3);
    assert!(plots[0].polygon.rings[0].contains(&[20.0, 20.0]));
    let projection = folder.path().join("plots.prj");
    let text = r#"PROJCS["WGS 84 / UTM zone 16N",GEOGCS["WGS 84"],AUTHORITY["EPSG","32616"]]"#;
    std::fs::write(&projection, text).unwrap();
    assert_eq!(read(&path, Some(&place)).unwrap(), plots);
    std::fs::write(&projection, r#"PROJCS["Mine",GEOGCS["GCS_WGS_1984"]]"#).unwrap();
    let error = read(&path, Some(&place)).unwrap_err().to_string();
    assert!(error.contains("plots.prj") && error.contains("Mine"), "{error}");
    std::fs::remove_file(folder.path().join("plots.dbf")).unwrap();
    assert!(read(&path, None).unwrap_err().to_string().contains("plots.shp"));
}

/// A shapefile with one polygon and a name in Latin-1.
fn shapefile_of(folder: &Path, name: &[u8], [x, y]: [f64; 2]) -> PathBuf {
    use shapefile::{
        Point, PolygonRing,
        dbase::{FieldValue, Record, TableWriterBuilder},
    };
    let path = folder.join("plots.shp");
    let table = TableWriterBuilder::new()
        .add_character_field("PLOT".try_into().unwrap(), 20)
        .add_character_field("GENOTYPE".try_into().unwrap(), 20);
    let mut writer = shapefile::Writer::from_path(&path, table).unwrap();
    let ring = [(x, y), (x, y - 10.0), (x + 10.0, y - 10.0), (x, y)];
    let ring = PolygonRing::Outer(ring.map(|(x, y)| Point::new(x, y)).into());
    let mut record = Record::default();
    record.insert("PLOT".into(), FieldValue::Character(Some("1".into())));
    let placeholder = "x".repeat(name.len());
    record.insert("GENOTYPE".into(), FieldValue::Character(Some(placeholder.clone())));
    writer.write_shape_and_record(&shapefile::Polygon::new(ring), &record).unwrap();
    drop(writer);
    let table = folder.join("plots.dbf");
    let mut bytes = std::fs::read(&table).unwrap();
    let at = bytes.windows(name.len()).rposition(|part| part == placeholder.as_bytes()).unwrap();
    bytes[at..at + name.len()].copy_from_slice(name);
    std::fs::write(&table, bytes).unwrap();
    path
}

#[test]
fn texts_are_in_the_encoding_that_is_stated_or_fits() {
    let folder = tempfile::tempdir().unwrap();
    let genotype = |path: &Path| {
        let plots = read(path, None).unwrap();
        plots[0].attributes.iter().find(|(key, _)| key == "GENOTYPE").unwrap().1.clone()
    };
    let path = shapefile_of(folder.path(), b"K\xf6ln", [0.0; 2]);
    assert_eq!(genotype(&path), "Köln");
    for (label, expected) in
        [("ISO-8859-1", "Köln"), ("88591", "Köln"), ("ANSI 1252", "Köln"), ("1251", "Kцln")]
    {
        std::fs::write(path.with_extension("cpg"), label).unwrap();
        assert_eq!(genotype(&path), expected, "{label}");
    }
    std::fs::write(path.with_extension("cpg"), "Klingon").unwrap();
    assert!(read(&path, None).unwrap_err().to_string().contains("plots.cpg"));
    std::fs::remove_file(path.with_extension("cpg")).unwrap();
    let path = shapefile_of(folder.path(), "Köln".as_bytes(), [0.0; 2]);
    assert_eq!(genotype(&path), "Köln");
}

#[test]
fn holes_beside_their_outline_add_nothing() {
    let square = |x: f64| format!("[[{x},0],[{},0],[{},10],[{x},10],[{x},0]]", x + 10.0, x + 10.0);
    let text = |hole: String| {
        format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","properties":{{"plot":1}},
            "geometry":{{"type":"Polygon","coordinates":[{},{hole}]}}}}]}}"#,
            square(0.0)
        )
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    std::fs::write(&path, text(square(30.0))).unwrap();
    let layer = read_layer(&path, Drawn::default()).unwrap();
    assert_eq!(layer.polygons[0].polygon.pixels(), 100);
    assert!(layer.notes[0].contains("a hole lies outside"), "{:?}", layer.notes);
    std::fs::write(&path, text("[[2,2],[4,2],[4,4],[2,4],[2,2]]".to_owned())).unwrap();
    let layer = read_layer(&path, Drawn::default()).unwrap();
    assert_eq!((layer.polygons[0].polygon.pixels(), layer.notes.len()), (96, 0));
}

#[test]
fn names_are_the_property_in_which_plots_differ() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    let read = |rows: &[&str], key: Option<&str>| {
        let feature = |(k, properties): (usize, &&str)| {
            let x = 20 * k;
            format!(
                r#"{{"type":"Feature","properties":{properties},"geometry":
                {{"type":"Polygon","coordinates":[[[{x},0],[{},0],[{x},9],[{x},0]]]}}}}"#,
                x + 9
            )
        };
        let features: Vec<String> = rows.iter().enumerate().map(feature).collect();
        let text = format!(r#"{{"type":"FeatureCollection","features":[{}]}}"#, features.join(","));
        std::fs::write(&path, text).unwrap();
        let layer =
            read_layer(&path, Drawn { key, ..Drawn::default() }).map_err(|e| e.to_string())?;
        Ok::<_, String>((
            layer.polygons.into_iter().map(|of| of.name).collect::<Vec<_>>(),
            layer.notes,
        ))
    };
    let genotypes = [r#"{"name":"B73","Plot_ID":101.0}"#, r#"{"name":"B73","Plot_ID":102.0}"#];
    let (names, notes) = read(&genotypes, None).unwrap();
    assert_eq!(names, ["101", "102"]);
    assert!(notes.is_empty(), "{notes:?}");
    let repeated = [r#"{"plot":"B73","id":7}"#, r#"{"plot":"B73","id":8}"#];
    let (names, notes) = read(&repeated, None).unwrap();
    assert_eq!(names, ["7", "8"]);
    assert!(notes[0].contains("named by id") && notes[0].contains("plot_key"), "{notes:?}");
    let own = [r#"{"name":"a","Parcel":"x"}"#, r#"{"name":"a","Parcel":"y"}"#];
    let error = read(&own, None).unwrap_err();
    assert!(error.contains("unique are: Parcel") && error.contains("plot_key"), "{error}");
    assert_eq!(read(&own, Some("parcel")).unwrap().0, ["x", "y"]);
    assert!(read(&own, Some("nothing")).unwrap_err().contains("there are: Parcel, name"));
    assert!(read(&own, Some("name")).unwrap_err().contains("two polygons"));
}

/// Projections without codes, as Esri's programs and survey software describe them, come to the same pixel as those with codes.
#[test]
fn systems_are_read_from_well_known_text() {
    let degrees = r#"PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]"#;
    let grs80 = r#"SPHEROID["GRS_1980",6378137.0,298.257222101]]"#;
    let nad83 = format!(r#"GEOGCS["GCS_NAD_1983_2011",DATUM["D_NAD_1983_2011",{grs80},{degrees}"#);
    let utm = format!(
        r#"PROJCS["NAD_1983_2011_UTM_Zone_16N",{nad83},PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",500000.0],
        PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",-87.0],PARAMETER["Scale_Factor",0.9996],
        PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]"#
    );
    // A state plane in US survey feet: EPSG:2263, Long Island.
    let state = format!(
        r#"PROJCS["NAD_1983_2011_StatePlane_New_York_Long_Isl_FIPS_3104_Ft_US",{nad83},PROJECTION["Lambert_Conformal_Conic"],
        PARAMETER["False_Easting",984250.0],PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",-74.0],
        PARAMETER["Standard_Parallel_1",40.66666666666666],PARAMETER["Standard_Parallel_2",41.03333333333333],
        PARAMETER["Latitude_Of_Origin",40.16666666666666],UNIT["Foot_US",0.3048006096012192]]"#
    );
    let etrs = format!(
        r#"PROJCS["ETRS_1989_UTM_Zone_32N",GEOGCS["GCS_ETRS_1989",DATUM["D_ETRS_1989",{grs80},{degrees},
        PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],
        PARAMETER["Central_Meridian",9.0],PARAMETER["Scale_Factor",0.9996],PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]"#
    );
    for (text, at, own, map) in [
        (&utm, [500_200.0, 4_480_000.0], 6345, 32616),
        (&state, [1_000_000.0, 200_000.0], 2263, 32618),
        (&etrs, [520_000.0, 5_400_000.0], 25832, 32632),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = shapefile_of(folder.path(), b"B73", at);
        std::fs::write(path.with_extension("prj"), text).unwrap();
        let [latitude, longitude] = crs::Crs::of_code(own).unwrap().to_wgs84(at[0], at[1]).unwrap();
        let onto = crs::Crs::of_code(map).unwrap();
        let corner = onto.from_wgs84(latitude, longitude).unwrap();
        let place = Georeference::north_up(corner, 0.01, Crs::projected(map));
        let plots = read(&path, Some(&place)).unwrap();
        let near = |p: &[f64; 2]| p[0].abs() < 1.0 && p[1].abs() < 1.0;
        assert!(plots[0].polygon.rings[0].iter().any(near), "{own}: {plots:?}");
    }
    // Airy's ellipsoid, and nothing of where the datum lies: a hundred metres off.
    let folder = tempfile::tempdir().unwrap();
    let path = shapefile_of(folder.path(), b"B73", [351_000.0, 512_000.0]);
    let text = format!(
        r#"PROJCS["British_National_Grid",GEOGCS["GCS_OSGB_1936",DATUM["D_OSGB_1936",SPHEROID["Airy_1830",6377563.396,299.3249646]],
        {degrees},PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",400000.0],PARAMETER["False_Northing",-100000.0],
        PARAMETER["Central_Meridian",-2.0],PARAMETER["Scale_Factor",0.9996012717],PARAMETER["Latitude_Of_Origin",49.0],UNIT["Meter",1.0]]"#
    );
    std::fs::write(path.with_extension("prj"), text).unwrap();
    let place = Georeference::north_up([500_000.0, 6_000_000.0], 0.01, Crs::projected(32630));
    assert!(read(&path, Some(&place)).unwrap_err().to_string().contains("datum"));
}

/// Plots 1 to 3, side by side, as a shapefile.
fn three_plots(folder: &Path) -> PathBuf {
    use shapefile::{
        Point, PolygonRing,
        dbase::{FieldValue, Record, TableWriterBuilder},
    };
    let path = folder.join("PLOTS.shp");
    let table = TableWriterBuilder::new().add_character_field("PLOT".try_into().unwrap(), 20);
    let mut writer = shapefile::Writer::from_path(&path, table).unwrap();
    for (k, x) in [(1, 0.0), (2, 20.0), (3, 40.0)] {
        let ring = [(x, 0.0), (x, 10.0), (x + 10.0, 10.0), (x, 0.0)];
        let ring = PolygonRing::Outer(ring.map(|(x, y)| Point::new(x, y)).into());
        let mut record = Record::default();
        record.insert("PLOT".into(), FieldValue::Character(Some(k.to_string())));
        writer.write_shape_and_record(&shapefile::Polygon::new(ring), &record).unwrap();
    }
    drop(writer);
    path
}

#[test]
fn rows_of_a_shapefile_stay_with_their_shapes() {
    let folder = tempfile::tempdir().unwrap();
    let path = three_plots(folder.path());
    let names = |path: &Path| -> Vec<(String, f64)> {
        let plots = read(path, None).unwrap();
        plots.into_iter().map(|of| (of.name, of.polygon.bounds().unwrap()[0][0])).collect()
    };
    let all = [("1".to_owned(), 0.0), ("2".to_owned(), 20.0), ("3".to_owned(), 40.0)];
    assert_eq!(names(&path), all);
    // A shape that grew stands at the end of the file, and the index knows where.
    let (shapes, index) = (std::fs::read(&path).unwrap(), path.with_extension("shx"));
    let offsets = std::fs::read(&index).unwrap();
    let length = (shapes.len() - 100) / 3;
    let moved = [&shapes[..], &shapes[100 + length..100 + 2 * length]].concat();
    let mut moved_index = offsets.clone();
    moved_index[108..112].copy_from_slice(&((shapes.len() / 2) as u32).to_be_bytes());
    std::fs::write(&path, moved).unwrap();
    std::fs::write(&index, moved_index).unwrap();
    assert_eq!(names(&path), all);
    std::fs::write(&path, &shapes).unwrap();
    std::fs::write(&index, &offsets).unwrap();
    // A deleted row, and endings in capitals.
    let table = path.with_extension("dbf");
    let rows = std::fs::read(&table).unwrap();
    let first = usize::from(rows[8]) + 256 * usize::from(rows[9]);
    let mut deleted = rows.clone();
    deleted[first + 21] = b'*';
    std::fs::write(&table, &deleted).unwrap();
    std::fs::rename(&table, path.with_extension("DBF")).unwrap();
    std::fs::rename(&index, path.with_extension("SHX")).unwrap();
    assert_eq!(names(&path), [all[0].clone(), all[2].clone()]);
    assert_eq!(
        (find(folder.path(), "plots", &ENDINGS).first().cloned(), shapefile_parts(&path).len()),
        (Some(path.clone()), 2)
    );
    // A row too few.
    let mut short = rows;
    short[4] = 2;
    std::fs::write(path.with_extension("DBF"), &short).unwrap();
    let error = read(&path, None).unwrap_err().to_string();
    assert!(error.contains("2 rows for the 3 shapes"), "{error}");
}

#[test]
fn parts_over_each_other_are_refused_and_islands_are_not() {
    let square = |x: f64, side: f64| {
        let (low, high) = (x - side, x + side);
        format!("[[{low},{low}],[{high},{low}],[{high},{high}],[{low},{high}],[{low},{low}]]")
    };
    let read = |parts: &[String]| {
        let parts = parts.join(",");
        let text = format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","properties":{{"plot":1}},
            "geometry":{{"type":"MultiPolygon","coordinates":[{parts}]}}}}]}}"#
        );
        parse(&text, None).map(|plots| plots[0].polygon.pixels())
    };
    let [one, twice, other] =
        [(0.0, 5.0), (4.0, 5.0), (12.0, 5.0)].map(|(x, side)| square(x, side));
    for parts in
        [[format!("[{one}]"), format!("[{twice}]")], [format!("[{one}]"), format!("[{one}]")]]
    {
        assert!(read(&parts).unwrap_err().contains("parts lie over each other"));
    }
    assert_eq!(read(&[format!("[{one}]"), format!("[{other}]")]), Ok(200));
    let island = [format!("[{one},{}]", square(0.0, 3.0)), format!("[{}]", square(0.0, 1.0))];
    assert_eq!(read(&island), Ok(100 - 36 + 4));
}

#[test]
fn faults_are_told_before_the_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plots.geojson");
    let place = Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(32616));
    std::fs::write(&path, PLOTS.replace("\"id\":7", "\"id\":\"A\"")).unwrap();
    let drawn = Drawn { place: Some(&place), size: Some((20, 20)), ..Drawn::default() };
    let error = read_layer(&path, drawn).unwrap_err().to_string();
    assert!(error.contains("two polygons are named \"A\""), "{error}");
}

#[test]
fn a_datum_that_nobody_knows_moves_no_plot() {
    // ED50 has no shift in its definition; its zones differ from each other by their meridian alone.
    let text = PLOTS.replace("32616", "23030");
    let onto = |code| Georeference::north_up([100.0, 200.0], 0.5, Crs::projected(code));
    let error = parse(&text, Some(&onto(25830))).unwrap_err();
    assert!(error.contains("datum") && error.contains("+ellps=intl"), "{error}");
    assert!(parse(&text, Some(&onto(23030))).is_ok());
    let error = parse(&text, Some(&onto(23029))).map(drop);
    assert!(!error.is_err_and(|error| error.contains("datum")));
}

#[test]
fn holes_parts_and_attributes_are_written_and_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let square =
        |x: f64, side: f64| vec![[x, x], [x + side, x], [x + side, x + side], [x, x + side]];
    let plots = [write::Outline {
        name: "A".to_owned(),
        rings: vec![square(0.0, 90.0), square(10.0, 20.0), square(200.0, 30.0)],
        attributes: vec![("genotype".to_owned(), "B73".into())],
    }];
    for ending in ENDINGS.iter().filter(|ending| **ending != "gpkg" || crate::gpkg::IS_AVAILABLE) {
        let path = folder.path().join("plots").with_extension(ending);
        write(&path, false, &plots, None).unwrap();
        let found = read(&path, None).unwrap();
        assert_eq!(found[0].polygon.rings.len(), 3, "{ending}");
        assert_eq!(found[0].polygon.pixels(), 8100 - 400 + 900, "{ending}");
        assert_eq!(found[0].attributes, plots[0].attributes, "{ending}");
    }
}
