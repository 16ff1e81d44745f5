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

use std::fmt::{self, Debug};
use std::io::IsTerminal;
use std::process::ExitCode;

use anstyle::Style;
use fipa_acl::{escape, is_unprintable};
use tracing::field::Field;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::{self, Writer};

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
        .fmt_fields(format::debug_fn(log_field))
        .init();
}

/// Writes one field of an event. Names and texts of peers are among the values, so a value with
/// unprintable characters is escaped; others stay, because they may have been escaped already.
fn log_field(writer: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> fmt::Result {
    let mut text = format!("{value:?}");
    if text.contains(is_unprintable) {
        text = escape(&text).into_owned();
    }
    match field.name() {
        "message" => writer.write_str(&text),
        // Where in a crate that logs with `log` the event came from.
        name if name.starts_with("log.") => Ok(()),
        name if writer.has_ansi_escapes() => {
            let (italic, dimmed) = (Style::new().italic(), Style::new().dimmed());
            write!(writer, " {italic}{name}{italic:#}{dimmed}={dimmed:#}{text}")
        }
        name => write!(writer, " {name}={text}"),
    }
}
