//! The files of a project folder have their columns, and say what the twin says.

use data_synth::{
    files,
    twin::{FlightPreset, Twin, TwinConfig},
};

fn twin() -> Twin {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.field.rows = 8;
    config.field.row_length_m = 10.0;
    config.field.habit.tiller_fraction = 0.2;
    config.tie_points.per_photo = 20;
    config.build().unwrap()
}

/// Header and fields of a table.
struct Table(Vec<String>, Vec<Vec<String>>);

impl Table {
    fn numbers(&self, column: &str) -> Vec<f64> {
        let place = self.0.iter().position(|name| name == column).unwrap();
        self.1.iter().map(|row| row[place].parse().unwrap()).collect()
    }
}

fn table(
    twin: &Twin,
    fill: impl Fn(&Twin, &mut dyn std::io::Write) -> std::io::Result<()>,
) -> Table {
    let mut bytes = Vec::new();
    fill(twin, &mut bytes).unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let mut lines = text.lines().map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
    let header = lines.next().unwrap();
    let rows: Vec<_> = lines.collect();
    assert!(rows.iter().all(|row| row.len() == header.len()), "{header:?}");
    Table(header, rows)
}

#[test]
fn every_table_has_its_columns_and_rows() {
    let twin = twin();
    type Fill = fn(&Twin, &mut dyn std::io::Write) -> std::io::Result<()>;
    let leaves = twin.field().leaves().count();
    let cases: [(Fill, &str, usize); 10] = [
        (
            files::gcps,
            "label,easting_m,northing_m,height_m,Accuracy_Horizontal,Accuracy_Vertical,role",
            9,
        ),
        (files::true_gcps, "label,easting_m,northing_m,height_m,role", 9),
        (files::marks, "image,label,u_px,v_px", twin.marks.len()),
        (files::true_marks, "image,label,u_px,v_px", twin.marks.len()),
        (
            files::geolocation,
            "image_name,lat,lon,gps_height,easting_m,northing_m,height_m,Accuracy_Horizontal,Accuracy_Vertical",
            twin.shots.len(),
        ),
        (
            files::plants,
            "plant,u_px,v_px,row,site,second,plot,easting_m,northing_m,height_m,x_m,y_m,\
             lean_east_m,lean_north_m,leaves,tillers,panicles",
            twin.field().plants.len(),
        ),
        (
            files::leaves,
            "leaf,plant,stalk,length_m,width_m,area_m2,visible_fraction,azimuth_deg,hue_deg,senescent,\
             collar_easting_m,collar_northing_m,collar_height_m",
            leaves,
        ),
        (files::leaf_axes, "leaf,node,easting_m,northing_m,height_m,half_width_m", 9 * leaves),
        (files::rows, "row,node,easting_m,northing_m,height_m,u_px,v_px", 8 * 21),
        (
            files::weeds,
            "weed,kind,leaves,easting_m,northing_m,height_m,u_px,v_px",
            twin.weeds().len(),
        ),
    ];
    for (fill, header, rows) in cases {
        let table = table(&twin, fill);
        assert_eq!(table.0.join(","), header);
        assert_eq!(table.1.len(), rows, "{header}");
    }
}

