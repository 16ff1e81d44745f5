//! A headless browser, by the WebDriver protocol of W3C.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::{Command, Stdio};
use std::time::Duration;

use fipa_testbed::{ChildGuard, can_run, until, until_some};
use serde_json::{Value, json};

/// Timeout for hanging tests.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Maximum number of starts of the driver. It takes a free port of IPv4, and ends if that port of IPv6 is taken.
const MOST_STARTS: usize = 5;

/// A window of a browser. Ends with it.
pub(crate) struct Browser {
    _driver: ChildGuard,
    address: SocketAddr,
    session: String,
}

impl Browser {
    /// Opens a window of this size, in CSS pixels; `None` if there is no browser. Then prints a note with the name of
    /// the test.
    pub(crate) fn open(name: &str, width: u32, height: u32) -> Option<Self> {
        can_run(name, &["chromium", "chromedriver"], true).then_some(())?;
        let (driver, port) = (0..MOST_STARTS).find_map(|_| start_driver()).unwrap();
        let mut browser = Self {
            _driver: driver,
            address: SocketAddr::from(([127, 0, 0, 1], port)),
            session: String::new(),
        };
        let size = format!("--window-size={width},{height}");
        let mut arguments = vec![
            "--headless=new",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            &size,
        ];
        if rustix::process::geteuid().is_root() {
            arguments.push("--no-sandbox");
        }
        let options = json!({ "args": arguments });
        let capabilities = json!({
            "goog:chromeOptions": options, "goog:loggingPrefs": { "browser": "ALL" },
            // A gateway has a certificate of its own, without an authority.
            "acceptInsecureCerts": true,
        });
        let created = browser.post(
            "/session",
            &json!({ "capabilities": { "alwaysMatch": capabilities } }),
        );
        browser.session = format!("/session/{}", created["sessionId"].as_str().unwrap());
        // Smaller than the smallest window.
        browser.command("/goog/cdp/execute", &json!({
            "cmd": "Emulation.setDeviceMetricsOverride",
            "params": { "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500 },
        }));
        Some(browser)
    }

    /// A command of Chromium itself.
    pub(crate) fn chromium(&self, command: &str) {
        self.command(
            "/goog/cdp/execute",
            &json!({ "cmd": command, "params": {} }),
        );
    }

    /// Opens the page of a gateway with its token in a window of this size, and waits until it is live.
    pub(crate) fn open_page(
        name: &str,
        (width, height): (u32, u32),
        (address, token): (SocketAddr, &str),
    ) -> Option<Self> {
        let browser = Self::open(name, width, height)?;
        browser.go_to(&format!("http://{address}/#token={token}"));
        until("the page is live", || {
            browser.value("document.getElementById('state').textContent") == "live"
        });
        Some(browser)
    }

    pub(crate) fn go_to(&self, address: &str) {
        self.command("/url", &json!({ "url": address }));
    }

    /// The value of a JavaScript expression in the page.
    pub(crate) fn value(&self, expression: &str) -> Value {
        let script = format!("return ({expression})");
        self.command("/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// The text that the page shows.
    pub(crate) fn text(&self) -> String {
        self.value("document.body.innerText")
            .as_str()
            .unwrap()
            .to_owned()
    }

    /// Waits until the page shows a text.
    pub(crate) fn wait_for(&self, text: &str) {
        until_some(&format!("{text:?} on the page"), || {
            self.text().contains(text).then_some(())
        });
    }

    /// The only cookie of the page.
    pub(crate) fn cookie(&self) -> Value {
        let path = format!("{}/cookie", self.session);
        let head = format!("GET {path} HTTP/1.1\r\nHost: {}\r\n", self.address);
        let mut cookies = self.exchange(&format!("{head}\r\n"));
        let cookies = cookies.as_array_mut().unwrap();
        assert_eq!(cookies.len(), 1, "{cookies:?}");
        cookies.remove(0)
    }

    /// The messages of the browser about the page: errors of its scripts, and what its policy forbids.
    pub(crate) fn messages(&self) -> Vec<String> {
        let log = self.command("/se/log", &json!({ "type": "browser" }));
        let entries = log.as_array().unwrap().iter();
        entries
            .map(|entry| entry["message"].as_str().unwrap().to_owned())
            .collect()
    }

    pub(crate) fn assert_no_messages(&self) {
        assert_eq!(self.messages(), Vec::<String>::new());
    }

    fn command(&self, path: &str, body: &Value) -> Value {
        self.post(&format!("{}{path}", self.session), body)
    }

    fn post(&self, path: &str, body: &Value) -> Value {
        let body = body.to_string();
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: {}\r\nContent-Length: {}\r\n",
            self.address,
            body.len()
        );
        self.exchange(&format!("{head}\r\n{body}"))
    }

    fn exchange(&self, request: &str) -> Value {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        // The driver keeps its connections open.
        let mut answer = BufReader::new(stream);
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            assert_ne!(answer.read_until(b'\n', &mut head).unwrap(), 0);
        }
        let head = String::from_utf8(head).unwrap().to_ascii_lowercase();
        let length = head
            .lines()
            .find_map(|line| line.strip_prefix("content-length:"))
            .unwrap();
        let mut body = vec![0; length.trim().parse().unwrap()];
        answer.read_exact(&mut body).unwrap();
        let mut answer: Value = serde_json::from_slice(&body).unwrap();
        assert!(head.starts_with("http/1.1 200"), "{request}: {answer:#}");
        answer["value"].take()
    }
}

/// Starts the driver, and returns it with its port; `None` if it ends at once.
fn start_driver() -> Option<(ChildGuard, u16)> {
    let mut driver = Command::new("chromedriver");
    driver
        .arg("--port=0")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null());
    let mut driver = ChildGuard::start(&mut driver);
    let mut lines = BufReader::new(driver.child().stdout.take().unwrap()).lines();
    let port = lines.find_map(|line| {
        let line = line.unwrap();
        let port = line
            .strip_suffix('.')?
            .split_once("started successfully on port ")?
            .1;
        port.parse().ok()
    })?;
    // The driver writes nothing more of interest, but must not fail at it.
    std::thread::spawn(move || lines.for_each(drop));
    Some((driver, port))
}

impl Drop for Browser {
    fn drop(&mut self) {
        if self.session.is_empty() {
            return;
        }
        // The browser ends with its session, also after a failure. A panic during another one would end all tests.
        let end = || -> std::io::Result<()> {
            let mut stream = TcpStream::connect(self.address)?;
            stream.set_read_timeout(Some(WATCHDOG))?;
            let (session, address) = (&self.session, self.address);
            write!(
                stream,
                "DELETE {session} HTTP/1.1\r\nHost: {address}\r\n\r\n"
            )?;
            stream.read_exact(&mut [0])
        };
        let ended = end();
        if !std::thread::panicking() {
            ended.unwrap();
        }
    }
}
