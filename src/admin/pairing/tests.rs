//! Tests of pairings: the decisions with seeded random numbers, then the exchange over pipes and sockets.

use proptest::prelude::*;
use rand_core::{CryptoRng, RngCore};
use tempfile::TempDir;
use tokio::io::{DuplexStream, duplex};

use super::*;
use crate::admin::keys::{KeysError, VALID};

/// Random numbers that a seed repeats.
struct Seeded(fastrand::Rng);

impl RngCore for Seeded {
    fn next_u32(&mut self) -> u32 {
        self.0.u32(..)
    }

    fn next_u64(&mut self) -> u64 {
        self.0.u64(..)
    }

    fn fill_bytes(&mut self, bytes: &mut [u8]) {
        self.0.fill(bytes);
    }

    fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), rand_core::Error> {
        self.0.fill(bytes);
        Ok(())
    }
}

impl CryptoRng for Seeded {}

fn code(text: &str) -> Code {
    text.parse().unwrap()
}

fn greeting(role: Role, digits: &str, seed: u64) -> Greeting {
    Greeting::new(role, &code(digits), Seeded(fastrand::Rng::with_seed(seed)))
}

/// The dialing host, then the listening one, after their hellos.
fn greeted(codes: [&str; 2], seed: u64) -> [Unconfirmed; 2] {
    let dialing = greeting(Role::Dialing, codes[0], seed);
    let listening = greeting(Role::Listening, codes[1], seed + 1);
    let hellos = [*dialing.hello(), *listening.hello()];
    [
        dialing.greeted(&hellos[1]).unwrap(),
        listening.greeted(&hellos[0]).unwrap(),
    ]
}

fn confirmed(seed: u64) -> [Confirmed; 2] {
    let [dialing, listening] = greeted(["123-456-789"; 2], seed);
    let tags = [dialing.confirmation(), listening.confirmation()];
    [
        dialing.confirmed(&tag(&tags[1])).unwrap(),
        listening.confirmed(&tag(&tags[0])).unwrap(),
    ]
}

fn tag(bytes: &[u8]) -> [u8; TAG] {
    bytes.try_into().unwrap()
}

fn is_wrong_code<T>(result: Result<T, PairingError>) -> bool {
    matches!(result, Err(PairingError::WrongCode))
}

fn is_altered<T>(result: Result<T, PairingError>) -> bool {
    matches!(result, Err(PairingError::Altered))
}

#[test]
fn a_code_has_nine_digits_in_groups() {
    let made = Code::random().unwrap();
    let text = made.to_string();
    assert_eq!(code(&text), made);
    assert_eq!(text.len(), 11, "{text}");
    assert_eq!(format!("{made:?}"), "Code");
    assert_eq!(code(" 123 456\t789\r\n"), code("123-456-789"));
    assert_eq!(code("000000007").to_string(), "000-000-007");
    for wrong in ["", "12345678", "1234567890", "12345678x", "１23456789"] {
        assert_eq!(wrong.parse::<Code>(), Err(CodeError), "{wrong}");
    }
}

#[test]
fn hosts_with_one_code_confirm_each_other_and_exchange_messages() {
    for seed in 0..50 {
        let [dialing, listening] = confirmed(seed);
        for (from, to) in [(&dialing, &listening), (&listening, &dialing)] {
            let message = from.tagged(Kind::Certificate, b"certificate");
            let body = to.body(Kind::Certificate, &message).unwrap();
            assert_eq!(body, b"certificate");
        }
    }
}

/// Hosts of two versions of this program must agree on each byte.
#[test]
fn the_messages_do_not_change_between_versions() {
    let [dialing, _] = greeted(["123-456-789"; 2], 1);
    let hex: String = dialing
        .confirmation()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    assert_eq!(
        hex,
        "024040d55d76d664cd8293c8c6a17e03898f9144c38505214cc6e322622f3947"
    );
}

