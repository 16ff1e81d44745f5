//! The watcher's side of the connections: accepts processes and receives their records.
//!
//! Records arrive in batches. While a process sends, its socket is read at intervals and is not registered with the
//! runtime, which the kernel would wake for every single record.

use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

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
    /// Records in the order of their arrival.
    Records(RecordSource, Vec<Record>),
    Malformed(RecordSource, RecordError),
    End(RecordSource),
}

/// Maximum number of connected processes.
const MAX_PROCESSES: usize = 1024;
/// Maximum number of records in one event.
const MAX_BATCH: usize = 256;
/// Bytes of records after which a batch ends. The socket has more, so the next look follows at once.
const BATCH_BYTES: usize = 64 * 1024;
/// Time between two looks into the socket of a process that sends less.
const INTERVAL: Duration = Duration::from_millis(10);

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
    let _ = forward(process, source, &events).await;
}

/// The watcher was dropped.
struct Dropped;

/// Forwards the records of a process until its connection ends.
async fn forward(
    process: tokio::net::UnixDatagram,
    source: RecordSource,
    events: &mpsc::Sender<ProcessEvent>,
) -> Result<(), Dropped> {
    let send = async |event| events.send(event).await.map_err(|_| Dropped);
    let mut buffer = vec![0; MAX_LEN + 1];
    let mut process = process;
    loop {
        if process.readable().await.is_err() {
            return send(ProcessEvent::End(source)).await;
        }
        let Ok(socket) = process.into_std() else {
            return send(ProcessEvent::End(source)).await;
        };
        loop {
            let mut records = Vec::new();
            let read = take_records(&socket, &mut buffer, &mut records);
            let is_idle = records.is_empty();
            if !is_idle {
                send(ProcessEvent::Records(source, records)).await?;
            }
            match read {
                Batch::End => return send(ProcessEvent::End(source)).await,
                Batch::Malformed(why) => return send(ProcessEvent::Malformed(source, why)).await,
                Batch::Full => tokio::task::yield_now().await,
                Batch::Open if is_idle => break,
                Batch::Open => tokio::time::sleep(INTERVAL).await,
            }
        }
        process = match tokio::net::UnixDatagram::from_std(socket) {
            Ok(process) => process,
            Err(_) => return send(ProcessEvent::End(source)).await,
        };
    }
}

/// State of a connection after reading the records that are there.
enum Batch {
    Open,
    /// There may be more records.
    Full,
    End,
    Malformed(RecordError),
}

/// Takes the records that are there, up to the maximum of a batch.
fn take_records(socket: &UnixDatagram, buffer: &mut [u8], records: &mut Vec<Record>) -> Batch {
    let mut taken = 0;
    while records.len() < MAX_BATCH && taken < BATCH_BYTES {
        let bytes = match socket.recv(buffer) {
            // Records are never empty, so an empty one is the end of the connection.
            Ok(0) => return Batch::End,
            Ok(len) => buffer.get(..len).unwrap_or_default(),
            Err(error) if error.kind() == ErrorKind::WouldBlock => return Batch::Open,
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(_) => return Batch::End,
        };
        taken += bytes.len();
        match Record::parse(bytes) {
            Ok(record) => records.push(record),
            Err(why) => return Batch::Malformed(why),
        }
    }
    Batch::Full
}
