//! The listening side: accepts connections of the users of the domain.

use std::sync::Arc;

use bytes::BytesMut;
use fipa_transport::{DomainUsers, log_limit};
use tokio::net::{UnixListener, UnixStream};

use super::directory::peer;
use crate::end::ConnectionEnd;
use crate::stream::counters::count;
use crate::stream::endpoint::{Endpoint, UnprovedSlot};
use crate::stream::frame::FrameReader;
use crate::stream::link::LinkTask;
use crate::stream::proof::Proof;
use crate::stream::source::Source;
use crate::stream::wire;

/// Accepts connections until it is aborted.
pub(super) async fn accept(endpoint: Arc<Endpoint>, listener: UnixListener, users: DomainUsers) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => serve(&endpoint, stream, users),
            Err(error) => endpoint.accept_failed(&error).await,
        }
    }
}

/// Starts the task of an accepted connection.
fn serve(endpoint: &Arc<Endpoint>, stream: UnixStream, users: DomainUsers) {
    let from = match peer(&stream, users) {
        Ok(from) => from,
        Err(error) => {
            count(&endpoint.tally().refused_unproved);
            log_limit::warn!("connection refused: {error}");
            return;
        }
    };
    let Some(slot) = endpoint.admit_unproved(from) else {
        return;
    };
    let number = slot.number;
    let task = tokio::spawn(receive(endpoint.clone(), slot, stream, from)).abort_handle();
    endpoint.unproved_started(number, task);
}

async fn receive(endpoint: Arc<Endpoint>, slot: UnprovedSlot, stream: UnixStream, from: Source) {
    let Some((link, sink)) = endpoint.accepted() else {
        return;
    };
    let reader = FrameReader::new(endpoint.limits().max_letter, BytesMut::new());
    let running = LinkTask::new(endpoint, link, sink, None);
    let ends = match wire::unix(stream) {
        Ok(ends) => ends,
        Err(error) => return running.fail(ConnectionEnd::Broken(error.to_string())),
    };
    running
        .serve(ends, Proof::default(), reader, from, || {
            drop(slot);
        })
        .await;
}
