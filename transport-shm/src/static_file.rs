//! The descriptions of iceoryx2's nodes and services, in files that are not synchronized with the disk.
//!
//! iceoryx2 calls `fsync` for each of these files, six times when a process starts. On a disk each call
//! takes milliseconds. After a crash of the system, the files of the processes that ran may be empty,
//! and the next process removes them. Everything else is that of iceoryx2's own storage.

use std::fs::{DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, ErrorKind, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::PathBuf;
use std::ptr::NonNull;
use std::time::Duration;

use iceoryx2::prelude::SemanticString as _;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_cal::named_concept::{
    FileName, NamedConcept, NamedConceptBuilder, NamedConceptConfiguration as _,
    NamedConceptDoesExistError, NamedConceptListError, NamedConceptMgmt,
    NamedConceptPathHintRemoveError, NamedConceptRemoveError, Path,
};
use iceoryx2_cal::static_storage::file::{
    Builder as OpenBuilder, Configuration, Storage, StorageView,
};
use iceoryx2_cal::static_storage::{
    StaticStorage, StaticStorageBuilder, StaticStorageCreateError, StaticStorageLocked,
    StaticStorageOpenError, StaticStorageReadError, StaticStorageUnlockError, StaticStorageView,
};

/// Mode of a file whose contents are not complete, by which other processes recognize it.
const UNFINISHED: u32 = 0o600;

/// Mode of a file whose contents are complete.
const FINISHED: u32 = 0o400;

/// Mode of the directory of the files.
const DIRECTORY: u32 = 0o750;

/// A complete file.
#[derive(Debug)]
pub(crate) struct StaticFile(Storage);

impl Abandonable for StaticFile {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller guarantees a valid pointer, and does not use the file afterwards.
        let this = unsafe { this.as_mut() };
        // SAFETY: the storage is a field of that file, and is not used afterwards either.
        unsafe { Storage::abandon_in_place(NonNull::from_mut(&mut this.0)) };
    }
}

impl NamedConcept for StaticFile {
    fn name(&self) -> &FileName {
        self.0.name()
    }
}

impl NamedConceptMgmt for StaticFile {
    type Configuration = Configuration;

    unsafe fn remove_cfg(
        name: &FileName,
        config: &Configuration,
    ) -> Result<bool, NamedConceptRemoveError> {
        // SAFETY: the caller gives the guarantees of the same function.
        unsafe { Storage::remove_cfg(name, config) }
    }

    fn does_exist_cfg(
        name: &FileName,
        config: &Configuration,
    ) -> Result<bool, NamedConceptDoesExistError> {
        Storage::does_exist_cfg(name, config)
    }

    fn list_cfg(config: &Configuration) -> Result<Vec<FileName>, NamedConceptListError> {
        Storage::list_cfg(config)
    }

    fn remove_path_hint(path: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        Storage::remove_path_hint(path)
    }
}

impl StaticStorageView for StaticFile {
    fn len(&self) -> u64 {
        self.0.len()
    }

    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn read(&self, content: &mut [u8]) -> Result<(), StaticStorageReadError> {
        self.0.read(content)
    }
}

impl StaticStorage for StaticFile {
    type Builder = Builder;
    type Locked = UnfinishedFile;
    type View = StorageView;

    fn view(&self) -> &StorageView {
        self.0.view()
    }

    fn release_ownership(&self) {
        self.0.release_ownership();
    }

    fn acquire_ownership(&self) {
        self.0.acquire_ownership();
    }
}

/// Creates or opens a file.
#[derive(Debug)]
pub(crate) struct Builder {
    name: FileName,
    config: Configuration,
    has_ownership: bool,
}

impl NamedConceptBuilder<StaticFile> for Builder {
    fn new(name: &FileName) -> Self {
        Self {
            name: *name,
            config: Configuration::default(),
            has_ownership: true,
        }
    }

    fn config(mut self, config: &Configuration) -> Self {
        self.config = config.clone();
        self
    }
}

