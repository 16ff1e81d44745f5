//! The files of iceoryx2's structures, with pages that are allocated before use.
//!
//! iceoryx2 extends a shared memory file and maps it, which allocates no page. Its first write
//! to a page of a full file system then raises SIGBUS and ends the process. No check of the free
//! space helps: another program can fill the file system between the check and the write.
//!
//! [`Storage`] implements iceoryx2's `DynamicStorage`, and [`Svc`](crate::layout::Svc) builds all
//! structures of nodes, services, ports and connections on it. It allocates the pages of a new file
//! with `fallocate` before anything is written there. If the file system is full, the creation
//! fails with an ordinary error. The format of the files is that of iceoryx2's own storage.
//!
//! Memory for payloads is sparse, because it has room for many large letters. Of such a file the
//! storage allocates only what iceoryx2 writes on its own ([`HEAD`], [`TAIL`]). The rest is
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

/// Pause before [`Builder::open`] checks again a file that is being initialized.
const PAUSE: Duration = Duration::from_millis(1);

/// Bytes at the beginning of a sparse file that are allocated at once: the description of the
/// memory, and the header of the first chunk, which iceoryx2 writes when it is loaned.
const HEAD: usize = 8 << 10;

/// Maximum number of chunks in a sparse file.
pub(crate) const MAX_CHUNKS: usize = 2048;

/// Bytes at the end of a sparse file that are allocated at once: the list of free chunks, of four
/// bytes each, and its alignment.
const TAIL: usize = 4 * MAX_CHUNKS + (8 << 10);

/// A file of iceoryx2. If `SPARSE` is true, only a part of its pages is allocated at once.
///
/// It is small: iceoryx2 has a table with room for 255 files of payloads per connection, of which one or two are open.
#[derive(Debug)]
pub(crate) struct Storage<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> {
    name: Box<FileName>,
    data: NonNull<Data<T>>,
    // Before `file`, whose descriptor it stores.
    _registered: Option<Registration>,
    file: Box<SharedMemory>,
}

// SAFETY: `data` points into memory that every process of the domain may use concurrently, and `T`
// is `Send`. `file` is a mapping and a descriptor, which belong to the process and not to a thread.
unsafe impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Send for Storage<T, SPARSE> {}
// SAFETY: a shared `Storage` gives out only shared references to `T`, which is `Sync`. The only
// other mutable state of `file` is an atomic flag.
unsafe impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Sync for Storage<T, SPARSE> {}

