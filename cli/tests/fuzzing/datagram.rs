//! Datagrams of the UDP transport, of QUIC and of UDT.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fastrand::Rng;
use quinn::{ClientConfig, Endpoint, VarInt};
use tokio::net::UdpSocket;
use tokio::time::sleep;

use super::{Script, Writer, mutate};

/// Maximum length of a received datagram, in bytes.
const LARGEST: usize = 65_536;

/// Timeout for an answer, for opening a stream and for a write.
const TIMEOUT: Duration = Duration::from_millis(500);

async fn socket(to: SocketAddr) -> UdpSocket {
    let socket = UdpSocket::bind((to.ip(), 0)).await.unwrap();
    socket.connect(to).await.unwrap();
    socket
}

/// Sends each piece as a datagram. Returns the number of bytes sent.
pub(crate) async fn raw(to: SocketAddr, script: Script) -> u64 {
    let socket = socket(to).await;
    let mut sent = 0;
    for (mut piece, pause) in script.pieces {
        piece.truncate(60_000);
        // A full socket buffer counts as a lost datagram.
        if socket.send(&piece).await.is_ok() {
            sent += piece.len() as u64;
        }
        sleep(pause).await;
    }
    sent
}

fn header(kind: u8, to: u64) -> Vec<u8> {
    let mut bytes = b"fipa\x03".to_vec();
    bytes.extend([kind, 0, 0]);
    bytes.extend(to.to_le_bytes());
    bytes
}

/// Returns a hello of the UDP transport.
pub(crate) fn hello(number: u64, cookie: &[u8], body: &[u8]) -> Vec<u8> {
    let mut bytes = header(1, 0);
    bytes.extend(number.to_le_bytes());
    bytes.extend(cookie);
    bytes.extend((body.len() as u16).to_le_bytes());
    bytes.extend(body);
    bytes.resize(1200, 0);
    bytes
}

/// Opens a connection of the UDP transport and sends packets with mutations. Returns the number of
/// bytes sent, or `None` if the handshake failed.
pub(crate) async fn udp(to: SocketAddr, writer: &mut Writer<'_>) -> Option<u64> {
    let socket = socket(to).await;
    let number = writer.random.u64(1..);
    let body = writer.hello();
    let mut answer = [0; 2048];
    socket.send(&hello(number, &[0; 16], &body)).await.ok()?;
    let len = tokio::time::timeout(TIMEOUT, socket.recv(&mut answer))
        .await
        .ok()?
        .ok()?;
    let cookie = answer.get(16..32).filter(|_| len >= 32)?.to_vec();
    let mut again = vec![hello(number, &cookie, &body)];
    if writer.random.u8(..4) == 0 {
        mutate(writer.random, &mut again);
    }
    for packet in &again {
        socket.send(packet).await.ok()?;
    }
    let len = tokio::time::timeout(TIMEOUT, socket.recv(&mut answer))
        .await
        .ok()?
        .ok()?;
    let peer = answer.get(16..24).filter(|_| len >= 24)?;
    let peer = u64::from_le_bytes(peer.try_into().ok()?);
    let packets = (1..=writer.random.u64(1..8)).map(|packet| {
        let mut bytes = header(6, peer);
        bytes.extend(packet.to_le_bytes());
        match writer.random.u8(..8) {
            0 => {
                bytes.push(1);
                bytes.extend(writer.random.u64(..20).to_le_bytes());
                bytes.extend([0, 0, 0, 0, 2, 0xff, 0xff]);
            }
            1 => {
                let body = writer.answer();
                bytes.push(3);
                bytes.extend(packet.to_le_bytes());
                bytes.push(body.len() as u8);
                bytes.extend(body);
            }
            kind @ 2..4 => {
                bytes.push(kind + 2);
                bytes.extend(packet.to_le_bytes());
            }
            _ => {
                bytes.push(2);
                bytes.extend(packet.to_le_bytes());
                bytes.extend(writer.parcel());
            }
        }
        bytes
    });
    let packets: Vec<Vec<u8>> = packets.collect();
    let script = writer.recorded(&packets);
    let mut sent = 0;
    for (mut piece, pause) in script.pieces {
        piece.truncate(60_000);
        if socket.send(&piece).await.is_ok() {
            sent += piece.len() as u64;
        }
        sleep(pause).await;
    }
    Some(sent)
}

