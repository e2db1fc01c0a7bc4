//! Exterior orientations as a table: image, projection centre, omega, phi, kappa.

use super::{FileError, csv_table::quoted, output};
use rowgram_optim::geometry::rotation;
use rowgram_survey::scene::{Image, Reconstruction};
use std::path::Path;

/// Writes `image,x_m,y_m,z_m,omega_deg,phi_deg,kappa_deg` and, where the accuracies are known, standard
/// deviations of all six (`x`, `y`, `z` without a unit where the reconstruction has no scale), and with a rolling shutter the velocity of each image and the readout time; `R^T = Rx(omega) Ry(phi) Rz(kappa)` takes the camera frame (y up, looking along -z)
/// to the map.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, survey: &Reconstruction, force: bool) -> Result<(), FileError> {
    output::write(path, force, |out| {
        let images: &[Image] = &survey.images;
        let known = survey.accuracy.as_ref();
        let unit = if survey.reference.has_scale() { "_m" } else { "" };
        write!(out, "image,x{unit},y{unit},z{unit},omega_deg,phi_deg,kappa_deg")?;
        if known.is_some() {
            write!(out, ",sigma_x{unit},sigma_y{unit},sigma_z{unit}")?;
            write!(out, ",sigma_omega_deg,sigma_phi_deg,sigma_kappa_deg")?;
        }
        if survey.rolling_shutter.is_some() {
            write!(out, ",velocity_east_m_s,velocity_north_m_s,velocity_up_m_s")?;
            write!(out, ",turn_x_rad_s,turn_y_rad_s,turn_z_rad_s,readout_s")?;
        }
        writeln!(out)?;
        for (k, image) in images.iter().enumerate() {
            let [x, y, z] = image.pose.centre_m();
            let [omega, phi, kappa] = image.pose.omega_phi_kappa_rad().map(f64::to_degrees);
            write!(out, "{},{x:.4},{y:.4},{z:.4}", quoted(&image.name))?;
            write!(out, ",{omega:.7},{phi:.7},{kappa:.7}")?;
            if let Some(sigma) = known.and_then(|known| known.images.get(k)) {
                for sigma_m in sigma.centre_m {
                    write!(out, ",{sigma_m:.4}")?;
                }
                for angle in sigma.angles_rad {
                    write!(out, ",{:.7}", angle.to_degrees())?;
                }
            }
            if let (Some(shutter), Some([east, north, up])) =
                (survey.rolling_shutter, survey.velocity_m_s(k))
            {
                write!(out, ",{east:.5},{north:.5},{up:.5}")?;
                let turn = [image.motion[0], image.motion[1], image.motion[2]];
                let world = rotation::rotate(rotation::inverse(image.pose.rotation), turn);
                for rate in world {
                    write!(out, ",{:.7}", -rate / shutter.readout_s)?;
                }
                write!(out, ",{}", shutter.readout_s)?;
            }
            writeln!(out)?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::poses;
    use rowgram_survey::scene::{Pose, RollingShutter};

    #[test]
    fn the_motion_of_an_image_comes_back_from_the_table() {
        let motion = [0.002, -0.001, 0.003, 0.12, -0.2, 0.03];
        let pose = Pose::from_centre(rotation::exp([0.1, -0.2, 1.5]), [10.0, 20.0, 30.0]);
        let image = Image {
            name: "a,b.jpg".into(),
            id: 1,
            camera: 0,
            pose,
            motion,
            expected_motion: motion,
        };
        let shutter = RollingShutter { readout_s: 0.03, sigma_velocity_m_s: 1.0 };
        for rolling_shutter in [Some(shutter), None] {
            let survey = Reconstruction {
                images: vec![image.clone()],
                rolling_shutter,
                ..Reconstruction::default()
            };
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("exterior_orientation.csv");
            write(&path, &survey, false).unwrap();
            let found = &poses::read(&path).unwrap()[0];
            assert_eq!(found.name, "a,b.jpg");
            let found = found.motion;
            match (rolling_shutter, found) {
                // Rates have seven decimals, velocities five; 0.03 s of them are left.
                (Some(_), Some(found)) => {
                    (0..6).for_each(|k| assert!((found[k] - motion[k]).abs() < 1e-6, "{found:?}"));
                }
                (None, None) => {}
                other => panic!("{other:?}"),
            }
        }
    }
}
