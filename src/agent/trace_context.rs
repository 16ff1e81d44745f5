//! The W3C trace context in envelopes: the span in which an agent sends a letter.
//!
//! The current OpenTelemetry context of the sending thread becomes the user-defined parameters `traceparent` and
//! `tracestate` of the base envelope. Gateways pass on the base envelope as it is. JADE gets the parameters, too, and
//! fipa_services has no place for them. Without a span, the letter is not touched.
//!
//! The parameters that a letter arrives with are text from outside. They are read when the application asks for them.

use fipa_acl::{DecodeError, EncodeError, EnvelopeParams, ErrorChain, Letter};
use fipa_transport::log_limit;
use opentelemetry::Context;
use opentelemetry::trace::{
    SpanContext, SpanId, TraceContextExt as _, TraceFlags, TraceId, TraceState,
};

/// Length of a `traceparent` of version 00.
const TRACEPARENT_LEN: usize = 55;

/// Maximum length of a `tracestate`, in bytes.
///
/// W3C Trace Context 3.3.1.5: "Vendors SHOULD propagate at least 512 characters of a combined header."
const MAX_TRACESTATE: usize = 512;

/// Upper bound of the number of bytes by which the parameters lengthen an envelope.
pub(crate) const ROOM: usize = TRACEPARENT_LEN + MAX_TRACESTATE + 64;

