//! Agents: registering, sending, loans, receiving.

use std::time::Duration;

use fipa::blocking::Wait;
use fipa::error::DeregisterError;
use fipa::{Agent, Incoming, Loan, MessageBuilder, RegisterOptions};
use futures_util::stream::unfold;

use crate::domain::Membership;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, Items, OperationHandle, Text};
use crate::letter::{FipaMessage, Letter};
use crate::loaned::Loaned;
use crate::message::Draft;
use crate::raw::{Extensible, FipaText, Place, Readable, limit, structure};
use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, OrFail, Sending, all_delivered, send_loan};

/// The description of an agent in the directory. A field that is zero is not set.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaAgentOptions {
    /// sizeof(struct fipa_agent_options).
    pub size: usize,
    /// The kind of agent, for searches.
    pub agent_type: FipaText,
    /// Free text.
    pub description: FipaText,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaAgentOptions {}
// SAFETY: Its fields are pointers and numbers.
unsafe impl Readable for FipaAgentOptions {}

/// An agent, with the queue of its domain.
pub(crate) struct OwnAgent {
    pub(crate) agent: Agent,
    pub(crate) items: Items,
}

impl Object for OwnAgent {
    fn close(&self) -> Result<(), Failure> {
        // Operations hold further handles of the agent.
        match self.agent.clone().deregister() {
            // The domain was closed before, which has deregistered the agent.
            Ok(_) | Err(DeregisterError::Closed) => Ok(()),
            Err(error) => Err(Failure::of(error)),
        }
    }
}

/// Registers an agent. `options` may be NULL. `fipa_close` deregisters it, and what it has not received is dropped.
///
/// # Safety
/// The texts must be readable. `agent` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_register(
    domain: FipaHandle,
    name: FipaText,
    options: *const FipaAgentOptions,
    agent: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let agent = unsafe { Place::of(agent, "the handle") }?;
        let membership = table::get::<Membership>(domain)?;
        // SAFETY: The caller promises it.
        let name = unsafe { name.required("the name") }?;
        let mut described = RegisterOptions::default();
        if !options.is_null() {
            // SAFETY: The caller promises it.
            let options = unsafe { structure(options, "the options") }?;
            // SAFETY: The caller promises it.
            let agent_type = unsafe { options.agent_type.read("the agent_type") }?;
            // SAFETY: The caller promises it.
            let description = unsafe { options.description.read("the description") }?;
            described.agent_type = agent_type.unwrap_or_default().to_owned();
            described.description = description.unwrap_or_default().to_owned();
        }
        let registered = membership.domain.register_with(name, described).wait();
        let own = OwnAgent {
            agent: registered.or_fail()?,
            items: membership.items.clone(),
        };
        Ok(table::give(agent, own))
    })
}

/// Sends the message of the caller.
fn send(
    agent: &Agent,
    draft: &Draft<'_>,
    builder: MessageBuilder,
    within: Option<Duration>,
) -> Result<Sending, Failure> {
    let copy = |content: &[u8], to: &mut [u8]| {
        to.copy_from_slice(content);
        Ok(())
    };
    let content = draft.content();
    let content = content.map(|from| (from.len(), move |to: &mut [u8]| copy(from, to)));
    fipa_bindings::send(agent, draft.complete(builder)?, content, within)
}

/// Waits for the outcomes, and writes them for the caller.
fn settle(sending: Sending, outcomes: Option<Place<FipaHandle>>) -> Result<FipaResult, Failure> {
    let deliveries = sending.wait().or_fail()?;
    if let Some(outcomes) = outcomes {
        table::give(outcomes, Text::json(&deliveries)?);
    }
    all_delivered(&deliveries).map(|()| FipaResult::Ok)
}

/// An operation that ends with the outcomes.
async fn outcomes_of(sending: Sending) -> Event {
    match sending.await {
        Ok(outcomes) => match Text::json(&outcomes) {
            Ok(text) => Event::with(FipaEvent::Outcomes, text).result(all_delivered(&outcomes)),
            Err(failure) => Event::ended(Err(failure)),
        },
        Err(error) => Event::ended(Err(Failure::of(error))),
    }
}

/// Sends a message, and waits until each receiver has an outcome: at most `timeout_ms`, or the deadline of the
/// configuration (`mts.deadline`) if it is negative. Letters leave in the order of the calls.
///
/// The result is `FIPA_RESULT_NOT_DELIVERED` if a receiver has not got the letter; `fipa_error` lists the outcomes.
/// With `outcomes`, the caller gets them as JSON (`fipa_read_text`): an array with an object per receiver, with
/// `receiver`, `outcome` (`delivered`, `sent` or `failed`), `via` or `reason`, and the failed `attempts`.
///
/// # Safety
/// `message` is NULL or as its documentation says. `outcomes` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_send(
    agent: FipaHandle,
    message: *const FipaMessage,
    timeout_ms: i64,
    outcomes: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let outcomes = unsafe { Place::optional(outcomes, "the outcomes") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let draft = unsafe { Draft::read(message) }?;
        let builder = own.agent.message(draft.performative(None)?);
        let sending = send(&own.agent, &draft, builder, limit(timeout_ms))?;
        settle(sending, outcomes)
    })
}

