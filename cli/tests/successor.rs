//! Gateways that are killed and started again: what agents have told them is there again, on their own
//! host and on the other one, also what a platform such as JADE has registered and subscribed to.
//!
//! The hosts are network namespaces; see `fipa-testbed`. The platform is a thread that writes and reads
//! messages as JADE does.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its progress")]

mod hosts;

use std::io::{BufRead as _, BufReader, Lines, Read as _, Write as _};
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream};
use std::process::{ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use fipa::actions::{Action, Execution};
use fipa::config::Sources;
use fipa::{Config, Domain, Message, Performative};
use fipa_testbed::{ChildGuard, Family, Host, Network, enter, ignored_test, isolated, jade, until};
use hosts::PORT;
use serde_json::Value;

/// Port of HTTP of every gateway.
const HTTP: u16 = 7778;

/// Watchdog of all waits, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Environment variable with the domain of a robot process.
const DOMAIN: &str = "FIPA_TEST_ROBOT_DOMAIN";

#[test]
fn a_successor_has_what_agents_told_over_ipv4() {
    isolated("inside_a_successor_has_what_agents_told_over_ipv4", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_a_successor_has_what_agents_told_over_ipv4() {
    enter();
    a_successor_has_what_agents_told(Family::V4);
}

#[test]
fn a_successor_has_what_agents_told_over_ipv6() {
    isolated("inside_a_successor_has_what_agents_told_over_ipv6", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_a_successor_has_what_agents_told_over_ipv6() {
    enter();
    a_successor_has_what_agents_told(Family::UniqueLocal);
}

/// A robot with an action.
#[test]
#[ignore = "started by the other tests"]
fn robot_process() {
    let Ok(domain) = std::env::var(DOMAIN) else {
        return;
    };
    let config = Config::load(&Sources {
        set: vec![
            format!("domain={domain}"),
            "discovery.mdns=false".to_owned(),
        ],
        ..Sources::default()
    });
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let name = format!("robot-{domain}");
        let domain = Domain::open(&config.unwrap()).await.unwrap();
        let robot = domain.register(&name).await.unwrap();
        let dock = Action::new("dock").described("Docks");
        let offer = robot.offer(dock, |(): (), _: Execution| async { Ok::<_, String>(()) });
        let _offer = offer.unwrap();
        println!("ready");
        std::future::pending::<()>().await;
    });
}

/// Two hosts with a gateway and agents each.
struct Pair<'a> {
    network: &'a Network,
    gateways: Vec<ChildGuard>,
    _agents: Vec<ChildGuard>,
}

impl<'a> Pair<'a> {
    fn start(network: &'a Network) -> Self {
        let gateways = (0..2).map(|at| gateway(network, at)).collect();
        let mut pair = Self {
            network,
            gateways,
            _agents: Vec::new(),
        };
        for at in 0..2 {
            for arguments in [
                format!("df register arm{at} painting --service brush --property load=5"),
                format!("own bay{at} --agent crane{at} --volatile"),
                format!("echo echo{at}"),
            ] {
                pair._agents.push(pair.agent(at, &arguments));
            }
            let mut robot = ignored_test("robot_process");
            robot
                .env(DOMAIN, format!("host{at}"))
                .stdout(Stdio::piped());
            let mut robot = network.host(at).enter(|| ChildGuard::start(&mut robot));
            let mut lines = BufReader::new(robot.child().stdout.take().unwrap()).lines();
            assert!(lines.any(|line| line.is_ok_and(|line| line.ends_with("ready"))));
            std::thread::spawn(move || lines.for_each(drop));
            pair._agents.push(robot);
        }
        pair
    }

    /// Starts an agent that runs until it is killed.
    fn agent(&self, at: usize, arguments: &str) -> ChildGuard {
        let mut agent = self.command(at, arguments);
        ChildGuard::until_ready(&mut agent).0
    }

    /// A command on a host, whose arguments are separated by single spaces.
    fn command(&self, at: usize, arguments: &str) -> Command {
        let mut command = self.network.host(at).command(env!("CARGO_BIN_EXE_fipa"));
        command.args(["--set", &format!("domain=host{at}")]);
        command.args(arguments.split(' ')).stdin(Stdio::null());
        command
    }

    fn shown(&self, at: usize, arguments: &str) -> Option<String> {
        let done = self.command(at, arguments).output().unwrap();
        if !done.status.success() {
            println!("{arguments}: {}", String::from_utf8_lossy(&done.stderr));
            return None;
        }
        Some(String::from_utf8(done.stdout).unwrap())
    }

    /// Returns what the commands show on both hosts, without what belongs to one life of a gateway.
    fn all(&self) -> Vec<Option<String>> {
        let commands = ["df search --json", "ams --json", "locks --json"];
        let mut all: Vec<Option<String>> = Vec::new();
        for at in 0..2 {
            all.extend(commands.iter().map(|command| self.shown(at, command)));
            all.push(self.shown(at, &format!("actions robot-host{at} --json")));
            let agents = self.shown(at, "agents --json");
            all.push(agents.map(|agents| names(&agents)));
        }
        all
    }

    /// Kills the gateway of a host and starts another one.
    fn replace(&mut self, at: usize, meanwhile: impl FnOnce()) {
        self.gateways[at].kill();
        meanwhile();
        self.gateways[at] = gateway(self.network, at);
    }
}

/// Returns the names and places of agents, without those of commands, and without that of the platform, which
/// is listed for a minute after each letter.
fn names(agents: &str) -> String {
    let agents: Value = serde_json::from_str(agents).unwrap();
    let agents = agents["agents"].as_array().unwrap().iter();
    let agents = agents.map(|agent| format!("{} {}", agent["name"], agent["reach"]));
    let stays = |line: &String| !line.starts_with("\"fipa-") && !line.starts_with("\"painter@");
    agents.filter(stays).collect::<Vec<_>>().join("\n")
}

fn gateway(network: &Network, at: usize) -> ChildGuard {
    let mut settings = vec![
        format!("domain=host{at}"),
        format!("mts.name=gateway{at}"),
        "mts.transports=shm,tcp,http".to_owned(),
        format!("transport.tcp.listen=*:{PORT}"),
        format!("transport.http.listen=*:{HTTP}"),
        "discovery.mdns=false".to_owned(),
        "security.insecure=true".to_owned(),
    ];
    if at == 0 {
        let other = &network.host(1).addresses()[0];
        let peer = format!("discovery.static={{ gateway1 = [\"tcp://{other}:{PORT}\"] }}");
        settings.push(peer);
    }
    let mut gateway = hosts::gateway(network.host(at), &settings);
    ChildGuard::until_ready(&mut gateway).0
}

/// The only agent of a platform such as JADE, on a host of its own.
struct Jade<'a> {
    host: &'a Host,
    here: SocketAddr,
    gateway: SocketAddr,
    received: Receiver<Message>,
}

impl<'a> Jade<'a> {
    fn start(network: &'a Network, family: Family) -> Self {
        let (host, near) = (network.host(2), network.host(0));
        let ip = |host: &Host| match family {
            Family::V4 => IpAddr::from(host.ipv4()),
            _ => host.ipv6().into(),
        };
        let listener = host.enter(|| TcpListener::bind((ip(host), 0))).unwrap();
        let here = listener.local_addr().unwrap();
        let (sender, received) = channel();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                if sender.send(accept(stream.unwrap())).is_err() {
                    return;
                }
            }
        });
        let gateway = (ip(near), HTTP).into();
        Self {
            host,
            here,
            gateway,
            received,
        }
    }

    /// Sends a message to an agent of the gateway of the first host.
    fn tell(&self, to: &str, act: &str, language: &str, content: &str) {
        let (here, gateway) = (self.here, self.gateway);
        let id = |name: &str, at: SocketAddr| {
            format!(
                "<agent-identifier><name>{name}</name><addresses><url>http://{at}/acc</url></addresses>\
                 </agent-identifier>"
            )
        };
        let (to_id, from) = (id(to, gateway), id("painter@jade", here));
        let message = format!(
            "({act}\n :sender (agent-identifier :name painter@jade :addresses (sequence \
             http://{here}/acc))\n :receiver (set (agent-identifier :name {to} :addresses (sequence \
             http://{gateway}/acc)))\n :content \"{}\"\n :reply-with rw-1 :language {language} :ontology \
             FIPA-Agent-Management :protocol fipa-{act} :conversation-id c-{act})",
            content.replace('"', "\\\"")
        );
        let body = format!(
            "This is not part of the MIME multipart encoded message.\r\n--B\r\nContent-Type: \
             application/xml\r\n\r\n<?xml version=\"1.0\"?>\n<envelope><params index=\"1\"><to>{to_id}\
             </to><from>{from}</from><acl-representation>fipa.acl.rep.string.std</acl-representation>\
             <payload-length>{}</payload-length><date>20261120T111213456</date><intended-receiver>{to_id}\
             </intended-receiver></params></envelope>\r\n--B\r\nContent-Type: application/text\r\n\r\n\
             {message}\r\n--B--\r\n",
            message.len()
        );
        let request = format!(
            "POST http://{gateway}/acc HTTP/1.1\r\nCache-Control: no-cache\r\nMime-Version: 1.0\r\nHost: \
             {gateway}\r\nContent-Type: multipart/mixed ; boundary=\"B\"\r\nContent-Length: {}\r\n\
             Connection: close\r\n\r\n{body}",
            body.len()
        );
        let mut stream = self.host.enter(|| TcpStream::connect(gateway)).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = [0; 15];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(&answer, b"HTTP/1.1 200 OK");
    }

    /// Requests a function, and checks that it is done.
    fn ask(&self, agent: &str, function: &str) {
        let to = format!("{agent}@gateway0");
        let content = format!("((action (agent-identifier :name {to}) ({function})))");
        self.tell(&to, "request", "fipa-sl0", &content);
        let answer = self.next();
        assert_eq!(*answer.performative(), Performative::Inform, "{answer}");
    }

    fn next(&self) -> Message {
        self.received.recv_timeout(TIMEOUT).unwrap()
    }

    /// Waits for a notification that has this text.
    fn is_told(&self, text: &str) {
        loop {
            let notification = self.next();
            assert_eq!(
                *notification.performative(),
                Performative::Inform,
                "{notification}"
            );
            assert_eq!(notification.conversation_id(), Some("c-subscribe"));
            let content = String::from_utf8(notification.content().unwrap().to_vec()).unwrap();
            if content.contains(text) {
                return;
            }
        }
    }
}