#[derive(Debug, thiserror::Error)]
enum AddError {
    #[error("cannot read the envelope")]
    Read(#[from] DecodeError),
    #[error("cannot write the envelope")]
    Write(#[from] EncodeError),
}

/// Adds the span of the current context to a letter of this process. A letter that would be longer than `limit` or
/// [`Letter::MAX_AROUND`] remains as it is.
pub(crate) fn added_to(letter: Letter, limit: u64) -> Letter {
    let parameters = Context::map_current(|current| parameters(current.span().span_context()));
    if parameters.is_empty() {
        return letter;
    }
    match with_parameters(&letter, parameters) {
        Ok(traced) if traced.around_len() <= Letter::MAX_AROUND && traced.len() as u64 <= limit => {
            traced
        }
        Ok(_) => letter,
        Err(error) => {
            log_limit::warn!(error = %ErrorChain(&error), "a letter is sent without its trace context");
            letter
        }
    }
}

/// Returns the parameters of an envelope for a span: none if the span is not valid.
fn parameters(span: &SpanContext) -> Vec<(String, String)> {
    if !span.is_valid() {
        return Vec::new();
    }
    let (trace, id) = (span.trace_id(), span.span_id());
    let flags = span.trace_flags() & TraceFlags::SAMPLED;
    let parent = format!("00-{trace}-{id}-{flags:02x}");
    let mut parameters = vec![(EnvelopeParams::TRACEPARENT.to_owned(), parent)];
    let state = span.trace_state().header();
    if is_tracestate(&state) {
        parameters.push((EnvelopeParams::TRACESTATE.to_owned(), state));
    }
    parameters
}

fn with_parameters(letter: &Letter, parameters: Vec<(String, String)>) -> Result<Letter, AddError> {
    let mut envelope = letter.parse_envelope()?;
    envelope.base.user_defined.extend(parameters);
    let encoded = envelope.encode_standard()?;
    Ok(Letter::new(encoded, letter.payload().clone()))
}

/// Returns a context whose span is the remote one in which the letter was sent. Without valid parameters, the context
/// has no span.
pub(crate) fn of(letter: &Letter) -> Context {
    match span_of(letter) {
        Some(span) => Context::new().with_remote_span_context(span),
        None => Context::new(),
    }
}

fn span_of(letter: &Letter) -> Option<SpanContext> {
    let envelope = letter.parse_envelope().ok()?;
    let newest_first = envelope.extensions.iter().rev().chain([&envelope.base]);
    let parameters = newest_first.flat_map(|part| part.user_defined.iter().rev());
    let newest = |name| {
        let mut all = parameters.clone();
        all.find_map(|(key, value)| (key == name).then_some(&**value))
    };
    let (trace, id, flags) = parse_traceparent(newest(EnvelopeParams::TRACEPARENT)?)?;
    let state = newest(EnvelopeParams::TRACESTATE).and_then(parse_tracestate);
    let state = state.unwrap_or_default();
    Some(SpanContext::new(trace, id, flags, true, state))
}

/// Reads a `traceparent` of version 00 (W3C Trace Context 3.2.2): four fields of fixed lengths, lower-case hexadecimal.
fn parse_traceparent(text: &str) -> Option<(TraceId, SpanId, TraceFlags)> {
    if text.len() != TRACEPARENT_LEN {
        return None;
    }
    let mut fields = text.split('-');
    let mut field = |len| {
        let is_hex = |text: &&str| {
            text.bytes()
                .all(|it| matches!(it, b'0'..=b'9' | b'a'..=b'f'))
        };
        fields.next().filter(|it| it.len() == len).filter(is_hex)
    };
    let (version, trace, id, flags) = (field(2)?, field(32)?, field(16)?, field(2)?);
    let trace = TraceId::from_hex(trace).ok()?;
    let id = SpanId::from_hex(id).ok()?;
    // W3C Trace Context 3.2.2.5.2: flags other than `sampled` have no meaning in version 00.
    let flags = TraceFlags::new(u8::from_str_radix(flags, 16).ok()?) & TraceFlags::SAMPLED;
    let is_valid = version == "00" && trace != TraceId::INVALID && id != SpanId::INVALID;
    is_valid.then_some((trace, id, flags))
}

/// Reads a `tracestate` (W3C Trace Context 3.3.1) without optional white space and empty members.
fn parse_tracestate(text: &str) -> Option<TraceState> {
    let state: TraceState = is_tracestate(text).then(|| text.parse().ok())??;
    // The parser of the crate repairs and drops members.
    let is_whole = state.header() == text;
    let has_keys = (&state).into_iter().all(|(key, _)| !key.is_empty());
    (is_whole && has_keys).then_some(state)
}

/// Whether a text has the length and the characters of a `tracestate`.
fn is_tracestate(text: &str) -> bool {
    (1..=MAX_TRACESTATE).contains(&text.len()) && text.bytes().all(|it| matches!(it, b' '..=b'~'))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::time::SystemTime;

    use allocation_counter::measure;
    use fipa_acl::{
        AgentId, Dialect, Envelope, Message, Performative, Received, Representation, Time,
    };
    use fipa_mts::letter_for;
    use proptest::prelude::*;

    use super::*;
    #[cfg(feature = "shm")]
    use crate::{Config, Domain, Kind};

    const PARENT: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";

    fn letter() -> Letter {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .content("text")
            .build()
            .unwrap();
        letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()
    }

    fn span(state: &str) -> SpanContext {
        let (trace, id, flags) = parse_traceparent(PARENT).unwrap();
        SpanContext::new(trace, id, flags, true, state.parse().unwrap())
    }

    /// A `tracestate` of this length.
    fn state_of(len: usize) -> String {
        let first = "a=".to_owned() + &"x".repeat(200);
        let second = "b=".to_owned() + &"y".repeat(200);
        let rest = len - first.len() - second.len() - 2;
        format!("{first},{second},c={}", "z".repeat(rest - 2))
    }

    fn sent_in(span: SpanContext, limit: u64) -> Letter {
        let _current = Context::new().with_remote_span_context(span).attach();
        added_to(letter(), limit)
    }

    fn received_with(parameters: &[(&str, &str)]) -> SpanContext {
        let own = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        let parameters = parameters.iter().map(own).collect();
        let letter = with_parameters(&letter(), parameters).unwrap();
        of(&letter).span().span_context().clone()
    }

    #[test]
    fn the_span_of_the_sender_arrives_as_a_remote_one() {
        let longest = state_of(MAX_TRACESTATE);
        for state in ["", "vendor=value", &longest] {
            let sent = sent_in(span(state), u64::MAX);
            assert_eq!(*of(&sent).span().span_context(), span(state));
            assert_eq!(sent.payload(), letter().payload());
            assert!(sent.envelope_len() <= letter().envelope_len() + ROOM);
        }
    }

    #[test]
    fn a_letter_without_a_span_is_not_touched() {
        let unsent = added_to(letter(), u64::MAX);
        let at = unsent.envelope().as_ptr();
        let mut sent = None;
        let taken = measure(|| sent = Some(added_to(unsent, u64::MAX)));
        assert_eq!(taken.count_total, 0);
        assert_eq!(sent.unwrap().envelope().as_ptr(), at);
        assert!(!of(&letter()).span().span_context().is_valid());
    }

    #[test]
    fn a_letter_that_would_be_too_long_is_sent_without_its_span() {
        let longer = sent_in(span(""), u64::MAX).len() as u64;
        assert!(of(&sent_in(span(""), longer)).has_active_span());
        assert_eq!(sent_in(span(""), longer - 1), letter());
    }

    #[test]
    fn a_trace_state_that_no_header_can_have_is_left_out() {
        let states = [state_of(MAX_TRACESTATE + 1), "a=\0".into(), "a=é".into()];
        for state in states {
            let sent = sent_in(span(&state), u64::MAX);
            assert_eq!(*of(&sent).span().span_context(), span(""));
        }
    }

    #[test]
    fn the_span_survives_xml_and_the_stamps_of_gateways() {
        let envelope = sent_in(span("vendor=a b\"c"), u64::MAX);
        let envelope = envelope.parse_envelope().unwrap();
        let stamp = EnvelopeParams {
            received: Some(Received::new(
                "gateway",
                Time::from_system_time(SystemTime::UNIX_EPOCH).unwrap(),
            )),
            ..EnvelopeParams::default()
        };
        let stamped = Letter::new(
            envelope.encode_standard().unwrap(),
            letter().payload().clone(),
        )
        .stamped(Envelope::encode_extension(&stamp).unwrap());
        assert_eq!(*of(&stamped).span().span_context(), span("vendor=a b\"c"));
        for (representation, dialect) in [
            (Representation::Xml, Dialect::FipaServices),
            (Representation::Xml, Dialect::Jade),
            (Representation::Xml, Dialect::Standard),
        ] {
            let translated = envelope.encode(representation, dialect).unwrap();
            let translated = Letter::new(translated, letter().payload().clone());
            let found = of(&translated).span().span_context().clone();
            assert_eq!(found, span("vendor=a b\"c"), "{dialect:?}");
        }
    }

    #[test]
    fn invalid_parameters_are_ignored() {
        let zeros = |range: std::ops::Range<usize>| {
            let mut text = PARENT.to_owned();
            let zeros = "0".repeat(range.len());
            text.replace_range(range, &zeros);
            text
        };
        for parent in [
            "",
            "00",
            &PARENT.to_uppercase(),
            &PARENT.replacen("00-", "01-", 1),
            &PARENT.replacen("00-", "ff-", 1),
            &PARENT.replace('-', "_"),
            &format!("{PARENT}-"),
            &format!("{PARENT} "),
            &format!("{PARENT}-00"),
            &PARENT[..54],
            &PARENT.replace("0af7", "+af7"),
            &PARENT.replace("-01", "-0g"),
            &PARENT.replace("-01", "-+1"),
            // A dash at another place.
            "00-0af7651916cd43dd8448eb211c80319-cb7ad6b7169203331-01",
            // As many bytes, not as many characters.
            &PARENT.replace("0af7", "0aé"),
            &zeros(3..35),
            &zeros(36..52),
        ] {
            assert_eq!(
                received_with(&[(EnvelopeParams::TRACEPARENT, parent)]),
                SpanContext::NONE,
                "{parent}"
            );
        }
        assert_eq!(
            received_with(&[(EnvelopeParams::TRACESTATE, "a=b")]),
            SpanContext::NONE
        );
        for state in [
            "=b",
            "a",
            "a=b=c",
            "a==b",
            "a=b,",
            ",a=b",
            " a=b",
            "a=b, c=d",
            "A=b",
            "a=\t",
            "a=é",
            &state_of(MAX_TRACESTATE + 1),
            &["a=b"; 33].join(","),
        ] {
            let found = received_with(&[
                (EnvelopeParams::TRACEPARENT, PARENT),
                (EnvelopeParams::TRACESTATE, state),
            ]);
            assert_eq!(found, span(""), "{state}");
        }
        // Flags without a meaning.
        let parent = PARENT.replace("-01", "-ff");
        assert_eq!(
            received_with(&[(EnvelopeParams::TRACEPARENT, &parent)]),
            span("")
        );
    }

    #[cfg(feature = "shm")]
    #[tokio::test]
    async fn a_loan_has_room_for_the_longest_trace_context() {
        let directory = tempfile::tempdir().unwrap();
        let mut config = Config::for_host("loans");
        config.domain = format!("loans-in-spans-{}", std::process::id());
        config.runtime_dir = directory.path().join("run").to_string_lossy().into_owned();
        config.mts.transports = vec![Kind::Shm];
        let here = Domain::open(&config).await.unwrap();
        let there = Domain::open(&config).await.unwrap();
        let rover = here.register("rover").await.unwrap();
        let arm = there.register("arm").await.unwrap();
        let message = rover.message(Performative::Inform).receiver("arm");
        let loan = rover.loan(message, 1 << 20).unwrap();
        let sent = {
            let span = span(&state_of(MAX_TRACESTATE));
            let _current = Context::new().with_remote_span_context(span).attach();
            rover.send_loan(loan)
        };
        assert!(sent.await.unwrap().all_succeeded());
        let counters = here.inner.service.shm_counters();
        assert_eq!((counters.loans_sent, counters.loans_copied), (1, 0));
        drop((rover, arm));
        here.close().await;
        there.close().await;
    }

    proptest! {
        #[test]
        fn any_text_is_a_span_of_this_form_or_ignored(
            parent in prop_oneof![
                any::<String>(),
                "[0-9a-f]{2}-[0-9a-f]{30,34}-[0-9a-f]{15,17}-[0-9a-f]{2}",
                "00-[0-9a-f]{32}-[0-9a-f]{16}-[0-9a-g]{2}",
                "00-[0-9a-f-]{49}-01",
                "00-(0{32}|[0-9a-f]{32})-(0{16}|[0-9a-f]{16})-0[01]",
            ],
            state in prop_oneof![
                any::<String>(),
                "([a-z0-9@*/_-]{0,20}=[ -~]{0,20},?){0,40}",
                "([a-z][a-z0-9]{0,9}=[a-z0-9 ]{1,9}[a-z],){0,34}a=b",
            ],
        ) {
            let found = parse_traceparent(&parent);
            let state = parse_tracestate(&state);
            if let Some(state) = &state {
                let header = state.header();
                prop_assert!(header.len() <= MAX_TRACESTATE);
                prop_assert_eq!(parse_tracestate(&header), Some(state.clone()));
            }
            if let Some((trace, id, flags)) = found {
                let span = SpanContext::new(trace, id, flags, true, state.unwrap_or_default());
                prop_assert!(span.is_valid());
                let written = parameters(&span);
                // The same, apart from flags without a meaning.
                prop_assert_eq!(&written[0].1[..53], &parent[..53]);
                let sent = sent_in(span.clone(), u64::MAX);
                prop_assert_eq!(span_of(&sent), Some(span));
            }
        }
    }
}