impl Builder {
    fn open_builder(&self) -> OpenBuilder {
        OpenBuilder::new(&self.name)
            .config(&self.config)
            .has_ownership(self.has_ownership)
    }
}

impl StaticStorageBuilder<StaticFile> for Builder {
    fn has_ownership(mut self, value: bool) -> Self {
        self.has_ownership = value;
        self
    }

    fn create_locked(self) -> Result<UnfinishedFile, StaticStorageCreateError> {
        let directory = text(self.config.get_path_hint().as_bytes());
        let mut builder = DirBuilder::new();
        let created = builder.recursive(true).mode(DIRECTORY).create(directory);
        created.map_err(|_| StaticStorageCreateError::RootDirectoryCreationFailure)?;
        let path = text(self.config.path_for(&self.name).as_bytes());
        let mut options = OpenOptions::new();
        let file = options
            .write(true)
            .create_new(true)
            .mode(UNFINISHED)
            .open(&path);
        let file = file.map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => StaticStorageCreateError::AlreadyExists,
            ErrorKind::PermissionDenied => StaticStorageCreateError::InsufficientPermissions,
            ErrorKind::Interrupted => StaticStorageCreateError::Interrupt,
            _ => StaticStorageCreateError::InternalError,
        })?;
        let unfinished = UnfinishedFile {
            removed_on_drop: self.has_ownership.then(|| path.clone()),
            builder: self,
            file,
        };
        // The umask may have removed a bit.
        match unfinished.set_mode(UNFINISHED) {
            Ok(()) => Ok(unfinished),
            Err(_) => Err(StaticStorageCreateError::InternalError),
        }
    }

    fn open(self, timeout: Duration) -> Result<StaticFile, StaticStorageOpenError> {
        self.open_builder().open(timeout).map(StaticFile)
    }
}

/// A file without contents, which other processes do not read. Removed when it is dropped.
#[derive(Debug)]
pub(crate) struct UnfinishedFile {
    builder: Builder,
    file: File,
    removed_on_drop: Option<PathBuf>,
}

impl UnfinishedFile {
    fn set_mode(&self, mode: u32) -> io::Result<()> {
        self.file.set_permissions(Permissions::from_mode(mode))
    }
}

impl Drop for UnfinishedFile {
    fn drop(&mut self) {
        if let Some(path) = &self.removed_on_drop {
            // Another program may have removed it.
            let _ = std::fs::remove_file(path);
        }
    }
}

impl Abandonable for UnfinishedFile {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller guarantees a valid pointer, and does not use the file afterwards.
        let this = unsafe { this.as_mut() };
        this.removed_on_drop = None;
        // SAFETY: the value is valid, and is not used or dropped afterwards.
        unsafe { std::ptr::drop_in_place(this) };
    }
}

impl NamedConcept for UnfinishedFile {
    fn name(&self) -> &FileName {
        &self.builder.name
    }
}

impl StaticStorageLocked<StaticFile> for UnfinishedFile {
    fn unlock(mut self, contents: &[u8]) -> Result<StaticFile, StaticStorageUnlockError> {
        let written = self.file.write_all(contents);
        let finished = written.and_then(|()| self.set_mode(FINISHED));
        finished.map_err(|error| match error.kind() {
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
                StaticStorageUnlockError::NoSpaceLeft
            }
            ErrorKind::PermissionDenied => StaticStorageUnlockError::InsufficientPermissions,
            ErrorKind::Interrupted => StaticStorageUnlockError::Interrupt,
            _ => StaticStorageUnlockError::InternalError,
        })?;
        let opened = self.builder.open_builder().open(Duration::ZERO);
        let opened = opened.map_err(|_| StaticStorageUnlockError::InternalError)?;
        // The opened file is removed by its owner.
        self.removed_on_drop = None;
        Ok(StaticFile(opened))
    }
}

/// A path of iceoryx2.
fn text(bytes: &[u8]) -> PathBuf {
    use std::os::unix::ffi::OsStrExt as _;
    std::ffi::OsStr::from_bytes(bytes).into()
}
