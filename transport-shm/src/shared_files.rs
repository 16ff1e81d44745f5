//! Lists `/dev/shm`, where every user of the host may create files.

use std::fs::DirEntry;
use std::path::Path;

use fipa_transport::log_limit;

/// Mount point of POSIX shared memory on Linux.
pub(crate) const SHM: &str = "/dev/shm";

/// Maximum number of files that are examined, because a user of the host may create millions. Files that are not
/// found are removed by a later cleanup.
const MAX_FILES: usize = 131_072;

/// Entries of `/dev/shm`, of which the first 131,072 are examined.
pub(crate) fn shared_files() -> impl Iterator<Item = DirEntry> {
    listed(Path::new(SHM), MAX_FILES)
}

/// Entries of a directory, at most `most`. Skips those that cannot be read.
fn listed(directory: &Path, most: usize) -> impl Iterator<Item = DirEntry> {
    let found = std::fs::read_dir(directory).into_iter().flatten();
    let found = found.enumerate().take_while(move |(index, _)| {
        if *index >= most {
            log_limit::warn!(
                "{SHM} has more than {most} files, of which the other ones are ignored; `ls -l {SHM}` shows their owners"
            );
        }
        *index < most
    });
    found.filter_map(|(_, file)| file.ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_shared_files_that_are_examined_is_bounded() {
        let directory = tempfile::tempdir().unwrap();
        for name in 0..5 {
            std::fs::write(directory.path().join(name.to_string()), "").unwrap();
        }
        assert_eq!(listed(directory.path(), 3).count(), 3);
        assert_eq!(listed(directory.path(), 5).count(), 5);
        assert_eq!(listed(&directory.path().join("missing"), 5).count(), 0);
        assert!(shared_files().count() <= MAX_FILES);
    }
}
