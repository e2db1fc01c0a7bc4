//! What GDAL writes is read, what is written is read again, what is damaged is told.

use super::*;
use rowgram_optim::output::FileError;
use rowgram_raster::{
    georeference::{Crs, CrsKind, Georeference},
    window::Window,
};
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/geotiff").join(name)
}

/// Sample `b` of pixel `(u, v)` in the rasters of `tests/golden/geotiff.py`.
fn pattern(u: usize, v: usize, b: usize) -> u32 {
    ((7 * u + 13 * v + 101 * b) % 251) as u32
}

const WINDOWS: [Window; 4] = [
    Window { u: 0, v: 0, width: 70, height: 45 },
    Window { u: 31, v: 15, width: 3, height: 19 },
    Window { u: 69, v: 44, width: 1, height: 1 },
    Window { u: 5, v: 40, width: 65, height: 5 },
];

fn expect<T: Sample + PartialEq + std::fmt::Debug>(
    name: &str,
    bands: usize,
    of: impl Fn(u32) -> T,
) {
    let reader = Reader::open(&golden(name)).unwrap();
    assert_eq!((reader.width(), reader.height(), reader.bands()), (70, 45, bands), "{name}");
    for window in WINDOWS {
        let read = reader.read::<T>(window).unwrap();
        let pixels = window.row_range().flat_map(|v| window.columns().map(move |u| (u, v)));
        let expected: Vec<T> = pixels
            .flat_map(|(u, v)| (0..bands).map(move |b| (u, v, b)))
            .map(|(u, v, b)| of(pattern(u, v, b)))
            .collect();
        assert!(read == expected, "{name} {window:?}");
    }
}

#[test]
fn what_gdal_writes_is_read_by_any_window() {
    expect("lzw_tiles.tif", 3, |x| x as u8);
    expect("packbits_strips.tif", 1, |x| x as u8);
    expect("planar_bigtiff.tif", 3, |x| x as u8);
    expect("u16_turned.tif", 1, |x| (257 * x) as u16);
    expect("f32_predictor.tif", 1, |x| x as f32 + 0.25);
    let reader = Reader::open(&golden("jpeg_ycbcr.tif")).unwrap();
    let picture = reader.read_rgb(WINDOWS[1]).unwrap();
    for (u, v, pixel) in picture.enumerate_pixels() {
        for b in 0..3 {
            let expected = 60 + 31 + 15 + u + v + 20 * b as u32;
            assert!(pixel.0[b].abs_diff(expected as u8) <= 4, "{u} {v}: {:?}", pixel.0);
        }
    }
}

#[test]
fn the_place_on_the_map_is_that_of_gdal_at_pixel_centres() {
    let place = |name| Reader::open(&golden(name)).unwrap().georeference().unwrap();
    let upright = place("lzw_tiles.tif");
    assert_eq!(upright.crs, Crs::projected(32616));
    let expected = [500_000.0 + 10.5 * 0.013, 4_475_000.0 - 20.5 * 0.013];
    for i in 0..2 {
        // The transform is stored as it is; only the sum is rounded, at 1e-9 m.
        approx::assert_abs_diff_eq!(upright.map([10.0, 20.0])[i], expected[i], epsilon = 1e-8);
    }
    let turned = place("u16_turned.tif");
    let expected =
        [500_000.0 + 10.5 * 0.012 + 20.5 * 0.005, 4_475_000.0 + 10.5 * 0.005 - 20.5 * 0.012];
    for i in 0..2 {
        approx::assert_abs_diff_eq!(turned.map([10.0, 20.0])[i], expected[i], epsilon = 1e-8);
    }
    assert_eq!(turned.gsd_m().map(|gsd| (gsd * 1e4).round()), Some(130.0));
    let degrees = place("degrees.tif");
    assert_eq!(degrees.crs.kind, CrsKind::Geographic);
    let [width, height] = degrees.pixel_m().unwrap();
    assert!((width / height - 1.0).abs() < 0.02, "read with square pixels: {width} {height}");
}

