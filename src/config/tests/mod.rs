//! Reading configurations, the search for the file, and rendering.

mod mistakes;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fipa_transport::Kind;
use proptest::prelude::*;

use super::reader::Reader;
use super::{
    Check, Config, ConfigError, Effective, Interface, Origin, PeerConfig, PlatformAgent,
    RouteConfig, Sources,
};

/// Loads a text as if it stood in `./fipa.toml`.
fn load(text: &str, set: &[&str]) -> Result<Effective, ConfigError> {
    let directory = tempfile::tempdir().unwrap();
    fs::write(directory.path().join("fipa.toml"), text).unwrap();
    Effective::load(&Sources {
        set: set.iter().map(|&one| one.to_owned()).collect(),
        current_dir: Some(directory.path().to_owned()),
        host_name: "sherpa".to_owned(),
        ..Sources::default()
    })
}

fn config(text: &str, set: &[&str]) -> Config {
    load(text, set).unwrap().into_config()
}

fn error(text: &str, set: &[&str]) -> String {
    load(text, set).unwrap_err().to_string()
}

#[test]
fn an_address_of_a_legacy_peer_needs_no_brackets() {
    let addresses: [std::net::IpAddr; 1] = ["10.0.0.9".parse().unwrap()];
    let config = config("", &["security.legacy_peers=10.0.0.9"]);
    assert_eq!(config.security.legacy_peers, addresses);
}

#[test]
fn an_empty_configuration_yields_the_defaults() {
    let sources = Sources {
        host_name: "sherpa".to_owned(),
        ..Sources::default()
    };
    let effective = Effective::load(&sources).unwrap();
    assert_eq!(effective.file(), None);
    assert_eq!(effective.config(), &Config::for_host("sherpa"));
    assert_eq!(effective.config().mts.name, "sherpa-mts");
    assert_eq!(
        effective.config().mts.transports,
        [Kind::Shm, Kind::Unix, Kind::Tcp]
    );
    assert!(Config::load(&Sources::default()).unwrap().mts.name == "localhost-mts");
}

#[test]
fn unusual_host_names_yield_a_valid_name() {
    for host in [
        "",
        "a b\n",
        "(none)",
        r"([{*+?|^$\",
        "\u{2800}",
        &"é".repeat(300),
    ] {
        Config::for_host(host).check().unwrap();
    }
}

/// The file in the documentation contains the defaults, except for tables that are empty by default.
#[test]
fn the_documented_file_is_the_default() {
    let documentation = include_str!("../mod.rs");
    let block = documentation.split("```").nth(1).unwrap();
    let sample: String = block
        .lines()
        .skip(1)
        .map(|line| format!("{}\n", line.trim_start_matches("//!")))
        .collect();
    let mut documented = config(&sample, &[]);
    assert_eq!(documented.routes.len(), 1);
    assert_eq!(documented.discovery.peers.len(), 1);
    documented.routes.clear();
    documented.discovery.peers.clear();
    assert_eq!(documented.access.allow.len(), 1);
    assert_eq!(documented.access.deny.len(), 1);
    documented.access.allow.clear();
    documented.access.deny.clear();
    assert_eq!(documented, Config::for_host("sherpa"));
}

