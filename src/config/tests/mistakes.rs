//! Refused configurations and their error messages.

use std::fs;

use fipa_acl::ErrorChain;

use super::{config, error};
use crate::config::{Config, ConfigError, Interface, Sources};

/// Each case is a file and its complete error message.
#[test]
fn mistakes_are_reported_with_line_and_key() {
    let cases: &[(&str, &str)] = &[
        // Unknown keys.
        (
            "domain = \"a\"\n[mts]\ndeadlin = \"5s\"\n",
            "fipa.toml:3: unknown key `mts.deadlin`; did you mean `mts.deadline`? \
             (known in [mts]: name, transports, deadline, queue, queue_bytes, raise_open_files)",
        ),
        (
            "deadline = \"5s\"\n",
            "fipa.toml:1: unknown key `deadline`; did you mean `mts.deadline`? \
             (known at the top: domain, runtime_dir, group, mts, transport, discovery, security, http, contacts, access, \
             monitor, platform, record, routes)",
        ),
        (
            "[discover]\nmdns = true\n",
            "fipa.toml:1: unknown key `discover`; did you mean `discovery`? \
             (known at the top: domain, runtime_dir, group, mts, transport, discovery, security, http, contacts, access, \
             monitor, platform, record, routes)",
        ),
        (
            "[radio]\nrate = 1\n",
            "fipa.toml:1: unknown key `radio`; known at the top: domain, runtime_dir, group, mts, transport, discovery, \
             security, http, contacts, access, monitor, platform, record, routes",
        ),
        (
            "[transport.serial]\nlisten = []\n",
            "fipa.toml:1: unknown key `transport.serial`; known in [transport]: shm, tcp, udp, quic, http, https, udt",
        ),
        (
            "[mts]\nname.first = \"x\"\n",
            "fipa.toml:2: `mts.name` is invalid: a table is not allowed here (a name with dots needs \
             quotes); expected a name of 1 to 255 bytes",
        ),
        (
            "[routes]\ncamera.left = [\"shm\"]\n",
            "fipa.toml:2: `routes.camera` is invalid: a table is not allowed here (a name with dots \
             needs quotes); expected a list of transports such as [\"shm\", \"unix\", \"tcp\"]",
        ),
        (
            "\nmts = 5\n",
            "fipa.toml:2: `mts` is a section, not a value; \
             write [mts] and below it some of its keys: \
             name, transports, deadline, queue, queue_bytes, raise_open_files",
        ),
        (
            "routes = \"x\"\n",
            "fipa.toml:1: `routes` is a section, not a value; \
             write [routes] and below it some of its keys: names of your choice",
        ),
        // Values of the wrong kind.
        (
            "[platform]\ndf = 5\n",
            "fipa.toml:2: `platform.df` is invalid: 5: an integer is not allowed here; \
             expected true, false or a name such as \"directory\"",
        ),
        (
            "domain = 5\n",
            "fipa.toml:1: `domain` is invalid: 5: an integer is not allowed here; \
             expected a name of 1 to 32 letters, digits, '_' or '-'",
        ),
        (
            "[mts]\ntransports = \"shm\"\n",
            "fipa.toml:2: `mts.transports` is invalid: \"shm\": a string is not allowed here; \
             expected a list of transports such as [\"shm\", \"unix\", \"tcp\"]",
        ),
        (
            "[mts]\ntransports = [\n  \"shm\",\n  \"tpc\",\n]\n",
            "fipa.toml:4: `mts.transports` is invalid: \"tpc\": unknown transport \"tpc\" \
             (known: shm, unix, tcp, udp, quic, udt, http, https); expected a list of transports such as [\"shm\", \"unix\", \"tcp\"]",
        ),
        (
            "[mts]\nname = true\n",
            "fipa.toml:2: `mts.name` is invalid: true: a boolean is not allowed here; \
             expected a name of 1 to 255 bytes",
        ),
        (
            "[mts]\ndeadline = 5\n",
            "fipa.toml:2: `mts.deadline` is invalid: 5: the unit is missing; \
             expected a duration such as \"5s\" or \"500ms\"",
        ),
        (
            "[mts]\ndeadline = \"5 parsecs\"\n",
            "fipa.toml:2: `mts.deadline` is invalid: \"5 parsecs\": unknown time unit \"parsecs\", \
             supported units: ns, us/µs, ms, sec, min, hours, days, weeks, months, years \
             (and few variations); expected a duration such as \"5s\" or \"500ms\"",
        ),
        (
            "[mts]\nqueue = \"many\"\n",
            "fipa.toml:2: `mts.queue` is invalid: \"many\": a string is not allowed here; \
             expected a number of letters such as 256",
        ),
        (
            "[mts]\nqueue = -1\n",
            "fipa.toml:2: `mts.queue` is invalid: -1: a negative number is not allowed; \
             expected a number of letters such as 256",
        ),
        (
            "[transport.shm]\ncapacity = \"256 buckets\"\n",
            "fipa.toml:2: `transport.shm.capacity` is invalid: \"256 buckets\": not a size; \
             expected a size such as \"64MiB\"",
        ),
        (
            "[transport.shm]\nmax_letter = -5\n",
            "fipa.toml:2: `transport.shm.max_letter` is invalid: -5: a negative number is not \
             allowed; expected a size such as \"64MiB\"",
        ),
        (
            "[transport.shm]\nspin = 2.5\n",
            "fipa.toml:2: `transport.shm.spin` is invalid: 2.5: a float is not allowed here; \
             expected a duration such as \"50us\", or 0",
        ),
        (
            "[transport.tcp]\nlisten = [\"localhost:7788\"]\n",
            "fipa.toml:2: `transport.tcp.listen` is invalid: \"localhost:7788\": not a numeric \
             address with port; expected a list of numeric addresses with port such as \
             [\"127.0.0.1:0\"]",
        ),
        (
            "[transport.udp]\nlisten = [7788]\n",
            "fipa.toml:2: `transport.udp.listen` is invalid: 7788: an integer is not allowed here; \
             expected a list of numeric addresses with port such as [\"127.0.0.1:0\"]",
        ),
        (
            "[discovery]\nmdns = \"yes\"\n",
            "fipa.toml:2: `discovery.mdns` is invalid: \"yes\": a string is not allowed here; \
             expected true or false",
        ),
        (
            "[discovery]\ninterfaces = [\"eth0/1\"]\n",
            "fipa.toml:2: `discovery.interfaces` is invalid: \"eth0/1\": neither an interface \
             name nor an address; expected a list of interface names or addresses such as \
             [\"wlan0\", \"10.0.0.7\"]",
        ),
        (
            "[discovery]\nstatic = { crex = [\n\"10.0.0.2:7788\"] }\n",
            "fipa.toml:3: `discovery.static.crex` is invalid: \"10.0.0.2:7788\": not a location \
             (expected for example tcp://10.0.0.2:7788): \"10.0.0.2:7788\"; \
             expected a list of locations such as [\"tcp://10.0.0.2:7788\"]",
        ),
        // Values that are not allowed.
        (
            "\n\ndomain = \"../etc\"\n",
            "fipa.toml:3: `domain` cannot be \"../etc\"; \
             it becomes part of file names: use 1 to 32 of A-Z a-z 0-9 _ -",
        ),
        (
            "domain = \"\"\n",
            "fipa.toml:1: `domain` cannot be \"\"; \
             it becomes part of file names: use 1 to 32 of A-Z a-z 0-9 _ -",
        ),
        (
            "domain = \"abcdefghijabcdefghijabcdefghij123\"\n",
            "fipa.toml:1: `domain` cannot be \"abcdefghijabcdefghijabcdefghij123\"; \
             it becomes part of file names: use 1 to 32 of A-Z a-z 0-9 _ -",
        ),
        (
            "runtime_dir = \"run\"\n",
            "fipa.toml:1: `runtime_dir` cannot be \"run\", which differs between working directories; \
             write the full path, for example /run/fipa",
        ),
        (
            "[mts]\nname = \"a\\nb\"\n",
            "fipa.toml:2: `mts.name` cannot be the name \"a\\nb\"; \
             use 1 to 255 bytes of UTF-8 without control, format or invisible characters, without \
             blanks at the ends, and none of * + ? [ ( { | ^ $ \\",
        ),
        (
            "[mts]\ntransports = []\n",
            "fipa.toml:2: `mts.transports` is empty; list at least one of shm, tcp, udp, quic, unix, udt, http, https",
        ),
        (
            "[mts]\ntransports = [\"tcp\", \"shm\", \"tcp\"]\n",
            "fipa.toml:2: `mts.transports` lists tcp twice; list each transport once",
        ),
        (
            "[mts]\ntransports = [\"shm\", \"quic\", \"tcp\"]\n",
            "fipa.toml:2: `mts.transports` lists quic, which needs keys; \
             make keys (`fipa keys init`) and set security.keys, or remove quic",
        ),
        (
            "[mts]\ndeadline = \"0s\"\n",
            "fipa.toml:2: `mts.deadline` cannot be 0s; \
             use more than 0, at most 1h",
        ),
        (
            "[mts]\ndeadline = \"1h 1ns\"\n",
            "fipa.toml:2: `mts.deadline` cannot be 1h 1ns; \
             use more than 0, at most 1h",
        ),
        (
            "[mts]\nqueue = 0\n",
            "fipa.toml:2: `mts.queue` cannot be 0; use 1 to 65536 letters",
        ),
        (
            "[mts]\nqueue = 65537\n",
            "fipa.toml:2: `mts.queue` cannot be 65537; use 1 to 65536 letters",
        ),
        (
            "[routes]\n\"\" = [\"shm\"]\n",
            "fipa.toml:2: `routes.\"\"` has no receiver; write the name of an agent, or a pattern",
        ),
        (
            "[routes]\n\"camera_(\" = [\"shm\"]\n",
            "fipa.toml:2: `routes.\"camera_(\"` is not a valid pattern: unclosed group; \
             write the name of an agent, or a regular expression that matches whole names",
        ),
        (
            "[access.deny]\nrover = [\"arm request\"]\n",
            "fipa.toml:2: `access.deny.rover` has \"request\" behind a receiver; write receivers such \
             as \"arm_.* performative=request protocol=fipa-request\"",
        ),
        (
            "[access.allow]\nrover = []\n",
            "fipa.toml:2: `access.allow.rover` has no receivers; write receivers such \
             as \"arm_.* performative=request protocol=fipa-request\"",
        ),
        (
            "[routes]\na = []\n",
            "fipa.toml:2: `routes.a` is empty; list at least one of shm, tcp, udp, quic, unix, udt, http, https",
        ),
        (
            "[routes]\na = [\"shm\", \"quic\", \"shm\"]\n",
            "fipa.toml:2: `routes.a` lists shm twice; list each transport once",
        ),
        (
            "[routes]\na = [\"tcp\"]\n[mts]\ntransports = [\"shm\"]\n",
            "fipa.toml:2: `routes.a` lists only transports that are off; \
             list one that is in `mts.transports`, or add one of these to `mts.transports`",
        ),
        (
            "[transport.shm]\ncapacity = \"99999999EiB\"\n",
            "fipa.toml:2: `transport.shm.capacity` cannot be 18446744073709551615 bytes; \
             use 1MiB to 1TiB, and at most the size of /dev/shm",
        ),
        (
            "[transport.shm]\nmax_letter = \"1GiB\"\n",
            "fipa.toml:2: `transport.shm.max_letter` is 1073741824 bytes, more than the 268435456 \
             of `transport.shm.capacity`; lower it, or raise the capacity",
        ),
        (
            "[transport.shm]\nmax_letter = \"100 B\"\n",
            "fipa.toml:2: `transport.shm.max_letter` cannot be 100 bytes; \
             use at least 4KiB: an envelope and a message must fit",
        ),
        (
            "[transport.shm]\nspin = \"2s\"\n",
            "fipa.toml:2: `transport.shm.spin` cannot be 2s; \
             use 0 to 1s: spinning keeps a core busy",
        ),
        (
            "[transport.tcp]\nlisten = [\"127.0.0.1:0\", \"[::1]:7\", \"127.0.0.1:0\", \"[::1]:7\"]\n",
            "fipa.toml:2: `transport.tcp.listen` lists [::1]:7 twice; list each address once",
        ),
        (
            "[discovery]\ninterfaces = [\"eth0\", \"eth0\"]\n",
            "fipa.toml:2: `discovery.interfaces` lists eth0 twice; list each interface once",
        ),
        (
            "[discovery]\nstatic = { crex = [] }\n",
            "fipa.toml:2: `discovery.static.crex` is empty; \
             list at least one location of this peer",
        ),
        (
            "[discovery.static]\ncrex = [\"tcp://a:1\", \"tcp://a:1\"]\n",
            "fipa.toml:2: `discovery.static.crex` lists tcp://a:1 twice; list each location once",
        ),
        (
            "[discovery.static]\ncrex = [\"shm://1\"]\n",
            "fipa.toml:2: `discovery.static.crex` lists shm://1, which works only within one host; \
             write for example tcp://10.0.0.2:7788",
        ),
        (
            "[discovery.static]\ncrex = [\"tcp://10.0.0.2\"]\n",
            "fipa.toml:2: `discovery.static.crex` lists tcp://10.0.0.2, which has no port; \
             write for example tcp://10.0.0.2:7788 or tcp://[fe80::1%eth0]:7788",
        ),
        (
            "[platform]\nams = \"a\"\ndf = \"a\"\n",
            "fipa.toml:3: `platform.df` is \"a\", which is the name of platform.ams, too; \
             use another name",
        ),
        (
            "[platform]\nams = \"arm_.*\"\n",
            "fipa.toml:2: `platform.ams` cannot be \"arm_.*\", which is no name of an agent; \
             use true, false, or a name without any of * + ? [ ( { | ^ $ \\",
        ),
        (
            "[mts]\nname = \"rover\"\n[platform]\nams = \"ams@rover\"\ndf = \"df@crex\"\n",
            "fipa.toml:5: `platform.df` cannot be \"df@crex\", which is reserved for another gateway; \
             use true, or a name that does not begin with ams@ or df@",
        ),
        (
            "[discovery.static]\necho = [\"http://:7778/acc\"]\n",
            "fipa.toml:2: `discovery.static.echo` lists http://:7778/acc, which has no host or a wrong \
             port; write for example http://10.0.0.7:7778/acc",
        ),
        (
            "[http]\nlisten = \"0.0.0.0:9790\"\n",
            "fipa.toml:2: `http.listen` is \"0.0.0.0:9790\", which other hosts reach, but there is no key to encrypt \
             with; set security.keys, or use 127.0.0.1 or [::1], for example 127.0.0.1:9790",
        ),
        // Files that are not TOML.
        (
            "domain = \"a\"\n[mts\nname = 5\n",
            "fipa.toml:2: not TOML: unclosed table, expected `]`; correct the line \"[mts\"",
        ),
        (
            "domain = \"a\"\ndomain = \"b\"\n",
            "fipa.toml:2: not TOML: duplicate key; correct the line \"domain = \\\"b\\\"\"",
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(&error(text, &[]), expected, "{text}");
    }
}

#[test]
fn lists_are_bounded() {
    let addresses = |count: usize| {
        let all: Vec<String> = (1..=count)
            .map(|port| format!("\"127.0.0.1:{port}\""))
            .collect();
        format!("[transport.tcp]\nlisten = [{}]\n", all.join(", "))
    };
    config(&addresses(16), &[]);
    assert_eq!(
        error(&addresses(17), &[]),
        "fipa.toml:2: `transport.tcp.listen` has 17 entries; use at most 16"
    );
    let routes: String = (0..257).map(|n| format!("a{n} = [\"shm\"]\n")).collect();
    assert_eq!(
        error(&format!("[routes]\n{routes}"), &[]),
        "fipa.toml:2: `routes` has 257 entries; use at most 256"
    );
    let interfaces: Vec<String> = (0..65).map(|n| format!("\"eth{n}\"")).collect();
    assert_eq!(
        error(
            &format!("discovery.interfaces = [{}]", interfaces.join(",")),
            &[]
        ),
        "fipa.toml:1: `discovery.interfaces` has 65 entries; use at most 64"
    );
    let peers: String = (0..1025)
        .map(|n| format!("a{n} = [\"tcp://a:1\"]\n"))
        .collect();
    assert_eq!(
        error(&format!("[discovery.static]\n{peers}"), &[]),
        "fipa.toml:2: `discovery.static` has 1025 entries; use at most 1024"
    );
    let locations: Vec<String> = (1..=17).map(|port| format!("\"tcp://a:{port}\"")).collect();
    assert_eq!(
        error(
            &format!("discovery.static.a = [{}]", locations.join(",")),
            &[]
        ),
        "fipa.toml:1: `discovery.static.a` has 17 entries; use at most 16"
    );
    let name = "x".repeat(256);
    assert_eq!(
        error(&format!("mts.name = {name:?}"), &[]),
        "fipa.toml:1: `mts.name` is a name of 256 bytes; \
         use 1 to 255 bytes of UTF-8 without control, format or invisible characters, \
         without blanks at the ends, and none of * + ? [ ( { | ^ $ \\"
    );
    let deep = format!("domain = {}1{}", "[".repeat(10_000), "]".repeat(10_000));
    assert!(error(&deep, &[]).starts_with("fipa.toml:1: not TOML: "));
}

#[test]
fn all_mistakes_are_reported_at_once_in_order() {
    assert_eq!(
        error("domain = 1\nmts.queue = \"x\"\n", &["a", "b"]),
        "--set a: not of the form key=value; write for example --set mts.deadline=9s\n\
         --set b: not of the form key=value; write for example --set mts.deadline=9s\n\
         fipa.toml:1: `domain` is invalid: 1: an integer is not allowed here; \
         expected a name of 1 to 32 letters, digits, '_' or '-'\n\
         fipa.toml:2: `mts.queue` is invalid: \"x\": a string is not allowed here; \
         expected a number of letters such as 256"
    );
}

#[test]
fn mistakes_in_set_arguments_name_the_argument() {
    assert_eq!(
        error("", &["mts.deadlin=5s"]),
        "--set mts.deadlin=5s: unknown key `mts.deadlin`; did you mean `mts.deadline`? \
         (known in [mts]: name, transports, deadline, queue, queue_bytes, raise_open_files)"
    );
    assert_eq!(
        error("", &["mts.transports=shm,quic"]),
        "--set mts.transports=shm,quic: `mts.transports` lists quic, which needs keys; \
         make keys (`fipa keys init`) and set security.keys, or remove quic"
    );
    assert_eq!(
        error("", &["mts=5"]),
        "--set mts=5: `mts` is a section, not a value; \
         write [mts] and below it some of its keys: \
             name, transports, deadline, queue, queue_bytes, raise_open_files"
    );
    for (set, expected) in [
        (
            "record.bytes=1KiB",
            "cannot be 1024 bytes; use 1MiB to 1TiB",
        ),
        ("record.directory=~/r", "begins with ~"),
        (
            "access.recorders=[\"arm_(\"]",
            "list names or patterns of agents",
        ),
    ] {
        let text = error("", &[set]);
        assert!(text.contains(expected), "{text}");
    }
    assert_eq!(
        error("", &["mts.queue=x\u{1b}[31m"]),
        "--set mts.queue=x\\u{1b}[31m: `mts.queue` is invalid: \"x\\u001B[31m\": \
         a string is not allowed here; expected a number of letters such as 256"
    );
    // A value that --set replaces is still checked.
    assert!(error("domain = 5\n", &["domain=a"]).starts_with("fipa.toml:1: `domain` is invalid"));
}

/// The message of an error with those of its causes.
fn chain(error: &ConfigError) -> String {
    ErrorChain(error).to_string()
}

#[test]
fn a_named_file_must_be_there() {
    let directory = tempfile::tempdir().unwrap();
    let sources = Sources {
        file: Some("none.toml".into()),
        current_dir: Some(directory.path().to_owned()),
        ..Sources::default()
    };
    let missing = "none.toml (named by --config): No such file or directory (os error 2)";
    assert_eq!(
        chain(&Config::load(&sources).unwrap_err()),
        format!("cannot read the configuration {missing}")
    );
    let sources = Sources {
        variable: Some(directory.path().to_owned()),
        ..Sources::default()
    };
    assert_eq!(
        chain(&Config::load(&sources).unwrap_err()),
        format!(
            "cannot read the configuration {} (named by $FIPA_CONFIG): Is a directory (os error 21)",
            directory.path().display()
        )
    );
}

#[test]
fn the_file_of_the_host_is_never_skipped() {
    let directory = tempfile::tempdir().unwrap();
    let sources = Sources {
        host_dir: Some(directory.path().to_owned()),
        ..Sources::default()
    };
    assert!(Config::load(&sources).is_ok());
    let file = directory.path().join("fipa.toml");
    fs::create_dir(&file).unwrap();
    assert_eq!(
        chain(&Config::load(&sources).unwrap_err()),
        format!(
            "cannot read the configuration {} (for all programs of this host): Is a directory (os error 21)",
            file.display()
        )
    );
}

#[test]
fn a_found_file_must_be_readable_text() {
    let directory = tempfile::tempdir().unwrap();
    let sources = Sources {
        current_dir: Some(directory.path().to_owned()),
        ..Sources::default()
    };
    let refused = |bytes: &[u8]| {
        fs::write(directory.path().join("fipa.toml"), bytes).unwrap();
        chain(&Config::load(&sources).unwrap_err())
    };
    assert_eq!(
        refused(b"domain = \"a\"\n# \xff\n"),
        "cannot read the configuration fipa.toml (found in the current directory): \
         line 2 is not UTF-8, as TOML must be"
    );
    assert_eq!(
        refused(&[b'#'; (1 << 20) + 1]),
        "cannot read the configuration fipa.toml (found in the current directory): \
         larger than 1048576 bytes, the maximum for a configuration"
    );
}

#[test]
fn a_changed_configuration_is_checked_again() {
    let mut config = Config::for_host("sherpa");
    config.check().unwrap();
    config.domain = "a/b".to_owned();
    config.mts.queue = 0;
    config.transport.tcp.listen.push("nowhere".to_owned());
    config
        .discovery
        .interfaces
        .push(Interface::Name("a b".to_owned()));
    let ConfigError::Mistakes(mistakes) = config.check().unwrap_err() else {
        panic!("mistakes expected");
    };
    let shown: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
    assert_eq!(
        shown,
        [
            "`domain` cannot be \"a/b\"; \
             it becomes part of file names: use 1 to 32 of A-Z a-z 0-9 _ -",
            "`mts.queue` cannot be 0; use 1 to 65536 letters",
            "`transport.tcp.listen` lists \"nowhere\", not a numeric address with port; \
             write for example 127.0.0.1:0 or [fe80::1%eth0]:7788, or *:7788 for all addresses of this host",
            "`discovery.interfaces` lists \"a b\", which is not a possible name of an interface; \
             `ip link` lists the names",
        ]
    );
    assert!(mistakes.iter().all(|mistake| mistake.place.is_none()));
}
