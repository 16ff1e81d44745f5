//! The rules of `[access]` between agents of one host, which have no gateway between them: who gets
//! a letter holds its sender to them.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use fipa::config::Sources;
use fipa::{
    Agent, AgentId, Config, Domain, FailureReason, Kind, Message, Outcome, Performative, WayFault,
};

/// Two processes' memberships in a domain of their own: one without rules, and one with these.
async fn host(kind: Kind, rules: &str) -> (Domain, Domain) {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let config = |more: &[&str]| {
        let mut set = vec![
            format!("domain=acc-{}-{number}", std::process::id()),
            format!("mts.transports={kind}"),
        ];
        set.extend(more.iter().map(|it| (*it).to_owned()));
        let sources = Sources {
            set,
            ..Sources::default()
        };
        Config::load(&sources).unwrap()
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

/// Why it was refused, if it was.
fn refused(outcome: &Outcome) -> Option<String> {
    match outcome {
        Outcome::Failed {
            reason: FailureReason::Refused,
            attempts,
        } => {
            let attempt = attempts.last().unwrap();
            assert_eq!(attempt.error.fault, WayFault::Refused);
            Some(attempt.error.to_string())
        }
        _ => None,
    }
}

async fn next(agent: &Agent) -> Message {
    let received = tokio::time::timeout(Duration::from_secs(60), agent.receive()).await;
    received.unwrap().unwrap().message
}

async fn rules_are_kept(kind: Kind) {
    let rules = "access.deny={ \"ro.*\" = [\"arm performative=request\"] }";
    let (lax, strict) = host(kind, rules).await;
    let (rover, crex) = (
        lax.register("rover").unwrap(),
        lax.register("crex").unwrap(),
    );
    let (arm, leg) = (
        strict.register("arm").unwrap(),
        strict.register("leg").unwrap(),
    );
    for (from, to, performative) in [
        (&rover, "arm", Performative::Inform),
        (&rover, "leg", Performative::Request),
        (&crex, "arm", Performative::Request),
        // Nobody is refused what is sent, but what comes.
        (&arm, "rover", Performative::Request),
    ] {
        let outcome = send(from, to, performative).await;
        assert!(outcome.is_success(), "{} to {to}: {outcome}", from.name());
    }
    let outcome = send(&rover, "arm", Performative::Request).await;
    let why = refused(&outcome).unwrap_or_else(|| panic!("{outcome}"));
    assert!(why.contains("a rule denies it (access.deny)"), "{why}");
    // Its sender is told in FIPA's words, too, and nothing has come.
    assert_eq!(next(&rover).await.sender().unwrap().name(), "arm");
    let failure = next(&rover).await;
    assert_eq!(*failure.performative(), Performative::Failure);
    let told = String::from_utf8_lossy(failure.content().unwrap()).into_owned();
    assert!(told.contains("refused"), "{told}");
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
async fn rules_are_kept_over_tcp() {
    rules_are_kept(Kind::Tcp).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn who_sends_too_much_is_refused_and_others_are_not() {
    const RATE: usize = 5;
    let (lax, strict) = host(Kind::Shm, "access.rate=5").await;
    let (rover, crex) = (
        lax.register("rover").unwrap(),
        lax.register("crex").unwrap(),
    );
    let arm = strict.register("arm").unwrap();
    let (begun, mut taken, mut last) = (Instant::now(), 0, None);
    while last.is_none() {
        let outcome = send(&rover, "arm", Performative::Inform).await;
        last = refused(&outcome);
        taken += usize::from(outcome.is_success());
        // Sent more slowly than that, a letter is never too many.
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