#[test]
fn values_are_numbers_and_nodata_is_nan() {
    let heights = Reader::open(&golden("f32_predictor.tif")).unwrap();
    assert_eq!(heights.nodata(), Some(-9999.0));
    assert_eq!(heights.read_f32(WINDOWS[2]).unwrap(), [pattern(69, 44, 0) as f32 + 0.25]);
    let reader = Reader::open(&golden("u16_turned.tif")).unwrap();
    let values = reader.read_f32(WINDOWS[0]).unwrap();
    for v in 0..45 {
        for u in 0..70 {
            let (value, expected) = (values[v * 70 + u], pattern(u, v, 0));
            assert!(if expected == 0 { value.is_nan() } else { value == 257.0 * expected as f32 });
        }
    }
    let grey = reader.read_rgb(WINDOWS[0]).unwrap();
    assert_eq!(grey.get_pixel(1, 0).0, [7; 3]);
}

#[test]
fn wrong_kinds_and_damaged_files_are_told() {
    let error =
        Reader::open(&golden("lzw_tiles.tif")).unwrap().read::<f32>(WINDOWS[0]).unwrap_err();
    let message = error.to_string();
    assert!(
        message.ends_with("its samples are 8-bit, expected 32-bit floating point"),
        "{message}"
    );
    let outside = Window { u: 60, v: 0, width: 20, height: 2 };
    assert!(Reader::open(&golden("lzw_tiles.tif")).unwrap().read::<u8>(outside).is_err());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.tif");
    let whole = std::fs::read(golden("planar_bigtiff.tif")).unwrap();
    for length in [0, 3, 8, 20, 100, whole.len() / 2, whole.len() - 40] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let read = Reader::open(&path).and_then(|reader| reader.read::<u8>(WINDOWS[0]));
        let error = read
            .err()
            .map(|e| (e.to_string().contains("cut.tif"), rowgram_base::Error::from(e).kind()));
        assert_eq!(error, Some((true, rowgram_base::Kind::BadInput)), "{length} bytes");
    }
    let missing = Reader::open(&folder.path().join("missing.tif")).err().unwrap();
    assert!(missing.to_string().starts_with("cannot read"), "{missing}");
}

fn round_trip<T: Sample + PartialEq>(layout: Layout, of: impl Fn(usize) -> T) -> PathBuf {
    let folder = tempfile::tempdir().unwrap().keep();
    let path = folder.join("raster.tif");
    let samples: Vec<T> = (0..layout.width * layout.height * layout.bands()).map(of).collect();
    let band = layout.width * layout.bands();
    write::<T, rowgram_optim::output::FileError>(&path, false, &layout, |writer| {
        // From the bottom up, by rows of tiles.
        for v in (0..layout.height).step_by(TILE).rev() {
            let rows = v..(v + TILE).min(layout.height);
            let part = &samples[rows.start * band..rows.end * band];
            writer.put(Window::rows(layout.width, rows), part)?;
        }
        Ok(())
    })
    .unwrap();
    let reader = Reader::open(&path).unwrap();
    assert!(reader.read::<T>(Window::whole(layout.width, layout.height)).unwrap() == samples);
    assert_eq!(reader.nodata(), layout.nodata);
    let (place, expected) = (reader.georeference(), layout.georeference);
    assert_eq!(place.map(|place| place.crs), expected.map(|place| place.crs));
    if let (Some(place), Some(expected)) = (place, expected) {
        for corner in [[0.0, 0.0], [layout.width as f64, 0.0], [0.0, layout.height as f64]] {
            for i in 0..2 {
                let (a, b) = (place.map(corner)[i], expected.map(corner)[i]);
                approx::assert_abs_diff_eq!(a, b, epsilon = 1e-8);
            }
        }
    }
    path
}

#[test]
fn what_is_written_is_read_again() {
    let place = Georeference::north_up([500_000.0, 4_475_000.0], 0.02, Crs::projected(32616));
    let layout = Layout {
        width: 700,
        height: 1100,
        colour: Colour::Classes,
        georeference: Some(place),
        nodata: None,
    };
    let keep = std::env::var_os("ROWGRAM_KEEP").map(PathBuf::from);
    let files = [
        ("classes.tif", round_trip(layout, |i| ((i / 700) % 3) as u32)),
        ("mask.tif", round_trip(layout, |i| if i % 7 == 0 { 255u8 } else { 0 })),
        ("rgb.tif", round_trip(Layout { colour: Colour::Rgb, ..layout }, |i| (i * i % 251) as u8)),
        (
            "rgba.tif",
            round_trip(Layout { colour: Colour::Rgba, width: 3, height: 1, ..layout }, |i| i as u8),
        ),
        (
            "heights.tif",
            round_trip(Layout { colour: Colour::Values, nodata: Some(-9999.0), ..layout }, |i| {
                if i % 5 == 0 { -9999.0 } else { (i as f32).sqrt() }
            }),
        ),
        ("plain.tif", round_trip(Layout { georeference: None, ..layout }, |i| i as u16)),
        (
            "local.tif",
            round_trip(
                Layout {
                    georeference: Some(Georeference {
                        crs: Crs::LOCAL,
                        per_column: [0.016, 0.012],
                        per_row: [0.012, -0.016],
                        ..place
                    }),
                    ..layout
                },
                |i| (i % 2) as u8,
            ),
        ),
    ];
    for (name, path) in files {
        if let Some(folder) = &keep {
            std::fs::copy(&path, folder.join(name)).unwrap();
        }
        std::fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }
}

