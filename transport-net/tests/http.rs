//! Letters over HTTP, with a platform that reads and writes the recorded bytes of JADE.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use common::{Party, Recorder, config, letter_parcel, message_parcel};
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Performative,
};
use fipa_testbed::{hostile_requests, until_some};
use fipa_transport::{
    Answer, Conclusion, FailureReason, Kind, Location, Parcel, Transport as _, TransportErrorKind,
};
use fipa_transport_net::{HttpConfig, HttpTransport, NetLimits};

const STRING: &[u8] = include_bytes!("data/jade_http/string.3-echo-reply-from-jade.bin");
const XML: &[u8] = include_bytes!("data/jade_http/xml.3-echo-reply-from-jade.bin");
const BIT_EFFICIENT: &[u8] =
    include_bytes!("data/jade_http/bitefficient.3-echo-reply-from-jade.bin");
const ONCE: &[u8] = include_bytes!("data/jade_http/string.1-request-to-jade.bin");
const KEPT_ANSWER: &[u8] = include_bytes!("data/jade_http/keepalive-http-response-from-jade.bin");
const LAST_ANSWER: &[u8] = include_bytes!("data/jade_http/string.4-http-response-to-jade.bin");
const OK: &str = "HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: Keep-Alive\r\n\r\n";

/// A watchdog for what never comes.
const TIMEOUT: Duration = Duration::from_secs(60);

type Platform = Party<HttpTransport>;

fn with(limits: NetLimits) -> Platform {
    let tcp = config(&["127.0.0.1:0"]);
    let config = HttpConfig {
        listen: tcp.listen,
        identity: tcp.identity,
        limits,
        #[cfg(feature = "secure")]
        security: None,
    };
    Party::over(Recorder::default(), |runtime| {
        HttpTransport::new(config, runtime)
    })
}

fn party() -> Platform {
    with(config(&[]).limits)
}

fn connect(to: &Platform) -> TcpStream {
    let stream = TcpStream::connect(to.location().authority()).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    stream
}

/// Reads an answer, which has no body.
fn answer(stream: &mut impl Read) -> String {
    let mut text = Vec::new();
    while !text.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        text.extend(byte);
    }
    String::from_utf8(text).unwrap()
}

/// Returns the messages that have arrived, once there are so many.
fn messages(at: &Platform, count: usize) -> Vec<Message> {
    until_some("the letters", || {
        (at.sink.record.lock().unframed.len() >= count).then_some(())
    });
    let record = at.sink.record.lock();
    assert_eq!(record.unframed.len(), count);
    let messages = record.unframed.iter().map(|(letter, via)| {
        assert_eq!(*via, Kind::Http);
        let (envelope, _) = Envelope::decode(&letter.envelope()).unwrap();
        let message = Message::decode(letter.payload()).unwrap();
        let intended = envelope.effective().intended_receivers;
        assert_eq!(intended, message.receivers());
        message
    });
    messages.collect()
}

#[test]
fn letters_of_jade_arrive_over_one_connection_in_all_encodings() {
    let party = party();
    let location = party.location().to_string();
    assert!(location.ends_with("/acc"), "{location}");
    let mut jade = connect(&party);
    for bytes in [STRING, XML, BIT_EFFICIENT, XML] {
        jade.write_all(bytes).unwrap();
        assert_eq!(answer(&mut jade), OK);
    }
    for message in messages(&party, 4) {
        assert_eq!(*message.performative(), Performative::Inform);
        assert_eq!(message.content().unwrap(), "hello jade");
        assert_eq!(message.sender().unwrap().name(), "echo@jadetest");
        assert_eq!(message.in_reply_to(), Some("rw-1"));
    }
    assert_eq!(party.transport.counters().unframed_in, 4);
}

#[test]
fn a_client_that_closes_gets_the_recorded_answer() {
    let party = party();
    let mut jade = connect(&party);
    jade.write_all(ONCE).unwrap();
    let mut all = Vec::new();
    jade.read_to_end(&mut all).unwrap();
    assert_eq!(all, LAST_ANSWER);
    assert_eq!(messages(&party, 1)[0].content().unwrap(), "hello jade");
}

