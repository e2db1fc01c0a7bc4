//! `rowgram ortho query`: from a place on an orthomosaic to the pixel of the photo behind it, and back.

use super::project;
use rowgram_base::error::Error;
use rowgram_project::query::{OrthophotoOrigins, Sighting, query};
use std::path::PathBuf;

/// Ask an orthomosaic which photo pixel is behind a place, or where a photo pixel is
///
/// Coordinates are metres in the mapping frame; pixels of photos are columns and rows, the centre of the first one being
/// 0,0.
///
/// Examples:
///   rowgram ortho query field --at 500670.2,4480143.1
///   rowgram ortho query field --at 500670.2,4480143.1 --every-photo
///   rowgram ortho query field --photo IMG_0031.JPG --pixel 2011.5,1490
///   rowgram ortho query ortho.tif --at 500670.2,4480143.1 --json
///   rowgram ortho query field --write origins.tif
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment, arg_required_else_help = true)]
pub(super) struct Args {
    /// Folder of a project, or an orthomosaic with its record (.json) and its provenance beside it.
    input: PathBuf,
    /// Folder of results of the project [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// A place: gives the photo and the pixel behind it.
    #[arg(
        long,
        value_name = "X,Y",
        value_delimiter = ',',
        allow_hyphen_values = true,
        required_unless_present_any = ["photo", "write"],
        conflicts_with = "photo"
    )]
    at: Vec<f64>,
    /// With --at: every photo in whose frame the place lies, the steepest view first.
    #[arg(long, conflicts_with = "photo")]
    every_photo: bool,
    /// A photo, with --pixel: gives the place. By name with or without ending; with its folder where several photos share the name.
    #[arg(long, value_name = "NAME", requires = "pixel")]
    photo: Option<String>,
    /// Column and row in the photo.
    #[arg(
        long,
        value_name = "U,V",
        value_delimiter = ',',
        allow_hyphen_values = true,
        requires = "photo"
    )]
    pixel: Vec<f64>,
    /// Write a GeoTIFF of all pixels: number of the photo, column and row in it, view angle (degrees), distance to the seam (metres; -1
    /// where there is none).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["at", "photo"])]
    write: Option<PathBuf>,
    /// Replace a file that exists.
    #[arg(long, requires = "write")]
    force: bool,
    /// The surface, if it is not where it was.
    #[arg(long, value_name = "FILE")]
    dem: Option<PathBuf>,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// An orthomosaic without its record, a place that it does not show, a photo that it does not know.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let origins = if args.input.is_dir() {
        query(&project::open(&args.input, args.output.as_deref())?, args.dem.as_deref())?
    } else {
        OrthophotoOrigins::open(&args.input, args.dem.as_deref())?
    };
    if let Some(path) = &args.write {
        return project::present(
            false,
            |monitor| origins.write_full(path, args.force, monitor),
            |()| path.display().to_string(),
        );
    }
    if let (Some(photo), &[u, v]) = (&args.photo, &args.pixel[..]) {
        let found = origins.map_position(photo, [u, v])?;
        if args.json {
            return super::print_json(&found);
        }
        return super::print(&format!(
            "x {:.4} y {:.4} z {:.4} m; column {:.2} row {:.2} of the orthomosaic{}",
            found.x_m,
            found.y_m,
            found.z_m,
            found.column,
            found.row,
            match found.is_source {
                Some(false) => ", which is taken from another photo",
                Some(true) => ", which is taken from this photo",
                None => "",
            }
        ));
    }
    let &[x, y] = &args.at[..] else {
        return Err(Error::Argument("expected --at X,Y, or --photo NAME with --pixel U,V".into()));
    };
    if args.every_photo {
        let found = origins.sightings([x, y])?;
        if args.json {
            return super::print_json(&found);
        }
        let line = |of: &Sighting| {
            format!(
                "{} u {:.3} v {:.3} px; view angle {:.1} degrees{}",
                of.image,
                of.u_px,
                of.v_px,
                of.view_angle_deg,
                if of.is_source == Some(true) { "; the orthomosaic shows this one" } else { "" }
            )
        };
        return super::print(&found.iter().map(line).collect::<Vec<_>>().join("\n"));
    }
    let found = origins.photo_pixel([x, y])?;
    if args.json {
        return super::print_json(&found);
    }
    super::print(&format!(
        "{} u {:.3} v {:.3} px; height {:.3} m, view angle {:.1} degrees{}",
        found.path.display(),
        found.u_px,
        found.v_px,
        found.z_m,
        found.view_angle_deg,
        found.to_seam_m.map_or(String::new(), |m| format!(", {m:.2} m to the seam"))
    ))
}
