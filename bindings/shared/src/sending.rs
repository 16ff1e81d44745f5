//! Sending contents of the program.

use std::pin::Pin;
use std::time::Duration;

use fipa::error::SendError;
use fipa::{Agent, Deliveries, FailureReason, Loan, MessageBuilder, Outcome};

use crate::failure::{Failure, FailureKind, OrFail as _};

/// Length of a content in bytes from which it is copied into memory that the receivers read in place.
const IN_PLACE: usize = 4_096;

/// The outcomes of a message that was sent.
pub type Sending = Pin<Box<dyn Future<Output = Result<Deliveries, SendError>> + Send>>;

/// Sends a message; the letters leave in the order of the calls. The deadline of the configuration applies if
/// `within` is `None`. `content` is the length of the content, and a function that writes it.
///
/// # Errors
/// If the message cannot be sent at all, or the content cannot be written.
pub fn send<E: From<Failure>>(
    agent: &Agent,
    message: MessageBuilder,
    content: Option<(usize, impl FnOnce(&mut [u8]) -> Result<(), E>)>,
    within: Option<Duration>,
) -> Result<Sending, E> {
    let message = match content {
        None => message,
        Some((len, write)) if len < IN_PLACE => {
            let mut bytes = vec![0; len];
            write(&mut bytes)?;
            message.content(bytes)
        }
        Some((len, write)) => {
            let mut loan = agent.loan(message, len).or_fail()?;
            write(loan.content_mut())?;
            return Ok(send_loan(agent, loan, within));
        }
    };
    Ok(match within {
        Some(within) => Box::pin(agent.send_within(message, within)),
        None => Box::pin(agent.send(message)),
    })
}

/// Sends a loan, as [`send`].
#[must_use]
pub fn send_loan(agent: &Agent, loan: Loan, within: Option<Duration>) -> Sending {
    match within {
        Some(within) => Box::pin(agent.send_loan_within(loan, within)),
        None => Box::pin(agent.send_loan(loan)),
    }
}

/// Checks that each receiver has got the letter.
///
/// # Errors
/// Lists the outcomes if one has not.
pub fn all_delivered(outcomes: &Deliveries) -> Result<(), Failure> {
    if outcomes.all_succeeded() {
        return Ok(());
    }
    let closed = |outcome: &Outcome| matches!(outcome, Outcome::Failed { reason, .. } if *reason == FailureReason::Closed);
    let kind = match outcomes.0.iter().any(|it| closed(&it.outcome)) {
        true => FailureKind::Closed,
        false => FailureKind::NotDelivered,
    };
    Err(Failure::new(kind, outcomes.to_string()))
}