#[test]
fn every_key_is_read() {
    let config = config(
        r#"
        domain = "lab_2"
        runtime_dir = "/run/fipa"
        group = "robot"
        mts = { name = "crex", transports = ["tcp"], deadline = "1m 30s", queue = 8 }
        [routes]
        "camera_.*" = ["shm", "tcp"]
        'arm\..*' = ["tcp"]
        [transport]
        shm.capacity = "1.5GiB"
        shm.max_letter = 65536
        shm.spin = 0
        tcp.listen = ["[fe80::1%eth0]:7788", "0.0.0.0:7788"]
        udp.listen = []
        quic.listen = ["[::1]:7789"]
        udt.listen = ["0.0.0.0:7790"]
        [discovery]
        mdns = false
        interfaces = ["wlan0", "10.0.0.7", "fe80::1"]
        [discovery.static]
        sherpa-mts = ["tcp://10.0.0.2:7788", "tcp://sherpa.local:7788"]
        [security]
        keys = "/etc/fipa/keys"
        loopback = true
        legacy_peers = ["10.0.0.9", "::1"]
        peer_connections = 8
        peer_letters = 0
        peer_bytes = "1MiB"
        [contacts]
        networks = ["10.0.0.0/8", "fd00::1"]
        [access]
        rate = 100
        allow = { "rover_.*" = ["arm", "crex performative=request"] }
        deny = { rover_1 = ["arm"] }
        [monitor]
        check = "enforce"
        answer = true
        heartbeat = "2s"
        protocols = ["lift.scxml"]
        exempt = ["lift"]
        [platform]
        ams = false
        df = "yellow pages"
        "#,
        &[],
    );
    assert_eq!(config.domain, "lab_2");
    assert_eq!(config.runtime_dir, "/run/fipa");
    assert_eq!(config.group, "robot");
    assert_eq!(config.mts.name, "crex");
    assert_eq!(config.mts.transports, [Kind::Tcp]);
    assert_eq!(config.mts.deadline, Duration::from_secs(90));
    assert_eq!(config.mts.queue, 8);
    let routes: Vec<&str> = config
        .routes
        .iter()
        .map(|route| route.receiver.as_str())
        .collect();
    assert_eq!(routes, ["camera_.*", r"arm\..*"]);
    assert_eq!(config.routes[0].transports, [Kind::Shm, Kind::Tcp]);
    assert_eq!(config.transport.shm.capacity, 3 << 29);
    assert_eq!(config.transport.shm.max_letter, 65_536);
    assert_eq!(config.transport.shm.spin, Duration::ZERO);
    assert_eq!(
        config.transport.tcp.listen,
        ["[fe80::1%eth0]:7788", "0.0.0.0:7788"]
    );
    assert!(config.transport.udp.listen.is_empty());
    assert_eq!(config.transport.quic.listen, ["[::1]:7789"]);
    assert_eq!(config.transport.udt.listen, ["0.0.0.0:7790"]);
    assert_eq!(config.access.rate, 100);
    assert_eq!(config.access.allow[0].sender, "rover_.*");
    assert_eq!(
        config.access.allow[0].receivers,
        ["arm", "crex performative=request"]
    );
    assert_eq!(config.access.deny[0].receivers, ["arm"]);
    assert!(!config.discovery.mdns);
    assert_eq!(config.security.keys, "/etc/fipa/keys");
    assert!(config.security.loopback && !config.security.insecure);
    let legacy: [std::net::IpAddr; 2] = ["10.0.0.9", "::1"].map(|text| text.parse().unwrap());
    assert_eq!(config.security.legacy_peers, legacy);
    let security = &config.security;
    assert_eq!((security.peer_connections, security.peer_letters), (8, 0));
    assert_eq!(security.peer_bytes, 1 << 20);
    let networks = config.contacts.networks.iter().map(ToString::to_string);
    assert!(networks.eq(["10.0.0.0/8", "fd00::1"]));
    assert_eq!(config.monitor.check, Check::Enforce);
    assert!(config.monitor.answer);
    assert_eq!(config.monitor.heartbeat, Duration::from_secs(2));
    assert_eq!(config.monitor.protocols, ["lift.scxml"]);
    assert_eq!(config.monitor.exempt, ["lift"]);
    assert_eq!(config.platform.ams, PlatformAgent::Off);
    let named = PlatformAgent::Named("yellow pages".to_owned());
    assert_eq!(config.platform.df, named);
    let addresses = ["10.0.0.7", "fe80::1"].map(|text| Interface::Address(text.parse().unwrap()));
    let [first, second] = addresses;
    assert_eq!(
        config.discovery.interfaces,
        [Interface::Name("wlan0".to_owned()), first, second]
    );
    let [peer] = config.discovery.peers.as_slice() else {
        panic!("one gateway expected");
    };
    assert_eq!(peer.name, "sherpa-mts");
    assert_eq!(peer.locations[1].to_string(), "tcp://sherpa.local:7788");
}

