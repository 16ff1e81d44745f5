//! `fipa top`: shows the letters per second of agents and hosts live.
//!
//! * [`window`] and [`meter`] count the letters that a watcher observes, [`peers`] reads the reports of the gateway.
//! * [`table`] is a state of the domain at one time; [`screen`] and [`print`] show it.
//! * [`view`] handles keys; [`terminal`] has the terminal.

mod meter;
mod peers;
mod print;
mod screen;
mod table;
mod terminal;
mod view;
mod window;

use std::io::{self, IsTerminal as _};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use clap::Args;
use fipa::admin::routes::{ASKER_TYPE, RouteReport};
use fipa::admin::watch::{Event, Passage, WatchOptions, Watcher};
use fipa::{Agent, Config, DirectoryView, Reach, Role};
use ratatui::crossterm::event::Event as TerminalEvent;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use self::meter::{Meter, Observed};
use self::peers::Peers;
pub(in crate::command) use self::print::{AgentCounts, TotalsObject, peer_object};
use self::screen::Palette;
pub(in crate::command) use self::table::{AgentRow, Snapshot};
use self::table::{Column, Surroundings};
use self::terminal::Screen;
use self::view::{Filter, View};
use crate::command::watch::OBSERVATION_DELAY;
use crate::command::watch::checker::{self, CheckResult, Checker, Earlier, Letter};
use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Show the letters per second of agents and hosts live
///
/// Shows, for each agent of this host and each agent that exchanges letters with them: the letters per
/// second that it sends and receives, its failures, its letters that violate their protocols (the check
/// of `fipa watch`), the time from sending to the outcome, and the transport that carries most of its
/// letters. If a gateway is running, it also shows the hosts of other gateways: connected or lost,
/// letters per second, delivery time, transports, encryption and retries. The agents need no
/// configuration for it and are not slowed down.
///
/// On a terminal, it takes the whole screen, and ? lists the keys. Rates and times cover the last five
/// seconds, or --every if that is longer. Otherwise it prints tables, each of the last --every.
///
/// At most 1000 agents have rows; the letters of all others are in one row.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa top
  fipa top 'arm_.*' --sort failed
  fipa top --every 10s | tee letters.txt         tables, one every ten seconds
  fipa top --count 1 --every 5s | cat            one table
  fipa top --json | jq -c '.agents[] | select(.failures_per_second > 0)'

Keys:
  q Ctrl-C     quit
  < > or ← →   sort by the column before or after; 1 to 8 sort by a column
  r            reverse the order
  /            show only agents with a name or names that match a pattern
  Esc          show all agents again
  p            pause, continue
  ?            help

Columns of agents: letters per second sent (SENT), received (RECV) and failed (FAIL), letters so far that
violate their protocols (VIOL), time from sending to the outcome (MEDIAN, P99), transport (VIA).
Columns of hosts: state, letters per second to (TO) and from (FROM) its agents, time from sending to the
outcome, transports, encryption, attempts to send that failed or were rejected since the start of the
gateway (RETRIES).

JSON, one object on a line:
  { \"time\", \"domain\", \"host\", \"agents_here\", \"agents_elsewhere\", \"processes\", \"gateway\": name or null,
    \"problem\": reason why the hosts are not up to date, or null,
    \"letters_per_second\", \"failures_per_second\", \"violations_per_second\",
    \"letters\", \"failures\", \"violations\": since the start, \"lost\": lost records,
    \"median_us\", \"p99_us\": delivery time in microseconds, or null,
    \"agents\": [ agent ], \"others\": agent, the sum of all agents without a row, or null,
    \"hosts\": [ { \"name\", \"state\": \"connected\", \"lost\" or \"no_answer\", \"seconds\": in this state,
                 \"to_per_second\", \"from_per_second\", \"median_us\", \"p99_us\", \"transports\",
                 \"encrypted\": true, false or null, \"retries\" } ] }
  agent = { \"name\", \"sent_per_second\", \"received_per_second\", \"failures_per_second\",
            \"sent\", \"received\", \"failures\", \"violations\": since the start,
            \"median_us\", \"p99_us\", \"via\": transport or null }")]
