//! The gateway of a host, and the watcher of its letters.

use std::sync::Arc;

use fipa::Gateway;
use fipa::admin::watch::{Event, Passage, WatchOptions, Watcher};
use fipa::locks::fences_of;

use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Reporter, micros};

/// Runs the gateway of a host.
pub(crate) async fn gateway(part: &Part) -> Result<(), Failed> {
    serve(part, Gateway::open(&part.config()?).await?).await;
    Ok(())
}

/// Runs this gateway as that of a host, until standard input ends.
pub async fn serve(part: &Part, gateway: Gateway) {
    let reporter = Reporter::new(&part.name);
    let locations = gateway.locations();
    let locations = locations.iter().map(ToString::to_string).collect();
    reporter.claim(Claim::Listening { locations });
    reporter.claim(Claim::Ready);
    Stop::default().requested().await;
    gateway.close().await;
}

/// Reports the letters of a host.
pub(crate) async fn watcher(part: &Part) -> Result<(), Failed> {
    let mut watcher = Watcher::open(&part.config()?, WatchOptions::default()).await?;
    let reporter = Reporter::new(&part.name);
    reporter.claim(Claim::Ready);
    let mut stop = Stop::default();
    loop {
        tokio::select! {
            event = watcher.next() => if let Event::Letter(passage) = event {
                report(&reporter, &passage);
            },
            () = stop.requested() => break,
        }
    }
    while let Some(event) = watcher.finish() {
        if let Event::Letter(passage) = event {
            report(&reporter, &passage);
        }
    }
    Ok(())
}

fn report(reporter: &Reporter, passage: &Arc<Passage>) {
    // The watcher of the other host reports it.
    let Some(message) = passage.message.as_ref().filter(|_| !passage.from_elsewhere) else {
        return;
    };
    let text = |value: Option<&str>| value.unwrap_or_default().to_owned();
    let fences = fences_of(message).unwrap_or_default();
    let letter = Claim::Letter {
        sender: text(message.sender().map(fipa::AgentId::name)),
        receiver: passage.receiver.to_string(),
        performative: message.performative().to_string(),
        protocol: text(message.protocol()),
        conversation: text(message.conversation_id()),
        fences: fences.iter().map(ToString::to_string).collect(),
    };
    reporter.claim_at(micros(passage.at), letter);
}