/// The beginning of a file. The memory that `T` manages follows.
#[derive(Debug)]
#[repr(C)]
struct Data<T> {
    /// Version of iceoryx2; 0 until the file is initialized.
    version: AtomicU64,
    value: MaybeUninit<T>,
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Storage<T, SPARSE> {
    /// Wraps a mapped file. `None` if the file is too short.
    fn new(name: FileName, file: SharedMemory) -> Option<Self> {
        (file.size() >= size_of::<Data<T>>()).then(|| Self {
            name: Box::new(name),
            data: file.base_address().cast(),
            _registered: None,
            file: Box::new(file),
        })
    }

    fn version(&self) -> &AtomicU64 {
        // SAFETY: the mapping begins with a `Data<T>`, is long enough (`new`), aligned to a page
        // and exists as long as self. The page is allocated. After the creating process has
        // initialized the word, every process accesses it only atomically.
        unsafe { &(*self.data.as_ptr()).version }
    }

    fn value(&self) -> *mut T {
        // SAFETY: the address is in the mapping, as for `version`. No reference is created.
        let value = unsafe { &raw mut (*self.data.as_ptr()).value };
        value.cast()
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Drop for Storage<T, SPARSE> {
    fn drop(&mut self) {
        if self.file.has_ownership() {
            // SAFETY: the value is initialized: `create_file` and `open_existing` return no other
            // storage, and on an error they drop a file without a value, or a storage without
            // ownership. iceoryx2 ensures that one process is the owner.
            unsafe { self.value().drop_in_place() };
        }
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> Abandonable for Storage<T, SPARSE> {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller guarantees a valid pointer, and does not use the storage afterwards.
        let this = unsafe { this.as_mut() };
        this._registered = None;
        // SAFETY: `file` is a field of that storage, and is not used afterwards either.
        unsafe { SharedMemory::abandon_in_place(NonNull::from_mut(&mut *this.file)) };
    }
}

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> NamedConcept
    for Storage<T, SPARSE>
{
    fn name(&self) -> &FileName {
        &self.name
    }
}

/// The original storage, which names, lists and removes the files.
type Original<T> = posix_shared_memory::Storage<T>;

impl<T: Send + Sync + Debug + ZeroCopySend, const SPARSE: bool> NamedConceptMgmt
    for Storage<T, SPARSE>
{
    type Configuration = posix_shared_memory::Configuration<T>;

    unsafe fn remove_cfg(
        name: &FileName,
        config: &Self::Configuration,
    ) -> Result<bool, NamedConceptRemoveError> {
        // SAFETY: the caller gives the same guarantee.
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
        // SAFETY: the value is in the mapping, as for `version`. A `Storage` is returned only after
        // its value was initialized, which `try_open` checks by the version. `T` is `Sync`.
        unsafe { &*self.value() }
    }

    unsafe fn __internal_set_type_name_in_config(
        config: &mut Self::Configuration,
        type_name: &str,
    ) {
        // SAFETY: the caller gives the same guarantee.
        unsafe { Original::<T>::__internal_set_type_name_in_config(config, type_name) };
    }
}

/// Creates or opens a [`Storage`].
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
        self.open_existing(access)
    }

    fn open_or_create(mut self) -> Result<Storage<T, SPARSE>, DynamicStorageOpenOrCreateError> {
        loop {
            match self.open_existing(AccessMode::ReadWrite) {
                Err(DynamicStorageOpenError::DoesNotExist) => {}
                found => return Ok(found?),
            }
            match self.make() {
                // Another process was faster.
                Err(DynamicStorageCreateError::AlreadyExists) => {}
                created => return Ok(created?),
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
            // Owned until the value is initialized: an error removes the file.
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
            // SAFETY: the descriptor belongs to `file`, which stays open during the call.
            let fd = unsafe { BorrowedFd::borrow_raw(descriptor(&file)) };
            allocate_pages(fd, part).map_err(|_| DynamicStorageCreateError::InternalError)?;
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
        let registered = SPARSE.then(|| Registration::new(&file));
        let mut storage =
            Storage::new(self.name, file).ok_or(DynamicStorageCreateError::InternalError)?;
        storage._registered = registered;
        Ok(storage)
    }

    /// Initializes the value and the version.
    fn initialize(&mut self, file: &SharedMemory) -> Result<(), DynamicStorageCreateError> {
        let data: NonNull<Data<T>> = file.base_address().cast();
        let data = data.as_ptr();
        // SAFETY: the mapping is aligned to a page and longer than a `Data<T>`, whose pages are
        // allocated. Other processes of the domain do not use the file before it has its final
        // permission, and this process has no other reference. A new file is filled with zeros,
        // which are a valid version and a valid `MaybeUninit`.
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

    /// Opens the file. Waits up to the timeout for the process that initializes it.
    fn open_existing(
        &self,
        access: AccessMode,
    ) -> Result<Storage<T, SPARSE>, DynamicStorageOpenError> {
        let began = Instant::now();
        loop {
            match self.try_open(access) {
                Err(DynamicStorageOpenError::InitializationNotYetFinalized)
                    if began.elapsed() < self.timeout =>
                {
                    std::thread::sleep(PAUSE);
                }
                found => return found,
            }
        }
    }

    fn try_open(&self, access: AccessMode) -> Result<Storage<T, SPARSE>, DynamicStorageOpenError> {
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
        // Root can open the file before its pages are allocated, and must not read it then.
        let permission = file.permission().map_err(|_| E::InternalError)?;
        if !permission.has(Permission::OWNER_READ) {
            return Err(E::InitializationNotYetFinalized);
        }
        let storage = Storage::new(self.name, file).ok_or(E::InternalError)?;
        // Only relaxed loads are allowed on memory that is mapped for reading; the fence adds the
        // order.
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
    // SAFETY: the callers use the descriptor only while the file is open, and do not close it.
    unsafe { file.file_descriptor().native_handle() }
}

/// Allocates the pages of a part of a file. Stores a failure for [`with_shortage`].
fn allocate_pages(file: BorrowedFd<'_>, part: Range<usize>) -> Result<(), Errno> {
    let len = part.end.saturating_sub(part.start) as u64;
    loop {
        match fallocate(file, FallocateFlags::empty(), part.start as u64, len) {
            Err(Errno::INTR) => {}
            Err(error) => {
                LAST_SHORTAGE.set(Some(Shortage { needed: len, error }));
                return Err(error);
            }
            Ok(()) => return Ok(()),
        }
    }
}

thread_local! {
    static LAST_SHORTAGE: Cell<Option<Shortage>> = const { Cell::new(None) };
}

/// A failed allocation of pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shortage {
    /// Bytes that could not be allocated.
    pub(crate) needed: u64,
    pub(crate) error: Errno,
}

/// Calls `make`, and returns the last failed allocation of pages in it. iceoryx2 does not report
/// that reason, and creates a port without its connections if there is no room for them.
pub(crate) fn with_shortage<R>(make: impl FnOnce() -> R) -> (R, Option<Shortage>) {
    LAST_SHORTAGE.set(None);
    let result = make();
    (result, LAST_SHORTAGE.take())
}

/// The mapped sparse files of this process, by the address of the mapping.
static MAPPED: Mutex<BTreeMap<usize, MappedFile>> = Mutex::new(BTreeMap::new());

#[derive(Debug)]
struct MappedFile {
    len: usize,
    descriptor: RawFd,
}

/// An entry in [`MAPPED`], removed when this is dropped.
#[derive(Debug)]
struct Registration {
    address: usize,
}

impl Registration {
    fn new(file: &SharedMemory) -> Self {
        let address = file.base_address().as_ptr() as usize;
        let mapped = MappedFile {
            len: file.size(),
            descriptor: descriptor(file),
        };
        MAPPED.lock().insert(address, mapped);
        Self { address }
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        MAPPED.lock().remove(&self.address);
    }
}

/// Allocates the pages of an address range in a sparse file of this process.
///
/// # Errors
/// Returns `FAULT` if the range is not in such a file, otherwise the error of the file system.
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
/// Returns the errors of [`allocate`].
pub(crate) fn allocate_all(address: usize) -> Result<(), Errno> {
    with_mapped(address, |_, mapped| mapped.take(0..mapped.len))
}

fn with_mapped(
    address: usize,
    with: impl FnOnce(usize, &MappedFile) -> Result<(), Errno>,
) -> Result<(), Errno> {
    // The lock keeps the file open.
    let mapped = MAPPED.lock();
    match mapped.range(..=address).next_back() {
        Some((base, mapped)) if address - base < mapped.len => with(*base, mapped),
        _ => Err(Errno::FAULT),
    }
}

impl MappedFile {
    fn take(&self, part: Range<usize>) -> Result<(), Errno> {
        // SAFETY: the caller holds the lock of `MAPPED`. A storage removes its entry before it
        // closes its file (the order of its fields), so the descriptor is open during the call.
        let file = unsafe { BorrowedFd::borrow_raw(self.descriptor) };
        allocate_pages(file, part)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt;

    use fipa_transport::Incarnation;

    use super::*;

    /// Creates a sparse file of one MiB with a unique name. It is removed when dropped.
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
    fn sparse_files_have_the_requested_pages() {
        let (storage, path) = sparse();
        let taken = || std::fs::metadata(&path).unwrap().blocks() as usize * 512;
        // The kernel allocates whole pages, and the file need not end with one.
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
        // Another storage finds the value; only the one that created the file can allocate its
        // pages.
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

    /// A large one costs each connection its size 255 times.
    #[test]
    fn a_storage_is_small() {
        assert!(size_of::<Storage<u64, true>>() <= size_of::<[usize; 8]>());
    }

    #[test]
    fn an_uninitialized_file_is_neither_opened_nor_left() {
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
    fn a_file_larger_than_the_file_system_is_a_reported_error() {
        let name = format!("fipatest-{}", Incarnation::random());
        let name = FileName::try_from(name.as_str()).unwrap();
        let found = rustix::fs::statvfs(crate::shared_files::SHM).unwrap();
        let total = found.f_blocks * found.f_frsize;
        assert!(total > 0, "a file system without a limit cannot be full");
        // More than the file system has, which the kernel refuses before it allocates anything.
        let builder = Builder::<u64, false>::new(&name)
            .supplementary_size(usize::try_from(total).unwrap() + 1)
            .initializer(|_, _| panic!("initialized without pages"));
        let (created, shortage) = with_shortage(|| builder.create());
        assert_eq!(
            created.err(),
            Some(DynamicStorageCreateError::InternalError)
        );
        let shortage = shortage.unwrap();
        assert!(shortage.needed > total);
        assert_eq!(shortage.error, Errno::NOSPC);
        assert_eq!(with_shortage(|| ()).1, None);
    }
}
