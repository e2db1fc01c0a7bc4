//! The files of a project folder, as text: what a crew would bring home, and the truth.
//!
//! Positions in the mapping frame are easting, northing and ellipsoidal height, metres; image positions are
//! pixels with the centre of the top-left pixel at (0, 0). Each function writes one file to any writer;
//! nothing here opens one. Numbers from 0 tie the tables together: `plant`, `leaf`, `plot`, `row`.

use crate::{
    field::{Field, Frame},
    leaf::NODES,
    tie_points::TiePoint,
    twin::Twin,
    visible::visible_fractions,
};
use std::io::{self, Write};

type Result = io::Result<()>;

/// `gcps.csv`: what the survey says of the targets; `role` is `control` or `check`.
///
/// # Errors
/// What the writer says, here and below.
pub fn gcps(twin: &Twin, out: &mut dyn Write) -> Result {
    let config = &twin.config.targets;
    writeln!(
        out,
        "label,easting_m,northing_m,height_m,Accuracy_Horizontal,Accuracy_Vertical,role"
    )?;
    for target in &twin.targets {
        let [e, n, h] = twin.site.grid_m(target.surveyed_m);
        let (horizontal, vertical) = (config.survey_horizontal_m, config.survey_vertical_m);
        let (label, role) = (&target.label, target.role.word());
        writeln!(out, "{label},{e:.4},{n:.4},{h:.4},{horizontal},{vertical},{role}")?;
    }
    Ok(())
}

/// `truth/gcps.csv`: where the targets truly are.
///
/// # Errors
/// What the writer says.
pub fn true_gcps(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "label,easting_m,northing_m,height_m,role")?;
    for target in &twin.targets {
        let [e, n, h] = twin.site.grid_m(target.place_m);
        writeln!(out, "{},{e:.5},{n:.5},{h:.5},{}", target.label, target.role.word())?;
    }
    Ok(())
}

/// `marks.csv`: the targets as a person clicked them.
///
/// # Errors
/// What the writer says.
pub fn marks(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "image,label,u_px,v_px")?;
    for mark in &twin.marks {
        let [u, v] = mark.marked_px;
        let (image, label) = (&twin.shots[mark.shot].name, &twin.targets[mark.target].label);
        writeln!(out, "{image},{label},{u:.3},{v:.3}")?;
    }
    Ok(())
}

/// `truth/marks.csv`: where the targets truly appear.
///
/// # Errors
/// What the writer says.
pub fn true_marks(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "image,label,u_px,v_px")?;
    for mark in &twin.marks {
        let [u, v] = mark.true_px;
        let (image, label) = (&twin.shots[mark.shot].name, &twin.targets[mark.target].label);
        writeln!(out, "{image},{label},{u:.6},{v:.6}")?;
    }
    Ok(())
}

/// `geolocation.csv`: what the receiver says, as in the photos' EXIF, with all digits, and in the mapping frame.
///
/// # Errors
/// What the writer says; a position without latitude and longitude.
pub fn geolocation(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(
        out,
        "image_name,lat,lon,gps_height,easting_m,northing_m,height_m,Accuracy_Horizontal,Accuracy_Vertical"
    )?;
    let config = &twin.config.flight.gnss;
    // No receiver claims to be exact.
    let claimed_m = [config.horizontal_m, config.vertical_m]
        .map(|sigma_m| config.stated_sigma_m.unwrap_or_else(|| sigma_m.max(0.01)));
    for shot in &twin.shots {
        let [latitude, longitude, height] =
            twin.site.geographic(shot.gnss_m).map_err(io::Error::other)?;
        let [e, n, h] = twin.site.grid_m(shot.gnss_m);
        writeln!(
            out,
            "{},{latitude:.9},{longitude:.9},{height:.3},{e:.4},{n:.4},{h:.4},{},{}",
            shot.name, claimed_m[0], claimed_m[1]
        )?;
    }
    Ok(())
}

/// `truth/camera.toml`: the true camera.
///
/// # Errors
/// What the writer says.
pub fn camera(twin: &Twin, out: &mut dyn Write) -> Result {
    let camera = &twin.config.camera;
    writeln!(out, "name = {:?}", format!("{} {}", camera.make, camera.model))?;
    writeln!(out, "model = \"smac\"")?;
    writeln!(
        out,
        "width_px = {}\nheight_px = {}\n\n[parameters]",
        camera.width_px, camera.height_px
    )?;
    for (name, value) in [
        ("c_px", camera.c_px),
        ("xp_px", camera.xp_px),
        ("yp_px", camera.yp_px),
        ("K0", camera.k0),
        ("K1", camera.k1),
        ("K2", camera.k2),
        ("K3", camera.k3),
        ("P1", camera.p1),
        ("P2", camera.p2),
        ("R0_px", camera.r0_px),
    ] {
        writeln!(out, "{name} = {value:?}")?;
    }
    Ok(())
}

