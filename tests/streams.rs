//! Streams between two hosts: a letter that fails behind a gateway delays no other letter, and letters
//! sent after closing the domain fail as closed.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::sync::Arc;
use std::time::Duration;

use fipa::{Agent, AgentId, Domain, FailureReason, Gateway, Kind, Message, Outcome, Performative};
use support::config;

/// A simulated host: a gateway and one process.
struct Host {
    gateway: Gateway,
    domain: Domain,
}

impl Host {
    async fn open(more: &[&str]) -> Self {
        let set = ["security.insecure=true", "mts.deadline=60s"];
        let config = config(&[&set, more].concat());
        Self {
            gateway: Gateway::open(&config).await.unwrap(),
            domain: Domain::open(&config).await.unwrap(),
        }
    }

    /// Returns the setting by which another host knows this one.
    fn as_peer(&self) -> String {
        let locations = self.gateway.locations();
        let mut tcp = locations.iter().filter(|it| it.kind() == Kind::Tcp);
        let address = tcp.next().unwrap().address();
        format!("discovery.static={{ far = [\"tcp://{address}\"] }}")
    }

    async fn close(self) {
        self.domain.close().await;
        self.gateway.close().await;
    }
}

fn was_refused(outcome: &Outcome) -> bool {
    let refused = FailureReason::Refused;
    matches!(outcome, Outcome::Failed { reason, .. } if *reason == refused)
}

/// Sends letters concurrently to an agent behind a gateway with these rules, and returns the outcomes.
async fn outcomes(rules: &str, performatives: &[Performative]) -> Vec<Outcome> {
    let far = Host::open(&[rules]).await;
    let near = Host::open(&[&far.as_peer()]).await;
    let arm = Arc::new(far.domain.register("arm").await.unwrap());
    let rover = near.domain.register("rover").await.unwrap();
    while near.domain.directory().lookup("arm").is_none() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let reader = Arc::clone(&arm);
    let reading = tokio::spawn(async move { while reader.receive().await.is_ok() {} });
    let mut sending = Vec::new();
    for performative in performatives {
        let message = message(&rover, performative.clone());
        sending.push(rover.send(message));
    }
    let mut outcomes = Vec::new();
    for sent in sending {
        outcomes.push(sent.await.unwrap().0.remove(0).outcome);
    }
    reading.abort();
    drop((arm, rover));
    near.close().await;
    far.close().await;
    outcomes
}

fn message(from: &Agent, performative: Performative) -> Message {
    from.message(performative)
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_that_a_gateway_refuses_delays_no_later_one() {
    let mut performatives = vec![Performative::Inform; 300];
    performatives[10] = Performative::Cancel;
    performatives[11] = Performative::Cancel;
    performatives[200] = Performative::Cancel;
    let rule = "access.deny={ \".*\" = [\"arm performative=cancel\"] }";
    let outcomes = outcomes(rule, &performatives).await;
    for (number, (outcome, performative)) in outcomes.iter().zip(&performatives).enumerate() {
        match performative {
            Performative::Cancel => assert!(was_refused(outcome), "{number}: {outcome}"),
            _ => assert!(outcome.is_success(), "{number}: {outcome}"),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn letters_beyond_the_rate_of_a_gateway_delay_no_others() {
    let outcomes = outcomes("access.rate=50", &vec![Performative::Inform; 300]).await;
    let delivered = outcomes.iter().filter(|outcome| outcome.is_success());
    assert!(delivered.count() >= 50);
    assert!(outcomes.iter().any(was_refused));
    for (number, outcome) in outcomes.iter().enumerate() {
        let ended = outcome.is_success() || was_refused(outcome);
        assert!(ended, "{number}: {outcome}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_sent_after_closing_the_domain_fails_as_closed() {
    let host = Host::open(&[]).await;
    let rover = host.domain.register("rover").await.unwrap();
    let arm = host.domain.register("arm").await.unwrap();
    let late = message(&rover, Performative::Inform);
    host.domain.close().await;
    let outcome = rover.send(late).await.unwrap().0.remove(0).outcome;
    let closed = FailureReason::Closed;
    assert!(
        matches!(&outcome, Outcome::Failed { reason, .. } if *reason == closed),
        "{outcome}"
    );
    drop((rover, arm));
    host.gateway.close().await;
}