#[test]
fn requests_that_arrive_together_or_byte_by_byte_are_answered_in_order() {
    let party = party();
    let mut jade = connect(&party);
    let named = |number: usize| {
        let text = String::from_utf8(STRING.to_vec()).unwrap();
        // The length stays the same.
        text.replace("hello jade", &format!("hello {number:04}"))
    };
    let together: String = (0..50).map(named).collect();
    jade.write_all(together.as_bytes()).unwrap();
    for _ in 0..50 {
        assert_eq!(answer(&mut jade), OK);
    }
    for byte in named(50).as_bytes() {
        jade.write_all(&[*byte]).unwrap();
    }
    assert_eq!(answer(&mut jade), OK);
    for (number, message) in messages(&party, 51).iter().enumerate() {
        let expected = format!("hello {number:04}");
        assert_eq!(message.content().unwrap(), &expected);
    }
}

#[test]
fn a_letter_that_is_repeated_on_a_new_connection_arrives_once() {
    let party = party();
    let mut used = connect(&party);
    for bytes in [XML, STRING] {
        used.write_all(bytes).unwrap();
        assert_eq!(answer(&mut used), OK);
    }
    // The client has not seen the answer to the second request, and repeats it.
    let mut fresh = connect(&party);
    fresh.write_all(STRING).unwrap();
    assert_eq!(answer(&mut fresh), OK);
    assert_eq!(messages(&party, 2).len(), 2);
    // The next one is another letter, whatever its bytes.
    fresh.write_all(STRING).unwrap();
    assert_eq!(answer(&mut fresh), OK);
    assert_eq!(messages(&party, 3).len(), 3);
}

#[test]
fn equal_letters_on_connections_of_their_own_all_arrive() {
    let party = party();
    for _ in 0..3 {
        let mut jade = connect(&party);
        jade.write_all(ONCE).unwrap();
        jade.read_to_end(&mut Vec::new()).unwrap();
    }
    assert_eq!(messages(&party, 3).len(), 3);
}

#[test]
fn other_requests_are_answered_with_their_status_and_end_the_connection() {
    let party = with(NetLimits {
        max_letter: 100_000,
        handshake_timeout: Duration::from_millis(500),
        ..config(&[]).limits
    });
    let post = |fields: &str| format!("POST /acc HTTP/1.1\r\n{fields}\r\n");
    let mixed = "Content-Type: multipart/mixed; boundary=\"b\"\r\n";
    let many_parts = "--b\r\n\r\n<envelope/>\r\n".repeat(5000);
    let cases = [
        ("GET /acc HTTP/1.1\r\n\r\n".to_owned(), "405"),
        ("POST /x HTTP/1.1\r\n\r\n".to_owned(), "404"),
        (post("Content-Type: application/json\r\n"), "415"),
        (
            post(&format!("{mixed}Transfer-Encoding: chunked\r\n")),
            "411",
        ),
        (post(&format!("{mixed}Origin: http://x\r\n")), "403"),
        (post(&format!("{mixed}Content-Length: 99999999\r\n")), "413"),
        (
            post(&format!("{mixed}{}", "a: b\r\n".repeat(20_000))),
            "431",
        ),
        (
            format!(
                "{}{many_parts}",
                post(&format!("{mixed}Content-Length: {}\r\n", many_parts.len()))
            ),
            "400",
        ),
        (
            format!("{}12345", post(&format!("{mixed}Content-Length: 5\r\n"))),
            "400",
        ),
        // The rest of the head does not come.
        ("POST /acc HT".to_owned(), "408"),
    ];
    for (request, status) in cases {
        let mut client = connect(&party);
        client.write_all(request.as_bytes()).unwrap();
        let mut all = String::new();
        client.read_to_string(&mut all).unwrap();
        let expected = format!("HTTP/1.1 {status} ");
        assert!(all.starts_with(&expected), "{:.80}: {all}", request);
        assert!(all.contains("Connection: close"), "{all}");
    }
    assert_eq!(party.transport.counters().refused_nonsense, 10);
    // A connection without a request is closed without an answer.
    let mut silent = connect(&party);
    assert_eq!(silent.read_to_end(&mut Vec::new()).unwrap(), 0);
    let mut jade = connect(&party);
    jade.write_all(STRING).unwrap();
    assert_eq!(answer(&mut jade), OK);
    assert_eq!(messages(&party, 1).len(), 1);
}