#[test]
fn tables_agree_with_each_other() {
    let twin = twin();
    let (plants, leaves, plots) =
        (table(&twin, files::plants), table(&twin, files::leaves), table(&twin, files::plots));
    let mut counts = vec![0.0; plants.1.len()];
    for owner in leaves.numbers("plant") {
        counts[owner as usize] += 1.0;
    }
    assert_eq!(counts, plants.numbers("leaves"));
    let mut per_plot = vec![[0.0; 2]; plots.1.len()];
    for (plot, leaves) in plants.numbers("plot").iter().zip(&counts) {
        per_plot[*plot as usize][0] += 1.0;
        per_plot[*plot as usize][1] += leaves;
    }
    assert_eq!(per_plot.iter().map(|c| c[0]).collect::<Vec<_>>(), plots.numbers("plants"));
    assert_eq!(per_plot.iter().map(|c| c[1]).collect::<Vec<_>>(), plots.numbers("leaves"));
    let area: f64 = leaves.numbers("area_m2").iter().sum();
    approx::assert_relative_eq!(
        area,
        plots.numbers("leaf_area_m2").iter().sum::<f64>(),
        epsilon = 1e-4
    );
    assert!(leaves.numbers("visible_fraction").iter().all(|part| (0.0..=1.0).contains(part)));

    // Axes end to end are as long as their leaves, up to what the ground lifts.
    let axes = table(&twin, files::leaf_axes);
    let (e, n, h) =
        (axes.numbers("easting_m"), axes.numbers("northing_m"), axes.numbers("height_m"));
    let lengths = leaves.numbers("length_m");
    let agree = (0..lengths.len()).filter(|leaf| {
        let arc: f64 = (9 * leaf..9 * leaf + 8)
            .map(|i| f64::hypot(f64::hypot(e[i + 1] - e[i], n[i + 1] - n[i]), h[i + 1] - h[i]))
            .sum();
        (arc / lengths[*leaf] - 1.0).abs() < 0.02
    });
    assert!(agree.count() as f64 > 0.8 * lengths.len() as f64);

    // Survey and clicks scatter about the truth as asked.
    let (survey, truth) = (table(&twin, files::gcps), table(&twin, files::true_gcps));
    for column in ["easting_m", "northing_m", "height_m"] {
        let errors =
            survey.numbers(column).into_iter().zip(truth.numbers(column)).map(|(a, b)| a - b);
        let errors: Vec<f64> = errors.collect();
        assert!(
            errors.iter().any(|e| e.abs() > 0.001) && errors.iter().all(|e| e.abs() < 0.08),
            "{errors:?}"
        );
    }
    let (clicks, truth) = (table(&twin, files::marks), table(&twin, files::true_marks));
    let errors: Vec<f64> = ["u_px", "v_px"]
        .iter()
        .flat_map(|c| {
            clicks
                .numbers(c)
                .into_iter()
                .zip(truth.numbers(c))
                .map(|(a, b)| a - b)
                .collect::<Vec<_>>()
        })
        .collect();
    let (_, deviation_px) = crate::moments(&errors);
    let count = errors.len() as f64;
    assert!(
        (deviation_px / 0.4 - 1.0).abs() < 4.0 / (2.0 * count).sqrt(),
        "{deviation_px} px of {count}"
    );
}

#[test]
fn the_dem_is_the_ground() {
    let twin = twin();
    let mut bytes = Vec::new();
    files::dem(&twin, &mut bytes).unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let mut lines = text.lines();
    let mut head = |name: &str| -> f64 {
        let (key, value) = lines.next().unwrap().split_once(' ').unwrap();
        assert_eq!(key, name);
        value.parse().unwrap()
    };
    let (columns, rows) = (head("ncols") as usize, head("nrows") as usize);
    let (left, bottom, cell) = (head("xllcorner"), head("yllcorner"), head("cellsize"));
    head("NODATA_value");
    let values: Vec<Vec<f64>> =
        lines.map(|line| line.split(' ').map(|value| value.parse().unwrap()).collect()).collect();
    assert_eq!(values.len(), rows);
    let site = twin.site.config();
    for (row, line) in values.iter().enumerate() {
        assert_eq!(line.len(), columns);
        for (column, value) in line.iter().enumerate().step_by(7) {
            let x = left + (column as f64 + 0.5) * cell - site.easting_m;
            let y = bottom + (rows as f64 - 0.5 - row as f64) * cell - site.northing_m;
            let height = site.height_m + twin.field().terrain.height_m(x, y);
            approx::assert_abs_diff_eq!(*value, height, epsilon = 1e-4);
        }
    }
    for plant in &twin.field().plants {
        let [e, n, _] = twin.site.grid_m([plant.x_m, plant.y_m, plant.z_m]);
        assert!((left..left + columns as f64 * cell).contains(&e));
        assert!((bottom..bottom + rows as f64 * cell).contains(&n));
    }
}
