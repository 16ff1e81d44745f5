//! The calls that take handles of several kinds, and the queue of a domain.

use std::os::fd::AsRawFd as _;

use crate::domain::Membership;
use crate::failure::{FipaResult, call};
use crate::item::{FipaItem, OperationHandle};
use crate::raw::{FipaText, Place, fill, fillable, limit};
use crate::table::{self, FipaHandle};
use fipa_bindings::OrFail;

/// Takes the next item of a domain; waits for it up to `timeout_ms`, or without a limit if that is negative. Returns
/// `FIPA_RESULT_EMPTY` if there is none. Several threads may wait; each item goes to one of them.
///
/// # Safety
/// `item` is NULL, or its first field is the number of bytes that can be written there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_next(
    domain: FipaHandle,
    timeout_ms: i64,
    item: *mut FipaItem,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it. An item that cannot be written must not be taken.
        unsafe { fillable(item, "the item") }?;
        let membership = table::get::<Membership>(domain)?;
        let Some(next) = membership.items.next(limit(timeout_ms)) else {
            return Ok(FipaResult::Empty);
        };
        let next = next.event.into_item(next.tag);
        // SAFETY: The caller promises it.
        unsafe { fill(item, next, "the item") }?;
        Ok(FipaResult::Ok)
    })
}

/// Returns a descriptor for poll, epoll or an event loop. It is readable from before an item can be taken until
/// `fipa_next` with a time limit of 0 has returned `FIPA_RESULT_EMPTY`. It may be readable without an item. The caller
/// neither reads nor closes it, and stops polling it before it closes the domain.
///
/// # Safety
/// `fd` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_fd(domain: FipaHandle, fd: *mut i32) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let fd = unsafe { Place::of(fd, "the fd") }?;
        let membership = table::get::<Membership>(domain)?;
        let descriptor = membership.items.descriptor().or_fail()?.as_raw_fd();
        fd.put(descriptor);
        Ok(FipaResult::Ok)
    })
}

/// Asks the other side to cancel the conversation of an operation. The operation then ends with
/// `FIPA_RESULT_CANCELLED`, or with its result if the other side goes on.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_cancel(operation: FipaHandle) -> FipaResult {
    call(|| {
        table::get::<OperationHandle>(operation)?.cancel();
        Ok(FipaResult::Ok)
    })
}

/// Returns the text of a handle: of a JSON text, of the answers to a call for proposals, or of the arguments of a goal.
/// It is valid until the handle is closed.
///
/// # Safety
/// `text` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_text(handle: FipaHandle, text: *mut FipaText) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let text = unsafe { Place::of(text, "the text") }?;
        let object = table::any(handle)?;
        let own = object
            .text()
            .ok_or_else(|| table::other_kind(handle, "Text"))?;
        text.put(FipaText::of(own));
        Ok(FipaResult::Ok)
    })
}

/// Closes a handle of any kind. What was read from it is no longer valid.
///
/// A domain is left, and letters in transit get one second; an agent is deregistered; a lock is released; a task that
/// has no answer fails; an operation ends, without a further item; an open loan is dropped.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_close(handle: FipaHandle) -> FipaResult {
    call(|| {
        table::remove(handle)?.close()?;
        Ok(FipaResult::Ok)
    })
}
