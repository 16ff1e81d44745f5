//! Letters to legacy peers, which behave as fipa_services and JADE's proxy agent do: one letter per
//! connection, read until the end of the stream.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use common::{Party, config, message_parcel};
use fipa_acl::{AclRepresentation, Envelope, Message};
use fipa_testbed::until_some;
use fipa_transport::{
    AttemptId, Conclusion, Kind, Location, Signature, Transport, TransportErrorKind,
};

/// A legacy peer that accepts connections one after the other, and reads each to its end.
struct LegacyPeer {
    location: Location,
    letters: Receiver<Vec<u8>>,
}

impl LegacyPeer {
    fn new(signature: Signature) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let location = location(&listener, signature);
        let (sender, letters) = channel();
        thread::spawn(move || {
            for stream in listener.incoming() {
                let mut letter = Vec::new();
                stream.unwrap().read_to_end(&mut letter).unwrap();
                if sender.send(letter).is_err() {
                    return;
                }
            }
        });
        Self { location, letters }
    }

    /// Returns the next letter, read as these peers do: an envelope, and the payload to the end.
    fn letter(&self) -> (Envelope, Message, Vec<u8>) {
        let bytes = self.letters.recv_timeout(Duration::from_secs(60)).unwrap();
        let (envelope, len) = Envelope::decode(&bytes).unwrap();
        let payload = Bytes::copy_from_slice(&bytes[len..]).into();
        (envelope, Message::decode(&payload).unwrap(), bytes)
    }
}

fn location(listener: &TcpListener, signature: Signature) -> Location {
    let address = listener.local_addr().unwrap().to_string();
    let plain = Location::new(Kind::Tcp, &address).unwrap();
    plain.with_signature(signature).unwrap()
}

#[test]
fn fipa_services_gets_one_letter_per_connection_in_order() {
    let (party, peer) = (Party::new(), LegacyPeer::new(Signature::FipaServices));
    for number in 0..20 {
        party
            .send(
                number,
                &peer.location,
                message_parcel(number, &number.to_string()),
            )
            .unwrap();
    }
    for number in 0..20 {
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        let (envelope, message, bytes) = peer.letter();
        assert_eq!(bytes[0], 0xfe);
        assert_eq!(message.content().unwrap(), &number.to_string());
        let effective = envelope.effective();
        assert_eq!(effective.intended_receivers[0].name(), "arm_1");
        let representation = effective.acl_representation;
        assert_eq!(representation, Some(AclRepresentation::BitEfficient));
    }
    assert_eq!(party.transport.counters().unframed_out, 20);
}

#[test]
fn jade_gets_xml_and_a_string_message_and_can_answer() {
    let (party, peer) = (Party::new(), LegacyPeer::new(Signature::JadeProxy));
    party
        .send(1, &peer.location, message_parcel(1, "hello"))
        .unwrap();
    assert_eq!(party.conclusion(1), Conclusion::Handed);
    let (envelope, message, bytes) = peer.letter();
    assert!(bytes.starts_with(b"<?xml"));
    assert!(envelope.effective().payload_length.is_some());
    let here = format!("tcp://{}", party.location().address());
    assert_eq!(message.sender().unwrap().addresses(), [&*here]);
    // The answer to that address arrives.
    let mut answer = TcpStream::connect(here.strip_prefix("tcp://").unwrap()).unwrap();
    answer.write_all(&bytes).unwrap();
    drop(answer);
    until_some("the answer", || {
        (party.sink.record.lock().unframed.len() == 1).then_some(())
    });
}

#[test]
fn an_unreachable_peer_is_reported_for_all_waiting_letters() {
    let party = Party::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let gone = location(&listener, Signature::FipaServices);
    drop(listener);
    for attempt in 0..10 {
        party
            .send(attempt, &gone, message_parcel(attempt, "x"))
            .unwrap();
    }
    for attempt in 0..10 {
        match party.conclusion(attempt) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}")
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_peer_that_does_not_read_is_given_up_and_others_are_served() {
    let mut impatient = config(&["127.0.0.1:0"]);
    impatient.limits.stall_timeout = Duration::from_millis(300);
    let (party, good) = (
        Party::with(impatient),
        LegacyPeer::new(Signature::FipaServices),
    );
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let deaf = location(&listener, Signature::FipaServices);
    party
        .send(1, &deaf, message_parcel(1, &"x".repeat(32 << 20)))
        .unwrap();
    party.send(2, &deaf, message_parcel(2, "waits")).unwrap();
    party
        .send(3, &good.location, message_parcel(3, "y"))
        .unwrap();
    assert_eq!(party.conclusion(3), Conclusion::Handed);
    match party.conclusion(1) {
        Conclusion::Unconfirmed(error) => {
            assert_eq!(error.fault, TransportErrorKind::TimedOut, "{error}")
        }
        other => panic!("{other:?}"),
    }
    // The system accepts a small letter for a peer that does not read.
    assert_eq!(party.conclusion(2), Conclusion::Handed);
    drop(listener);
}

#[test]
fn waiting_letters_are_bounded_and_concluded_once() {
    let mut few = config(&["127.0.0.1:0"]);
    few.limits.max_in_flight = 3;
    let party = Party::with(few);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let slow = location(&listener, Signature::FipaServices);
    let large = "x".repeat(32 << 20);
    party.send(0, &slow, message_parcel(0, &large)).unwrap();
    let (mut stream, _) = listener.accept().unwrap();
    // The letter has begun now.
    stream.read_exact(&mut [0]).unwrap();
    for attempt in 1..=3 {
        party
            .send(attempt, &slow, message_parcel(attempt, "x"))
            .unwrap();
    }
    let full = party.send(4, &slow, message_parcel(4, "x")).unwrap_err();
    assert_eq!(full.fault, TransportErrorKind::Congested, "{full}");
    party.transport.abandon(AttemptId(2), &slow);
    party.transport.close();
    assert!(matches!(party.conclusion(0), Conclusion::Unconfirmed(_)));
    for attempt in [1, 3] {
        assert!(matches!(party.conclusion(attempt), Conclusion::NotSent(_)));
    }
    assert_eq!(party.sink.record.lock().concluded.len(), 3);
    let closed = party.send(5, &slow, message_parcel(5, "x")).unwrap_err();
    assert_eq!(closed.fault, TransportErrorKind::Closed, "{closed}");
    drop(stream);
}

#[test]
fn a_letter_that_the_peer_cannot_read_is_not_sent() {
    let (party, peer) = (Party::new(), LegacyPeer::new(Signature::FipaServices));
    party
        .send(1, &peer.location, common::parcel(1, "not even an envelope"))
        .unwrap();
    match party.conclusion(1) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::Inexpressible, "{error}")
        }
        other => panic!("{other:?}"),
    }
}
