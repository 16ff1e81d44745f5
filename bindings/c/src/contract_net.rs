//! Calls for proposals (FIPA00029).

use std::sync::Arc;
use std::time::Duration;

use fipa::protocol::ContractNet;
use fipa::{Message, Performative};
use tokio::sync::Mutex;

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, Items, OperationHandle, Text, script};
use crate::letter::{FipaMessage, Letter};
use crate::message::Draft;
use crate::raw::{FipaBytes, LONG, Place, elements, limit};
use crate::table::{self, FipaHandle, Object};
use fipa_bindings::{Failure, FailureKind, OrFail};

/// Time for the proposals if the caller sets none.
const TIMEOUT: Duration = Duration::from_secs(10);

/// A call for proposals whose answers are there.
pub(crate) struct OpenCall {
    proposals: Vec<Message>,
    answers: Text,
    /// `None` after the award.
    net: Arc<Mutex<Option<ContractNet>>>,
    items: Items,
}

impl OpenCall {
    fn new(net: ContractNet, items: Items) -> Result<Self, Failure> {
        let bids = net.bids();
        let answers = fipa_bindings::bids(bids);
        Ok(Self {
            proposals: bids.proposals.clone(),
            answers: Text::json(&answers)?,
            net: Arc::new(Mutex::new(Some(net))),
            items,
        })
    }
}

impl Object for OpenCall {
    fn text(&self) -> Option<&str> {
        Some(self.answers.as_str())
    }
}

/// Calls the receivers of the message, names and patterns, for proposals. Waits for their answers up to `timeout_ms`
/// (10 s if it is negative). The item is of the kind `FIPA_EVENT_BIDS`, or `FIPA_EVENT_ENDED` with the failure.
///
/// # Safety
/// `message` is NULL or as its documentation says. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_call(
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
        let draft = unsafe { Draft::read(message) }?;
        let act = draft.performative(Some(Performative::Cfp))?;
        let receivers: Vec<String> = draft.receivers()?.into_iter().map(str::to_owned).collect();
        let builder = draft.with_content(own.agent.message(act))?;
        let none: [&str; 0] = [];
        let builder = builder.replace_receivers(none);
        let timeout = limit(timeout_ms).unwrap_or(TIMEOUT);
        let (agent, items) = (own.agent.clone(), own.items.clone());
        let events = script(async move |emitter| {
            let net = agent.contract_net(builder, &receivers, timeout).await;
            let open = OpenCall::new(net.or_fail()?, items)?;
            let number = open.proposals.len() as u64;
            let bids = Event::with(FipaEvent::Bids, open).number(number);
            emitter.emit(bids).await;
            Ok(())
        });
        let began = OperationHandle::of(own.items.follow(tag, events));
        Ok(table::give(operation, began))
    })
}

/// Returns a proposal, with an index from 0, as a letter that the caller closes. `fipa_read_text` of the call returns
/// the other answers in JSON: `refusals` (each with `agent` and `reason`), `silent`, `unreached`, `gone` and `violations`.
///
/// # Safety
/// `letter` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_bid(
    bids: FipaHandle,
    index: usize,
    letter: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let letter = unsafe { Place::of(letter, "the handle") }?;
        let open = table::get::<OpenCall>(bids)?;
        let proposal = open.proposals.get(index).cloned();
        let proposal = proposal.ok_or_else(|| {
            let number = open.proposals.len();
            Failure::invalid(format!(
                "there is no proposal {index}: the call has {number}"
            ))
        })?;
        Ok(table::give(letter, Letter::from(proposal)))
    })
}

/// Accepts the proposals of these indices, none or several, and rejects the others; each gets the content. Waits for
/// the results up to `timeout_ms`, or without a limit if it is negative. There is an item of the kind
/// `FIPA_EVENT_AWARDED` per accepted proposal, and then `FIPA_EVENT_ENDED`. A call is awarded once; one that is closed
/// without an award rejects all proposals.
///
/// # Safety
/// The indices and the content must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_award(
    bids: FipaHandle,
    accepted: *const usize,
    accepted_count: usize,
    content: FipaBytes,
    timeout_ms: i64,
    tag: u64,
) -> FipaResult {
    call(|| {
        let open = table::get::<OpenCall>(bids)?;
        // SAFETY: The caller promises it.
        let indices = unsafe { elements(accepted, accepted_count, "the accepted") }?.to_vec();
        // SAFETY: The caller promises it.
        let content = unsafe { content.read("the content") }?.unwrap_or_default();
        let content = str::from_utf8(content);
        let content = content.map_err(|_| Failure::invalid("the content is not UTF-8"))?;
        let content = content.to_owned();
        if let Some(wrong) = indices.iter().find(|index| **index >= open.proposals.len()) {
            return Err(Failure::invalid(format!("there is no proposal {wrong}")));
        }
        let taken = open.net.try_lock().ok().and_then(|mut net| net.take());
        let mut net =
            taken.ok_or_else(|| Failure::new(FailureKind::Closed, "the call was awarded"))?;
        let timeout = limit(timeout_ms).unwrap_or(LONG);
        let calls = Arc::clone(&open);
        open.items.follow(
            tag,
            script(async move |emitter| {
                let chosen = indices
                    .iter()
                    .filter_map(|index| calls.proposals.get(*index));
                let chosen: Vec<Message> = chosen.cloned().collect();
                let awarded = net.award(&chosen, &content, timeout).await.or_fail()?;
                for one in awarded {
                    let from = |proposal: &Message| {
                        proposal
                            .sender()
                            .is_some_and(|sender| sender.name() == one.agent)
                    };
                    let index = calls.proposals.iter().position(from).unwrap_or_default();
                    let event = match one.result {
                        Ok(message) => Event::with(FipaEvent::Awarded, Letter::from(message)),
                        Err(error) => Event::of(FipaEvent::Awarded).result(Err(Failure::of(error))),
                    };
                    emitter.emit(event.number(index as u64)).await;
                }
                emitter.emit(Event::ended(Ok(()))).await;
                Ok(())
            }),
        );
        Ok(FipaResult::Ok)
    })
}
