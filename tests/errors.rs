//! Each error of the public interface has a message without the messages of its causes, and reports
//! the causes as sources. [`ErrorChain`] prints all of them once.

use std::error::Error;
use std::io;
use std::sync::Arc;

use fipa::Kind;
use fipa::admin::routes::AskError;
use fipa::config::ConfigError;
use fipa::error::{
    CoalitionError, DeregisterError, DomainDirError, EncodeError, EntryError, ErrorChain,
    HostError, ListenError, MembersError, NameError, OpenError, PostError, RegisterError,
    SendError,
};

const CAUSE: &str = "the disk is on fire";

fn cause() -> io::Error {
    io::Error::other(CAUSE)
}

/// Each error with all of its text.
fn errors() -> Vec<(Box<dyn Error>, String)> {
    let path = || "/dir".into();
    let name = NameError::Empty.to_string();
    let encode = EncodeError::EnvelopeTooLong(70_000);
    let directory = || HostError::Io {
        what: "open",
        path: path(),
        source: cause(),
    };
    #[cfg_attr(not(feature = "secure"), expect(unused_mut))]
    let mut all: Vec<(Box<dyn Error>, String)> = vec![
        (
            Box::new(OpenError::Listen {
                kind: Kind::Tcp,
                source: ListenError::Bind {
                    address: "127.0.0.1:7".into(),
                    source: cause(),
                },
            }),
            format!("cannot open the transport tcp: cannot listen on 127.0.0.1:7: {CAUSE}"),
        ),
        (
            Box::new(OpenError::Config(ConfigError::Read {
                path: path(),
                named_by: "named by --config",
                source: cause(),
            })),
            format!("cannot read the configuration /dir (named by --config): {CAUSE}"),
        ),
        (
            Box::new(OpenError::DomainDir(DomainDirError::Io {
                path: path(),
                source: cause(),
            })),
            format!("cannot use the directory /dir: {CAUSE}"),
        ),
        (
            Box::new(OpenError::Directory(directory())),
            format!("cannot open /dir: {CAUSE}"),
        ),
        (
            Box::new(OpenError::Directory(HostError::Watch {
                path: path(),
                source: cause(),
            })),
            format!("cannot read inotify events of /dir: {CAUSE}"),
        ),
        (
            Box::new(OpenError::Name(RegisterError::Failed(
                Arc::new(directory()),
            ))),
            format!(
                "cannot register the gateway: cannot register in the directory: cannot open /dir: \
                 {CAUSE}"
            ),
        ),
        (
            Box::new(OpenError::Watch(cause())),
            format!("cannot listen to the processes of the domain: {CAUSE}"),
        ),
        (
            Box::new(OpenError::StaticPeers(EntryError::MtsName(
                NameError::Empty,
            ))),
            format!(
                "cannot use discovery.static: the name of the message transport service is not \
                 valid: {name}"
            ),
        ),
        (
            Box::new(RegisterError::Invalid(EntryError::Name(NameError::Empty))),
            format!("cannot register: {name}"),
        ),
        (
            Box::new(DeregisterError::Failed(Arc::new(directory()))),
            format!("cannot deregister from the directory: cannot open /dir: {CAUSE}"),
        ),
        (
            Box::new(CoalitionError::Members(MembersError::Name(
                NameError::Empty,
            ))),
            format!("the name of a member is not valid: {name}"),
        ),
        (
            Box::new(AskError::Send(SendError::Post(PostError::Encode(
                encode.clone(),
            )))),
            format!("cannot send the request to the gateway: cannot encode the letter: {encode}"),
        ),
        (
            Box::new(OpenError::Thread(cause())),
            format!("cannot start the background thread: {CAUSE}"),
        ),
    ];
    #[cfg(feature = "secure")]
    all.extend([
        (
            Box::new(OpenError::Keys(fipa::admin::keys::KeysError::Io {
                path: path(),
                source: cause(),
            })) as Box<dyn Error>,
            format!("cannot use security.keys: cannot use /dir: {CAUSE}"),
        ),
        (
            Box::new(fipa::admin::keys::KeysError::Make(Box::new(cause()))),
            format!("cannot make a key: {CAUSE}"),
        ),
    ]);
    #[cfg(feature = "protocols")]
    all.extend([
        (
            Box::new(fipa::error::ProtocolError::Read {
                path: path(),
                source: cause(),
            }) as Box<dyn Error>,
            format!("monitor.protocols: cannot read /dir: {CAUSE}"),
        ),
        (
            Box::new(fipa::error::ProtocolError::Full(fipa::monitor::LibraryFull)),
            format!(
                "monitor.protocols: too many protocols: {}",
                fipa::monitor::LibraryFull
            ),
        ),
    ]);
    all
}

#[test]
fn an_error_and_its_sources_say_each_cause_once() {
    for (error, text) in errors() {
        assert_eq!(ErrorChain(&*error).to_string(), text);
        let mut next: &dyn Error = &*error;
        while let Some(source) = next.source() {
            let (message, cause) = (next.to_string(), source.to_string());
            assert!(
                !message.contains(&cause),
                "{message:?} prints its source {cause:?}"
            );
            next = source;
        }
    }
}

#[test]
fn every_error_of_the_crate_converts_into_the_top_error() {
    let module = include_str!("../src/error.rs");
    let exported = regex::Regex::new(r"(?m)^pub (use [^;]*;|enum \w+)").unwrap();
    let exported = exported.find_iter(module).map(|found| found.as_str());
    let error = regex::Regex::new(r"\b[A-Z][A-Za-z]*Error\b").unwrap();
    let names_of = |text: &'static str| {
        let found = error.find_iter(text).map(|found| found.as_str());
        found.collect::<std::collections::BTreeSet<_>>()
    };
    let top = include_str!("../src/any_error.rs");
    let names: std::collections::BTreeSet<_> = exported.flat_map(names_of).collect();
    assert!(names.len() > 15, "{names:?}");
    let modules = [
        include_str!("../src/actions/mod.rs"),
        include_str!("../src/admin/contact.rs"),
        include_str!("../src/locks/mod.rs"),
    ];
    let public = modules.map(|module| {
        let lines = module.lines().filter(|line| line.starts_with("pub "));
        lines.flat_map(&names_of).collect::<Vec<_>>()
    });
    for name in names.into_iter().chain(public.concat()) {
        assert!(top.contains(&format!("(#[from] {name}),")), "{name}");
    }
}

#[test]
fn the_top_error_has_the_text_of_the_error_and_its_causes() {
    let error = OpenError::Watch(cause());
    let text = ErrorChain(&error).to_string();
    let top = fipa::Error::from(error);
    assert_eq!(ErrorChain(&top).to_string(), text);
    // The form in which the result of `main` is printed.
    assert_eq!(format!("{top:?}"), text);
}
