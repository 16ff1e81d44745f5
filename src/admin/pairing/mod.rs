//! Two hosts trust each other after a code, which one of them shows, was typed on the other.
//!
//! The listening host makes a code and opens a port ([`Listener`]). The dialing host connects and gets the same code
//! from its user ([`dial`]). Both agree on a key by SPAKE2 (in the form of the crate `spake2`, which is older
//! than RFC 9382): a host that guesses the code can test one guess, and one that only reads the messages can test none.
//! After each has proved that it has the key, they send each other their certificates, authenticated by the key.
//!
//! The wrong proof of one host ends the pairing, and the next one has another code. Connections that prove nothing do
//! not end it.
//!
//! Not in this module: the checks and the files of certificates ([`keys`](crate::admin::keys)).

mod code;
mod error;
mod exchange;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use fipa_transport_net::{AddressError, reachable_at, resolve};
use rand_core::OsRng;
use rustix::io::Errno;
use rustix::net::sockopt;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::task::{AbortHandle, JoinSet, spawn_blocking};
use tokio::time::{Instant, sleep, sleep_until, timeout};

pub use self::code::{Code, CodeError};
pub use self::error::PairingError;
use self::exchange::{Confirmed, Greeting, HELLO, Kind, REFUSAL, Role, TAG, Unconfirmed};
use crate::admin::keys::{Certificate, Keys};

/// Time in which a host with the code has to come.
pub const OPEN: Duration = Duration::from_secs(5 * 60);

/// Time for the messages up to the confirmation of the dialing host, and for those after it.
const ANSWER: Duration = Duration::from_secs(10);

/// Time from a hello to the answer, which hides the time of the computation: the crate `spake2` does not promise that
/// it takes equally long for each code.
const COMPUTATION: Duration = Duration::from_millis(20);

/// Maximum number of connections of unknown hosts at one time. A further one replaces the oldest one.
const MAX_CONNECTIONS: usize = 16;

/// Connections that the system holds until they are accepted.
const BACKLOG: u32 = 128;

/// Pause after a connection could not be accepted, for example because there are too many open files.
const PAUSE: Duration = Duration::from_millis(100);

/// The result of a pairing.
#[derive(Debug)]
#[non_exhaustive]
pub struct Paired {
    /// The certificate of the other host, which this host trusts now.
    pub certificate: Certificate,
    /// Whether the other host said that it trusts the certificate of this host.
    pub mutual: bool,
}

/// A host that waits for the one on which its code is typed. The port is open until the value is dropped.
#[derive(Debug)]
pub struct Listener {
    keys: Keys,
    own: Certificate,
    code: Code,
    socket: TcpListener,
    port: u16,
    until: Instant,
}

impl Listener {
    /// Makes a code, and listens on this port at all addresses of the host for [`OPEN`]; on port 0, the system chooses
    /// the port. Must be called within a tokio runtime.
    ///
    /// # Errors
    /// If this host has no keys, or the port cannot be opened.
    pub fn open(keys: &Keys, port: u16) -> Result<Self, PairingError> {
        let listen = || {
            let socket = listen(port)?;
            let port = socket.local_addr()?.port();
            Ok((socket, port))
        };
        let own = keys.own()?;
        let (socket, port) = listen().map_err(|source| PairingError::Listen { port, source })?;
        Ok(Self {
            keys: keys.clone(),
            own,
            code: Code::random().map_err(PairingError::Random)?,
            socket,
            port,
            until: Instant::now() + OPEN,
        })
    }

    /// The code to type on the other host.
    #[must_use]
    pub fn code(&self) -> &Code {
        &self.code
    }

