//! A gateway with an HTTP listener.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use serde_json::Value;

use crate::common::{Host, Running};

/// Timeout for hanging tests.
const WATCHDOG: Duration = Duration::from_secs(60);

/// A gateway with an HTTP listener.
pub(crate) struct Shown {
    pub(crate) gateway: Running,
    pub(crate) address: SocketAddr,
    pub(crate) token: String,
}

impl Shown {
    /// Starts the gateway with this address and these settings.
    pub(crate) fn start(host: &Host, listen: &str, settings: &[&str]) -> Self {
        let listen = format!("http.listen={listen}");
        let settings = [&*listen].into_iter().chain(settings.iter().copied());
        let settings = settings.flat_map(|setting| ["--set", setting]);
        let arguments: Vec<_> = ["up", "--json"].into_iter().chain(settings).collect();
        let gateway = host.start(&arguments);
        let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
        let file = ready["http"]["token_file"].as_str().unwrap();
        Self {
            gateway,
            address: ready["http"]["address"].as_str().unwrap().parse().unwrap(),
            token: fs::read_to_string(file).unwrap().trim_end().to_owned(),
        }
    }

    pub(crate) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        stream
    }

    /// Sends a request. Returns the status, the headers, and the body of the answer.
    pub(crate) fn exchange(&self, request: &str) -> (u16, String, String) {
        let (status, head, body) = self.exchange_bytes(request);
        (status, head, String::from_utf8(body).unwrap())
    }

    /// The same with a body of bytes.
    pub(crate) fn exchange_bytes(&self, request: &str) -> (u16, String, Vec<u8>) {
        let mut stream = self.connect();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|it| it == b"\r\n\r\n").unwrap();
        let body = answer.split_off(end + 4);
        answer.truncate(end);
        let head = String::from_utf8(answer).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head, body)
    }

    /// The header with the token.
    pub(crate) fn bearer(&self) -> String {
        format!("Authorization: Bearer {}\r\n", self.token)
    }
}
