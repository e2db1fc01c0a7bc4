use super::*;

#[test]
fn numbers_of_a_drone_are_read_in_both_forms() {
    let text = br#"....<x:xmpmeta><rdf:Description drone-dji:GimbalYawDegree="+12.5" drone-dji:GimbalPitchDegree="-90.0"
        drone-dji:RelativeAltitude="+40.1"><drone-dji:GimbalRollDegree>0.0</drone-dji:GimbalRollDegree></x:xmpmeta>..."#;
    let found = parse(text);
    assert_eq!(found.gimbal_deg, Some([12.5, -90.0, 0.0]));
    assert_eq!(found.height_above_take_off_m, Some(40.1));
    assert_eq!(found.geotag, None);
}

#[test]
fn the_principal_distance_is_taken_from_what_there_is() {
    let plain = Metadata { focal_35mm: Some(24.0), ..Metadata::default() };
    let (c, _) = plain.principal_distance_px([4000, 3000]).unwrap();
    assert!((c - 24.0 / DIAGONAL_35MM * 5000.0).abs() < 1e-9);
    let canon = Metadata {
        make: "Canon".into(),
        model: "Canon IXUS 220 HS".into(),
        focal_mm: Some(4.3),
        ..Metadata::default()
    };
    let (c, _) = canon.principal_distance_px([2000, 1500]).unwrap();
    assert!((c - 4.3 / 6.17 * 2000.0).abs() < 1e-9);
    assert_eq!(Metadata::default().principal_distance_px([10, 10]), None);
}

/// A value of a TIFF entry: its type, its number of parts and its bytes.
type Entry = (u16, u16, u32, Vec<u8>);

/// What a directory ends with.
enum Next {
    /// No further one, as it should be.
    None,
    /// The next beyond the end of the file.
    Beyond,
    /// Nothing at all: the bytes of values follow at once.
    Missing,
}

/// A directory of EXIF at a place, with the values that do not fit into it behind it.
fn directory(at: usize, entries: &[Entry], next: &Next) -> Vec<u8> {
    let tail = if matches!(next, Next::Missing) { 0 } else { 4 };
    let mut values = Vec::new();
    let mut out = (entries.len() as u16).to_be_bytes().to_vec();
    let begin = at + 2 + 12 * entries.len() + tail;
    for (tag, kind, count, bytes) in entries {
        out.extend(tag.to_be_bytes());
        out.extend(kind.to_be_bytes());
        out.extend(count.to_be_bytes());
        let mut held = bytes.clone();
        if held.len() > 4 {
            let place = (begin + values.len()) as u32;
            values.extend(held);
            held = place.to_be_bytes().to_vec();
        }
        held.resize(4, 0);
        out.extend(held);
    }
    match next {
        Next::None => out.extend([0; 4]),
        Next::Beyond => out.extend(60_000u32.to_be_bytes()),
        Next::Missing => {}
    }
    out.extend(values);
    out
}

fn ratios(parts: &[[u32; 2]]) -> Vec<u8> {
    parts.iter().flatten().flat_map(|part| part.to_be_bytes()).collect()
}

fn ascii(text: &str) -> Vec<u8> {
    text.bytes().chain([0]).collect()
}

/// A JPEG with EXIF whose first directory, and those of exposure and position, end so.
fn photo_with_exif(first: &Next, below: &Next, xmp: &str) -> Vec<u8> {
    photo_at(["N", "W"], 0, first, below, xmp)
}

/// The same with the sides to which latitude and longitude count, and what the height is over.
fn photo_at(
    sides: [&str; 2],
    height_reference: u8,
    first: &Next,
    below: &Next,
    xmp: &str,
) -> Vec<u8> {
    let exposure = |at| {
        directory(at, &[(0x920a, 5, 1, ratios(&[[88, 10]])), (0xa405, 3, 1, vec![0, 24])], below)
    };
    let position = |at| {
        let [north, west] = sides.map(ascii);
        let (lat, lon) = ([[40, 1], [28, 1], [1872, 100]], [[86, 1], [59, 1], [3136, 100]]);
        let entries: [Entry; 6] = [
            (1, 2, north.len() as u32, north),
            (2, 5, 3, ratios(&lat)),
            (3, 2, west.len() as u32, west),
            (4, 5, 3, ratios(&lon)),
            (5, 1, 1, vec![height_reference]),
            (6, 5, 1, ratios(&[[193_373, 1000]])),
        ];
        directory(at, &entries, below)
    };
    let pointers = |exif: usize, gps: usize| -> Vec<Entry> {
        let at = |place: usize| (place as u32).to_be_bytes().to_vec();
        vec![(0x10f, 2, 4, ascii("DJI")), (0x8769, 4, 1, at(exif)), (0x8825, 4, 1, at(gps))]
    };
    let exif_at = 8 + directory(8, &pointers(0, 0), first).len();
    let gps_at = exif_at + exposure(exif_at).len();
    let mut tiff = b"MM\0\x2a\0\0\0\x08".to_vec();
    tiff.extend(directory(8, &pointers(exif_at, gps_at), first));
    tiff.extend(exposure(exif_at));
    tiff.extend(position(gps_at));
    let mut bytes = vec![0xff, 0xd8];
    for payload in [[b"Exif\0\0".to_vec(), tiff].concat(), xmp.as_bytes().to_vec()] {
        bytes.extend([0xff, 0xe1]);
        bytes.extend((payload.len() as u16 + 2).to_be_bytes());
        bytes.extend(payload);
    }
    bytes.extend([0xff, 0xda, 0, 2, 0xff, 0xd9]);
    bytes
}

