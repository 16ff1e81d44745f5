//! The dialing side: opens a connection to a location.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::{Location, Sink};
use tokio::net::UnixStream;
use tokio::time;

use super::directory::Directory;
use crate::end::ConnectionEnd;
use crate::stream::endpoint::Endpoint;
use crate::stream::frame::FrameReader;
use crate::stream::link::{Link, LinkTask};
use crate::stream::proof::Proof;
use crate::stream::source::Source;
use crate::stream::wire;

/// Opens the connection of a new link, and serves it.
pub(super) async fn dial(
    endpoint: Arc<Endpoint>,
    directory: Option<Arc<Directory>>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let running = LinkTask::new(endpoint, link.clone(), sink, Some(to.clone()));
    let Some(directory) = directory else {
        return running.fail(ConnectionEnd::Closed);
    };
    let connected = tokio::select! {
        connected = connect(&directory, to.address(), limits.connect_timeout) => connected,
        end = link.end_requested() => return running.fail(end),
    };
    let (stream, from) = match connected {
        Ok(connected) => connected,
        Err(error) => return running.fail(ConnectionEnd::unreachable(&to, &in_words(&error))),
    };
    let ends = match wire::unix(stream) {
        Ok(ends) => ends,
        Err(error) => return running.fail(ConnectionEnd::unreachable(&to, &error)),
    };
    link.connected(Instant::now());
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    running
        .serve(ends, Proof::default(), reader, from, || {})
        .await;
}

/// Returns the text for an error of connecting.
fn in_words(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::ConnectionRefused | io::ErrorKind::NotFound => {
            format!("the process at this socket has ended or is ending: {error}")
        }
        _ => error.to_string(),
    }
}

async fn connect(
    directory: &Directory,
    name: &str,
    timeout: Duration,
) -> io::Result<(UnixStream, Source)> {
    match time::timeout(timeout, directory.connect(name)).await {
        Ok(connected) => connected,
        Err(_) => Err(io::Error::new(
            io::ErrorKind::TimedOut,
            format!("timed out connecting after {timeout:?} (connect_timeout)"),
        )),
    }
}
