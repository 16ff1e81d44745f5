//! The dialing side: opens a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::{Location, Sink};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::sleep;

use super::endpoint::TcpEndpoint;
use crate::end::ConnectionEnd;
use crate::sockets::{connect, prepare};
use crate::stream::dialing::{addresses, reach};
use crate::stream::frame::FrameReader;
use crate::stream::link::{Link, LinkTask};
use crate::stream::proof::Proof;
use crate::stream::source::Source;
#[cfg(feature = "secure")]
use crate::stream::tls;
use crate::stream::wire::{self, Reading, Writing};

/// Time after which another connection to the same address is attempted, and the maximum number of
/// attempts.
const RETRY_AFTER: Duration = Duration::from_millis(400);
const MAX_CONNECTS: usize = 4;

/// Opens the connection of a new link, and serves it.
pub(crate) async fn dial(
    endpoint: Arc<TcpEndpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let addresses = addresses(&*sink, &to);
    let running = LinkTask::new(
        endpoint.stream.clone(),
        link.clone(),
        sink,
        Some(to.clone()),
    );
    let (stream, peer) = match reach(
        &endpoint.stream,
        &link,
        &to,
        addresses,
        connect_with_retries,
    )
    .await
    {
        Ok(connected) => connected,
        Err(end) => return running.fail(end),
    };
    if let Err(error) = prepare(&stream, &limits) {
        return running.fail(ConnectionEnd::unreachable(&to, &error));
    }
    let (ends, proof) = tokio::select! {
        proved = prove(&running, stream, peer) => match proved {
            Ok(proved) => proved,
            Err(why) => {
                endpoint.config.refused_dials.add(&to, &why);
                return running.fail(ConnectionEnd::unreachable(&to, &why));
            }
        },
        end = link.end_requested() => return running.fail(end),
    };
    link.connected(Instant::now());
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    running
        .serve(ends, proof, reader, Source::Address(peer), || {})
        .await;
}

/// Performs the TLS handshake if the peer must prove its identity.
#[cfg(feature = "secure")]
async fn prove(
    running: &LinkTask,
    stream: TcpStream,
    peer: SocketAddr,
) -> Result<((Reading, Writing), Proof), String> {
    let config = &running.endpoint().config;
    match &config.security {
        Some(security) if !config.takes_frames_of(peer.ip()) => {
            let timeout = config.limits.handshake_timeout;
            let secured = tls::connect(security, stream, peer, timeout).await?;
            Ok((secured.ends, secured.proof))
        }
        _ => Ok((wire::plain(stream), Proof::default())),
    }
}

/// Without TLS, no peer proves its identity.
#[cfg(not(feature = "secure"))]
async fn prove(
    _running: &LinkTask,
    stream: TcpStream,
    _peer: SocketAddr,
) -> Result<((Reading, Writing), Proof), String> {
    Ok((wire::plain(stream), Proof::default()))
}

/// Opens a connection, and after a while another one if there is no answer: the system retransmits
/// a lost SYN only after one second, and then after two. The first open connection is used.
async fn connect_with_retries(address: SocketAddr) -> io::Result<(TcpStream, SocketAddr)> {
    let mut asked = JoinSet::new();
    loop {
        asked.spawn(connect(address));
        tokio::select! {
            Some(ended) = asked.join_next() => return ended.unwrap_or_else(|e| Err(io::Error::other(e))),
            () = sleep(RETRY_AFTER), if asked.len() < MAX_CONNECTS => {}
        }
    }
}
