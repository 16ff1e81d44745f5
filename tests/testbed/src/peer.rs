//! Building blocks of peers that do not use `fipa`.

#[cfg(feature = "tls")]
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
#[cfg(feature = "tls")]
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
#[cfg(feature = "tls")]
use rustls::{DigitallySignedStruct, Error, SignatureScheme, crypto::ring};

/// Builds a frame of the protocol between gateways from its kind, number and body. Written by hand, so
/// that the reader is not tested with the writer of the same crate.
#[must_use]
pub fn frame(kind: u8, id: u64, body: &[u8]) -> Vec<u8> {
    let mut frame = frame_header(kind, id, body.len() as u64).to_vec();
    frame.extend(body);
    frame
}

/// Builds the header of a frame with a body of this length in bytes.
#[must_use]
pub fn frame_header(kind: u8, id: u64, body_len: u64) -> [u8; 24] {
    let mut header = [0; 24];
    header[..5].copy_from_slice(b"fipa\x03");
    header[5] = kind;
    header[8..16].copy_from_slice(&id.to_le_bytes());
    header[16..].copy_from_slice(&body_len.to_le_bytes());
    header
}

/// Accepts every server certificate without verification.
#[cfg(feature = "tls")]
#[derive(Debug)]
pub struct AnyPeer;

#[cfg(feature = "tls")]
impl ServerCertVerifier for AnyPeer {
    fn verify_server_cert(
        &self,
        _: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        let provider = ring::default_provider();
        provider
            .signature_verification_algorithms
            .supported_schemes()
    }
}