#[test]
fn set_overrides_the_file() {
    let set = [
        "domain=42",
        "mts.name = \"quoted name\"",
        "mts.deadline=1s",
        "mts.deadline=2s",
        "mts.queue=7",
        "mts.transports=tcp, shm",
        "transport.shm.capacity=1GiB",
        "transport.shm.spin=0",
        "transport.tcp.listen=[\"[::1]:0\"]",
        "transport.udp.listen=",
        "discovery.mdns=false",
        "discovery.static={ crex = [\"tcp://10.0.0.2:1\"] }",
        "routes.\"a=b\"=tcp",
        "routes.c.d=shm",
        "routes.x=tcp",
    ];
    let file = "domain = \"file\"\n[routes]\nx = [\"shm\"]\ny = [\"shm\"]\n";
    assert_eq!(
        error(file, &set),
        "--set routes.c.d=shm: unknown key `routes.c.d`; known in [routes.c]: names of your choice"
    );
    let set: Vec<&str> = set.into_iter().filter(|one| !one.contains("c.d")).collect();
    let config = config(file, &set);
    assert_eq!(config.domain, "42");
    assert_eq!(config.mts.name, "quoted name");
    assert_eq!(config.mts.deadline, Duration::from_secs(2));
    assert_eq!(config.mts.queue, 7);
    assert_eq!(config.mts.transports, [Kind::Tcp, Kind::Shm]);
    assert_eq!(config.transport.shm.capacity, 1 << 30);
    assert_eq!(config.transport.shm.spin, Duration::ZERO);
    assert_eq!(config.transport.tcp.listen, ["[::1]:0"]);
    assert!(config.transport.udp.listen.is_empty());
    assert!(!config.discovery.mdns);
    assert_eq!(config.discovery.peers[0].name, "crex");
    let routes: Vec<(&str, Kind)> = config
        .routes
        .iter()
        .map(|route| (route.receiver.as_str(), route.transports[0]))
        .collect();
    assert_eq!(
        routes,
        [("x", Kind::Tcp), ("a=b", Kind::Tcp), ("y", Kind::Shm)]
    );
}

#[test]
fn the_first_file_counts() {
    let directory = tempfile::tempdir().unwrap();
    let write = |name: &str, domain: &str| {
        let path = directory.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, format!("domain = \"{domain}\"\n")).unwrap();
        path
    };
    let asked = write("asked.toml", "asked");
    let variable = write("variable.toml", "variable");
    let local = write("here/fipa.toml", "local");
    let of_user = write("home/.config/fipa/fipa.toml", "user");
    let of_host = write("etc/fipa.toml", "host");
    let mut sources = Sources {
        file: Some(asked.clone()),
        variable: Some(variable.clone()),
        current_dir: Some(directory.path().join("here")),
        home: Some(directory.path().join("home")),
        host_dir: Some(directory.path().join("etc")),
        ..Sources::default()
    };
    let loaded = |sources: &Sources| {
        let effective = Effective::load(sources).unwrap();
        let file = effective.file().map(Path::to_owned);
        (effective.into_config().domain, file)
    };
    assert_eq!(loaded(&sources), ("asked".to_owned(), Some(asked)));
    sources.file = Some(PathBuf::from("../asked.toml"));
    assert_eq!(
        loaded(&sources),
        ("asked".to_owned(), Some("../asked.toml".into()))
    );
    sources.file = None;
    assert_eq!(loaded(&sources), ("variable".to_owned(), Some(variable)));
    sources.variable = Some(PathBuf::new());
    assert_eq!(
        loaded(&sources),
        ("local".to_owned(), Some("fipa.toml".into()))
    );
    fs::remove_file(local).unwrap();
    assert_eq!(loaded(&sources), ("user".to_owned(), Some(of_user.clone())));
    fs::remove_file(of_user).unwrap();
    assert_eq!(loaded(&sources), ("host".to_owned(), Some(of_host.clone())));
    fs::remove_file(of_host).unwrap();
    assert_eq!(loaded(&sources), ("default".to_owned(), None));
}

