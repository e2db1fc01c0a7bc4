//! `rowgram view`: the map and the marks of a project in a browser.

use super::{print, print_json, project::ProjectArgs};
use rowgram_base::error::Error;
use rowgram_project::report::view::{Server, Viewer, serve};

/// Show the map and the marks of a project in a browser
///
/// The map of the report with every pixel of the orthomosaic, and with the photos: a click on a plant shows it in every photo
/// in whose frame it lies. Where there are surveyed points, ADDRESS/marks shows each in all photos that should show it;
/// marks are set, moved and removed in a loupe there, and saved into marks.csv, the only file that can be written. Prints the
/// address to open, and answers until it is stopped (Ctrl-C). Only programs on this machine can ask, only those that
/// know the address with its random part, and only for what these pages show. The rasters of the project are at
/// ADDRESS/rasters/ortho.tif and so on, for QGIS and GDAL.
///
/// PROJECT is a folder after rowgram run; after rowgram align there are marks alone.
///
/// Examples:
///   rowgram view field
///   rowgram view field --port 8080
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    #[command(flatten)]
    project: ProjectArgs,
    /// Port to listen on; 0 takes one that is free.
    #[arg(long, default_value_t = 0)]
    port: u16,
}

/// Runs the command.
///
/// # Errors
/// A project with neither a map nor anything to mark; a port that is taken.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = args.project.open()?;
    let viewer = Viewer::open(&project)?;
    let server = Server::listen(args.port)?;
    if args.project.json {
        print_json(&serde_json::json!({"url": server.url()}))?;
    } else {
        print(&format!("{}  (Ctrl-C ends)", server.url()))?;
    }
    serve(server, viewer)
}
