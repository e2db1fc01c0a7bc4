//! The tables of a report, as CSV. Standard deviations are scaled by `sigma0`.

use super::Adjustment;
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvWriter;
use rowgram_optim::output;
use rowgram_survey::problems::adjustment::{ObservationRef, TestedObservation};
use std::path::Path;

pub(super) fn write(folder: &Path, adjustment: &Adjustment, force: bool) -> Result<(), Error> {
    let adjusted = &adjustment.adjusted;
    let (survey, statistics) = (&adjusted.reconstruction, &adjusted.statistics);
    let sigma0 = statistics.sigma0;
    // Rows are made as they are written: all of them at once would be the largest thing in memory.
    let table = |name: &str, header: &[&str], rows: &mut dyn Iterator<Item = Vec<String>>| {
        save(&folder.join(name), header, rows, force)
    };
    let number = |v: f64| format!("{v:.6}");

    let header = [
        "image",
        "point",
        "u_px",
        "v_px",
        "residual_u_px",
        "residual_v_px",
        "redundancy_u",
        "redundancy_v",
        "w_u",
        "w_v",
        "test",
    ];
    let measured = |subject: ObservationRef| match subject {
        ObservationRef::TieObservation(k) => {
            let o = &survey.observations[k];
            let sigma = survey.tie_sigma_px;
            Some((o.image, survey.points[o.point as usize].id.to_string(), o.image_px, sigma))
        }
        ObservationRef::Mark(k) => {
            let mark = &survey.marks[k];
            let name = survey.ground[mark.ground as usize].name.clone();
            Some((mark.image, name, mark.image_px, mark.sigma_px))
        }
        ObservationRef::Control(_) | ObservationRef::Position(_) | ObservationRef::ScaleBar(_) => {
            None
        }
    };
    let row = |tested: &TestedObservation| {
        let (image, point, at, sigma) = measured(tested.subject)?;
        let sigma = sigma * adjustment.settings.sigma_factors[tested.group as usize];
        let mut row = vec![survey.images[image as usize].name.clone(), point];
        row.extend(
            [at[0], at[1], sigma * tested.residual[0], sigma * tested.residual[1]].map(number),
        );
        row.extend([0, 1].map(|k| number(tested.redundancy[k])));
        row.extend([0, 1].map(|k| number(tested.standardised()[k])));
        row.push(number(tested.statistic));
        Some(row)
    };
    let marks = |tested: &&TestedObservation| matches!(tested.subject, ObservationRef::Mark(_));
    table("marks.csv", &header, &mut statistics.tested.iter().filter(marks).filter_map(row))?;
    let ties =
        |tested: &&TestedObservation| matches!(tested.subject, ObservationRef::TieObservation(_));
    table("tie_points.csv", &header, &mut statistics.tested.iter().filter(ties).filter_map(row))?;

    let other = statistics.tested.iter().filter(|tested| measured(tested.subject).is_none());
    let mut rows = other.map(|tested| {
        let mut row = vec![adjusted.name(tested.subject)];
        for values in [tested.residual, tested.redundancy, tested.standardised()] {
            row.extend((0..3).map(|k| {
                if k < usize::from(tested.rows) { number(values[k]) } else { String::new() }
            }));
        }
        row.push(number(tested.statistic));
        row.push(tested.freedom.to_string());
        row
    });
    let header = [
        "observation",
        "residual_1_sigma",
        "residual_2_sigma",
        "residual_3_sigma",
        "redundancy_1",
        "redundancy_2",
        "redundancy_3",
        "w_1",
        "w_2",
        "w_3",
        "test",
        "freedom",
    ];
    table("control_tests.csv", &header, &mut rows)?;

    let mut rows = survey.images.iter().zip(&statistics.images).map(|(image, accuracy)| {
        let mut row = vec![image.name.clone()];
        row.extend(image.pose.centre_m().map(number));
        row.extend(image.pose.omega_phi_kappa_rad().map(|angle| number(angle.to_degrees())));
        let sigma = |k: usize| number(sigma0 * accuracy.centre_m2[k][k].max(0.0).sqrt());
        row.extend([0, 1, 2].map(sigma));
        row.extend(accuracy.angles_rad.map(|angle| number(sigma0 * angle.to_degrees())));
        row.extend(accuracy.ellipsoid().map(|axis| number(sigma0 * axis)));
        row
    });
    let header = [
        "image",
        "x_m",
        "y_m",
        "z_m",
        "omega_deg",
        "phi_deg",
        "kappa_deg",
        "sigma_x_m",
        "sigma_y_m",
        "sigma_z_m",
        "sigma_omega_deg",
        "sigma_phi_deg",
        "sigma_kappa_deg",
        "ellipsoid_1_m",
        "ellipsoid_2_m",
        "ellipsoid_3_m",
    ];
    table("images.csv", &header, &mut rows)?;

    let mut rows = survey.points.iter().zip(&statistics.points).map(|(point, accuracy)| {
        let mut row = vec![point.id.to_string()];
        row.extend(point.position_m.map(number));
        row.extend(
            [0, 1, 2].map(|k| number(sigma0 * accuracy.covariance_m2[k][k].max(0.0).sqrt())),
        );
        row
    });
    let header = ["point", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m"];
    table("points.csv", &header, &mut rows)?;

    for interior in &statistics.interiors {
        let mut rows = interior.names.iter().enumerate().map(|(k, name)| {
            let mut row = vec![(*name).to_owned(), format!("{:e}", interior.values[k])];
            row.push(format!("{:e}", sigma0 * interior.standard_deviations[k]));
            row.extend(interior.correlation[k].iter().map(|&v| number(v)));
            row
        });
        let mut header = vec!["parameter", "value", "standard_deviation"];
        header.extend(&interior.names);
        table(&format!("interior-{}.csv", interior.camera + 1), &header, &mut rows)?;
    }

    let aside = adjustment.unmatched.iter().chain(&adjusted.validated.excluded).map(|aside| {
        let word = |word: &Option<String>| word.clone().unwrap_or_default();
        vec![aside.kind.to_string(), word(&aside.image), word(&aside.point), aside.reason.clone()]
    });
    let removed = adjustment.removed.iter().map(|removed| {
        let reason = format!("taken out at {:.2} times the critical value", removed.excess);
        vec![removed.group.name().to_owned(), String::new(), removed.name.clone(), reason]
    });
    let header = ["kind", "image", "point", "reason"];
    table("excluded.csv", &header, &mut aside.chain(removed))
}

fn save(
    path: &Path,
    header: &[&str],
    rows: &mut dyn Iterator<Item = Vec<String>>,
    force: bool,
) -> Result<(), Error> {
    output::write(path, force, |out| {
        let mut writer = CsvWriter::new(out);
        writer.write_record(header)?;
        for row in rows {
            writer.write_record(row)?;
        }
        writer.flush()
    })?;
    Ok(())
}
