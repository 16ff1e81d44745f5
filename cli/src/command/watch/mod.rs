//! `fipa watch`: shows the letters of this host live.

pub(super) mod checker;
mod conversations;
mod drawing;
pub(super) mod filter;
pub(super) mod json;
mod mermaid;
mod sequence;
mod tally;
pub(super) mod text;

use std::path::{Path, PathBuf};
use std::pin::pin;
use std::time::{Duration, SystemTime};

use clap::Args;
use fipa::Config;
use fipa::admin::watch::{Event, Passage, WatchOptions, Watcher};

use self::checker::{CheckResult, Checker, Earlier, Letter};
use self::conversations::{Conversation, Conversations};
use self::filter::Filter;
use self::tally::Tally;
use self::text::{Look, TextOutput};
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};

/// Show the letters of this host live
///
/// Shows the letters of all processes of the domain on this host, including those through shared
/// memory: sender, receiver, performative, transport, outcome, and whether the letter follows the
/// interaction protocol of its conversation. The agents need no configuration for it and are not
/// slowed down. Content is shown only with --content. A letter between hosts is visible on both.
///
/// Letters are shown in the order in which they were sent, each when its outcome is known or after
/// 250 ms. A later outcome is printed on a line of its own. If the output is read too slowly, the
/// command reports the number of lost records.
///
/// A conversation that may have begun before the command is unchecked until a message begins another
/// one: the agents of its letter were registered before, or one of them is on another host. After lost
/// records, this holds for all conversations.
///
/// Ctrl-C stops the command and prints a summary.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa watch
  fipa watch --agent 'arm_.*' --protocol fipa-contract-net
  fipa watch --violations --protocols ./protocols
  fipa watch --sequence                          draws conversations as sequence diagrams
  fipa watch --conversation c1 --svg c1.svg      writes a drawing at the end
  fipa watch --conversation c1 --mermaid c1.mmd  writes a diagram for documents at the end
  fipa watch --json | jq -r 'select(.verdict.verdict == \"violation\") | .verdict.text'

Columns: time (UTC), sender and receiver, performative, protocol, conversation, size of the letter,
transport, outcome, verdict. The verdict is the new state of the conversation, `-` for a letter that
cannot be checked, or VIOLATION with the expected messages.