#[test]
fn tiles_that_do_not_fit_and_failures_leave_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("raster.tif");
    let layout = Layout {
        width: 600,
        height: 600,
        colour: Colour::Classes,
        georeference: None,
        nodata: None,
    };
    for window in [
        Window { u: 1, v: 0, width: 511, height: 512 },
        Window { u: 0, v: 0, width: 100, height: 512 },
        Window { u: 512, v: 512, width: 512, height: 512 },
        Window { u: 0, v: 0, width: 512, height: 513 },
    ] {
        let samples = vec![0u8; window.pixels()];
        let failed = write(&path, false, &layout, |writer| writer.put(window, &samples));
        assert!(failed.unwrap_err().to_string().contains("does not fit"), "{window:?}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "no litter");
    }
    // Tiles that were not put are nodata.
    write::<u8, rowgram_optim::output::FileError>(
        &path,
        false,
        &Layout { nodata: Some(9.0), ..layout },
        |writer| writer.put(Window { u: 512, v: 0, width: 88, height: 512 }, &[1; 88 * 512]),
    )
    .unwrap();
    let read = Reader::open(&path).unwrap().read::<u8>(Window::whole(600, 600)).unwrap();
    assert_eq!((read[0], read[599], read[600 * 599]), (9, 1, 9));
    let none = Layout { width: 0, ..layout };
    assert!(write::<u8, rowgram_optim::output::FileError>(&path, true, &none, |_| Ok(())).is_err());
}

fn layout(place: Georeference, [width, height]: [usize; 2]) -> Layout {
    Layout { width, height, colour: Colour::Values, georeference: Some(place), nodata: None }
}

#[test]
fn pixels_that_are_lines_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lines.tif");
    for side in [-1.4e133, 50.0] {
        let place = Georeference {
            per_column: [side, 0.0],
            ..Georeference::north_up([500_000.0, 4_500_000.0], 0.05, Crs::projected(32616))
        };
        let layout = Layout {
            width: 8,
            height: 6,
            colour: Colour::Values,
            georeference: Some(place),
            nodata: None,
        };
        write::<u8, FileError>(&path, true, &layout, |writer| {
            writer.put(Window::whole(8, 6), &[7; 48])
        })
        .unwrap();
        let error = Reader::open(&path).err().unwrap().to_string();
        assert!(error.contains("its georeference is damaged"), "{error}");
    }
}

#[test]
fn oblong_pixels_are_read_as_square_ones() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("oblong.tif");
    let place = Georeference {
        per_row: [0.0, -0.02],
        ..Georeference::north_up([500_000.0, 5_000_000.0], 0.01, Crs::projected(32616))
    };
    let values: Vec<f32> = (0..12u8).map(f32::from).collect();
    write::<f32, FileError>(&path, false, &layout(place, [4, 3]), |writer| {
        writer.put(Window::whole(4, 3), &values)
    })
    .unwrap();
    let reader = Reader::open(&path).unwrap();
    assert_eq!((reader.width(), reader.height(), reader.stored_size()), (4, 6, Some([4, 3])));
    let square = reader.georeference().unwrap();
    assert_eq!(square.gsd_m().map(|gsd| (gsd * 1e6).round()), Some(1e4));
    // The corner stays; the middle of the first pixel is a quarter of the old height below it.
    for (a, b) in square.map([-0.5, -0.5]).iter().zip(place.map([-0.5, -0.5])) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    let expected: Vec<f32> =
        [0, 0, 1, 1, 2, 2].iter().flat_map(|row| values[4 * row..][..4].to_vec()).collect();
    assert_eq!(reader.read_f32(Window::whole(4, 6)).unwrap(), expected);
    let window = Window { u: 1, v: 1, width: 2, height: 3 };
    assert_eq!(reader.read_f32(window).unwrap(), [1.0, 2.0, 5.0, 6.0, 5.0, 6.0]);
    assert!(reader.read_f32(Window { u: 0, v: 5, width: 1, height: 2 }).is_err());
}