/// A packet of UDT to this socket: two words of its own, and the contents.
fn udt_packet(first: u32, second: u32, to: u32, contents: &[u8]) -> Vec<u8> {
    let header = [first, second, 0, to];
    let header: Vec<u8> = header.into_iter().flat_map(u32::to_be_bytes).collect();
    [&header, contents].concat()
}

/// The sequence number of the first packet of a UDT connection.
const UDT_INITIAL: u32 = 7;

/// Returns a handshake of UDT with this request and cookie.
fn udt_handshake(request: i32, socket: u32, cookie: u32) -> Vec<u8> {
    let (version, datagrams, max_packet, window) = (4, 2, 1500, 8192);
    let words = [
        [version, datagrams, UDT_INITIAL, max_packet],
        [window, request.cast_unsigned(), socket, cookie],
        [u32::from_le_bytes([127, 0, 0, 1]), 0, 0, 0],
    ];
    let contents = words.concat().into_iter().flat_map(u32::to_be_bytes);
    udt_packet(1 << 31, 0, 0, &contents.collect::<Vec<u8>>())
}

/// Opens a UDT connection and sends letters and control packets with mutations. Returns the number
/// of bytes sent, or `None` if the handshake failed.
pub(crate) async fn udt(to: SocketAddr, writer: &mut Writer<'_>) -> Option<u64> {
    const COOKIE: std::ops::Range<usize> = 44..48;
    const SOCKET: std::ops::Range<usize> = 40..44;
    let socket = socket(to).await;
    let id = writer.random.u32(1..1 << 30);
    let mut answer = [0; 2048];
    let mut asked = async |request: Vec<Vec<u8>>, field: std::ops::Range<usize>| {
        for packet in &request {
            socket.send(packet).await.ok()?;
        }
        let answered = tokio::time::timeout(TIMEOUT, socket.recv(&mut answer)).await;
        let len = answered.ok()?.ok()?;
        let word = answer[..len].get(field)?;
        Some(u32::from_be_bytes(word.try_into().ok()?))
    };
    let cookie = asked(vec![udt_handshake(1, id, 0)], COOKIE).await?;
    let mut again = vec![udt_handshake(-1, id, cookie)];
    if writer.random.u8(..4) == 0 {
        mutate(writer.random, &mut again);
    }
    let peer = asked(again, SOCKET).await?;
    let packets = writer.udt(peer, UDT_INITIAL);
    let script = writer.recorded(&packets);
    let mut sent = 0;
    for (mut piece, pause) in script.pieces {
        piece.truncate(60_000);
        if socket.send(&piece).await.is_ok() {
            sent += piece.len() as u64;
        }
        sleep(pause).await;
    }
    Some(sent)
}

/// Returns a packet of UDT with a part of a message.
pub(crate) fn udt_data(
    peer: u32,
    sequence: u32,
    (begins, ends): (bool, bool),
    message: u32,
    part: &[u8],
) -> Vec<u8> {
    let position = u32::from(begins) << 31 | u32::from(ends) << 30;
    udt_packet(sequence, position | 1 << 29 | message, peer, part)
}

/// Returns a packet of UDT that controls the connection.
pub(crate) fn udt_control(peer: u32, kind: u32, number: u32, words: &[u32]) -> Vec<u8> {
    let contents = words.iter().copied().flat_map(u32::to_be_bytes);
    let contents: Vec<u8> = contents.collect();
    udt_packet(1 << 31 | kind << 16, number, peer, &contents)
}