JSON, one object on a line:
  { \"event\": \"watching\", \"domain\", \"processes\": number of processes }
  { \"event\": \"letter\", \"number\", \"time\", \"sender\", \"receiver\", \"performative\", \"protocol\",
    \"conversation_id\", \"size\", \"content_length\", \"content_cut\", \"via\", \"gateway\",
    \"message\": identifier, the same for all receivers of a message,
    \"outcome\": \"delivered\", \"sent\", \"failed\", \"taken\" (seen only at the receiver) or
    \"under_way\", \"reason\", \"attempts\": [ { \"via\", \"location\", \"error\" } ],
    \"settled\": whether the sender got this outcome; otherwise a gateway had it,
    \"verdict\": { \"verdict\": \"accepted\", \"violation\" or \"unchecked\", ... },
    \"letter\": { \"envelope\", \"effective\", \"message\" } as `fipa decode` prints it }
  { \"event\": \"outcome\", \"number\", \"sender\", \"receiver\", \"outcome\", ... }  of an earlier letter
  { \"event\": \"overdue\", \"protocol\", \"conversation_id\", \"participant\", \"state\" }
  { \"event\": \"lost\", \"process\", \"records\" }
  { \"event\": \"refused\", \"process\", \"error\" }
  { \"event\": \"summary\", \"seconds\", \"letters\", \"shown\", \"outcomes\", \"conversations\",
    \"violations\", \"lost\" }")]
pub(crate) struct Arguments {
    #[command(flatten)]
    filter: Filter,

    /// Show content, at most this number of bytes per message
    ///
    /// Complete content in FIPA-SL is formatted for reading.
    #[arg(long, value_name = "BYTES", num_args = 0..=1, default_missing_value = "80",
          require_equals = true, value_parser = bytes)]
    content: Option<usize>,

    /// Directory with SCXML files of protocols (*.scxml, *.xml, or without an extension)
    ///
    /// They are added to those of the FIPA standards and of monitor.protocols.
    #[arg(long, value_name = "DIR")]
    protocols: Option<PathBuf>,

    /// Draw each conversation as a sequence diagram when it has ended or is idle
    #[arg(long, conflicts_with = "json")]
    sequence: bool,

    /// Write the conversations as sequence diagrams in SVG to this file at the end
    ///
    /// Repeated letters between two agents are one line with their number. A conversation has at most
    /// 25 lines: violations and failures, then the first and the last letters.
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,

    /// Write the conversations as a Mermaid sequence diagram to this file at the end
    #[arg(long, value_name = "FILE")]
    mermaid: Option<PathBuf>,

    /// End after this number of shown letters
    #[arg(long, short, value_name = "N")]
    count: Option<u64>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Writes the files of diagrams.
    fn write<'a>(
        &self,
        conversations: impl Iterator<Item = &'a Conversation> + Clone,
    ) -> Result<(), Failure> {
        if let Some(file) = &self.svg {
            write(file, &drawing::page(conversations.clone()))?;
        }
        if let Some(file) = &self.mermaid {
            write(file, &mermaid::diagram(conversations))?;
        }
        Ok(())
    }
}

fn write(file: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(file, text).map_err(|error| {
        Failure::failed(
            format!("cannot write the diagram: {error}"),
            file.display().to_string(),
            "give a file that this user can write",
        )
    })
}

fn bytes(text: &str) -> Result<usize, String> {
    let bytes = text.parse();
    bytes.map_err(|_| "expected a number of bytes such as 80".to_owned())
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    report::warn_of_performatives(&arguments.filter.performative);
    let directory = arguments.protocols.as_deref();
    let library = checker::protocols(&config.monitor.protocols, directory)?;
    let checker = Checker::new(library);
    // An unwritable file is reported at the start, not at the end.
    arguments.write([].into_iter())?;
    options::block_on(watch(&arguments, checker, &config))?
}

async fn watch(arguments: &Arguments, checker: Checker, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let content = arguments.content.unwrap_or(0);
    let mut watcher = stop
        .during(membership::watch(config, WatchOptions { content }))
        .await?;
    let mut earlier = Earlier::default();
    earlier.add(watcher.directory());
    let mut display = Display {
        filter: &arguments.filter,
        checker,
        earlier,
        tally: Tally::default(),
        conversations: (arguments.sequence
            || arguments.mermaid.is_some()
            || arguments.svg.is_some())
        .then(Conversations::default),
        format: if arguments.json {
            Format::Json
        } else if arguments.sequence {
            Format::Sequence(Look::of_stdout())
        } else {
            Format::Text(TextOutput::new(Look::of_stdout()))
        },
        has_reader: true,
    };
    display.begin(&config.domain, watcher.processes())?;
    {
        let mut stopped = pin!(stop.requested());
        let mut over = pin!(options::after(arguments.time));
        while display.has_reader
            && arguments
                .count
                .is_none_or(|count| display.tally.shown < count)
        {
            tokio::select! {
                event = watcher.next() => {
                    if let Event::Lost { .. } = event {
                        display.lose(&watcher);
                    }
                    display.event(&event)?;
                }
                () = tokio::time::sleep(TICK) => {}
                () = &mut stopped => break,
                () = &mut over => break,
            }
            display.handle_timeout()?;
        }
    }
    let full = || {
        arguments
            .count
            .is_some_and(|count| display.tally.shown >= count)
    };
    if !full() {
        while let Some(event) = watcher.finish() {
            if let Event::Lost { .. } = event {
                display.lose(&watcher);
            }
            display.event(&event)?;
        }
    }
    Stop::ending();
    drop(watcher);
    display.end(arguments)
}

/// Interval of checks for overdue messages.
pub(super) const TICK: Duration = Duration::from_millis(200);
/// Maximum delay between sending a letter and observing it. A message is overdue only after it.
pub(super) const OBSERVATION_DELAY: Duration = Duration::from_millis(500);

/// Prints the observed events.
struct Display<'a> {
    filter: &'a Filter,
    checker: Checker,
    earlier: Earlier,
    tally: Tally,
    conversations: Option<Conversations>,
    format: Format,
    /// Whether standard output still has a reader.
    has_reader: bool,
}

enum Format {
    Text(TextOutput),
    Json,
    Sequence(Look),
}

impl Display<'_> {
    fn begin(&mut self, domain: &str, processes: usize) -> Result<(), Failure> {
        match &self.format {
            Format::Json => self.print(&json::watching(domain, processes)),
            Format::Text(output) => {
                let text = output.head(domain, processes);
                self.print(&text)
            }
            Format::Sequence(_) => self.print(&text::first_line(domain, processes)),
        }
    }

    fn print(&mut self, text: &str) -> Result<(), Failure> {
        self.has_reader &= output::bytes_if_read(text.as_bytes())?;
        Ok(())
    }

    /// Handles the loss of letters: the conversations of the present agents are unknown.
    fn lose(&mut self, watcher: &Watcher) {
        self.earlier.add(watcher.directory());
        self.checker.forget();
    }

    fn event(&mut self, event: &Event) -> Result<(), Failure> {
        match event {
            Event::Letter(passage) => self.letter(passage),
            Event::Later(passage) => {
                self.tally.later(passage);
                // Only for letters that were shown; a violation was printed with its letter.
                if !self.filter.violations && self.filter.takes(passage, &CheckResult::Checked) {
                    let text = match &self.format {
                        Format::Text(output) => output.later(passage),
                        Format::Json => json::later(passage),
                        Format::Sequence(_) => String::new(),
                    };
                    self.print(&text)?;
                }
                Ok(())
            }
            Event::Lost { process, records } => {
                self.tally.lost += records;
                let text = match &self.format {
                    Format::Json => json::lost(process, *records),
                    Format::Text(TextOutput { look }) | Format::Sequence(look) => {
                        text::lost(*look, process, *records)
                    }
                };
                self.print(&text)
            }
            Event::Refused { process, why } => {
                let text = match &self.format {
                    Format::Json => json::refused(process, &why.to_string()),
                    Format::Text(TextOutput { look }) | Format::Sequence(look) => {
                        text::refused(*look, process, &why.to_string())
                    }
                };
                self.print(&text)
            }
            // Events of later versions.
            _ => Ok(()),
        }
    }

    fn letter(&mut self, passage: &Passage) -> Result<(), Failure> {
        // Every letter is checked, whether shown or not: the state of a conversation depends on all its
        // letters.
        let letter = Letter::of(passage, &self.earlier);
        let checked = self.checker.check(letter);
        self.tally.letter(passage, &checked);
        if !self.filter.takes(passage, &checked) {
            return Ok(());
        }
        self.tally.shown += 1;
        let mut evicted = None;
        if let Some(conversations) = &mut self.conversations {
            evicted = conversations.add(passage, &checked);
        }
        let text = match &self.format {
            Format::Text(output) => output.letter(passage, &checked),
            Format::Json => json::letter(passage, &checked),
            Format::Sequence(look) => evicted.map_or_else(String::new, |it| it.drawn(*look)),
        };
        self.print(&text)
    }

    /// Prints overdue messages and the diagrams of idle conversations.
    fn handle_timeout(&mut self) -> Result<(), Failure> {
        let now = SystemTime::now() - OBSERVATION_DELAY;
        for event in self.checker.handle_timeout(now) {
            if self
                .filter
                .takes_conversation(Some(&event.protocol), Some(&event.conversation_id))
            {
                let text = match &self.format {
                    Format::Json => json::overdue(&event),
                    Format::Text(TextOutput { look }) | Format::Sequence(look) => {
                        text::overdue(*look, &event)
                    }
                };
                self.print(&text)?;
            }
        }
        if let (Format::Sequence(look), Some(conversations)) =
            (&self.format, &mut self.conversations)
        {
            let look = *look;
            let text = conversations
                .take_idle()
                .map(|it| it.drawn(look))
                .collect::<String>();
            self.print(&text)?;
        }
        Ok(())
    }

    fn end(mut self, arguments: &Arguments) -> Result<(), Failure> {
        if let (Format::Sequence(look), Some(conversations)) =
            (&self.format, &mut self.conversations)
        {
            let look = *look;
            let text = conversations
                .take_all()
                .map(|it| it.drawn(look))
                .collect::<String>();
            self.print(&text)?;
        }
        let text = match &self.format {
            Format::Json => json::summary(&self.tally),
            Format::Text(TextOutput { look }) => self.tally.summary(*look),
            // A diagram ends with a blank line already.
            Format::Sequence(look) => self
                .tally
                .summary(*look)
                .trim_start_matches('\n')
                .to_owned(),
        };
        self.print(&text)?;
        match &self.conversations {
            Some(conversations) => arguments.write(conversations.all()),
            None => Ok(()),
        }
    }
}
