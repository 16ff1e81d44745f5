//! `fipa content`: checks, formats and converts FIPA-SL content.

mod json;

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use fipa_acl::escape;
use fipa_content::{Content, ContentExpression, Printer, Profile, SlDialect, Wff};

use crate::input;
use crate::options::Global;
use crate::output;
use crate::report::{self, Failure};

/// Check, format and convert content of messages in FIPA-SL
///
/// FIPA-SL (FIPA00008) is the content language of FIPA messages. Input is a file, or standard input.
#[derive(Debug, Subcommand)]
#[command(after_help = "\
Examples:
  fipa content check goal.sl
  echo '((action crex (dock :speed 0.5)))' | fipa content format
  fipa content to-json goal.sl | jq
  fipa content to-json goal.sl | fipa content from-json")]
pub(crate) enum Arguments {
    /// Check content, and print the smallest profile that has all of its expressions
    ///
    /// An error names the line, the column and the violated clause. With --profile, content that is not in
    /// the profile is an error, too. Content is a list of expressions: (not true) has the two propositions not
    /// and true, and ((not true)) has one formula. The command warns of the former.
    Check {
        #[command(flatten)]
        source: Source,
        /// Value of :language that the content must conform to, for example fipa-sl0
        #[arg(long, value_name = "LANGUAGE", value_parser = profile)]
        profile: Option<Profile>,
    },

    /// Print content on several lines
    Format {
        #[command(flatten)]
        source: Source,
        /// Print on one line
        #[arg(long)]
        line: bool,
        /// Reader of the output
        #[arg(long, value_name = "DIALECT", default_value = "standard")]
        to: ContentDialect,
    },

    /// Print content as JSON
    #[command(after_help = json::HELP)]
    ToJson {
        #[command(flatten)]
        source: Source,
    },

    /// Print the content that JSON of `fipa content to-json` describes
    #[command(after_help = json::HELP)]
    FromJson {
        /// File with the JSON, or - for standard input
        #[arg(default_value = "-", value_name = "FILE")]
        file: PathBuf,
        /// Reader of the output
        #[arg(long, value_name = "DIALECT", default_value = "standard")]
        to: ContentDialect,
    },
}

#[derive(Debug, Args)]
pub(crate) struct Source {
    /// File with the content, or - for standard input
    #[arg(default_value = "-", value_name = "FILE")]
    file: PathBuf,

    /// Writer of the content
    #[arg(long, value_name = "DIALECT", default_value = "standard")]
    dialect: ContentDialect,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum ContentDialect {
    /// FIPA00008
    Standard,
    /// JADE
    Jade,
}

impl From<ContentDialect> for SlDialect {
    fn from(dialect: ContentDialect) -> Self {
        match dialect {
            ContentDialect::Standard => Self::Standard,
            ContentDialect::Jade => Self::Jade,
        }
    }
}

/// Maximum length of an input, in bytes.
const LIMIT: u64 = 64 << 20;

fn profile(text: &str) -> Result<Profile, String> {
    let profile = Profile::of_language(text);
    profile.ok_or_else(|| "expected fipa-sl0, fipa-sl1, fipa-sl2 or fipa-sl".to_owned())
}

pub(crate) fn run(arguments: Arguments, _: &Global) -> Result<(), Failure> {
    match arguments {
        Arguments::Check { source, profile } => {
            let bytes = source.bytes()?;
            let content = source.parse(&bytes)?;
            if let Some(profile) = profile {
                profile.check(&content).map_err(|error| {
                    let place = input::name(&source.file);
                    let help = "use a larger profile as :language, or change the content";
                    Failure::failed(error.to_string(), place, help)
                })?;
            }
            if let Some(first) = first_of_one(&content, source.dialect, &bytes) {
                report::warn(&format!(
                    "{}: the content is a list of {} expressions, the first of which is the proposition \
                     {first:?}; for one expression, write one more pair of parentheses, as in ((not true))",
                    input::name(&source.file),
                    content.expressions.len(),
                ));
            }
            let smallest = Profile::of(&content).map_or("JADE's meta-symbols", Profile::as_str);
            output::text(&format!("{smallest}\n"))
        }
        Arguments::Format { source, line, to } => {
            let bytes = source.bytes()?;
            let content = source.parse(&bytes)?;
            let printer = Printer::new().dialect(to.into());
            let printer = if line { printer } else { printer.indented() };
            print(&printer, &content, &source.file)
        }
        Arguments::ToJson { source } => {
            let bytes = source.bytes()?;
            output::json(&json::of_content(&source.parse(&bytes)?))
        }
        Arguments::FromJson { file, to } => {
            let bytes = input::read(&file, LIMIT)?;
            let help = "see `fipa content to-json --help` for the form";
            input::check_not_empty(&bytes, &file, help)?;
            let content = json::to_content(&bytes).map_err(|error| {
                let problem = format!("the input is no content as JSON: {}", escape(&error));
                Failure::failed(problem, input::name(&file), help)
            })?;
            print(&Printer::new().dialect(to.into()), &content, &file)
        }
    }
}

impl Source {
    fn bytes(&self) -> Result<Vec<u8>, Failure> {
        input::read(&self.file, LIMIT)
    }

    fn parse<'a>(&self, bytes: &'a [u8]) -> Result<Content<'a>, Failure> {
        let help = "content is one or more expressions in parentheses, for example \
                    ((action crex (dock)))";
        input::check_not_empty(bytes, &self.file, help)?;
        // A text file ends with a newline, which belongs to no content.
        Content::parse_in(self.dialect.into(), bytes).map_err(|error| {
            let help = match parses_in_parentheses(self.dialect, bytes) {
                true => {
                    "write one more pair of parentheses: content is a list of expressions, for example \
                     ((action crex (dock)))"
                }
                false => help,
            };
            let problem = format!("{} ({})", error.problem(), error.clause());
            let place = input::place(&self.file, bytes, error.offset());
            Failure::failed(problem, place, help)
        })
    }
}

/// Whether the bytes are content in one more pair of parentheses.
fn parses_in_parentheses(dialect: ContentDialect, bytes: &[u8]) -> bool {
    let inside = [b"(", bytes, b")"].concat();
    Content::parse_in(dialect.into(), &inside).is_ok()
}

/// Returns the first of several expressions if it is a proposition, and all of them are probably meant as one
/// expression.
fn first_of_one<'c>(
    content: &'c Content<'_>,
    dialect: ContentDialect,
    bytes: &[u8],
) -> Option<&'c str> {
    match content.expressions.as_slice() {
        [ContentExpression::Wff(Wff::Proposition(first)), _, ..]
            if parses_in_parentheses(dialect, bytes) =>
        {
            Some(first)
        }
        _ => None,
    }
}

fn print(printer: &Printer, content: &Content<'_>, file: &std::path::Path) -> Result<(), Failure> {
    let mut bytes = printer.print(content).map_err(|error| {
        let help = "use the other dialect (--to), or change the content";
        Failure::failed(error.to_string(), input::name(file), help)
    })?;
    bytes.push(b'\n');
    // Escapes have no meaning in SL. They would change strings with control characters.
    output::converted(&bytes)
}
