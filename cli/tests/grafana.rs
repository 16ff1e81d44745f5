//! The dashboard for Grafana, with a real gateway and a real Prometheus.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

mod common;

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{Host, Running};
use fipa_testbed::ChildGuard;
use serde_json::Value;

/// Timeout for hanging tests.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Whether the programs of Prometheus are there; panics without them if `CI=true`.
fn has_prometheus() -> bool {
    let has = |program| {
        let version = Command::new(program).arg("--version").output();
        version.is_ok_and(|output| output.status.success())
    };
    if has("prometheus") && has("promtool") {
        return true;
    }
    let in_ci = std::env::var("CI").as_deref() == Ok("true");
    assert!(!in_ci, "needs prometheus and promtool");
    eprintln!("SKIPPED, not a success: needs prometheus and promtool");
    false
}

/// A gateway that shows metrics.
struct Shown {
    gateway: Running,
    address: String,
    token_file: String,
}

impl Shown {
    fn start(host: &Host, peer: &str) -> Self {
        let peer = format!("discovery.static={{ crex = [\"tcp://{peer}\"] }}");
        let settings = ["mts.name=sherpa", "http.listen=127.0.0.1:0", &peer];
        let mut arguments = vec!["up", "--json"];
        for setting in settings {
            arguments.extend(["--set", setting]);
        }
        let gateway = host.start(&arguments);
        let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
        let text = |key: &str| ready["http"][key].as_str().unwrap().to_owned();
        Self {
            gateway,
            address: text("address"),
            token_file: text("token_file"),
        }
    }

    fn metrics(&self) -> String {
        let token = fs::read_to_string(&self.token_file).unwrap();
        let token = format!("Authorization: Bearer {}\r\n", token.trim_end());
        get(&self.address, "/metrics", "1.1", &token)
    }
}

/// The body of a successful answer.
fn get(address: &str, path: &str, version: &str, headers: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(WATCHDOG)).unwrap();
    let request = format!("GET {path} HTTP/{version}\r\nHost: {address}\r\n{headers}\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert_eq!(head.split(' ').nth(1), Some("200"), "{path}: {answer}");
    body.to_owned()
}

/// A running Prometheus, and its address.
fn prometheus(host: &Host, shown: &Shown) -> (ChildGuard, String) {
    let config = host.path("prometheus.yml");
    let readme = fs::read_to_string(dashboard("README.md")).unwrap();
    // The example of the documentation, with the values of this test.
    let (_, example) = readme.split_once("```yaml\n").unwrap();
    let (example, _) = example.split_once("```").unwrap();
    let text = example
        .replace("scrape_interval: 10s", "scrape_interval: 1s")
        .replace("127.0.0.1:9790", &shown.address)
        .replace("/etc/prometheus/fipa.token", &shown.token_file);
    for part in ["scrape_interval: 1s", &shown.address, &shown.token_file] {
        assert!(text.contains(part), "{part} in {text}");
    }
    fs::write(&config, text).unwrap();
    let mut command = Command::new("prometheus");
    command
        .arg(format!("--config.file={}", config.display()))
        .arg(format!(
            "--storage.tsdb.path={}",
            host.path("tsdb").display()
        ))
        .arg("--web.listen-address=127.0.0.1:0")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut child = ChildGuard::start(&mut command);
    let mut log = BufReader::new(child.child().stderr.take().unwrap());
    let mut all = String::new();
    let mut address = None;
    while !all.contains("Server is ready to receive web requests") || address.is_none() {
        let mut line = String::new();
        let read = log.read_line(&mut line).unwrap();
        assert!(read > 0, "{all}");
        all.push_str(&line);
        if line.contains("msg=\"Listening on\"") {
            let found = line.split("address=").nth(1).unwrap();
            address = Some(found.trim().to_owned());
        }
    }
    // A full pipe would block it.
    std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
    (child, address.unwrap())
}

fn dashboard(name: &str) -> std::path::PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    root.join("tools/grafana").join(name)
}

