//! Exterior orientations of other programs: tables of projection centres with omega, phi, kappa, and Orthority's
//! GeoJSON.
//!
//! A table has a header, in any letters: the photo (`filename`, `image`, `label`, as in tables of positions), `x`, `y`, `z`, `omega`, `phi`,
//! `kappa`, with or without units (`x_m`, `omega_deg`); degrees unless the column is called `omega_rad`. Commas, semicolons,
//! tabs or spaces separate; quotes may be single or double. `R^T = Rx(omega) Ry(phi) Rz(kappa)` takes the camera
//! frame (y up, looking along -z) to the map. Columns with the velocity and turn of a photo during the readout of
//! its rows, as `rowgram synth flight` writes them, are used where they are.

use super::{
    FileError, columns,
    table::{Row, Table},
};
use rowgram_optim::geometry::rotation;
use rowgram_survey::scene::Pose;
use serde_json::Value;
use std::path::Path;

/// The pose of a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct Exterior {
    /// The photo's file name, perhaps without its ending.
    pub name: String,
    /// The pose in the middle of the exposure.
    pub pose: Pose,
    /// How the camera frame turns (radians) and shifts (metres) while the rows are read, in that frame.
    pub motion: Option<[f64; 6]>,
    /// The name of its camera, where there is one.
    pub camera: Option<String>,
}

/// The rotation from the map to the camera frame, from the photogrammetric angles.
pub fn from_angles_rad([omega, phi, kappa]: [f64; 3]) -> rotation::Quaternion {
    let about = |axis: usize, angle: f64| {
        let mut w = [0.0; 3];
        w[axis] = angle;
        rotation::exp(w)
    };
    let to_map =
        rotation::multiply(rotation::multiply(about(0, omega), about(1, phi)), about(2, kappa));
    rotation::inverse(to_map)
}

/// Reads a table or a GeoJSON file.
///
/// # Errors
/// Names the file, the line, the column or the photo.
pub fn read(path: &Path) -> Result<Vec<Exterior>, FileError> {
    let text = super::table::read_text(path)?;
    let poses = if text.trim_start().starts_with('{') {
        let file: Value = serde_json::from_str(&text)
            .map_err(|e| FileError::malformed(path, e.line(), e.to_string()))?;
        geojson(&file).map_err(|message| FileError::malformed(path, None, message))?
    } else {
        let table = Table::read(path)?;
        table.rows().iter().map(|of| row(&table, of)).collect::<Result<_, _>>()?
    };
    if poses.is_empty() {
        return Err(FileError::malformed(path, None, "it holds no photo"));
    }
    let mut names: Vec<&str> = poses.iter().map(|pose| pose.name.as_str()).collect();
    names.sort_unstable();
    if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(FileError::malformed(
            path,
            None,
            format!("photo {:?} is there twice", pair[0]),
        ));
    }
    Ok(poses)
}

fn row(table: &Table, row: &Row) -> Result<Exterior, FileError> {
    let text = |names: &[&str]| table.column(names).map(|column| table.text(row, column));
    let number = |names: &[&str]| -> Result<Option<f64>, FileError> {
        table.column(names).map(|column| table.number(row, column)).transpose()
    };
    let needed = |names: &[&str]| table.number(row, table.required("pose", names)?);
    let name = text(columns::IMAGE)
        .filter(|name| !name.is_empty())
        .ok_or_else(|| table.fault(row, "no name of a photo; expected a column filename".into()))?;
    let centre_m =
        [needed(columns::EASTING)?, needed(columns::NORTHING)?, needed(columns::HEIGHT)?];
    let mut angles = [0.0; 3];
    for (angle, name) in angles.iter_mut().zip(["omega", "phi", "kappa"]) {
        let (degrees, radians) = (format!("{name}_deg"), format!("{name}_rad"));
        *angle = match number(&[&radians])? {
            Some(value) => value,
            None => needed(&[name, &degrees])?.to_radians(),
        };
    }
    let rotation = from_angles_rad(angles);
    let motion = match number(&["readout_s"])? {
        Some(readout_s) if readout_s != 0.0 => {
            let three = |names: [&str; 3]| -> Result<[f64; 3], FileError> {
                let mut of = [0.0; 3];
                for (value, name) in of.iter_mut().zip(names) {
                    *value = number(&[name])?.unwrap_or(0.0);
                }
                Ok(of)
            };
            let velocity = three(["velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s"])?;
            let turn = three(["turn_x_rad_s", "turn_y_rad_s", "turn_z_rad_s"])?;
            // In the camera's frame the world turns and moves the other way.
            let turn = rotation::rotate(rotation, turn.map(|v| -v * readout_s));
            let shift = rotation::rotate(rotation, velocity.map(|v| -v * readout_s));
            Some([turn[0], turn[1], turn[2], shift[0], shift[1], shift[2]])
        }
        _ => None,
    };
    Ok(Exterior {
        name: name.to_owned(),
        pose: Pose::from_centre(rotation, centre_m),
        motion,
        camera: text(&["camera"]).map(str::to_owned),
    })
}

fn geojson(file: &Value) -> Result<Vec<Exterior>, String> {
    let features = file["features"].as_array().ok_or("expected a list \"features\"")?;
    let three = |of: &Value| -> Option<[f64; 3]> {
        let list = of.as_array().filter(|list| list.len() == 3)?;
        Some([list[0].as_f64()?, list[1].as_f64()?, list[2].as_f64()?])
    };
    let one = |(k, feature): (usize, &Value)| {
        let of = &feature["properties"];
        let name = of["filename"].as_str().ok_or(format!("feature {k} has no \"filename\""))?;
        let wrong = |key: &str| format!("photo {name:?}: expected three numbers {key:?}");
        let centre_m = three(&of["xyz"]).ok_or_else(|| wrong("xyz"))?;
        let angles = three(&of["opk"]).ok_or_else(|| wrong("opk"))?;
        Ok(Exterior {
            name: name.to_owned(),
            pose: Pose::from_centre(from_angles_rad(angles), centre_m),
            motion: None,
            camera: of["camera"].as_str().map(str::to_owned),
        })
    };
    features.iter().enumerate().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_come_back_whatever_the_table_looks_like() {
        let texts = [
            "filename,x,y,z,omega,phi,kappa\na.tif,1,2,3,10,-20,30\n",
            "'filename' 'x' 'y' 'z' 'omega' 'phi' 'kappa' 'camera'\n'a.tif' 1 2 3 10 -20 30 'a b c'\n",
            "PhotoID,X/Easting,Y/Northing,Z/Altitude,Omega,Phi,Kappa\na.tif,1,2,3,10,-20,30\n",
            "image;x_m;y_m;z_m;omega_deg;phi_deg;kappa_deg\na.tif;1;2;3;10;-20;30\n",
        ];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.csv");
        let table = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read(&path)
        };
        for text in texts {
            let poses = table(text).unwrap();
            assert_eq!(poses[0].name, "a.tif");
            let expected = [10.0f64, -20.0, 30.0].map(f64::to_radians);
            let found = poses[0].pose.omega_phi_kappa_rad();
            for k in 0..3 {
                approx::assert_abs_diff_eq!(found[k], expected[k], epsilon = 1e-12);
                approx::assert_abs_diff_eq!(
                    poses[0].pose.centre_m()[k],
                    [1.0, 2.0, 3.0][k],
                    epsilon = 1e-12
                );
            }
        }
        let fault = table("filename,x,y,z,omega,phi\na,1,2,3,4,5\n").unwrap_err().to_string();
        assert!(fault.contains("kappa"), "{fault}");
    }
}
