//! `fipa watch`: the letters of this host, while they pass.

mod conversations;
mod filter;
pub(super) mod judge;
mod machine;
mod mermaid;
mod person;
mod sequence;
mod tally;

use std::path::PathBuf;
use std::pin::pin;
use std::time::{Duration, SystemTime};

use clap::Args;
use fipa::watch::{Event, Passage, WatchOptions, Watcher};
use fipa::{Config, Matcher, Performative};
use tokio::time::Instant;

use self::conversations::Conversations;
use self::filter::Filter;
use self::judge::{Judge, Judged};
use self::person::{Look, Person};
use self::tally::Tally;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Show letters passing on this host, live
///
/// Shows the letters of all processes of the domain on this host, those through shared memory too:
/// who writes to whom, what, by which way, what becomes of it, and whether it keeps to the
/// interaction protocol of its conversation. Agents need not be asked and are not slowed; content
/// is not shown unless asked for. A letter between hosts is seen at both.
///
/// Letters are shown in the order in which they were sent, each when its outcome is known, or after
/// a quarter of a second; an outcome that comes later has a line of its own. Whoever reads too
/// slowly is told how much was missed.
///
/// Ctrl-C ends it, with a summary.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa watch
  fipa watch --agent 'arm_.*' --protocol fipa-contract-net
  fipa watch --violations --protocols ./protocols
  fipa watch --sequence                          conversations as sequence diagrams
  fipa watch --conversation c1 --mermaid c1.mmd  the same for documents, written at the end
  fipa watch --json | jq -r 'select(.verdict.verdict == \"violation\") | .verdict.text'

Columns: time (UTC), from and to, performative, protocol, conversation, length of the letter, way,
outcome, verdict. The verdict is the state that the conversation is in now, `-` where there is
nothing to be checked, or VIOLATION with what was expected of whom.

