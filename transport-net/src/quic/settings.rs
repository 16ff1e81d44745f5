//! Transport parameters: windows, streams and timeouts.

use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ClientConfig, Connection, IdleTimeout, ServerConfig, TransportConfig, VarInt};

use crate::NetLimits;
use crate::secure::Security;

/// The ALPN protocol name (RFC 7301).
pub(super) const PROTOCOL: &[u8] = b"fipa/1";

/// Maximum number of concurrent parcel streams of a connection with the usual window. Parcels are
/// read one after the other, so more would only wait.
const STREAMS: u32 = 64;

/// Maximum number of unread bytes of one parcel: the bytes in flight at 50 MB/s and 10 ms.
const STREAM_WINDOW: u32 = 512 << 10;

/// Maximum number of unread bytes of a connection. Each stream may fill its own window, and there
/// is room for another one: otherwise waiting parcels could block the one that is read next.
const WINDOW: u32 = (STREAMS + 1) * STREAM_WINDOW;

/// Streams and bytes of a connection without a reservation for the usual window.
const FIRST_STREAMS: u32 = 2;
const FIRST_WINDOW: u32 = (FIRST_STREAMS + 1) * STREAM_WINDOW;

/// Bytes to reserve for the usual window, beyond the minimum.
pub(super) const WIDENING: usize = (WINDOW - FIRST_WINDOW) as usize;

/// Increases the receive window of a connection to its usual size.
pub(super) fn widen(connection: &Connection) {
    connection.set_receive_window(VarInt::from_u32(WINDOW));
    connection.set_max_concurrent_uni_streams(VarInt::from_u32(STREAMS));
}

/// Maximum number of sent and unacknowledged bytes.
const SEND_WINDOW: u64 = 8 << 20;

/// Assumed round-trip time before the first measurement: a lost first packet is retransmitted after
/// three times this time. quinn's default of 333 ms is meant for the Internet; this transport is
/// used in local networks.
const INITIAL_RTT: Duration = Duration::from_millis(100);

/// Maximum number of handshakes of which only the first packet has arrived; more are refused.
const MAX_INCOMING: usize = 256;

/// Maximum number of bytes buffered for each of those handshakes, and for all of them.
const INCOMING_BUFFER: u64 = 16 << 10;
const INCOMING_BUFFERS: u64 = 1 << 20;

pub(super) fn transport(limits: &NetLimits) -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    // Ping frames detect silent peers; this timeout detects peers that fail during the handshake.
    let silence = (limits.keep_alive * 4).max(limits.handshake_timeout);
    let silence = IdleTimeout::try_from(silence).unwrap_or_else(|_| VarInt::MAX.into());
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(FIRST_STREAMS))
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(FIRST_WINDOW))
        .send_window(SEND_WINDOW)
        // The parcel that is read first is sent first.
        .send_fairness(false)
        .datagram_receive_buffer_size(None)
        .initial_rtt(INITIAL_RTT)
        .max_idle_timeout(Some(silence));
    Arc::new(transport)
}

/// Returns the configuration for accepting, with the present credentials.
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

/// Returns the configuration for dialing, with the present credentials.
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