/// `truth/exterior_orientation.csv`: every photo's at its middle row. `R = R_x(omega) R_y(phi) R_z(kappa)`
/// turns the camera frame (x right, y up, looking along -z) into the mapping frame.
///
/// # Errors
/// What the writer says.
pub fn exterior_orientation(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(
        out,
        "image,easting_m,northing_m,height_m,omega_deg,phi_deg,kappa_deg,strip,time_s,\
         velocity_east_m_s,velocity_north_m_s,velocity_up_m_s,turn_x_rad_s,turn_y_rad_s,turn_z_rad_s,readout_s"
    )?;
    for shot in &twin.shots {
        let [e, n, h] = twin.site.grid_m(shot.centre_m);
        let [omega, phi, kappa] = shot.angles_rad().map(f64::to_degrees);
        let [ve, vn, vu] = shot.velocity_m_s;
        let [tx, ty, tz] = shot.turn_rad_s;
        writeln!(
            out,
            "{},{e:.5},{n:.5},{h:.5},{omega:.9},{phi:.9},{kappa:.9},{},{:.4},{ve:.6},{vn:.6},{vu:.6},\
             {tx:.9},{ty:.9},{tz:.9},{}",
            shot.name, shot.strip, shot.time_s, shot.readout_s
        )?;
    }
    Ok(())
}

/// `truth/light.csv`: what the light of each channel is multiplied by in every photo, vignetting aside.
///
/// # Errors
/// What the writer says.
pub fn light(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "image,light,sensitivity,gain_red,gain_green,gain_blue")?;
    let studio = twin.studio();
    for (number, shot) in twin.shots.iter().enumerate() {
        let [red, green, blue] = studio.gains(shot, number);
        let (light, sensitivity) = (shot.light, shot.sensitivity.unwrap_or(1.0));
        writeln!(out, "{},{light:.6},{sensitivity:.6},{red:.6},{green:.6},{blue:.6}", shot.name)?;
    }
    Ok(())
}

/// `truth/plants.csv`: every stalk base, with its pixel in the raster from straight above.
///
/// # Errors
/// What the writer says.
pub fn plants(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(
        out,
        "plant,u_px,v_px,row,site,second,plot,easting_m,northing_m,height_m,x_m,y_m,\
         lean_east_m,lean_north_m,leaves,tillers,panicles"
    )?;
    for (number, plant) in twin.field().plants.iter().enumerate() {
        let [e, n, h] = twin.site.grid_m([plant.x_m, plant.y_m, plant.z_m]);
        let panicles = plant.stalks.iter().filter(|stalk| stalk.panicle_m > 0.0).count();
        writeln!(
            out,
            "{number},{:.4},{:.4},{},{},{},{},{e:.5},{n:.5},{h:.5},{:.5},{:.5},{:.5},{:.5},{},{},{panicles}",
            plant.u_px,
            plant.v_px,
            plant.row,
            plant.site,
            u8::from(plant.second),
            plant.plot,
            plant.x_m,
            plant.y_m,
            plant.tilt_m[0],
            plant.tilt_m[1],
            plant.leaves.len(),
            plant.stalks.len() - 1,
        )?;
    }
    Ok(())
}

/// `truth/leaves.csv`: every leaf's traits. The visible fraction is the part of its plan view that no higher leaf hides
/// from straight above.
///
/// # Errors
/// What the writer says.
pub fn leaves(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(
        out,
        "leaf,plant,stalk,length_m,width_m,area_m2,visible_fraction,azimuth_deg,hue_deg,senescent,\
         collar_easting_m,collar_northing_m,collar_height_m"
    )?;
    let visible = visible_fractions(twin.field(), twin.weeds());
    let mut number = 0;
    for (owner, plant) in twin.field().plants.iter().enumerate() {
        for leaf in &plant.leaves {
            let [e, n, h] = twin.site.grid_m(twin.field().leaf_axis_m(plant.z_m, leaf)[0]);
            writeln!(
                out,
                "{number},{owner},{},{:.5},{:.5},{:.7},{:.4},{:.3},{:.2},{},{e:.5},{n:.5},{h:.5}",
                leaf.stalk,
                leaf.length_m,
                leaf.width_m,
                leaf.area_m2(),
                visible[number],
                leaf.azimuth_rad.to_degrees(),
                leaf.hue_deg,
                u8::from(leaf.senescent),
            )?;
            number += 1;
        }
    }
    Ok(())
}

