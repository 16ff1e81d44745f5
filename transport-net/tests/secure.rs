//! Admission of peers that must prove their identity.
#![cfg(feature = "secure")]
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, TcpListener, TcpStream};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use common::certificates::Host;
use common::{NAME, Party, accepted, config, letter_parcel, parcel};
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Performative,
};
use fipa_testbed::until_some;
use fipa_transport::{
    Answer, Conclusion, FailureReason, Kind, Location, Mandate, Transport, TransportErrorKind,
};
use fipa_transport_net::secure::{Rules, Security};
use fipa_transport_net::{Counters, NetLimits, TcpTransport};

/// A transport over which peers prove their identity.
trait Proving: Transport + Sized {
    fn party(security: Security) -> Party<Self> {
        Self::limited(security, |_| {})
    }

    fn limited(security: Security, limit: fn(&mut NetLimits)) -> Party<Self>;

    fn counters(&self) -> Counters;
}

impl Proving for TcpTransport {
    fn limited(security: Security, limit: fn(&mut NetLimits)) -> Party {
        let mut config = config(&["127.0.0.1:0"]);
        config.security = Some(security);
        limit(&mut config.limits);
        Party::with(config)
    }

    fn counters(&self) -> Counters {
        self.counters()
    }
}

#[cfg(feature = "quic")]
impl Proving for fipa_transport_net::QuicTransport {
    fn limited(security: Security, limit: fn(&mut NetLimits)) -> Party<Self> {
        let mut config = common::quic_config(&["127.0.0.1:0"], security);
        limit(&mut config.limits);
        Party::over(common::Recorder::default(), |runtime| {
            Self::new(config, runtime)
        })
    }

    fn counters(&self) -> Counters {
        self.counters()
    }
}

