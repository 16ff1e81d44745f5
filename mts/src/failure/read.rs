//! Reads failure messages: those of this project, of fipa_services and of JADE.

use fipa_acl::{Message, Payload, Performative};

use super::one_line;

/// A failure message of the message transport service or agent management system of either host: a
/// letter was not delivered to one receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryFailure {
    /// Name of the receiver, if the message has it.
    pub receiver: Option<String>,
    /// The reason in the words of the service: one line of at most 400 bytes,
    /// [escaped](fipa_acl::escape).
    pub reason: String,
}

impl DeliveryFailure {
    /// Reads a failure message. `None` if the message is not a failure, or reports another failure
    /// than a delivery, such as that of an action that the receiver agreed to.
    #[must_use]
    pub fn read(message: &Message) -> Option<Self> {
        if *message.performative() != Performative::Failure {
            return None;
        }
        let content = message.content()?;
        let text = std::str::from_utf8(content).ok()?;
        of_sl(text).or_else(|| of_fipa_services(content.clone().into()))
    }
}

/// `((action AGENT (ACLMessage)) (MTS-error AGENT (internal-error "REASON")))`
fn of_sl(text: &str) -> Option<DeliveryFailure> {
    let mut tokens = Tokens(text).skip_while(|token| !token.is_word("mts-error"));
    tokens.next()?;
    let mut receiver = None;
    let mut reason = "";
    let mut before = Token::Open;
    for token in tokens {
        match (before, token) {
            (Token::Word(":name"), Token::Word(name) | Token::Text(name)) if receiver.is_none() => {
                receiver = Some(one_line(name));
            }
            (Token::Word(word), Token::Text(text)) if !word.starts_with(':') => reason = text,
            _ => {}
        }
        before = token;
    }
    Some(DeliveryFailure {
        receiver,
        reason: one_line(&reason.replace("\\\"", "\"")),
    })
}

/// A nested `inform` to the receiver in the language `internal-error`.
fn of_fipa_services(content: Payload) -> Option<DeliveryFailure> {
    let report = Message::decode(&content).ok()?;
    if *report.performative() != Performative::Inform || report.language() != Some("internal-error")
    {
        return None;
    }
    let text = String::from_utf8_lossy(report.content()?).into_owned();
    let first = text.lines().next().unwrap_or_default();
    Some(DeliveryFailure {
        receiver: report.receivers().first().map(|to| to.name().to_owned()),
        reason: one_line(first.strip_prefix("description: ").unwrap_or(first)),
    })
}

/// A token of FIPA SL (FIPA00008), as far as failure messages use it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Token<'a> {
    Open,
    Close,
    /// A string literal, between its quotation marks.
    Text(&'a str),
    Word(&'a str),
}

impl Token<'_> {
    fn is_word(&self, name: &str) -> bool {
        matches!(self, Token::Word(word) if word.eq_ignore_ascii_case(name))
    }
}

/// The tokens of a text. Each takes at least one byte of it.
struct Tokens<'a>(&'a str);

impl<'a> Iterator for Tokens<'a> {
    type Item = Token<'a>;

    fn next(&mut self) -> Option<Token<'a>> {
        let text = self.0.trim_ascii_start();
        let (token, len) = match text.bytes().next()? {
            b'(' => (Token::Open, 1),
            b')' => (Token::Close, 1),
            b'"' => {
                let inside = text.get(1..)?;
                let end = end_of_text(inside);
                (Token::Text(inside.get(..end)?), end + 2)
            }
            _ => {
                let ends = |c: char| c.is_ascii_whitespace() || matches!(c, '(' | ')' | '"');
                let end = text.find(ends).unwrap_or(text.len());
                (Token::Word(text.get(..end)?), end)
            }
        };
        // The closing mark of the last literal may be missing.
        self.0 = text.get(len..).unwrap_or_default();
        Some(token)
    }
}

/// Offset of the literal's end: of the first quotation mark without `\` before it.
fn end_of_text(inside: &str) -> usize {
    let mut escaped = false;
    let end = inside.bytes().position(|byte| {
        let ends = byte == b'"' && !escaped;
        escaped = byte == b'\\' && !escaped;
        ends
    });
    end.unwrap_or(inside.len())
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use bytes::Bytes;
    use fipa_acl::{AgentId, Dialect, Letter};
    use fipa_transport::FailureReason;

    use super::*;
    use crate::failure::{Failed, Failure};
    use crate::letter_for;

    const FIPA_SERVICES: &[u8] = include_bytes!("../../../acl/tests/vectors/failure_letter.bin");
    const JADE: &[u8] = include_bytes!("../../../acl/tests/vectors/jade_failure.str");

    fn report(receiver: &str, reason: &str) -> DeliveryFailure {
        DeliveryFailure {
            receiver: Some(receiver.to_owned()),
            reason: reason.to_owned(),
        }
    }

    #[test]
    fn the_recorded_failure_message_of_fipa_services_is_read() {
        let letter = Letter::split(Bytes::from_static(FIPA_SERVICES)).unwrap();
        let message = Message::decode(letter.payload()).unwrap();
        assert_eq!(
            DeliveryFailure::read(&message),
            Some(report("nobo", "message delivery failed"))
        );
    }

    #[test]
    fn the_recorded_failure_message_of_jade_is_read() {
        let message = Message::decode(&Bytes::from_static(JADE).into()).unwrap();
        let reason = "Agent not found: getContainerID() failed to find agent nobody@jadetest";
        assert_eq!(
            DeliveryFailure::read(&message),
            Some(report("nobody@jadetest", reason))
        );
    }

    #[test]
    fn failure_messages_of_this_project_are_read_in_either_form() {
        let request = Message::builder(Performative::Request)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .build()
            .unwrap();
        let letter = letter_for(&request, SystemTime::UNIX_EPOCH).unwrap();
        let detail = "said \"no\"";
        let failure = Failure {
            count: 1,
            letter: &Failed::of(&letter).unwrap(),
            receiver: "arm",
            reason: FailureReason::Refused,
            detail,
        };
        for (dialect, reason) in [
            (Dialect::Standard, "refused: said \"no\""),
            (
                Dialect::FipaServices,
                "message delivery failed: refused: said \"no\"",
            ),
        ] {
            let letter = failure.written_for("mts", dialect, SystemTime::UNIX_EPOCH);
            let message = Message::decode(letter.unwrap().payload()).unwrap();
            assert_eq!(DeliveryFailure::read(&message), Some(report("arm", reason)));
        }
    }

    #[test]
    fn failures_of_other_actions_are_not_delivery_failures() {
        let message = |performative, content: &str| {
            Message::builder(performative)
                .content(content.to_owned())
                .build()
                .unwrap()
        };
        for content in [
            "",
            "(lift sample-3) (too-heavy \"MTS-error\")",
            "no MTS today",
            "\"",
            "(inform :language fipa-sl :content \"x\")",
        ] {
            let failure = message(Performative::Failure, content);
            assert_eq!(DeliveryFailure::read(&failure), None, "{content}");
        }
        let quoted = "(MTS-error (agent-identifier :name arm) (internal-error \"x\"))";
        assert_eq!(
            DeliveryFailure::read(&message(Performative::Inform, quoted)),
            None
        );
        let open = "(MTS-error (agent-identifier :name arm) (internal-error \"a\u{1b}b";
        let failure = message(Performative::Failure, open);
        assert_eq!(
            DeliveryFailure::read(&failure),
            Some(report("arm", r"a\u{1b}b"))
        );
    }
}
