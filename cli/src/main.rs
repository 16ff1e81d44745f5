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
//! * [`log`] writes the log.
//! * [`report`] prints errors and warnings; [`output`] prints results; [`input`] reads files and
//!   standard input. [`log_output`] holds back texts for standard error while a command draws on the terminal.

mod answers;
mod command;
mod complete;
mod input;
mod log;
mod log_output;
mod membership;
mod options;
mod output;
mod report;
mod service_manager;
mod signals;

use std::process::ExitCode;

fn main() -> ExitCode {
    complete::answer();
    let command_line = options::CommandLine::read(command::topics::tip_for_one_argument);
    let global = &command_line.global;
    log::start(global.log_filter(), global.log_format);
    command_line.global.keep_sources();
    if let Err(error) = fipa::admin::open_files::raise() {
        tracing::debug!(%error, "cannot raise the limit of open files");
    }
    match command::run(command_line.command, &command_line.global) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}