#[test]
fn hosts_with_two_codes_both_notice() {
    for seed in 0..50 {
        let [dialing, listening] = greeted(["123-456-789", "123-456-780"], seed);
        let tags = [dialing.confirmation(), listening.confirmation()];
        assert!(is_wrong_code(dialing.confirmed(&tag(&tags[1]))));
        assert!(is_wrong_code(listening.confirmed(&tag(&tags[0]))));
    }
}

#[test]
fn the_messages_of_a_host_are_refused_when_they_return_to_it() {
    for role in [Role::Dialing, Role::Listening] {
        let own = greeting(role, "123-456-789", 1);
        let hello = *own.hello();
        assert!(matches!(own.greeted(&hello), Err(PairingError::NotPairing)));

        // The same with the side of the other role.
        let own = greeting(role, "123-456-789", 1);
        let mut turned = hello;
        let side = turned.iter().position(|byte| b"AB".contains(byte)).unwrap();
        turned[side] ^= b'A' ^ b'B';
        let own = own.greeted(&turned).unwrap();
        let confirmation = own.confirmation();
        assert!(is_wrong_code(own.confirmed(&tag(&confirmation))));
    }
    for host in confirmed(1) {
        let message = host.tagged(Kind::Certificate, b"certificate");
        assert!(is_altered(host.body(Kind::Certificate, &message)));
    }
}

#[test]
fn a_host_in_the_middle_without_the_code_is_noticed_by_both() {
    for (role, seed) in [(Role::Dialing, 1), (Role::Listening, 2)] {
        let other = match role {
            Role::Dialing => Role::Listening,
            Role::Listening => Role::Dialing,
        };
        let honest = || greeting(role, "123-456-789", seed);
        let between = || greeting(other, "000-000-000", 3);
        let deceived = || honest().greeted(between().hello()).unwrap();
        // The confirmation of the host in the middle, and what it gets from the other honest host and passes on.
        let made = between().greeted(honest().hello()).unwrap().confirmation();
        let [dialing, listening] = greeted(["123-456-789"; 2], 4);
        let passed_on = [made, dialing.confirmation(), listening.confirmation()];
        for confirmation in passed_on {
            assert!(is_wrong_code(deceived().confirmed(&tag(&confirmation))));
        }
    }
}

#[test]
fn a_message_counts_in_its_pairing_for_its_kind_only() {
    let [dialing, listening] = confirmed(1);
    let [_, other] = confirmed(10);
    let message = dialing.tagged(Kind::Verdict, &[1]);
    assert_eq!(listening.body(Kind::Verdict, &message).unwrap(), [1]);
    assert!(is_altered(listening.body(Kind::Certificate, &message)));
    assert!(is_altered(listening.body(Kind::Confirmation, &message)));
    assert!(is_altered(other.body(Kind::Verdict, &message)));
    for at in 0..message.len() {
        let mut changed = message.clone();
        changed[at] ^= 1;
        assert!(is_altered(listening.body(Kind::Verdict, &changed)), "{at}");
        assert!(is_altered(listening.body(Kind::Verdict, &message[..at])));
    }
}

#[test]
fn each_changed_bit_of_a_hello_prevents_the_confirmation() {
    for bit in 0..HELLO * 8 {
        let dialing = greeting(Role::Dialing, "123-456-789", 1);
        let listening = greeting(Role::Listening, "123-456-789", 2);
        let mut hello = *dialing.hello();
        hello[bit / 8] ^= 1 << (bit % 8);
        let dialing = dialing.greeted(listening.hello()).unwrap();
        match listening.greeted(&hello) {
            Ok(listening) => {
                let confirmation = dialing.confirmation();
                assert!(is_wrong_code(listening.confirmed(&tag(&confirmation))));
            }
            Err(error) => assert!(matches!(error, PairingError::NotPairing), "{error:?}"),
        }
    }
}

