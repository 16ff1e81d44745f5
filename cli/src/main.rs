//! The `fipa` command.
//!
//! What lives here: the command line, what is printed, log output, exit codes. What a command
//! does with agents and letters is the business of the crate `fipa`.
//!
//! * [`options`] has the command line and the options all commands share.
//! * [`command`] has one file per command. A new one is a file there and a line in its enum.
//! * [`membership`] has what the commands share that take part in a domain.
//! * [`report`] says what went wrong; [`output`] prints what was asked for; [`input`] reads what is
//!   given as a file or on standard input.

mod command;
mod input;
mod membership;
mod options;
mod output;
mod report;

use std::io::IsTerminal;
use std::process::ExitCode;

use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    let command_line = options::CommandLine::read();
    log_to_stderr(&command_line.global);
    match command::run(command_line.command, &command_line.global) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}

/// Logs go to standard error: standard output is for what was asked for.
fn log_to_stderr(global: &options::Global) {
    let usual = || EnvFilter::new(global.log_level());
    let filter = if std::env::var_os("RUST_LOG").is_some_and(|value| !value.is_empty()) {
        EnvFilter::try_from_default_env().unwrap_or_else(|error| {
            report::warn(&format!(
                "$RUST_LOG is not understood ({error}); logging as usual"
            ));
            usual()
        })
    } else {
        usual()
    };
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
        .with_writer(std::io::stderr)
        .init();
}
