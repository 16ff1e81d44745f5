//! Endpoints over Unix domain sockets.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::fs;
use std::io::Read as _;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, PermissionsExt as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{Party, Recorder, accepted, parcel, unix_config};
use fipa_testbed::until_some;
use fipa_transport::{
    Conclusion, Incarnation, Kind, ListenError, Location, Transport, TransportErrorKind,
};
use fipa_transport_net::UnixTransport;
use tokio::net::unix::pipe;

type Unix = Party<UnixTransport>;

fn party(directory: &Path) -> Unix {
    let config = unix_config(directory);
    Party::over(Recorder::default(), |runtime| {
        UnixTransport::new(config, runtime)
    })
}

fn sockets(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().path()).collect()
}

/// A directory whose path is longer than a socket address can be.
fn long(home: &Path) -> PathBuf {
    let path = home.join("d".repeat(200)).join("e".repeat(200));
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    path
}

#[test]
fn letters_go_both_ways_in_a_directory_with_a_long_path() {
    let home = tempfile::tempdir().unwrap();
    let directory = long(home.path());
    let (a, b) = (party(&directory), party(&directory));
    a.assert_reaches(1, &b);
    b.assert_reaches(1, &a);
    // Over the same connection, whichever side opened it.
    assert_eq!(a.transport.counters().dialed, 1);
    assert_eq!(b.transport.counters().dialed, 0);
    let (_, from, _) = b.sink.record.lock().arrivals.remove(0);
    assert_eq!(&from.location, a.location());
    assert!(!from.is_remote());
}

#[test]
fn nothing_but_the_socket_of_its_owner_is_in_a_private_directory() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let a = party(&directory);
    assert_eq!(fs::metadata(&directory).unwrap().mode() & 0o777, 0o700);
    let [socket] = &sockets(&directory)[..] else {
        panic!("one socket")
    };
    let found = fs::symlink_metadata(socket).unwrap();
    assert!(found.file_type().is_socket());
    assert_eq!(found.mode() & 0o777, 0o600);
    assert_eq!(
        socket.file_name().unwrap().to_str(),
        Some(a.location().address())
    );
    a.transport.close();
    assert!(sockets(&directory).is_empty());
}

#[test]
fn a_directory_that_others_may_enter_is_not_used() {
    let home = tempfile::tempdir().unwrap();
    fs::set_permissions(home.path(), fs::Permissions::from_mode(0o711)).unwrap();
    let runtime = common::runtime();
    let transport = UnixTransport::new(unix_config(home.path()), runtime.handle().clone());
    let error = transport.listen(std::sync::Arc::new(Recorder::default()));
    let Err(ListenError::Unavailable(text)) = error else {
        panic!("{error:?}")
    };
    assert!(text.contains("its mode is 711"), "{text}");
}

/// Set for the process that the test starts as another user: the socket to connect to.
const CONNECT: &str = "FIPA_TEST_CONNECT";

/// Not a test of its own: connects, and waits until the other side closes the connection.
#[test]
fn as_another_user() {
    let Some(path) = std::env::var_os(CONNECT) else {
        return;
    };
    let mut stream = UnixStream::connect(path).unwrap();
    let mut rest = Vec::new();
    stream.read_to_end(&mut rest).unwrap();
    assert!(rest.is_empty());
}

#[test]
fn a_process_of_another_user_is_refused() {
    let is_root = fs::metadata("/proc/self").unwrap().uid() == 0;
    if !is_root {
        eprintln!("needs root, to be another user");
        return;
    }
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let a = party(&directory);
    let socket = directory.join(a.location().address());
    // As if an administrator had made the private directory accessible.
    for (path, mode) in [(home.path(), 0o711), (&directory, 0o711), (&socket, 0o666)] {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    }
    // A place where other users can execute it.
    let program = home.path().join("program");
    fs::copy(std::env::current_exe().unwrap(), &program).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    let mut other = Command::new(program);
    let other = other.args(["--exact", "as_another_user"]);
    let other = other.env(CONNECT, &socket).current_dir("/");
    let ended = other.uid(65534).gid(65534).stdout(Stdio::null()).status();
    assert!(
        ended.unwrap().success(),
        "the connection of the other user stays open"
    );
    assert_eq!(a.transport.counters().refused_unproved, 1);
    assert_eq!(a.transport.counters().accepted, 0);
}

#[test]
fn sockets_of_dead_processes_are_removed_and_those_of_others_are_not() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let a = party(&directory);
    // Dropping the standard library's listener leaves the file, as the end of a process does.
    let dead = directory.join("00000000000000aa");
    drop(UnixListener::bind(&dead).unwrap());
    fs::write(directory.join("notes"), "not a socket of fipa").unwrap();
    a.transport.tidy();
    until_some("the dead socket to go", || (!dead.exists()).then_some(()));
    assert!(directory.join("notes").exists());
    drop(UnixListener::bind(&dead).unwrap());
    // A starting process does the same.
    let b = party(&directory);
    assert!(!dead.exists());
    a.assert_reaches(1, &b);
    b.assert_reaches(1, &a);
}

