//! The listening side: accepting connections of this user.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::BytesMut;
use tokio::net::{UnixListener, UnixStream};

use super::directory::peer;
use crate::seldom::warn_seldom;
use crate::stream::endpoint::{Endpoint, Stranger};
use crate::stream::frame::FrameReader;
use crate::stream::link::Running;
use crate::stream::proof::Proof;
use crate::stream::source::Source;
use crate::stream::wire;

/// Accepts connections until it is aborted.
pub(super) async fn accept(endpoint: Arc<Endpoint>, listener: UnixListener) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => serve(&endpoint, stream),
            Err(error) => endpoint.accept_failed(&error).await,
        }
    }
}

/// Starts the task of an accepted connection.
fn serve(endpoint: &Arc<Endpoint>, stream: UnixStream) {
    let from = match peer(&stream) {
        Ok(number) => Source::Process(number),
        Err(error) => {
            let counter = &endpoint.tally().refused_unproved;
            let before = counter.fetch_add(1, Ordering::Relaxed);
            warn_seldom(before, format_args!("connection refused: {error}"));
            return;
        }
    };
    let Some(place) = endpoint.receive_stranger(from) else {
        return;
    };
    let number = place.number;
    let task = tokio::spawn(receive(endpoint.clone(), place, stream, from)).abort_handle();
    endpoint.stranger_started(number, task);
}

async fn receive(endpoint: Arc<Endpoint>, place: Stranger, stream: UnixStream, from: Source) {
    let Some((link, sink)) = endpoint.accepted() else {
        return;
    };
    let reader = FrameReader::new(endpoint.limits().max_letter, BytesMut::new());
    Running::new(endpoint, link, sink, None)
        .serve(wire::unix(stream), Proof::default(), reader, from, || {
            drop(place);
        })
        .await;
}