    /// The port that is open.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.port
    }

    /// The addresses at which other hosts reach this one, best first. They include those of loopback if there are no
    /// others.
    ///
    /// # Errors
    /// If the network interfaces cannot be listed.
    pub fn addresses(&self) -> Result<Vec<SocketAddr>, AddressError> {
        reachable_at(&[format!("*:{}", self.port)])
    }

    /// Waits for the other host, and trusts its certificate.
    ///
    /// # Errors
    /// If no host came in time, if one came with a wrong code, or if the exchange or the trust failed.
    pub async fn pair(self) -> Result<Paired, PairingError> {
        let (stream, unconfirmed, theirs) = self.first_confirmation().await?;
        // Only one confirmation is ever judged: that is the only attempt.
        let Self {
            keys, own, socket, ..
        } = self;
        drop(socket);
        let confirmed = within_time(judge(stream, unconfirmed, &theirs)).await?;
        exchange(confirmed, &keys, &own).await
    }

    /// Returns the connection whose confirmation arrives first. The other ones are closed.
    async fn first_confirmation(
        &self,
    ) -> Result<(TcpStream, Unconfirmed, [u8; TAG]), PairingError> {
        let mut connections = JoinSet::new();
        let mut open: VecDeque<AbortHandle> = VecDeque::new();
        loop {
            tokio::select! {
                Some(ended) = connections.join_next() => match ended {
                    Ok(Ok(first)) => return Ok(first),
                    Ok(Err(error)) => tracing::debug!(%error, "a connection did not pair"),
                    Err(error) => tracing::debug!(%error, "a connection was closed for a newer one"),
                },
                accepted = self.socket.accept() => match accepted {
                    Ok((stream, peer)) => {
                        tracing::debug!(%peer, "a connection for the pairing");
                        open.retain(|connection| !connection.is_finished());
                        // A host without the code, which keeps its connections, must not keep out the one with it.
                        if open.len() >= MAX_CONNECTIONS && let Some(oldest) = open.pop_front() {
                            oldest.abort();
                        }
                        let code = self.code.clone();
                        open.push_back(connections.spawn(within_time(listen_to(stream, code))));
                    }
                    Err(error) => {
                        tracing::debug!(%error, "a connection cannot be accepted");
                        sleep(PAUSE).await;
                    }
                },
                () = sleep_until(self.until) => return Err(PairingError::Expired(OPEN)),
            }
        }
    }
}

/// Pairs with the host that listens at this address (`address:port` or `name:port`) and shows this code.
///
/// # Errors
/// If this host has no keys, if the other host cannot be reached or has another code, or if the exchange or the trust
/// failed.
pub async fn dial(keys: &Keys, address: &str, code: &Code) -> Result<Paired, PairingError> {
    let own = keys.own()?;
    let stream = connect(address).await?;
    let confirmed = within_time(dialed(stream, code)).await?;
    exchange(confirmed, keys, &own).await
}

async fn connect(address: &str) -> Result<TcpStream, PairingError> {
    let text = address.to_owned();
    let found = spawn_blocking(move || resolve(&text)).await;
    let found = found.map_err(io::Error::other).and_then(|found| found);
    let found = found.map_err(|source| PairingError::Address {
        address: address.to_owned(),
        source,
    })?;
    let mut failed = io::Error::from(io::ErrorKind::NotFound);
    for one in found {
        match timeout(ANSWER, TcpStream::connect(one)).await {
            Ok(Ok(stream)) => return Ok(stream),
            Ok(Err(error)) => failed = error,
            Err(_) => failed = io::ErrorKind::TimedOut.into(),
        }
    }
    Err(PairingError::Connect {
        address: address.to_owned(),
        source: failed,
    })
}

/// Opens a port for both families of addresses, or for IPv4 on a host without IPv6.
fn listen(port: u16) -> io::Result<TcpListener> {
    let both = TcpSocket::new_v6().and_then(|socket| {
        sockopt::set_ipv6_v6only(&socket, false)?;
        socket.bind((Ipv6Addr::UNSPECIFIED, port).into())?;
        Ok(socket)
    });
    let socket = match both {
        Ok(socket) => socket,
        Err(error) if lacks_ipv6(&error) => {
            let socket = TcpSocket::new_v4()?;
            socket.bind((Ipv4Addr::UNSPECIFIED, port).into())?;
            socket
        }
        Err(error) => return Err(error),
    };
    socket.listen(BACKLOG)
}

fn lacks_ipv6(error: &io::Error) -> bool {
    [Errno::AFNOSUPPORT, Errno::ADDRNOTAVAIL]
        .iter()
        .any(|errno| error.raw_os_error() == Some(errno.raw_os_error()))
}

async fn within_time<T>(
    work: impl Future<Output = Result<T, PairingError>>,
) -> Result<T, PairingError> {
    let done = timeout(ANSWER, work).await;
    done.unwrap_or(Err(PairingError::Silent(ANSWER)))
}

/// The listening host, up to the confirmation of the dialing host, which is not judged yet.
async fn listen_to<S: AsyncRead + AsyncWrite + Unpin>(
    mut stream: S,
    code: Code,
) -> Result<(S, Unconfirmed, [u8; TAG]), PairingError> {
    let theirs: [u8; HELLO] = read(&mut stream).await?;
    let answer = Instant::now() + COMPUTATION;
    let greeting = Greeting::new(Role::Listening, &code, OsRng);
    let ours = *greeting.hello();
    let unconfirmed = greeting.greeted(&theirs);
    sleep_until(answer).await;
    // Also a host of another version gets the hello, to tell its user.
    write(&mut stream, &ours).await?;
    let unconfirmed = unconfirmed?;
    let confirmation = read(&mut stream).await?;
    Ok((stream, unconfirmed, confirmation))
}

