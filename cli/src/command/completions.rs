//! `fipa completions`: scripts for shells.

use clap::{Args, ValueEnum};
use clap_complete::env::{Bash, EnvCompleter, Fish, Zsh};

use crate::report::Failure;
use crate::{complete, output};

/// Print the script that completes command lines of fipa in a shell
///
/// The script asks this program for each completion. Commands, options, names of running agents and keys
/// of the configuration are completed. A completion does not join the domain.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  source <(fipa completions bash)                                       in ~/.bashrc
  source <(fipa completions zsh)                                        in ~/.zshrc, after compinit
  fipa completions fish > ~/.config/fish/completions/fipa.fish")]
pub(crate) struct Arguments {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

pub(crate) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let shell: &dyn EnvCompleter = match arguments.shell {
        Shell::Bash => &Bash,
        Shell::Zsh => &Zsh,
        Shell::Fish => &Fish,
    };
    let mut script = Vec::new();
    shell
        .write_registration(complete::VARIABLE, "fipa", "fipa", "fipa", &mut script)
        .map_err(|error| {
            Failure::failed(
                format!("cannot write the script: {error}"),
                "this process",
                "run the command again",
            )
        })?;
    output::bytes(&script)
}
