//! The memory for the payloads of a port: that of iceoryx2, with fewer files.
//!
//! A port makes another file when a payload is longer than the chunks of the last one. iceoryx2 allows 255 files, and has
//! counters for the chunks of each of them in the memory of each sender. [`PayloadFiles`] allows [`MAX_FILES`].

use std::alloc::Layout;
use std::ptr::NonNull;
use std::time::Duration;

use iceoryx2::prelude::AllocationStrategy;
use iceoryx2_bb_elementary_traits::allocator::{
    Allocate, AllocationError, AllocationGrowError, ContentPlacement, Deallocate, Grow,
};
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_posix::file::AccessMode;
use iceoryx2_cal::named_concept::{
    FileName, NamedConcept, NamedConceptBuilder, NamedConceptDoesExistError, NamedConceptListError,
    NamedConceptMgmt, NamedConceptPathHintRemoveError, NamedConceptRemoveError, Path,
};
use iceoryx2_cal::resizable_shared_memory::dynamic::{
    DynamicMemory, DynamicMemoryBuilder, DynamicView, DynamicViewBuilder,
};
use iceoryx2_cal::resizable_shared_memory::{
    ResizableSharedMemory, ResizableSharedMemoryBuilder, ResizableSharedMemoryForPoolAllocator,
    ResizableSharedMemoryViewBuilder,
};
use iceoryx2_cal::shared_memory::common::details::{AllocatorDetails, Memory};
use iceoryx2_cal::shared_memory::{
    SegmentId, SharedMemoryCreateError, SharedMemoryOpenError, ShmPointer,
};
use iceoryx2_cal::shm_allocator::PointerOffset;
use iceoryx2_cal::shm_allocator::pool_allocator::PoolAllocator;

use crate::storage::Storage;

/// Maximum number of files of one port. The chunks of a file are at least twice as long as those of the one before. From
/// one page to the longest letter, 2^40 bytes, that takes 29. A port that reached the limit would send nothing more.
const MAX_FILES: usize = 40;

/// Memory of payloads, in one file.
pub(crate) type Payloads<A> = Memory<A, Storage<AllocatorDetails<A>, true>>;

type File = Payloads<PoolAllocator>;
type Original = DynamicMemory<PoolAllocator, File>;
type Configuration = <Original as NamedConceptMgmt>::Configuration;

/// The files of one port.
#[derive(Debug)]
pub(crate) struct PayloadFiles(Original);

impl Allocate<ShmPointer> for PayloadFiles {
    fn allocate(&self, layout: Layout) -> Result<ShmPointer, AllocationError> {
        let chunk = self.0.allocate(layout)?;
        if usize::from(chunk.offset.segment_id().value()) < MAX_FILES {
            return Ok(chunk);
        }
        // SAFETY: the chunk was allocated with this layout, and this is its only pointer.
        unsafe { self.0.deallocate(chunk, layout) };
        Err(AllocationError::OutOfMemory)
    }
}

impl Deallocate<ShmPointer> for PayloadFiles {
    unsafe fn deallocate(&self, chunk: ShmPointer, layout: Layout) {
        // SAFETY: the caller gives the same guarantee.
        unsafe { self.0.deallocate(chunk, layout) };
    }
}

impl Grow<ShmPointer> for PayloadFiles {
    /// This transport grows no chunk.
    unsafe fn grow(
        &self,
        _: ShmPointer,
        _: Layout,
        _: Layout,
        _: ContentPlacement,
    ) -> Result<ShmPointer, AllocationGrowError> {
        Err(AllocationGrowError::OutOfMemory)
    }
}

impl ResizableSharedMemory<PoolAllocator, File> for PayloadFiles {
    type ViewBuilder = ViewBuilder;
    type MemoryBuilder = Builder;
    type View = DynamicView<PoolAllocator, File>;

    fn max_number_of_reallocations() -> usize {
        MAX_FILES
    }

    fn number_of_active_segments(&self) -> usize {
        self.0.number_of_active_segments()
    }

    fn allocation_strategy(&self) -> AllocationStrategy {
        self.0.allocation_strategy()
    }
}

impl ResizableSharedMemoryForPoolAllocator<File> for PayloadFiles {
    unsafe fn deallocate_bucket(&self, offset: PointerOffset) {
        // SAFETY: the caller gives the same guarantee.
        unsafe { self.0.deallocate_bucket(offset) };
    }

    fn bucket_size(&self, file: SegmentId) -> usize {
        self.0.bucket_size(file)
    }
}

