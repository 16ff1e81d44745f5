//! Conversations: requests, and serving them.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa::blocking::Wait;
use fipa::protocol::{DialogueError, Reply, Request, Task};
use fipa::{Agent, MessageBuilder, Performative};
use tokio::sync::{Notify, mpsc, oneshot};

use crate::agent::OwnAgent;
use crate::failure::{Failure, FipaResult, OrFail, call};
use crate::item::{Event, FipaEvent, Following, GivenHandle, Items, OperationHandle, script};
use crate::letter::{FipaMessage, Letter};
use crate::message::Draft;
use crate::raw::{FipaBytes, FipaText, LONG, Place, limit};
use crate::table::{self, FipaHandle, Object};

/// Time for the answer to a cancel.
const CANCEL: Duration = Duration::from_secs(10);

/// Begins a request (`fipa-request`) or, if the act is `query-ref` or `query-if`, a query.
async fn begin(
    agent: &Agent,
    message: MessageBuilder,
    is_query: bool,
    timeout: Duration,
) -> Result<Request, DialogueError> {
    match is_query {
        true => agent.query(message, timeout).await,
        false => agent.request(message, timeout).await,
    }
}

/// Reads the message of a request.
///
/// # Safety
/// As for [`Draft::read`].
unsafe fn opening(
    own: &OwnAgent,
    message: *const FipaMessage,
) -> Result<(MessageBuilder, bool), Failure> {
    // SAFETY: The caller promises it.
    let draft = unsafe { Draft::read(message) }?;
    let act = draft.performative(Some(Performative::Request))?;
    let is_query = matches!(act, Performative::QueryRef | Performative::QueryIf);
    Ok((draft.with_content(own.agent.message(act))?, is_query))
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
        let (message, is_query) = unsafe { opening(&own, message) }?;
        let timeout = limit(timeout_ms).unwrap_or(LONG);
        let result = async {
            let mut request = begin(&own.agent, message, is_query, timeout).await?;
            request.result().await
        };
        let result = Letter::from(result.wait().or_fail()?);
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
        let (message, is_query) = unsafe { opening(&own, message) }?;
        let timeout = limit(timeout_ms).unwrap_or(LONG);
        let cancel = Arc::new(Notify::new());
        let (agent, cancelling) = (own.agent.clone(), Arc::clone(&cancel));
        let events = script(async move |emitter| {
            let mut request = begin(&agent, message, is_query, timeout).await.or_fail()?;
            loop {
                tokio::select! {
                    agreed = request.agreed() => {
                        if agreed.or_fail()? {
                            emitter.emit(Event::of(FipaEvent::Agreed)).await;
                        }
                        break;
                    }
                    () = cancelling.notified() => cancelled(&mut request).await.or_fail()?,
                }
            }
            let answer = loop {
                tokio::select! {
                    answer = request.result() => break answer.or_fail()?,
                    () = cancelling.notified() => cancelled(&mut request).await.or_fail()?,
                }
            };
            let answer = Letter::from(answer);
            emitter.emit(Event::with(FipaEvent::Answer, answer)).await;
            Ok(())
        });
        let began = OperationHandle::cancellable(own.items.follow(tag, events), cancel);
        Ok(table::give(operation, began))
    })
}

/// Cancels a request. It ends with an error, or goes on.
async fn cancelled(request: &mut Request) -> Result<(), DialogueError> {
    request.cancel(CANCEL).await.map(drop)
}

/// A conversation that this agent serves. Its task runs in the background until the last message, or until this
/// value is dropped.
struct OpenTask {
    first: Letter,
    commands: mpsc::Sender<(Command, Done)>,
    items: Items,
}

type Done = oneshot::Sender<Result<(), Failure>>;

/// A message that the caller sends in a conversation.
enum Command {
    Agree(Bytes),
    Notify(Bytes),
    Propose(Bytes),
    Last(Reply),
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
                handle(task, events.clone(), items.clone())
            })
        };
        let served = served.wait().or_fail()?;
        let open = Following::new(&own.items, tag, served, received);
        Ok(table::give(server, open))
    })
}

/// Leads a task as the caller commands, and tells the caller if the initiator cancels it or is gone.
async fn handle(
    mut task: Task,
    events: mpsc::UnboundedSender<Event>,
    items: Items,
) -> Result<Reply, &'static str> {
    let (commands, mut commanded) = mpsc::channel::<(Command, Done)>(1);
    let handle = GivenHandle::default();
    let open = OpenTask {
        first: Letter::from(task.message().clone()),
        commands,
        items,
    };
    if events
        .send(Event::giving(FipaEvent::Task, open, &handle))
        .is_err()
    {
        return Err("the program has ended its server");
    }
    let mut goes_on = true;
    loop {
        let command = tokio::select! {
            command = commanded.recv() => command,
            cancelled = task.cancelled(), if goes_on => {
                goes_on = false;
                let cancelled = cancelled.map_err(Failure::of);
                // The program may have ended its server; it still can answer.
                let _ = events.send(Event::about(FipaEvent::Cancel, &handle).result(cancelled));
                continue;
            }
        };
        let Some((command, done)) = command else {
            return Err("the program has ended the conversation without a last message");
        };
        let result = match command {
            Command::Agree(content) => task.agree(content).await,
            Command::Notify(content) => task.inform(content).await,
            Command::Propose(content) => match task.propose(content, LONG).await {
                Ok(accepted) => {
                    let decision = Event::about(FipaEvent::Decision, &handle);
                    let _ = events.send(decision.number(accepted.into()));
                    if !accepted {
                        let _ = done.send(Ok(()));
                        return Ok(Reply::Nothing);
                    }
                    Ok(())
                }
                Err(error) => Err(error),
            },
            Command::Last(reply) => {
                let result = task.reply(reply).await;
                // The caller may no longer wait.
                let _ = done.send(result.map_err(Failure::of));
                return Ok(Reply::Nothing);
            }
        };
        let _ = done.send(result.map_err(Failure::of));
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

impl Command {
    /// Reads the number of an act. It comes from the caller, and may be any.
    fn of(act: i32, content: Bytes) -> Result<Self, Failure> {
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
            Some(FipaReply::Agree) => Self::Agree(content),
            Some(FipaReply::Propose) => Self::Propose(content),
            Some(FipaReply::Notify) => Self::Notify(content),
            Some(FipaReply::Inform) => Self::Last(Reply::Inform(content)),
            Some(FipaReply::Refuse) => Self::Last(Reply::Refuse(content)),
            Some(FipaReply::Failure) => Self::Last(Reply::Failure(content)),
            None => {
                return Err(Failure::invalid(format!(
                    "there is no act of the number {act}"
                )));
            }
        })
    }
}

impl OpenTask {
    /// Has the background task send a message.
    fn command(
        &self,
        command: Command,
    ) -> impl Future<Output = Result<(), Failure>> + Send + 'static {
        let commands = self.commands.clone();
        async move {
            let (done, result) = oneshot::channel();
            let over = || Failure::new(FipaResult::Closed, "the conversation has ended");
            commands.send((command, done)).await.map_err(|_| over())?;
            result.await.unwrap_or_else(|_| Err(over()))
        }
    }
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
        task.command(Command::of(act, content)?).wait()?;
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
        let sent = task.command(Command::of(act, content)?);
        task.items.begin(tag, async { Event::ended(sent.await) });
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
