//! The calling side: opening a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bytes::BytesMut;
use fipa_transport::{Location, Sink, WayError, WayFault};
use quinn::{Connection, RecvStream, SendStream};

use super::sockets::Sockets;
use super::streams::{Control, Letters, Outgoing};
use crate::end::End;
use crate::tcp::dial::{Unreachable, addresses, first};
use crate::tcp::endpoint::Endpoint;
use crate::tcp::frame::FrameReader;
use crate::tcp::link::{Link, Running};
use crate::tcp::proof::Proof;
use crate::tcp::wire::{Reading, Writing};

/// Opens the connection of a link that has been made up, and serves it.
pub(super) async fn dial(
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let addresses = addresses(&*sink, &to);
    let running = Running::new(endpoint, link.clone(), sink, Some(to.clone()));
    let unreachable = |what: &dyn std::fmt::Display| {
        let detail = format!("{}: {what}", to.address());
        End::NotOpened(WayError::new(WayFault::Unreachable, detail))
    };
    let by = sockets.clone();
    let connecting = first(&limits, addresses, move |address| {
        connect(by.clone(), address)
    });
    let connected = tokio::select! {
        connected = connecting => connected,
        end = link.leaving() => return running.fail(end),
    };
    let (connection, send, receive) = match connected {
        Ok(connected) => connected,
        Err(Unreachable(what)) => return running.fail(unreachable(&what)),
    };
    let Some(certificate) = sockets.certificate(&connection) else {
        return running.fail(unreachable(
            &"the peer's certificate is not trusted any more",
        ));
    };
    link.connected(Instant::now());
    let from = connection.remote_address();
    let proof = Proof::of(&sockets.security, certificate);
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    let ends = ends(&connection, send, receive, limits.max_letter);
    drop(connection);
    running.serve(ends, proof, reader, from, || {}).await;
}

async fn connect(
    sockets: Arc<Sockets>,
    address: SocketAddr,
) -> io::Result<(Connection, SendStream, RecvStream)> {
    let told = |error: &dyn std::fmt::Display| {
        io::Error::other(format!("{error} (`fipa keys list` on both sides)"))
    };
    let connecting = sockets.dial(address)?;
    let connection = connecting.await.map_err(|error| told(&error))?;
    let (send, receive) = connection.open_bi().await.map_err(|error| told(&error))?;
    Ok((connection, send, receive))
}

/// What a link reads from and writes to.
pub(super) fn ends(
    connection: &Connection,
    send: SendStream,
    receive: RecvStream,
    max_letter: usize,
) -> (Reading, Writing) {
    let letters = Box::new(Letters::new(connection, max_letter));
    let reading = Reading::Quic(Control::new(connection, receive), Some(letters));
    (reading, Writing::Quic(Outgoing::new(connection, send)))
}