/// Sends a message as `fipa_send`, without waiting. The outcomes are an item of the kind `FIPA_EVENT_OUTCOMES`.
///
/// # Safety
/// `message` is NULL or as its documentation says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_send(
    agent: FipaHandle,
    message: *const FipaMessage,
    timeout_ms: i64,
    tag: u64,
) -> FipaResult {
    call(|| {
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let draft = unsafe { Draft::read(message) }?;
        let builder = own.agent.message(draft.performative(None)?);
        let sending = send(&own.agent, &draft, builder, limit(timeout_ms))?;
        own.items.begin(tag, outcomes_of(sending));
        Ok(FipaResult::Ok)
    })
}

/// Sends an answer to a letter, as `fipa_send`: to its `reply_to` or its sender, in the same conversation and
/// protocol. What `message` sets takes precedence.
///
/// # Safety
/// As for `fipa_send`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_answer(
    agent: FipaHandle,
    letter: FipaHandle,
    message: *const FipaMessage,
    timeout_ms: i64,
    outcomes: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let outcomes = unsafe { Place::optional(outcomes, "the outcomes") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let draft = unsafe { Draft::read(message) }?;
        let act = draft.performative(None)?;
        let builder =
            table::with_letter(letter, |letter| Ok(own.agent.reply(letter.message(), act)))?;
        let sending = send(&own.agent, &draft, builder, limit(timeout_ms))?;
        settle(sending, outcomes)
    })
}

/// A loan that the caller writes and sends.
type OpenLoan = Loaned<OwnAgent, Loan>;

/// Loans memory of `len` bytes for the content of a message, in shared memory where possible: receivers on this host
/// read in place what the caller writes. The content of `message` is ignored. The memory is valid until the loan is
/// sent or closed.
///
/// # Safety
/// `message` is NULL or as its documentation says. `loan` and `content` are NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_loan(
    agent: FipaHandle,
    message: *const FipaMessage,
    len: usize,
    loan: *mut FipaHandle,
    content: *mut *mut u8,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let loan = unsafe { Place::of(loan, "the handle") }?;
        // SAFETY: The caller promises it.
        let content = unsafe { Place::of(content, "the content") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let draft = unsafe { Draft::read(message) }?;
        let builder = draft.complete(own.agent.message(draft.performative(None)?))?;
        let mut loaned = own.agent.loan(builder, len).or_fail()?;
        let memory = loaned.content_mut().as_mut_ptr();
        let open = OpenLoan::new(own, loaned);
        content.put(memory);
        Ok(table::give(loan, open))
    })
}

/// Sends a loan as `fipa_send`. Its handle is closed, and the caller no longer writes the memory.
///
/// # Safety
/// `outcomes` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_send_loan(
    loan: FipaHandle,
    timeout_ms: i64,
    outcomes: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let outcomes = unsafe { Place::optional(outcomes, "the outcomes") }?;
        let (own, taken) = OpenLoan::take(loan)?;
        let sending = send_loan(&own.agent, taken, limit(timeout_ms));
        settle(sending, outcomes)
    })
}

/// Sends a loan as `fipa_send_loan`, without waiting. The outcomes are an item of the kind `FIPA_EVENT_OUTCOMES`.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_begin_send_loan(loan: FipaHandle, timeout_ms: i64, tag: u64) -> FipaResult {
    call(|| {
        let (own, taken) = OpenLoan::take(loan)?;
        let sending = send_loan(&own.agent, taken, limit(timeout_ms));
        own.items.begin(tag, outcomes_of(sending));
        Ok(FipaResult::Ok)
    })
}

/// Waits for the next letter of an agent, up to `timeout_ms`, or without a limit if it is negative. Returns
/// `FIPA_RESULT_EMPTY` if none has arrived. The caller closes the letter.
///
/// # Safety
/// `letter` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_receive(
    agent: FipaHandle,
    timeout_ms: i64,
    letter: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let letter = unsafe { Place::of(letter, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        let received: Option<Incoming> = match limit(timeout_ms) {
            Some(Duration::ZERO) => own.agent.try_receive().or_fail()?,
            Some(limit) => own
                .agent
                .receive()
                .wait_within(limit)
                .transpose()
                .or_fail()?,
            None => Some(own.agent.receive().wait().or_fail()?),
        };
        let Some(received) = received else {
            return Ok(FipaResult::Empty);
        };
        Ok(table::give(letter, Letter::from(received)))
    })
}

/// Makes the letters of an agent items of the kind `FIPA_EVENT_LETTER`. They wait in the queue of the agent until
/// `fipa_next` takes them. Closing the operation ends it, and no letter is lost.
///
/// # Safety
/// `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_listen(
    agent: FipaHandle,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        let letters = unfold(Some(own.agent.clone()), |agent| async move {
            let agent = agent?;
            match agent.receive().await {
                Ok(letter) => {
                    let letter = Letter::from(letter);
                    Some((Event::with(FipaEvent::Letter, letter), Some(agent)))
                }
                Err(error) => Some((Event::ended(Err(Failure::of(error))), None)),
            }
        });
        let began = OperationHandle::of(own.items.follow(tag, letters));
        Ok(table::give(operation, began))
    })
}