#[test]
fn systems_without_a_code_are_kept() {
    use rowgram_raster::crs;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("local.tif");
    let text =
        "+proj=tmerc +lat_0=48 +lon_0=9 +k=0.5 +x_0=1000 +y_0=0 +ellps=GRS80 +units=m +no_defs";
    let local = Crs::from(&crs::Crs::of_definition(text).unwrap());
    let place = Georeference::north_up([1000.0, 10.0], 0.01, local);
    write::<f32, FileError>(&path, false, &layout(place, [2, 2]), |writer| {
        writer.put(Window::whole(2, 2), &[0.0; 4])
    })
    .unwrap();
    let read = Reader::open(&path).unwrap().georeference().unwrap();
    assert_eq!(read.crs, local);
    // A metre of this map is two on the ground.
    assert!((read.gsd_m().unwrap() - 0.02).abs() < 1e-5, "{:?}", read.gsd_m());
}

#[test]
fn world_files_and_projections_beside_a_picture_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.png");
    std::fs::write(folder.path().join("mask.pgw"), "0.01\n0\n0\n-0.01\n500000.005\n5000000\n")
        .unwrap();
    let place = beside(&path).unwrap().unwrap();
    assert_eq!((place.origin, place.crs.kind), ([500_000.005, 5_000_000.0], CrsKind::Unknown));
    let text = r#"PROJCS["NAD_1983_2011_UTM_Zone_16N",GEOGCS["GCS_NAD_1983_2011",DATUM["D_NAD_1983_2011",
        SPHEROID["GRS_1980",6378137.0,298.257222101]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],
        PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],
        PARAMETER["Central_Meridian",-87.0],PARAMETER["Scale_Factor",0.9996],PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]"#;
    std::fs::write(folder.path().join("mask.prj"), text).unwrap();
    assert_eq!(beside(&path).unwrap().unwrap().gsd_m(), Some(0.01));
    std::fs::write(folder.path().join("mask.pgw"), "0.01 0 0 many 0 0").unwrap();
    assert!(beside(&path).unwrap_err().to_string().contains("mask.pgw"));
}

#[test]
fn the_brighter_of_two_values_is_plant_where_white_is_zero_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.tif");
    for (photometric, plants) in [(0u16, [0u8, 1, 1, 0]), (1, [1, 0, 0, 1])] {
        // Width, height, bits, compression, what zero is, place of the samples, samples, rows, bytes.
        let tags = [(256, 4), (257, 1), (258, 8), (259, 1), (262, photometric), (273, 126)];
        let tags = tags.into_iter().chain([(277, 1), (278, 1), (279, 4)]);
        let mut bytes = vec![b'I', b'I', 42, 0, 8, 0, 0, 0, 9, 0];
        for (tag, value) in tags {
            let [tag, kind, value] = [tag, 3, value].map(u16::to_le_bytes);
            bytes.extend([tag, kind, [1, 0], [0, 0], value, [0, 0]].concat());
        }
        bytes.resize(126, 0);
        bytes.extend([255, 0, 0, 255]);
        std::fs::write(&path, bytes).unwrap();
        let source = crate::rasters::Source::open(&path).unwrap();
        assert!(!source.is_photo());
        let mask = source.mask(|_| panic!("a mask of two values")).unwrap();
        assert_eq!(mask.data, plants, "{photometric}");
    }
}

