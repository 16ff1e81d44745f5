//! The dialing side: opens a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bytes::BytesMut;
use fipa_transport::{Location, Sink};
use quinn::{Connection, ConnectionError, RecvStream, SendStream};

use super::sockets::{Sockets, lost};
use super::streams::{Control, Letters, Outgoing};
use crate::end::ConnectionEnd;
use crate::refused_dials::RefusedDials;
use crate::stream::dialing::{addresses, reach};
use crate::stream::endpoint::Endpoint;
use crate::stream::frame::FrameReader;
use crate::stream::link::{Link, LinkTask};
use crate::stream::source::Source;
use crate::stream::wire::{Reading, Writing};

/// Opens the connection of a new link, and serves it.
pub(super) async fn dial(
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let addresses = addresses(&*sink, &to);
    let refused = Refused {
        dials: endpoint.config.refused_dials.clone(),
        to: to.clone(),
    };
    let running = LinkTask::new(endpoint, link.clone(), sink, Some(to.clone()));
    let by = sockets.clone();
    let connect = move |address| connect(by.clone(), address, refused.clone());
    let reached = reach(running.endpoint(), &link, &to, addresses, connect);
    let (connection, send, receive) = match reached.await {
        Ok(connected) => connected,
        Err(end) => return running.fail(end),
    };
    let Some(proof) = sockets.proof(&connection) else {
        let what = "the peer's certificate is no longer trusted";
        return running.fail(ConnectionEnd::unreachable(&to, &what));
    };
    link.connected(Instant::now());
    let from = connection.remote_address();
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    let ends = ends(&connection, send, receive, limits.max_letter);
    drop(connection);
    let from = Source::Address(from);
    running.serve(ends, proof, reader, from, || {}).await;
}

/// Records that the peer refused the connection to a location.
#[derive(Clone)]
struct Refused {
    dials: RefusedDials,
    to: Location,
}

async fn connect(
    sockets: Arc<Sockets>,
    address: SocketAddr,
    refused: Refused,
) -> io::Result<(Connection, SendStream, RecvStream)> {
    let recorded = |error: ConnectionError| {
        let lost = lost(&error);
        if let ConnectionError::TransportError(_) | ConnectionError::ConnectionClosed(_) = error {
            refused.dials.add(&refused.to, &lost.to_string());
        }
        lost
    };
    let connection = sockets.dial(address)?.await.map_err(recorded)?;
    let (send, receive) = connection.open_bi().await.map_err(recorded)?;
    Ok((connection, send, receive))
}

/// Returns the wire of a connection.
pub(super) fn ends(
    connection: &Connection,
    send: SendStream,
    receive: RecvStream,
    max_letter: usize,
) -> (Reading, Writing) {
    let letters = Box::new(Letters::new(connection.clone(), max_letter));
    let control = Box::new(Control::new(connection, receive));
    let outgoing = Box::new(Outgoing::new(connection, send));
    (
        Reading::Streams(control, Some(letters)),
        Writing::Streams(outgoing),
    )
}
