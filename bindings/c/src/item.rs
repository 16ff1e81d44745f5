//! The queue of a domain.

use std::any::Any;
use std::os::fd::AsRawFd as _;
use std::sync::{Arc, OnceLock};

use fipa::Deliveries;
use fipa_queue::{Operation, Queue};
use futures_core::Stream;
use futures_util::stream::poll_fn;
use tokio::sync::{Notify, mpsc};

use crate::actions::OpenGoal;
use crate::contract_net::OpenCall;
use crate::conversation::OpenTask;
use crate::domain::{Membership, Text};
use crate::failure::{Failure, FipaResult, OrFail, call};
use crate::locks::HeldLock;
use crate::message::Letter;
use crate::raw::{self, Extensible, fill, fillable, put};
use crate::table::{self, FipaHandle};

pub(crate) type Items = Queue<Event>;

/// What an item is, and what its handle refers to.
#[repr(i32)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FipaEvent {
    /// The operation has ended. `result` says how; there is no handle.
    Ended = 0,
    /// A message has its outcomes: `fipa_read_text`, the JSON of `fipa_send`.
    Outcomes = 1,
    /// A letter has arrived: `fipa_read_message`.
    Letter = 2,
    /// The directory or a coalition has changed: `fipa_read_text`.
    Change = 3,
    /// The other agent has agreed to a request. There is no handle.
    Agreed = 4,
    /// The answer to a request: `fipa_read_message`.
    Answer = 5,
    /// A conversation that this agent serves has begun: `fipa_read_message`, `fipa_task_reply`.
    Task = 6,
    /// A notification of a subscription: `fipa_read_message`. `number` is the number of notifications that were missed
    /// just before.
    Notification = 7,
    /// A lock is held.
    Lock = 8,
    /// The initiator of a task cancels it, or is gone if `result` says so. The handle is that of the task.
    Cancel = 9,
    /// A subscription is interrupted for the reason in `result`, and goes on when the publisher returns. There is no
    /// handle.
    Interrupted = 10,
    /// The answers to a call for proposals: `fipa_read_bid`, `fipa_award`. `number` is the number of proposals.
    Bids = 11,
    /// The result of an accepted proposal: `fipa_read_message`, or no handle and the failure in `result`. `number` is
    /// the index of the proposal.
    Awarded = 12,
    /// The initiator has decided on the proposal of a task, whose handle it is. `number` is 1 if it has accepted.
    Decision = 13,
    /// A goal of an action that this agent offers: `fipa_read_text` returns its arguments, `fipa_goal_end` ends it.
    Goal = 14,
    /// A goal is to stop, for the reason in `result`: it was cancelled (`FIPA_RESULT_CANCELLED`), its time is over, or
    /// its client is gone. The handle is that of the goal.
    Stop = 15,
    /// A robot has accepted a goal. There is no handle.
    Accepted = 16,
    /// The progress of a goal: `fipa_read_text`, a JSON object with `state`, `fraction`, `note` and `value`.
    Progress = 17,
    /// The result of a goal or of a question: `fipa_read_text`, the value in JSON.
    Result = 18,
}

/// An item of a queue.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaItem {
    /// sizeof(struct fipa_item).
    pub size: usize,
    /// The tag with which the operation was begun.
    pub tag: u64,
    /// What the item is.
    pub kind: FipaEvent,
    /// Zero, or the failure of the operation. `fipa_error` has its text until the next failure of this thread.
    pub result: FipaResult,
    /// The handle, which the caller closes unless the kind says that it is that of a task or goal; zero if there is
    /// none.
    pub handle: FipaHandle,
    /// A number that depends on the kind.
    pub number: u64,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaItem {}

/// An event of an operation.
pub(crate) enum Event {
    Ended(Result<(), Failure>),
    Outcomes(Deliveries),
    Letter(Letter),
    Change(Text),
    Agreed,
    Answer(Letter),
    Task(OpenTask),
    Notification(Letter, u64),
    Interrupted(Failure),
    Lock(HeldLock),
    Cancel(GivenHandle, Result<(), Failure>),
    Bids(OpenCall),
    Awarded(usize, Result<Letter, Failure>),
    Decision(GivenHandle, bool),
    Goal(OpenGoal),
    Stop(GivenHandle, Failure),
    Accepted,
    Progress(Text),
    Result(Text),
}

/// The handle of a task or goal, once the caller has it.
pub(crate) type GivenHandle = Arc<OnceLock<FipaHandle>>;

pub(crate) fn failed(failure: Failure) -> Event {
    Event::Ended(Err(failure))
}