pub(crate) struct Arguments {
    /// Show only agents with this name or with a name that matches this pattern
    #[arg(value_parser = Filter::parse, add = complete::agents())]
    pattern: Option<Filter>,

    /// Time between two screens or tables
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = interval)]
    every: Duration,

    /// End after this number of screens or tables
    #[arg(long, short, value_name = "N")]
    count: Option<u64>,

    /// Sort agents by this column
    #[arg(long, value_name = "COLUMN", value_enum, default_value_t = Column::Sent)]
    sort: Column,

    /// Directory with SCXML files of protocols (*.scxml, *.xml, or without an extension)
    ///
    /// They are added to those of the FIPA standards and of monitor.protocols.
    #[arg(long, value_name = "DIR")]
    protocols: Option<PathBuf>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

/// Minimum time between two screens.
const MIN_INTERVAL: Duration = Duration::from_millis(100);
/// Minimum time that rates on a screen cover.
const MIN_WINDOW: Duration = Duration::from_secs(5);
/// Time between two requests to the gateway.
const REPORT_INTERVAL: Duration = Duration::from_secs(2);

fn interval(text: &str) -> Result<Duration, String> {
    let time = options::duration(text)?;
    match time < MIN_INTERVAL {
        true => Err("expected at least 100ms".to_owned()),
        false => Ok(time),
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let directory = arguments.protocols.as_deref();
    let library = checker::protocols(&config.monitor.protocols, directory)?;
    let checker = Checker::new(library);
    options::block_on(top(arguments, checker, &config))?
}

async fn top(arguments: Arguments, checker: Checker, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let shown = match stop.during(membership::asker(&domain)).await {
        Ok(asker) => show(arguments, checker, config, asker, &mut stop).await,
        Err(failure) => Err(failure),
    };
    Stop::ending();
    domain.close().await;
    shown
}

/// Shows the domain until the end of the command, and restores the terminal.
async fn show(
    arguments: Arguments,
    checker: Checker,
    config: &Config,
    asker: Agent,
    stop: &mut Stop,
) -> Result<(), Failure> {
    let watcher = stop
        .during(membership::watch(config, WatchOptions::default()))
        .await?;
    let (mut target, keys) = Target::open(&arguments)?;
    let window = match target {
        Target::Screen(..) => arguments.every.max(MIN_WINDOW),
        Target::Text | Target::Json => arguments.every,
    };
    let own = vec![asker.name().to_owned()];
    let mut observer = Observer::new(window, checker, own, config, &watcher);
    let (sender, reports) = mpsc::channel(1);
    let asking = tokio::spawn(ask(asker, sender));
    let mut sources = Sources {
        watcher,
        reports,
        keys,
    };
    let shown = tokio::select! {
        shown = refresh(&arguments, &mut observer, &mut sources, &mut target) => shown,
        () = stop.requested() => Ok(()),
    };
    drop(target);
    // The agent leaves the domain before the domain is closed.
    asking.abort();
    let _ = asking.await;
    shown
}

/// The events of the command.
struct Sources {
    watcher: Watcher,
    reports: mpsc::Receiver<GatewayReport>,
    /// Keys and changes of the size of the terminal.
    keys: Option<mpsc::Receiver<TerminalEvent>>,
}

/// The report of the gateway, `None` if none is running, or the problem.
pub(in crate::command) type GatewayReport = Result<Option<RouteReport>, String>;

/// Asks the gateway for its report again and again.
pub(in crate::command) async fn ask(agent: Agent, reports: mpsc::Sender<GatewayReport>) {
    loop {
        // The routes to all agents could be many; the report needs to have none.
        let report = membership::report_to(&agent, Some(agent.name())).await;
        let report = report.map_err(|failure| failure.problem());
        if reports.send(report).await.is_err() {
            return;
        }
        tokio::time::sleep(REPORT_INTERVAL).await;
    }
}

/// Observes the domain and shows it again and again.
async fn refresh(
    arguments: &Arguments,
    observer: &mut Observer,
    sources: &mut Sources,
    target: &mut Target,
) -> Result<(), Failure> {
    let mut view = View::new(arguments.sort, arguments.pattern.clone());
    let first = match target {
        Target::Screen(..) => Duration::ZERO,
        // The first table covers a whole interval.
        Target::Text | Target::Json => arguments.every,
    };
    let began = tokio::time::Instant::now() + first;
    let mut ticks = tokio::time::interval_at(began, arguments.every);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut snapshot = observer.snapshot(&sources.watcher);
    let mut shown = 0;
    while arguments.count.is_none_or(|count| shown < count) {
        let is_open = tokio::select! {
            event = sources.watcher.next() => {
                observer.event(&event, &sources.watcher);
                true
            }
            Some(report) = sources.reports.recv() => {
                observer.report(report);
                true
            }
            _ = ticks.tick() => {
                if !view.paused {
                    snapshot = observer.snapshot(&sources.watcher);
                }
                shown += 1;
                target.show(&snapshot, &view)?
            }
            event = next_key(&mut sources.keys) => match event {
                Some(TerminalEvent::Key(key)) if view.handle_key(key) => false,
                Some(_) => target.show(&snapshot, &view)?,
                None => false,
            },
        };
        if !is_open {
            break;
        }
    }
    Ok(())
}

/// Returns `None` when the terminal is closed.
async fn next_key(keys: &mut Option<mpsc::Receiver<TerminalEvent>>) -> Option<TerminalEvent> {
    match keys {
        Some(keys) => keys.recv().await,
        None => std::future::pending().await,
    }
}

/// The place where the domain is shown.
enum Target {
    Screen(Box<Screen>, Palette),
    Text,
    Json,
}

impl Target {
    /// Takes the screen of the terminal, if there is one and no JSON is requested. Also returns its keys.
    fn open(
        arguments: &Arguments,
    ) -> Result<(Self, Option<mpsc::Receiver<TerminalEvent>>), Failure> {
        if arguments.json {
            return Ok((Self::Json, None));
        }
        if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
            return Ok((Self::Text, None));
        }
        let palette = Palette {
            color: output::has_color(),
        };
        let opened = Screen::open().map_err(|error| terminal_failure(&error));
        opened.map(|(screen, keys)| (Self::Screen(Box::new(screen), palette), Some(keys)))
    }

    /// Shows the domain. Returns whether the output still has a reader.
    fn show(&mut self, snapshot: &Snapshot, view: &View) -> Result<bool, Failure> {
        let shown = view.filter.as_ref().map(|filter| &filter.matcher);
        let text = match self {
            Self::Screen(screen, palette) => {
                let drawn = screen.draw(|frame| screen::draw(frame, snapshot, view, *palette));
                return drawn
                    .map(|()| true)
                    .map_err(|error| terminal_failure(&error));
            }
            Self::Text => output::printable(&print::text(snapshot, view.order, shown)).into_owned(),
            Self::Json => {
                let json = print::json(snapshot, view.order, shown).to_string();
                format!("{}\n", output::visible_in_json(&json))
            }
        };
        output::bytes_if_read(text.as_bytes())
    }
}