/// Points of small order would make the key known without the code, if the code were not subtracted from them.
#[test]
fn points_of_small_order_are_no_way_around_the_code() {
    let mut identity = [0; 32];
    identity[0] = 1;
    let mut order_2 = [0xff; 32];
    (order_2[0], order_2[31]) = (0xec, 0x7f);
    for point in [identity, order_2, [0; 32]] {
        let listening = greeting(Role::Listening, "123-456-789", 1);
        let dialing = greeting(Role::Dialing, "123-456-788", 2);
        let theirs = *listening.hello();
        let mut hello = *dialing.hello();
        hello[HELLO - 32..].copy_from_slice(&point);
        let listening = listening.greeted(&hello).unwrap();
        let confirmation = dialing.greeted(&theirs).unwrap().confirmation();
        assert!(is_wrong_code(listening.confirmed(&tag(&confirmation))));
    }
}

proptest! {
    #[test]
    fn random_bytes_confirm_nothing(
        bytes in prop::array::uniform32(any::<u8>()),
        confirmation in prop::array::uniform32(any::<u8>()),
        message in prop::collection::vec(any::<u8>(), 0..200),
        seed: u64,
    ) {
        for role in [Role::Dialing, Role::Listening] {
            let own = greeting(role, "123-456-789", seed);
            let other = match role {
                Role::Dialing => b'B',
                Role::Listening => b'A',
            };
            let mut hello = *own.hello();
            hello[HELLO - 33] = other;
            hello[HELLO - 32..].copy_from_slice(&bytes);
            if let Ok(own) = own.greeted(&hello) {
                prop_assert!(is_wrong_code(own.confirmed(&confirmation)));
            }
        }
        for host in confirmed(seed >> 1) {
            prop_assert!(is_altered(host.body(Kind::Certificate, &message)));
        }
    }
}

/// A host with keys in a temporary directory.
struct Keyed {
    _dir: TempDir,
    keys: Keys,
    own: Certificate,
}

fn keyed(name: &str) -> Keyed {
    let dir = tempfile::tempdir().unwrap();
    let keys = Keys::at(dir.path().join("keys"));
    let own = keys.init(name, &[], VALID).unwrap();
    Keyed {
        _dir: dir,
        keys,
        own,
    }
}

/// Two ends of a connection that has room for all messages.
fn pipe() -> (DuplexStream, DuplexStream) {
    duplex(1 << 20)
}

#[tokio::test]
async fn hosts_trust_each_other_after_the_exchange() {
    let (rover, crex) = (keyed("rover-mts"), keyed("crex-mts"));
    let [dialing, listening] = confirmed(1);
    let (near, far) = pipe();
    let (ours, theirs) = tokio::join!(
        exchange((near, dialing), &rover.keys, &rover.own),
        exchange((far, listening), &crex.keys, &crex.own),
    );
    let (ours, theirs) = (ours.unwrap(), theirs.unwrap());
    assert!(ours.mutual && theirs.mutual);
    assert_eq!(
        (&ours.certificate, &theirs.certificate),
        (&crex.own, &rover.own)
    );
    assert_eq!(rover.keys.trusted().unwrap(), [crex.own]);
    assert_eq!(crex.keys.trusted().unwrap(), [rover.own]);
}

#[tokio::test]
async fn a_revoked_certificate_is_refused_and_the_other_host_learns_it() {
    let (rover, crex) = (keyed("rover-mts"), keyed("crex-mts"));
    rover.keys.trust_der(crex.own.der()).unwrap();
    rover.keys.revoke("crex-mts").unwrap();
    let [dialing, listening] = confirmed(1);
    let (near, far) = pipe();
    let (ours, theirs) = tokio::join!(
        exchange((near, dialing), &rover.keys, &rover.own),
        exchange((far, listening), &crex.keys, &crex.own),
    );
    assert!(
        matches!(ours, Err(PairingError::Keys(KeysError::Revoked(_)))),
        "{ours:?}"
    );
    assert!(!theirs.unwrap().mutual);
    assert_eq!(rover.keys.trusted().unwrap(), []);
}

