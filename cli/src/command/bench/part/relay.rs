//! Half of a bare relay, iceoryx2 to TCP to iceoryx2: what the way through two gateways is
//! compared with. The same bytes go through as many processes, and the acknowledgement comes back
//! from the last one; there is no envelope, no directory and no promise.
//!
//! Everything in order, so the acknowledgement needs no number: one byte of TCP.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};

use fipa::Config;
use fipa_transport_shm::raw::{RawClient, RawNode, RawPending, RawRequest, RawServer, Wait};

use super::iceoryx::node;
use super::orders::{End, Event, Peer, obey, say, told};

/// The name of the service on either side.
const NAME: &str = "raw";

/// `Sender`: the half on the sender's side, with a server that the sender writes to, and a
/// connection to the other half. `Receiver`: the other half.
pub(super) fn play(config: &Config, end: End) -> Result<(), String> {
    let node = node(config)?;
    match end {
        End::Sender => near(&node),
        End::Receiver => far(&node),
    }
}

fn near(node: &RawNode) -> Result<(), String> {
    let server = node.serve(NAME).map_err(told)?;
    let server = &server;
    std::thread::scope(|scope| {
        let start = |stream: TcpStream| {
            let (to_answer, answers) = channel();
            let back = stream.try_clone().map_err(told)?;
            scope.spawn(move || ended(send_on(server, stream, &to_answer)));
            scope.spawn(move || ended(answer(server, back, &answers)));
            Ok(())
        };
        obey(&mut Half { start }, String::new());
        // The threads wait for the other processes, which may be gone; they end with this one.
        std::process::exit(0)
    })
}

/// From shared memory to the socket.
fn send_on(
    server: &RawServer,
    mut stream: TcpStream,
    to_answer: &Sender<RawRequest>,
) -> Result<(), String> {
    loop {
        let request = server.receive(Wait::Block).map_err(told)?;
        let payload = request.payload();
        let len = u64::try_from(payload.len()).map_err(told)?.to_le_bytes();
        write_both(&mut stream, &len, payload).map_err(told)?;
        to_answer.send(request).map_err(told)?;
    }
}

/// In one system call where the kernel takes it.
fn write_both(stream: &mut TcpStream, first: &[u8], second: &[u8]) -> std::io::Result<()> {
    let mut slices = [std::io::IoSlice::new(first), std::io::IoSlice::new(second)];
    let mut slices = &mut slices[..];
    while !slices.is_empty() {
        let written = stream.write_vectored(slices)?;
        std::io::IoSlice::advance_slices(&mut slices, written);
    }
    Ok(())
}

/// From the socket's acknowledgements to the sender.
fn answer(
    server: &RawServer,
    mut stream: TcpStream,
    answers: &Receiver<RawRequest>,
) -> Result<(), String> {
    let mut bytes = [0; 64];
    loop {
        let acknowledged = stream.read(&mut bytes).map_err(told)?;
        if acknowledged == 0 {
            return Ok(());
        }
        for _ in 0..acknowledged {
            let request = answers.recv().map_err(told)?;
            server.answer(request, Wait::Block).map_err(told)?;
        }
    }
}

fn far(node: &RawNode) -> Result<(), String> {
    let listener = TcpListener::bind("127.0.0.1:0").map_err(told)?;
    let address = listener.local_addr().map_err(told)?.to_string();
    let client = node.connect(NAME).map_err(told)?;
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
                Err(error) => ended(Err(told(error))),
            }
        });
        let nobody = |_| Err("this half of the relay does not connect".to_owned());
        obey(&mut Half { start: nobody }, address);
        std::process::exit(0)
    })
}

/// From the socket into shared memory, without a buffer in between.
fn take_in(
    client: &RawClient<'_>,
    mut stream: TcpStream,
    to_await: &Sender<RawPending>,
) -> Result<(), String> {
    let mut len = [0; 8];
    // How many may be on their way to the receiver is the sender's business.
    while stream.read_exact(&mut len).is_ok() {
        let len = usize::try_from(u64::from_le_bytes(len)).map_err(told)?;
        let mut loan = client.loan(len).map_err(told)?;
        stream.read_exact(loan.content_mut()).map_err(told)?;
        let pending = client.send(loan, Wait::Block).map_err(told)?;
        to_await.send(pending).map_err(told)?;
    }
    Ok(())
}

/// From the receiver's answers to the socket.
fn acknowledge(
    client: &RawClient<'_>,
    mut stream: TcpStream,
    pending: &Receiver<RawPending>,
) -> Result<(), String> {
    while let Ok(pending) = pending.recv() {
        client.answered(&pending, Wait::Block).map_err(told)?;
        // Makes room for the next one before that is called for.
        drop(pending);
        stream.write_all(&[1]).map_err(told)?;
    }
    Ok(())
}

fn ended(result: Result<(), String>) {
    if let Err(what) = result {
        say(&Event::Failed { what });
    }
}

/// What is told to a half: where the other one is, and how much time it took.
struct Half<S> {
    start: S,
}

impl<S: FnMut(TcpStream) -> Result<(), String>> Peer for Half<S> {
    fn find(&mut self, to: &str) -> Result<(), String> {
        let stream = TcpStream::connect(to).map_err(told)?;
        stream.set_nodelay(true).map_err(told)?;
        (self.start)(stream)
    }
}
