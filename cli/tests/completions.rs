//! `fipa completions` in bash, zsh and fish, and `fipa man`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::Host;

/// Returns what bash completes in these words; the last one is incomplete.
fn completed(host: &Host, words: &[&str]) -> Vec<String> {
    // Runs the function that the script registers, as bash does when the user presses TAB.
    let script = "\
        source <(fipa completions bash) || exit
        registered=$(complete -p fipa) || exit
        function=${registered##*-F }
        function=${function%% *}
        COMP_WORDS=(\"$@\") COMP_CWORD=$(($# - 1)) COMP_TYPE=9
        $function fipa \"${COMP_WORDS[COMP_CWORD]}\" \"${COMP_WORDS[COMP_CWORD - 1]}\"
        printf '%s\\n' \"${COMPREPLY[@]}\"";
    completed_by(host, "bash", &["--norc", "-c", script, "bash"], words)
}

/// The same for zsh. Its completion system works within the line editor only, so the functions that the script
/// calls are replaced.
fn completed_in_zsh(host: &Host, words: &[&str]) -> Vec<String> {
    let script = "\
        compdef() { registered=$1 }
        _describe() { print -rl -- ${(P)3} }
        source <(fipa completions zsh) || exit
        words=(\"$@\") CURRENT=$#
        $registered";
    completed_by(host, "zsh", &["-f", "-c", script, "zsh"], words)
}

/// The same for fish.
fn completed_in_fish(host: &Host, words: &[&str]) -> Vec<String> {
    let script = "\
        fipa completions fish | source
        complete --do-complete \"$argv\"";
    completed_by(host, "fish", &["--no-config", "-c", script], words)
}

/// Returns what a shell prints that runs this script, with these words as its arguments.
fn completed_by(host: &Host, shell: &str, script: &[&str], words: &[&str]) -> Vec<String> {
    let programs = Path::new(env!("CARGO_BIN_EXE_fipa")).parent().unwrap();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    let done = Command::new(shell)
        .args(script)
        .args(words)
        .current_dir(host.path("."))
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

/// Whether this shell is installed. If not, prints a note, or panics if `CI=true`.
fn has(shell: &str) -> bool {
    let found = Command::new(shell).args(["-c", "true"]).status();
    let found = found.is_ok_and(|status| status.success());
    if !found {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "{shell} is missing");
        eprintln!("SKIPPED, not a success: needs {shell}");
    }
    found
}

/// Bash inserts completions without quotes, so a name of another host would be a command.
#[test]
fn names_that_mean_something_to_a_shell_are_not_completed() {
    let host = Host::new();
    let hostile = [
        "zrover;touch injected;#",
        "z`touch injected`",
        "z&touch injected&",
        "z>injected",
        "z two",
        "z'",
    ];
    let _hostile = hostile.map(|name| host.echo(name));
    let _plain = ["zrover_1", "z.arm-2@béla:1099/JADE"].map(|name| host.echo(name));
    let listed = host.run(&["agents"]).done();
    assert!(hostile.iter().all(|name| listed.contains(name)), "{listed}");
    let expected = ["z.arm-2@béla:1099/JADE", "zrover_1"];
    let words = ["fipa", "send", "--to", "z"];
    let mut found = completed(&host, &words);
    found.sort();
    assert_eq!(found, expected);
    for (shell, complete) in [
        ("zsh", completed_in_zsh as fn(&Host, &[&str]) -> Vec<String>),
        ("fish", completed_in_fish),
    ] {
        if has(shell) {
            let mut found = complete(&host, &words);
            // zsh separates a description by a colon.
            found.iter_mut().for_each(|it| *it = it.replace("\\:", ":"));
            found.sort();
            assert_eq!(found, expected, "{shell}");
        }
    }
    // The user's line runs as it is after a completion.
    let line = format!("set -- {}", completed(&host, &words).join(" "));
    completed_by(&host, "bash", &["--norc", "-c", &line], &[]);
    assert!(!host.path("injected").exists());
}

#[test]
fn files_that_mean_something_to_bash_are_left_to_bash() {
    let host = Host::new();
    for name in ["zdata.bin", "z;touch injected", "z$(touch injected)"] {
        fs::write(host.path(name), "").unwrap();
    }
    let found = completed(&host, &["fipa", "decode", "z"]);
    assert_eq!(found, ["zdata.bin"]);
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
