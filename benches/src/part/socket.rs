//! Bare blocking sockets: content in one direction, one byte back as the acknowledgment.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;

use super::Socket;
use super::iceoryx::make_ready;
use super::orders::{
    End, Fill, Letters, Peer, Sent, byte_of, check, execute_orders, now_ns, to_text,
};

pub(super) fn play(end: End, kind: Socket) -> Result<(), String> {
    match (kind, end) {
        (Socket::Tcp, End::Receiver) => {
            let listener = TcpListener::bind("127.0.0.1:0").map_err(to_text)?;
            let address = listener.local_addr().map_err(to_text)?.to_string();
            let accept = move || {
                let (stream, _) = listener.accept()?;
                stream.set_nodelay(true)?;
                Ok(stream)
            };
            execute_orders(&mut Receiver::new(accept), address);
        }
        (Socket::Unix, End::Receiver) => {
            let place =
                std::env::var_os("FIPA_RUNTIME_DIR").ok_or("FIPA_RUNTIME_DIR is not set")?;
            let path = PathBuf::from(place).join("socket");
            let listener = UnixListener::bind(&path).map_err(to_text)?;
            let accept = move || Ok(listener.accept()?.0);
            execute_orders(&mut Receiver::new(accept), path.display().to_string());
        }
        (Socket::Tcp, End::Sender) => {
            let connect = |to: &str| {
                let stream = TcpStream::connect(to)?;
                stream.set_nodelay(true)?;
                Ok(stream)
            };
            execute_orders(&mut Sender::new(connect), String::new());
        }
        (Socket::Unix, End::Sender) => {
            let connect = |to: &str| UnixStream::connect(to);
            execute_orders(&mut Sender::new(connect), String::new());
        }
    }
    Ok(())
}

struct Receiver<S, A> {
    accept: A,
    stream: Option<S>,
    buffer: Vec<u8>,
}

impl<S, A> Receiver<S, A> {
    fn new(accept: A) -> Self {
        Self {
            accept,
            stream: None,
            buffer: Vec::new(),
        }
    }
}

impl<S: Read + Write, A: Fn() -> std::io::Result<S>> Peer for Receiver<S, A> {
    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let stream = match &mut self.stream {
            Some(stream) => stream,
            none => none.insert((self.accept)().map_err(to_text)?),
        };
        self.buffer.resize(letters.size, 0);
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            stream.read_exact(&mut self.buffer).map_err(to_text)?;
            at.push(now_ns());
            check(&self.buffer, letters, number)?;
            stream.write_all(&[1]).map_err(to_text)?;
        }
        Ok(at)
    }
}

struct Sender<S, C> {
    connect: C,
    stream: Option<S>,
    ready: Vec<u8>,
    answers: Vec<u8>,
}

impl<S, C> Sender<S, C> {
    fn new(connect: C) -> Self {
        Self {
            connect,
            stream: None,
            ready: Vec::new(),
            answers: Vec::new(),
        }
    }
}

impl<S: Read + Write, C: Fn(&str) -> std::io::Result<S>> Peer for Sender<S, C> {
    fn find(&mut self, to: &str) -> Result<(), String> {
        self.stream = Some((self.connect)(to).map_err(to_text)?);
        Ok(())
    }

    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let stream = self.stream.as_mut().ok_or("not connected")?;
        let mut sent = Sent::with_room(letters);
        self.answers.resize(letters.window, 0);
        for number in 0..letters.count {
            while sent.began.len() - sent.ended.len() >= letters.window {
                let answers = stream.read(&mut self.answers).map_err(to_text)?;
                if answers == 0 {
                    return Err("the other end has closed the connection".to_owned());
                }
                sent.ended.extend(std::iter::repeat_n(now_ns(), answers));
            }
            begin(&mut self.ready, letters, number, &mut sent);
            stream.write_all(&self.ready).map_err(to_text)?;
        }
        while sent.ended.len() < sent.began.len() {
            stream.read_exact(&mut [0]).map_err(to_text)?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }
}

/// Makes the content of a letter and records its start. Without loans, content that is not filled is
/// prepared before.
fn begin(ready: &mut Vec<u8>, letters: &Letters, number: usize, sent: &mut Sent) {
    let byte = byte_of(number);
    if letters.fill == Fill::Filled {
        ready.resize(letters.size, 0);
        sent.began.push(now_ns());
        ready.fill(byte);
    } else {
        make_ready(ready, letters.size, byte);
        sent.began.push(now_ns());
    }
}
