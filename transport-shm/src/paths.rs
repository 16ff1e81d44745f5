//! The paths of the files of processes.

use std::path::{Path, PathBuf};

use fipa_transport::Incarnation;

use crate::shared_files::{SHM, shared_files};

/// Suffix of the file names of segments.
pub(crate) const CONTENT: &str = "content";

/// Paths of the files of processes.
#[derive(Debug, Clone)]
pub(crate) struct ProcessPaths {
    directory: PathBuf,
    prefix: String,
}

impl ProcessPaths {
    pub(crate) fn new(root: &Path, prefix: &str) -> Self {
        Self {
            directory: root.join("processes"),
            prefix: format!("{prefix}_"),
        }
    }

    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    pub(crate) fn liveness_fifo(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.live", self.prefix))
    }

    pub(crate) fn doorbell(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.bell", self.prefix))
    }

    pub(crate) fn status_page(&self, of: Incarnation) -> PathBuf {
        Path::new(SHM).join(format!("{}{of}.page", self.prefix))
    }

    /// Path of a segment of content for several receivers.
    pub(crate) fn segment(&self, of: Incarnation, number: u64) -> PathBuf {
        Path::new(SHM).join(format!("{}{of}.{number}.{CONTENT}", self.prefix))
    }

    /// Passes the files of these processes to `remove`.
    pub(crate) fn remove(&self, of: &[Incarnation], remove: impl Fn(&Path)) {
        if of.is_empty() {
            return;
        }
        // One pass for all processes, because other users may have many files here.
        for file in shared_files() {
            let name = file.file_name();
            if let Some((owner, kind)) = name.to_str().and_then(|name| self.parse(name))
                && kind.ends_with(CONTENT)
                && of.contains(&owner)
            {
                remove(&file.path());
            }
        }
        for one in of {
            // The liveness FIFO goes last: as long as it exists, a later cleanup finds the process and
            // removes the other files. A missing file is not an error.
            for path in [
                self.status_page(*one),
                self.doorbell(*one),
                self.liveness_fifo(*one),
            ] {
                remove(&path);
            }
        }
    }

    /// Splits the name of a file into the process and the kind of file.
    pub(crate) fn parse<'a>(&self, name: &'a str) -> Option<(Incarnation, &'a str)> {
        let (digits, kind) = name.strip_prefix(&self.prefix)?.split_once('.')?;
        Some((digits.parse().ok()?, kind))
    }
}