#[test]
fn malformed_and_ambiguous_requests_carry_no_letter() {
    let party = party();
    let text = String::from_utf8(STRING.to_vec()).unwrap();
    let (head, _) = text.split_once("\r\n\r\n").unwrap();
    let fields = head.lines().skip(1);
    let fields = fields.filter(|field| !field.to_ascii_lowercase().starts_with("content-length"));
    let fields: String = fields.map(|field| format!("{field}\r\n")).collect();
    for (name, request) in hostile_requests("POST", "/acc", &fields, &text) {
        let mut client = connect(&party);
        // The endpoint closes the connection before it has read all.
        let _ = client.write_all(&request);
        let _ = client.shutdown(Shutdown::Write);
        let mut all = Vec::new();
        let _ = client.read_to_end(&mut all);
        let all = String::from_utf8_lossy(&all);
        let answers = ["HTTP/1.1 4", "HTTP/1.1 505 "];
        let is_refused = all.is_empty() || answers.iter().any(|it| all.starts_with(it));
        assert!(is_refused, "{name}: {all}");
        assert!(all.matches("HTTP/").count() <= 1, "{name}: {all}");
    }
    assert!(party.sink.record.lock().unframed.is_empty());
    let mut jade = connect(&party);
    jade.write_all(STRING).unwrap();
    assert_eq!(answer(&mut jade), OK);
}

#[test]
fn a_body_that_stops_is_given_up() {
    let party = with(NetLimits {
        stall_timeout: Duration::from_millis(300),
        ..config(&[]).limits
    });
    let mut slow = connect(&party);
    slow.write_all(&STRING[..STRING.len() - 100]).unwrap();
    let mut all = String::new();
    slow.read_to_string(&mut all).unwrap();
    assert!(all.starts_with("HTTP/1.1 408 "), "{all}");
}

#[test]
fn idle_connections_give_way_and_busy_ones_do_not() {
    let party = with(NetLimits {
        max_connections: 4,
        ..config(&[]).limits
    });
    // All loopback addresses together have half of the connections.
    let mut first = connect(&party);
    first.write_all(STRING).unwrap();
    assert_eq!(answer(&mut first), OK);
    let mut busy = connect(&party);
    busy.write_all(&STRING[..50]).unwrap();
    until_some("the busy connection", || {
        let mut third = connect(&party);
        third.write_all(STRING).unwrap();
        let mut all = Vec::new();
        // While the task of the busy connection has not read its bytes, it is idle, too.
        let _ = third.shutdown(Shutdown::Write);
        (third.read_to_end(&mut all).is_ok() && !all.is_empty()).then_some(())
    });
    // The first one was evicted.
    first.write_all(STRING).ok();
    assert!(matches!(first.read(&mut [0]), Ok(0) | Err(_)));
    busy.write_all(&STRING[50..]).unwrap();
    assert_eq!(answer(&mut busy), OK);
}

/// A platform that reads requests, and writes an answer to each.
struct Jade {
    location: Location,
    /// The number of the connection of each request, and its bytes.
    requests: Receiver<(usize, Vec<u8>)>,
    /// A notification for each connection that it has closed.
    closed: Receiver<()>,
}

impl Jade {
    /// Starts a platform. `answers` returns the bytes of the answer to a request, by the number of
    /// the request, and whether the connection stays open.
    fn new(answers: impl Fn(usize) -> (Vec<u8>, bool) + Send + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let location = format!("http://{}/acc", listener.local_addr().unwrap());
        let (sender, requests) = channel();
        let (closing, closed) = channel();
        thread::spawn(move || {
            let mut count = 0;
            for (connection, stream) in listener.incoming().enumerate() {
                serve(stream.unwrap(), connection, &mut count, &answers, &sender);
                let _ended = closing.send(());
            }
        });
        Self {
            location: location.parse().unwrap(),
            requests,
            closed,
        }
    }

    fn answering(answer: &'static [u8]) -> Self {
        Self::new(move |_| (answer.to_vec(), true))
    }

    /// Returns the next request, as JADE reads it.
    fn request(&self) -> (usize, Envelope, Message) {
        let (connection, bytes) = self.requests.recv_timeout(TIMEOUT).unwrap();
        let head = position(&bytes, b"\r\n\r\n").unwrap();
        let text = std::str::from_utf8(&bytes[..head]).unwrap();
        let (_, behind) = text.split_once("boundary=\"").unwrap();
        let (boundary, _) = behind.split_once('"').unwrap();
        let delimiter = format!("\r\n--{boundary}");
        let mut parts = Vec::new();
        let mut rest = &bytes[head..];
        while let Some(at) = position(rest, delimiter.as_bytes()) {
            parts.push(&rest[..at]);
            rest = &rest[at + delimiter.len()..];
        }
        assert_eq!(rest, b"--\r\n");
        let of_part = |part: &[u8]| part[position(part, b"\r\n\r\n").unwrap() + 4..].to_vec();
        let envelope = of_part(parts[1]);
        let (envelope, len) = Envelope::decode(&envelope).map(|it| (it.0, it.1)).unwrap();
        assert_eq!(len, of_part(parts[1]).len());
        let payload = Bytes::from(of_part(parts[2]));
        let named = envelope.effective().payload_length;
        // JADE warns of another number of bytes.
        assert_eq!(named, Some(payload.len() as u64));
        (
            connection,
            envelope,
            Message::decode(&payload.into()).unwrap(),
        )
    }
}