#[tokio::test]
async fn a_host_does_not_pair_with_itself() {
    let rover = keyed("rover-mts");
    let [dialing, listening] = confirmed(1);
    let (near, far) = pipe();
    let (ours, theirs) = tokio::join!(
        exchange((near, dialing), &rover.keys, &rover.own),
        exchange((far, listening), &rover.keys, &rover.own),
    );
    for result in [ours, theirs] {
        assert!(
            matches!(result, Err(PairingError::Keys(KeysError::Own))),
            "{result:?}"
        );
    }
}

/// The result of a host to whose exchange the other side contributes these bytes and then its end.
async fn exchanged_with(
    bytes: &[u8],
    host: Confirmed,
    rover: &Keyed,
) -> Result<Paired, PairingError> {
    let (near, mut far) = pipe();
    far.write_all(bytes).await.unwrap();
    far.shutdown().await.unwrap();
    exchange((near, host), &rover.keys, &rover.own).await
}

#[tokio::test]
async fn certificates_that_are_cut_changed_too_long_or_none_are_not_trusted() {
    let (rover, crex) = (keyed("rover-mts"), keyed("crex-mts"));
    let message = |body: &[u8]| {
        let [dialing, listening] = confirmed(1);
        let length = u32::try_from(body.len()).unwrap().to_be_bytes();
        let message = listening.tagged(Kind::Certificate, body);
        (dialing, [&length, message.as_slice()].concat())
    };
    let der = crex.own.der();
    let (_, whole) = message(der);
    for at in (0..whole.len()).step_by(3) {
        let (host, _) = message(der);
        let cut = exchanged_with(&whole[..at], host, &rover).await;
        assert!(matches!(cut, Err(PairingError::Ended(_))), "{at}: {cut:?}");
        let (host, _) = message(der);
        let mut changed = whole.clone();
        changed[at] ^= 0x10;
        exchanged_with(&changed, host, &rover).await.unwrap_err();
    }
    let (host, _) = message(der);
    let long = exchanged_with(&u32::MAX.to_be_bytes(), host, &rover).await;
    assert!(matches!(long, Err(PairingError::TooLong(_))), "{long:?}");
    let (host, none) = message(b"none");
    let none = exchanged_with(&none, host, &rover).await;
    assert!(
        matches!(none, Err(PairingError::Keys(KeysError::Certificate(_)))),
        "{none:?}"
    );
    assert_eq!(rover.keys.trusted().unwrap(), []);

    // A host that ends after its certificate has authenticated itself. It is trusted, and may not trust this one.
    let (host, _) = message(der);
    let silent = exchanged_with(&whole, host, &rover).await.unwrap();
    assert!(!silent.mutual);
}

/// Otherwise a host could test a code on each of many connections.
#[tokio::test]
async fn the_listening_host_confirms_nothing_before_the_dialing_host() {
    let (near, mut far) = pipe();
    let dialing = greeting(Role::Dialing, "123-456-789", 1);
    far.write_all(dialing.hello()).await.unwrap();
    far.shutdown().await.unwrap();
    let listened = listen_to(near, code("123-456-789")).await;
    assert!(matches!(listened, Err(PairingError::Ended(_))));
    drop(listened);
    let mut sent = Vec::new();
    far.read_to_end(&mut sent).await.unwrap();
    assert_eq!(sent.len(), HELLO);
}

fn listener(host: &Keyed) -> (Listener, String) {
    let listener = Listener::open(&host.keys, 0).unwrap();
    let address = format!("127.0.0.1:{}", listener.port);
    (listener, address)
}