fn terminal_failure(error: &io::Error) -> Failure {
    Failure::failed(
        format!("cannot use the terminal: {error}"),
        "standard output",
        "print tables instead: `fipa top | cat`",
    )
}

/// Counts the observed letters.
pub(in crate::command) struct Observer {
    meter: Meter,
    peers: Peers,
    checker: Checker,
    earlier: Earlier,
    /// The names of the agents of this program. Their letters do not count.
    own: Vec<String>,
    domain: String,
    host: String,
}

impl Observer {
    /// Begins now. Rates and percentiles cover a window of this length.
    pub(in crate::command) fn new(
        window: Duration,
        checker: Checker,
        own: Vec<String>,
        config: &Config,
        watcher: &Watcher,
    ) -> Self {
        let mut earlier = Earlier::default();
        earlier.add(watcher.directory());
        Self {
            meter: Meter::new(Instant::now(), window),
            peers: Peers::default(),
            checker,
            earlier,
            own,
            domain: config.domain.clone(),
            host: output::host_name(),
        }
    }

    /// Handles an event. Returns the result of the check of a new letter, unless it is of this program.
    pub(in crate::command) fn event(
        &mut self,
        event: &Event,
        watcher: &Watcher,
    ) -> Option<CheckResult> {
        let now = Instant::now();
        let directory = watcher.directory();
        match event {
            Event::Letter(passage) if !self.is_own(passage) => {
                let checked = self.checker.check(Letter::of(passage, &self.earlier));
                let host = host_of(passage, directory);
                let host = host.as_deref();
                let observed = Observed { passage, host };
                self.meter.letter(now, &observed, checked.is_violation());
                return Some(checked);
            }
            Event::Later(passage) | Event::Confirmed(passage) if !self.is_own(passage) => {
                let host = host_of(passage, directory);
                let host = host.as_deref();
                self.meter.later(now, &Observed { passage, host });
            }
            Event::Lost { records, .. } => {
                self.meter.lose(*records);
                self.earlier.add(directory);
                self.checker.forget();
            }
            _ => {}
        }
        None
    }

