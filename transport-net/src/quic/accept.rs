//! The listening side: handshakes and refusals.

use std::io;
use std::sync::Arc;

use bytes::BytesMut;
use fipa_transport::{log_limit, quota_address};
use quinn::{Connection, Incoming, RecvStream, SendStream};
use tokio::time;

use super::dial::ends;
use super::sockets::{Sockets, lost};
use crate::secure::advice::TlsFailure;
use crate::stream::counters::count;
use crate::stream::endpoint::{Endpoint, UnprovedSlot};
use crate::stream::frame::FrameReader;
use crate::stream::link::LinkTask;
use crate::stream::source::Source;

/// Accepts connections until it is aborted.
pub(super) async fn accept(
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
    socket: quinn::Endpoint,
) {
    while let Some(incoming) = socket.accept().await {
        // With many pending handshakes, a source address is validated before memory is allocated
        // for it (RFC 9000 section 8.1.2).
        if endpoint.is_crowded() && !incoming.remote_address_validated() {
            if let Err(error) = incoming.retry() {
                tracing::debug!(%error, "cannot request another handshake with address validation");
            }
            continue;
        }
        let Some(slot) = endpoint.admit_unproved(Source::Address(incoming.remote_address())) else {
            return;
        };
        let number = slot.number;
        let task = receive(endpoint.clone(), sockets.clone(), slot, incoming);
        let task = tokio::spawn(task).abort_handle();
        endpoint.unproved_started(number, task);
    }
}

async fn receive(
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
    slot: UnprovedSlot,
    incoming: Incoming,
) {
    let from = incoming.remote_address();
    let timeout = endpoint.limits().handshake_timeout;
    let handshake_result = match time::timeout(timeout, handshake(&sockets, incoming)).await {
        Ok(Ok((connection, send, receive))) => match sockets.proof(&connection) {
            Some(proof) => Ok((connection, send, receive, proof)),
            None => Err("the peer's certificate is no longer trusted".to_owned()),
        },
        Ok(Err(error)) => {
            let why = error.to_string();
            if TlsFailure::in_error(&error).is_some() {
                endpoint.config.refusals.add(from.ip(), &why);
            }
            Err(why)
        }
        Err(_) => Err(format!(
            "handshake not complete within {timeout:?} (handshake_timeout)"
        )),
    };
    let (connection, send, receive, proof) = match handshake_result {
        Ok(handshake_result) => handshake_result,
        Err(why) => {
            count(&endpoint.tally().refused_unproved);
            log_limit::warn!(of: quota_address(from.ip()), "{from}: connection refused: {why}");
            return;
        }
    };
    let Some((link, sink)) = endpoint.accepted() else {
        return;
    };
    let max_letter = endpoint.limits().max_letter;
    let reader = FrameReader::new(max_letter, BytesMut::new());
    let ends = ends(&connection, send, receive, max_letter);
    drop(connection);
    LinkTask::new(endpoint, link, sink, None)
        .serve(ends, proof, reader, Source::Address(from), || drop(slot))
        .await;
}

/// Performs the handshake, and accepts the first stream of the peer.
async fn handshake(
    sockets: &Sockets,
    incoming: Incoming,
) -> io::Result<(Connection, SendStream, RecvStream)> {
    let connection = sockets
        .accept(incoming)?
        .await
        .map_err(|error| lost(&error))?;
    let (send, receive) = connection.accept_bi().await.map_err(|error| lost(&error))?;
    Ok((connection, send, receive))
}
