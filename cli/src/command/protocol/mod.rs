//! `fipa protocol`: lists, shows, checks and draws interaction protocols.

mod defaults;
pub(in crate::command) mod drawing;
mod mermaid;

use std::path::{Path, PathBuf};

use clap::{Subcommand, ValueEnum};
use fipa::monitor::projection::Projection;
use fipa::monitor::scxml::{MAX_FILE, Mistake, ScxmlError, Warning};
use fipa::monitor::{After, Cancel, Library, Machine, Scope, State, Subprotocol, Transition};
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::complete;
use crate::input;
use crate::options::Global;
use crate::output;
use crate::report::{self, Failure};

/// List, show, export, check and draw interaction protocols
///
/// The protocols of the FIPA standards are built in. Files in `monitor.protocols` of the
/// configuration take precedence over them. A file is SCXML in the format of fipa_acl. Attributes in
/// the namespace urn:fipa-rs:protocol add per-participant states, optional steps and timeouts.
#[derive(Debug, Subcommand)]
#[command(after_help = "\
Examples:
  fipa protocol list
  fipa protocol show fipa-contract-net
  fipa protocol export fipa-request > my.scxml
  fipa protocol check protocols/*.scxml
  fipa protocol draw fipa-request --output request.svg
  fipa protocol draw my.scxml --format mermaid

`fipa replay FILE --check` judges recorded letters.")]
pub(crate) enum Arguments {
    /// List the known protocols with their aliases
    #[command(after_help = "\
Examples:
  fipa protocol list
  fipa protocol list --json | jq -r '.[].name'

JSON:
  [ { \"name\", \"aliases\": [ text ], \"title\": text or null, \"roles\": [ text ], \"states\": number } ]")]
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Show the states and transitions of a protocol
    #[command(after_help = "\
Examples:
  fipa protocol show fipa-request
  fipa protocol show my.scxml --json

JSON:
  { \"name\", \"aliases\", \"title\", \"scope\": \"participant\" or \"conversation\",
    \"cancel\": \"initiator\", \"anyone\" or \"nobody\", \"roles\", \"initiator\", \"initial\",
    \"states\": [ { \"id\", \"final\",
                  \"transitions\": [ { \"performative\", \"from\", \"to\", \"target\", \"optional\",
                                     \"when_all\", \"at_most\": number or null } ],
                  \"subprotocols\": [ { \"name\", \"from\", \"proxied_to\" } ],
                  \"timeout\": { \"after\": \"reply-by\" or a duration, \"target\" } or null } ] }")]
    Show {
        /// Name of a protocol, or an SCXML file
        #[arg(add = complete::protocols(true))]
        protocol: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Print the SCXML file of a protocol, as a start for a protocol of one's own
    #[command(after_help = "\
Examples:
  fipa protocol export fipa-request
  fipa protocol export fipa-contract-net --output my.scxml")]
    Export {
        /// Name of a protocol
        #[arg(add = complete::protocols(false))]
        protocol: String,
        /// Write the file to this path instead of standard output
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },

    /// Check protocol files for errors
    ///
    /// Reports every error with its line: unknown and unreachable states, ambiguous transitions, roles
    /// that no agent can take, messages of a role to itself. The exit code is 0 if there is no error. Warns of performatives that
    /// differ from standard ones by a typing error, and of attributes that have no effect.
    ///
    /// A protocol with three or more roles is projected onto each role, so that each agent checks what it
    /// sees. If this is not possible, the protocol is only watched, and the reasons are printed: a role
    /// that cannot know when to speak, several roles that decide at once, a deadlock, a message that no
    /// role expects, a state that is not reached.
    #[command(after_help = "\
Examples:
  fipa protocol check my.scxml
  fipa protocol check protocols/*.scxml --json

JSON:
  [ { \"file\", \"name\": text or null, \"mistakes\": [ { \"line\", \"what\" } ],
      \"warnings\": [ { \"line\", \"what\" } ], \"defects\": [ text ] } ]")]
    Check {
        /// SCXML files; - for standard input
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Draw a protocol as SVG or as a Mermaid state diagram
    ///
    /// A drawing has a legend of its signs.
    #[command(after_help = "\
Examples:
  fipa protocol draw fipa-request --output request.svg
  fipa protocol draw fipa-request --defaults --output request.svg
  fipa protocol draw my.scxml --format mermaid")]
    Draw {
        /// Name of a protocol, or an SCXML file
        #[arg(add = complete::protocols(true))]
        protocol: String,
        /// Output format
        #[arg(long, value_enum, default_value_t = Format::Svg)]
        format: Format,
        /// Draw also the transitions that every protocol has: not-understood, cancel, and the report
        /// of an undelivered message
        #[arg(long)]
        defaults: bool,
        /// Write the drawing to this file instead of standard output
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// Drawing for browsers and documents
    Svg,
    /// Text that GitHub and other tools render
    Mermaid,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    match arguments {
        Arguments::List { json } => list(&library(global)?, json),
        Arguments::Show { protocol, json } => {
            let machine = find(&protocol, global)?;
            if json {
                return output::json(&as_json(&machine));
            }
            output::text(&as_text(&machine))
        }
        Arguments::Export { protocol, output } => write(&exported(&protocol, global)?, output),
        Arguments::Check { files, json } => check(&files, json),
        Arguments::Draw {
            protocol,
            format,
            defaults,
            output,
        } => {
            let machine = find(&protocol, global)?;
            let drawn = match format {
                Format::Svg => drawing::svg(&machine, defaults, None),
                Format::Mermaid => mermaid::diagram(&machine, defaults),
            };
            write(&drawn, output)
        }
    }
}

/// Writes a text to a file, or to standard output.
fn write(text: &str, to: Option<PathBuf>) -> Result<(), Failure> {
    let Some(path) = to else {
        return output::text(text);
    };
    std::fs::write(&path, text).map_err(|error| {
        let help = "give a file that this user can write";
        let problem = format!("cannot write the file: {error}");
        Failure::failed(problem, input::name(&path), help)
    })
}

/// Returns the file of a protocol: of the configuration, else the built-in one.
fn exported(named: &str, global: &Global) -> Result<String, Failure> {
    for file in global.config()?.monitor.protocols.iter().rev() {
        let path = Path::new(file);
        if read(path)?.is_called(named) {
            return text_of(path);
        }
    }
    match Library::standard_text(named) {
        Some(text) => Ok(text.to_owned()),
        None => Err(unknown(named, &library(global)?)),
    }
}

/// Loads the protocols of the standards and of the configuration.
pub(super) fn library(global: &Global) -> Result<Library, Failure> {
    let mut library = Library::standard();
    for file in &global.config()?.monitor.protocols {
        let machine = read(Path::new(file))?;
        library.add(machine).map_err(|error| {
            Failure::failed(
                error.to_string(),
                file.as_str(),
                "list fewer files in monitor.protocols",
            )
        })?;
    }
    Ok(library)
}

/// Finds a known protocol by its name, else reads the file of that name.
pub(super) fn find(named: &str, global: &Global) -> Result<Machine, Failure> {
    let path = Path::new(named);
    let library = library(global)?;
    match library.find(named) {
        Some(machine) => Ok(machine.clone()),
        None if named == "-" || named.contains(['/', '.']) || path.is_file() => read(path),
        None => Err(unknown(named, &library)),
    }
}

/// Warns of the name of an unknown protocol that differs from a known one by a typing error. Protocols need
/// not be known, so the command continues.
pub(super) fn warn_if_misspelled(named: &str, global: &Global) {
    // Files of protocols with mistakes are reported where they are needed.
    let library = library(global).unwrap_or_else(|_| Library::standard());
    if let Some(near) = library.near(named) {
        report::warn(&format!(
            "no protocol has the name {named:?}; did you mean {:?}? (`fipa protocol list` has all)",
            near.name()
        ));
    }
}

fn unknown(named: &str, library: &Library) -> Failure {
    let names: Vec<&str> = library.iter().map(Machine::name).collect();
    Failure::failed(
        format!("no protocol and no file has the name {named:?}"),
        "the command line",
        format!("give a file, or one of {}", names.join(", ")),
    )
}

fn read(path: &Path) -> Result<Machine, Failure> {
    let text = text_of(path)?;
    let name = input::name(path);
    Machine::read(&name, &text).map_err(|error| mistaken(&error))
}

/// The error report of a file with mistakes.
fn mistaken(error: &ScxmlError) -> Failure {
    let name = &error.file;
    let all = error.mistakes.iter().map(|mistake| {
        let place = format!("{name}:{}", mistake.line);
        Failure::failed(mistake.problem.to_string(), place, "fix the file")
    });
    match Failure::all(all) {
        Err(failure) => failure,
        Ok(()) => Failure::failed(error.to_string(), name.as_str(), "fix the file"),
    }
}

fn text_of(path: &Path) -> Result<String, Failure> {
    let bytes = input::read(path, MAX_FILE as u64)?;
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        let problem = format!("invalid UTF-8 at byte {at}");
        Failure::failed(problem, input::name(path), "save the file as UTF-8")
    })
}

fn list(library: &Library, as_json: bool) -> Result<(), Failure> {
    if as_json {
        let one = |machine: &Machine| {
            json!({
                "name": machine.name(),
                "aliases": machine.aliases(),
                "title": machine.title(),
                "roles": machine.roles(),
                "states": machine.states().len(),
            })
        };
        return output::json(&library.iter().map(one).collect::<Value>());
    }
    let mut table = output::table(["PROTOCOL", "TITLE", "ALIASES"]);
    for machine in library.iter() {
        let aliases = machine.aliases().join(", ");
        table.add_row([
            escape(machine.name()),
            escape(machine.title().unwrap_or_default()),
            escape(&aliases),
        ]);
    }
    output::text(&format!("{}\n", table.trim_fmt()))
}

fn check(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    if !as_json {
        let mut failures = Vec::new();
        for file in files {
            let name = input::name(file);
            let read = text_of(file).map(|text| Machine::read_with_warnings(&name, &text));
            match read {
                Ok(Ok((machine, warnings))) => {
                    output::text(&format!(
                        "{name}: {}, states: {}, no errors\n",
                        escape(machine.name()),
                        machine.states().len()
                    ))?;
                    print_warnings(&warnings)?;
                    for defect in defects(&machine) {
                        output::text(&format!("  only watched: {defect}\n"))?;
                    }
                }
                Ok(Err(error)) => {
                    if !error.warnings.is_empty() {
                        output::text(&format!("{name}: errors: {}\n", error.mistakes.len()))?;
                    }
                    print_warnings(&error.warnings)?;
                    failures.push(mistaken(&error));
                }
                Err(failure) => failures.push(failure),
            }
        }
        return Failure::all(failures);
    }
    let mut results = Vec::new();
    let mut invalid = false;
    for file in files {
        let name = input::name(file);
        let read = Machine::read_with_warnings(&name, &text_of(file)?);
        invalid |= read.is_err();
        let mistakes: Vec<Value> = match &read {
            Ok(_) => Vec::new(),
            Err(error) => {
                let mistakes = error.mistakes.iter();
                let one = |mistake: &Mistake| json!({ "line": mistake.line, "what": mistake.problem.to_string() });
                mistakes.map(one).collect()
            }
        };
        let (machine, warnings) = match read {
            Ok((machine, warnings)) => (Some(machine), warnings),
            Err(error) => (None, error.warnings),
        };
        let one =
            |warning: &Warning| json!({ "line": warning.line, "what": warning.doubt.to_string() });
        let warnings: Vec<Value> = warnings.iter().map(one).collect();
        let name_of = machine.as_ref().map(Machine::name);
        let defects = machine.as_ref().map(defects).unwrap_or_default();
        results.push(json!({
            "file": name, "name": name_of, "mistakes": mistakes, "warnings": warnings,
            "defects": defects
        }));
    }
    output::json(&results)?;
    if invalid {
        return Err(Failure::already_reported());
    }
    Ok(())
}

fn print_warnings(warnings: &[Warning]) -> Result<(), Failure> {
    for Warning { line, doubt } in warnings {
        let doubt = doubt.to_string();
        output::text(&format!("  warning, line {line}: {}\n", escape(&doubt)))?;
    }
    Ok(())
}

/// Returns the reasons for which agents cannot check the messages that they send and receive.
fn defects(machine: &Machine) -> Vec<String> {
    let defects = Projection::defects(machine).into_iter();
    let shown = defects.map(|defect| escape(&defect.to_string()).to_string());
    shown.collect()
}

fn scope(machine: &Machine) -> &'static str {
    match machine.scope() {
        Scope::Participant => "participant",
        _ => "conversation",
    }
}

fn cancel(machine: &Machine) -> &'static str {
    match machine.cancel() {
        Cancel::Initiator => "initiator",
        Cancel::Anyone => "anyone",
        _ => "nobody",
    }
}

/// The time of a timeout, as text.
fn after(when: After) -> String {
    match when {
        After::Span(span) => humantime::format_duration(span).to_string(),
        _ => "reply-by".to_owned(),
    }
}

/// The performative of a transition, as text.
fn act(step: &Transition) -> &str {
    match step.performative() {
        ".*" => "any message",
        named => named,
    }
}

/// The conditions of a transition, as text behind it: nothing, or for example ` (optional, at most 1)`.
fn conditions(step: &Transition) -> String {
    let mut all = Vec::new();
    if step.is_optional() {
        all.push("optional".to_owned());
    }
    if step.needs_all() {
        all.push("when all".to_owned());
    }
    if let Some(most) = step.at_most() {
        all.push(format!("at most {most}"));
    }
    match all.is_empty() {
        true => String::new(),
        false => format!(" ({})", all.join(", ")),
    }
}

/// The meaning of [`conditions`], for drawings.
const CONDITIONS: [&str; 3] = [
    "optional: the step may be skipped",
    "when all: all participants are at such a step, or behind it",
    "at most N: no more participants are in the state behind it at the same time",
];

/// The role of a sender or receiver, as text.
fn role(named: &str) -> &str {
    match named {
        ".*" => "any role",
        named => named,
    }
}

/// The protocols that are allowed within a state, as text.
fn within(sub: &Subprotocol) -> String {
    match sub.name() {
        ".*" => "any protocol".to_owned(),
        named => format!("protocol {named}"),
    }
}

fn as_json(machine: &Machine) -> Value {
    let state = |state: &State| {
        let transitions = state.transitions().iter().map(|transition| {
            json!({
                "performative": transition.performative(),
                "from": transition.from(),
                "to": transition.to(),
                "target": machine.target(transition),
                "optional": transition.is_optional(),
                "when_all": transition.needs_all(),
                "at_most": transition.at_most(),
            })
        });
        let subprotocols = state.subprotocols().iter().map(
            |sub| json!({ "name": sub.name(), "from": sub.from(), "proxied_to": sub.proxied_to() }),
        );
        let timeout = state.timeout().map(|timeout| {
            json!({
                "after": after(timeout.after()),
                "target": machine.timeout_target(timeout),
            })
        });
        json!({
            "id": state.id(),
            "final": state.is_final(),
            "transitions": transitions.collect::<Value>(),
            "subprotocols": subprotocols.collect::<Value>(),
            "timeout": timeout,
        })
    };
    json!({
        "name": machine.name(),
        "aliases": machine.aliases(),
        "title": machine.title(),
        "scope": scope(machine),
        "cancel": cancel(machine),
        "roles": machine.roles(),
        "initiator": machine.initiator(),
        "initial": machine.initial().id(),
        "states": machine.states().iter().map(state).collect::<Value>(),
    })
}

fn as_text(machine: &Machine) -> String {
    let mut lines = vec![match machine.title() {
        Some(title) => format!("{}: {title}", machine.name()),
        None => machine.name().to_owned(),
    }];
    if !machine.aliases().is_empty() {
        lines.push(format!("aliases: {}", machine.aliases().join(", ")));
    }
    lines.push(format!("roles: {}", machine.roles().join(", ")));
    lines.push(match machine.scope() {
        Scope::Participant => "scope: one state per participant".to_owned(),
        _ => "scope: one state for the whole conversation".to_owned(),
    });
    lines.push(format!("may be canceled by: {}", cancel(machine)));
    for state in machine.states() {
        let begins = state.id() == machine.initial().id();
        let marks = match (begins, state.is_final()) {
            (true, true) => " (initial, final)",
            (true, false) => " (initial)",
            (false, true) => " (final)",
            (false, false) => "",
        };
        lines.push(String::new());
        lines.push(format!("{}{marks}", state.id()));
        for step in state.transitions() {
            lines.push(format!(
                "  {} from {} to {} -> {}{}",
                act(step),
                role(step.from()),
                role(step.to()),
                machine.target(step),
                conditions(step)
            ));
        }
        for sub in state.subprotocols() {
            let answers = sub
                .proxied_to()
                .map(|to| format!(", answers go to {}", role(to)));
            lines.push(format!(
                "  {} within this state, started by {}{}",
                within(sub),
                role(sub.from()),
                answers.unwrap_or_default()
            ));
        }
        if let Some(timeout) = state.timeout() {
            let target = machine.timeout_target(timeout);
            lines.push(format!("  after {} -> {target}", after(timeout.after())));
        }
    }
    lines.push(String::new());
    let lines: Vec<_> = lines.iter().map(|line| escape(line)).collect();
    lines.join("\n")
}
