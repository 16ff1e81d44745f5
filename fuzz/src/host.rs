//! Files of the host's directory: any bytes are an entries file or an error; what is read survives
//! being written.

use fipa_sds::fuzzing::{file_name, read_and_written};

/// Reads the bytes as an entries file, and as the name of one.
pub fn play(bytes: &[u8]) {
    match read_and_written(bytes) {
        Ok(written) => {
            read_and_written(&written).expect("what was written is read");
        }
        Err(error) => assert!(!error.is_empty()),
    }
    if let Ok(name) = std::str::from_utf8(bytes) {
        file_name(name);
    }
}
