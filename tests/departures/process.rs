//! A child process: a gateway, or an agent that takes part in every conversation and never ends one by
//! itself.
//!
//! Output: `at ADDRESS` of a gateway, `ready`, and `got PERFORMATIVE` for each received message.
//! Input: `finish` makes the agent reply to the requests that it has agreed to, and notify its
//! subscribers. The process ends when its input ends.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc;
use std::time::Duration;

use fipa::actions::{Action, Execution, Progress};
use fipa::protocol::{DialogueError, Reply, Task};
use fipa::{Agent, AgentId, Config, Domain, Gateway, Incoming, Kind, Performative};
use tokio::sync::Semaphore;

use crate::support;

/// Environment variable with the role of a child process: `gateway` or the name of an agent, then
/// arguments of `--set`, separated by spaces.
const ROLE: &str = "FIPA_DEPARTURES_ROLE";

/// Longer than any test runs.
const FOREVER: Duration = Duration::from_secs(600);

fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Runs the role of the environment, if there is one.
pub(crate) fn run() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    // Ends a line that the test harness may have started.
    say("");
    let mut words = role.split(' ').map(str::to_owned);
    let name = words.next().unwrap();
    let config = support::load(words);
    let finish = Arc::new(Semaphore::new(0));
    let finished = Arc::clone(&finish);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            assert_eq!(line, "finish");
            finished.add_permits(1_000);
        }
        std::process::exit(0);
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        if name == "gateway" {
            let gateway = Gateway::open(&config).await.unwrap();
            let mut locations = gateway.locations().into_iter();
            let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
            say(&format!("at {}", location.address()));
            say("ready");
            std::future::pending::<()>().await;
        }
        if name == "robot" {
            robot(&config, &finish).await;
        }
        agent(&config, &name, &finish).await;
    });
}

/// Offers an action that ends when the test says so, and publishes numbers.
async fn robot(config: &Config, finish: &Arc<Semaphore>) {
    let domain = Domain::open(config).await.unwrap();
    let robot = domain.register("robot").await.unwrap();
    let finish = Arc::clone(finish);
    let hold = move |(): (), run: Execution| {
        let finish = Arc::clone(&finish);
        async move {
            for step in 0_u64.. {
                run.progress(Progress {
                    note: Some(step.to_string()),
                    ..Progress::default()
                });
                tokio::select! {
                    finished = finish.acquire() => {
                        finished.unwrap().forget();
                        break;
                    }
                    () = tokio::time::sleep(Duration::from_millis(100)) => {}
                }
            }
            Ok::<_, String>("done".to_owned())
        }
    };
    let _offer = robot.offer(Action::new("hold"), hold).unwrap();
    let count = robot.publisher("count").unwrap();
    say("ready");
    for number in 0_u64.. {
        count.publish(number.to_string()).await;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

async fn agent(config: &Config, name: &str, finish: &Arc<Semaphore>) {
    let domain = Domain::open(config).await.unwrap();
    let agent = Arc::new(domain.register(name).await.unwrap());
    say("ready");
    if name == "starter" {
        tokio::spawn(start(Arc::clone(&agent)));
    }
    loop {
        let first = agent.receive().await.unwrap();
        say(&format!("got {}", first.message().performative()));
        if let Ok(task) = agent.take_part(&first) {
            tokio::spawn(take_part(task, first, Arc::clone(finish)));
        }
    }
}

/// Begins a conversation with the rover.
async fn start(agent: Arc<Agent>) {
    let request = agent
        .message(Performative::Request)
        .receiver(AgentId::new("rover").unwrap());
    let mut request = agent.request(request, FOREVER).await.unwrap();
    let _ = request.result().await;
}

async fn take_part(
    mut task: Task,
    first: Incoming,
    finish: Arc<Semaphore>,
) -> Result<(), DialogueError> {
    match first.message().performative() {
        Performative::Request | Performative::QueryRef | Performative::RequestWhen => {
            task.agree("").await?;
            finish.acquire().await.unwrap().forget();
            return task.reply(Reply::Inform("done".into())).await;
        }
        Performative::Subscribe => {
            task.agree("").await?;
            task.inform("first").await?;
            finish.acquire().await.unwrap().forget();
            task.inform("second").await?;
        }
        Performative::Proxy => {
            task.agree("").await?;
            task.inform("passed on").await?;
        }
        Performative::Cfp => {
            task.propose("1", FOREVER).await?;
            say(&format!("got {}", task.message().performative()));
        }
        // The opening of an auction.
        Performative::Inform => {
            task.next_call(FOREVER).await?;
            say("got call");
        }
        _ => {}
    }
    std::future::pending().await
}

/// A running child process. Dropping it kills it.
pub(crate) struct Process {
    child: Child,
    input: ChildStdin,
    lines: mpsc::Receiver<String>,
    /// The address of a gateway.
    pub(crate) address: Option<String>,
}

impl Process {
    /// Starts a process with this role, and waits until it is ready.
    pub(crate) fn start(name: &str, set: &[String]) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "--nocapture", "process_entry"])
            .env(ROLE, format!("{name} {}", set.join(" ")))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let mut process = Self {
            input: child.stdin.take().unwrap(),
            child,
            lines,
            address: None,
        };
        loop {
            let line = process.line();
            if let Some(address) = line.strip_prefix("at ") {
                process.address = Some(address.to_owned());
            }
            if line == "ready" {
                return process;
            }
        }
    }

    fn line(&self) -> String {
        self.lines.recv_timeout(Duration::from_secs(60)).unwrap()
    }

    /// Waits until the process has received these messages, in any order.
    pub(crate) fn got(&self, messages: &[&str]) {
        let mut missing: Vec<&str> = messages.to_vec();
        while !missing.is_empty() {
            let line = self.line();
            let got = line.strip_prefix("got ").unwrap_or_default();
            if let Some(at) = missing.iter().position(|act| *act == got) {
                missing.swap_remove(at);
            }
        }
    }

    pub(crate) fn finish(&mut self) {
        writeln!(self.input, "finish").unwrap();
    }

    /// Kills the process with SIGKILL.
    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Stops or continues the process.
    pub(crate) fn signal(&self, signal: rustix::process::Signal) {
        let id = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(id, signal).unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
