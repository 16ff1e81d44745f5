//! The `fipa` command.
//!
//! This crate has the command line, the printed output, the log output and the exit codes. The work
//! with agents and letters is in the crate `fipa`.
//!
//! * [`options`] has the command line and the options all commands share.
//! * [`command`] has one file per command. A new one is a file there and a line in its enum.
//! * [`membership`] has the code shared by the commands that join a domain: joining, registering,
//!   errors and signals.
//! * [`complete`] completes command lines for shells.
//! * [`report`] prints errors and warnings; [`output`] prints results; [`input`] reads files and
//!   standard input. [`log_output`] holds back texts for standard error while a command draws on the terminal.

mod answers;
mod command;
mod complete;
mod input;
mod log_output;
mod membership;
mod options;
mod output;
mod report;
mod service_manager;
mod signals;

use std::fmt::{self, Debug};
use std::io::IsTerminal;
use std::process::ExitCode;

use anstyle::Style;
use fipa::log_limit::Cut;
use fipa_acl::{escape, is_unprintable};
use tracing::field::Field;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::{self, Writer};

fn main() -> ExitCode {
    complete::answer();
    let command_line = options::CommandLine::read(command::topics::tip_for_one_argument);
    log_to_stderr(&command_line.global);
    command_line.global.keep_sources();
    if let Err(error) = fipa::admin::open_files::raise() {
        tracing::debug!(%error, "cannot raise the limit of open files");
    }
    match command::run(command_line.command, &command_line.global) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}

/// Starts logging to standard error. Standard output carries only the results of a command.
fn log_to_stderr(global: &options::Global) {
    let default_filter = || EnvFilter::new(global.log_filter());
    let filter = if std::env::var_os("RUST_LOG").is_some_and(|value| !value.is_empty()) {
        EnvFilter::try_from_default_env().unwrap_or_else(|error| {
            report::warn(&format!(
                "ignoring $RUST_LOG, which is not a valid log filter: {error}"
            ));
            default_filter()
        })
    } else {
        default_filter()
    };
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
        .with_writer(|| log_output::LogOutput)
        .fmt_fields(format::debug_fn(log_field))
        .init();
}

/// Writes one field of an event. A value can contain names and texts of peers, so a value with
/// unprintable characters is escaped. Other values stay as they are: they may be escaped already.
fn log_field(writer: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> fmt::Result {
    // Lines for debugging are not cut by the library.
    let mut text = Cut(format_args!("{value:?}")).to_string();
    if text.contains(is_unprintable) {
        text = escape(&text).into_owned();
    }
    match field.name() {
        "message" => writer.write_str(&text),
        // The source location of an event from a crate that logs with `log`.
        name if name.starts_with("log.") => Ok(()),
        name if writer.has_ansi_escapes() => {
            let (italic, dimmed) = (Style::new().italic(), Style::new().dimmed());
            write!(writer, " {italic}{name}{italic:#}{dimmed}={dimmed:#}{text}")
        }
        name => write!(writer, " {name}={text}"),
    }
}
