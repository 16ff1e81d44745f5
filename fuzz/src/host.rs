//! Files of the host's directory. Any bytes are an entries file or an error. A valid file
//! is still valid after it is written again. The same holds for files with agents of other hosts.

use fipa_sds::fuzzing::{file_name, read_and_written, read_remote};

/// Reads the bytes as a file of either kind, and as the name of a file.
pub fn play(bytes: &[u8]) {
    match read_and_written(bytes) {
        Ok(written) => {
            read_and_written(&written).expect("a written file can be read");
        }
        Err(error) => assert!(!error.is_empty()),
    }
    read_remote(bytes);
    if let Ok(name) = std::str::from_utf8(bytes) {
        file_name(name);
    }
}