/// Runs each of these tests over TCP and over QUIC.
macro_rules! over_both {
    ($($name:ident,)*) => {
        mod tcp {
            $(#[test] fn $name() { super::$name::<fipa_transport_net::TcpTransport>(); })*
        }

        #[cfg(feature = "quic")]
        mod quic {
            $(#[test] fn $name() { super::$name::<fipa_transport_net::QuicTransport>(); })*
        }
    };
}

over_both! {
    peers_that_trust_each_other_exchange_letters_of_any_size,
    untrusted_peers_are_refused_on_either_side,
    certificates_that_are_not_valid_now_are_refused,
    a_peer_cannot_claim_another_name_than_its_certificate_has,
    a_peer_speaks_for_its_own_agents_only,
    a_peer_with_keys_does_not_count_as_of_this_host,
    withdrawn_trust_ends_the_connection,
    an_expired_certificate_ends_the_connection,
    a_new_key_takes_over_while_letters_pass,
    a_peer_that_the_service_refuses_gets_no_letter_and_sends_none,
    a_peer_beyond_its_rate_limit_is_read_later_without_loss,
    a_restarted_gateway_replaces_its_older_connection_at_once,
}

fn party(security: Security) -> Party {
    TcpTransport::party(security)
}

/// Two parties that trust each other.
fn friends<T: Proving>(left: &Host, right: &Host) -> (Party<T>, Party<T>) {
    (
        T::party(left.security(&[right])),
        T::party(right.security(&[left])),
    )
}

/// Asserts that a letter from one party to the other fails, and that none has arrived.
fn assert_refused<T: Transport>(from: &Party<T>, to: &Party<T>) -> String {
    from.send(1, to.location(), parcel(1, "let me in")).unwrap();
    let Conclusion::NotSent(error) = from.conclusion(1) else {
        panic!("it was sent: {:?}", from.conclusion(1));
    };
    assert_eq!(to.arrivals(), 0);
    error.to_string()
}

/// Asserts that an error names the alert of the peer once, and does not guess about keys.
fn assert_tells_alert(error_text: &str, alert: &str) {
    let part = format!("the peer sent the TLS alert {alert}");
    assert_eq!(error_text.matches(&part).count(), 1, "{error_text}");
    for guess in [
        "possible causes",
        "has none",
        "security.keys",
        "may require",
    ] {
        assert!(!error_text.contains(guess), "{error_text}");
    }
}

fn letter_from(sender: &str) -> Letter {
    letter_signed(sender, sender)
}

/// A letter whose envelope names one sender and whose message names another.
fn letter_signed(sender: &str, signed: &str) -> Letter {
    let base = EnvelopeParams {
        to: vec![AgentId::new("arm_1").unwrap()],
        from: Some(AgentId::new(sender).unwrap()),
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some("20261120T112644998Z".parse().unwrap()),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new(signed).unwrap())
        .receiver(AgentId::new("arm_1").unwrap())
        .content("hello")
        .build()
        .unwrap();
    Letter::new(envelope.encode_standard().unwrap(), message.to_payload())
}

fn peers_that_trust_each_other_exchange_letters_of_any_size<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let (from, to) = friends::<T>(&rover, &crex);
    from.assert_reaches(1, &to);
    let large = vec![7; 5 << 20];
    from.send(2, to.location(), parcel(2, large.clone()))
        .unwrap();
    assert_eq!(from.conclusion(2), accepted());
    to.assert_reaches(3, &from);
    let arrived = to.sink.record.lock().arrivals[1].0.clone();
    assert_eq!(arrived, parcel(2, large));
    // One for all parcels and one for large letters.
    assert_eq!(from.transport.counters().dialed, 2);
}

fn untrusted_peers_are_refused_on_either_side<T: Proving>() {
    let (rover, crex, stranger) = (
        Host::new(NAME, &[]),
        Host::new(NAME, &[]),
        Host::new(NAME, &[]),
    );
    // This certificate is not trusted.
    let to = T::party(crex.security(&[&rover]));
    let from = T::party(stranger.security(&[&crex]));
    let error_text = assert_refused(&from, &to);
    assert!(
        error_text.contains("the peer does not trust this host"),
        "{error_text}"
    );
    assert_tells_alert(&error_text, "unknown_ca (48)");
    // The listener has another certificate.
    let from = T::party(rover.security(&[&stranger]));
    let error_text = assert_refused(&from, &to);
    assert!(error_text.contains("unknown issuer"), "{error_text}");
    assert!(
        error_text.contains("does not trust the peer: run `fipa keys trust`"),
        "{error_text}"
    );
    until_some("it was counted", || {
        (to.transport.counters().refused_unproved >= 2).then_some(())
    });
}

fn certificates_that_are_not_valid_now_are_refused<T: Proving>() {
    let day = Duration::from_secs(86_400);
    let now = SystemTime::now();
    let rover = Host::new(NAME, &[]);
    for (from, until, what) in [
        (now - 2 * day, now - day, "Expired"),
        (now + day, now + 2 * day, "not valid yet"),
    ] {
        let crex = Host::valid(NAME, &[], from, until);
        let (from, to) = friends::<T>(&rover, &crex);
        let error_text = assert_refused(&from, &to);
        assert!(
            error_text.contains(what) && error_text.contains("renew` there"),
            "{error_text}"
        );
        let clock = error_text.contains("not valid yet by the clock of this host");
        assert_eq!(clock, what == "not valid yet", "{error_text}");
        // The clock comes before the keys.
        let shown = error_text
            .find("the clock of this host, which shows 20")
            .unwrap();
        assert!(
            shown < error_text.find("renew` there").unwrap(),
            "{error_text}"
        );
        let error_text = assert_refused(&to, &from);
        assert!(
            error_text.contains("this host's certificate is not valid"),
            "{error_text}"
        );
        assert_tells_alert(&error_text, "certificate_expired (45)");
        let shown = error_text
            .find("the clock of this host, which shows 20")
            .unwrap();
        assert!(
            shown < error_text.find("keys renew`").unwrap(),
            "{error_text}"
        );
    }
}

#[test]
fn a_certificate_without_its_key_is_of_no_use() {
    let (rover, thief) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let stolen = Host::new(NAME, &[]).with_key_of(&thief);
    let rules = Rules::default();
    let refused = Security::new(stolen.credentials(&[&rover]), rules);
    assert!(
        refused.is_err(),
        "key and certificate do not belong together"
    );
}

fn a_peer_cannot_claim_another_name_than_its_certificate_has<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new("another-mts", &[]));
    let (from, to) = friends::<T>(&rover, &crex);
    let error_text = assert_refused(&from, &to);
    assert!(error_text.contains("another-mts"), "{error_text}");
}