/// Returns the first datagram of a QUIC connection with this configuration.
pub(crate) async fn initial(config: &ClientConfig) -> Vec<u8> {
    let trap = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    let connecting = endpoint.connect_with(config.clone(), trap.local_addr().unwrap(), "x");
    let _connecting = connecting.unwrap();
    let mut packet = vec![0; LARGEST];
    let (len, _) = trap.recv_from(&mut packet).await.unwrap();
    packet.truncate(len);
    packet
}

/// Opens a QUIC connection as a trusted peer and writes to its streams. If `relayed` is set, the
/// datagrams pass a relay that mutates some of them. Returns the number of bytes written, or `None`
/// if the handshake failed.
pub(crate) async fn quic(
    to: SocketAddr,
    config: ClientConfig,
    script: Script,
    random: &mut Rng,
    relayed: bool,
) -> Option<u64> {
    let relay = match relayed {
        true => Some(Relay::before(to, random.fork()).await),
        false => None,
    };
    let at = relay.as_ref().map_or(to, |relay| relay.at);
    let endpoint = Endpoint::client((to.ip(), 0).into()).unwrap();
    let connecting = endpoint.connect_with(config, at, "x").unwrap();
    let connection = tokio::time::timeout(Duration::from_secs(3), connecting)
        .await
        .ok()?
        .ok()?;
    let (mut control, _answers) = connection.open_bi().await.ok()?;
    let mut written = 0;
    for (number, (piece, pause)) in script.pieces.into_iter().enumerate() {
        let to_control = number == 0 || random.u8(..4) == 0;
        let mut letter = match to_control {
            true => None,
            false => match tokio::time::timeout(TIMEOUT, connection.open_uni()).await {
                Ok(Ok(stream)) => Some(stream),
                _ => break,
            },
        };
        let stream = letter.as_mut().unwrap_or(&mut control);
        match tokio::time::timeout(TIMEOUT, stream.write_all(&piece)).await {
            Ok(Ok(())) => written += piece.len() as u64,
            _ => break,
        }
        if let Some(mut letter) = letter {
            // An error means that the connection is lost, which is allowed.
            let _ = match random.u8(..8) {
                0 => letter.reset(VarInt::from_u32(7)).is_ok(),
                _ => letter.finish().is_ok(),
            };
        }
        sleep(pause).await;
    }
    sleep(script.timeout).await;
    if random.bool() {
        connection.close(VarInt::from_u32(random.u32(..100)), b"enough");
        let _ = tokio::time::timeout(TIMEOUT, endpoint.wait_idle()).await;
    }
    Some(written)
}

/// A relay between a peer and the gateway. It mutates some datagrams of the peer.
struct Relay {
    at: SocketAddr,
    task: tokio::task::JoinHandle<()>,
}

impl Relay {
    async fn before(behind: SocketAddr, mut random: Rng) -> Self {
        let front = Arc::new(UdpSocket::bind((behind.ip(), 0)).await.unwrap());
        let back = socket(behind).await;
        let at = front.local_addr().unwrap();
        let task = tokio::spawn(async move {
            let (mut there, mut here) = (vec![0; LARGEST], vec![0; LARGEST]);
            let mut client = None;
            loop {
                tokio::select! {
                    Ok((len, from)) = front.recv_from(&mut there) => {
                        client = Some(from);
                        let mut packets = vec![there[..len].to_vec()];
                        if random.u8(..4) == 0 {
                            mutate(&mut random, &mut packets);
                        }
                        for mut packet in packets {
                            packet.truncate(60_000);
                            // A full socket buffer counts as a lost datagram.
                            let _ = back.send(&packet).await;
                        }
                    }
                    Ok(len) = back.recv(&mut here) => {
                        if let Some(client) = client {
                            let _ = front.send_to(&here[..len], client).await;
                        }
                    }
                    else => return,
                }
            }
        });
        Self { at, task }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.task.abort();
    }
}
