//! The watcher's side of the sockets.

use std::time::Duration;

use bytes::Bytes;
use fipa_mts::watch::record::{MAX_LEN, Wish};
use fipa_mts::watch::{Record, RecordError, Source};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use super::socket;

/// What processes have told, and that they have come and gone.
pub(super) enum Told {
    Begin(Source, String),
    Record(Source, Record),
    Malformed(Source, RecordError),
    End(Source),
}

/// Processes that are listened to at most.
const MAX_PROCESSES: usize = 1024;

/// Listens to all who connect, for as long as somebody wants to hear it.
pub(super) async fn run(listener: UnixListener, wish: Wish, told: mpsc::Sender<Told>) {
    let mut processes = JoinSet::new();
    let mut number = 0;
    loop {
        while processes.try_join_next().is_some() {}
        match listener.accept().await {
            Ok((process, _)) if processes.len() < MAX_PROCESSES => {
                number += 1;
                processes.spawn(listen(process, Source(number), wish, told.clone()));
            }
            Ok(_) => tracing::warn!("more than {MAX_PROCESSES} processes want to be watched"),
            Err(error) => {
                tracing::warn!(%error, "a process cannot be watched");
                // No descriptors left, say: not in a tight loop.
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

async fn listen(process: UnixStream, source: Source, wish: Wish, told: mpsc::Sender<Told>) {
    // Nobody else may enter the directory; but what is told of letters must be of this user's.
    let peer = match process.peer_cred() {
        Ok(peer) if peer.uid() == rustix::process::geteuid().as_raw() => peer,
        _ => return,
    };
    let name = format!("process {}", peer.pid().unwrap_or_default());
    let Ok(process) = socket::accepted(process) else {
        return;
    };
    if process.send(&wish.to_bytes()).await.is_err() {
        return;
    }
    // Whoever watches may have gone; then nothing matters any more.
    if told.send(Told::Begin(source, name)).await.is_err() {
        return;
    }
    let mut buffer = vec![0; MAX_LEN + 1];
    loop {
        let end = match process.recv(&mut buffer).await {
            // Datagrams are never empty, so this is the end.
            Ok(0) | Err(_) => Told::End(source),
            Ok(len) => match Record::parse(&Bytes::copy_from_slice(&buffer[..len])) {
                Ok(record) => {
                    if told.send(Told::Record(source, record)).await.is_err() {
                        return;
                    }
                    continue;
                }
                Err(why) => Told::Malformed(source, why),
            },
        };
        let _ = told.send(end).await;
        return;
    }
}
