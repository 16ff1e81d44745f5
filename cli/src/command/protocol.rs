//! `fipa protocol`: the interaction protocols that are known, and files with others.

mod drawing;
mod mermaid;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use comfy_table::{Table, presets};
use fipa::monitor::scxml::MAX_FILE;
use fipa::monitor::{After, Cancel, Library, Machine, Scope, State, Subprotocol, Transition};
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::input;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// List, show, check and draw interaction protocols
///
/// The protocols of the FIPA standards are built in; files that `monitor.protocols` names in the
/// configuration come before them. A file is SCXML in the form of fipa_acl, with additions in a
/// namespace (urn:fipa-rs:protocol) for what that form cannot say: a state for each participant,
/// optional steps, time-outs.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa protocol list
  fipa protocol show fipa-contract-net
  fipa protocol check protocols/*.scxml
  fipa protocol draw fipa-request --output request.svg
  fipa protocol draw my.scxml --format mermaid")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List the protocols that are known, with the names that peers have for them
    #[command(after_help = "\
JSON:
  [ { \"name\", \"aliases\": [ text ], \"title\": text or null, \"roles\": [ text ], \"states\": number } ]")]
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Show the states of a protocol, and what leads from one to another
    #[command(after_help = "\
JSON:
  { \"name\", \"aliases\", \"title\", \"scope\": \"participant\" or \"conversation\",
    \"cancel\": \"initiator\", \"anyone\" or \"nobody\", \"roles\", \"initiator\", \"initial\",
    \"states\": [ { \"id\", \"final\",
                  \"transitions\": [ { \"performative\", \"from\", \"to\", \"target\", \"optional\" } ],
                  \"subprotocols\": [ { \"name\", \"from\", \"proxied_to\" } ],
                  \"timeout\": { \"after\": \"reply-by\" or a span, \"target\" } or null } ] }")]
    Show {
        /// The name of a protocol, or an SCXML file
        protocol: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Say whether files are protocols, and where they have mistakes
    ///
    /// Every mistake is told with its line: unknown and unreachable states, transitions with two
    /// meanings, roles that nobody can have. The exit code is 0 when there is none.
    #[command(after_help = "\
JSON:
  [ { \"file\", \"name\": text or null, \"mistakes\": [ { \"line\", \"what\" } ] } ]")]
    Check {
        /// SCXML files, or - for standard input
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Draw a protocol as SVG, or as a Mermaid state diagram
    Draw {
        /// The name of a protocol, or an SCXML file
        protocol: String,
        /// What to draw
        #[arg(long, value_enum, default_value_t = Format::Svg)]
        format: Format,
        /// Write it to this file instead of standard output
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A drawing, for browsers and documents
    Svg,
    /// Text that GitHub and others draw
    Mermaid,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    match arguments.action {
        Action::List { json } => list(&library(global)?, json),
        Action::Show { protocol, json } => {
            let machine = find(&protocol, global)?;
            if json {
                return output::json(&described(&machine));
            }
            output::text(&told(&machine))
        }
        Action::Check { files, json } => check(&files, json),
        Action::Draw {
            protocol,
            format,
            output,
        } => {
            let machine = find(&protocol, global)?;
            let drawn = match format {
                Format::Svg => drawing::svg(&machine),
                Format::Mermaid => mermaid::diagram(&machine),
            };
            match output {
                None => output::text(&drawn),
                Some(path) => std::fs::write(&path, drawn).map_err(|error| {
                    let advice = "name a file that this user can write";
                    Failure::failed(format!("cannot write: {error}"), input::name(&path), advice)
                }),
            }
        }
    }
}

/// The protocols of the standard, and those of the configuration.
fn library(global: &Global) -> Result<Library, Failure> {
    let mut library = Library::standard();
    for file in &global.config()?.monitor.protocols {
        let machine = read(Path::new(file))?;
        library.add(machine).map_err(|error| {
            Failure::failed(
                error.to_string(),
                file.as_str(),
                "list fewer in monitor.protocols",
            )
        })?;
    }
    Ok(library)
}

/// What is named: a protocol that is known, else a file.
fn find(named: &str, global: &Global) -> Result<Machine, Failure> {
    let path = Path::new(named);
    let library = library(global)?;
    match library.find(named) {
        Some(machine) => Ok(machine.clone()),
        None if named == "-" || named.contains(['/', '.']) || path.is_file() => read(path),
        None => {
            let names: Vec<&str> = library.iter().map(Machine::name).collect();
            Err(Failure::failed(
                format!("no protocol is called {named:?}, and no file either"),
                "the protocols that are known",
                format!("name a file, or one of {}", names.join(", ")),
            ))
        }
    }
}

fn read(path: &Path) -> Result<Machine, Failure> {
    let text = text_of(path)?;
    let name = input::name(path);
    Machine::read(&name, &text).map_err(|error| {
        let all = error.mistakes.iter().map(|mistake| {
            let place = format!("{name}:{}", mistake.line);
            Failure::failed(mistake.problem.to_string(), place, "correct the file")
        });
        match Failure::all(all) {
            Err(failure) => failure,
            Ok(()) => Failure::failed(error.to_string(), name.as_str(), "correct the file"),
        }
    })
}

fn text_of(path: &Path) -> Result<String, Failure> {
    let bytes = input::read(path, MAX_FILE as u64)?;
    String::from_utf8(bytes).map_err(|error| {
        let what = format!("not UTF-8 at byte {}", error.utf8_error().valid_up_to());
        Failure::failed(what, input::name(path), "save it as UTF-8")
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
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["PROTOCOL", "", "ALSO CALLED"]);
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
            match read(file) {
                Ok(machine) => output::text(&format!(
                    "{}: {}, states: {}, no mistakes\n",
                    input::name(file),
                    escape(machine.name()),
                    machine.states().len()
                ))?,
                Err(failure) => failures.push(failure),
            }
        }
        return Failure::all(failures);
    }
    let mut told = Vec::new();
    let mut wrong = false;
    for file in files {
        let name = input::name(file);
        let read = Machine::read(&name, &text_of(file)?);
        wrong |= read.is_err();
        let mistakes: Vec<Value> = match &read {
            Ok(_) => Vec::new(),
            Err(error) => {
                let mistakes = error.mistakes.iter();
                let one = |mistake: &fipa::monitor::scxml::Mistake| json!({ "line": mistake.line, "what": mistake.problem.to_string() });
                mistakes.map(one).collect()
            }
        };
        let name_of = read.as_ref().ok().map(Machine::name);
        told.push(json!({ "file": name, "name": name_of, "mistakes": mistakes }));
    }
    output::json(&told)?;
    if wrong {
        return Err(Failure::already_told());
    }
    Ok(())
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

/// When a time-out is, in words.
fn after(when: After) -> String {
    match when {
        After::Span(span) => humantime::format_duration(span).to_string(),
        _ => "reply-by".to_owned(),
    }
}

/// What is said, in words.
fn act(step: &Transition) -> &str {
    match step.performative() {
        ".*" => "anything",
        named => named,
    }
}

/// Who says it or hears it, in words.
fn role(named: &str) -> &str {
    match named {
        ".*" => "anybody",
        named => named,
    }
}

/// The protocols that may run within a state, in words.
fn within(sub: &Subprotocol) -> String {
    match sub.name() {
        ".*" => "any protocol".to_owned(),
        named => format!("protocol {named}"),
    }
}

fn described(machine: &Machine) -> Value {
    let state = |state: &State| {
        let transitions = state.transitions().iter().map(|transition| {
            json!({
                "performative": transition.performative(),
                "from": transition.from(),
                "to": transition.to(),
                "target": machine.target(transition),
                "optional": transition.is_optional(),
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

fn told(machine: &Machine) -> String {
    let mut lines = vec![match machine.title() {
        Some(title) => format!("{}: {title}", machine.name()),
        None => machine.name().to_owned(),
    }];
    if !machine.aliases().is_empty() {
        lines.push(format!("also called {}", machine.aliases().join(", ")));
    }
    lines.push(format!("roles: {}", machine.roles().join(", ")));
    lines.push(match machine.scope() {
        Scope::Participant => "each participant has a state of its own".to_owned(),
        _ => "one state for the whole conversation".to_owned(),
    });
    lines.push(format!("may be cancelled by: {}", cancel(machine)));
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
            let optional = if step.is_optional() {
                " (may be left out)"
            } else {
                ""
            };
            lines.push(format!(
                "  {} from {} to {} -> {}{optional}",
                act(step),
                role(step.from()),
                role(step.to()),
                machine.target(step)
            ));
        }
        for sub in state.subprotocols() {
            let answers = sub
                .proxied_to()
                .map(|to| format!(", its answers to {}", role(to)));
            lines.push(format!(
                "  {} within, begun by {}{}",
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