/// A TIFF of one strip of rows of these samples, with more tags of text.
fn strip(
    path: &Path,
    size: [u16; 2],
    [bits, format]: [u16; 2],
    data: &[u8],
    texts: &[(u16, &str)],
) {
    let bands = data.len() as u16 / (size[0] * size[1] * (bits / 8));
    let photometric = if bands == 3 { 2 } else { 1 };
    let end = 10 + 12 * (11 + texts.len()) + 4;
    let widths = vec![bits; 3].into_iter().flat_map(u16::to_le_bytes).collect::<Vec<_>>();
    let mut after: Vec<u8> = widths;
    let samples = end + after.len();
    after.extend(data);
    let mut tags = vec![
        (256, 3, 1, size[0].into()),
        (257, 3, 1, size[1].into()),
        (258, 3, u32::from(bands), if bands == 3 { end as u32 } else { bits.into() }),
        (259, 3, 1, 1),
        (262, 3, 1, photometric),
        (273, 4, 1, samples as u32),
        (277, 3, 1, bands.into()),
        (278, 3, 1, size[1].into()),
        (279, 4, 1, data.len() as u32),
        (284, 3, 1, 1),
        (339, 3, 1, format.into()),
    ];
    for (tag, text) in texts {
        let text = format!("{text}\0");
        tags.push((*tag, 2, text.len() as u32, (end + after.len()) as u32));
        after.extend(text.bytes());
    }
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend((tags.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in tags {
        bytes.extend([u16::to_le_bytes(tag), u16::to_le_bytes(kind)].concat());
        bytes.extend([u32::to_le_bytes(count), u32::to_le_bytes(value)].concat());
    }
    bytes.extend([0; 4]);
    bytes.extend(after);
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn values_and_gaps_of_files_beside_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("dsm.tif");
    let values: Vec<u8> =
        [10_100u16, 5000, 0, 9000].into_iter().flat_map(u16::to_le_bytes).collect();
    let item = |role: &str, text: &str| format!("<Item sample=\"0\" role=\"{role}\">{text}</Item>");
    let metadata = item("scale", "0.01") + &item("offset", "100");
    strip(&path, [4, 1], [16, 1], &values, &[(42_112, &metadata), (42_113, "0.000")]);
    let read = || Reader::open(&path).unwrap().read_f32(Window::whole(4, 1)).unwrap();
    let is = |expected: [f32; 4]| {
        let read = read();
        let same = |(a, b): (&f32, &f32)| a == b || a.is_nan() && b.is_nan();
        assert!(read.iter().zip(&expected).all(same), "{read:?}, expected {expected:?}");
    };
    is([201.0, 150.0, f32::NAN, 190.0]);
    // As for GDAL, what stands beside the file goes first.
    let xml = "<PAMDataset><PAMRasterBand band=\"1\"><NoDataValue>5000</NoDataValue></PAMRasterBand></PAMDataset>";
    std::fs::write(folder.path().join("dsm.tif.aux.xml"), xml).unwrap();
    is([201.0, f32::NAN, 100.0, 190.0]);
    let unit = item("unittype", "ft");
    strip(&path, [4, 1], [16, 1], &values, &[(42_112, &unit)]);
    is([3078.48, f32::NAN, 0.0, 2743.2]);
    strip(&path, [4, 1], [16, 1], &values, &[(42_112, &metadata), (42_113, "0.000")]);
    strip(&folder.path().join("dsm.tif.msk"), [4, 1], [8, 1], &[0, 255, 255, 255], &[]);
    is([f32::NAN, f32::NAN, 100.0, 190.0]);
    let picture = folder.path().join("ortho.tif");
    strip(&picture, [2, 1], [8, 1], &[9, 8, 7, 6, 5, 4], &[]);
    strip(&folder.path().join("ortho.tif.msk"), [2, 1], [8, 1], &[255, 0], &[]);
    let reader = Reader::open(&picture).unwrap();
    let (rgb, gaps) = reader.read_rgb_and_gaps(Window::whole(2, 1)).unwrap();
    assert_eq!((rgb.into_raw(), gaps), (vec![9, 8, 7, 0, 0, 0], Some(vec![false, true])));
    assert!(reader.states_gaps() && reader.overviews().is_empty());
    strip(&folder.path().join("ortho.tif.msk"), [1, 2], [8, 1], &[255, 0], &[]);
    let error = Reader::open(&picture).err().unwrap().to_string();
    assert!(error.contains("ortho.tif.msk") && error.contains("2 x 1"), "{error}");
}

#[test]
fn bytes_in_another_type_have_the_colours_of_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ortho.tif");
    let bytes = [12u8, 90, 33, 60, 176, 20];
    let wide: Vec<u8> = bytes.into_iter().flat_map(|x| u16::from(x).to_le_bytes()).collect();
    for format in [1, 2] {
        strip(&path, [2, 1], [16, format], &wide, &[]);
        let rgb = Reader::open(&path).unwrap().read_rgb(Window::whole(2, 1)).unwrap();
        assert_eq!(rgb.into_raw(), bytes, "{format}");
    }
}