/// Reads a request, answers it, and returns its message.
fn accept(mut stream: TcpStream) -> Message {
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    let mut bytes = Vec::new();
    let mut more = [0; 65536];
    loop {
        let len = stream.read(&mut more).unwrap();
        assert!(len > 0, "the request is not complete");
        bytes.extend(&more[..len]);
        let head = bytes.windows(4).position(|it| it == b"\r\n\r\n");
        if head.is_some_and(|it| bytes.len() == it + 4 + jade::content_length(&bytes[..it])) {
            break;
        }
    }
    let ok = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    stream.write_all(ok).unwrap();
    let payload = fipa_acl::Payload {
        head: jade::message(&bytes).to_vec().into(),
        ..fipa_acl::Payload::default()
    };
    Message::decode(&payload).unwrap()
}

/// Waits for a line about this agent.
fn line_about(lines: &mut Lines<BufReader<ChildStdout>>, name: &str) -> Value {
    loop {
        let line = line(lines);
        if line["name"] == name || line["agent"]["name"] == name {
            return line;
        }
    }
}

/// Returns the next line of a command in JSON.
fn line(lines: &mut Lines<BufReader<ChildStdout>>) -> Value {
    serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap()
}

const PAINTER: &str = "df-agent-description :name (agent-identifier :name painter@jade) :services (set \
                       (service-description :name spray :type painting))";

