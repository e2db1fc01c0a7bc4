//! Synthetic crop fields.
