//! The handles of this process.

use std::any::{Any, type_name};
use std::sync::{Arc, LazyLock};

use parking_lot::RwLock;
use slotmap::{DefaultKey, Key as _, KeyData, SlotMap};

use crate::failure::{Failure, FipaResult};

/// A handle: an index with a generation. Zero is no handle. A handle that was closed is never given out again before
/// 2^31 others in its place.
pub type FipaHandle = u64;

pub(crate) type Object = Arc<dyn Any + Send + Sync>;

static TABLE: LazyLock<RwLock<SlotMap<DefaultKey, Object>>> = LazyLock::new(RwLock::default);

/// Stores an object, and returns its handle.
pub(crate) fn add<T: Any + Send + Sync>(object: T) -> FipaHandle {
    let object: Object = Arc::new(object);
    TABLE.write().insert(object).data().as_ffi()
}

/// Returns the object of a handle.
pub(crate) fn get<T: Any + Send + Sync>(handle: FipaHandle) -> Result<Arc<T>, Failure> {
    any(handle)?.downcast().map_err(|_| {
        let expected = type_name::<T>().rsplit("::").next();
        other_kind(handle, expected.unwrap_or_default())
    })
}

pub(crate) fn other_kind(handle: FipaHandle, expected: &str) -> Failure {
    let text = format!("the handle {handle:#x} is of another kind: expected {expected}");
    Failure::new(FipaResult::BadHandle, text)
}

/// Returns the object of a handle of any kind.
pub(crate) fn any(handle: FipaHandle) -> Result<Object, Failure> {
    let object = key(handle).and_then(|key| TABLE.read().get(key).cloned());
    object.ok_or_else(|| unknown(handle))
}

/// Closes a handle. The caller drops the object, outside of the lock.
pub(crate) fn remove(handle: FipaHandle) -> Result<Object, Failure> {
    let object = key(handle).and_then(|key| TABLE.write().remove(key));
    object.ok_or_else(|| unknown(handle))
}

/// Returns the key of a handle. Several numbers stand for one key, and only one of them was given out.
fn key(handle: FipaHandle) -> Option<DefaultKey> {
    let key = KeyData::from_ffi(handle);
    (key.as_ffi() == handle).then(|| key.into())
}

fn unknown(handle: FipaHandle) -> Failure {
    let text = format!("the handle {handle:#x} was closed, or was never given out");
    Failure::new(FipaResult::BadHandle, text)
}
