//! The files in which iceoryx2 keeps its structures, with pages that are allocated before use.
//!
//! iceoryx2 makes a shared memory file longer and maps it, which allocates no page. Its first write
//! to a page of a full file system then raises SIGBUS and ends the process. No check of the free
//! space helps: another program can fill the file system between the check and the write.
//!
//! [`Storage`] implements iceoryx2's `DynamicStorage`, and [`Svc`](crate::layout::Svc) builds all
//! structures of nodes, services, ports and connections on it. It allocates the pages of a new file
//! with `fallocate` before anything is written there. If the file system is full, the creation
//! fails with an ordinary error. The format of the files is that of iceoryx2's own storage.
//!
//! Memory for payloads is sparse, because it has room for many large letters. Of such a file the
//! storage allocates only what iceoryx2 writes without being asked ([`HEAD`], [`TAIL`]). The rest is
//! up to [`memory::populate`](crate::memory::populate) and [`allocate`].

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt::Debug;
use std::mem::MaybeUninit;
use std::ops::Range;
use std::os::fd::{BorrowedFd, RawFd};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering, fence};
use std::time::{Duration, Instant};

use iceoryx2::prelude::ZeroCopySend;
use iceoryx2_bb_elementary::bump_allocator::BumpAllocator;
use iceoryx2_bb_elementary::package_version::PackageVersion;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_posix::file_descriptor::{FileDescriptorBased, FileDescriptorManagement};
use iceoryx2_bb_posix::memory_mapping::MemoryMappingCreationError;
use iceoryx2_bb_posix::shared_memory::{
    AccessMode, CreationMode, Permission, SharedMemory, SharedMemoryBuilder,
    SharedMemoryCreationError,
};
use iceoryx2_cal::dynamic_storage::{
    DynamicStorage, DynamicStorageBuilder, DynamicStorageCreateError, DynamicStorageOpenError,
    DynamicStorageOpenOrCreateError, Initializer, posix_shared_memory,
};
use iceoryx2_cal::named_concept::{
    FileName, NamedConcept, NamedConceptBuilder, NamedConceptConfiguration,
    NamedConceptDoesExistError, NamedConceptListError, NamedConceptMgmt,
    NamedConceptPathHintRemoveError, NamedConceptRemoveError, Path,
};
use parking_lot::Mutex;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;

/// Permission of a file that is not initialized yet: other processes cannot open it for reading.
const UNFINISHED: Permission = Permission::OWNER_WRITE;

/// Permission of a file that is initialized.
const FINISHED: Permission = Permission::OWNER_READ_WRITE;

/// How long [`Builder::open`] waits before it looks again at a file that is being initialized.
const PAUSE: Duration = Duration::from_millis(1);

/// Bytes at the beginning of a sparse file that are allocated at once: the description of the
/// memory, and the header of the first chunk, which iceoryx2 writes when it is loaned.
const HEAD: usize = 8 << 10;

/// Chunks that a sparse file may have at most.
pub(crate) const MAX_CHUNKS: usize = 2048;

/// Bytes at the end of a sparse file that are allocated at once: the list of free chunks, at four
/// bytes for each, and their alignment.
const TAIL: usize = 4 * MAX_CHUNKS + (8 << 10);

/// A file of iceoryx2. `SPARSE` says whether only a part of its pages is allocated at once.
#[derive(Debug)]
pub(crate) struct Storage<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> {
    name: FileName,
    data: NonNull<Data<T>>,
    // Before the file, which it is the descriptor of.
    _registered: Option<Registered>,
    file: SharedMemory,
}

// SAFETY: memory that every process of the domain may use at the same time; `T` is `Send`, and the
// file is only a mapping and a descriptor, which belong to the process.
unsafe impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Send for Storage<T, SPARSE> {}
// SAFETY: a shared `Storage` gives out shared references to `T`, which is `Sync`. The file's other
// state is an atomic flag.
unsafe impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Sync for Storage<T, SPARSE> {}