#[tokio::test]
async fn silent_connections_and_other_protocols_do_not_disturb_a_pairing() {
    let (rover, crex) = (keyed("rover-mts"), keyed("crex-mts"));
    let (listener, address) = listener(&crex);
    let code = listener.code().clone();
    let listening = tokio::spawn(listener.pair());
    let mut strangers = Vec::new();
    for number in 0..3 * MAX_CONNECTIONS {
        let mut stranger = TcpStream::connect(&address).await.unwrap();
        match number % 3 {
            0 => {}
            // It gets a hello, and sends no confirmation.
            1 => {
                let greeting = Greeting::new(Role::Dialing, &code, OsRng);
                stranger.write_all(greeting.hello()).await.unwrap();
            }
            _ => stranger.write_all(&[b'x'; HELLO]).await.unwrap(),
        }
        strangers.push(stranger);
    }
    let dialed = dial(&rover.keys, &address, &code).await.unwrap();
    let listened = listening.await.unwrap().unwrap();
    assert!(dialed.mutual && listened.mutual);
    // Those that were still open are closed, and so is the port.
    for mut stranger in strangers {
        let mut rest = Vec::new();
        let _ = stranger.read_to_end(&mut rest).await;
        assert!([0, HELLO].contains(&rest.len()), "{rest:?}");
    }
    let again = dial(&rover.keys, &address, &code).await;
    assert!(matches!(again, Err(PairingError::Connect { .. })));
}

/// The dialing host learns that the versions differ.
#[tokio::test]
async fn a_host_of_another_version_gets_a_hello() {
    let (near, mut far) = pipe();
    let mut hello = *greeting(Role::Dialing, "123-456-789", 1).hello();
    hello[13] = b'2';
    far.write_all(&hello).await.unwrap();
    let listened = listen_to(near, code("123-456-789")).await;
    assert!(matches!(listened, Err(PairingError::NotPairing)));
    let ours: [u8; HELLO] = read(&mut far).await.unwrap();
    assert!(ours.starts_with(b"fipa pairing 1"));
}

#[tokio::test]
async fn a_wrong_code_ends_the_pairing_on_both_hosts() {
    let (rover, crex) = (keyed("rover-mts"), keyed("crex-mts"));
    let (listener, address) = listener(&crex);
    let right = listener.code().clone();
    let wrong = code(if right == code("123456789") {
        "123456788"
    } else {
        "123456789"
    });
    let (dialed, listened) = tokio::join!(dial(&rover.keys, &address, &wrong), listener.pair());
    assert!(is_wrong_code(dialed));
    assert!(is_wrong_code(listened));
    let again = dial(&rover.keys, &address, &right).await;
    assert!(matches!(again, Err(PairingError::Connect { .. })));
    assert_eq!(rover.keys.trusted().unwrap(), []);
    assert_eq!(crex.keys.trusted().unwrap(), []);
}

#[tokio::test]
async fn a_pairing_ends_after_its_time() {
    let crex = keyed("crex-mts");
    let (mut listener, _) = listener(&crex);
    assert!(listener.until > Instant::now() + OPEN / 2);
    listener.until = Instant::now();
    let listened = listener.pair().await;
    assert!(matches!(listened, Err(PairingError::Expired(_))));
}

#[tokio::test]
async fn a_host_without_keys_neither_listens_nor_dials() {
    let dir = tempfile::tempdir().unwrap();
    let keys = Keys::at(dir.path());
    let listened = Listener::open(&keys, 0);
    let dialed = dial(&keys, "127.0.0.1:1", &code("123456789")).await;
    let is_missing =
        |error: &PairingError| matches!(error, PairingError::Keys(KeysError::Missing(_)));
    assert!(is_missing(&listened.unwrap_err()));
    assert!(is_missing(&dialed.unwrap_err()));
}

/// The dialing host, too, is told that another program listens there.
#[tokio::test]
async fn another_protocol_is_no_wrong_code() {
    let (near, mut far) = pipe();
    far.write_all(&[b'x'; HELLO]).await.unwrap();
    let dialed = dialed(near, &code("123-456-789")).await;
    assert!(matches!(dialed, Err(PairingError::NotPairing)));
}