fn a_successor_has_what_agents_told(family: Family) {
    let network = Network::of(family, 3);
    let mut pair = Pair::start(&network);
    let jade = Jade::start(&network, family);
    jade.ask("df", &format!("register ({PAINTER})"));
    jade.ask(
        "ams",
        "register (ams-agent-description :name (agent-identifier :name painter@jade) :ownership jade)",
    );
    let query = "(action (agent-identifier :name df@gateway0) (search (df-agent-description :services \
                 (set (service-description :type painting))) (search-constraints :max-results -1)))";
    let query = format!("((iota ?x (result {query} ?x)))");
    jade.tell("df@gateway0", "subscribe", "fipa-sl2", &query);
    assert_eq!(*jade.next().performative(), Performative::Agree);
    jade.is_told("arm1");
    let mut watch = pair.command(0, "df watch --type painting --json");
    let mut watch = ChildGuard::start(watch.stdout(Stdio::piped()));
    let mut watched = BufReader::new(watch.child().stdout.take().unwrap()).lines();
    assert_eq!(line(&mut watched)["event"], "watching");
    for _ in 0..3 {
        assert_eq!(line(&mut watched)["event"], "changed");
    }
    until("both hosts know all", || {
        let all = pair.all();
        let knows = |shown: usize, names: &[&str]| {
            let shown = all[shown].as_deref().unwrap_or_default();
            [0, 1].iter().all(|at| {
                let mut names = names.iter().map(|name| format!("{name}{at}"));
                names.all(|name| shown.contains(&name))
            })
        };
        let agents = ["arm", "echo", "robot-host", "crane"];
        [0, 5]
            .iter()
            .all(|df| knows(*df, &["arm"]) && knows(df + 4, &agents))
    });
    let before = pair.all();
    assert!(before.iter().all(Option::is_some), "{before:#?}");
    wait_for_state(0, "painter@jade");
    for at in [0, 1, 0] {
        let killed = Instant::now();
        pair.replace(at, || {});
        let mut now = Vec::new();
        until("both hosts show the same again", || {
            now = pair.all();
            now == before
        });
        assert_eq!(now, before, "after the gateway of host {at}");
        println!(
            "{family:?}: host {at} shows the same after {:?}",
            killed.elapsed()
        );
    }
    // The platform changes what it registered with the first gateway, and is told of what an agent of this
    // host did in the meantime.
    let late = pair.agent(0, "df register late painting");
    jade.is_told("late");
    assert_eq!(line_about(&mut watched, "late")["event"], "changed");
    wait_for_state(0, "late");
    pair.replace(0, || drop(late));
    jade.is_told("late");
    assert_eq!(line_about(&mut watched, "late")["event"], "left");
    let own = "-agent-description :name (agent-identifier :name painter@jade)";
    jade.ask("df", &format!("deregister (df{own})"));
    jade.ask("ams", &format!("deregister (ams{own})"));
    assert_eq!(line_about(&mut watched, "painter@jade")["event"], "left");
}

/// Waits until the file of the gateway has this text.
fn wait_for_state(at: usize, text: &str) {
    let runtime = std::env::var_os("FIPA_RUNTIME_DIR").unwrap();
    let file = std::path::Path::new(&runtime).join(format!("host{at}/gateway.state"));
    until("the gateway keeps its state", || {
        std::fs::read_to_string(&file).is_ok_and(|wait_for_state| wait_for_state.contains(text))
    });
}