fn position(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|it| it == what)
}

/// Serves one connection.
fn serve(
    mut stream: TcpStream,
    connection: usize,
    count: &mut usize,
    answers: &impl Fn(usize) -> (Vec<u8>, bool),
    sender: &Sender<(usize, Vec<u8>)>,
) {
    loop {
        let mut bytes = Vec::new();
        let mut more = [0; 65536];
        let end = loop {
            let Ok(len @ 1..) = stream.read(&mut more) else {
                return;
            };
            bytes.extend(&more[..len]);
            let Some(head) = position(&bytes, b"\r\n\r\n") else {
                continue;
            };
            let text = String::from_utf8(bytes[..head].to_vec()).unwrap();
            let (_, behind) = text.split_once("Content-Length: ").unwrap();
            let length: usize = behind.lines().next().unwrap().parse().unwrap();
            let end = head + 4 + length;
            if bytes.len() >= end {
                break end;
            }
        };
        assert_eq!(bytes.len(), end, "nothing follows an unanswered request");
        sender.send((connection, bytes)).unwrap();
        let (answer, stays) = answers(*count);
        *count += 1;
        stream.write_all(&answer).unwrap();
        if !stays {
            return;
        }
    }
}

#[test]
fn letters_leave_in_order_over_one_connection_although_answers_have_no_length() {
    let (party, jade) = (party(), Jade::answering(KEPT_ANSWER));
    for number in 0..20 {
        let text = number.to_string();
        party
            .send(number, &jade.location, message_parcel(number, &text))
            .unwrap();
    }
    for number in 0..20 {
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        let (connection, envelope, message) = jade.request();
        assert_eq!(connection, 0);
        assert_eq!(message.content().unwrap(), &number.to_string());
        let effective = envelope.effective();
        assert_eq!(effective.intended_receivers[0].name(), "arm_1");
        assert_eq!(
            effective.acl_representation,
            Some(AclRepresentation::String)
        );
        // The platform can answer.
        let here = party.location().to_string();
        for sender in [message.sender(), effective.from.as_ref()] {
            assert_eq!(sender.unwrap().addresses(), [&*here]);
        }
    }
    // The connection is still open for the next letter.
    party
        .send(20, &jade.location, message_parcel(20, "grüße 漢"))
        .unwrap();
    assert_eq!(party.conclusion(20), Conclusion::Handed);
    let (connection, envelope, message) = jade.request();
    assert_eq!(
        (connection, message.content().unwrap()),
        (0, &"grüße 漢".into())
    );
    assert_eq!(
        envelope.effective().payload_encoding.as_deref(),
        Some("UTF-8")
    );
    assert_eq!(party.transport.counters().unframed_out, 21);
}

#[test]
fn letters_leave_in_the_encoding_that_the_location_names() {
    let (party, jade) = (party(), Jade::answering(LAST_ANSWER));
    let encodings = [
        ("jade", AclRepresentation::String),
        ("jade-xml", AclRepresentation::Xml),
        ("jade-bit-efficient", AclRepresentation::BitEfficient),
    ];
    for (number, (name, representation)) in (0..).zip(encodings) {
        let to: Location = format!("{};{name}", jade.location).parse().unwrap();
        let content = "grüße (an \"c\") 漢";
        party
            .send(number, &to, message_parcel(number, content))
            .unwrap();
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        let (_, envelope, message) = jade.request();
        assert_eq!(message.content().unwrap(), content);
        let effective = envelope.effective();
        assert_eq!(effective.acl_representation, Some(representation));
    }
}

#[test]
fn a_closed_connection_is_replaced_for_the_next_letter() {
    let party = party();
    // The answer announces that the connection stays open, but it is closed.
    let jade = Jade::new(|_| (KEPT_ANSWER.to_vec(), false));
    for number in 0..5 {
        party
            .send(number, &jade.location, message_parcel(number, "x"))
            .unwrap();
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        assert_eq!(jade.request().0, number as usize);
        jade.closed.recv_timeout(TIMEOUT).unwrap();
    }
    let closing = Jade::answering(LAST_ANSWER);
    for number in 10..13 {
        party
            .send(number, &closing.location, message_parcel(number, "x"))
            .unwrap();
        assert_eq!(party.conclusion(number), Conclusion::Handed);
    }
}