/// The listening host, from the confirmation of the dialing host to its own one.
async fn judge<S: AsyncWrite + Unpin>(
    mut stream: S,
    unconfirmed: Unconfirmed,
    theirs: &[u8; TAG],
) -> Result<(S, Confirmed), PairingError> {
    let ours = unconfirmed.confirmation();
    match unconfirmed.confirmed(theirs) {
        Ok(confirmed) => {
            write(&mut stream, &ours).await?;
            Ok((stream, confirmed))
        }
        Err(error) => {
            // The other host then says that the code was wrong, and the attempt is over in any case.
            if let Err(error) = write(&mut stream, &REFUSAL).await {
                tracing::debug!(%error, "the other host was not told that the code is wrong");
            }
            Err(error)
        }
    }
}

/// The dialing host, up to the confirmation of both.
async fn dialed<S: AsyncRead + AsyncWrite + Unpin>(
    mut stream: S,
    code: &Code,
) -> Result<(S, Confirmed), PairingError> {
    let greeting = Greeting::new(Role::Dialing, code, OsRng);
    write(&mut stream, greeting.hello()).await?;
    let theirs = read(&mut stream).await?;
    let unconfirmed = greeting.greeted(&theirs)?;
    write(&mut stream, &unconfirmed.confirmation()).await?;
    let theirs = read(&mut stream).await?;
    Ok((stream, unconfirmed.confirmed(&theirs)?))
}

/// Exchanges the certificates, and trusts the one of the other host. Both hosts do the same.
async fn exchange(
    (mut stream, confirmed): (impl AsyncRead + AsyncWrite + Unpin, Confirmed),
    keys: &Keys,
    own: &Certificate,
) -> Result<Paired, PairingError> {
    let theirs = within_time(certificate_of_peer(&mut stream, &confirmed, own)).await?;
    let trusted = keys.trust_der(&theirs);
    // Also a host that does not trust the other one tells it so.
    let mutual = within_time(verdict_of_peer(&mut stream, &confirmed, trusted.is_ok())).await;
    let certificate = trusted?;
    let mutual = mutual.unwrap_or_else(|error| {
        tracing::debug!(%error, "the other host did not say whether it trusts this one");
        false
    });
    Ok(Paired {
        certificate,
        mutual,
    })
}

/// Sends the certificate of this host, and returns that of the other one in DER.
async fn certificate_of_peer(
    stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
    confirmed: &Confirmed,
    own: &Certificate,
) -> Result<Vec<u8>, PairingError> {
    let der = own.der();
    let len = u32::try_from(der.len()).map_err(|_| PairingError::TooLong(der.len()))?;
    write(stream, &len.to_be_bytes()).await?;
    write(stream, &confirmed.tagged(Kind::Certificate, der)).await?;

    let len = u32::from_be_bytes(read(stream).await?) as usize;
    if len > Certificate::MAX_LEN {
        return Err(PairingError::TooLong(len));
    }
    let mut message = vec![0; len + TAG];
    let read_all = stream.read_exact(&mut message).await;
    read_all.map_err(PairingError::Ended)?;
    Ok(confirmed.body(Kind::Certificate, &message)?.to_vec())
}

/// Tells the other host whether this one trusts its certificate, and returns what it says.
async fn verdict_of_peer(
    stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
    confirmed: &Confirmed,
    trusted: bool,
) -> Result<bool, PairingError> {
    write(stream, &confirmed.tagged(Kind::Verdict, &[trusted.into()])).await?;
    let message: [u8; 1 + TAG] = read(stream).await?;
    Ok(confirmed.body(Kind::Verdict, &message)? == [1])
}

async fn read<const N: usize>(
    stream: &mut (impl AsyncRead + Unpin),
) -> Result<[u8; N], PairingError> {
    let mut bytes = [0; N];
    let read = stream.read_exact(&mut bytes).await;
    read.map_err(PairingError::Ended)?;
    Ok(bytes)
}

async fn write(stream: &mut (impl AsyncWrite + Unpin), bytes: &[u8]) -> Result<(), PairingError> {
    stream.write_all(bytes).await.map_err(PairingError::Ended)
}