#[test]
fn shows_every_value_with_its_origin() {
    let file = r#"
domain = "lab"
[mts]
transports = [
  "shm",
  "tcp",
]
[routes]
"camera_.*" = ["shm"]
arm = ["tcp", "shm"]
[discovery]
static = { crex-mts = ["tcp://10.0.0.2:7788"] }
"#;
    let effective = load(file, &["mts.deadline=90s", "routes.'a b'=tcp"]).unwrap();
    let expected = r#"domain = "lab"                       # fipa.toml:2
runtime_dir = ""                     # default
group = ""                           # default

[mts]
name = "sherpa-mts"                  # default
transports = ["shm", "tcp"]          # fipa.toml:4
deadline = "1m 30s"                  # --set
queue = 256                          # default
queue_bytes = "64MiB"                # default
raise_open_files = false             # default

[transport.shm]
capacity = "256MiB"                  # default
max_letter = "64MiB"                 # default
spin = "50us"                        # default

[transport.tcp]
listen = ["127.0.0.1:0"]             # default
processes = false                    # default

[transport.udp]
listen = ["127.0.0.1:0"]             # default

[transport.quic]
listen = ["127.0.0.1:0"]             # default

[transport.http]
listen = ["127.0.0.1:7778"]          # default

[transport.https]
listen = ["127.0.0.1:0"]             # default
authorities = ""                     # default

[transport.udt]
listen = ["127.0.0.1:0"]             # default

[discovery]
mdns = true                          # default
interfaces = []                      # default

[security]
keys = ""                            # default
insecure = false                     # default
loopback = false                     # default
legacy_peers = []                    # default
key_log = false                      # default
peer_connections = 64                # default
peer_letters = 20000                 # default
peer_bytes = "256MiB"                # default

[http]
listen = ""                          # default
names = []                           # default
token_file = ""                      # default
control = false                      # default

[contacts]
networks = []                        # default

[access]
rate = 0                             # default
operators = []                       # default
recorders = []                       # default

[monitor]
check = "off"                        # default
answer = false                       # default
heartbeat = "5s"                     # default
protocols = []                       # default
idle = "1day"                        # default
conversations = 100000               # default
bytes = "64MiB"                      # default
exempt = []                          # default

[platform]
ams = true                           # default
df = true                            # default

[record]
directory = ""                       # default
bytes = "1GiB"                       # default

[routes]
"a b" = ["tcp"]                      # --set
"camera_.*" = ["shm"]                # fipa.toml:9
arm = ["tcp", "shm"]                 # fipa.toml:10

[discovery.static]
crex-mts = ["tcp://10.0.0.2:7788"]   # fipa.toml:12

[access.allow]                       # default

[access.deny]                        # default
"#;
    assert_eq!(effective.render(), expected);
    assert_eq!(config(expected, &[]), effective.into_config());
}

/// A comment ends at the end of the line, and a file name may contain a newline.
#[test]
fn a_file_name_with_newlines_is_escaped_in_rendered_comments() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x\ndomain = \"evil\"\r.toml");
    fs::write(&path, "mts.queue = 7\n").unwrap();
    let sources = Sources {
        file: Some(path.clone()),
        ..Sources::default()
    };
    let effective = Effective::load(&sources).unwrap();
    let setting = effective
        .settings()
        .into_iter()
        .find(|setting| setting.path == ["mts", "queue"]);
    let origin = Origin::File { path, line: 1 };
    assert_eq!(setting.unwrap().origin, origin);
    assert_eq!(origin.to_string().lines().count(), 1);
    assert_eq!(config(&effective.render(), &[]), effective.into_config());
}

