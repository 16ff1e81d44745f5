//! `fipa completions` in bash, and `fipa man`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::Host;

/// Returns what bash completes in these words; the last one is incomplete.
fn completed(host: &Host, words: &[&str]) -> Vec<String> {
    let programs = Path::new(env!("CARGO_BIN_EXE_fipa")).parent().unwrap();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    // Runs the function that the script registers, as bash does when the user presses TAB.
    let script = "\
        source <(fipa completions bash) || exit
        registered=$(complete -p fipa) || exit
        function=${registered##*-F }
        function=${function%% *}
        COMP_WORDS=(\"$@\") COMP_CWORD=$(($# - 1)) COMP_TYPE=9
        $function fipa \"${COMP_WORDS[COMP_CWORD]}\" \"${COMP_WORDS[COMP_CWORD - 1]}\"
        printf '%s\\n' \"${COMPREPLY[@]}\"";
    let done = Command::new("bash")
        .args(["--norc", "-c", script, "bash"])
        .args(words)
        .env_clear()
        .env("PATH", path)
        .env("HOME", host.path("."))
        .env("FIPA_RUNTIME_DIR", host.path("run"))
        .env("FIPA_DOMAIN", &host.domain)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{words:?}: {errors}");
    let text = String::from_utf8(done.stdout).unwrap();
    // bash separates the candidates by \v in this script of clap.
    let words = text.split(['\n', '\u{b}']);
    words
        .filter(|word| !word.is_empty())
        .map(str::to_owned)
        .collect()
}

/// The files in the runtime directory, with their contents' versions.
fn files(directory: &Path, found: &mut Vec<(PathBuf, std::time::SystemTime)>) {
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let metadata = entry.metadata().unwrap();
        found.push((entry.path(), metadata.modified().unwrap()));
        if metadata.is_dir() {
            files(&entry.path(), found);
        }
    }
    found.sort();
}

#[test]
fn bash_completes_commands_agents_and_keys() {
    let host = Host::new();
    assert_eq!(completed(&host, &["fipa", "doc"]), ["doctor"]);
    assert_eq!(
        completed(&host, &["fipa", "send", "--perf"]),
        ["--performative"]
    );
    assert_eq!(
        completed(&host, &["fipa", "--set", "mts.d"]),
        ["mts.deadline="]
    );
    assert_eq!(
        completed(&host, &["fipa", "send", "--to", "arm"]),
        Vec::<String>::new()
    );
    assert!(!host.path("run").exists(), "a completion creates nothing");

    let _arms = ["arm_1", "arm_2", "crane"].map(|name| host.echo(name));
    let mut before = Vec::new();
    files(&host.path("run"), &mut before);
    assert_eq!(
        completed(&host, &["fipa", "send", "--to", "arm"]),
        ["arm_1", "arm_2"]
    );
    for command in ["routes", "ping", "request", "subscribe", "do", "actions"] {
        let words = ["fipa", command, "cr"];
        assert_eq!(completed(&host, &words), ["crane"], "{command}");
    }
    let shown = completed(&host, &["fipa", "protocol", "show", "fipa-iter"]);
    assert_eq!(shown, ["fipa-iterated-contract-net"]);
    // The domain on the command line precedes the variable.
    let elsewhere = ["fipa", "--set", "domain=other", "agents", "cr"];
    assert_eq!(completed(&host, &elsewhere), Vec::<String>::new());
    let mut after = Vec::new();
    files(&host.path("run"), &mut after);
    assert_eq!(before, after, "a completion joins no domain");

    let _bay = host.start(&["own", "bay", "--volatile"]);
    assert_eq!(completed(&host, &["fipa", "lock", "b"]), ["bay"]);
}

#[test]
fn every_shell_gets_a_script() {
    let host = Host::new();
    for shell in ["bash", "zsh", "fish"] {
        let script = host.run(&["completions", shell]).done();
        assert!(script.contains("FIPA_COMPLETE"), "{shell}: {script}");
    }
    let unknown = host.run(&["completions", "csh"]).failed(2);
    assert!(unknown.contains("bash, zsh, fish"), "{unknown}");
}

#[test]
fn every_command_has_a_manual_page() {
    let host = Host::new();
    let pages = host.path("pages");
    let help = host.run(&["help"]).done();
    let commands = help.split("Commands:\n").nth(1).unwrap();
    let commands = commands.lines().take_while(|line| !line.is_empty());
    // A description that is too long continues in a line with a deeper indent.
    let commands = commands.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names: Vec<&str> = commands
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect();
    assert!(
        names.contains(&"send") && names.contains(&"man"),
        "{names:?}"
    );
    host.run(&["man", pages.to_str().unwrap()]).done();
    let read = |name: &str| fs::read_to_string(pages.join(name)).unwrap();
    assert!(read("fipa.1").contains(".TH fipa 1"));
    for name in names {
        let page = read(&format!("fipa-{name}.1"));
        assert!(page.contains("Examples"), "{name} has examples");
    }
    let file = host.path("pages/fipa.1/below");
    let failed = host.run(&["man", file.to_str().unwrap()]).failed(1);
    assert!(failed.contains("cannot write the pages"), "{failed}");
}
