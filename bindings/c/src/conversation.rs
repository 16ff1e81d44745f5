//! Conversations: requests, and serving them.

use std::pin::pin;
use std::sync::Arc;

use bytes::Bytes;
use fipa::blocking::Wait;
use fipa::protocol::Reply;
use fipa::{MessageBuilder, Performative};
use fipa_bindings::{
    Command, Conversation, Failure, FailureKind, OrFail, RequestEvent, TaskEvent, lead, request,
};
use futures_util::StreamExt as _;
use tokio::sync::{Notify, mpsc};

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, Following, GivenHandle, Items, OperationHandle};
use crate::letter::{FipaMessage, Letter};
use crate::message::Draft;
use crate::raw::{FipaBytes, FipaText, LONG, Place, limit};
use crate::table::{self, FipaHandle, Object};

/// Reads the message of a request.
///
/// # Safety
/// As for [`Draft::read`].
unsafe fn opening(
    own: &OwnAgent,
    message: *const FipaMessage,
) -> Result<(MessageBuilder, Performative), Failure> {
    // SAFETY: The caller promises it.
    let draft = unsafe { Draft::read(message) }?;
    let act = draft.performative(Some(Performative::Request))?;
    let message = draft.with_content(own.agent.message(act.clone()))?;
    Ok((message, act))
}

/// Requests an action from one agent (FIPA00026), or asks it (FIPA00027) if the performative is `query-ref` or
/// `query-if`. Waits for the result, up to `timeout_ms` or without a limit if it is negative. The caller closes the
/// answer.
///
/// # Safety
/// `message` is NULL or as its documentation says. `answer` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_request(
    agent: FipaHandle,
    message: *const FipaMessage,
    timeout_ms: i64,
    answer: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let answer = unsafe { Place::of(answer, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let (message, act) = unsafe { opening(&own, message) }?;
        let timeout = limit(timeout_ms).unwrap_or(LONG);
        let events = request(own.agent.clone(), message, &act, timeout, Arc::default());
        let answer_of = async |event| match event {
            Ok(RequestEvent::Agreed) => None,
            Ok(RequestEvent::Answer(answer)) => Some(Ok(answer)),
            Err(failure) => Some(Err(failure)),
        };
        let mut answers = pin!(events.filter_map(answer_of));
        let over = || Failure::new(FailureKind::Closed, "the conversation has ended");
        let result = Letter::from(*answers.next().wait().ok_or_else(over)??);
        Ok(table::give(answer, result))
    })
}

/// Begins a request as `fipa_request`, without waiting. Its items are `FIPA_EVENT_AGREED`, if the other agent agrees
/// first, and then `FIPA_EVENT_ANSWER`, or `FIPA_EVENT_ENDED` with the failure. `fipa_cancel` cancels it; closing the
/// operation only stops listening.
///
/// # Safety
/// `message` is NULL or as its documentation says. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_request(
    agent: FipaHandle,
    message: *const FipaMessage,
    timeout_ms: i64,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let (message, act) = unsafe { opening(&own, message) }?;
        let timeout = limit(timeout_ms).unwrap_or(LONG);
        let cancel = Arc::new(Notify::new());
        let (agent, cancelling) = (own.agent.clone(), Arc::clone(&cancel));
        let events = request(agent, message, &act, timeout, cancelling);
        let events = events.map(|event| match event {
            Ok(RequestEvent::Agreed) => Event::of(FipaEvent::Agreed),
            Ok(RequestEvent::Answer(answer)) => {
                Event::with(FipaEvent::Answer, Letter::from(*answer))
            }
            Err(failure) => Event::ended(Err(failure)),
        });
        let began = OperationHandle::cancellable(own.items.follow(tag, events), cancel);
        Ok(table::give(operation, began))
    })
}

/// A conversation that this agent serves. Its task runs in the background until the last message, or until this
/// value is dropped.
struct OpenTask {
    first: Letter,
    conversation: Conversation,
    items: Items,
}

impl Object for OpenTask {
    fn letter(&self) -> Option<&Letter> {
        Some(&self.first)
    }
}

