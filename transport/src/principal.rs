//! The identity that a peer has proved.

/// The identity that a link proves for the service at its other end. Services are told apart only
/// by this, and not by their own claims.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Principal {
    /// A process of this user on this host: the link is shared memory, a Unix domain socket, or
    /// loopback if the host's owner has allowed that.
    Host,
    /// A process of another user of the domain on this host, by the number of the user: the link is a Unix domain
    /// socket.
    User(u32),
    /// The holder of the key of the certificate with this SHA-256 fingerprint (of its DER form).
    Certificate([u8; 32]),
    /// No proof. All services without proof count as one.
    Unproved,
}
