//! The Wireshark dissector `tools/wireshark/fipa.lua` on captures of real processes: the dissected fields are what was
//! sent, over every transport and both address families, in every encoding. Encrypted captures are dissected with
//! the key log of a gateway. Damaged captures cause no error of the dissector.
//!
//! The tests capture on the loopback interface, which needs root.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::io::Write as _;
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{Host, Running};
use fastrand::Rng;
use fipa_testbed::{ChildGuard, can_run, until, until_some};
use serde_json::{Map, Value, json};

const DISSECTOR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../tools/wireshark/fipa.lua");

/// Seed of the random decisions.
const SEED: u64 = 0x0f1b_a069;
/// Number of damaged conversations.
const DAMAGED: usize = 500;

/// Port of the accepting side in captures that a test writes.
const PORT: u16 = 7788;

fn is_possible(name: &str) -> bool {
    let is_root = rustix::process::geteuid().is_root();
    can_run(name, &["tshark", "dumpcap"], is_root)
}

/// `tshark` with the dissector and these options, on a capture.
fn tshark(capture: &Path, options: &[&str]) -> String {
    let mut command = Command::new("tshark");
    command
        .arg("-X")
        .arg(format!("lua_script:{DISSECTOR}"))
        .arg("-r")
        .arg(capture)
        .args(options);
    let output = command.stdin(Stdio::null()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!errors.contains("Lua"), "{errors}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The values of `fields` in each packet that `filter` selects.
fn fields(
    capture: &Path,
    options: &[&str],
    filter: &str,
    fields: &[&str],
) -> Vec<Map<String, Value>> {
    let mut all = vec!["-Y", filter, "-T", "json"];
    all.extend_from_slice(options);
    for field in fields {
        all.extend(["-e", field]);
    }
    let text = tshark(capture, &all);
    if text.trim().is_empty() {
        return Vec::new();
    }
    // A capture that is being written may end within a packet; `tshark` then ends the list nevertheless.
    let packets: Vec<Value> = serde_json::from_str(&text).unwrap_or_default();
    let layers = packets.iter().map(|packet| &packet["_source"]["layers"]);
    layers.filter_map(|it| it.as_object().cloned()).collect()
}

/// A running capture of one port of the loopback interface.
struct Capture {
    dumpcap: ChildGuard,
    path: PathBuf,
}

impl Capture {
    fn start(host: &Host, port: &str) -> Self {
        let path = host.path(&format!("{port}.pcapng"));
        let log = host.path(&format!("{port}.dumpcap"));
        let mut command = Command::new("dumpcap");
        let filter = format!("port {port}");
        command.args(["-q", "-i", "lo", "-f", &filter, "-w"]);
        let output = fs::File::create(&log).unwrap();
        command.arg(&path).stderr(output).stdout(Stdio::null());
        let dumpcap = ChildGuard::start(&mut command);
        until("dumpcap captures", || {
            fs::read_to_string(&log).unwrap().contains("File:")
        });
        Self { dumpcap, path }
    }

    /// Waits until the capture has a packet that the filter selects, and ends it.
    fn end(mut self, options: &[&str], filter: &str) -> PathBuf {
        until(filter, || {
            !fields(&self.path, options, filter, &["frame.number"]).is_empty()
        });
        self.dumpcap.signal("-INT");
        assert!(self.dumpcap.wait().success());
        self.path
    }
}

/// A gateway whose peer has sent letters to it. The transports of both are shared memory and `kind`.
struct Scene {
    kind: &'static str,
    ours: Host,
    theirs: Host,
    names: [String; 2],
    options: Vec<String>,
}

impl Scene {
    fn new(kind: &'static str, is_secured: bool) -> Self {
        let (ours, theirs) = (Host::new(), Host::new());
        let names = [
            format!("rover-{}", ours.domain),
            format!("crex-{}", theirs.domain),
        ];
        let mut options = vec![format!("mts.transports=[\"shm\", \"{kind}\"]")];
        if is_secured {
            let own = |host: &Host| host.path("keys/own.pem").display().to_string();
            let run = |host: &Host, name: &str, words: &[&str]| {
                let (name, dir) = (format!("mts.name={name}"), host.path("keys"));
                let dir = dir.display().to_string();
                host.run(&[&["keys"], words, &["--dir", &dir, "--set", &name]].concat())
                    .done()
            };
            run(&ours, &names[0], &["init"]);
            run(&theirs, &names[1], &["init"]);
            run(&ours, &names[0], &["trust", &own(&theirs)]);
            run(&theirs, &names[1], &["trust", &own(&ours)]);
            options.push("security.loopback=true".to_owned());
        }
        Self {
            kind,
            ours,
            theirs,
            names,
            options,
        }
    }

    /// A gateway with these settings.
    fn gateway(&self, is_ours: bool, settings: &[String], key_log: Option<&Path>) -> Running {
        let (host, name) = match is_ours {
            true => (&self.ours, &self.names[0]),
            false => (&self.theirs, &self.names[1]),
        };
        let mut all = vec![format!("mts.name={name}")];
        all.extend_from_slice(&self.options);
        all.extend_from_slice(settings);
        if host.path("keys").exists() {
            all.push(format!("security.keys={}", host.path("keys").display()));
        }
        let mut words = vec!["up", "--json", "-v"];
        for setting in &all {
            words.extend(["--set", setting]);
        }
        let mut command = host.command(&words);
        if let Some(path) = key_log {
            command.env("SSLKEYLOGFILE", path);
        }
        Running::new(command)
    }

    /// The gateway that listens on this address, and its location.
    fn listening(&self, address: &str) -> (Running, String, String) {
        let listen = format!("transport.{}.listen=[\"{address}:0\"]", self.kind);
        let gateway = self.gateway(false, &[listen], None);
        let location = gateway.location(self.kind);
        let port = location.rsplit(':').next().unwrap().to_owned();
        (gateway, location, port)
    }

    fn dialing(&self, location: &str, settings: &[String], key_log: Option<&Path>) -> Running {
        let peer = format!("discovery.static={{ {} = [{location:?}] }}", self.names[1]);
        self.gateway(true, &[settings, &[peer]].concat(), key_log)
    }

    /// Sends a letter until it is delivered.
    fn send(&self, words: &[&str]) {
        let words = [&["send", "--json"], words].concat();
        until_some("a letter is delivered", || {
            (self.ours.run(&words).code == Some(0)).then_some(())
        });
    }
}

/// The fields that are compared.
const COMPARED: [&str; 12] = [
    "fipa.performative",
    "fipa.sender",
    "fipa.receiver",
    "fipa.reply_with",
    "fipa.language",
    "fipa.ontology",
    "fipa.protocol",
    "fipa.conversation_id",
    "fipa.content_length",
    "fipa.content",
    "fipa.encoding",
    "fipa.envelope.to",
];

/// Options of `fipa send` for a letter, and its fields.
fn letter(arm: &str) -> (Vec<&str>, Value) {
    let options = vec![
        "--to",
        arm,
        "--from",
        "captain",
        "--performative",
        "request",
        "--protocol",
        "fipa-request",
        "--conversation-id",
        "the \"first\" one",
        "--reply-with",
        "béla 1",
        "--language",
        "fipa-sl",
        "--ontology",
        "lab",
        "--content",
        "((lift wörld))",
    ];
    let fields = json!({
        "fipa.performative": ["request"],
        "fipa.sender": ["captain"],
        "fipa.receiver": [arm],
        "fipa.reply_with": ["béla 1"],
        "fipa.language": ["fipa-sl"],
        "fipa.ontology": ["lab"],
        "fipa.protocol": ["fipa-request"],
        "fipa.conversation_id": ["the \"first\" one"],
        "fipa.content_length": ["15"],
        "fipa.content": ["((lift wörld))"],
        "fipa.encoding": ["bit-efficient"],
        "fipa.envelope.to": [arm],
    });
    (options, fields)
}

const OF_CAPTAIN: &str = "fipa.sender == \"captain\"";

/// Captures letters between two gateways, and compares what is dissected with what was sent.
fn compare(kind: &'static str, address: &str, is_secured: bool) {
    let scene = Scene::new(kind, is_secured);
    let arm = format!("arm-{}", scene.theirs.domain);
    let (_theirs, location, port) = scene.listening(address);
    let capture = Capture::start(&scene.ours, &port);
    let keys = scene.ours.path("secrets.log");
    let settings = match is_secured {
        true => vec!["security.key_log=true".to_owned()],
        false => Vec::new(),
    };
    let mut ours = scene.dialing(&location, &settings, Some(&keys));
    if is_secured {
        ours.wait_for_log(&["WARN", "everyone who reads this file can decrypt captured"]);
    }
    let _arm = scene.theirs.echo(&arm);
    let (words, expected) = letter(&arm);
    scene.send(&words);
    // Bytes that are no text, and the letter whose arrival in the capture ends it.
    let binary = scene.ours.path("binary");
    fs::write(&binary, [0, 0xff, 0x1b, b'a']).unwrap();
    let binary = binary.display().to_string();
    let last = [
        "--to",
        &arm,
        "--from",
        "captain",
        "--conversation-id",
        "last",
        "--content-file",
        &binary,
    ];
    scene.send(&last);

    let secrets = format!("tls.keylog_file:{}", keys.display());
    let options: &[&str] = match is_secured {
        true => &["-o", &secrets],
        false => &[],
    };
    let ended = format!("{OF_CAPTAIN} && fipa.conversation_id == \"last\"");
    let capture = capture.end(options, &ended);
    let filter = format!("{OF_CAPTAIN} && fipa.conversation_id != \"last\"");
    let found = fields(&capture, options, &filter, &COMPARED);
    assert!(!found.is_empty());
    for packet in found {
        assert_eq!(Value::from(packet), expected);
    }
    let found = fields(
        &capture,
        options,
        &ended,
        &["fipa.content_bytes", "fipa.content_length"],
    );
    assert_eq!(
        Value::from(found[0].clone()),
        json!({ "fipa.content_bytes": ["00ff1b61"], "fipa.content_length": ["4"] })
    );
    // Hellos and answers, and the column of information.
    let hellos = fields(
        &capture,
        options,
        "fipa.hello.name",
        &["fipa.hello.name", "fipa.hello.domain"],
    );
    let is_hello = |name: &str, host: &Host| {
        let hello = json!({ "fipa.hello.name": [name], "fipa.hello.domain": [host.domain] });
        hellos
            .iter()
            .any(|found| Value::from(found.clone()) == hello)
    };
    assert!(is_hello(&scene.names[0], &scene.ours), "{hellos:?}");
    assert!(is_hello(&scene.names[1], &scene.theirs), "{hellos:?}");
    assert!(!fields(&capture, options, "fipa.answer", &["fipa.answer"]).is_empty());
    let info = fields(&capture, options, &filter, &["_ws.col.Info"]);
    let info = info[0]["_ws.col.Info"][0].as_str().unwrap();
    let summary =
        format!("request captain → {arm}, fipa-request, conversation the \"first\" one, 15 bytes");
    assert!(info.contains(&summary), "{info}");
    let wrong = fields(
        &capture,
        options,
        "fipa.malformed || fipa.fault",
        &["_ws.expert.message"],
    );
    assert!(wrong.is_empty(), "{wrong:?}");
    if is_secured {
        let mode = fs::metadata(&keys).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode, 0o600);
        let without = fields(&capture, &[], "fipa.performative", &["fipa.performative"]);
        assert!(
            without.is_empty(),
            "the capture is not encrypted: {without:?}"
        );
    }
}

macro_rules! compares {
    ($($name:ident: $kind:literal, $address:literal, $is_secured:literal;)*) => {$(
        #[test]
        fn $name() {
            if is_possible(stringify!($name)) {
                compare($kind, $address, $is_secured);
            }
        }
    )*};
}

compares! {
    letters_over_tcp_and_ipv4_are_dissected: "tcp", "127.0.0.1", false;
    letters_over_tcp_and_ipv6_are_dissected: "tcp", "[::1]", false;
    letters_over_udp_and_ipv4_are_dissected: "udp", "127.0.0.1", false;
    letters_over_udp_and_ipv6_are_dissected: "udp", "[::1]", false;
    letters_over_tls_are_dissected_with_the_key_log: "tcp", "[::1]", true;
    letters_over_quic_are_dissected_with_the_key_log: "quic", "127.0.0.1", true;
}

/// Letters of legacy peers, in every encoding of messages, over a connection without frames.
fn compare_letters_without_frames(address: &str) {
    let host = Host::new();
    let listen = format!("transport.tcp.listen=[\"{address}:0\"]");
    let gateway = host.start(&["up", "--json", "--set", &listen]);
    let location = gateway.location("tcp");
    let port = location.rsplit(':').next().unwrap();
    let capture = Capture::start(&host, port);
    let encodings = [
        ("bit-efficient", "bit-efficient"),
        ("string", "string"),
        ("xml", "XML"),
    ];
    for (representation, _) in encodings {
        let message = json!({
            "envelope": { "base": { "to": [{ "name": "arm" }], "from": { "name": "captain" },
                "date": "2030-01-31T12:00:00Z" } },
            "message": {
                "performative": "request", "sender": { "name": "captain", "addresses": ["tcp://127.0.0.1:9"] },
                "receivers": [{ "name": "arm" }, { "name": "brake" }], "reply_with": "béla 1", "language": "fipa-sl",
                "ontology": "lab", "protocol": "fipa-request", "conversation_id": representation,
                "content": "((lift (sample 3)))", "user_defined": { "color": "dark red" },
            },
        });
        let encode = ["encode", "--representation", representation];
        let encoded = host.run_with_input(&encode, message.to_string().as_bytes());
        assert_eq!(encoded.code, Some(0), "{encoded:?}");
        let mut stream = TcpStream::connect(location.strip_prefix("tcp://").unwrap()).unwrap();
        // Two segments.
        let (first, second) = encoded.stdout.split_at(30);
        stream.set_nodelay(true).unwrap();
        stream.write_all(first).unwrap();
        stream.write_all(second).unwrap();
    }
    let capture = capture.end(&[], "fipa.conversation_id == \"xml\"");
    for (representation, shown) in encodings {
        let filter = format!("fipa.conversation_id == \"{representation}\"");
        let found = fields(&capture, &[], &filter, &COMPARED);
        let expected = json!({
            "fipa.performative": ["request"],
            "fipa.sender": ["captain"],
            "fipa.receiver": ["arm", "brake"],
            "fipa.reply_with": ["béla 1"],
            "fipa.language": ["fipa-sl"],
            "fipa.ontology": ["lab"],
            "fipa.protocol": ["fipa-request"],
            "fipa.conversation_id": [representation],
            "fipa.content_length": ["19"],
            "fipa.content": ["((lift (sample 3)))"],
            "fipa.encoding": [shown],
            "fipa.envelope.to": ["arm"],
        });
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(Value::from(found[0].clone()), expected);
    }
    let wrong = fields(
        &capture,
        &[],
        "fipa.malformed || fipa.fault",
        &["_ws.expert.message"],
    );
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn letters_without_frames_are_dissected_in_every_encoding() {
    if is_possible("letters_without_frames_are_dissected_in_every_encoding") {
        compare_letters_without_frames("127.0.0.1");
        compare_letters_without_frames("[::1]");
    }
}

/// The payloads of a capture, in the order of their arrival at the port.
fn payloads(capture: &Path, protocol: &str, port: &str) -> Vec<Vec<u8>> {
    let field = format!("{protocol}.payload");
    let filter = format!("{protocol}.dstport == {port} && {field}");
    let packets = fields(capture, &[], &filter, &[&field]);
    let texts = packets
        .iter()
        .map(|packet| packet[&field][0].as_str().unwrap());
    let bytes = texts.map(|text| {
        let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
        let pairs = digits
            .chunks(2)
            .map(|pair| std::str::from_utf8(pair).unwrap());
        pairs
            .map(|pair| u8::from_str_radix(pair, 16).unwrap())
            .collect()
    });
    bytes.collect()
}

/// A capture file (pcap, packets of IPv4 without a link layer) that a test writes.
struct Written(Vec<u8>);

impl Written {
    fn new() -> Self {
        const RAW_IP: u32 = 101;
        let mut bytes = Vec::new();
        bytes.extend(0xa1b2_c3d4_u32.to_le_bytes());
        bytes.extend([2, 0, 4, 0]);
        bytes.extend([0; 8]);
        bytes.extend(262_144_u32.to_le_bytes());
        bytes.extend(RAW_IP.to_le_bytes());
        Self(bytes)
    }

    fn packet(&mut self, protocol: u8, rest: &[&[u8]]) {
        let len = 20 + rest.iter().map(|part| part.len()).sum::<usize>();
        self.0.extend([0; 8]);
        self.0.extend((len as u32).to_le_bytes());
        self.0.extend((len as u32).to_le_bytes());
        self.0.extend([0x45, 0]);
        self.0.extend((len as u16).to_be_bytes());
        self.0
            .extend([0, 0, 0, 0, 64, protocol, 0, 0, 192, 0, 2, 1, 192, 0, 2, 2]);
        rest.iter().for_each(|part| self.0.extend(*part));
    }

    /// A conversation over TCP from this port, in segments of random lengths.
    fn stream(&mut self, from: u16, bytes: &[u8], random: &mut Rng) {
        let mut rest = bytes;
        while !rest.is_empty() {
            let most = *random.choice([8, 100, 1460, 9000].iter()).unwrap();
            // The heuristic needs the first eight bytes of a frame in one segment.
            let least = if rest.len() == bytes.len() { 8 } else { 1 };
            let len = random.usize(1..=most).max(least).min(rest.len());
            let (segment, after) = rest.split_at(len);
            let sequence = (1 + bytes.len() - rest.len()) as u32;
            let mut header = Vec::new();
            header.extend(from.to_be_bytes());
            header.extend(PORT.to_be_bytes());
            header.extend(sequence.to_be_bytes());
            header.extend(1_u32.to_be_bytes());
            // Offset of the data, PSH and ACK, window; no checksum, no urgent data.
            header.extend([0x50, 0x18, 0xff, 0xff, 0, 0, 0, 0]);
            self.packet(6, &[&header, segment]);
            rest = after;
        }
    }

    fn datagram(&mut self, from: u16, bytes: &[u8]) {
        let mut header = Vec::new();
        header.extend(from.to_be_bytes());
        header.extend(PORT.to_be_bytes());
        header.extend((8 + bytes.len() as u16).to_be_bytes());
        header.extend([0, 0]);
        self.packet(17, &[&header, bytes]);
    }
}

/// Damages bytes: changes, removes or repeats some of them.
fn damage(bytes: &mut Vec<u8>, random: &mut Rng) {
    for _ in 0..random.usize(1..5) {
        if bytes.len() < 8 {
            return;
        }
        let at = random.usize(..bytes.len());
        let end = (at + random.usize(1..64)).min(bytes.len());
        match random.u8(..6) {
            0 => bytes[at] = random.u8(..),
            1 => bytes[at] ^= 1 << random.u8(..8),
            // Lengths and counts at their limits.
            2 => bytes[at..end.min(at + 8)]
                .fill(*random.choice([0, 0x7f, 0x80, 0xff].iter()).unwrap()),
            3 => drop(bytes.drain(at..end)),
            4 => {
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part);
            }
            _ => bytes.truncate(at.max(8)),
        }
    }
}

/// Captures the letters of a dialing gateway, and returns its payloads in pieces: one stream, or datagrams.
fn sent_by_a_gateway(kind: &'static str, protocol: &str) -> Vec<Vec<u8>> {
    let scene = Scene::new(kind, false);
    let arm = format!("arm-{}", scene.theirs.domain);
    let (_theirs, location, port) = scene.listening("127.0.0.1");
    let capture = Capture::start(&scene.ours, &port);
    let _ours = scene.dialing(&location, &[], None);
    let _arm = scene.theirs.echo(&arm);
    let (words, _) = letter(&arm);
    scene.send(&words);
    let capture = capture.end(&[], OF_CAPTAIN);
    payloads(&capture, protocol, &port)
}

/// Recorded requests of JADE, with the encoding of the message in each.
const REQUESTS: [(&str, &[u8]); 3] = [
    (
        "string",
        include_bytes!(
            "../../transport-net/tests/data/jade_http/string.3-echo-reply-from-jade.bin"
        ),
    ),
    (
        "XML",
        include_bytes!("../../transport-net/tests/data/jade_http/xml.3-echo-reply-from-jade.bin"),
    ),
    (
        "bit-efficient",
        include_bytes!(
            "../../transport-net/tests/data/jade_http/bitefficient.3-echo-reply-from-jade.bin"
        ),
    ),
];

#[test]
fn messages_over_http_are_dissected_in_every_encoding() {
    if !can_run(
        "messages_over_http_are_dissected_in_every_encoding",
        &["tshark"],
        true,
    ) {
        return;
    }
    let mut random = Rng::with_seed(SEED);
    let mut written = Written::new();
    for (from, (_, request)) in (10_000..).zip(REQUESTS) {
        written.stream(from, request, &mut random);
    }
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("http.pcap");
    fs::write(&capture, written.0).unwrap();
    let decoded = format!("tcp.port=={PORT},http");
    let compared = [
        "fipa.encoding",
        "fipa.performative",
        "fipa.sender",
        "fipa.receiver",
        "fipa.conversation_id",
        "fipa.content",
    ];
    let found = fields(&capture, &["-d", &decoded], "fipa", &compared);
    let expected = REQUESTS.map(|(encoding, _)| {
        json!({
            "fipa.encoding": [encoding],
            "fipa.performative": ["inform"],
            "fipa.sender": ["echo@jadetest"],
            "fipa.receiver": ["rusty@rustap"],
            "fipa.conversation_id": ["conv-1"],
            "fipa.content": ["hello jade"],
        })
    });
    let found: Vec<Value> = found.into_iter().map(Value::from).collect();
    assert_eq!(found, expected);
}

#[test]
fn damaged_captures_cause_no_error_of_the_dissector() {
    if !is_possible("damaged_captures_cause_no_error_of_the_dissector") {
        return;
    }
    let stream = sent_by_a_gateway("tcp", "tcp").concat();
    let datagrams = sent_by_a_gateway("udp", "udp");
    let mut random = Rng::with_seed(SEED);
    let directory = tempfile::tempdir().unwrap();
    let written = |name: &str, capture: Written| {
        let path = directory.path().join(name);
        fs::write(&path, capture.0).unwrap();
        path
    };

    // Undamaged, every division into segments yields the same letters.
    let mut whole = Written::new();
    let count = 40_u16;
    for from in 0..count {
        whole.stream(10_000 + from, &stream, &mut random);
    }
    for datagram in &datagrams {
        whole.datagram(10_000, datagram);
    }
    let whole = written("whole.pcap", whole);
    let letters = fields(
        &whole,
        &[],
        OF_CAPTAIN,
        &["fipa.sender", "tcp.srcport", "udp.srcport"],
    );
    let over_tcp = letters
        .iter()
        .filter(|packet| packet.contains_key("tcp.srcport"));
    let over_udp = letters
        .iter()
        .filter(|packet| packet.contains_key("udp.srcport"));
    assert!(over_udp.count() >= 1);
    let mut ports: Vec<String> = over_tcp
        .map(|packet| packet["tcp.srcport"].to_string())
        .collect();
    ports.sort();
    ports.dedup();
    assert_eq!(ports.len(), usize::from(count));
    assert!(
        fields(
            &whole,
            &[],
            "fipa.malformed || fipa.fault",
            &["frame.number"]
        )
        .is_empty()
    );

    let mut broken = Written::new();
    for number in 0..DAMAGED {
        let from = 10_000 + number as u16;
        if random.bool() {
            let mut bytes = stream.clone();
            damage(&mut bytes, &mut random);
            broken.stream(from, &bytes, &mut random);
        } else {
            let mut bytes = random.choice(&datagrams).unwrap().clone();
            damage(&mut bytes, &mut random);
            broken.datagram(from, &bytes);
        }
    }
    let broken = written("broken.pcap", broken);
    // By the heuristic, and by "Decode as", which does not check the first bytes.
    let decoded = [
        format!("tcp.port=={PORT},fipa"),
        format!("udp.port=={PORT},fipa"),
    ];
    let by_hand = ["-d", &decoded[0], "-d", &decoded[1]];
    for options in [&[][..], &by_hand] {
        let text = tshark(&broken, &[options, &["-V"]].concat());
        for wrong in [
            "Lua Error",
            "Fault of the dissector",
            "Dissector bug",
            "STATUS_",
        ] {
            if let Some(at) = text.find(wrong) {
                let from = text.floor_char_boundary(at.saturating_sub(2000));
                let to = text.floor_char_boundary(at + 500);
                panic!("{wrong}, seed {SEED}: {}", &text[from..to]);
            }
        }
        let faults = fields(&broken, options, "fipa.fault", &["frame.number"]);
        assert!(faults.is_empty(), "{faults:?}");
        let malformed = fields(&broken, options, "fipa.malformed", &["frame.number"]);
        assert!(
            malformed.len() > DAMAGED / 20,
            "only {} are malformed",
            malformed.len()
        );
        let dissected = fields(&broken, options, "fipa", &["frame.number"]);
        assert!(
            dissected.len() > DAMAGED,
            "only {} are dissected",
            dissected.len()
        );
    }
}

#[test]
fn a_key_log_needs_the_key_and_the_variable() {
    let scene = Scene::new("tcp", true);
    let path = scene.ours.path("secrets.log");
    let asked = ["security.key_log=true".to_owned()];
    let mut asking = scene.gateway(true, &asked, None);
    asking.wait_for_log(&["WARN", "SSLKEYLOGFILE is not set"]);
    let (code, _) = asking.signal("-TERM");
    assert_eq!(code, Some(0));
    let ignoring = scene.gateway(true, &[], Some(&path));
    let (code, log) = ignoring.signal("-TERM");
    assert_eq!(code, Some(0));
    assert!(!log.contains("key log"), "{log}");
    assert!(!path.exists());
    // A file that others can read.
    fs::write(&path, "").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
    let (name, keys) = (
        format!("mts.name={}", scene.names[0]),
        scene.ours.path("keys"),
    );
    let keys = format!("security.keys={}", keys.display());
    let words = ["up", "--set", &name, "--set", &keys, "--set", &asked[0]];
    let mut refused = scene.ours.command(&words);
    refused.env("SSLKEYLOGFILE", &path);
    let refused = refused.output().unwrap();
    assert_eq!(refused.status.code(), Some(1));
    let errors = String::from_utf8(refused.stderr).unwrap();
    assert!(
        errors.contains("other users can read the key log"),
        "{errors}"
    );
}
