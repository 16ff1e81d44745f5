//! What is agreed upon with peers: windows, streams, and how long silence lasts.

use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ClientConfig, Connection, IdleTimeout, ServerConfig, TransportConfig, VarInt};

use crate::Limits;
use crate::secure::Security;

/// What both sides have to speak (RFC 7301).
const PROTOCOL: &[u8] = b"fipa/1";

/// Letters that may arrive at the same time on a connection with a whole window. They are read one after the other, so more would only
/// wait.
const STREAMS: u32 = 64;

/// Bytes of one letter that may wait to be read: what is under way at 50 MB/s in 10 ms.
const STREAM_WINDOW: u32 = 512 << 10;

/// Bytes that may wait to be read in all. Each of the streams may fill its own window, and there is
/// room for another: otherwise letters that wait for their turn could keep the one whose turn it is
/// from arriving.
const WINDOW: u32 = (STREAMS + 1) * STREAM_WINDOW;

/// Letters and bytes of a connection that has no share of the budget for whole windows.
const FIRST_STREAMS: u32 = 2;
const FIRST_WINDOW: u32 = (FIRST_STREAMS + 1) * STREAM_WINDOW;

/// What a connection with a whole window takes of the budget.
pub(super) const WIDENING: usize = (WINDOW - FIRST_WINDOW) as usize;

/// Gives a connection its whole window.
pub(super) fn widen(connection: &Connection) {
    connection.set_receive_window(VarInt::from_u32(WINDOW));
    connection.set_max_concurrent_uni_streams(VarInt::from_u32(STREAMS));
}

/// Bytes that were sent and are not acknowledged.
const SEND_WINDOW: u64 = 8 << 20;

/// Round trip that is assumed before one was measured: a lost first packet is repeated after three times
/// as long. The default of 333 ms is that of the Internet; here are networks of robots.
const INITIAL_RTT: Duration = Duration::from_millis(100);

/// Handshakes of which the first packet has come and nothing been done yet; more are refused.
const MAX_INCOMING: usize = 256;

/// Bytes that are kept of each of those, and of all.
const INCOMING_BUFFER: u64 = 16 << 10;
const INCOMING_BUFFERS: u64 = 1 << 20;

pub(super) fn transport(limits: &Limits) -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    // Frames ask for signs of life; this is for peers that die in the middle of a handshake.
    let silence = (limits.keep_alive * 4).max(limits.handshake_timeout);
    let silence = IdleTimeout::try_from(silence).unwrap_or_else(|_| VarInt::MAX.into());
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(FIRST_STREAMS))
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(FIRST_WINDOW))
        .send_window(SEND_WINDOW)
        // The letter that is read first is sent first.
        .send_fairness(false)
        .datagram_receive_buffer_size(None)
        .initial_rtt(INITIAL_RTT)
        .max_idle_timeout(Some(silence));
    Arc::new(transport)
}

/// How this side accepts, with the keys it has now.
pub(super) fn server(
    security: &Security,
    transport: &Arc<TransportConfig>,
) -> Result<ServerConfig, String> {
    let mut tls = (*security.server()).clone();
    tls.alpn_protocols = vec![PROTOCOL.to_vec()];
    let crypto = QuicServerConfig::try_from(tls).map_err(|error| error.to_string())?;
    let mut server = ServerConfig::with_crypto(Arc::new(crypto));
    server
        .transport_config(Arc::clone(transport))
        .max_incoming(MAX_INCOMING)
        .incoming_buffer_size(INCOMING_BUFFER)
        .incoming_buffer_size_total(INCOMING_BUFFERS);
    Ok(server)
}

/// How this side dials, with the keys it has now.
pub(super) fn client(
    security: &Security,
    transport: &Arc<TransportConfig>,
) -> Result<ClientConfig, String> {
    let mut tls = (*security.client()).clone();
    tls.alpn_protocols = vec![PROTOCOL.to_vec()];
    let crypto = QuicClientConfig::try_from(tls).map_err(|error| error.to_string())?;
    let mut client = ClientConfig::new(Arc::new(crypto));
    client.transport_config(Arc::clone(transport));
    Ok(client)
}