/// The queries of all panels, each with the title of its panel. The variables have values as Grafana sets them.
fn queries() -> Vec<(String, String)> {
    let text = fs::read_to_string(dashboard("fipa.json")).unwrap();
    let dashboard: Value = serde_json::from_str(&text).unwrap();
    let mut queries = Vec::new();
    for panel in dashboard["panels"].as_array().unwrap() {
        let title = panel["title"].as_str().unwrap();
        for target in panel["targets"].as_array().into_iter().flatten() {
            let query = target["expr"].as_str().unwrap();
            let query = query
                .replace("$__rate_interval", "15s")
                .replace("$instance", ".*");
            assert!(
                !query.contains('$'),
                "{title}: an unknown variable in {query}"
            );
            queries.push((title.to_owned(), query));
        }
    }
    queries
}

/// The series that a query finds. Fails for a query with an error.
fn series(prometheus: &str, query: &str) -> Vec<Value> {
    let encoded: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
    let path = format!("/api/v1/query?query={encoded}");
    let answer: Value = serde_json::from_str(&get(prometheus, &path, "1.0", "")).unwrap();
    assert_eq!(answer["status"], "success", "{query}: {answer}");
    answer["data"]["result"].as_array().unwrap().clone()
}

/// Sends 20 letters a second until it is dropped.
fn sender(host: &Host, to: &str) -> ChildGuard {
    let send = ["send", "--to", to, "--content", "x", "--rate", "20"];
    let mut command = host.command(&send);
    ChildGuard::start(command.stdout(Stdio::null()).stderr(Stdio::null()))
}

#[test]
fn prometheus_reads_the_metrics_and_each_panel_of_the_dashboard_shows_them() {
    if !has_prometheus() {
        return;
    }
    let (host, other) = (Host::new(), Host::new());
    let far = format!("far-{}", other.domain);
    let _far = other.echo(&far);
    let crex = other.start(&["up", "--json", "--set", "mts.name=crex"]);
    let shown = Shown::start(&host, &crex.tcp_address());
    let _arm = host.echo("arm");
    let deny = "access.deny={ \".*\" = [\"brake\"] }";
    let _brake = host.start(&["echo", "brake", "--set", deny]);
    let until_known = Instant::now() + WATCHDOG;
    while host.run(&["agents", &far, "--json"]).done_json()["agents"][0].is_null() {
        assert!(Instant::now() < until_known, "{far} is not announced");
    }
    let _senders = ["arm", &far, "brake", "nowhere"].map(|to| sender(&host, to));

    let (_prometheus, address) = prometheus(&host, &shown);
    let queries = queries();
    assert!(queries.len() > 20, "{queries:?}");
    let watchdog = Instant::now() + WATCHDOG;
    for (title, query) in &queries {
        // Rates need two readings; a value that is not a number is no value yet.
        while !series(&address, query)
            .iter()
            .any(|it| it["value"][1] != "NaN")
        {
            assert!(
                Instant::now() < watchdog,
                "no series for {title:?}: {query}"
            );
            std::thread::sleep(Duration::from_millis(200));
        }
    }
    let up = series(&address, "up{job=\"fipa\"}");
    assert_eq!(up[0]["value"][1], "1", "{up:?}");

    // Each metric of the gateway has a panel.
    let metrics = shown.metrics();
    let names = metrics
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE fipa_"));
    for name in names.filter_map(|line| line.split(' ').next()) {
        let name = format!("fipa_{name}");
        let is_shown = queries.iter().any(|(_, query)| query.contains(&name));
        assert!(is_shown, "no panel shows {name}");
    }
    accepted_by_promtool(&metrics);
    let (code, _) = shown.gateway.signal("-TERM");
    assert_eq!(code, Some(0));
}

fn accepted_by_promtool(metrics: &str) {
    let mut promtool = Command::new("promtool");
    promtool.args(["check", "metrics"]).stdin(Stdio::piped());
    let promtool = promtool.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = promtool.spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    input.write_all(metrics.as_bytes()).unwrap();
    drop(input);
    let output = child.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && errors.is_empty(),
        "{errors}{metrics}"
    );
}