#[test]
fn a_removed_socket_is_created_again_and_connections_stay() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let (a, b) = (party(&directory), party(&directory));
    a.assert_reaches(1, &b);
    fs::remove_dir_all(&directory).unwrap();
    assert!(!b.transport.is_there());
    a.assert_reaches(2, &b);
    assert!(b.transport.rejoin().unwrap());
    assert!(b.transport.is_there());
    assert!(!b.transport.rejoin().unwrap());
    assert!(a.transport.rejoin().unwrap());
    a.assert_reaches(3, &b);
    let c = party(&directory);
    c.assert_reaches(1, &b);
    a.assert_reaches(4, &c);
    assert_eq!(a.transport.counters().dialed, 2);
    a.transport.close();
    assert!(!a.transport.rejoin().unwrap(), "it is closed");
}

#[test]
fn no_path_is_an_address() {
    let home = tempfile::tempdir().unwrap();
    let a = party(&home.path().join("unix"));
    let b = party(&home.path().join("other"));
    let there = format!("../other/{}", b.location().address());
    let unknown = Incarnation::UNKNOWN;
    for (attempt, address) in [&*there, ".", "x"].into_iter().enumerate() {
        let attempt = attempt as u64;
        let to = Location::new(Kind::Unix, address).unwrap();
        a.send(attempt, &to.with_incarnation(unknown), parcel(1, "x"))
            .unwrap();
        let concluded = a.conclusion(attempt);
        let Conclusion::NotSent(error) = concluded else {
            panic!("{concluded:?}")
        };
        assert_eq!(error.fault, TransportErrorKind::Unreachable);
    }
    assert_eq!(b.arrivals(), 0);
}

#[test]
fn the_end_of_the_other_side_is_reported_without_an_invented_answer() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let a = party(&directory);
    let b = party(&directory);
    a.assert_reaches(1, &b);
    let gone = b.location().clone();
    drop(b);
    until_some("the connection to end", || {
        (a.transport.counters().connections == 0).then_some(())
    });
    a.send(2, &gone, parcel(2, "x")).unwrap();
    assert!(matches!(a.conclusion(2), Conclusion::NotSent(_)));
    let c = party(&directory);
    a.send(3, c.location(), parcel(3, "x")).unwrap();
    assert_eq!(a.conclusion(3), accepted());
}

/// Asserts that the error of an attempt is about the end of the process, and that a letter to another process is
/// delivered afterwards.
fn assert_process_ended(directory: &Path, to: &str) {
    let from = party(directory);
    let to = Location::new(Kind::Unix, to).unwrap();
    from.send(1, &to, parcel(1, "x")).unwrap();
    let Conclusion::NotSent(error) = from.conclusion(1) else {
        panic!("{:?}", from.conclusion(1));
    };
    let text = "the process at this socket has ended or is ending";
    assert!(error.detail.contains(text), "{error}");
    assert!(!error.detail.contains("keys"), "{error}");
    from.assert_reaches(2, &party(directory));
}

/// A listening socket of a process that serves nothing.
fn listening(directory: &Path) -> (UnixListener, String) {
    // The directory is created by a transport, with the mode that it needs.
    drop(party(directory));
    let name = Incarnation::random().to_string();
    let listener = UnixListener::bind(directory.join(&name)).unwrap();
    (listener, name)
}

#[test]
fn a_process_that_ends_before_its_hello_is_reported_as_ending() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    for reads in [true, false] {
        let (listener, name) = listening(&directory);
        let ending = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.set_nonblocking(true).unwrap();
            let mut bytes = [0; 4096];
            if reads {
                stream.set_nonblocking(false).unwrap();
                // Nothing is unread, so the other side sees an end of stream instead of a reset.
                let _ = stream.read(&mut bytes).unwrap();
            }
        });
        assert_process_ended(&directory, &name);
        ending.join().unwrap();
    }
}

#[test]
fn a_process_that_ends_with_a_connection_in_its_backlog_is_reported_as_ending() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let (listener, name) = listening(&directory);
    let ending = std::thread::spawn(move || {
        // Until a connection waits to be accepted.
        common::runtime().block_on(async {
            // As a pipe, because tokio only accepts the connections of a listener.
            let listener = pipe::Receiver::from_owned_fd_unchecked(listener.into()).unwrap();
            listener.readable().await.unwrap();
        });
    });
    assert_process_ended(&directory, &name);
    ending.join().unwrap();
}

#[test]
fn the_socket_of_a_process_that_has_ended_is_reported_as_such() {
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let (listener, name) = listening(&directory);
    drop(listener);
    assert_process_ended(&directory, &name);
    let removed = Incarnation::random().to_string();
    assert_process_ended(&directory, &removed);
}
