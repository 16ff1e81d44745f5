//! Conversations that a program leads from outside Rust's futures.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa::protocol::{DialogueError, Reply, Request, Task};
use fipa::{Agent, Message, MessageBuilder, Performative};
use futures_core::Stream;
use tokio::sync::{Notify, mpsc, oneshot};

use crate::failure::{Failure, FailureKind, OrFail as _};
use crate::script::script;

/// Time for the answer to a cancel.
pub(crate) const CANCEL: Duration = Duration::from_secs(10);

/// Time for the decision on a proposal. The partner watch ends a conversation whose initiator is gone before.
const DECISION: Duration = Duration::from_secs(100 * 365 * 24 * 60 * 60);

/// An event of a request.
#[derive(Debug)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each event"
)]
pub enum RequestEvent {
    /// The other agent has agreed.
    Agreed,
    /// The answer, the last event.
    Answer(Box<Message>),
}

/// Requests an action (FIPA00026), or asks (FIPA00027) if the act of the message is `query-ref` or `query-if`.
/// `cancel` cancels the request, which then ends with an error, or goes on. Dropping the stream ends the conversation
/// without a word to the other agent.
pub fn request(
    agent: Agent,
    message: MessageBuilder,
    act: &Performative,
    timeout: Duration,
    cancel: Arc<Notify>,
) -> impl Stream<Item = Result<RequestEvent, Failure>> + Send + use<> {
    let is_query = matches!(act, Performative::QueryRef | Performative::QueryIf);
    script(async move |emitter| {
        let mut request = match is_query {
            true => agent.query(message, timeout).await,
            false => agent.request(message, timeout).await,
        }
        .or_fail()?;
        loop {
            tokio::select! {
                agreed = request.agreed() => {
                    if agreed.or_fail()? {
                        emitter.emit(RequestEvent::Agreed).await;
                    }
                    break;
                }
                () = cancel.notified() => cancelled(&mut request).await.or_fail()?,
            }
        }
        let answer = loop {
            tokio::select! {
                answer = request.result() => break answer.or_fail()?,
                () = cancel.notified() => cancelled(&mut request).await.or_fail()?,
            }
        };
        emitter.emit(RequestEvent::Answer(Box::new(answer))).await;
        Ok(())
    })
}

/// Cancels a request. It ends with an error, or goes on.
async fn cancelled(request: &mut Request) -> Result<(), DialogueError> {
    request.cancel(CANCEL).await.map(drop)
}

/// A message that the program sends in a conversation that it serves.
#[derive(Debug)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each command"
)]
pub enum Command {
    /// Agrees; the result follows.
    Agree(Bytes),
    /// An `inform` after which the conversation goes on.
    Notify(Bytes),
    /// A proposal (FIPA00029), which waits for the decision. After a rejection the conversation is over.
    Propose(Bytes),
    /// The last message.
    Last(Reply),
}

type Done = oneshot::Sender<Result<bool, Failure>>;

/// A conversation that the program serves, led by [`lead`] in the background until the last message, or until this
/// value is dropped.
pub struct Conversation(mpsc::Sender<(Command, Done)>);

impl Conversation {
    /// Sends a message, and waits until it is delivered; a proposal, until it is decided on. Returns false if a proposal
    /// is rejected, else true.
    pub fn send(
        &self,
        command: Command,
    ) -> impl Future<Output = Result<bool, Failure>> + Send + use<> {
        let commands = self.0.clone();
        async move {
            let (done, result) = oneshot::channel();
            let over = || Failure::new(FailureKind::Closed, "the conversation has ended");
            commands.send((command, done)).await.map_err(|_| over())?;
            // The conversation may end while it sends.
            drop(commands);
            result.await.unwrap_or_else(|_| Err(over()))
        }
    }
}

impl fmt::Debug for Conversation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Conversation").finish_non_exhaustive()
    }
}

/// An event of a conversation that the program serves.
#[derive(Debug)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each event"
)]
pub enum TaskEvent {
    /// The conversation has begun with this message.
    Begun(Box<Message>, Conversation),
    /// The initiator cancels the conversation, or is gone.
    Cancelled(Result<(), Failure>),
    /// The initiator has decided on the proposal: whether it has accepted.
    Decided(bool),
}

/// Leads a task as the program commands. `tell` hands an event to the program, and returns false if the program takes
/// no more. It is for the handler of [`Agent::serve`].
///
/// # Errors
/// If the program ends the conversation without a last message.
pub async fn lead(
    mut task: Task,
    tell: impl Fn(TaskEvent) -> bool + Send,
) -> Result<Reply, &'static str> {
    let (commands, mut commanded) = mpsc::channel::<(Command, Done)>(1);
    let begun = TaskEvent::Begun(Box::new(task.message().clone()), Conversation(commands));
    if !tell(begun) {
        return Err("the program has ended its server");
    }
    let mut goes_on = true;
    loop {
        let command = tokio::select! {
            command = commanded.recv() => command,
            cancelled = task.cancelled(), if goes_on => {
                goes_on = false;
                // The program may have ended its server; it still can answer.
                let _ = tell(TaskEvent::Cancelled(cancelled.or_fail()));
                continue;
            }
        };
        let Some((command, done)) = command else {
            return Err("the program has ended the conversation without a last message");
        };
        // The program may no longer wait for the result of a command.
        let result = match command {
            Command::Agree(content) => task.agree(content).await.map(|()| true),
            Command::Notify(content) => task.inform(content).await.map(|()| true),
            Command::Propose(content) => match task.propose(content, DECISION).await {
                Ok(accepted) => {
                    let _ = tell(TaskEvent::Decided(accepted));
                    if !accepted {
                        let _ = done.send(Ok(false));
                        return Ok(Reply::Nothing);
                    }
                    Ok(true)
                }
                Err(error) => Err(error),
            },
            Command::Last(reply) => {
                let result = task.reply(reply).await;
                let _ = done.send(result.map(|()| true).or_fail());
                return Ok(Reply::Nothing);
            }
        };
        let _ = done.send(result.or_fail());
    }
}
