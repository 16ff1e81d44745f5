//! Locks of resources, and their owners.

use std::path::PathBuf;
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::locks::{Lock, LockError, OwnOptions, Owned};
use fipa::{Agent, Message, MessageBuilder};

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, OperationHandle, script};
use crate::raw::{Extensible, FipaText, Place, Readable, fill, limit, structure, texts};
use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, OrFail};

/// A lock that the caller holds.
pub(crate) struct HeldLock {
    pub(crate) lock: Lock,
    fence: Option<String>,
}

impl HeldLock {
    fn new(lock: Lock) -> Self {
        let fence = lock.fence().map(ToString::to_string);
        Self { lock, fence }
    }
}

impl Object for HeldLock {
    fn guard(&self, message: MessageBuilder) -> Option<Result<MessageBuilder, Failure>> {
        Some(Ok(self.lock.guard(message)))
    }
}

/// Locks resources, all of them or none; waits up to `timeout_ms`, or without a limit if it is negative. The agent
/// renews the leases in the background. `fipa_close` releases the lock.
///
/// # Safety
/// The texts must be readable. `lock` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_lock(
    agent: FipaHandle,
    resources: *const FipaText,
    resource_count: usize,
    timeout_ms: i64,
    lock: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let lock = unsafe { Place::of(lock, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let resources = unsafe { named(resources, resource_count) }?;
        let acquired = acquire(&own.agent, &resources, limit(timeout_ms)).wait();
        let held = HeldLock::new(acquired.or_fail()?);
        Ok(table::give(lock, held))
    })
}

/// Reads the names of the resources of a lock.
///
/// # Safety
/// As for [`texts`].
unsafe fn named<'a>(resources: *const FipaText, count: usize) -> Result<Vec<&'a str>, Failure> {
    // SAFETY: The caller promises it.
    let resources = unsafe { texts(resources, count, "a resource") }?;
    match resources.is_empty() {
        true => Err(Failure::invalid("a lock without a resource")),
        false => Ok(resources),
    }
}

async fn acquire(
    agent: &Agent,
    resources: &[&str],
    within: Option<Duration>,
) -> Result<Lock, LockError> {
    match within {
        Some(within) => agent.lock_all_within(resources, within).await,
        None => agent.lock_all(resources).await,
    }
}

/// Locks resources as `fipa_lock`, without waiting. The first item is `FIPA_EVENT_LOCK`, with the handle of the lock,
/// or `FIPA_EVENT_ENDED` with the failure. After the lock, an item `FIPA_EVENT_ENDED` says that it was lost
/// (`FIPA_RESULT_LOST`), or that it was released or the agent deregistered (`FIPA_RESULT_CLOSED`). Closing the
/// operation before the lock withdraws the request.
///
/// # Safety
/// The texts must be readable. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_lock(
    agent: FipaHandle,
    resources: *const FipaText,
    resource_count: usize,
    timeout_ms: i64,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let resources = unsafe { named(resources, resource_count) }?;
        let resources: Vec<String> = resources.into_iter().map(str::to_owned).collect();
        let (agent, within) = (own.agent.clone(), limit(timeout_ms));
        let events = script(async move |emitter| {
            let resources: Vec<&str> = resources.iter().map(String::as_str).collect();
            let lock = acquire(&agent, &resources, within).await.or_fail()?;
            let lost = lock.lost();
            emitter
                .emit(Event::with(FipaEvent::Lock, HeldLock::new(lock)))
                .await;
            Err(Failure::of(lost.await))
        });
        let began = OperationHandle::of(own.items.follow(tag, events));
        Ok(table::give(operation, began))
    })
}

/// The state of a lock.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaLockInfo {
    /// sizeof(struct fipa_lock_info).
    pub size: usize,
    /// Milliseconds until the shortest lease ends unless it is renewed: 0 after the loss of the lock, -1 if no owner
    /// gives a lease.
    pub remaining_ms: i64,
    /// The fence of the first resource. Empty if its owner gives none. Valid until the lock is closed.
    pub fence: FipaText,
    /// 1 if the agent holds all resources, else 0.
    pub is_held: i32,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaLockInfo {}