/// The service may be connected over another transport, with another certificate.
fn a_peer_that_the_service_refuses_gets_no_letter_and_sends_none<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    for refusing in [true, false] {
        let (from, to) = friends::<T>(&rover, &crex);
        let refused_by = if refusing { &from } else { &to };
        refused_by.sink.refuses_peers.store(true, Ordering::Relaxed);
        assert_refused(&from, &to);
        assert!(refused_by.sink.record.lock().introduced.is_empty());
    }
}

fn a_peer_speaks_for_its_own_agents_only<T: Proving>() {
    let rover = Host::new(NAME, &["rover", "rover_*"]);
    let crex = Host::new(NAME, &["crex", "arm_1"]);
    let (from, to) = friends::<T>(&rover, &crex);
    for (attempt, sender) in [(1, "rover"), (2, "rover_arm")] {
        let letter = letter_parcel(attempt, letter_from(sender));
        from.send(attempt, to.location(), letter).unwrap();
        assert_eq!(from.conclusion(attempt), accepted(), "{sender}");
    }
    // Each side reports the agents of the other to its directory.
    for (party, agents) in [(&to, ["rover", "rover_*"]), (&from, ["crex", "arm_1"])] {
        let record = party.sink.record.lock();
        let mandates: Vec<_> = record.introduced.iter().map(|it| &it.mandate).collect();
        // The platform agents of the service itself belong to it.
        let own = ["ams", "df"].map(|agent| format!("{agent}@{NAME}"));
        let agents: Vec<String> = agents.map(str::to_owned).into_iter().chain(own).collect();
        assert_eq!(mandates, [&Mandate::Certified(agents.into())]);
    }
    let claimed = letter_parcel(3, letter_from("crex"));
    from.send(3, to.location(), claimed).unwrap();
    let Conclusion::Answered(Answer::Failed { reason, .. }) = from.conclusion(3) else {
        panic!("{:?}", from.conclusion(3));
    };
    assert_eq!(reason, FailureReason::Refused);
    // Nor may the message name another sender than the envelope.
    let disguised = letter_parcel(5, letter_signed("rover", "crex"));
    from.send(5, to.location(), disguised).unwrap();
    let Conclusion::Answered(Answer::Failed { reason, detail }) = from.conclusion(5) else {
        panic!("{:?}", from.conclusion(5));
    };
    assert_eq!(reason, FailureReason::Refused);
    assert!(detail.contains("its message names crex"), "{detail}");
    assert_eq!(to.arrivals(), 2);
    assert_eq!(to.transport.counters().refused_senders, 2);
    // Nor does it get letters for agents of other peers, even if the directory says so.
    let mut stray = letter_parcel(4, letter_from("rover"));
    stray.receiver = "sherpa".into();
    let refused = from.send(4, to.location(), stray.clone()).unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Refused);
    // Also when the connection is only opened for such a letter.
    let later = T::party(rover.security(&[&crex]));
    later.send(1, to.location(), stray).unwrap();
    let Conclusion::NotSent(refused) = later.conclusion(1) else {
        panic!("{:?}", later.conclusion(1));
    };
    assert_eq!(refused.fault, TransportErrorKind::Refused);
}

/// Gateways forward letters of processes of their own host.
fn a_peer_with_keys_does_not_count_as_of_this_host<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let (from, to) = friends::<T>(&rover, &crex);
    // All endpoints of these tests claim the same host and domain.
    from.assert_reaches(1, &to);
    to.assert_reaches(2, &from);
    for party in [&from, &to] {
        let (_, hop, _) = party.sink.record.lock().arrivals[0].clone();
        assert!(hop.is_remote(), "{hop:?}");
    }
}

