//! Counts the letters of a domain by protocol. The counted processes take no part in it.

use std::collections::BTreeMap;
use std::time::Duration;

use fipa::Config;
use fipa::admin::watch::{Event as WatchEvent, WatchOptions, Watcher};
use tokio::io::{BufReader, Lines, Stdin};
use tokio::time::Instant;

use super::agent::{Running, orders, runtime};
use super::orders::{Event, Peer, execute_orders};
use crate::error::chain_text;

/// Time without a letter after which the count is complete. A watcher reports a letter at most a quarter
/// of a second after its first record.
const QUIET: Duration = Duration::from_millis(500);

struct Counting {
    watcher: Watcher,
    orders: Lines<BufReader<Stdin>>,
    by_protocol: BTreeMap<String, u64>,
    lost: u64,
}

pub(super) fn play(config: &Config) -> Result<(), String> {
    let runtime = runtime()?;
    let opened = runtime.block_on(Watcher::open(config, WatchOptions::default()));
    let counting = Counting {
        watcher: opened.map_err(chain_text)?,
        orders: runtime.block_on(async { orders() }),
        by_protocol: BTreeMap::new(),
        lost: 0,
    };
    let mut running = Running {
        agent: Some(counting),
        runtime,
    };
    execute_orders(&mut running, String::new());
    let Running { agent, runtime } = running;
    drop(agent);
    runtime.shutdown_background();
    Ok(())
}

impl Peer for Running<Counting> {
    fn next_order(&mut self) -> Option<String> {
        self.run(|mut counting| async move {
            let line = counting.next_order().await;
            (counting, line)
        })
        .ok()?
    }

    fn count_letters(&mut self, quiet: Option<String>) -> Result<Event, String> {
        self.run(move |mut counting| async move {
            if let Some(protocol) = quiet {
                counting.wait_for_quiet(&protocol).await;
            }
            let by_protocol = std::mem::take(&mut counting.by_protocol);
            let lost = std::mem::take(&mut counting.lost);
            (counting, Event::Letters { by_protocol, lost })
        })
    }
}

impl Counting {
    async fn next_order(&mut self) -> Option<String> {
        loop {
            tokio::select! {
                event = self.watcher.next() => self.add(&event),
                line = self.orders.next_line() => return line.ok()?,
            }
        }
    }

    async fn wait_for_quiet(&mut self, protocol: &str) {
        let mut until = Instant::now() + QUIET;
        while let Ok(event) = tokio::time::timeout_at(until, self.watcher.next()).await {
            let before = self.by_protocol.get(protocol).copied();
            self.add(&event);
            if self.by_protocol.get(protocol).copied() != before {
                until = Instant::now() + QUIET;
            }
        }
    }

    fn add(&mut self, event: &WatchEvent) {
        match event {
            // The watcher of the other host counts its own letters.
            WatchEvent::Letter(letter) if !letter.from_elsewhere => {
                let message = letter.message.as_ref();
                let protocol = message.and_then(|message| message.protocol());
                let count = self
                    .by_protocol
                    .entry(protocol.unwrap_or_default().to_owned());
                *count.or_default() += 1;
            }
            WatchEvent::Lost { records, .. } => self.lost += records,
            _ => {}
        }
    }
}
