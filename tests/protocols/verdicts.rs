//! The number of checks per message: one at its sender and one at its receiver.

use std::collections::HashMap;
use std::sync::{LazyLock, Mutex};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};

use super::*;

/// The number of verdicts, by conversation.
static GIVEN: LazyLock<Mutex<HashMap<String, u32>>> = LazyLock::new(Mutex::default);

/// Counts the trace events of checks.
struct Counter;

impl Subscriber for Counter {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.target() == "fipa::agent::checks" && metadata.name() != "span"
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn event(&self, event: &Event<'_>) {
        let mut conversation = Conversation(None);
        event.record(&mut conversation);
        if let Some(id) = conversation.0 {
            *GIVEN.lock().unwrap().entry(id).or_default() += 1;
        }
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

struct Conversation(Option<String>);

impl Visit for Conversation {
    fn record_debug(&mut self, _: &Field, _: &dyn std::fmt::Debug) {}

    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "conversation" {
            self.0 = Some(value.to_owned());
        }
    }
}

fn given(id: &str) -> u32 {
    GIVEN.lock().unwrap().get(id).copied().unwrap_or(0)
}

#[tokio::test(flavor = "multi_thread")]
async fn four_verdicts_for_a_request_and_its_inform() {
    // Checks of other tests in this program count for other conversations.
    let _ = tracing::subscriber::set_global_default(Counter);
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let ask = to(&rover, Performative::Request, &arm, "lift")
        .protocol("fipa-request")
        .conversation_id("counted")
        .build()
        .unwrap();
    rover.send(ask).await.unwrap();
    let asked = next_message(&arm).await.unwrap().into_message();
    let done = arm.reply(&asked, Performative::Inform).build().unwrap();
    arm.send(done).await.unwrap();
    next_message(&rover).await.unwrap();
    assert_eq!(given("counted"), 4);

    // Calls that lead a conversation check its messages themselves, with any `monitor.check`. The
    // checks of `monitor.check` stay at one per side and message.
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let id = request.conversation_id().to_owned();
    let asked = next_message(&arm).await.unwrap();
    let task = arm.take_part(&asked).unwrap();
    task.reply(Reply::Inform("done".into())).await.unwrap();
    request.result().await.unwrap();
    assert_eq!(given(&id), 4);
}