/// `truth/leaf_axes.csv`: every leaf's axis from the collar to the tip, with half its width at each node.
///
/// # Errors
/// What the writer says.
pub fn leaf_axes(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "leaf,node,easting_m,northing_m,height_m,half_width_m")?;
    let mut number = 0;
    for plant in &twin.field().plants {
        for leaf in &plant.leaves {
            let axis = twin.field().leaf_axis_m(plant.z_m, leaf);
            for node in 0..NODES {
                let [e, n, h] = twin.site.grid_m(axis[node]);
                let half = leaf.half_width_m[node];
                writeln!(out, "{number},{node},{e:.4},{n:.4},{h:.4},{half:.5}")?;
            }
            number += 1;
        }
    }
    Ok(())
}

/// `truth/rows.csv`: the middle line of every row as a polyline of 21 nodes.
///
/// # Errors
/// What the writer says.
pub fn rows(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "row,node,easting_m,northing_m,height_m,u_px,v_px")?;
    let (field, config) = (twin.field(), &twin.field().config);
    for row in 0..config.rows {
        for node in 0..=20 {
            let along = config.row_length_m * (f64::from(node) / 20.0 - 0.5);
            let [x, y] = config.ground(along, config.row_across(row, along));
            let [e, n, h] = twin.site.grid_m([x, y, field.terrain.height_m(x, y)]);
            let [u, v] = field.frame.pixel(x, y);
            writeln!(out, "{row},{node},{e:.4},{n:.4},{h:.4},{u:.3},{v:.3}")?;
        }
    }
    Ok(())
}

