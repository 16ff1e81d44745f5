//! The watcher's side of the connections: accepts processes and receives their records.

use std::time::Duration;

use bytes::Bytes;
use fipa_mts::watch::record::{MAX_LEN, Wish};
use fipa_mts::watch::{Record, RecordError, RecordSource};
use fipa_transport::{DomainUsers, log_limit};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use super::socket;

/// An event on the connection of a process.
pub(super) enum ProcessEvent {
    Begin(RecordSource, String),
    Record(RecordSource, Record),
    Malformed(RecordSource, RecordError),
    End(RecordSource),
}

/// Maximum number of connected processes.
const MAX_PROCESSES: usize = 1024;

/// Accepts processes and forwards their events, until it is aborted.
pub(super) async fn run(
    listener: UnixListener,
    users: DomainUsers,
    wish: Wish,
    events: mpsc::Sender<ProcessEvent>,
) {
    let mut processes = JoinSet::new();
    let mut number = 0;
    loop {
        while processes.try_join_next().is_some() {}
        match listener.accept().await {
            Ok((process, _)) if processes.len() < MAX_PROCESSES => {
                number += 1;
                let source = RecordSource(number);
                processes.spawn(listen(process, users, source, wish, events.clone()));
            }
            Ok(_) => log_limit::warn!(
                "refused a process: {MAX_PROCESSES} processes, the maximum, are watched already"
            ),
            Err(error) => {
                log_limit::warn!(%error, "cannot accept the connection of a process; retrying");
                // The cause may persist, for example a lack of descriptors: avoids a busy loop.
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

async fn listen(
    process: UnixStream,
    users: DomainUsers,
    source: RecordSource,
    wish: Wish,
    events: mpsc::Sender<ProcessEvent>,
) {
    // The directory is private, but records must be from users of the domain in any case.
    let peer = match process.peer_cred() {
        Ok(peer) if users.admit(peer.uid()) => peer,
        _ => return,
    };
    let name = format!("process {}", peer.pid().unwrap_or_default());
    let Ok(process) = socket::accepted(process) else {
        return;
    };
    if process.send(&wish.to_bytes()).await.is_err() {
        return;
    }
    // Fails if the watcher was dropped.
    if events
        .send(ProcessEvent::Begin(source, name))
        .await
        .is_err()
    {
        return;
    }
    let mut buffer = vec![0; MAX_LEN + 1];
    loop {
        let end = match process.recv(&mut buffer).await {
            // Records are never empty, so an empty one is the end of the connection.
            Ok(0) | Err(_) => ProcessEvent::End(source),
            Ok(len) => match Record::parse(&Bytes::copy_from_slice(&buffer[..len])) {
                Ok(record) => {
                    if events
                        .send(ProcessEvent::Record(source, record))
                        .await
                        .is_err()
                    {
                        return;
                    }
                    continue;
                }
                Err(why) => ProcessEvent::Malformed(source, why),
            },
        };
        let _ = events.send(end).await;
        return;
    }
}