impl Abandonable for PayloadFiles {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller guarantees a valid pointer, and does not use the memory afterwards.
        let this = unsafe { this.as_mut() };
        // SAFETY: it is the field of that memory, and is not used afterwards either.
        unsafe { Original::abandon_in_place(NonNull::from_mut(&mut this.0)) };
    }
}

impl NamedConcept for PayloadFiles {
    fn name(&self) -> &FileName {
        self.0.name()
    }
}

impl NamedConceptMgmt for PayloadFiles {
    type Configuration = Configuration;

    unsafe fn remove_cfg(
        name: &FileName,
        config: &Configuration,
    ) -> Result<bool, NamedConceptRemoveError> {
        // SAFETY: the caller gives the same guarantee.
        unsafe { Original::remove_cfg(name, config) }
    }

    fn does_exist_cfg(
        name: &FileName,
        config: &Configuration,
    ) -> Result<bool, NamedConceptDoesExistError> {
        Original::does_exist_cfg(name, config)
    }

    fn list_cfg(config: &Configuration) -> Result<Vec<FileName>, NamedConceptListError> {
        Original::list_cfg(config)
    }

    fn remove_path_hint(path: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        Original::remove_path_hint(path)
    }
}

/// Creates [`PayloadFiles`].
#[derive(Debug)]
pub(crate) struct Builder(DynamicMemoryBuilder<PoolAllocator, File>);

impl NamedConceptBuilder<PayloadFiles> for Builder {
    fn new(name: &FileName) -> Self {
        Self(DynamicMemoryBuilder::new(name))
    }

    fn config(self, config: &Configuration) -> Self {
        Self(self.0.config(config))
    }
}

impl ResizableSharedMemoryBuilder<PoolAllocator, File, PayloadFiles> for Builder {
    fn max_chunk_layout_hint(self, layout: Layout) -> Self {
        Self(self.0.max_chunk_layout_hint(layout))
    }

    fn max_number_of_chunks_hint(self, number: usize) -> Self {
        Self(self.0.max_number_of_chunks_hint(number))
    }

    fn allocation_strategy(self, strategy: AllocationStrategy) -> Self {
        Self(self.0.allocation_strategy(strategy))
    }

    fn create(self) -> Result<PayloadFiles, SharedMemoryCreateError> {
        self.0.create().map(PayloadFiles)
    }
}

/// Opens the files of another process.
#[derive(Debug)]
pub(crate) struct ViewBuilder(DynamicViewBuilder<PoolAllocator, File>);

impl NamedConceptBuilder<PayloadFiles> for ViewBuilder {
    fn new(name: &FileName) -> Self {
        Self(DynamicViewBuilder::new(name))
    }

    fn config(self, config: &Configuration) -> Self {
        Self(self.0.config(config))
    }
}

impl
    ResizableSharedMemoryViewBuilder<
        PoolAllocator,
        File,
        PayloadFiles,
        DynamicView<PoolAllocator, File>,
    > for ViewBuilder
{
    fn timeout(self, timeout: Duration) -> Self {
        Self(self.0.timeout(timeout))
    }

    fn open(
        self,
        access: AccessMode,
    ) -> Result<DynamicView<PoolAllocator, File>, SharedMemoryOpenError> {
        self.0.open(access)
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

    use super::*;

    #[test]
    fn the_number_of_files_is_bounded() {
        let name = format!("fipatest-{}", Incarnation::random());
        let name = FileName::try_from(name.as_str()).unwrap();
        let files = Builder::new(&name)
            .max_chunk_layout_hint(Layout::new::<u64>())
            .max_number_of_chunks_hint(1)
            .allocation_strategy(AllocationStrategy::BestFit)
            .create()
            .unwrap();
        // Each is longer than the chunks of the file before.
        let mut allocated = (1..).map(|number| {
            let layout = Layout::from_size_align(64 * number, 8).unwrap();
            files.allocate(layout).map(|chunk| (chunk, layout))
        });
        let made: Vec<_> = allocated.by_ref().map_while(Result::ok).collect();
        assert_eq!(made.len(), MAX_FILES - 1);
        assert_eq!(
            allocated.next().unwrap().err(),
            Some(AllocationError::OutOfMemory)
        );
        for (chunk, layout) in made {
            // SAFETY: the chunk was allocated with this layout, and is not used.
            unsafe { files.deallocate(chunk, layout) };
        }
    }
}
