//! The sockets of an endpoint: the listening ones, and one per address family for dialing.
//!
//! The latter are bound to no address, so that packets leave from any address of the host:
//! connections survive a change of address.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;

use parking_lot::Mutex;
use quinn::{
    Connecting, ConnectionError, Endpoint, EndpointConfig, Incoming, ServerConfig, TokioRuntime,
    TransportConfig,
};
use rustls::AlertDescription;
use rustls::pki_types::CertificateDer;
use socket2::{Domain, Protocol, Socket, Type};

use super::settings;
use crate::NetLimits;
use crate::secure::Security;
use crate::secure::advice::{self, Finder, TlsFailure};
use crate::stream::proof::Proof;

#[derive(Debug)]
pub(super) struct Sockets {
    security: Security,
    transport: Arc<TransportConfig>,
    /// For IPv4 and IPv6; opened on demand.
    dialing: Mutex<[Option<Endpoint>; 2]>,
}

impl Sockets {
    pub(super) fn new(security: Security, limits: &NetLimits) -> Self {
        Self {
            security,
            transport: settings::transport(limits),
            dialing: Mutex::default(),
        }
    }

    /// Listens on a configured address. Returns the address that the socket is bound to.
    pub(super) fn listen(&self, address: SocketAddr) -> io::Result<(Endpoint, SocketAddr)> {
        let socket = open(address)?;
        let bound = socket.local_addr()?;
        let server = settings::server(&self.security, &self.transport).map_err(io::Error::other)?;
        Ok((endpoint(Some(server), socket)?, bound))
    }

    /// Continues the handshake of a peer.
    pub(super) fn accept(&self, incoming: Incoming) -> io::Result<Connecting> {
        let server = settings::server(&self.security, &self.transport).map_err(io::Error::other)?;
        incoming
            .accept_with(Arc::new(server))
            .map_err(|error| lost(&error))
    }

    /// Begins a handshake with the peer at this address.
    pub(super) fn dial(&self, to: SocketAddr) -> io::Result<Connecting> {
        let client = settings::client(&self.security, &self.transport).map_err(io::Error::other)?;
        let socket = {
            let mut dialing = self.dialing.lock();
            let [v4, v6] = &mut *dialing;
            let (place, any) = match to {
                SocketAddr::V4(_) => (v4, SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0))),
                SocketAddr::V6(_) => (v6, SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0))),
            };
            match place {
                Some(socket) => socket.clone(),
                None => place.insert(endpoint(None, open(any)?)?).clone(),
            }
        };
        // The name is neither sent nor verified: the certificate identifies the peer.
        let name = to.ip().to_string();
        socket
            .connect_with(client, to, &name)
            .map_err(io::Error::other)
    }

    /// Returns the proof of a peer. `None` if its certificate is not trusted.
    pub(super) fn proof(&self, connection: &quinn::Connection) -> Option<Proof> {
        let presented = connection.peer_identity()?;
        let presented = presented.downcast::<Vec<CertificateDer<'static>>>().ok()?;
        self.security.trust(Some(&presented)).map(Proof::from)
    }

    /// Releases the sockets; connections that are closing keep them until they have ended.
    pub(super) fn close(&self) {
        *self.dialing.lock() = [None, None];
    }
}

/// Returns the alert of TLS that ended a connection (RFC 9001 section 4.8), and the side that sent it.
fn alert(error: &ConnectionError) -> Option<(AlertDescription, Finder)> {
    let (code, finder) = match error {
        ConnectionError::TransportError(error) => (u64::from(error.code), Finder::Here),
        ConnectionError::ConnectionClosed(close) => (u64::from(close.error_code), Finder::Peer),
        _ => return None,
    };
    let alert = u8::try_from(code.checked_sub(0x100)?).ok()?;
    Some((alert.into(), finder))
}

/// Whether TLS ended a connection, because the keys or the protocols of the two sides do not match.
pub(super) fn is_of_tls(error: &ConnectionError) -> bool {
    alert(error).is_some()
}

/// Returns the error of a lost connection.
pub(super) fn lost(error: &ConnectionError) -> io::Error {
    match is_of_tls(error) {
        true => TlsFailure::io(loss_reason(error)),
        false => io::Error::other(loss_reason(error)),
    }
}

/// Returns the reason for which a connection is lost, with a remedy if TLS ended it.
pub(super) fn loss_reason(error: &ConnectionError) -> String {
    let text = || advice::in_words(&error.to_string());
    let remedy = match (alert(error), error) {
        (Some((AlertDescription::NoApplicationProtocol, _)), _) => {
            let own = String::from_utf8_lossy(settings::PROTOCOL);
            format!(
                "the two sides have no version of the protocol over QUIC in common, and this side has {own}: \
                 install the same release of fipa on both hosts"
            )
        }
        // quinn only keeps the text and the alert of a TLS error, and the alert is that of an expired
        // certificate.
        (_, ConnectionError::TransportError(failed)) if failed.reason.ends_with("NotValidYet") => {
            advice::not_yet()
        }
        (_, ConnectionError::TransportError(failed))
            if failed.reason.ends_with(advice::OWN_CERTIFICATE) =>
        {
            advice::ITSELF.to_owned()
        }
        (Some((alert, finder)), _) => advice::of_alert(alert, finder).into_owned(),
        (None, ConnectionError::TransportError(_) | ConnectionError::ConnectionClosed(_)) => {
            return text();
        }
        (None, other) => return other.to_string(),
    };
    let remedy = match alert(error) {
        Some((alert, Finder::Peer)) => advice::alert_of_peer(alert, &remedy),
        _ => remedy,
    };
    format!("{} ({remedy})", text())
}

fn open(address: SocketAddr) -> io::Result<UdpSocket> {
    let domain = Domain::for_address(address);
    let socket = Socket::new(domain, Type::DGRAM.nonblocking(), Some(Protocol::UDP))?;
    if address.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    Ok(socket.into())
}

fn endpoint(server: Option<ServerConfig>, socket: UdpSocket) -> io::Result<Endpoint> {
    let mut config = EndpointConfig::default();
    // Only version 1 (RFC 9000), no drafts.
    config.supported_versions(vec![1]);
    Endpoint::new(config, server, socket, Arc::new(TokioRuntime))
}