#[test]
fn an_answer_other_than_200_is_a_failed_attempt() {
    let party = party();
    let refusal = b"HTTP/1.1 406 Not\x1b[31m Acceptable\r\nContent-Length: 2\r\n\r\nno";
    let jade = Jade::answering(refusal);
    for number in 0..2 {
        party
            .send(number, &jade.location, message_parcel(number, "x"))
            .unwrap();
        match party.conclusion(number) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Refused, "{error}");
                assert!(
                    error.detail.contains("406 Not\\u{1b}[31m Acceptable"),
                    "{error}"
                );
            }
            other => panic!("{other:?}"),
        }
        assert_eq!(jade.request().0, 0);
    }
}

#[test]
fn a_letter_without_an_answer_is_unconfirmed_and_never_repeated() {
    let party = with(NetLimits {
        stall_timeout: Duration::from_secs(2),
        ..config(&[]).limits
    });
    // The first request is answered, the second is not, and the connection is closed.
    let jade = Jade::new(|number| match number {
        1 => (Vec::new(), false),
        _ => (KEPT_ANSWER.to_vec(), true),
    });
    for number in 0..3 {
        let text = number.to_string();
        party
            .send(number, &jade.location, message_parcel(number, &text))
            .unwrap();
    }
    assert_eq!(party.conclusion(0), Conclusion::Handed);
    assert!(matches!(party.conclusion(1), Conclusion::Unconfirmed(_)));
    assert_eq!(party.conclusion(2), Conclusion::Handed);
    for (number, connection) in [0, 0, 1].into_iter().enumerate() {
        let (over, _, message) = jade.request();
        assert_eq!(over, connection);
        assert_eq!(message.content().unwrap(), &number.to_string());
    }
    // A silent platform.
    let silent = Jade::new(|_| (Vec::new(), true));
    party
        .send(5, &silent.location, message_parcel(5, "x"))
        .unwrap();
    match party.conclusion(5) {
        Conclusion::Unconfirmed(error) => {
            assert_eq!(error.fault, TransportErrorKind::TimedOut, "{error}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn letters_that_jade_would_lose_are_not_sent() {
    let (party, jade) = (party(), Jade::answering(KEPT_ANSWER));
    let arm = AgentId::new("arm_1").unwrap();
    let message = Message::builder(Performative::Inform).receiver(arm.clone());
    let base = EnvelopeParams {
        to: vec![arm],
        acl_representation: Some(AclRepresentation::BitEfficient),
        from: Some(AgentId::new("rover").unwrap()),
        date: Some("20261120T112644481Z".parse().unwrap()),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let letter = Letter::new(
        envelope.encode_standard().unwrap(),
        message.build().unwrap().to_payload(),
    );
    party
        .send(1, &jade.location, letter_parcel(1, letter))
        .unwrap();
    match party.conclusion(1) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::Inexpressible, "{error}");
            assert!(error.detail.contains("no sender"), "{error}");
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn large_letters_pass_in_both_directions() {
    let (near, far) = (party(), party());
    let content = "<a & b> \"quoted\" \\ \u{e9}\n".repeat(100_000);
    near.send(1, far.location(), message_parcel(1, &content))
        .unwrap();
    assert_eq!(near.conclusion(1), Conclusion::Handed);
    let [message] = &messages(&far, 1)[..] else {
        panic!("one message");
    };
    assert_eq!(message.content().unwrap(), &content);
    // The answer to the address in it arrives.
    let back = message.sender().unwrap().addresses()[0].parse().unwrap();
    far.send(1, &back, message_parcel(1, &content)).unwrap();
    assert_eq!(far.conclusion(1), Conclusion::Handed);
    assert_eq!(messages(&near, 1)[0].content().unwrap(), &content);
}

#[test]
fn a_closed_endpoint_concludes_its_letters() {
    let party = party();
    let silent = Jade::new(|_| (Vec::new(), true));
    for number in 0..3 {
        party
            .send(number, &silent.location, message_parcel(number, "x"))
            .unwrap();
    }
    silent.request();
    let mut client = connect(&party);
    client.write_all(STRING).unwrap();
    assert_eq!(answer(&mut client), OK);
    party.transport.close();
    assert!(matches!(party.conclusion(0), Conclusion::Unconfirmed(_)));
    for number in 1..3 {
        assert!(matches!(party.conclusion(number), Conclusion::NotSent(_)));
    }
    assert_eq!(client.read_to_end(&mut Vec::new()).unwrap_or(0), 0);
    let after = party
        .send(9, &silent.location, message_parcel(9, "x"))
        .unwrap_err();
    assert_eq!(after.fault, TransportErrorKind::Closed);
}

/// The same over TLS.
#[cfg(feature = "secure")]
mod tls {
    #[cfg(feature = "quic")]
    use std::sync::Arc;
    use std::time::SystemTime;

    use fipa_transport_net::secure::{Authorities, Rules, Security};
    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

    use super::*;
    use crate::common::certificates::Host;

    /// Creates an endpoint of `https` with these credentials, also as those that except legacy peers.
    fn party(security: Security, authorities: Authorities) -> Platform {
        security.set_authorities(authorities).unwrap();
        let tcp = config(&["127.0.0.1:0"]);
        let config = HttpConfig {
            listen: tcp.listen,
            identity: tcp.identity,
            limits: tcp.limits,
            security: Some(security.clone()),
        };
        Party::over(Recorder::default(), |runtime| {
            HttpTransport::over_tls(config, security, runtime)
        })
    }

    /// Returns a letter of this agent to `arm_1`.
    fn letter(number: u64, sender: &str) -> Parcel {
        let (from, to) = (
            AgentId::new(sender).unwrap(),
            AgentId::new("arm_1").unwrap(),
        );
        let message = Message::builder(Performative::Inform)
            .sender(from.clone())
            .receiver(to.clone())
            .content(number.to_string())
            .build()
            .unwrap();
        let envelope = Envelope {
            base: EnvelopeParams {
                from: Some(from),
                to: vec![to.clone()],
                intended_receivers: vec![to],
                acl_representation: Some(AclRepresentation::BitEfficient),
                date: Some("20261120T112644481Z".parse().unwrap()),
                ..EnvelopeParams::default()
            },
            extensions: Vec::new(),
        };
        let payload = message.to_payload();
        letter_parcel(
            number,
            Letter::new(envelope.encode_standard().unwrap(), payload),
        )
    }

    fn failure(conclusion: Conclusion) -> (TransportErrorKind, String) {
        match conclusion {
            Conclusion::NotSent(error) => (error.fault, error.detail),
            other => panic!("{other:?}"),
        }
    }

    fn assert_withdrawn(conclusion: Conclusion) {
        let Conclusion::Answered(Answer::Failed { reason, detail }) = conclusion else {
            panic!("{conclusion:?}");
        };
        assert_eq!(reason, FailureReason::Refused);
        assert!(detail.contains("was withdrawn"), "{detail}");
    }

    #[test]
    fn platforms_with_trusted_certificates_exchange_letters() {
        let (crex, jade) = (Host::new("crex", &[]), Host::new("jade", &["echo@jade"]));
        let ours = party(crex.security(&[&jade]), Authorities::default());
        let theirs = party(jade.security(&[&crex]), Authorities::default());
        assert!(
            ours.location()
                .to_string()
                .starts_with("https://127.0.0.1:")
        );
        for number in 0..5 {
            ours.send(number, theirs.location(), letter(number, "rover"))
                .unwrap();
            assert_eq!(ours.conclusion(number), Conclusion::Handed);
        }
        until_some("the letters", || {
            (theirs.sink.record.lock().unframed.len() == 5).then_some(())
        });
        let record = theirs.sink.record.lock();
        for (number, (letter, via)) in record.unframed.iter().enumerate() {
            assert_eq!(*via, Kind::Https);
            let message = Message::decode(letter.payload()).unwrap();
            assert_eq!(message.content().unwrap(), &number.to_string());
            // The platform can answer.
            let here = ours.location().to_string();
            assert_eq!(message.sender().unwrap().addresses(), [&*here]);
        }
        drop(record);
        // The certificate of the platform names one agent, and its letters are of that one.
        // Its own directory facilitator needs no mention.
        for (number, sender) in [(0, "echo@jade"), (2, "df@jade")] {
            theirs
                .send(number, ours.location(), letter(number, sender))
                .unwrap();
            assert_eq!(theirs.conclusion(number), Conclusion::Handed);
        }
        theirs
            .send(1, ours.location(), letter(1, "brake@jade"))
            .unwrap();
        let (kind, text) = failure(theirs.conclusion(1));
        assert_eq!(kind, TransportErrorKind::Refused);
        assert!(text.contains("403"), "{text}");
        assert_eq!(ours.sink.record.lock().unframed.len(), 2);
    }

    #[test]
    fn a_platform_without_a_trusted_certificate_is_refused_unless_it_is_listed() {
        let (crex, jade) = (Host::new("crex", &[]), Host::new("jade", &[]));
        let ours = party(crex.security(&[]), Authorities::default());
        // It trusts this host, which does not trust it.
        let theirs = party(jade.security(&[&crex]), Authorities::default());
        theirs
            .send(0, ours.location(), letter(0, "echo@jade"))
            .unwrap();
        let (kind, text) = failure(theirs.conclusion(0));
        assert_eq!(kind, TransportErrorKind::Refused);
        assert!(text.contains("403"), "{text}");
        ours.send(0, theirs.location(), letter(0, "rover")).unwrap();
        let (kind, text) = failure(ours.conclusion(0));
        assert_eq!(kind, TransportErrorKind::Distrusted);
        assert!(text.contains("neither trusted"), "{text}");
        let rules = Rules {
            loopback: true,
            legacy_peers: vec!["127.0.0.1".parse().unwrap()],
        };
        let listing = party(
            Security::new(crex.credentials(&[]), rules).unwrap(),
            Authorities::default(),
        );
        theirs
            .send(1, listing.location(), letter(1, "echo@jade"))
            .unwrap();
        assert_eq!(theirs.conclusion(1), Conclusion::Handed);
        // A list excepts no server from the proof: its letters would be readable for others.
        listing
            .send(1, theirs.location(), letter(1, "rover"))
            .unwrap();
        assert_eq!(
            failure(listing.conclusion(1)).0,
            TransportErrorKind::Distrusted
        );
        assert!(ours.sink.record.lock().unframed.is_empty());
        assert!(theirs.sink.record.lock().unframed.is_empty());
    }

    #[test]
    fn plain_http_is_not_read_behind_tls() {
        let crex = Host::new("crex", &[]);
        let ours = party(crex.security(&[]), Authorities::default());
        let mut plain = connect(&ours);
        plain.write_all(ONCE).unwrap();
        let mut answer = Vec::new();
        // The end of the connection may be a reset.
        let _ = plain.read_to_end(&mut answer);
        assert!(!answer.starts_with(b"HTTP/"), "{answer:?}");
        assert!(ours.sink.record.lock().unframed.is_empty());
    }

    /// An authority of platforms.
    struct Authority {
        root: rcgen::Certificate,
        issuer: Issuer<'static, KeyPair>,
    }

    impl Authority {
        fn new() -> Self {
            let key = KeyPair::generate().unwrap();
            let mut params = CertificateParams::default();
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            let root = params.self_signed(&key).unwrap();
            let issuer = Issuer::new(params, key);
            Self { root, issuer }
        }

        fn listed(&self) -> Authorities {
            Authorities::new(vec![self.root.der().clone()]).unwrap()
        }

        /// Creates a platform that has proved its name `localhost` until this time. Returns its location
        /// with that name, too.
        fn platform(&self, until: SystemTime) -> (Host, Platform, Location) {
            let jade = Host::named("jade", "localhost", &self.issuer, until);
            let theirs = party(
                Security::new(jade.credentials(&[]), Rules::default()).unwrap(),
                Authorities::default(),
            );
            let at = theirs.location().authority().to_owned();
            let named = format!("https://{}/acc", at.replace("127.0.0.1", "localhost"));
            (jade, theirs, named.parse().unwrap())
        }
    }

    fn tomorrow() -> SystemTime {
        SystemTime::now() + Duration::from_secs(86_400)
    }

    #[test]
    fn an_authority_proves_the_name_of_a_platform() {
        let authority = Authority::new();
        let crex = Host::new("crex", &[]);
        let ours = party(crex.security(&[]), authority.listed());
        let (_, theirs, named) = authority.platform(tomorrow());
        ours.send(0, &named, letter(0, "rover")).unwrap();
        assert_eq!(ours.conclusion(0), Conclusion::Handed);
        // The certificate proves the name only, and only where the authority is listed.
        ours.send(1, theirs.location(), letter(1, "rover")).unwrap();
        assert_eq!(
            failure(ours.conclusion(1)).0,
            TransportErrorKind::Distrusted
        );
        let without = party(crex.security(&[]), Authorities::default());
        without.send(2, &named, letter(2, "rover")).unwrap();
        assert_eq!(
            failure(without.conclusion(2)).0,
            TransportErrorKind::Distrusted
        );
        assert_eq!(theirs.sink.record.lock().unframed.len(), 1);
        assert!(Authorities::new(vec![vec![1, 2, 3].into()]).is_err());
    }

    /// The connection of the first letter stays open, and is not used for another one.
    #[test]
    fn a_platform_is_judged_again_when_credentials_or_authorities_change() {
        type Change<'a> = &'a dyn Fn(&Security, &Host);

        let authority = Authority::new();
        let crex = Host::new("crex", &[]);
        let without_authority = |security: &Security, _: &Host| {
            security.set_authorities(Authorities::default()).unwrap();
        };
        let revoked = |security: &Security, jade: &Host| {
            let mut credentials = crex.credentials(&[]);
            credentials.revoked.push(jade.certificate.fingerprint());
            security.replace(credentials).unwrap();
        };
        let unrelated = |security: &Security, _: &Host| {
            security.replace(crex.credentials(&[])).unwrap();
        };
        let changes: [Change<'_>; 3] = [&unrelated, &without_authority, &revoked];
        for (change, is_trusted) in changes.into_iter().zip([true, false, false]) {
            let security = crex.security(&[]);
            let ours = party(security.clone(), authority.listed());
            let (jade, theirs, named) = authority.platform(tomorrow());
            ours.send(0, &named, letter(0, "rover")).unwrap();
            assert_eq!(ours.conclusion(0), Conclusion::Handed);
            change(&security, &jade);
            ours.send(1, &named, letter(1, "rover")).unwrap();
            match is_trusted {
                true => assert_eq!(ours.conclusion(1), Conclusion::Handed),
                // Final, unlike for a platform that was never trusted.
                false => assert_withdrawn(ours.conclusion(1)),
            }
            let taken = theirs.sink.record.lock().unframed.len();
            assert_eq!(taken, 1 + usize::from(is_trusted));
        }
    }

    #[test]
    fn a_chain_ends_with_its_first_certificate_that_ends() {
        let authority = Authority::new();
        let crex = Host::new("crex", &[]);
        let ours = party(crex.security(&[]), authority.listed());
        // Time for a handshake under load.
        let end = SystemTime::now() + Duration::from_secs(8);
        let (_, theirs, named) = authority.platform(end);
        let mut number = 0;
        let last = loop {
            ours.send(number, &named, letter(number, "rover")).unwrap();
            match ours.conclusion(number) {
                Conclusion::Handed => number += 1,
                other => break other,
            }
            assert!(SystemTime::now() < end + TIMEOUT, "letters still pass");
            thread::sleep(Duration::from_millis(20));
        };
        assert!(number > 0 && SystemTime::now() >= end, "{last:?}");
        ours.send(number + 1, &named, letter(number + 1, "rover"))
            .unwrap();
        let after = ours.conclusion(number + 1);
        assert_eq!(failure(after).0, TransportErrorKind::Distrusted);
        let taken = theirs.sink.record.lock().unframed.len() as u64;
        // The certificate may end between the arrival of the last letter and its answer.
        let is_uncertain = matches!(last, Conclusion::Unconfirmed(_));
        let most = number + u64::from(is_uncertain);
        assert!(
            (number..=most).contains(&taken),
            "{taken} of {number}: {last:?}"
        );
    }

    /// A client that keeps its connection open, as JADE does.
    #[cfg(feature = "quic")]
    #[test]
    fn the_next_request_after_trust_was_withdrawn_is_refused_and_the_connection_closed() {
        let (crex, jade) = (Host::new("crex", &[]), Host::new("jade", &[]));
        let security = crex.security(&[&jade]);
        let ours = party(security.clone(), Authorities::default());
        const TLS13: common::intruder::Versions = &[&rustls::version::TLS13];
        let config = Arc::new(common::intruder::client(Some(&jade), TLS13));
        let session = rustls::ClientConnection::new(config, "localhost".try_into().unwrap());
        let mut client = rustls::StreamOwned::new(session.unwrap(), connect(&ours));
        client.write_all(STRING).unwrap();
        assert_eq!(answer(&mut client), OK);
        security.replace(crex.credentials(&[])).unwrap();
        // The connection may be closed before the request has been read.
        let _ = client.write_all(STRING);
        let mut rest = Vec::new();
        let _ = client.read_to_end(&mut rest);
        let rest = String::from_utf8(rest).unwrap();
        assert!(rest.starts_with("HTTP/1.1 403 "), "{rest}");
        assert_eq!(ours.sink.record.lock().unframed.len(), 1);
    }
}
