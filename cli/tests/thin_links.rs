//! Small letters beside large ones on a link of 10 Mbit/s.
//!
//! The hosts are network namespaces; see `fipa-testbed`. A packet filter drops what exceeds the rate.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its progress")]

mod hosts;

use std::process::{Child, Command, Stdio};

use fipa_testbed::{ChildGuard, Family, Network, directory, enter, isolated, until};
use hosts::PORT;

/// Length of a large letter: it takes more than three seconds.
const LARGE: usize = 4 << 20;

/// Defines a test, and the ignored test that it runs in namespaces.
macro_rules! on_a_thin_link {
    ($name:ident, $inside:ident, $family:expr) => {
        #[test]
        fn $name() {
            isolated(stringify!($inside), &["nft"]);
        }

        #[test]
        #[ignore = "is run by the other test in namespaces of its own"]
        fn $inside() {
            enter();
            small_letters_arrive_before_large_ones($family);
        }
    };
}

on_a_thin_link!(
    small_letters_arrive_before_large_ones_over_ipv4,
    inside_small_letters_arrive_before_large_ones_over_ipv4,
    Family::V4
);

on_a_thin_link!(
    small_letters_arrive_before_large_ones_over_ipv6,
    inside_small_letters_arrive_before_large_ones_over_ipv6,
    Family::UniqueLocal
);

/// Two hosts send each other a large letter. Before these have arrived, new letters of other agents and their
/// replies arrive in both directions.
fn small_letters_arrive_before_large_ones(family: Family) {
    let network = Network::of(family, 2);
    hosts::make_keys(2);
    for host in network.hosts() {
        hosts::filter(
            host,
            "limit rate over 1250 kbytes/second burst 32 kbytes drop",
        );
    }
    let map = directory().join("map");
    std::fs::write(&map, vec![7; LARGE]).unwrap();
    let fipa = |at: usize, words: &[&str]| {
        let mut command = network.host(at).command(env!("CARGO_BIN_EXE_fipa"));
        command.args(["--set", &format!("domain=host{at}")]);
        command.args(words).stdin(Stdio::null());
        command
    };
    for (transport, has_keys) in [("tcp", false), ("tcp", true), ("quic", true)] {
        println!("{family:?}: {transport}, keys: {has_keys}");
        let _gateways = [0, 1].map(|at| {
            let settings = [
                format!("domain=host{at}"),
                format!("mts.name=gateway{at}"),
                format!("mts.transports=shm,{transport}"),
                format!("transport.{transport}.listen=*:{PORT}"),
                match has_keys {
                    true => format!("security.keys={}", hosts::keys(at).dir().display()),
                    false => "security.insecure=true".to_owned(),
                },
            ];
            ChildGuard::until_ready(&mut hosts::gateway(network.host(at), &settings)).0
        });
        let _agents = [0, 1].map(|at| {
            let names = [format!("echo{at}"), format!("map{at}")];
            let echo = ChildGuard::until_ready(&mut fipa(at, &["echo", &names[0]])).0;
            (
                echo,
                ChildGuard::until_ready(&mut fipa(at, &["listen", &names[1]])).0,
            )
        });
        for (at, other) in [(0, 1), (1, 0)] {
            until("the other host is found", || {
                let agents = fipa(at, &["agents"]).output().unwrap().stdout;
                String::from_utf8_lossy(&agents).contains(&format!("map{other}"))
            });
        }
        let mut large = [(0, "map1"), (1, "map0")].map(|(at, to)| {
            let file = map.display().to_string();
            let words = [
                "send",
                "--to",
                to,
                "--content-file",
                &file,
                "--deadline",
                "5m",
            ];
            run(fipa(at, &words))
        });
        for _ in 0..2 {
            for (at, to) in [(0, "echo1"), (1, "echo0")] {
                let words = ["send", "--to", to, "--content", "stop", "--wait"];
                let sent = fipa(at, &words).output().unwrap();
                let errors = String::from_utf8_lossy(&sent.stderr);
                assert!(sent.status.success(), "from host {at}: {errors}");
            }
        }
        for sender in &mut large {
            assert_eq!(
                sender.try_wait().unwrap(),
                None,
                "a large letter came first"
            );
        }
        for sender in large {
            let ended = sender.wait_with_output().unwrap();
            let errors = String::from_utf8_lossy(&ended.stderr);
            assert!(ended.status.success(), "{errors}");
        }
    }
}

fn run(mut command: Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}
