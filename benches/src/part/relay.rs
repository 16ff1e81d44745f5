//! Half of a bare relay iceoryx2 → TCP → iceoryx2, the limit of two gateways. The same bytes pass through
//! as many processes, and the last one acknowledges. There is no envelope, no directory and no promise.
//!
//! All letters stay in order, so an acknowledgment is one byte without a number.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};

use fipa::Config;
use fipa_transport_shm::raw::{RawClient, RawNode, RawPending, RawRequest, RawServer, Wait};

use super::iceoryx::node;
use super::orders::{End, Event, Peer, execute_orders, say, to_text};

/// Name of the service on both sides.
const NAME: &str = "raw";

/// Plays the half on the sender's side (`Sender`), with a server for the sender and a connection to
/// the other half, or that other half (`Receiver`).
pub(super) fn play(config: &Config, end: End) -> Result<(), String> {
    let node = node(config)?;
    match end {
        End::Sender => near(&node),
        End::Receiver => far(&node),
    }
}

fn near(node: &RawNode) -> Result<(), String> {
    let server = node.serve(NAME).map_err(to_text)?;
    let server = &server;
    std::thread::scope(|scope| {
        let start = |stream: TcpStream| {
            let (to_answer, answers) = channel();
            let back = stream.try_clone().map_err(to_text)?;
            scope.spawn(move || ended(send_on(server, stream, &to_answer)));
            scope.spawn(move || ended(answer(server, back, &answers)));
            Ok(())
        };
        execute_orders(&mut Half { start }, String::new());
        // The threads may wait for processes that have ended, so they are not joined.
        std::process::exit(0)
    })
}

/// Copies requests from shared memory to the socket.
fn send_on(
    server: &RawServer,
    mut stream: TcpStream,
    to_answer: &Sender<RawRequest>,
) -> Result<(), String> {
    loop {
        let request = server.receive(Wait::Block).map_err(to_text)?;
        let payload = request.payload();
        let len = u64::try_from(payload.len()).map_err(to_text)?.to_le_bytes();
        write_both(&mut stream, &len, payload).map_err(to_text)?;
        to_answer.send(request).map_err(to_text)?;
    }
}

/// Writes both slices, in one system call where the kernel accepts it.
fn write_both(stream: &mut TcpStream, first: &[u8], second: &[u8]) -> std::io::Result<()> {
    let mut slices = [std::io::IoSlice::new(first), std::io::IoSlice::new(second)];
    let mut slices = &mut slices[..];
    while !slices.is_empty() {
        let written = stream.write_vectored(slices)?;
        std::io::IoSlice::advance_slices(&mut slices, written);
    }
    Ok(())
}

/// Turns acknowledgments from the socket into responses to the sender.
fn answer(
    server: &RawServer,
    mut stream: TcpStream,
    answers: &Receiver<RawRequest>,
) -> Result<(), String> {
    let mut bytes = [0; 64];
    loop {
        let acknowledged = stream.read(&mut bytes).map_err(to_text)?;
        if acknowledged == 0 {
            return Ok(());
        }
        for _ in 0..acknowledged {
            let request = answers.recv().map_err(to_text)?;
            server.answer(request, Wait::Block).map_err(to_text)?;
        }
    }
}

fn far(node: &RawNode) -> Result<(), String> {
    let listener = TcpListener::bind("127.0.0.1:0").map_err(to_text)?;
    let address = listener.local_addr().map_err(to_text)?.to_string();
    let client = node.connect(NAME).map_err(to_text)?;
    let client = &client;
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let accepted = listener.accept().and_then(|(stream, _)| {
                stream.set_nodelay(true)?;
                Ok((stream.try_clone()?, stream))
            });
            match accepted {
                Ok((back, stream)) => {
                    let (to_await, pending) = channel();
                    scope.spawn(move || ended(take_in(client, stream, &to_await)));
                    ended(acknowledge(client, back, &pending));
                }
                Err(error) => ended(Err(to_text(error))),
            }
        });
        let refuse = |_| Err("this half accepts the connection".to_owned());
        execute_orders(&mut Half { start: refuse }, address);
        std::process::exit(0)
    })
}

/// Reads from the socket into shared memory, without a buffer in between.
fn take_in(
    client: &RawClient<'_>,
    mut stream: TcpStream,
    to_await: &Sender<RawPending>,
) -> Result<(), String> {
    let mut len = [0; 8];
    // The sender bounds the number of letters under path.
    while stream.read_exact(&mut len).is_ok() {
        let len = usize::try_from(u64::from_le_bytes(len)).map_err(to_text)?;
        let mut loan = client.loan(len).map_err(to_text)?;
        stream.read_exact(loan.content_mut()).map_err(to_text)?;
        let pending = client.send(loan, Wait::Block).map_err(to_text)?;
        to_await.send(pending).map_err(to_text)?;
    }
    Ok(())
}

/// Turns responses of the receiver into acknowledgments on the socket.
fn acknowledge(
    client: &RawClient<'_>,
    mut stream: TcpStream,
    pending: &Receiver<RawPending>,
) -> Result<(), String> {
    while let Ok(pending) = pending.recv() {
        client.answered(&pending, Wait::Block).map_err(to_text)?;
        // Frees the slot before the sender needs it for the next letter.
        drop(pending);
        stream.write_all(&[1]).map_err(to_text)?;
    }
    Ok(())
}

fn ended(result: Result<(), String>) {
    if let Err(what) = result {
        say(&Event::Failed { what });
    }
}

/// A half as a part: it connects to the other half and reports its processor time.
struct Half<S> {
    start: S,
}

impl<S: FnMut(TcpStream) -> Result<(), String>> Peer for Half<S> {
    fn find(&mut self, to: &str) -> Result<(), String> {
        let stream = TcpStream::connect(to).map_err(to_text)?;
        stream.set_nodelay(true).map_err(to_text)?;
        (self.start)(stream)
    }
}