fn withdrawn_trust_ends_the_connection<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let security = crex.security(&[&rover]);
    let to = T::party(security.clone());
    let from = T::party(rover.security(&[&crex]));
    from.assert_reaches(1, &to);
    security.replace(crex.credentials(&[])).unwrap();
    until_some("the connection ends", || {
        (to.transport.counters().connections == 0).then_some(())
    });
    until_some("the other side has noticed", || {
        (from.transport.counters().connections == 0).then_some(())
    });
    from.send(2, to.location(), parcel(2, "again")).unwrap();
    assert!(matches!(from.conclusion(2), Conclusion::NotSent(_)));
    // Trust that is restored admits the peer again.
    security.replace(crex.credentials(&[&rover])).unwrap();
    from.assert_reaches(3, &to);
}

fn an_expired_certificate_ends_the_connection<T: Proving>() {
    let now = SystemTime::now();
    // Time for a handshake under load.
    let ends = now + Duration::from_secs(8);
    let day = Duration::from_secs(86_400);
    let (rover, crex) = (
        Host::valid(NAME, &[], now - day, ends),
        Host::new(NAME, &[]),
    );
    let (from, to) = friends::<T>(&rover, &crex);
    from.assert_reaches(1, &to);
    until_some("the connection ends", || {
        (to.transport.counters().connections == 0).then_some(())
    });
    assert!(SystemTime::now() > ends, "not before it expires");
    until_some("the other side has noticed", || {
        (from.transport.counters().connections == 0).then_some(())
    });
    from.send(2, to.location(), parcel(2, "again")).unwrap();
    assert!(matches!(from.conclusion(2), Conclusion::NotSent(_)));
}

fn a_new_key_takes_over_while_letters_pass<T: Proving>() {
    let (rover, crex, renewed) = (
        Host::new(NAME, &[]),
        Host::new(NAME, &[]),
        Host::new(NAME, &[]),
    );
    let security = crex.security(&[&rover]);
    let to = T::party(security.clone());
    let from = T::party(rover.security(&[&crex, &renewed]));
    from.assert_reaches(1, &to);
    security.replace(renewed.credentials(&[&rover])).unwrap();
    from.assert_reaches(2, &to);
    assert_eq!(
        from.transport.counters().dialed,
        1,
        "the connection has stayed"
    );
}

#[test]
fn a_peer_that_must_prove_its_identity_gets_no_unencrypted_bytes() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let to = party(crex.security(&[&rover]));
    // A fipa peer without keys, in both directions.
    let plain = Party::new();
    let error_text = assert_refused(&plain, &to);
    assert!(
        error_text.contains("set security.keys here"),
        "{error_text}"
    );
    let error_text = assert_refused(&to, &plain);
    assert!(
        error_text.contains("set security.keys there"),
        "{error_text}"
    );
    // A legacy peer's letter, and frames.
    for first in [&b"\xfe\x10"[..], b"fipa\x03\x01\0\0", b"<?xml", b"garbage"] {
        let address = to.location().address().to_owned();
        let mut stream = TcpStream::connect(address).unwrap();
        stream.write_all(first).unwrap();
        let mut said = Vec::new();
        // A reset is equivalent to an end of stream.
        let _ = stream.read_to_end(&mut said);
        assert_eq!(said, b"", "an answer to {first:?}");
    }
    assert_eq!(to.arrivals() + to.sink.record.lock().unframed.len(), 0);
}

/// The credentials of a host that trusts the rover, and has a legacy peer on this host as an
/// exception.
fn with_an_exception() -> Security {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let rules = Rules {
        loopback: true,
        legacy_peers: vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
    };
    Security::new(crex.credentials(&[&rover]), rules).unwrap()
}

/// Sends a letter as legacy peers do.
fn throw(to: &Party) {
    let mut stream = TcpStream::connect(to.location().address()).unwrap();
    stream
        .write_all(&letter_from("cpp-sender").to_bytes())
        .unwrap();
    stream.shutdown(std::net::Shutdown::Write).unwrap();
}

#[test]
fn a_legacy_peer_may_be_an_exception_and_is_nothing_more() {
    let to = party(with_an_exception());
    throw(&to);
    until_some("its letter", || {
        (to.sink.record.lock().unframed.len() == 1).then_some(())
    });
    assert_refused(&Party::new(), &to);
}

