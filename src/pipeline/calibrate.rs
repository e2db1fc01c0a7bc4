//! A camera from photos of a chessboard.

use std::path::PathBuf;

crate::options! {
    /// A camera from photos of a chessboard, all by one camera at one focus and zoom.
    pub struct CalibrateOptions in "calibrate" {
        /// Folder with the photos of the board; the stage is done where it exists.
        pub images: PathBuf = "calibration".into();
        /// Inner corners of the board, where four squares meet: of a row times of a column.
        pub board: Option<String> = None, example "\"8x6\"";
        /// Side of a square. It sets the scale of the poses of the board, nothing of the lens.
        pub square_m: Option<f64> = None, limits POSITIVE, example "0.025";
    }
}
