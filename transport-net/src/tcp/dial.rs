//! The calling side: opening a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bytes::BytesMut;
use fipa_transport::{Location, Sink, WayError, WayFault};
use tokio::net::{TcpStream, lookup_host};
use tokio::time::timeout;

use super::accept::prepare;
use super::endpoint::Endpoint;
use super::frame::FrameReader;
use super::link::{Link, Running};
use crate::address::{self, Target};
use crate::end::End;

/// Opens the connection of a link that has been made up, and serves it.
pub(crate) async fn dial(
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let running = Running::new(endpoint, link.clone(), sink, Some(to.clone()));
    let unreachable = |what: &dyn std::fmt::Display| {
        let detail = format!("{}: {what}", to.address());
        End::NotOpened(WayError::new(WayFault::Unreachable, detail))
    };
    let target = match address::target(to.address()) {
        Ok(target) => target,
        Err(error) => return running.fail(unreachable(&error)),
    };
    let connected = tokio::select! {
        connected = timeout(limits.connect_timeout, connect(&target)) => connected,
        end = link.leaving() => return running.fail(end),
    };
    let (stream, peer) = match connected {
        Ok(Ok(connected)) => connected,
        Ok(Err(error)) => return running.fail(unreachable(&error)),
        Err(_) => {
            let patience = limits.connect_timeout;
            let what = format!("no connection within {patience:?} (connect_timeout)");
            return running.fail(unreachable(&what));
        }
    };
    if let Err(error) = prepare(&stream, &limits) {
        return running.fail(unreachable(&error));
    }
    link.connected(Instant::now());
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    running
        .serve(stream.into_split(), reader, peer, || {})
        .await;
}

async fn connect(target: &Target) -> io::Result<(TcpStream, SocketAddr)> {
    let addresses: Vec<SocketAddr> = match target {
        Target::Numeric(address) => vec![*address],
        Target::Named(name, port) => lookup_host((name.as_str(), *port)).await?.collect(),
    };
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in addresses {
        match TcpStream::connect(address).await {
            // Where nobody listens on a port of its own range, a host can connect to itself.
            Ok(stream) if stream.local_addr()? == stream.peer_addr()? => {
                last = io::ErrorKind::ConnectionRefused.into();
            }
            Ok(stream) => return Ok((stream, address)),
            Err(error) => last = error,
        }
    }
    Err(last)
}