prop_compose! {
    fn configs()(
        domain in "[A-Za-z0-9_-]{1,32}",
        runtime_dir in "(/[a-z é\"]{1,9}){0,3}",
        group in "[a-z é\"]{0,9}",
        name in names(),
        transports in kinds(),
        deadline in 1..=3_600_000_000_000_u64,
        queue in 1..=65_536_usize,
        queue_bytes in 64_u64 << 10..=1 << 40,
        routes in prop::collection::btree_map("[a-zé\"'#= .\n-]{1,12}(\\.\\*)?", kinds(), 0..5),
        capacity in 1_u64 << 20..=1 << 40,
        letter in 4096_u64..=1 << 20,
        spin in 0..=1_000_000_000_u64,
        ports in prop::collection::btree_set(1_u16.., 0..4),
        mdns: bool,
        interfaces in prop::collection::btree_set("[a-z]{1,9}[0-9]", 0..4),
        peers in prop::collection::btree_map(names(), 1_u16.., 0..4),
        check in prop::sample::select(Check::ALL.to_vec()),
        answer: bool,
    ) -> Config {
        let mut config = Config::for_host("sherpa");
        config.domain = domain;
        config.runtime_dir = runtime_dir;
        config.group = group;
        config.mts.name = name;
        config.mts.transports = transports;
        config.mts.deadline = Duration::from_nanos(deadline);
        config.mts.queue = queue;
        config.mts.queue_bytes = queue_bytes;
        config.mts.raise_open_files = answer;
        config.routes = routes
            .into_iter()
            .map(|(receiver, transports)| RouteConfig { receiver, transports })
            .collect();
        // A route needs at least one transport that is on.
        config.routes.retain(|route| {
            route.transports.iter().any(|kind| config.mts.transports.contains(kind))
        });
        config.transport.shm.capacity = capacity;
        config.transport.shm.max_letter = letter;
        config.transport.shm.spin = Duration::from_nanos(spin);
        config.transport.tcp.listen =
            ports.iter().map(|port| format!("[fe80::1%eth0]:{port}")).collect();
        config.security.insecure = true;
        config.discovery.mdns = mdns;
        config.discovery.interfaces = interfaces.into_iter().map(Interface::Name).collect();
        config.discovery.peers = peers
            .into_iter()
            .map(|(name, port)| PeerConfig {
                name,
                locations: vec![format!("tcp://host:{port}").parse().unwrap()],
            })
            .collect();
        config.monitor.check = check;
        config.monitor.answer = answer;
        config.monitor.idle = Duration::from_nanos(deadline);
        config.monitor.bytes = queue_bytes;
        config
    }
}

/// Valid names of agents and gateways.
fn names() -> impl Strategy<Value = String> {
    let is_name = |name: &String| fipa_sds::check_name(name).is_ok();
    "\\PC{1,20}".prop_filter("a name", is_name)
}

fn kinds() -> impl Strategy<Value = Vec<Kind>> {
    prop::sample::subsequence(vec![Kind::Shm, Kind::Tcp], 1..=2).prop_shuffle()
}

fn reads_back_the_same(config: &Config) {
    config.check().unwrap();
    let mut reader = Reader::new("");
    reader.config = config.clone();
    let shown = Effective::new(reader, None).render();
    let mut reader = Reader::new("elsewhere");
    reader.file(Path::new("shown.toml"), &shown);
    reader.check();
    assert_eq!(&reader.mistakes, &[], "{shown}");
    assert_eq!(&reader.config, config, "{shown}");
}

#[test]
fn names_with_signs_and_addresses_with_zones_read_back_the_same() {
    for (name, listen) in [("®", "[fe80::1%eth0]:1"), ("\u{10a05}", "127.0.0.1:0")] {
        let mut config = Config::default();
        config.mts.name = name.to_owned();
        config.transport.tcp.listen = vec![listen.to_owned()];
        config.security.insecure = true;
        reads_back_the_same(&config);
    }
}

