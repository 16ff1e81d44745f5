//! The rules of `[access]` between agents of one host, without a gateway: the process of the receiver
//! applies them.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa::error::TransportErrorKind;
use fipa::{
    Agent, AgentId, Config, Domain, Entry, FailureReason, Gateway, Kind, Message, Outcome,
    Performative,
};
use fipa_mts::letter_for;
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, LegacySource, Location, Parcel,
    Reaction, Sink, Stream, Transport as _,
};
use fipa_transport_net::{Identity, TcpConfig, TcpTransport};

/// Opens two memberships in a new domain: one without rules, and one with these rules.
async fn host(kind: Kind, rules: &str) -> (Domain, Domain) {
    let mark = support::mark();
    let config = |more: &[&str]| {
        let mut set = vec![
            format!("domain=acc-{mark}"),
            format!("mts.transports={kind}"),
            "transport.tcp.processes=true".to_owned(),
        ];
        set.extend(more.iter().map(|it| (*it).to_owned()));
        support::load(set)
    };
    let lax = Domain::open(&config(&[])).await.unwrap();
    (lax, Domain::open(&config(&[rules])).await.unwrap())
}

async fn send(from: &Agent, to: &str, performative: Performative) -> Outcome {
    let message = from
        .message(performative)
        .receiver(AgentId::new(to).unwrap())
        .build()
        .unwrap();
    let delivery = from.send(message).await.unwrap().0.remove(0);
    delivery.outcome
}

/// Returns the reason of a refusal.
fn refused(outcome: &Outcome) -> Option<String> {
    match outcome {
        Outcome::Failed {
            reason: FailureReason::Refused,
            attempts,
        } => {
            let attempt = attempts.last().unwrap();
            assert_eq!(attempt.error.fault, TransportErrorKind::Refused);
            Some(attempt.error.to_string())
        }
        _ => None,
    }
}

async fn next(agent: &Agent) -> Message {
    let received = tokio::time::timeout(Duration::from_secs(60), agent.receive()).await;
    received.unwrap().unwrap().into_message()
}