JSON, one object on a line:
  { \"event\": \"watching\", \"domain\", \"processes\": how many were there }
  { \"event\": \"letter\", \"number\", \"time\", \"sender\", \"receiver\", \"performative\", \"protocol\",
    \"conversation_id\", \"size\", \"content_length\", \"content_cut\", \"via\", \"gateway\",
    \"message\": the same for all receivers of one message,
    \"outcome\": \"delivered\", \"sent\", \"failed\", \"taken\" (seen at the receiver only) or
    \"under_way\", \"reason\", \"attempts\": [ { \"via\", \"location\", \"error\" } ],
    \"verdict\": { \"verdict\": \"accepted\", \"violation\" or \"unchecked\", ... },
    \"letter\": { \"envelope\", \"effective\", \"message\" } as `fipa decode` prints it }
  { \"event\": \"outcome\", \"number\", \"sender\", \"receiver\", \"outcome\", ... }  of an earlier letter
  { \"event\": \"overdue\", \"protocol\", \"conversation_id\", \"participant\", \"state\" }
  { \"event\": \"lost\", \"process\", \"records\" }
  { \"event\": \"refused\", \"process\", \"error\" }
  { \"event\": \"summary\", \"seconds\", \"letters\", \"shown\", \"outcomes\", \"conversations\",
    \"violations\", \"lost\" }")]
pub(crate) struct Arguments {
    /// Only letters from or to this agent, or agents whose names match this pattern; may be repeated
    #[arg(long, value_name = "AGENT", value_parser = Matcher::parse)]
    agent: Vec<Matcher>,

    /// Only letters of this protocol, or of those that match this pattern; may be repeated
    #[arg(long, value_name = "PROTOCOL", value_parser = Matcher::parse)]
    protocol: Vec<Matcher>,

    /// Only letters with this performative; may be repeated
    #[arg(long, value_name = "PERFORMATIVE")]
    performative: Vec<Performative>,

    /// Only letters of this conversation, or of those that match this pattern; may be repeated
    #[arg(long, value_name = "ID", value_parser = filter::conversation)]
    conversation: Vec<filter::Conversation>,

    /// Only letters that break their protocols
    #[arg(long)]
    violations: bool,

    /// Show content, too: so many bytes of each message at most
    #[arg(long, value_name = "BYTES", num_args = 0..=1, default_missing_value = "80",
          require_equals = true, value_parser = bytes)]
    content: Option<usize>,

    /// Protocols besides those of the FIPA standards: SCXML files in this directory
    #[arg(long, value_name = "DIR")]
    protocols: Option<PathBuf>,

    /// Draw conversations as sequence diagrams, each when it has come to its end or nothing more
    /// comes
    #[arg(long, conflicts_with = "json")]
    sequence: bool,

    /// Write the conversations as a Mermaid sequence diagram into this file, at the end
    #[arg(long, value_name = "FILE")]
    mermaid: Option<PathBuf>,

    /// End after so many letters
    #[arg(long, value_name = "N")]
    count: Option<u64>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

fn bytes(text: &str) -> Result<usize, String> {
    let bytes = text.parse();
    bytes.map_err(|_| "use a number of bytes such as 80".to_owned())
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let judge = Judge::new(arguments.protocols.as_deref())?;
    if let Some(file) = &arguments.mermaid {
        // Better known now than at the end.
        mermaid::write(file, "sequenceDiagram\n")?;
    }
    options::block_on(watch(&arguments, judge, &config))?
}

async fn watch(arguments: &Arguments, judge: Judge, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let content = arguments.content.unwrap_or(0);
    let watcher = Watcher::open(config, WatchOptions { content }).await;
    let mut watcher = watcher.map_err(|error| membership::not_joined(error, config))?;
    let mut show = Show {
        filter: Filter {
            agents: &arguments.agent,
            protocols: &arguments.protocol,
            performatives: &arguments.performative,
            conversations: &arguments.conversation,
            violations: arguments.violations,
        },
        judge,
        tally: Tally::default(),
        conversations: (arguments.sequence || arguments.mermaid.is_some())
            .then(Conversations::default),
        form: if arguments.json {
            Form::Json
        } else if arguments.sequence {
            Form::Sequence(Look::of_stdout())
        } else {
            Form::Lines(Person::new(Look::of_stdout()))
        },
        open: true,
    };
    show.begin(&config.domain, watcher.processes())?;
    // Beyond all clocks is never.
    let ends = arguments
        .time
        .and_then(|time| Instant::now().checked_add(time));
    {
        let mut stopped = pin!(stop.requested());
        while show.open && arguments.count.is_none_or(|count| show.tally.shown < count) {
            tokio::select! {
                event = watcher.next() => show.event(&event)?,
                () = tokio::time::sleep(TICK) => {}
                () = &mut stopped => break,
                () = at(ends) => break,
            }
            show.time_passes()?;
        }
    }
    let full = || {
        arguments
            .count
            .is_some_and(|count| show.tally.shown >= count)
    };
    if !full() {
        while let Some(event) = watcher.finish() {
            show.event(&event)?;
        }
    }
    Stop::ending();
    drop(watcher);
    show.end(arguments.mermaid.as_deref())
}

/// How often what is overdue is looked for.
const TICK: Duration = Duration::from_millis(200);
/// Letters are seen this much later than they were sent, at most: nothing is overdue before.
const SEEN_AFTER: Duration = Duration::from_millis(500);

async fn at(end: Option<Instant>) {
    match end {
        Some(end) => tokio::time::sleep_until(end).await,
        None => std::future::pending().await,
    }
}

/// Shows what is seen.
struct Show<'a> {
    filter: Filter<'a>,
    judge: Judge,
    tally: Tally,
    conversations: Option<Conversations>,
    form: Form,
    /// Whether anybody reads what is printed.
    open: bool,
}

enum Form {
    Lines(Person),
    Json,
    Sequence(Look),
}

impl Show<'_> {
    fn begin(&mut self, domain: &str, processes: usize) -> Result<(), Failure> {
        match &self.form {
            Form::Json => self.print(&machine::watching(domain, processes)),
            Form::Lines(person) => {
                let text = person.head(domain, processes);
                self.print(&text)
            }
            Form::Sequence(_) => self.print(&person::first_line(domain, processes)),
        }
    }

    fn print(&mut self, text: &str) -> Result<(), Failure> {
        self.open &= output::text_if_read(text)?;
        Ok(())
    }

    fn event(&mut self, event: &Event) -> Result<(), Failure> {
        match event {
            Event::Letter(passage) => self.letter(passage),
            Event::Later(passage) => {
                self.tally.later(passage);
                // Only of what was shown; a violation was shown with the letter.
                if !self.filter.violations && self.filter.takes(passage, &Judged::Later) {
                    let text = match &self.form {
                        Form::Lines(person) => person.later(passage),
                        Form::Json => machine::later(passage),
                        Form::Sequence(_) => String::new(),
                    };
                    self.print(&text)?;
                }
                Ok(())
            }
            Event::Lost { process, records } => {
                self.tally.lost += records;
                let text = match &self.form {
                    Form::Json => machine::lost(process, *records),
                    Form::Lines(Person { look }) | Form::Sequence(look) => {
                        person::lost(*look, process, *records)
                    }
                };
                self.print(&text)
            }
            Event::Refused { process, why } => {
                let text = match &self.form {
                    Form::Json => machine::refused(process, &why.to_string()),
                    Form::Lines(Person { look }) | Form::Sequence(look) => {
                        person::refused(*look, process, &why.to_string())
                    }
                };
                self.print(&text)
            }
            // What a later version sees.
            _ => Ok(()),
        }
    }

    fn letter(&mut self, passage: &Passage) -> Result<(), Failure> {
        // All of them, whatever is shown: a conversation is more than the letters shown of it.
        let judged = self.judge.judge(passage);
        self.tally.letter(passage, &judged);
        if !self.filter.takes(passage, &judged) {
            return Ok(());
        }
        self.tally.shown += 1;
        let mut evicted = None;
        if let Some(conversations) = &mut self.conversations {
            evicted = conversations.add(passage, &judged);
        }
        let text = match &self.form {
            Form::Lines(person) => person.letter(passage, &judged),
            Form::Json => machine::letter(passage, &judged),
            Form::Sequence(look) => evicted.map_or_else(String::new, |it| it.drawn(*look)),
        };
        self.print(&text)
    }

    /// What is noticed without a letter.
    fn time_passes(&mut self) -> Result<(), Failure> {
        let now = SystemTime::now() - SEEN_AFTER;
        for event in self.judge.time_passes(now) {
            if self
                .filter
                .takes_conversation(event.protocol(), event.conversation())
            {
                let text = match &self.form {
                    Form::Json => machine::overdue(&event),
                    Form::Lines(Person { look }) | Form::Sequence(look) => {
                        person::overdue(*look, &event)
                    }
                };
                self.print(&text)?;
            }
        }
        if let (Form::Sequence(look), Some(conversations)) = (&self.form, &mut self.conversations) {
            let look = *look;
            let text = conversations
                .resting()
                .map(|it| it.drawn(look))
                .collect::<String>();
            self.print(&text)?;
        }
        Ok(())
    }

    fn end(mut self, mermaid: Option<&std::path::Path>) -> Result<(), Failure> {
        if let (Form::Sequence(look), Some(conversations)) = (&self.form, &mut self.conversations) {
            let look = *look;
            let text = conversations
                .rest()
                .map(|it| it.drawn(look))
                .collect::<String>();
            self.print(&text)?;
        }
        let text = match &self.form {
            Form::Json => machine::summary(&self.tally),
            Form::Lines(Person { look }) => self.tally.told(*look),
            // Behind a diagram there is a blank line already.
            Form::Sequence(look) => self.tally.told(*look).trim_start_matches('\n').to_owned(),
        };
        self.print(&text)?;
        if let (Some(file), Some(conversations)) = (mermaid, &self.conversations) {
            mermaid::write(file, &mermaid::diagram(conversations.all()))?;
        }
        Ok(())
    }
}