#[test]
fn with_keys_only_legacy_peers_on_loopback_need_none() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    for listen in ["127.0.0.1:0", "[::1]:0"] {
        let gateway = |loopback, processes| {
            let rules = Rules {
                loopback,
                ..Rules::default()
            };
            let mut config = config(&[listen]);
            config.security = Some(Security::new(crex.credentials(&[&rover]), rules).unwrap());
            config.processes = processes;
            Party::with(config)
        };
        let to = gateway(false, false);
        assert_refused(&Party::new(), &to);
        throw(&to);
        until_some("the letter of a legacy peer", || {
            (to.sink.record.lock().unframed.len() == 1).then_some(())
        });
        assert_eq!(to.arrivals(), 0);
        let with_processes = gateway(false, true);
        Party::new().assert_reaches(1, &with_processes);
        let with_loopback = gateway(true, false);
        assert_refused(&Party::new(), &with_loopback);
        let mut stream = TcpStream::connect(with_loopback.location().address()).unwrap();
        // The gateway may close the connection after the first bytes.
        let _ = stream.write_all(&letter_from("cpp-sender").to_bytes());
        until_some("the refusal", || {
            (with_loopback.transport.counters().refused_unproved > 0).then_some(())
        });
        assert_eq!(with_loopback.sink.record.lock().unframed.len(), 0);
    }
}

#[test]
fn a_legacy_peer_beyond_its_rate_limit_is_read_later() {
    let to = TcpTransport::limited(with_an_exception(), |limits| limits.peer_letters = 2);
    let begun = Instant::now();
    for _ in 0..6 {
        throw(&to);
    }
    until_some("its letters", || {
        (to.sink.record.lock().unframed.len() == 6).then_some(())
    });
    // Two at once, and two more per second; no pause is longer than a second.
    let took = begun.elapsed();
    assert!(took > Duration::from_millis(900), "{took:?}");
    assert!(to.transport.counters().held_back > 0);
}

fn a_peer_beyond_its_rate_limit_is_read_later_without_loss<T: Proving>() {
    const RATE: u64 = 4 << 20;
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let there: Party<T> = T::limited(crex.security(&[&rover]), |limits| limits.peer_bytes = RATE);
    let here: Party<T> = T::party(rover.security(&[&crex]));
    let begun = Instant::now();
    let content = "x".repeat(256 << 10);
    for attempt in 1..=48 {
        let parcel = parcel(attempt, content.clone());
        here.send(attempt, there.location(), parcel).unwrap();
    }
    for attempt in 1..=48 {
        assert_eq!(here.conclusion(attempt), accepted(), "{attempt}");
    }
    assert!(there.transport.counters().held_back > 0);
    // Twelve megabytes: four of them at once, with pauses of at most a second.
    let took = begun.elapsed();
    assert!(took > Duration::from_millis(500), "{took:?}");
    assert_eq!(here.transport.counters().held_back, 0);
}

fn a_restarted_gateway_replaces_its_older_connection_at_once<T: Proving>() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let there: Party<T> = T::limited(crex.security(&[&rover]), |limits| {
        limits.max_per_address = 1
    });
    let before: Party<T> = T::party(rover.security(&[&crex]));
    before.assert_reaches(1, &there);
    // It cannot send a goodbye: its connection stays open.
    let after: Party<T> = T::party(rover.security(&[&crex]));
    after.assert_reaches(1, &there);
    assert_eq!(there.transport.counters().connections, 1);
    assert_eq!(there.transport.counters().refused_crowd, 0);
    until_some("the older one is over", || {
        (before.transport.counters().connections == 0).then_some(())
    });
}

