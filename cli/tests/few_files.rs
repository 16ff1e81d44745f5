//! Processes that may open few files.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::process::Command;

use common::Host;

/// A command with these limits of open files, which are options of `ulimit`.
fn limited(host: &Host, limits: &str, arguments: &[&str]) -> Command {
    let fipa = host.command(arguments);
    let script = format!("ulimit {limits} && exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command
        .args(["-c", &script])
        .arg(fipa.get_program())
        .args(fipa.get_args())
        .current_dir(fipa.get_current_dir().unwrap())
        .env_clear();
    for (name, value) in fipa.get_envs() {
        command.env(name, value.unwrap());
    }
    command
}

/// Idle connections are given up for new ones. All of them would need about 180 descriptors.
#[test]
fn a_letter_reaches_more_agents_than_there_are_descriptors_for() {
    const AGENTS: usize = 16;
    let host = Host::new();
    let names: Vec<String> = (0..AGENTS).map(|number| format!("arm_{number}")).collect();
    let _agents: Vec<_> = names.iter().map(|name| host.echo(name)).collect();
    let all = [
        "send",
        "--to",
        "arm_.*",
        "--content",
        "stop",
        "--deadline",
        "30s",
    ];
    let sent = limited(&host, "-n 100", &all).output().unwrap();
    let (out, errors) = (
        String::from_utf8(sent.stdout).unwrap(),
        String::from_utf8(sent.stderr).unwrap(),
    );
    assert!(sent.status.success(), "{out}{errors}");
    assert_eq!(out.matches(": delivered").count(), AGENTS, "{out}{errors}");
}

/// Programs that use `select` cannot handle more than 1,024 open files.
#[test]
fn the_command_raises_its_limit_and_a_program_that_it_starts_has_the_one_before() {
    let host = Host::new();
    let _crane = host.start(&["own", "bay", "--agent", "crane", "--volatile"]);
    let show = "ulimit -S -n; ulimit -H -n; grep 'open files' /proc/$PPID/limits";
    let mut locked = limited(&host, "-S -n 100", &["lock", "bay", "--", "sh", "-c", show]);
    let ran = locked.output().unwrap();
    let errors = String::from_utf8(ran.stderr).unwrap();
    let out = String::from_utf8(ran.stdout).unwrap();
    let mut lines = out.lines();
    assert_eq!(lines.next(), Some("100"), "{out}{errors}");
    let hard = lines.next().unwrap();
    // Max open files, soft, hard, unit.
    let of_command = lines.next().unwrap().split_whitespace().nth(3).unwrap();
    let raised = hard.parse().map_or(65_536, |hard: u64| hard.min(65_536));
    assert_eq!(of_command, raised.to_string(), "{out}{errors}");
}
