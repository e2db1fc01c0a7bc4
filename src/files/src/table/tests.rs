use super::*;

/// Names and numbers of a file of these bytes.
fn read(bytes: &[u8]) -> Table {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    std::fs::write(&path, bytes).unwrap();
    Table::read(&path).unwrap()
}

fn cells(table: &Table) -> Vec<(String, Option<f64>, Option<f64>)> {
    let columns: Vec<Column> = table.columns().map(|(_, column)| column).collect();
    let of = |row: &Row| {
        let name = table.text(row, columns[0]).to_owned();
        (name, table.parse(row, columns[1]), table.parse(row, columns[2]))
    };
    table.rows().iter().map(of).collect()
}

#[test]
fn a_table_is_the_same_however_it_is_written() {
    let expected = [
        ("Köln 1".to_owned(), Some(500_671.98), Some(4_480_143.5)),
        ("B".to_owned(), Some(500_678.25), Some(4_480_145.0)),
    ];
    let comma = "name,east (m),north [m]\nKöln 1,500671.98,4480143.5\nB,500678.25,4480145\n";
    let utf16 = |big: bool| -> Vec<u8> {
        let units = std::iter::once('\u{feff}').chain(comma.chars());
        let units = units.map(|c| u16::try_from(u32::from(c)).unwrap());
        units.flat_map(|u| if big { u.to_be_bytes() } else { u.to_le_bytes() }).collect()
    };
    let latin: Vec<u8> = comma.chars().map(|c| u8::try_from(u32::from(c)).unwrap()).collect();
    let semicolon = "name;east;north\nKöln 1;500671,98;4480143,5\nB;500678,25;4480145,0\n";
    let tables: Vec<Vec<u8>> = vec![
        comma.as_bytes().to_vec(),
        format!("\u{feff}{}", comma.replace('\n', "\r\n")).into_bytes(),
        utf16(false),
        utf16(true),
        latin,
        semicolon.as_bytes().to_vec(),
        semicolon.replace(';', "\t").into_bytes(),
        b"# made by hand\n\nname,east,north\n\"K\xc3\xb6ln 1\",500671.98,4480143.5\n,,\nB,500678.25,4480145,\n".to_vec(),
        "name east north\n\"Köln 1\"   500671,98 4480143,5\n B  500678,25 4480145,0\n".as_bytes().to_vec(),
        "Köln 1;500671,98;4480143,5\nB;500678,25;4480145,0\n".as_bytes().to_vec(),
        "EPSG:32616\n#name,east,north\nKöln 1,500671.98,4480143.5\nB,500678.25,4480145\n".as_bytes().to_vec(),
    ];
    for bytes in &tables {
        let table = read(bytes);
        assert_eq!(cells(&table), expected, "{:?}", String::from_utf8_lossy(bytes));
        let has_names = table.column(&["east"]).is_some();
        assert_eq!(has_names, table.is_named());
    }
    assert_eq!(read(&tables[10]).system(), Some("EPSG:32616"));
    assert!(!read(&tables[9]).is_named() && read(&tables[10]).is_named());
    // A title over the whole; the system as Metashape writes it.
    assert_eq!(cells(&read(format!("Trial 7 2025;;\n{semicolon}").as_bytes())), expected);
    let text = format!("# CoordinateSystem: PROJCS[\"x\",AUTHORITY[\"EPSG\",\"32616\"]]\n{comma}");
    let table = read(text.as_bytes());
    assert_eq!(table.system(), Some("PROJCS[\"x\",AUTHORITY[\"EPSG\",\"32616\"]]"));
    assert_eq!(cells(&table), expected);
}

#[test]
fn an_ambiguous_comma_is_no_number() {
    // Beside decimal points a comma separates thousands or is a slip.
    let table = read(b"name;east;north\nA;1,234;5.5\n");
    let [east, north] = ["east", "north"].map(|name| table.column(&[name]).unwrap());
    assert_eq!(
        (table.parse(&table.rows()[0], east), table.parse(&table.rows()[0], north)),
        (None, Some(5.5))
    );
    assert!(table.number(&table.rows()[0], east).unwrap_err().to_string().contains("1,234"));
}

