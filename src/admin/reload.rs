//! Requests to read the configuration again, which `fipa reload` sends to the processes of its domain on this host.
//!
//! [`request`] creates a socket in the private directory of the domain, as a [watcher](crate::admin::watch) does.
//! Every process of the domain connects, receives the request, and answers it. A process that does not
//! [follow](crate::Domain::follow) a configuration answers so; the answer needs no cooperation of its program.

use std::collections::{BTreeMap, HashSet};
use std::time::Duration;

use bytes::Bytes;
use fipa_mts::watch::Record;
use fipa_mts::watch::record::{MAX_LEN, RecordBody};
use fipa_sds::{Directory, HostDirectory, Reach};
use fipa_transport::{DomainUsers, Incarnation};
use serde::Serialize;
use tokio::net::{UnixDatagram, UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout, timeout_at};

use crate::Config;
use crate::admin::member::Member;
use crate::admin::watch::connection::RELOAD;
use crate::admin::watch::reloading::read_answer;
pub use crate::admin::watch::reloading::{ReloadAnswer, ReloadRequest, ReloadRequests};
use crate::admin::watch::socket;
use crate::error::OpenError;

/// Time for all processes to answer. A stopped process does not answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for processes without agents, which the directory does not list, to connect after the others have answered.
const SETTLE_TIME: Duration = Duration::from_millis(100);
/// Maximum number of processes that are asked.
const MAX_PROCESSES: usize = 1024;

/// A process that was asked to read its configuration again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct ReloadedProcess {
    /// The name of its message transport service.
    pub name: String,
    /// Whether it is the gateway.
    pub gateway: bool,
    /// Its answer.
    #[serde(flatten)]
    pub answer: ReloadAnswer,
}

/// Requests all processes of a domain on this host to read their configurations again, and returns their answers. Takes
/// up to five seconds if a process does not answer. Must be called within a tokio runtime.
///
/// # Errors
/// If the configuration, of which only the domain and its place matter, is invalid, or the directory of the domain
/// cannot be used.
pub async fn request(config: &Config) -> Result<Vec<ReloadedProcess>, OpenError> {
    let member = Member::join(config, "reload").await?;
    let socket = member.host.listen()?;
    let socket = socket::listening(socket).map_err(OpenError::Watch)?;
    Ok(collect(&member.host, socket).await)
}

/// The name of a process's service, its incarnation, and whether it is the gateway.
struct Asked {
    name: String,
    incarnation: Incarnation,
    gateway: bool,
}

/// An event on the connection of a process.
enum Progress {
    Asked(Asked),
    Answered(Incarnation, ReloadAnswer),
}

async fn collect(host: &HostDirectory, socket: UnixListener) -> Vec<ReloadedProcess> {
    let due = Instant::now() + ANSWER_TIMEOUT;
    let (sender, mut progress) = mpsc::channel(MAX_PROCESSES);
    let mut accepting = JoinSet::new();
    accepting.spawn(accept(socket, host.users(), sender));
    let mut asked: BTreeMap<Incarnation, ReloadedProcess> = BTreeMap::new();
    let mut silent: HashSet<Incarnation> = HashSet::new();
    loop {
        let is_complete = silent.is_empty() && has_all(host, &asked);
        let wait_until = match is_complete {
            true => due.min(Instant::now() + SETTLE_TIME),
            false => due,
        };
        match timeout_at(wait_until, progress.recv()).await {
            Ok(Some(Progress::Asked(process))) => {
                silent.insert(process.incarnation);
                let Asked { name, gateway, .. } = process;
                let answer = ReloadAnswer::Silent;
                let process_answer = ReloadedProcess {
                    name,
                    gateway,
                    answer,
                };
                asked.insert(process.incarnation, process_answer);
            }
            Ok(Some(Progress::Answered(incarnation, answer))) => {
                silent.remove(&incarnation);
                if let Some(process) = asked.get_mut(&incarnation) {
                    process.answer = answer;
                }
            }
            Ok(None) | Err(_) => break,
        }
    }
    // Processes that are in the directory and did not connect, for example because they are stopped.
    for entry in host.entries().iter() {
        if entry.reach == Reach::Local {
            asked
                .entry(entry.mts.incarnation)
                .or_insert_with(|| ReloadedProcess {
                    name: entry.mts.shown().to_owned(),
                    gateway: entry.role == fipa_sds::Role::Gateway,
                    answer: ReloadAnswer::Silent,
                });
        }
    }
    let mut all: Vec<ReloadedProcess> = asked.into_values().collect();
    all.sort_by(|a, b| (!a.gateway, &a.name).cmp(&(!b.gateway, &b.name)));
    all
}

/// Whether all processes with agents have been asked.
fn has_all(host: &HostDirectory, asked: &BTreeMap<Incarnation, ReloadedProcess>) -> bool {
    let entries = host.entries();
    let mut local = entries.iter().filter(|entry| entry.reach == Reach::Local);
    local.all(|entry| asked.contains_key(&entry.mts.incarnation))
}

/// Accepts processes and asks them, until it is aborted.
async fn accept(listener: UnixListener, users: DomainUsers, progress: mpsc::Sender<Progress>) {
    let mut processes = JoinSet::new();
    while let Ok((process, _)) = listener.accept().await {
        if processes.len() < MAX_PROCESSES {
            processes.spawn(ask(process, users, progress.clone()));
        }
    }
}

/// Asks one process, and reports its answer.
async fn ask(
    process: UnixStream,
    users: DomainUsers,
    progress: mpsc::Sender<Progress>,
) -> Option<()> {
    // The directory is private, but answers must be from users of the domain in any case.
    let peer = process.peer_cred().ok()?;
    if !users.admit(peer.uid()) {
        return None;
    }
    let process = socket::accepted(process).ok()?;
    let mut buffer = vec![0; MAX_LEN + 1];
    let hello = timeout(ANSWER_TIMEOUT, receive(&process, &mut buffer));
    let RecordBody::Hello {
        name,
        incarnation,
        gateway,
    } = Record::parse(&hello.await.ok()??).ok()?.body
    else {
        return None;
    };
    let asked = Asked {
        name: name.to_string(),
        incarnation,
        gateway,
    };
    progress.send(Progress::Asked(asked)).await.ok()?;
    process.send(&RELOAD).await.ok()?;
    // The process also sends records of letters.
    let answer = loop {
        let bytes = receive(&process, &mut buffer).await?;
        if let Some(answer) = read_answer(&bytes) {
            break answer;
        }
    };
    let answered = Progress::Answered(incarnation, answer);
    progress.send(answered).await.ok()
}

/// Receives a datagram; `None` at the end of the connection.
async fn receive(process: &UnixDatagram, buffer: &mut [u8]) -> Option<Bytes> {
    let len = process.recv(buffer).await.ok().filter(|len| *len > 0)?;
    buffer.get(..len).map(Bytes::copy_from_slice)
}
