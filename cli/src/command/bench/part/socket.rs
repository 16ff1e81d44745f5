//! Bare sockets, blocking: content one way, one byte back as the acknowledgement.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::time::Duration;

use super::Socket;
use super::iceoryx::make_ready;
use super::orders::{End, Fill, Letters, Peer, Sent, byte_of, check, now_ns, obey, told};

/// How long a datagram is waited for before it is sent again.
const LOST: Duration = Duration::from_millis(50);

/// How often a datagram is sent before nobody seems to be there.
const TRIES: u32 = 100;

pub(super) fn play(end: End, kind: Socket) -> Result<(), String> {
    match (kind, end) {
        (Socket::Tcp, End::Receiver) => {
            let listener = TcpListener::bind("127.0.0.1:0").map_err(told)?;
            let address = listener.local_addr().map_err(told)?.to_string();
            let accept = move || {
                let (stream, _) = listener.accept()?;
                stream.set_nodelay(true)?;
                Ok(stream)
            };
            obey(&mut Receiver::new(accept), address);
        }
        (Socket::Unix, End::Receiver) => {
            let place =
                std::env::var_os("FIPA_RUNTIME_DIR").ok_or("FIPA_RUNTIME_DIR is not set")?;
            let path = PathBuf::from(place).join("socket");
            let listener = UnixListener::bind(&path).map_err(told)?;
            let accept = move || Ok(listener.accept()?.0);
            obey(&mut Receiver::new(accept), path.display().to_string());
        }
        (Socket::Udp, End::Receiver) => {
            let socket = UdpSocket::bind("127.0.0.1:0").map_err(told)?;
            let address = socket.local_addr().map_err(told)?.to_string();
            obey(&mut Datagrams::new(socket), address);
        }
        (Socket::Tcp, End::Sender) => {
            let connect = |to: &str| {
                let stream = TcpStream::connect(to)?;
                stream.set_nodelay(true)?;
                Ok(stream)
            };
            obey(&mut Sender::new(connect), String::new());
        }
        (Socket::Unix, End::Sender) => {
            let connect = |to: &str| UnixStream::connect(to);
            obey(&mut Sender::new(connect), String::new());
        }
        (Socket::Udp, End::Sender) => {
            let socket = UdpSocket::bind("127.0.0.1:0").map_err(told)?;
            obey(&mut Datagrams::new(socket), String::new());
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
            none => none.insert((self.accept)().map_err(told)?),
        };
        self.buffer.resize(letters.size, 0);
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            stream.read_exact(&mut self.buffer).map_err(told)?;
            at.push(now_ns());
            check(&self.buffer, letters, number)?;
            stream.write_all(&[1]).map_err(told)?;
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
        self.stream = Some((self.connect)(to).map_err(told)?);
        Ok(())
    }

    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let stream = self.stream.as_mut().ok_or("not connected")?;
        let mut sent = Sent::with_room(letters);
        self.answers.resize(letters.window, 0);
        for number in 0..letters.count {
            while sent.began.len() - sent.ended.len() >= letters.window {
                let answers = stream.read(&mut self.answers).map_err(told)?;
                if answers == 0 {
                    return Err("the other end has closed the connection".to_owned());
                }
                sent.ended.extend(std::iter::repeat_n(now_ns(), answers));
            }
            begin(&mut self.ready, letters, number, &mut sent);
            stream.write_all(&self.ready).map_err(told)?;
        }
        while sent.ended.len() < sent.began.len() {
            stream.read_exact(&mut [0]).map_err(told)?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }
}

/// Makes the content of a letter and notes when it was begun. There is no memory to be loaned:
/// what is not filled is there before.
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

/// Either end of a way for datagrams. The acknowledgement is the letter's number; what is lost is
/// sent again.
struct Datagrams {
    socket: UdpSocket,
    buffer: Vec<u8>,
    /// Eight bytes of number and the content.
    ready: Vec<u8>,
    content: Vec<u8>,
    /// Letters of all batches so far.
    before: u64,
}

impl Datagrams {
    fn new(socket: UdpSocket) -> Self {
        Self {
            socket,
            buffer: vec![0; 1 << 16],
            ready: Vec::new(),
            content: Vec::new(),
            before: 0,
        }
    }

    fn is_acknowledged(&mut self, number: u64) -> Result<bool, String> {
        loop {
            match self.socket.recv(&mut self.buffer) {
                Ok(_) if number_of(&self.buffer) == number => return Ok(true),
                // An answer to a datagram that was sent twice.
                Ok(_) => {}
                Err(error) if is_timeout(&error) => return Ok(false),
                Err(error) => return Err(told(error)),
            }
        }
    }

    fn deliver(&mut self, number: u64) -> Result<(), String> {
        for _ in 0..TRIES {
            self.socket.send(&self.ready).map_err(told)?;
            if self.is_acknowledged(number)? {
                return Ok(());
            }
        }
        Err("no datagram is answered".to_owned())
    }
}

impl Peer for Datagrams {
    fn find(&mut self, to: &str) -> Result<(), String> {
        self.socket.connect(to).map_err(told)?;
        self.socket.set_read_timeout(Some(LOST)).map_err(told)
    }

    /// One at a time, whatever the window: a window of datagrams needs a protocol.
    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        for number in 0..letters.count {
            self.before += 1;
            let mut content = std::mem::take(&mut self.content);
            begin(&mut content, letters, number, &mut sent);
            self.ready.clear();
            self.ready.extend_from_slice(&self.before.to_le_bytes());
            self.ready.extend_from_slice(&content);
            self.content = content;
            self.deliver(self.before)?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }

    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        while at.len() < letters.count {
            let (len, from) = self.socket.recv_from(&mut self.buffer).map_err(told)?;
            let arrived = now_ns();
            let number = number_of(&self.buffer);
            if number > self.before {
                self.before = number;
                let content = self.buffer.get(8..len).unwrap_or_default();
                check(content, letters, at.len())?;
                at.push(arrived);
            }
            let answer = number.to_le_bytes();
            self.socket.send_to(&answer, from).map_err(told)?;
        }
        Ok(at)
    }
}

fn number_of(datagram: &[u8]) -> u64 {
    let bytes = datagram.first_chunk().copied().unwrap_or_default();
    u64::from_le_bytes(bytes)
}

fn is_timeout(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)
}