proptest! {
    #[test]
    fn a_rendered_configuration_reads_back_the_same(config in configs()) {
        reads_back_the_same(&config);
    }

    #[test]
    fn every_text_yields_one_line_mistakes(text in "\\PC*|([a-z.]{1,9}( = |=)[\\[\\]{}a-z0-9\", .]*\n){0,9}") {
        let mut reader = Reader::new("");
        reader.set(&text);
        reader.file(Path::new("x"), &text);
        reader.check();
        for mistake in &reader.mistakes {
            prop_assert!(!mistake.to_string().contains('\n'), "{}", mistake);
        }
    }
}

#[test]
fn a_gateway_listens_on_the_network_only_with_keys_or_with_insecure() {
    let open = "transport.tcp.listen=0.0.0.0:7788";
    let mistakes = |set: &[&str]| {
        let sources = Sources {
            set: set.iter().map(|text| (*text).to_owned()).collect(),
            ..Sources::default()
        };
        match Config::load(&sources) {
            Ok(_) => String::new(),
            Err(ConfigError::Mistakes(all)) => all.iter().map(|one| one.what.clone()).collect(),
            Err(other) => panic!("{other}"),
        }
    };
    assert!(mistakes(&[open]).contains("`transport.tcp.listen` lists 0.0.0.0:7788"));
    assert!(mistakes(&["transport.tcp.listen=[fe80::1%eth0]:7788"]).contains("fe80::1"));
    let datagrams = [
        "mts.transports=shm,udp",
        "transport.udp.listen=0.0.0.0:7788",
    ];
    assert!(mistakes(&datagrams).contains("`transport.udp.listen` lists 0.0.0.0:7788"));
    let platforms = [
        "mts.transports=shm,http",
        "transport.http.listen=0.0.0.0:7778",
    ];
    assert!(mistakes(&platforms).contains("`transport.http.listen` lists 0.0.0.0:7778"));
    let keys = "security.keys=/etc/fipa/keys";
    assert_eq!(mistakes(&[platforms[0], platforms[1], keys]), "");
    for static_peer in [
        "http://10.0.0.7:7778/acc",
        "http://jade.local/acc",
        "http://[::1]/acc",
    ] {
        let line = format!("discovery.static={{ \"echo@jade\" = [\"{static_peer}\"] }}");
        assert_eq!(mistakes(&[&line]), "");
    }
    let loopback = ["security.loopback=true", "transport.tcp.processes=true"];
    assert!(mistakes(&[keys, loopback[0], loopback[1]]).contains("`transport.tcp.processes`"));
    for one in loopback {
        assert_eq!(mistakes(&[keys, one]), "");
    }
    assert_eq!(mistakes(&[open, "security.insecure=true"]), "");
    assert_eq!(mistakes(&[open, "security.keys=/etc/fipa/keys"]), "");
    assert_eq!(
        mistakes(&[open, "mts.transports=shm"]),
        "",
        "nothing listens"
    );
    assert_eq!(mistakes(&["transport.tcp.listen=[::1]:7788"]), "");
    // Limits that are too low.
    for too_low in ["security.peer_connections=0", "security.peer_bytes=1KiB"] {
        let key = too_low.split('=').next().unwrap();
        assert!(mistakes(&[too_low]).contains(key), "{too_low}");
    }
    assert_eq!(mistakes(&["security.peer_bytes=0"]), "");
    assert!(mistakes(&["security.keys=~/keys"]).contains("only shells expand"));
    let keys = "security.keys=/etc/fipa/keys";
    assert!(mistakes(&[keys, "security.insecure=true"]).contains("`security.insecure`"));
    assert_eq!(mistakes(&[keys, "security.key_log=true"]), "");
    assert!(mistakes(&["security.key_log=true"]).contains("no connection is encrypted"));
    assert!(mistakes(&[keys, "mts.transports=shm,udp,tcp"]).contains("not encrypted"));
}