#[test]
fn lines_are_those_of_the_file() {
    let table = read(b"# a\n\nname,x,y\n\nA,1,2\n\n# b\nB,3,oops\n");
    let y = table.column(&["y"]).unwrap();
    let lines: Vec<usize> = table.rows().iter().map(|row| row.line).collect();
    assert_eq!(lines, [5, 8]);
    assert!(table.number(&table.rows()[1], y).unwrap_err().to_string().contains("line 8"));
}

#[test]
fn titles_are_compared_without_units_and_case() {
    for (title, name) in [
        ("latitude [decimal degrees]", "latitude"),
        ("X/East", "x_east"),
        ("Accuracy_X/Y/Z_(m)", "accuracy_x_y_z"),
        ("height(m)", "height"),
        (" Lat. ", "lat"),
    ] {
        assert_eq!(normal(title), name);
    }
}

#[test]
fn units_of_titles_are_converted_or_refused() {
    let table = read(b"name,x [cm],omega (rad),z (ft),GPSLongitude,GPSLongitudeRef,n (W)\na,250,0.1,3,87.5,W,2\n");
    let number = |name: &str| table.number(&table.rows()[0], table.column(&[name]).unwrap());
    assert_eq!(number("x").unwrap(), 2.5);
    assert!((number("omega").unwrap() - 5.729_577_951).abs() < 1e-8);
    assert_eq!(number("gpslongitude").unwrap(), -87.5);
    for (name, expected) in [("z", "z (ft) has feet"), ("n", "make them negative")] {
        let error = number(name).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn units_may_end_a_title() {
    let table = read(
        b"name,sigma_xy_mm,easting_cm,altitude_ft,z (US survey foot),drift (left)\na,20,250,3,4,5\n",
    );
    let number = |names: &[&str]| table.number(&table.rows()[0], table.column(names).unwrap());
    assert_eq!(number(&["sigma_xy_m", "accuracy_xy"]).unwrap(), 0.02);
    assert_eq!(number(&["easting_m"]).unwrap(), 2.5);
    assert_eq!(number(&["drift"]).unwrap(), 5.0);
    for names in [&["height_m", "altitude"], &["z_m", "z"]] {
        let error = number(names).unwrap_err().to_string();
        assert!(error.contains("has feet"), "{error}");
    }
    // Of pixels a length is none.
    assert_eq!(table.column(&["easting_px", "easting"]), None);
}

#[test]
fn titles_in_a_comment_have_a_separator_of_their_own_and_a_footer_is_no_row() {
    let table = read(b"# PhotoID, X, Y, Z\na.jpg\t1.5\t2\t3\n# Control points Total Error\t\t\t0.05\n#b\t2\t2\t3\n");
    assert_eq!(table.header(), ["PhotoID", "X", "Y", "Z"]);
    let names = table.rows().iter().map(|row| table.text(row, Column(0)));
    assert_eq!(names.collect::<Vec<_>>(), ["a.jpg", "#b"]);
}

#[test]
fn a_table_that_cannot_be_split_and_minutes_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    std::fs::write(&path, "label easting\nA,1,2,3\nB,1,2,3\n").unwrap();
    let error = Table::read(&path).unwrap_err().to_string();
    assert!(error.contains("(label easting), this row is 4 (A | 1 | 2 | 3)"), "{error}");
    std::fs::write(&path, b"PK\x03\x04\x14\0\x06\0").unwrap();
    assert!(Table::read(&path).unwrap_err().to_string().contains("save it as CSV"));
    for (field, part) in [
        ("40°28'18.7\"\"N", "expected decimal degrees"),
        ("40 28 18.7", "expected decimal degrees"),
        ("86 deg 59' 31.35\"\" W", "expected decimal degrees"),
        ("north", "expected a finite number"),
    ] {
        let table = read(format!("name,lat,lon,h\na,\"{field}\",1,2\n").as_bytes());
        let error = table.number(&table.rows()[0], Column(1)).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    }
}