impl Event {
    fn into_item(self, tag: u64) -> Result<FipaItem, Failure> {
        let item = |kind, handle| FipaItem {
            size: size_of::<FipaItem>(),
            tag,
            kind,
            result: FipaResult::Ok,
            handle,
            number: 0,
        };
        Ok(match self {
            Self::Ended(ended) => FipaItem {
                result: result(ended),
                ..item(FipaEvent::Ended, 0)
            },
            Self::Outcomes(outcomes) => FipaItem {
                result: outcome(&outcomes),
                ..item(FipaEvent::Outcomes, table::add(Text::json(&outcomes)?))
            },
            Self::Letter(letter) => item(FipaEvent::Letter, table::add(letter)),
            Self::Change(change) => item(FipaEvent::Change, table::add(change)),
            Self::Agreed => item(FipaEvent::Agreed, 0),
            Self::Answer(letter) => item(FipaEvent::Answer, table::add(letter)),
            Self::Task(task) => {
                let given = Arc::clone(&task.handle);
                item(FipaEvent::Task, give(task, &given))
            }
            Self::Notification(letter, missed) => FipaItem {
                number: missed,
                ..item(FipaEvent::Notification, table::add(letter))
            },
            Self::Interrupted(failure) => FipaItem {
                result: failure.store(),
                ..item(FipaEvent::Interrupted, 0)
            },
            Self::Lock(lock) => item(FipaEvent::Lock, table::add(lock)),
            // The item of the task has come before.
            Self::Cancel(task, cause) => FipaItem {
                result: result(cause),
                ..item(FipaEvent::Cancel, given(&task))
            },
            Self::Bids(call) => FipaItem {
                number: call.proposals() as u64,
                ..item(FipaEvent::Bids, table::add(call))
            },
            Self::Awarded(index, result) => {
                let (handle, result) = match result {
                    Ok(letter) => (table::add(letter), FipaResult::Ok),
                    Err(failure) => (0, failure.store()),
                };
                FipaItem {
                    result,
                    number: index as u64,
                    ..item(FipaEvent::Awarded, handle)
                }
            }
            Self::Decision(task, accepted) => FipaItem {
                number: accepted.into(),
                ..item(FipaEvent::Decision, given(&task))
            },
            Self::Goal(goal) => {
                let given = Arc::clone(&goal.handle);
                item(FipaEvent::Goal, give(goal, &given))
            }
            Self::Stop(goal, cause) => FipaItem {
                result: cause.store(),
                ..item(FipaEvent::Stop, given(&goal))
            },
            Self::Accepted => item(FipaEvent::Accepted, 0),
            Self::Progress(progress) => item(FipaEvent::Progress, table::add(progress)),
            Self::Result(result) => item(FipaEvent::Result, table::add(result)),
        })
    }
}

/// Gives an object a handle that its later events can name.
fn give<T: Any + Send + Sync>(object: T, given: &GivenHandle) -> FipaHandle {
    let handle = table::add(object);
    // An object is an item once.
    let _ = given.set(handle);
    handle
}

/// Returns the handle of an object whose item has come before.
fn given(handle: &GivenHandle) -> FipaHandle {
    handle.get().copied().unwrap_or(0)
}

fn result(result: Result<(), Failure>) -> FipaResult {
    match result {
        Ok(()) => FipaResult::Ok,
        Err(failure) => failure.store(),
    }
}

/// The result of a message with these outcomes. The text of a failure lists them.
pub(crate) fn outcome(outcomes: &Deliveries) -> FipaResult {
    match outcomes.all_succeeded() {
        true => FipaResult::Ok,
        false => Failure::new(FipaResult::NotDelivered, outcomes.to_string()).store(),
    }
}

/// Sends the events of an operation. At most two wait, so an operation does not run ahead of its program.
#[derive(Clone)]
pub(crate) struct Emitter(mpsc::Sender<Event>);

impl Emitter {
    pub(crate) async fn emit(&self, event: Event) {
        // Fails only if the operation was abandoned, which drops this future, too.
        let _ = self.0.send(event).await;
    }
}

/// The events that a function emits. An error is the last one.
pub(crate) fn script<F>(run: impl FnOnce(Emitter) -> F) -> impl Stream<Item = Event> + Send
where
    F: Future<Output = Result<(), Failure>> + Send + 'static,
{
    let (sender, mut events) = mpsc::channel(1);
    let emitter = Emitter(sender);
    let running = run(emitter.clone());
    let mut running = Some(Box::pin(async move {
        if let Err(failure) = running.await {
            emitter.emit(failed(failure)).await;
        }
    }));
    poll_fn(move |context| {
        if let Some(script) = &mut running
            && script.as_mut().poll(context).is_ready()
        {
            // Its emitter, too, so that the stream ends after the last event.
            running = None;
        }
        events.poll_recv(context)
    })
}

/// An operation that was begun.
pub(crate) struct OperationHandle {
    operation: Operation,
    cancel: Arc<Notify>,
}

impl OperationHandle {
    pub(crate) fn of(operation: Operation) -> Self {
        Self::cancellable(operation, Arc::default())
    }

    pub(crate) fn cancellable(operation: Operation, cancel: Arc<Notify>) -> Self {
        Self { operation, cancel }
    }

    pub(crate) fn end(&self) {
        self.operation.abandon();
    }
}

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
        let Some(next) = membership.items.next(raw::limit(timeout_ms)) else {
            return Ok(FipaResult::Empty);
        };
        let next = next.event.into_item(next.tag)?;
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
        let membership = table::get::<Membership>(domain)?;
        let descriptor = membership.items.descriptor().or_fail()?.as_raw_fd();
        // SAFETY: The caller promises it.
        unsafe { put(fd, descriptor, "the fd") }?;
        Ok(FipaResult::Ok)
    })
}

/// Asks the other side to cancel the conversation of an operation. The operation then ends with
/// `FIPA_RESULT_CANCELLED`, or with its result if the other side goes on.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_cancel(operation: FipaHandle) -> FipaResult {
    call(|| {
        table::get::<OperationHandle>(operation)?
            .cancel
            .notify_one();
        Ok(FipaResult::Ok)
    })
}
