//! `rowgram view`: the map of a project in a browser.

use super::{print, print_json, project};
use rowgram_base::error::Error;
use rowgram_project::report::view::{Server, Viewer, serve};
use std::path::PathBuf;

/// Show the map of a project in a browser, in full resolution
///
/// The map of the report with every pixel of the orthomosaic, and with the photos: a click on a plant shows it in every photo
/// in whose frame it lies. Prints the address to open, and answers until it is stopped (Ctrl-C). Only programs on this
/// machine can ask, only those that know the address with its random part, and only for what the map shows. The rasters
/// of the project are at ADDRESS/rasters/ortho.tif and so on, for QGIS and GDAL.
///
/// PROJECT is a folder after rowgram run.
///
/// Examples:
///   rowgram view field
///   rowgram view field --port 8080
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder of the project.
    project: PathBuf,
    /// Folder of results [default: PROJECT/rowgram].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Port to listen on; 0 takes one that is free.
    #[arg(long, default_value_t = 0)]
    port: u16,
    /// Print the address as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A project without a map; a port that is taken.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let project = project::open(&args.project, args.output.as_deref())?;
    let viewer = Viewer::open(&project)?;
    let server = Server::listen(args.port)?;
    if args.json {
        print_json(&serde_json::json!({"url": server.url()}))?;
    } else {
        print(&format!("{}  (Ctrl-C ends)", server.url()))?;
    }
    serve(server, viewer)
}