/// Connections of a local user: silent ones, some with half a hello, some with a hello, and some
/// that begin a letter of a legacy peer; more than there are slots.
#[test]
fn connections_of_a_local_user_do_not_keep_out_peers_with_keys() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let rules = Rules {
        loopback: false,
        ..Rules::default()
    };
    let security = Security::new(crex.credentials(&[&rover]), rules).unwrap();
    let limits = NetLimits {
        max_connections: 32,
        max_strangers: 8,
        max_reads_per_address: 8,
        max_unread_per_address: 32,
        ..config(&[]).limits
    };
    let mut secured = config(&["127.0.0.1:0"]);
    secured.security = Some(security);
    secured.limits = limits.clone();
    let there = Party::with(secured);
    let address = there.location().address();
    let connect = |said: &[u8]| {
        let mut stream = TcpStream::connect(address).unwrap();
        // The connection may be closed already.
        let _ = stream.write_all(said);
        stream
    };
    let introduced: Vec<TcpStream> = (1..=limits.max_connections as u64)
        .map(|n| connect(&fipa_testbed::frame(1, 1, &common::rogue_hello(n))))
        .collect();
    let half = limits.max_connections as u64 / 2;
    until_some("each has a place or none", || {
        let counters = there.transport.counters();
        (counters.connections == half && counters.refused_crowd >= half).then_some(())
    });
    let letters: Vec<TcpStream> = (0..limits.max_unread_per_address + limits.max_reads_per_address)
        .map(|_| connect(&[0xfe]))
        .collect();
    let silent: Vec<TcpStream> = (0..2 * limits.max_strangers)
        .map(|n| connect(&b"fip"[..n % 4]))
        .collect();
    // A connection that is evicted before the handshake is opened again.
    let here = party(rover.security(&[&crex]));
    let gets_in = |attempt| {
        here.send(attempt, there.location(), parcel(1, "let me in"))
            .unwrap();
        here.conclusion(attempt) == accepted()
    };
    assert!((1..=20).any(gets_in));
    drop((introduced, letters, silent));
}

/// A listener that answers each connection with these bytes and closes it.
fn answering(answer: Vec<u8>) -> Location {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        while let Ok((mut stream, _)) = listener.accept() {
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(&answer);
        }
    });
    Location::new(Kind::Tcp, &at).unwrap()
}

#[test]
fn each_alert_is_told_with_its_own_remedy() {
    let from = party(Host::new(NAME, &[]).security(&[]));
    for (attempt, (alert, name, remedy)) in [
        (40, "handshake_failure (40)", "see its log"),
        (42, "bad_certificate (42)", "`fipa keys trust` there"),
        (43, "unsupported_certificate (43)", "same release of fipa"),
        (44, "certificate_revoked (44)", "`fipa keys renew` here"),
        (45, "certificate_expired (45)", "clock of the peer"),
        (48, "unknown_ca (48)", "`fipa keys trust` there"),
        (51, "decrypt_error (51)", "belong together"),
        (70, "protocol_version (70)", "TLS 1.3"),
        (80, "internal_error (80)", "see the log of the peer"),
        (112, "unrecognized_name (112)", "see its log"),
    ]
    .into_iter()
    .enumerate()
    {
        // A fatal alert in a record of its own (RFC 8446 section 6).
        let to = answering(vec![21, 3, 3, 0, 2, 2, alert]);
        from.send(attempt as u64, &to, parcel(1, "x")).unwrap();
        let Conclusion::NotSent(error) = from.conclusion(attempt as u64) else {
            panic!("{:?}", from.conclusion(attempt as u64));
        };
        assert_tells_alert(&error.detail, name);
        assert!(error.detail.contains(remedy), "{error}");
    }
    // The remedy for this one is about keys.
    let to = answering(vec![21, 3, 3, 0, 2, 2, 116]);
    from.send(100, &to, parcel(1, "x")).unwrap();
    let Conclusion::NotSent(error) = from.conclusion(100) else {
        panic!("{:?}", from.conclusion(100));
    };
    let error_text = "alert certificate_required (116): the peer requires a certificate";
    assert!(error.detail.contains(error_text), "{error}");
}

#[test]
fn only_without_an_alert_are_there_several_possible_causes() {
    let from = party(Host::new(NAME, &[]).security(&[]));
    from.send(1, &answering(Vec::new()), parcel(1, "x"))
        .unwrap();
    let Conclusion::NotSent(error) = from.conclusion(1) else {
        panic!("{:?}", from.conclusion(1));
    };
    for part in [
        "sent no alert",
        "possible causes: this host has keys and the peer has none",
        "no fipa gateway listens there",
    ] {
        assert!(error.detail.contains(part), "{error}");
    }
}
