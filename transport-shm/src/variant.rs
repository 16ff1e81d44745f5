//! The iceoryx2 service variant of this transport.

use std::fmt::Debug;

use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::service::Service;
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_cal::shm_allocator::bump_allocator::BumpAllocator;
use iceoryx2_cal::shm_allocator::pool_allocator::PoolAllocator;
use iceoryx2_cal::zero_copy_connection::common::details::{Connection, SharedManagementData};
use iceoryx2_cal::{bag, event, hash, monitoring, reactor, serialize};

use crate::payload_files::{PayloadFiles, Payloads};
use crate::static_file::StaticFile;
use crate::storage::Storage;
use crate::sync_policy::Locked;

/// `ipc_threadsafe::Service`, except that the pages of its files are allocated before use, that its
/// descriptions are not synchronized with the disk, that a port has fewer files of payloads, and that its lock is cheaper.
#[derive(Debug, Clone)]
pub(crate) struct Svc {}

impl Service for Svc {
    type StaticStorage = StaticFile;
    type ConfigSerializer = serialize::recommended::Recommended;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        Storage<T, false>;
    type Bag = bag::recommended::Recommended;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> = Storage<T, false>;
    type ServiceNameHasher = hash::recommended::Recommended;
    type SharedMemory = Payloads<PoolAllocator>;
    type ResizableSharedMemory = PayloadFiles;
    type Connection = Connection<Storage<SharedManagementData, false>>;
    type Event = event::recommended::Ipc;
    type Monitoring = monitoring::recommended::Ipc;
    type Reactor = reactor::recommended::Ipc;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> = Locked<T>;
    type BlackboardMgmt<T: Send + Sync + Debug + ZeroCopySend + 'static> = Storage<T, false>;
    type BlackboardPayload = Payloads<BumpAllocator>;
    type UniqueId = iceoryx2::unique_id_generator::unique_system_id::UniqueSystemId;
}

impl ServiceInternal<Self> for Svc {}