async fn rules_are_kept(kind: Kind) {
    let rules = "access.deny={ \"ro.*\" = [\"arm performative=request\"] }";
    let (lax, strict) = host(kind, rules).await;
    let (rover, crex) = (
        lax.register("rover").await.unwrap(),
        lax.register("crex").await.unwrap(),
    );
    let (arm, leg) = (
        strict.register("arm").await.unwrap(),
        strict.register("leg").await.unwrap(),
    );
    for (from, to, performative) in [
        (&rover, "arm", Performative::Inform),
        (&rover, "leg", Performative::Request),
        (&crex, "arm", Performative::Request),
        // A process applies its rules to received letters, not to sent ones.
        (&arm, "rover", Performative::Request),
    ] {
        let outcome = send(from, to, performative).await;
        assert!(outcome.is_success(), "{} to {to}: {outcome}", from.name());
    }
    let outcome = send(&rover, "arm", Performative::Request).await;
    let why = refused(&outcome).unwrap_or_else(|| panic!("{outcome}"));
    assert!(why.contains("a rule denies it (access.deny)"), "{why}");
    // Its sender also gets a failure message, and the receiver gets no letter.
    assert_eq!(next(&rover).await.sender().unwrap().name(), "arm");
    let failure = next(&rover).await;
    assert_eq!(*failure.performative(), Performative::Failure);
    let text = String::from_utf8_lossy(failure.content().unwrap()).into_owned();
    assert!(text.contains("refused"), "{text}");
    assert_eq!(*next(&arm).await.performative(), Performative::Inform);
    assert_eq!(*next(&arm).await.performative(), Performative::Request);
    assert!(arm.try_receive().unwrap().is_none());
    assert_eq!(*next(&leg).await.performative(), Performative::Request);
    drop((rover, crex, arm, leg));
    lax.close().await;
    strict.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn rules_are_kept_in_shared_memory() {
    rules_are_kept(Kind::Shm).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn rules_are_kept_over_unix_domain_sockets() {
    rules_are_kept(Kind::Unix).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn rules_are_kept_over_tcp() {
    rules_are_kept(Kind::Tcp).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sender_beyond_its_rate_is_refused_and_others_are_not() {
    const RATE: usize = 5;
    let (lax, strict) = host(Kind::Shm, "access.rate=5").await;
    let (rover, crex) = (
        lax.register("rover").await.unwrap(),
        lax.register("crex").await.unwrap(),
    );
    let arm = strict.register("arm").await.unwrap();
    let (begun, mut taken, mut last) = (Instant::now(), 0, None);
    while last.is_none() {
        let outcome = send(&rover, "arm", Performative::Inform).await;
        last = refused(&outcome);
        taken += usize::from(outcome.is_success());
        // A slow machine may send fewer letters than the rate, and then none is refused.
        assert!(begun.elapsed() < Duration::from_secs(60), "never refused");
    }
    assert!(last.unwrap().contains("access.rate"));
    let most = RATE as f64 * (1.0 + begun.elapsed().as_secs_f64());
    assert!(taken >= RATE && taken as f64 <= most, "{taken} of {most}");
    assert!(send(&crex, "arm", Performative::Inform).await.is_success());
    drop((rover, crex, arm));
    lax.close().await;
    strict.close().await;
}

/// Stores the conclusion that the forging peer gets.
#[derive(Default)]
struct StoredConclusion(parking_lot::Mutex<Option<Conclusion>>);

impl Sink for StoredConclusion {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: fipa::Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, _: AttemptId, conclusion: Conclusion) {
        *self.0.lock() = Some(conclusion);
    }
}

/// A service of another host with this name and incarnation, without keys.
fn peer(name: &str, incarnation: Incarnation) -> TcpConfig {
    let identity = Identity {
        name: name.to_owned(),
        incarnation,
        domain: "any".to_owned(),
        host: "any".to_owned(),
    };
    let mut config = TcpConfig::new(Vec::new(), identity);
    config.processes = true;
    config
}

/// Has this peer send a letter of this sender to an agent, over TCP to one of these locations. Returns the
/// answer.
async fn hand_over(peer: TcpConfig, sender: &str, to: &Entry, at: &[Location]) -> Conclusion {
    let transport = TcpTransport::new(peer, tokio::runtime::Handle::current());
    let stored = Arc::new(StoredConclusion::default());
    transport.listen(stored.clone()).unwrap();
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new(sender).unwrap())
        .receiver(AgentId::new(&*to.name).unwrap())
        .build()
        .unwrap();
    let parcel = Parcel {
        receiver: Arc::clone(&to.name),
        // A registration that the directory does not know: one that it knows belongs to its own link.
        stream: Stream::between(Incarnation::random(), to.incarnation),
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(letter_for(&message, SystemTime::now()).unwrap()),
    };
    let at = at.iter().find(|it| it.kind() == Kind::Tcp);
    transport.post(AttemptId(1), at.unwrap(), parcel).unwrap();
    let began = Instant::now();
    loop {
        if let Some(conclusion) = stored.0.lock().take() {
            return conclusion;
        }
        assert!(began.elapsed() < Duration::from_secs(60));
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

/// Opens a membership whose process also listens on TCP, with these rules.
fn listening(rules: &str) -> Config {
    support::load([
        &*format!("domain=acc-{}", support::mark()),
        "discovery.mdns=false",
        "transport.tcp.processes=true",
        rules,
    ])
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_with_a_line_break_in_the_name_of_its_sender_is_refused() {
    for rules in [
        "access.deny={ \".*\" = [\"arm\"] }",
        "access.deny={ \"x.*\" = [\"arm\"] }",
        // No rule at all.
        "access.rate=0",
    ] {
        let strict = Domain::open(&listening(rules)).await.unwrap();
        let arm = strict.register("arm").await.unwrap();
        let entry = strict.directory().lookup("arm").unwrap();
        let peer = peer("crex-mts", Incarnation::random());
        let refused = hand_over(peer, "rov\n_1", &entry, &entry.locations).await;
        let Conclusion::Answered(Answer::Failed { reason, detail }) = &refused else {
            panic!("{rules}: {refused:?}")
        };
        assert_eq!(*reason, FailureReason::Refused);
        assert!(
            detail.contains(r#""rov\u{a}_1" has the character U+000A"#),
            "{detail}"
        );
        assert!(arm.try_receive().unwrap().is_none());
        drop(arm);
        strict.close().await;
    }
}

/// The certificate of the peer covers the sender.
#[cfg(feature = "secure")]
#[tokio::test(flavor = "multi_thread")]
async fn a_certified_peer_evades_no_rule_by_a_line_break() {
    use fipa::admin::keys::{Keys, VALID};
    use fipa_transport_net::secure::{Rules, Security};

    let home = tempfile::tempdir().unwrap();
    let [own, theirs] = ["own", "theirs"].map(|keys| Keys::at(home.path().join(keys)));
    own.init("brake-mts", &[], VALID).unwrap();
    theirs.init("x-mts", &["x*".to_owned()], VALID).unwrap();
    for (keys, other) in [(&own, &theirs), (&theirs, &own)] {
        keys.trust(&std::fs::read(other.own_file()).unwrap())
            .unwrap();
    }
    let config = support::load([
        format!("domain=acc-{}", support::mark()),
        "mts.name=brake-mts".to_owned(),
        "discovery.mdns=false".to_owned(),
        format!("security.keys={}", own.dir().display()),
        "security.loopback=true".to_owned(),
        "access.deny={ \".*\" = [\"brake\"] }".to_owned(),
    ]);
    let gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    let brake = domain.register("brake").await.unwrap();
    let entry = domain.directory().lookup("brake").unwrap();
    for (sender, why) in [("x_1", "access.deny"), ("x\n_1", "U+000A")] {
        let credentials = theirs.credentials_of("x-mts").unwrap();
        let rules = Rules {
            loopback: true,
            ..Rules::default()
        };
        let mut peer = peer("x-mts", Incarnation::random());
        peer.processes = false;
        peer.security = Some(Security::new(credentials, rules).unwrap());
        let refused = hand_over(peer, sender, &entry, &gateway.locations()).await;
        let Conclusion::Answered(Answer::Failed { reason, detail }) = &refused else {
            panic!("{sender:?}: {refused:?}")
        };
        assert_eq!(*reason, FailureReason::Refused);
        assert!(detail.contains(why), "{detail}");
    }
    assert!(brake.try_receive().unwrap().is_none());
    drop(brake);
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_forged_name_of_the_gateway_is_refused_over_tcp() {
    let domain = format!("domain=acc-{}-gateway", std::process::id());
    let config = |more: &[&str]| {
        let set = [&*domain, "discovery.mdns=false", "mts.name=door-mts"];
        let set = set.iter().chain(more).map(|it| (*it).to_owned());
        support::load(set)
    };
    let gateway = Gateway::open(&config(&[])).await.unwrap();
    let rules = config(&[
        "transport.tcp.processes=true",
        "access.deny={ \".*\" = [\"arm\"] }",
    ]);
    let strict = Domain::open(&rules).await.unwrap();
    let arm = strict.register("arm").await.unwrap();
    let entry = gateway.directory().lookup("arm").unwrap();
    let forged = async |incarnation, entry: &Entry| {
        let name = gateway.name();
        hand_over(peer(name, incarnation), name, entry, &entry.locations).await
    };
    // No other peer can introduce itself with the incarnation of the gateway.
    let refused = forged(gateway.incarnation(), &entry).await;
    let Conclusion::NotSent(error) = &refused else {
        panic!("{refused:?}")
    };
    assert_eq!(error.fault, TransportErrorKind::Refused, "{error}");
    let refused = forged(Incarnation::random(), &entry).await;
    let Conclusion::Answered(Answer::Failed { reason, detail }) = &refused else {
        panic!("{refused:?}")
    };
    assert_eq!(*reason, FailureReason::Refused);
    assert!(detail.contains("access.deny"), "{detail}");
    assert!(arm.try_receive().unwrap().is_none());
    // A process listens on TCP only if transport.tcp.processes is true.
    let quiet = Domain::open(&config(&[])).await.unwrap();
    let leg = quiet.register("leg").await.unwrap();
    let entry = gateway.directory().lookup("leg").unwrap();
    let kinds: Vec<Kind> = entry.locations.iter().map(|it| it.kind()).collect();
    assert_eq!(kinds, [Kind::Shm, Kind::Unix]);
    drop((arm, leg));
    quiet.close().await;
    strict.close().await;
    gateway.close().await;
}