#[test]
fn damaged_directories_leave_what_can_be_read() {
    for (first, below, damaged) in [
        (Next::None, Next::None, false),
        (Next::Beyond, Next::None, true),
        (Next::None, Next::Missing, true),
    ] {
        let found = parse(&photo_with_exif(&first, &below, ""));
        assert_eq!(
            (found.make.as_str(), found.focal_mm, found.focal_35mm),
            ("DJI", Some(8.8), Some(24.0))
        );
        let tag = found.geotag.unwrap();
        assert!((tag.latitude_deg - 40.471_866_7).abs() < 1e-6, "{tag:?}");
        assert!((tag.longitude_deg + 86.992_044_4).abs() < 1e-6, "{tag:?}");
        assert_eq!(tag.height_m, Some(193.373));
        assert_eq!(!found.unread.is_empty(), damaged, "{:?}", found.unread);
    }
}

#[test]
fn positions_come_from_xmp_where_exif_has_none() {
    let of = |numbers: &str| {
        parse(format!("..<x:xmpmeta><rdf:Description {numbers}/></x:xmpmeta>").as_bytes())
    };
    let rtk = "drone-dji:RtkFlag=\"50\" drone-dji:RtkStdLon=\"0.012\" drone-dji:RtkStdLat=\"0.011\" drone-dji:RtkStdHgt=\"0.03\"";
    for longitude in ["drone-dji:GpsLongitude", "drone-dji:GpsLongtitude"] {
        let found = of(&format!(
            "drone-dji:GpsLatitude=\"+40.5\" {longitude}=\"-86.9\" drone-dji:AbsoluteAltitude=\"+193.5\" {rtk}"
        ));
        let tag = found.geotag.unwrap();
        assert_eq!((tag.latitude_deg, tag.longitude_deg, tag.height_m), (40.5, -86.9, Some(193.5)));
        assert_eq!(tag.sigma_m, Some([0.012, 0.011, 0.03]));
    }
    let found = parse(b"<x:xmpmeta><drone-dji:GpsLatitude>40.5</drone-dji:GpsLatitude><drone-dji:GpsLongitude>-86.9</drone-dji:GpsLongitude></x:xmpmeta>");
    assert_eq!(found.geotag.map(|tag| (tag.latitude_deg, tag.height_m)), Some((40.5, None)));
    let found = of(
        "exif:GPSLatitude=\"40,30.0N\" exif:GPSLongitude=\"86,54,0W\" exif:GPSAltitude=\"387/2\"",
    );
    let tag = found.geotag.unwrap();
    assert!((tag.latitude_deg - 40.5).abs() < 1e-9 && (tag.longitude_deg + 86.9).abs() < 1e-9);
    assert_eq!(tag.height_m, Some(193.5));
    // A receiver that knew nothing, and a float solution, whose accuracy is none.
    assert_eq!(of("drone-dji:GpsLatitude=\"0\" drone-dji:GpsLongitude=\"0\"").geotag, None);
    let float = of(&format!(
        "drone-dji:GpsLatitude=\"40.5\" drone-dji:GpsLongitude=\"-86.9\" {}",
        rtk.replace("50", "34")
    ));
    assert_eq!(float.geotag.unwrap().sigma_m, None);
    // EXIF counts where it has a position.
    let both = parse(&photo_with_exif(
        &Next::None,
        &Next::None,
        "<x:xmpmeta drone-dji:GpsLatitude=\"1.5\" drone-dji:GpsLongitude=\"2.5\" Camera:BandName=\"NIR\"></x:xmpmeta>",
    ));
    assert!((both.geotag.unwrap().latitude_deg - 40.47).abs() < 0.01);
    assert_eq!(both.band.as_deref(), Some("NIR"));
    // The same position, which EXIF rounds to a hundredth of a second; half a metre away it is another.
    for (longitude, expected) in [(-86.992_042_1, -86.992_042_1), (-86.992_038, -86.992_044_4)] {
        let xmp = format!(
            "<x:xmpmeta drone-dji:GpsLatitude=\"40.4718655\" drone-dji:GpsLongitude=\"{longitude}\"></x:xmpmeta>"
        );
        let tag = parse(&photo_with_exif(&Next::None, &Next::None, &xmp)).geotag.unwrap();
        assert!((tag.longitude_deg - expected).abs() < 1e-7, "{tag:?}");
    }
}

#[test]
fn a_position_counts_to_the_sides_that_are_named() {
    let read = |sides: [&str; 2], height_reference: u8| {
        parse(&photo_at(sides, height_reference, &Next::None, &Next::None, ""))
    };
    for (sides, height_reference, signs) in [
        (["N", "W"], 0, [1.0, -1.0, 1.0]),
        (["South", "west"], 1, [-1.0, -1.0, -1.0]),
        (["s", "East"], 2, [-1.0, 1.0, 1.0]),
        (["North", "E"], 3, [1.0, 1.0, -1.0]),
    ] {
        let tag = read(sides, height_reference).geotag.unwrap();
        let found = [tag.latitude_deg, tag.longitude_deg, tag.height_m.unwrap()];
        assert_eq!(found.map(f64::signum), signs, "{sides:?} {height_reference}");
    }
    let unsigned = read(["N", ""], 0);
    assert_eq!(unsigned.geotag, None);
    assert!(unsigned.unread.contains("GPSLongitudeRef"), "{}", unsigned.unread);
}
