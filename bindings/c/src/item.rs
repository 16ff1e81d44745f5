//! The events of operations, and the items that they become.

use std::sync::{Arc, OnceLock};

use fipa_bindings::{Emitter, Failure, FailureKind, Operation, Queue};
use futures_core::Stream;
use futures_util::StreamExt as _;
use futures_util::stream::poll_fn;
use serde::Serialize;
use tokio::sync::{Notify, mpsc};

use crate::failure::{FipaResult, store};
use crate::raw::Extensible;
use crate::table::{self, FipaHandle, Object};

pub(crate) type Items = Queue<Event>;

/// The kind of an item, which says what its handle refers to.
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
    /// The kind.
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

/// The handle of a task or goal, once the caller has it.
pub(crate) type GivenHandle = Arc<OnceLock<FipaHandle>>;

/// An event of an operation, before it is an item.
pub(crate) struct Event {
    kind: FipaEvent,
    result: Result<(), Failure>,
    subject: Subject,
    number: u64,
}

/// The object of an event.
enum Subject {
    None,
    /// It gets a handle, which later events may name.
    New(Arc<dyn Object>, Option<GivenHandle>),
    /// Its item has come before.
    Given(GivenHandle),
}

impl Event {
    pub(crate) fn of(kind: FipaEvent) -> Self {
        Self {
            kind,
            result: Ok(()),
            subject: Subject::None,
            number: 0,
        }
    }

    /// An event with an object.
    pub(crate) fn with(kind: FipaEvent, object: impl Object) -> Self {
        Self {
            subject: Subject::New(Arc::new(object), None),
            ..Self::of(kind)
        }
    }

    /// An event with an object whose later events name its handle.
    pub(crate) fn giving(kind: FipaEvent, object: impl Object, handle: &GivenHandle) -> Self {
        Self {
            subject: Subject::New(Arc::new(object), Some(Arc::clone(handle))),
            ..Self::of(kind)
        }
    }

    /// An event with a value in JSON.
    pub(crate) fn json(kind: FipaEvent, value: &impl Serialize) -> Self {
        match Text::json(value) {
            Ok(text) => Self::with(kind, text),
            Err(failure) => Self::ended(Err(failure)),
        }
    }

    /// An event about an object whose item has come before.
    pub(crate) fn about(kind: FipaEvent, handle: &GivenHandle) -> Self {
        Self {
            subject: Subject::Given(Arc::clone(handle)),
            ..Self::of(kind)
        }
    }

    /// The end of an operation.
    pub(crate) fn ended(result: Result<(), Failure>) -> Self {
        Self::of(FipaEvent::Ended).result(result)
    }

    pub(crate) fn result(self, result: Result<(), Failure>) -> Self {
        Self { result, ..self }
    }

    pub(crate) fn number(self, number: u64) -> Self {
        Self { number, ..self }
    }

    /// Gives the object its handle, and this thread the text of a failure.
    pub(crate) fn into_item(self, tag: u64) -> FipaItem {
        let handle = match self.subject {
            Subject::None => 0,
            Subject::New(object, given) => {
                let handle = table::add(object);
                if let Some(given) = given {
                    // An object is an item once.
                    let _ = given.set(handle);
                }
                handle
            }
            Subject::Given(given) => given.get().copied().unwrap_or(0),
        };
        FipaItem {
            size: size_of::<FipaItem>(),
            tag,
            kind: self.kind,
            result: match self.result {
                Ok(()) => FipaResult::Ok,
                Err(failure) => store(failure),
            },
            handle,
            number: self.number,
        }
    }
}

/// A text that the caller reads.
pub(crate) struct Text(String);

impl Text {
    pub(crate) fn json(value: &impl Serialize) -> Result<Self, Failure> {
        let text = serde_json::to_string(value);
        let text = text.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()));
        text.map(Self)
    }

    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl Object for Text {
    fn text(&self) -> Option<&str> {
        Some(&self.0)
    }
}

/// The events that a function emits. An error is the last one.
pub(crate) fn script<F>(run: impl FnOnce(Emitter<Event>) -> F) -> impl Stream<Item = Event> + Send
where
    F: Future<Output = Result<(), Failure>> + Send + 'static,
{
    let events = fipa_bindings::script(run);
    events.map(|event| event.unwrap_or_else(|failure| Event::ended(Err(failure))))
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

    /// Asks the operation to cancel its conversation.
    pub(crate) fn cancel(&self) {
        self.cancel.notify_one();
    }
}

impl Object for OperationHandle {
    fn close(&self) -> Result<(), Failure> {
        self.operation.abandon();
        Ok(())
    }
}

/// Something that begins operations of other agents, such as a server, with its events.
pub(crate) struct Following<T> {
    _kept: T,
    operation: OperationHandle,
}

impl<T: Send + Sync + 'static> Following<T> {
    /// Makes each event of `events` an item of the tag.
    pub(crate) fn new(
        items: &Items,
        tag: u64,
        kept: T,
        mut events: mpsc::UnboundedReceiver<Event>,
    ) -> Self {
        let events = poll_fn(move |context| events.poll_recv(context));
        Self {
            _kept: kept,
            operation: OperationHandle::of(items.follow(tag, events)),
        }
    }
}

impl<T: Send + Sync + 'static> Object for Following<T> {
    fn close(&self) -> Result<(), Failure> {
        self.operation.close()
    }
}
