use super::*;

const PHOTOS: Option<[f64; 2]> = Some([40.47, -86.99]);

fn read_as(name: &str, text: &str, photos_deg: Option<[f64; 2]>) -> CameraPlaces {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    read(&path, photos_deg).unwrap()
}

/// The first row of every form is of the same photo.
fn check(found: &CameraPlaces, sigma_m: Option<[f64; 3]>, what: &str) {
    let row = &found.rows[0];
    assert_eq!(row.place, Place::Degrees([40.471866036, -86.992045844]), "{what}");
    assert_eq!((row.height_m, row.sigma_m), (Some(193.373), sigma_m), "{what}");
    assert_eq!(found.rows.len(), 2, "{what}");
}

#[test]
fn positions_are_read_as_other_programs_write_them() {
    let accuracy = Some([0.5, 0.5, 0.8]);
    let pix4d = "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter],accuracy horizontal [meter],accuracy vertical [meter]\n\
        a.JPG,40.471866036,-86.992045844,193.373,0.5,0.8\nb.JPG,40.4718,-86.9919,194.0,0.5,0.8\n";
    check(&read_as("geolocation.csv", pix4d, None), accuracy, "Pix4D");
    let bare: String = pix4d.split_inclusive('\n').skip(1).collect();
    check(&read_as("geolocation.csv", &bare, None), accuracy, "Pix4D without a header");
    let angles = bare.replace(",0.5,0.8", ",172,0,0,0.5,0.8");
    check(&read_as("geolocation.csv", &angles, None), accuracy, "with angles");
    let odm = "EPSG:4326\na.JPG -86.992045844 40.471866036 193.373 172.0 0.0 0.0 0.5 0.8\nb.JPG -86.9919 40.4718 194.0 172.0 0.0 0.0 0.5 0.8\n";
    check(&read_as("geo.txt", odm, None), accuracy, "OpenDroneMap");
    // The photos tell which is which where a file does not keep to its usage.
    let odd = "EPSG:4326\na.JPG 40.471866036 -86.992045844 193.373\nb.JPG 40.4718 -86.9919 194.0\n";
    let found = read_as("geo.txt", odd, PHOTOS);
    check(&found, None, "exchanged");
    assert!(found.choice.unwrap().contains("latitude in \"column 2\""));
    let metashape = "#CoordinateSystem: WGS 84\n#Label\tX/Longitude\tY/Latitude\tZ/Altitude\tAccuracy_X/Y/Z_(m)\n\
        a.JPG\t-86.992045844\t40.471866036\t193.373\t0.5\nb.JPG\t-86.9919\t40.4718\t194.0\t0.5\n";
    check(&read_as("cameras.txt", metashape, None), Some([0.5; 3]), "Metashape");
    let exiftool = "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n./a.JPG,40.471866036,-86.992045844,193.373\n./b.JPG,40.4718,-86.9919,\n";
    let found = read_as("exif.csv", exiftool, None);
    check(&found, None, "exiftool");
    assert_eq!(found.rows[1].height_m, None);
    let comma = "Bild;Lat;Lon;Höhe\na.JPG;40,471866036;-86,992045844;193,373\nb.JPG;40,4718;-86,9919;194,0\n";
    let comma = comma.replace("Bild", "image").replace("Höhe", "height");
    check(&read_as("positions.csv", &comma, None), None, "decimal commas");
}

#[test]
fn logs_of_receivers_are_read() {
    let mrk = "1\t385478.123456\t[2275]\t    25,N\t     7,E\t   189,V\t40.471866036,Lat\t-86.992045844,Lon\t193.373,Ellh\t0.011, 0.012, 0.031\t50,Q\n\
        2\t385480.1\t[2275]\t    25,N\t     7,E\t   189,V\t40.4718,Lat\t-86.9919,Lon\t194.0,Ellh\t1.1, 1.2, 3.1\t16,Q\n";
    let found = read_as("flight_Timestamp.MRK", mrk, None);
    check(&found, Some([0.012, 0.011, 0.031]), "MRK");
    assert_eq!(found.rows[0].photo, PhotoReference::Number(1));
    assert_eq!(found.rows[1].sigma_m, None);
    let pos = "% program   : RTKPOST\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)\n\
        %  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)\n\
        2023/08/14 12:35:18.100   40.471866036  -86.992045844   193.3730   1  12   0.0110   0.0120   0.0310\n\
        2023/08/14 12:35:20.100   40.471800000  -86.991900000   194.0000   2  12   0.5110   0.5120   0.9310\n";
    let found = read_as("flight_events.pos", pos, None);
    check(&found, Some([0.012, 0.011, 0.031]), "RTKLIB");
    assert_eq!(
        (found.rows[1].photo.clone(), found.rows[1].sigma_m),
        (PhotoReference::Place(1), None)
    );
}

#[test]
fn metres_need_a_system() {
    let text = "EPSG:32616\na.JPG 500673.4 4480138.5 193.3\nb.JPG 500675.4 4480138.5 NaN\n";
    let found = read_as("geo.txt", text, None);
    assert!(found.needs_system());
    assert_eq!(found.system.as_deref(), Some("EPSG:32616"));
    assert_eq!(found.rows[0].place, Place::Metres([500_673.4, 4_480_138.5]));
    assert_eq!(found.rows[1].height_m, None);
}

#[test]
fn what_is_missing_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("geolocation.csv");
    for (text, part) in [
        ("image,lat\na,1\n", "longitude"),
        ("image,lat,lon\na,91,1\n", "no place on the globe"),
        ("image,lat,lon\na,x,1\n", "lat is \"x\""),
        ("a,b\nc,d\n", "image"),
        ("image,lat,lon\na,1,2\na,1,3\n", "a is there twice"),
        ("EPSG:4267\nimage,lat,lon\na,1,2\n", "to WGS84 (EPSG:4326)"),
        ("EPSG:4314\nimage,lat,lon\na,1,2\n", "transform them to WGS84"),
        ("", "empty"),
    ] {
        std::fs::write(&path, text).unwrap();
        let error = read(&path, None).unwrap_err().to_string();
        assert!(error.contains(part) && error.contains("geolocation.csv"), "{error}");
    }
}

#[test]
fn an_accuracy_may_be_alone() {
    for (titles, expected) in [
        ("accuracy_horizontal", Some([0.02, 0.02, 5.0])),
        ("sigma_z_m", Some([5.0, 5.0, 0.02])),
        ("comment", None),
    ] {
        let text = format!("image,latitude,longitude,{titles}\na.JPG,40.47,-86.99,0.02\n");
        assert_eq!(read_as("geolocation.csv", &text, None).rows[0].sigma_m, expected, "{titles}");
    }
}