/// What a file begins with. What `T` manages follows.
#[derive(Debug)]
#[repr(C)]
struct Data<T> {
    /// iceoryx2's version; 0 until the file is initialized.
    version: AtomicU64,
    value: MaybeUninit<T>,
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Storage<T, SPARSE> {
    /// The data of a mapped file. None if the file is too short.
    fn new(name: FileName, file: SharedMemory) -> Option<Self> {
        (file.size() >= size_of::<Data<T>>()).then(|| Self {
            name,
            data: file.base_address().cast(),
            _registered: None,
            file,
        })
    }

    fn version(&self) -> &AtomicU64 {
        // SAFETY: the mapping begins with a `Data<T>`, is long enough (`new`), aligned to a page and
        // lives as long as self. Every process accesses the word atomically only, after the one
        // that made the file has written it. Its page is allocated.
        unsafe { &(*self.data.as_ptr()).version }
    }

    fn value(&self) -> *mut T {
        // SAFETY: in the mapping, as for `version`; no reference is made.
        let value = unsafe { &raw mut (*self.data.as_ptr()).value };
        value.cast()
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Drop for Storage<T, SPARSE> {
    fn drop(&mut self) {
        if self.file.has_ownership() {
            // SAFETY: the value is initialized: `make` and `look` give out no other storage, and an
            // error of theirs drops a file without a value, or a storage without ownership. iceoryx2
            // sees to it that one process is the owner.
            unsafe { self.value().drop_in_place() };
        }
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Abandonable for Storage<T, SPARSE> {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller vouches for the pointer, and does not use the storage afterwards.
        let this = unsafe { this.as_mut() };
        this._registered = None;
        // SAFETY: as above.
        unsafe { SharedMemory::abandon_in_place(NonNull::from_mut(&mut this.file)) };
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> NamedConcept
    for Storage<T, SPARSE>
{
    fn name(&self) -> &FileName {
        &self.name
    }
}

/// Names and removes files as iceoryx2 does.
type Original<T> = posix_shared_memory::Storage<T>;

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> NamedConceptMgmt
    for Storage<T, SPARSE>
{
    type Configuration = posix_shared_memory::Configuration<T>;

    unsafe fn remove_cfg(
        name: &FileName,
        config: &Self::Configuration,
    ) -> Result<bool, NamedConceptRemoveError> {
        // SAFETY: the caller's promise is the same.
        unsafe { Original::<T>::remove_cfg(name, config) }
    }

    fn does_exist_cfg(
        name: &FileName,
        config: &Self::Configuration,
    ) -> Result<bool, NamedConceptDoesExistError> {
        Original::<T>::does_exist_cfg(name, config)
    }

    fn list_cfg(config: &Self::Configuration) -> Result<Vec<FileName>, NamedConceptListError> {
        Original::<T>::list_cfg(config)
    }

    fn remove_path_hint(path: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        Original::<T>::remove_path_hint(path)
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> DynamicStorage<T>
    for Storage<T, SPARSE>
{
    type Builder<'builder> = Builder<'builder, T, SPARSE>;

    fn does_support_persistency() -> bool {
        Original::<T>::does_support_persistency()
    }

    fn has_ownership(&self) -> bool {
        self.file.has_ownership()
    }

    fn release_ownership(&self) {
        self.file.release_ownership();
    }

    fn acquire_ownership(&self) {
        self.file.acquire_ownership();
    }

    fn get(&self) -> &T {
        // SAFETY: in the mapping, as for `version`; a `Storage` is only given out after its value
        // was initialized, which `open` sees by the version. What processes share is `Sync`.
        unsafe { &*self.value() }
    }

    unsafe fn __internal_set_type_name_in_config(
        config: &mut Self::Configuration,
        type_name: &str,
    ) {
        // SAFETY: the caller's promise is the same.
        unsafe { Original::<T>::__internal_set_type_name_in_config(config, type_name) };
    }
}

/// Makes or opens a [`Storage`].
#[derive(Debug)]
pub(crate) struct Builder<'builder, T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> {
    name: FileName,
    config: posix_shared_memory::Configuration<T>,
    supplementary: usize,
    open_to_all: bool,
    owned: bool,
    timeout: Duration,
    initializer: Initializer<'builder, T>,
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool>
    NamedConceptBuilder<Storage<T, SPARSE>> for Builder<'_, T, SPARSE>
{
    fn new(name: &FileName) -> Self {
        Self {
            name: *name,
            config: posix_shared_memory::Configuration::default(),
            supplementary: 0,
            open_to_all: false,
            owned: true,
            timeout: Duration::ZERO,
            initializer: Initializer::new(|_, _| false),
        }
    }

    fn config(mut self, config: &posix_shared_memory::Configuration<T>) -> Self {
        self.config = config.clone();
        self
    }
}

impl<'builder, T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool>
    DynamicStorageBuilder<'builder, T, Storage<T, SPARSE>> for Builder<'builder, T, SPARSE>
{
    fn has_ownership(self, owned: bool) -> Self {
        Self { owned, ..self }
    }

    fn enable_global_access(self, open_to_all: bool) -> Self {
        Self {
            open_to_all,
            ..self
        }
    }

    fn supplementary_size(self, supplementary: usize) -> Self {
        Self {
            supplementary,
            ..self
        }
    }

    fn timeout(self, timeout: Duration) -> Self {
        Self { timeout, ..self }
    }

    fn initializer<F: FnMut(&mut MaybeUninit<T>, &mut BumpAllocator) -> bool + 'builder>(
        self,
        initializer: F,
    ) -> Self {
        Self {
            initializer: Initializer::new(initializer),
            ..self
        }
    }

    fn create(mut self) -> Result<Storage<T, SPARSE>, DynamicStorageCreateError> {
        self.make()
    }

    fn open(self, access: AccessMode) -> Result<Storage<T, SPARSE>, DynamicStorageOpenError> {
        self.look(access)
    }

    fn open_or_create(mut self) -> Result<Storage<T, SPARSE>, DynamicStorageOpenOrCreateError> {
        loop {
            match self.look(AccessMode::ReadWrite) {
                Err(DynamicStorageOpenError::DoesNotExist) => {}
                found => return Ok(found?),
            }
            match self.make() {
                // Another process was faster.
                Err(DynamicStorageCreateError::AlreadyExists) => {}
                made => return Ok(made?),
            }
        }
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Builder<'_, T, SPARSE> {
    fn file_name(&self) -> FileName {
        self.config.path_for(&self.name).file_name()
    }

    fn make(&mut self) -> Result<Storage<T, SPARSE>, DynamicStorageCreateError> {
        let len = size_of::<Data<T>>()
            .checked_add(self.supplementary)
            .ok_or(DynamicStorageCreateError::InternalError)?;
        let mut file = SharedMemoryBuilder::new(&self.file_name())
            .creation_mode(CreationMode::CreateExclusive)
            .size(len)
            .permission(UNFINISHED)
            .zero_memory(false)
            // Until the value is there, the file is removed when it is dropped.
            .has_ownership(true)
            .create()
            .map_err(|error| match error {
                SharedMemoryCreationError::AlreadyExist => DynamicStorageCreateError::AlreadyExists,
                SharedMemoryCreationError::InsufficientPermissions => {
                    DynamicStorageCreateError::InsufficientPermissions
                }
                _ => DynamicStorageCreateError::InternalError,
            })?;
        let (head, tail) = match SPARSE && len > HEAD + TAIL {
            true => (0..HEAD, len - TAIL..len),
            false => (0..len, len..len),
        };
        for part in [head, tail].into_iter().filter(|part| !part.is_empty()) {
            // SAFETY: the descriptor is that of `file`, which stays open during the call.
            let fd = unsafe { BorrowedFd::borrow_raw(descriptor(&file)) };
            take_pages(fd, part).map_err(|_| DynamicStorageCreateError::InternalError)?;
        }
        self.initialize(&file)?;
        let permission = match self.open_to_all {
            true => FINISHED | Permission::GROUP_READ_WRITE | Permission::OTHERS_READ_WRITE,
            false => FINISHED,
        };
        file.set_permission(permission)
            .map_err(|_| DynamicStorageCreateError::InternalError)?;
        if !self.owned {
            file.release_ownership();
        }
        let registered = SPARSE.then(|| Registered::new(&file));
        let mut storage =
            Storage::new(self.name, file).ok_or(DynamicStorageCreateError::InternalError)?;
        storage._registered = registered;
        Ok(storage)
    }

    /// Writes what the file begins with.
    fn initialize(&mut self, file: &SharedMemory) -> Result<(), DynamicStorageCreateError> {
        let data: NonNull<Data<T>> = file.base_address().cast();
        let data = data.as_ptr();
        // SAFETY: the mapping is aligned to a page and longer than a `Data<T>`, whose pages are
        // allocated. No other process can open the file for reading yet, and this one has no other
        // reference. A new file is filled with zeros, which are a valid version and a valid
        // `MaybeUninit`.
        let data = unsafe { &mut *data };
        let rest = std::ptr::from_mut(data).wrapping_add(1).cast::<u8>();
        let rest = NonNull::new(rest).ok_or(DynamicStorageCreateError::InternalError)?;
        let mut allocator = BumpAllocator::new(rest, file.size() - size_of::<Data<T>>());
        if !self.initializer.call(&mut data.value, &mut allocator) {
            return Err(DynamicStorageCreateError::InitializationFailed);
        }
        let version = PackageVersion::get().to_u64();
        data.version.store(version, Ordering::SeqCst);
        Ok(())
    }

    /// Opens the file. Waits for the process that is making it as long as the timeout says.
    fn look(&self, access: AccessMode) -> Result<Storage<T, SPARSE>, DynamicStorageOpenError> {
        let began = Instant::now();
        loop {
            match self.look_once(access) {
                Err(DynamicStorageOpenError::InitializationNotYetFinalized)
                    if began.elapsed() < self.timeout =>
                {
                    std::thread::sleep(PAUSE);
                }
                found => return found,
            }
        }
    }

    fn look_once(&self, access: AccessMode) -> Result<Storage<T, SPARSE>, DynamicStorageOpenError> {
        use DynamicStorageOpenError as E;
        let file = SharedMemoryBuilder::new(&self.file_name())
            .open_existing(access)
            .map_err(|error| match error {
                SharedMemoryCreationError::DoesNotExist => E::DoesNotExist,
                SharedMemoryCreationError::InsufficientPermissions
                | SharedMemoryCreationError::MemoryMappingCreationError(
                    MemoryMappingCreationError::MappingSizeIsZero,
                ) => E::InitializationNotYetFinalized,
                _ => E::InternalError,
            })?;
        // Root can open it before the pages are allocated, and must not read there then.
        let permission = file.permission().map_err(|_| E::InternalError)?;
        if !permission.has(Permission::OWNER_READ) {
            return Err(E::InitializationNotYetFinalized);
        }
        let storage = Storage::new(self.name, file).ok_or(E::InternalError)?;
        // Relaxed, as Rust allows it on memory that is mapped for reading only.
        let version = storage.version().load(Ordering::Relaxed);
        fence(Ordering::Acquire);
        if version == 0 {
            Err(E::InitializationNotYetFinalized)
        } else if version != PackageVersion::get().to_u64() {
            Err(E::VersionMismatch)
        } else {
            Ok(storage)
        }
    }
}

fn descriptor(file: &SharedMemory) -> RawFd {
    // SAFETY: the descriptor is used only while the file is open, and not closed.
    unsafe { file.file_descriptor().native_handle() }
}

/// Allocates the pages of a part of a file. Remembers a failure for [`watch`].
fn take_pages(file: BorrowedFd<'_>, part: Range<usize>) -> Result<(), Errno> {
    let len = part.end.saturating_sub(part.start) as u64;
    loop {
        match fallocate(file, FallocateFlags::empty(), part.start as u64, len) {
            Err(Errno::INTR) => {}
            Err(error) => {
                FAILED.set(Some(Shortage { needed: len, error }));
                return Err(error);
            }
            Ok(()) => return Ok(()),
        }
    }
}

thread_local! {
    static FAILED: Cell<Option<Shortage>> = const { Cell::new(None) };
}

/// Pages that could not be allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shortage {
    /// Bytes that were needed.
    pub(crate) needed: u64,
    pub(crate) error: Errno,
}

/// Makes something, and says whether pages could not be allocated for it. iceoryx2 keeps the reason
/// to itself, and makes a port without its connections when there was no room for them.
pub(crate) fn watch<R>(make: impl FnOnce() -> R) -> (R, Option<Shortage>) {
    FAILED.set(None);
    let made = make();
    (made, FAILED.take())
}

/// The sparse files of this process that are mapped, by the address they are mapped at.
static MAPPED: Mutex<BTreeMap<usize, Mapped>> = Mutex::new(BTreeMap::new());

#[derive(Debug)]
struct Mapped {
    len: usize,
    descriptor: RawFd,
}

/// An entry in [`MAPPED`], removed when this is dropped.
#[derive(Debug)]
struct Registered {
    address: usize,
}

impl Registered {
    fn new(file: &SharedMemory) -> Self {
        let address = file.base_address().as_ptr() as usize;
        let mapped = Mapped {
            len: file.size(),
            descriptor: descriptor(file),
        };
        MAPPED.lock().insert(address, mapped);
        Self { address }
    }
}

impl Drop for Registered {
    fn drop(&mut self) {
        MAPPED.lock().remove(&self.address);
    }
}

/// Allocates pages of a sparse file of this process: those of this range of addresses.
///
/// # Errors
/// `FAULT` if the range is not in such a file, else what the file system says.
pub(crate) fn allocate(range: Range<usize>) -> Result<(), Errno> {
    with_mapped(range.start, |base, mapped| {
        if range.end > base.saturating_add(mapped.len) {
            return Err(Errno::FAULT);
        }
        mapped.take(range.start - base..range.end - base)
    })
}

/// Allocates all pages of the sparse file of this process that is mapped at this address.
///
/// # Errors
/// As for [`allocate`].
pub(crate) fn allocate_all(address: usize) -> Result<(), Errno> {
    with_mapped(address, |_, mapped| mapped.take(0..mapped.len))
}

fn with_mapped(
    address: usize,
    with: impl FnOnce(usize, &Mapped) -> Result<(), Errno>,
) -> Result<(), Errno> {
    // Under the lock, so that the file stays open.
    let mapped = MAPPED.lock();
    match mapped.range(..=address).next_back() {
        Some((base, mapped)) if address - base < mapped.len => with(*base, mapped),
        _ => Err(Errno::FAULT),
    }
}

impl Mapped {
    fn take(&self, part: Range<usize>) -> Result<(), Errno> {
        // SAFETY: the caller holds the lock of `MAPPED`. A storage takes its entry out before its
        // file is closed (the order of its fields), so the descriptor is open until then.
        let file = unsafe { BorrowedFd::borrow_raw(self.descriptor) };
        take_pages(file, part)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt;

    use fipa_transport::Incarnation;

    use super::*;

    /// A sparse file of a mebibyte under a name of its own, removed when it is dropped.
    fn sparse() -> (Storage<u64, true>, std::path::PathBuf) {
        let name = format!("fipatest-{}", Incarnation::random());
        let name = FileName::try_from(name.as_str()).unwrap();
        let storage = Builder::<u64, true>::new(&name)
            .supplementary_size(1 << 20)
            .initializer(|value, _| {
                value.write(7);
                true
            })
            .create()
            .unwrap();
        let found = format!("/proc/self/fd/{}", descriptor(&storage.file));
        let path = std::fs::read_link(found).unwrap();
        (storage, path)
    }

    #[test]
    fn sparse_files_have_the_pages_that_were_asked_for() {
        let (storage, path) = sparse();
        let taken = || std::fs::metadata(&path).unwrap().blocks() as usize * 512;
        // The kernel takes whole pages, and the end of the file need not be one.
        let at_first = taken();
        assert!((HEAD + TAIL..HEAD + TAIL + (8 << 10)).contains(&at_first));
        let base = storage.file.base_address().as_ptr() as usize;
        allocate(base + 100_000..base + 200_000).unwrap();
        assert!((100_000..110_000).contains(&(taken() - at_first)));
        let behind = base + storage.file.size();
        assert_eq!(allocate(behind - 1..behind + 1), Err(Errno::FAULT));
        assert_eq!(allocate_all(behind), Err(Errno::FAULT));
        allocate_all(base + 5000).unwrap();
        assert!(taken() >= storage.file.size());
        // Others find the value; only the process that made the file has its pages.
        let other = Builder::<u64, true>::new(storage.name())
            .open(AccessMode::ReadWrite)
            .unwrap();
        assert_eq!(*other.get(), 7);
        let elsewhere = other.file.base_address().as_ptr() as usize;
        assert_eq!(allocate_all(elsewhere), Err(Errno::FAULT));
        drop(storage);
        assert_eq!(allocate_all(base), Err(Errno::FAULT));
        assert!(!path.exists());
    }

    #[test]
    fn what_is_not_initialized_is_neither_opened_nor_left() {
        let name = format!("fipatest-{}", Incarnation::random());
        let name = FileName::try_from(name.as_str()).unwrap();
        let builder = || Builder::<u64, false>::new(&name);
        let refused = builder().initializer(|_, _| {
            let found = builder().open(AccessMode::ReadWrite);
            let unfinished = DynamicStorageOpenError::InitializationNotYetFinalized;
            assert_eq!(found.err(), Some(unfinished));
            false
        });
        let error = refused.create().err();
        assert_eq!(error, Some(DynamicStorageCreateError::InitializationFailed));
        let error = builder().open(AccessMode::ReadWrite).err();
        assert_eq!(error, Some(DynamicStorageOpenError::DoesNotExist));
    }

    #[test]
    fn too_large_a_file_is_an_error_that_is_remembered() {
        let name = format!("fipatest-{}", Incarnation::random());
        let name = FileName::try_from(name.as_str()).unwrap();
        let found = rustix::fs::statvfs(crate::memory::SHM).unwrap();
        let total = found.f_blocks * found.f_frsize;
        assert!(total > 0, "a file system without a limit cannot be full");
        // More than there could be, which the kernel refuses before it takes anything.
        let builder = Builder::<u64, false>::new(&name)
            .supplementary_size(usize::try_from(total).unwrap() + 1)
            .initializer(|_, _| panic!("there are no pages"));
        let (made, shortage) = watch(|| builder.create());
        assert_eq!(made.err(), Some(DynamicStorageCreateError::InternalError));
        let shortage = shortage.unwrap();
        assert!(shortage.needed > total);
        assert_eq!(shortage.error, Errno::NOSPC);
        assert_eq!(watch(|| ()).1, None);
    }
}
