//! Functions for the fuzz targets in `fuzz/`.

#[cfg(feature = "mdns")]
pub use crate::mdns::fuzzing::{Listener, announced};

pub use crate::host::fuzzing::{file_name, read_and_written, read_remote};