/// Returns the state of a lock.
///
/// # Safety
/// `info` is NULL, or its first field is the number of bytes that can be written there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_lock(lock: FipaHandle, info: *mut FipaLockInfo) -> FipaResult {
    call(|| {
        let held = table::get::<HeldLock>(lock)?;
        let remaining = held.lock.remaining();
        let remaining = remaining.map(|it| i64::try_from(it.as_millis()).unwrap_or(i64::MAX));
        let state = FipaLockInfo {
            size: size_of::<FipaLockInfo>(),
            remaining_ms: remaining.unwrap_or(-1),
            fence: FipaText::of_option(held.fence.as_deref()),
            is_held: held.lock.is_held().into(),
        };
        // SAFETY: The caller promises it.
        unsafe { fill(info, state, "the info") }?;
        Ok(FipaResult::Ok)
    })
}

/// How an agent owns a resource. A field that is zero has its default.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaOwnOptions {
    /// sizeof(struct fipa_own_options).
    pub size: usize,
    /// Lease of a grant in milliseconds (15,000). A holder that ends without a proof delays the next one for this time.
    pub lease_ms: i64,
    /// Directory of the state file, which keeps fences rising over restarts. By default `$FIPA_STATE_DIR`, else `fipa`
    /// in `$XDG_STATE_HOME`, else `~/.local/state/fipa`.
    pub state_dir: FipaText,
    /// Not 0: without a state file. Each start then grants nothing for one lease, and for at least 15 s.
    pub is_volatile: i32,
    /// Not 0: an owner without a file grants at once, because no lock of an earlier run is in use.
    pub forget: i32,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaOwnOptions {}
// SAFETY: Its fields are pointers and numbers.
unsafe impl Readable for FipaOwnOptions {}

/// A resource that an agent owns.
struct OpenOwned(Owned);

impl Object for OpenOwned {
    fn check(&self, message: &Message) -> Option<Result<(), Failure>> {
        Some(self.0.check(message).map(drop).or_fail())
    }
}

/// Owns a resource, whose locks other agents then request. `options` may be NULL. `fipa_close` ends it.
///
/// # Safety
/// `resource` must be readable. `options` is NULL or as its documentation says. `owned` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_own(
    agent: FipaHandle,
    resource: FipaText,
    options: *const FipaOwnOptions,
    owned: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let owned = unsafe { Place::of(owned, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let resource = unsafe { resource.required("the resource") }?;
        // SAFETY: The caller promises it.
        let options = unsafe { own_options(options) }?;
        let open = OpenOwned(own.agent.own(resource, options).wait().or_fail()?);
        Ok(table::give(owned, open))
    })
}

/// Reads how an agent owns a resource; NULL means the defaults.
///
/// # Safety
/// `options` is NULL or as its documentation says.
pub(crate) unsafe fn own_options(options: *const FipaOwnOptions) -> Result<OwnOptions, Failure> {
    let mut chosen = OwnOptions::default();
    if options.is_null() {
        return Ok(chosen);
    }
    // SAFETY: The caller promises it.
    let options = unsafe { structure(options, "the options") }?;
    if options.lease_ms != 0 {
        let lease = limit(options.lease_ms);
        chosen.lease = lease.ok_or_else(|| Failure::invalid("the lease is negative"))?;
    }
    // SAFETY: The caller promises it.
    let dir = unsafe { options.state_dir.read("the state_dir") }?;
    chosen.state_dir = dir.filter(|dir| !dir.is_empty()).map(PathBuf::from);
    chosen.volatile = options.is_volatile != 0;
    chosen.forget = options.forget != 0;
    Ok(chosen)
}

/// Checks the fence that a message carries (`lock` of `fipa_message`) for a resource that this agent owns, or for a
/// coalition in which it takes part. The result is `FIPA_RESULT_STALE` if the message must not be acted on.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_check_fence(guard: FipaHandle, letter: FipaHandle) -> FipaResult {
    call(|| {
        let object = table::any(guard)?;
        table::with_letter(letter, |letter| {
            let checked = object.check(letter.message());
            checked.ok_or_else(|| table::other_kind(guard, "OpenOwned"))??;
            Ok(FipaResult::Ok)
        })
    })
}
