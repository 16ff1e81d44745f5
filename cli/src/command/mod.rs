//! The commands, one file each: its arguments with their help, and `run`.

mod actions;
mod agents;
mod ams;
mod ask;
#[cfg(feature = "bench")]
mod bench;
mod coalition;
mod completions;
mod config;
mod content;
mod dashboard;
mod decode;
mod demo;
mod df;
mod do_action;
mod doctor;
mod echo;
mod encode;
mod keys;
mod listen;
mod lock;
mod locks;
mod man;
mod own;
mod ping;
mod protocol;
mod publish;
mod record;
mod reload;
mod replay;
mod request;
mod routes;
mod send;
mod subscribe;
mod top;
pub(crate) mod topics;
mod up;
mod watch;

use clap::Subcommand;

use crate::options::Global;
use crate::report::Failure;

/// The commands of `fipa`.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Up(up::Arguments),
    Agents(agents::Arguments),
    Send(Box<send::Arguments>),
    Echo(echo::Arguments),
    Listen(listen::Arguments),
    Request(request::Arguments),
    Publish(publish::Arguments),
    Subscribe(subscribe::Arguments),
    Topics(topics::Arguments),
    Ping(ping::Arguments),
    Coalition(coalition::Arguments),
    #[command(subcommand)]
    Df(df::Arguments),
    Ams(ams::Arguments),
    Actions(actions::Arguments),
    Do(do_action::Arguments),
    Own(own::Arguments),
    Lock(lock::Arguments),
    Locks(locks::Arguments),
    Routes(routes::Arguments),
    Reload(reload::Arguments),
    Watch(Box<watch::Arguments>),
    Top(top::Arguments),
    Dashboard(dashboard::Arguments),
    Record(Box<record::Arguments>),
    Replay(Box<replay::Arguments>),
    Demo(demo::Arguments),
    Doctor(doctor::Arguments),
    #[cfg(feature = "bench")]
    Bench(bench::Arguments),
    Decode(decode::Arguments),
    Encode(encode::Arguments),
    #[command(subcommand)]
    Content(content::Arguments),
    #[command(subcommand)]
    Protocol(protocol::Arguments),
    Keys(keys::Arguments),
    #[command(subcommand)]
    Config(config::Arguments),
    Completions(completions::Arguments),
    Man(man::Arguments),
}

/// Runs a command.
pub(crate) fn run(command: Command, global: &Global) -> Result<(), Failure> {
    match command {
        Command::Up(arguments) => up::run(arguments, global),
        Command::Agents(arguments) => agents::run(arguments, global),
        Command::Send(arguments) => send::run(*arguments, global),
        Command::Echo(arguments) => echo::run(arguments, global),
        Command::Listen(arguments) => listen::run(arguments, global),
        Command::Request(arguments) => request::run(arguments, global),
        Command::Publish(arguments) => publish::run(arguments, global),
        Command::Subscribe(arguments) => subscribe::run(arguments, global),
        Command::Topics(arguments) => topics::run(arguments, global),
        Command::Ping(arguments) => ping::run(arguments, global),
        Command::Coalition(arguments) => coalition::run(arguments, global),
        Command::Df(arguments) => df::run(arguments, global),
        Command::Ams(arguments) => ams::run(arguments, global),
        Command::Actions(arguments) => actions::run(arguments, global),
        Command::Do(arguments) => do_action::run(arguments, global),
        Command::Own(arguments) => own::run(arguments, global),
        Command::Lock(arguments) => lock::run(arguments, global),
        Command::Locks(arguments) => locks::run(arguments, global),
        Command::Routes(arguments) => routes::run(arguments, global),
        Command::Reload(arguments) => reload::run(arguments, global),
        Command::Watch(arguments) => watch::run(*arguments, global),
        Command::Top(arguments) => top::run(arguments, global),
        Command::Dashboard(arguments) => dashboard::run(arguments, global),
        Command::Record(arguments) => record::run(*arguments, global),
        Command::Replay(arguments) => replay::run(&arguments, global),
        Command::Demo(arguments) => demo::run(arguments, global),
        Command::Doctor(arguments) => doctor::run(arguments, global),
        #[cfg(feature = "bench")]
        Command::Bench(arguments) => bench::run(arguments, global),
        Command::Decode(arguments) => decode::run(arguments, global),
        Command::Encode(arguments) => encode::run(arguments, global),
        Command::Content(arguments) => content::run(arguments, global),
        Command::Protocol(arguments) => protocol::run(arguments, global),
        Command::Keys(arguments) => keys::run(arguments, global),
        Command::Config(arguments) => config::run(arguments, global),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Man(arguments) => man::run(&arguments),
    }
}