    /// Whether a letter is from or to an agent of this program.
    pub(in crate::command) fn is_own(&self, passage: &Passage) -> bool {
        let is_own = |name: &str| self.own.iter().any(|own| own == name);
        is_own(&passage.receiver) || passage.sender().is_some_and(is_own)
    }

    /// Takes the report of the gateway, or the reason why there is none.
    pub(in crate::command) fn report(&mut self, report: GatewayReport) {
        match report {
            Ok(report) => self.peers.handle_report(Instant::now(), report),
            Err(problem) => self.peers.handle_failure(problem),
        }
    }

    /// Returns the domain as it is now.
    pub(in crate::command) fn snapshot(&mut self, watcher: &Watcher) -> Snapshot {
        let (now, time) = (Instant::now(), SystemTime::now());
        self.checker.pass(time - OBSERVATION_DELAY);
        let directory = watcher.directory();
        directory.refresh();
        let entries = directory.entries();
        let agents = entries
            .iter()
            .filter(|entry| entry.role == Role::Agent && entry.agent_type != ASKER_TYPE);
        let local = agents.clone().filter(|it| it.reach == Reach::Local);
        self.meter.register(now, local.clone().map(|it| &*it.name));
        let here = local.count();
        let gateway = entries.iter().find(|entry| entry.is_own_gateway());
        let surroundings = Surroundings {
            domain: self.domain.clone(),
            host: self.host.clone(),
            time,
            here,
            elsewhere: agents.count() - here,
            // Without this process.
            processes: watcher.processes().saturating_sub(1),
            gateway: gateway.map(|entry| entry.name.to_string()),
            problem: self.peers.problem().map(str::to_owned),
        };
        let peers = self.peers.rows(now, &self.meter);
        Snapshot::new(now, &self.meter, peers, surroundings)
    }
}

/// The host of the agent at the other end of a letter, by the name of its gateway; `None` for a letter within this
/// host.
fn host_of(passage: &Passage, directory: DirectoryView<'_>) -> Option<Arc<str>> {
    let name = match passage.from_elsewhere {
        true => passage.sender()?,
        false => &passage.receiver,
    };
    let entry = directory.known(name)?;
    match entry.reach {
        Reach::Local => None,
        Reach::Remote { .. } => entry.mts.name.clone(),
    }
}
