//! Half of a bare relay iceoryx2 → network → iceoryx2, the limit of two gateways. The same bytes pass through
//! as many processes, and the last one acknowledges. There is no envelope, no directory and no promise.
//!
//! All letters stay in order, so an acknowledgment is one byte without a number.

use std::io::{IoSlice, Read, Write};
use std::sync::mpsc::{Receiver, Sender, channel};

use fipa::Config;
use fipa_transport_shm::raw::{RawClient, RawNode, RawPending, RawRequest, RawServer, Wait};

use super::iceoryx::node;
use super::orders::{End, Event, Peer, execute_orders, say, to_text};
use super::wire::{self, Connection, Listener, Wire};

/// Name of the service on both sides.
const NAME: &str = "raw";

/// Plays the half on the sender's side (`Sender`), with a server for the sender and a connection to
/// the other half, or that other half (`Receiver`).
pub(super) fn play(config: &Config, end: End, wire: Wire) -> Result<(), String> {
    let node = node(config)?;
    match end {
        End::Sender => near(&node, wire),
        End::Receiver => far(&node, wire),
    }
}

fn near(node: &RawNode, wire: Wire) -> Result<(), String> {
    let server = node.serve(NAME).map_err(to_text)?;
    let server = &server;
    std::thread::scope(|scope| {
        let connect = |to: &str| {
            let Connection { send, receive } = wire::connect(wire, to)?;
            let (to_answer, answers) = channel();
            scope.spawn(move || ended(send_on(server, send, &to_answer)));
            scope.spawn(move || ended(answer(server, receive, &answers)));
            Ok(())
        };
        execute_orders(&mut Half { connect }, String::new());
        // The threads may wait for processes that have ended, so they are not joined.
        std::process::exit(0)
    })
}

/// Copies requests from shared memory to the connection.
fn send_on(
    server: &RawServer,
    mut connection: impl Write,
    to_answer: &Sender<RawRequest>,
) -> Result<(), String> {
    loop {
        let request = server.receive(Wait::Block).map_err(to_text)?;
        let payload = request.payload();
        let len = u64::try_from(payload.len()).map_err(to_text)?.to_le_bytes();
        write_both(&mut connection, &len, payload).map_err(to_text)?;
        to_answer.send(request).map_err(to_text)?;
    }
}

/// Writes both slices, together where the connection accepts it.
fn write_both(connection: &mut impl Write, first: &[u8], second: &[u8]) -> std::io::Result<()> {
    let mut slices = [IoSlice::new(first), IoSlice::new(second)];
    let mut slices = &mut slices[..];
    while !slices.is_empty() {
        let written = connection.write_vectored(slices)?;
        IoSlice::advance_slices(&mut slices, written);
    }
    connection.flush()
}

/// Turns acknowledgments from the connection into responses to the sender.
fn answer(
    server: &RawServer,
    mut connection: impl Read,
    answers: &Receiver<RawRequest>,
) -> Result<(), String> {
    let mut bytes = [0; 64];
    loop {
        let acknowledged = connection.read(&mut bytes).map_err(to_text)?;
        if acknowledged == 0 {
            return Ok(());
        }
        for _ in 0..acknowledged {
            let request = answers.recv().map_err(to_text)?;
            server.answer(request, Wait::Block).map_err(to_text)?;
        }
    }
}

fn far(node: &RawNode, wire: Wire) -> Result<(), String> {
    let listener = Listener::bind(wire)?;
    let address = listener.address()?;
    let client = node.connect(NAME).map_err(to_text)?;
    let client = &client;
    std::thread::scope(|scope| {
        scope.spawn(move || match listener.accept() {
            Ok(Connection { send, receive }) => {
                let (to_await, pending) = channel();
                scope.spawn(move || ended(take_in(client, receive, &to_await)));
                ended(acknowledge(client, send, &pending));
            }
            Err(error) => ended(Err(error)),
        });
        let connect = |_: &str| Err("this half accepts the connection".to_owned());
        execute_orders(&mut Half { connect }, address);
        std::process::exit(0)
    })
}

/// Reads from the connection into shared memory, without a buffer in between.
fn take_in(
    client: &RawClient<'_>,
    mut connection: impl Read,
    to_await: &Sender<RawPending>,
) -> Result<(), String> {
    let mut len = [0; 8];
    // The sender bounds the number of letters in flight.
    while connection.read_exact(&mut len).is_ok() {
        let len = usize::try_from(u64::from_le_bytes(len)).map_err(to_text)?;
        let mut loan = client.loan(len).map_err(to_text)?;
        connection.read_exact(loan.content_mut()).map_err(to_text)?;
        let pending = client.send(loan, Wait::Block).map_err(to_text)?;
        to_await.send(pending).map_err(to_text)?;
    }
    Ok(())
}

/// Turns responses of the receiver into acknowledgments on the connection.
fn acknowledge(
    client: &RawClient<'_>,
    mut connection: impl Write,
    pending: &Receiver<RawPending>,
) -> Result<(), String> {
    while let Ok(pending) = pending.recv() {
        client.answered(&pending, Wait::Block).map_err(to_text)?;
        // Frees the slot before the sender needs it for the next letter.
        drop(pending);
        connection.write_all(&[1]).map_err(to_text)?;
        connection.flush().map_err(to_text)?;
    }
    Ok(())
}

fn ended(result: Result<(), String>) {
    if let Err(what) = result {
        say(&Event::Failed { what });
    }
}

/// A half as a part: it connects to the other half and reports its processor time.
struct Half<C> {
    connect: C,
}

impl<C: FnMut(&str) -> Result<(), String>> Peer for Half<C> {
    fn find(&mut self, to: &str) -> Result<(), String> {
        (self.connect)(to)
    }
}
