//! The handles of this process, and what their objects have in common.

use std::any::{Any, type_name};
use std::sync::{Arc, LazyLock};

use fipa::{Message, MessageBuilder};
use parking_lot::RwLock;
use slotmap::{DefaultKey, Key as _, KeyData, SlotMap};

use crate::failure::FipaResult;
use crate::letter::Letter;
use crate::raw::Place;
use fipa_bindings::{Failure, FailureKind};

/// A handle: an index with a generation. Zero is no handle. A handle that was closed is never given out again before
/// 2^31 others in its place.
pub type FipaHandle = u64;

/// An object with a handle. The methods are those of calls that take handles of several kinds.
pub(crate) trait Object: Any + Send + Sync {
    /// Ends what the object stands for. Other objects and calls may still hold it.
    fn close(&self) -> Result<(), Failure> {
        Ok(())
    }

    /// The text that the caller reads.
    fn text(&self) -> Option<&str> {
        None
    }

    /// The letter that the caller reads.
    fn letter(&self) -> Option<&Letter> {
        None
    }

    /// Adds fences to a message.
    fn guard(&self, _: MessageBuilder) -> Option<Result<MessageBuilder, Failure>> {
        None
    }

    /// Checks the fence of a message.
    fn check(&self, _: &Message) -> Option<Result<(), Failure>> {
        None
    }
}

impl Object for Letter {
    fn letter(&self) -> Option<&Letter> {
        Some(self)
    }
}

static TABLE: LazyLock<RwLock<SlotMap<DefaultKey, Arc<dyn Object>>>> =
    LazyLock::new(RwLock::default);

/// Stores an object, and returns its handle.
pub(crate) fn add(object: Arc<dyn Object>) -> FipaHandle {
    TABLE.write().insert(object).data().as_ffi()
}

/// Stores an object, and writes its handle for the caller.
pub(crate) fn give(place: Place<FipaHandle>, object: impl Object) -> FipaResult {
    place.put(add(Arc::new(object)));
    FipaResult::Ok
}

/// Calls a function with the letter of a handle.
pub(crate) fn with_letter<T>(
    handle: FipaHandle,
    read: impl FnOnce(&Letter) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let object = any(handle)?;
    let letter = object.letter();
    read(letter.ok_or_else(|| other_kind(handle, "Letter"))?)
}

/// Returns the object of a handle.
pub(crate) fn get<T: Object>(handle: FipaHandle) -> Result<Arc<T>, Failure> {
    let object: Arc<dyn Any + Send + Sync> = any(handle)?;
    object.downcast().map_err(|_| {
        let expected = type_name::<T>().rsplit("::").next();
        other_kind(handle, expected.unwrap_or_default())
    })
}

/// Returns the object of a handle of any kind.
pub(crate) fn any(handle: FipaHandle) -> Result<Arc<dyn Object>, Failure> {
    let object = key(handle).and_then(|key| TABLE.read().get(key).cloned());
    object.ok_or_else(|| unknown(handle))
}

/// Closes a handle. The caller drops the object, outside of the lock.
pub(crate) fn remove(handle: FipaHandle) -> Result<Arc<dyn Object>, Failure> {
    let object = key(handle).and_then(|key| TABLE.write().remove(key));
    object.ok_or_else(|| unknown(handle))
}

/// The error if a handle is not of the kind that a call takes.
pub(crate) fn other_kind(handle: FipaHandle, expected: &str) -> Failure {
    let text = format!("the handle {handle:#x} is of another kind: expected {expected}");
    Failure::new(FailureKind::BadHandle, text)
}

/// Returns the key of a handle. Several numbers stand for one key, and only one of them was given out.
fn key(handle: FipaHandle) -> Option<DefaultKey> {
    let key = KeyData::from_ffi(handle);
    (key.as_ffi() == handle).then(|| key.into())
}

fn unknown(handle: FipaHandle) -> Failure {
    let text = format!("the handle {handle:#x} was closed, or was never given out");
    Failure::new(FailureKind::BadHandle, text)
}