/// `truth/plots.csv`: plants, leaves and leaf area of every plot, and its corners in the order start-first row,
/// end-first row, end-last row, start-last row, half a row distance around the rows.
///
/// # Errors
/// What the writer says.
pub fn plots(twin: &Twin, out: &mut dyn Write) -> Result {
    write!(out, "plot,first_row,last_row,plants,leaves,leaf_area_m2")?;
    for corner in 0..4 {
        write!(out, ",easting_{corner}_m,northing_{corner}_m")?;
    }
    writeln!(out)?;
    let (field, config) = (twin.field(), &twin.field().config);
    let [side, along] = config.plots.count(config.rows, config.row_length_m);
    let mut totals = vec![(0usize, 0usize, 0.0f64); side * along];
    for plant in &field.plants {
        let total = &mut totals[plant.plot];
        total.0 += 1;
        total.1 += plant.leaves.len();
        total.2 += plant.leaves.iter().map(|leaf| leaf.area_m2()).sum::<f64>();
    }
    for (plot, (plants, leaves, area)) in totals.into_iter().enumerate() {
        let ([first, last], [start, end]) =
            config.plots.extent(config.rows, config.row_length_m, plot);
        write!(out, "{plot},{first},{last},{plants},{leaves},{area:.6}")?;
        let half = 0.5 * config.inter_row_m;
        for (at, row, beside) in
            [(start, first, -half), (end, first, -half), (end, last, half), (start, last, half)]
        {
            let [x, y] = config.ground(at, config.row_across(row, at) + beside);
            let [e, n, _] = twin.site.grid_m([x, y, 0.0]);
            write!(out, ",{e:.4},{n:.4}")?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// `truth/weeds.csv`: every weed's middle.
///
/// # Errors
/// What the writer says.
pub fn weeds(twin: &Twin, out: &mut dyn Write) -> Result {
    writeln!(out, "weed,kind,leaves,easting_m,northing_m,height_m,u_px,v_px")?;
    for (number, weed) in twin.weeds().iter().enumerate() {
        let height = twin.field().terrain.height_m(weed.x_m, weed.y_m);
        let [e, n, h] = twin.site.grid_m([weed.x_m, weed.y_m, height]);
        let [u, v] = twin.field().frame.pixel(weed.x_m, weed.y_m);
        let kind = if weed.grass { "grass" } else { "broad" };
        writeln!(out, "{number},{kind},{},{e:.4},{n:.4},{h:.4},{u:.3},{v:.3}", weed.leaves.len())?;
    }
    Ok(())
}

/// `truth/dem.asc`: the ground's height on a lattice of 10 cm as an ESRI ASCII grid, a raster of cells whose
/// values are those at their centres.
///
/// # Errors
/// What the writer says.
pub fn dem(twin: &Twin, out: &mut dyn Write) -> Result {
    const CELL_M: f64 = 0.1;
    let frame = &twin.field().frame;
    let size = |pixels: u32| (f64::from(pixels) * frame.gsd_m / CELL_M).ceil() as usize + 1;
    let (columns, rows) = (size(frame.width_px), size(frame.height_px));
    let [left, top, _] = twin.site.grid_m([frame.left_m, frame.top_m, 0.0]);
    let (left, top) = ((left / CELL_M).floor() * CELL_M, (top / CELL_M).ceil() * CELL_M);
    let bottom = top - rows as f64 * CELL_M;
    write!(out, "ncols {columns}\nnrows {rows}\nxllcorner {left:.3}\nyllcorner {bottom:.3}\n")?;
    writeln!(out, "cellsize {CELL_M}\nNODATA_value -9999")?;
    let site = twin.site.config();
    for row in 0..rows {
        for column in 0..columns {
            let x = left + (column as f64 + 0.5) * CELL_M - site.easting_m;
            let y = top - (row as f64 + 0.5) * CELL_M - site.northing_m;
            let height = site.height_m + twin.field().terrain.height_m(x, y);
            write!(out, "{}{height:.4}", if column > 0 { " " } else { "" })?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// A world file beside a raster over the field: pixel size and the centre of the top-left pixel.
///
/// # Errors
/// What the writer says.
pub fn world(twin: &Twin, frame: &Frame, out: &mut dyn Write) -> Result {
    let [e, n, _] = twin.site.grid_m([frame.left_m, frame.top_m, 0.0]);
    write!(out, "{:?}\n0.0\n0.0\n{:?}\n{e:.5}\n{n:.5}\n", frame.gsd_m, -frame.gsd_m)
}

/// The mapping frame as well-known text, for `.prj` files.
pub fn projection(twin: &Twin) -> String {
    let epsg = twin.site.config().epsg;
    let (zone, south) = (epsg % 100, epsg > 32700);
    let meridian = 6 * zone as i32 - 183;
    let (letter, northing) = if south { ('S', 10_000_000) } else { ('N', 0) };
    format!(
        "PROJCS[\"WGS 84 / UTM zone {zone}{letter}\",GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",\
         SPHEROID[\"WGS 84\",6378137,298.257223563]],PRIMEM[\"Greenwich\",0],\
         UNIT[\"degree\",0.0174532925199433]],PROJECTION[\"Transverse_Mercator\"],\
         PARAMETER[\"latitude_of_origin\",0],PARAMETER[\"central_meridian\",{meridian}],\
         PARAMETER[\"scale_factor\",0.9996],PARAMETER[\"false_easting\",500000],\
         PARAMETER[\"false_northing\",{northing}],UNIT[\"metre\",1],AUTHORITY[\"EPSG\",\"{epsg}\"]]\n"
    )
}

/// `tie_points.csv`: the measurements of tie points made without photos.
///
/// # Errors
/// What the writer says.
pub fn tie_points(twin: &Twin, points: &[TiePoint], out: &mut dyn Write) -> Result {
    writeln!(out, "image,point,u_px,v_px")?;
    for (number, point) in points.iter().enumerate() {
        for sighting in &point.seen {
            let [u, v] = sighting.measured_px;
            writeln!(out, "{},{number},{u:.4},{v:.4}", twin.shots[sighting.shot].name)?;
        }
    }
    Ok(())
}

/// `truth/tie_points.csv`: where the tie points truly are, and how many of their measurements are gross.
///
/// # Errors
/// What the writer says.
pub fn true_tie_points(twin: &Twin, points: &[TiePoint], out: &mut dyn Write) -> Result {
    writeln!(out, "point,easting_m,northing_m,height_m,measurements,gross")?;
    for (number, point) in points.iter().enumerate() {
        let [e, n, h] = twin.site.grid_m(point.place_m);
        let gross = point.seen.iter().filter(|sighting| sighting.outlier).count();
        writeln!(out, "{number},{e:.5},{n:.5},{h:.5},{},{gross}", point.seen.len())?;
    }
    Ok(())
}

/// `truth/photos/*.csv`: the stalk bases that lie inside a photo, whether or not leaves hide them.
///
/// # Errors
/// What the writer says.
pub fn photo_plants(twin: &Twin, field: &Field, shot: usize, out: &mut dyn Write) -> Result {
    writeln!(out, "u_px,v_px,row,plant")?;
    for (number, plant) in field.plants.iter().enumerate() {
        let place = [plant.x_m, plant.y_m, plant.z_m];
        if let Some([u, v]) = twin.shots[shot].project(&twin.camera, place)
            && twin.camera.inside([u, v], 0.0)
        {
            writeln!(out, "{u:.4},{v:.4},{},{number}", plant.row)?;
        }
    }
    Ok(())
}
