//! `fipa man`: manual pages.

use std::fs;
use std::path::PathBuf;

use clap::Args;

use crate::report::Failure;
use crate::{input, options, output};

/// Write the manual pages of fipa and of each command to a directory
///
/// The pages are those of section 1, one file per command, for example fipa-send.1.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa man ~/.local/share/man/man1          for `man fipa` and `man fipa-send`
  fipa man /tmp && man /tmp/fipa-up.1")]
pub(crate) struct Arguments {
    /// Directory for the pages; it is created if it does not exist
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

pub(crate) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let directory = &arguments.directory;
    let written = fs::create_dir_all(directory)
        .and_then(|()| clap_mangen::generate_to(options::command(), directory));
    written.map_err(|error| {
        Failure::failed(
            format!("cannot write the pages: {error}"),
            input::name(directory),
            "name a directory in which this user can create files",
        )
    })?;
    output::text(&format!(
        "wrote the manual pages to {}; `man {}/fipa.1` shows the first\n",
        input::name(directory),
        input::name(directory)
    ))
}