/// Serves a protocol, such as `fipa-request` or `fipa-query`: each message that begins a conversation of it is an item
/// of the kind `FIPA_EVENT_TASK`. The caller answers it with `fipa_task_reply` and closes it. A task that is closed
/// without a last message ends with `failure`. Closing the server ends the acceptance of further conversations.
///
/// # Safety
/// The text must be readable. `server` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_serve(
    agent: FipaHandle,
    protocol: FipaText,
    tag: u64,
    server: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let server = unsafe { Place::of(server, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let protocol = unsafe { protocol.required("the protocol") }?;
        // A server runs a bounded number of handlers, and each sends at most two events.
        let (events, received) = mpsc::unbounded_channel();
        let items = own.items.clone();
        let served = async {
            own.agent.serve(protocol, move |task| {
                let (events, items) = (events.clone(), items.clone());
                let handle = GivenHandle::default();
                lead(task, move |event| {
                    events.send(task_event(event, &handle, &items)).is_ok()
                })
            })
        };
        let served = served.wait().or_fail()?;
        let open = Following::new(&own.items, tag, served, received);
        Ok(table::give(server, open))
    })
}

fn task_event(event: TaskEvent, handle: &GivenHandle, items: &Items) -> Event {
    match event {
        TaskEvent::Begun(message, conversation) => {
            let open = OpenTask {
                first: Letter::from(*message),
                conversation,
                items: items.clone(),
            };
            Event::giving(FipaEvent::Task, open, handle)
        }
        TaskEvent::Cancelled(cancelled) => {
            Event::about(FipaEvent::Cancel, handle).result(cancelled)
        }
        TaskEvent::Decided(accepted) => {
            Event::about(FipaEvent::Decision, handle).number(accepted.into())
        }
    }
}

/// The act of a message of a participant.
#[repr(i32)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FipaReply {
    /// Agrees; the result follows.
    Agree = 0,
    /// The result, or the answer. The last message.
    Inform = 1,
    /// Refuses, with the reason. The last message.
    Refuse = 2,
    /// Reports a failure, with the reason. The last message.
    Failure = 3,
    /// An `inform` after which the conversation goes on, such as a notification of a subscription.
    Notify = 4,
    /// A proposal, as an answer to a call (FIPA00029). The decision is an item of the kind `FIPA_EVENT_DECISION`. The
    /// result of an accepted proposal is the last message; after a rejection there is none.
    Propose = 5,
}

/// Reads the number of an act. It comes from the caller, and may be any.
fn command(act: i32, content: Bytes) -> Result<Command, Failure> {
    const ACTS: [FipaReply; 6] = [
        FipaReply::Agree,
        FipaReply::Inform,
        FipaReply::Refuse,
        FipaReply::Failure,
        FipaReply::Notify,
        FipaReply::Propose,
    ];
    let known = ACTS.into_iter().find(|known| *known as i32 == act);
    Ok(match known {
        Some(FipaReply::Agree) => Command::Agree(content),
        Some(FipaReply::Propose) => Command::Propose(content),
        Some(FipaReply::Notify) => Command::Notify(content),
        Some(FipaReply::Inform) => Command::Last(Reply::Inform(content)),
        Some(FipaReply::Refuse) => Command::Last(Reply::Refuse(content)),
        Some(FipaReply::Failure) => Command::Last(Reply::Failure(content)),
        None => {
            return Err(Failure::invalid(format!(
                "there is no act of the number {act}"
            )));
        }
    })
}

/// Sends a message of a conversation that this agent serves, with one of the acts of `fipa_reply`, and waits until it
/// is delivered; a proposal, until it is decided on. After `FIPA_EVENT_CANCEL`, `FIPA_REPLY_INFORM` confirms the
/// cancel.
///
/// # Safety
/// The content must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_task_reply(
    task: FipaHandle,
    act: i32,
    content: FipaBytes,
) -> FipaResult {
    call(|| {
        let task = table::get::<OpenTask>(task)?;
        // SAFETY: The caller promises it.
        let content = unsafe { copied(content) }?;
        task.conversation.send(command(act, content)?).wait()?;
        Ok(FipaResult::Ok)
    })
}

/// Sends a message as `fipa_task_reply`, without waiting. The operation has one item, `FIPA_EVENT_ENDED`.
///
/// # Safety
/// The content must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_task_reply(
    task: FipaHandle,
    act: i32,
    content: FipaBytes,
    tag: u64,
) -> FipaResult {
    call(|| {
        let task = table::get::<OpenTask>(task)?;
        // SAFETY: The caller promises it.
        let content = unsafe { copied(content) }?;
        let sent = task.conversation.send(command(act, content)?);
        task.items
            .begin(tag, async { Event::ended(sent.await.map(drop)) });
        Ok(FipaResult::Ok)
    })
}

/// Copies a content.
///
/// # Safety
/// The bytes must be readable.
pub(crate) unsafe fn copied(content: FipaBytes) -> Result<Bytes, Failure> {
    // SAFETY: The caller promises it.
    let content = unsafe { content.read("the content") }?;
    Ok(Bytes::copy_from_slice(content.unwrap_or_default()))
}
