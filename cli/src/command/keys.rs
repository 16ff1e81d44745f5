//! `fipa keys`: the keys of this host and the certificates that it trusts.

use std::io::{self, BufRead as _, IsTerminal, Read as _};
use std::path::{self, Path, PathBuf};
use std::slice;
use std::time::{Duration, SystemTime};

use clap::builder::NonEmptyStringValueParser;
use clap::{Args, Subcommand};
use fipa::admin::keys::{Certificate, Holding, Keys, KeysError, VALID, Whose};
use fipa::admin::pairing::{self, Code, CodeError, Listener, OPEN, Paired, PairingError};
use fipa::error::ErrorChain;
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{input, output};

/// Manage this host's keys and its trusted hosts
///
/// Hosts with keys communicate only over TLS 1.3. Each host proves its identity by its certificate,
/// and the owner of the other host has to trust that certificate first. There is no certificate
/// authority.
///
/// A running gateway applies changes within two seconds.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa keys init                           once on each host
  fipa keys pair                           on one host; prints the command for the other host, and a code
  fipa up --set security.keys=$HOME/.config/fipa/keys --set 'transport.tcp.listen=*:7788'")]
pub(crate) struct Arguments {
    /// Directory of the keys [default: security.keys, else ~/.config/fipa/keys]
    #[arg(long, value_name = "DIRECTORY", global = true)]
    dir: Option<PathBuf>,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Create a key and a certificate for this host
    ///
    /// The certificate names the gateway mts.name. Give the file own.pem to the owners of other hosts;
    /// keep own.key secret.
    #[command(after_help = "\
Examples:
  fipa keys init
  fipa keys init --agent rover --agent 'arm_*'     limits the certificate to these agents
  fipa keys init --valid 90days --set mts.name=rover-mts")]
    Init {
        /// Agent for which this host may send; a final * stands for any ending; repeatable [default:
        /// every agent]
        #[arg(long = "agent", value_name = "NAME", value_parser = NonEmptyStringValueParser::new())]
        agents: Vec<String>,
        /// Validity of the certificate, for example 90days [default: ten years]
        #[arg(long, value_name = "DURATION", value_parser = options::duration)]
        valid: Option<Duration>,
    },

    /// Make this host and another one trust each other, by a code
    ///
    /// On one host, the command without HOST:PORT opens a port for five minutes. It prints the command for the other
    /// host, and a code that the other command asks for. Only a person who sees this code can pair a host. A wrong
    /// code ends the pairing on both hosts; the next one has a new code.
    ///
    /// Elsewhere than on a terminal, the code is read from standard input.
    #[command(after_help = "\
Examples:
  fipa keys pair                           on the first host
  fipa keys pair 192.168.1.7:43521         on the second host; the first one prints this line
  fipa keys pair --port 7789               on a port that the firewall lets through
  ssh -t crex fipa keys pair 192.168.1.7:43521     the same from the first host, in another terminal")]
    Pair {
        /// Address and port that the other host prints
        #[arg(value_name = "HOST:PORT", conflicts_with = "port", value_parser = NonEmptyStringValueParser::new())]
        address: Option<String>,
        /// Port to open [default: one that the system chooses]
        #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(1..))]
        port: Option<u16>,
    },

    /// Trust the certificates in a file
    ///
    /// Compare the printed fingerprint with the output of `fipa keys list` on the other host.
    #[command(after_help = "\
Examples:
  fipa keys trust crex.pem
  ssh crex cat .config/fipa/keys/own.pem | fipa keys trust -")]
    Trust {
        /// File own.pem of another host; - for standard input
        file: PathBuf,
    },

    /// List this host's certificate, its next certificate, and the trusted and revoked certificates
    #[command(after_help = "\
Examples:
  fipa keys list
  fipa keys list --json | jq -r '.trusted[].mts'

JSON:
  { \"dir\": path, \"own\" and \"next\": certificate or null, \"trusted\" and \"revoked\": [ certificate ] }
  certificate = { \"mts\": text, \"agents\": [ text ], \"fingerprint\": text,
                  \"from\": seconds, \"until\": seconds }   since 1970-01-01 00:00 UTC")]
    List {
        /// Print JSON instead of a table
        #[arg(long)]
        json: bool,
    },

    /// End the trust in a host
    ///
    /// Open connections to the host are closed. `fipa keys trust` with the same file trusts the host again.
    #[command(after_help = "\
Examples:
  fipa keys distrust crex-mts
  fipa keys distrust 5d41402abc4b")]
    Distrust {
        /// Name of its gateway, or the first 8 or more digits of the fingerprint
        #[arg(value_name = "NAME|FINGERPRINT")]
        which: String,
    },

    /// Revoke the certificate of a host permanently
    ///
    /// For a private key that may be in other hands. Open connections to the host are closed, and its
    /// certificate is never trusted again. On a terminal the command asks first; elsewhere it needs --yes.
    #[command(after_help = "\
Examples:
  fipa keys revoke crex-mts
  fipa keys revoke 5d41402abc4b --yes")]
    Revoke {
        /// Name of its gateway, or the first 8 or more digits of the fingerprint
        #[arg(value_name = "NAME|FINGERPRINT")]
        which: String,
        /// Revoke without asking
        #[arg(long, short)]
        yes: bool,
    },

    /// Create the next key and certificate, or switch to them
    ///
    /// Switch only after the owners of the other hosts have trusted the next certificate.
    #[command(after_help = "\
Examples:
  fipa keys renew              creates next.pem; give it to the owners of other hosts
  fipa keys renew --use        switches to the next key and certificate")]
    Renew {
        /// Switch to the key and certificate created before
        #[arg(long = "use", conflicts_with = "valid")]
        switch: bool,
        /// Validity of the certificate, for example 90days [default: ten years]
        #[arg(long, value_name = "DURATION", value_parser = options::duration)]
        valid: Option<Duration>,
    },
}

/// Number of digits that identify a certificate in a warning.
const SHOWN_DIGITS: usize = 16;

/// Maximum number of addresses of this host that are shown.
const SHOWN_ADDRESSES: usize = 4;

/// Maximum length of the line with a code, in bytes.
const MAX_LINE: u64 = 256;

/// Maximum size of a file with certificates, in bytes.
const MAX_PEM: u64 = 1 << 20;

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let keys = match arguments.dir {
        Some(dir) => Keys::at(dir),
        None if !config.security.keys.is_empty() => Keys::at(&config.security.keys),
        None => Keys::at(default_directory()?),
    };
    match arguments.action {
        Action::Init { agents, valid } => {
            let certificate = keys.init(&config.mts.name, &agents, valid.unwrap_or(VALID));
            let certificate = certificate.map_err(|error| failed(&error, &keys))?;
            output::text(&format!(
                "created a key and a certificate for {}\n{}\
                 to pair it with another host, run `{}`, or give {} to the owner of that host\n{}",
                escape(certificate.certified().mts()),
                described(&certificate),
                pairing_command(),
                keys.own_file().display(),
                to_configure(&keys, &config.security.keys),
            ))
        }
        Action::Pair { address, port } => match address {
            Some(address) => pair_with(&address, &keys),
            None => wait_for_pair(port.unwrap_or(0), &keys),
        },
        Action::Trust { file } => {
            let pem = input::read(&file, MAX_PEM)?;
            let trusted = keys.trust(&pem).map_err(|error| match error {
                KeysError::NoCertificate
                | KeysError::PrivateKey
                | KeysError::Own
                | KeysError::Certificate(_) => Failure::failed(
                    ErrorChain(&error).to_string(),
                    file.display().to_string(),
                    "give the file own.pem of the other host",
                ),
                other => failed(&other, &keys),
            })?;
            show_trusted(&trusted, &keys)
        }
        Action::List { json } => list(&keys, json).map_err(|error| failed(&error, &keys))?,
        Action::Distrust { which } => {
            let distrusted = keys.distrust(&which);
            let distrusted = distrusted.map_err(|error| failed(&error, &keys))?;
            output::text(&all_described("no longer trusted:", &distrusted))
        }
        Action::Revoke { which, yes } => {
            let meant = keys.trusted_as(&which);
            let meant = meant.map_err(|error| failed(&error, &keys))?;
            if !yes && !confirmed(&meant)? {
                return output::text("nothing was revoked\n");
            }
            let revoked = keys.revoke(&which);
            let revoked = revoked.map_err(|error| failed(&error, &keys))?;
            output::text(&all_described("revoked", &revoked))
        }
        Action::Renew { switch, valid } => {
            let renewed = match switch {
                true => keys.switch(),
                false => keys.renew(valid.unwrap_or(VALID)),
            };
            let renewed = renewed.map_err(|error| failed(&error, &keys))?;
            let done = match switch {
                true => "switched to the next certificate".to_owned(),
                false => format!(
                    "created the next certificate, {}: give it to the owners of other hosts, then run \
                     `fipa keys renew --use`",
                    keys.next_file().display()
                ),
            };
            output::text(&format!("{done}\n{}", described(&renewed)))
        }
    }
}

/// The lines for the configuration, unless it names the directory.
fn to_configure(keys: &Keys, configured: &str) -> String {
    if keys.dir() == Path::new(configured) {
        return String::new();
    }
    // Absolute, so that it is valid in any working directory of the gateway.
    let dir = path::absolute(keys.dir());
    let dir = dir.as_deref().unwrap_or(keys.dir()).display().to_string();
    format!("add to the configuration:\n\n[security]\nkeys = {dir:?}\n")
}

/// Shows the certificates that were just trusted, with what is unusual about them.
fn show_trusted(trusted: &[Certificate], keys: &Keys) -> Result<(), Failure> {
    let mut text = String::new();
    for certificate in trusted {
        text.push_str(&format!(
            "trusted {}\n",
            escape(certificate.certified().mts())
        ));
        text.push_str(&described(certificate));
        text.push_str(&validity_note(certificate, Whose::Peer));
    }
    let all = keys.trusted().map_err(|error| failed(&error, keys))?;
    for certificate in trusted {
        text.push_str(&also_trusted(certificate, &all));
    }
    output::text(&text)?;
    // This host may have no keys yet.
    if let Ok(own) = keys.own() {
        trusted
            .iter()
            .for_each(|certificate| warn_of_own_name(certificate, &own));
    }
    Ok(())
}

/// Shows a code, and waits for the host on which it is typed.
fn wait_for_pair(port: u16, keys: &Keys) -> Result<(), Failure> {
    let place = "this pairing";
    let failed = |error| not_paired(&error, place, keys);
    let paired = options::block_on(async {
        let listener = Listener::open(keys, port).map_err(failed)?;
        output::text(&invitation(&listener))?;
        listener.pair().await.map_err(failed)
    })??;
    finish_pair(&paired, keys)
}

/// The command that pairs this host or, on the other host, follows this one.
fn pairing_command() -> &'static str {
    match std::env::var_os("SUDO_USER") {
        Some(_) => "sudo fipa keys pair",
        None => "fipa keys pair",
    }
}

/// Tells what to type on the other host.
fn invitation(listener: &Listener) -> String {
    let command = pairing_command();
    let commands: Vec<_> = match listener.addresses() {
        Ok(addresses) => addresses
            .iter()
            .take(SHOWN_ADDRESSES)
            .map(|address| format!("  {command} {address}\n"))
            .collect(),
        Err(error) => {
            report::warn(&ErrorChain(&error).to_string());
            vec![format!("  {command} HOST:{}\n", listener.port())]
        }
    };
    format!(
        "on the other host, run{}\n{}and type this code there: {}\nwaiting {}, for one attempt\n",
        match commands.len() {
            1 => "",
            _ => " the first of these that connects",
        },
        commands.concat(),
        listener.code(),
        humantime::format_duration(OPEN),
    )
}

/// Asks for the code of the host at this address, and pairs with it.
fn pair_with(place: &str, keys: &Keys) -> Result<(), Failure> {
    // A code that is typed is good for one attempt: what is missing here must not cost it.
    keys.own().map_err(|error| failed(&error, keys))?;
    if io::stdin().is_terminal() {
        output::text("code that the other host shows: ")?;
    }
    let code = read_code().map_err(|problem| {
        Failure::wrong_usage(
            problem,
            "standard input",
            "type the code that `fipa keys pair` shows on the other host",
        )
    })?;
    let paired = options::block_on(pairing::dial(keys, place, &code))?;
    let paired = paired.map_err(|error| not_paired(&error, place, keys))?;
    finish_pair(&paired, keys)
}

/// Reads a line with a code.
fn read_code() -> Result<Code, String> {
    let mut line = String::new();
    let read = io::stdin().lock().take(MAX_LINE).read_line(&mut line);
    read.map_err(|error| error.to_string())?;
    line.parse().map_err(|error: CodeError| error.to_string())
}

fn finish_pair(paired: &Paired, keys: &Keys) -> Result<(), Failure> {
    show_trusted(slice::from_ref(&paired.certificate), keys)?;
    if paired.mutual {
        return output::text(
            "both hosts trust each other; running gateways apply it within two seconds\n",
        );
    }
    Err(Failure::failed(
        "the other host did not say that it trusts this one",
        keys.dir().display().to_string(),
        format!(
            "see what it prints; `fipa keys distrust {}` ends the trust of this host, too",
            start(&paired.certificate)
        ),
    ))
}

fn not_paired(error: &PairingError, place: &str, keys: &Keys) -> Failure {
    let help = match error {
        PairingError::Keys(error) => return failed(error, keys),
        PairingError::Listen { .. } => "choose another port with --port, or none",
        PairingError::Address { .. } => {
            "give the address and the port that `fipa keys pair` prints on the other host"
        }
        PairingError::Connect { .. } => {
            "check that `fipa keys pair` still waits on the other host, at this address; if a firewall is in the way, \
             choose a port that it lets through (`fipa keys pair --port` there)"
        }
        PairingError::NotPairing => {
            "check the address, and run the same version of fipa on both hosts"
        }
        PairingError::WrongCode => {
            "no host was trusted; start again with `fipa keys pair` on the first host, for a new code. If the code was \
             typed correctly, another host on the network tried to guess it"
        }
        _ => "start again with `fipa keys pair` on the first host, for a new code",
    };
    Failure::failed(ErrorChain(error).to_string(), escape(place), help)
}

/// The beginning of a fingerprint, which identifies a certificate on the command line.
fn start(certificate: &Certificate) -> String {
    let fingerprint = certificate.fingerprint().to_string();
    fingerprint.chars().take(SHOWN_DIGITS).collect()
}

/// Warns if the gateway of a certificate that was just trusted has the name of this host's gateway.
fn warn_of_own_name(certificate: &Certificate, own: &Certificate) {
    let name = certificate.certified().mts();
    if own.certified().mts() == name {
        report::warn(&format!(
            "the gateway of this host is named {name:?}, too: `fipa agents` and logs cannot tell the two \
             hosts apart. Give one of them another name: set mts.name there, make new keys in an empty \
             directory (`fipa keys init --dir DIRECTORY`), and trust the new certificate; `fipa keys \
             distrust {}` undoes this one",
            start(certificate)
        ));
    }
}

/// Describes the other trusted certificates with the gateway's name of one that was just trusted.
fn also_trusted(certificate: &Certificate, trusted: &[Certificate]) -> String {
    let name = certificate.certified().mts();
    let same = |other: &&Certificate| {
        other.certified().mts() == name && other.fingerprint() != certificate.fingerprint()
    };
    let others = trusted.iter().filter(same).map(|other| {
        let (name, start) = (escape(name), start(other));
        format!(
            "note: another certificate of {name} is trusted, too ({start}…); a host with either of them is \
             accepted as {name}.\n  After a renewal of the keys of that host, end the trust in the earlier \
             one: `fipa keys distrust {start}`.\n  If they are two hosts, give one of them another \
             mts.name and new keys.\n"
        )
    });
    others.collect()
}

/// Asks for the confirmation that these certificates are to be revoked.
fn confirmed(certificates: &[Certificate]) -> Result<bool, Failure> {
    if !io::stdin().is_terminal() {
        return Err(Failure::wrong_usage(
            "a revoked certificate is never trusted again, and standard input is no terminal to ask",
            "the command line",
            "add --yes, or end the trust until further notice with `fipa keys distrust`",
        ));
    }
    output::text(&format!(
        "{}These certificates will never be trusted again (`fipa keys distrust` can be undone).\n\
         Revoke them? Type yes: ",
        all_described("revoking", certificates)
    ))?;
    let mut answer = String::new();
    // Without an answer nothing is revoked.
    let _ = io::stdin().read_line(&mut answer);
    Ok(answer.trim() == "yes")
}

fn all_described(done: &str, certificates: &[Certificate]) -> String {
    let one = |certificate: &Certificate| {
        format!(
            "{done} {}\n{}",
            escape(certificate.certified().mts()),
            described(certificate)
        )
    };
    certificates.iter().map(one).collect()
}

/// Returns the directory of the keys if neither `--dir` nor `security.keys` names one.
fn default_directory() -> Result<PathBuf, Failure> {
    let home = std::env::var_os("HOME").filter(|home| !home.is_empty());
    let home = home.ok_or_else(|| {
        Failure::wrong_usage(
            "cannot determine the directory of the keys: $HOME is not set",
            "the environment",
            "give the directory with --dir, or set security.keys",
        )
    })?;
    Ok(PathBuf::from(home).join(".config/fipa/keys"))
}

fn failed(error: &KeysError, keys: &Keys) -> Failure {
    let help = match error {
        KeysError::Exists(file) if is_next(file) => {
            "give next.pem to the owners of other hosts, then run `fipa keys renew --use`"
        }
        KeysError::Exists(_) => "to replace this host's keys, run `fipa keys renew`",
        KeysError::Validity(_) => "give a validity above 0 that ends by the year 9999",
        KeysError::Certificate(_) => "change the names (mts.name, --agent)",
        KeysError::Contents { .. } => "replace the file with a valid one, or remove it",
        KeysError::Which { .. } => {
            "give the name of a gateway, or more digits of a fingerprint; see `fipa keys list`"
        }
        KeysError::Revoked(_) => {
            "get a new certificate from its owner (`fipa keys renew` on the other host)"
        }
        KeysError::Missing(_) | KeysError::NoNext(_) => {
            "`fipa keys init` creates keys, `fipa keys renew` creates the next ones"
        }
        KeysError::Io { source, .. } if source.kind() == io::ErrorKind::PermissionDenied => {
            "run the command with `sudo`, or as the user of this directory"
        }
        _ => "check whether this user can read and write in this directory",
    };
    Failure::failed(
        ErrorChain(error).to_string(),
        keys.dir().display().to_string(),
        help,
    )
}

/// Whether `fipa keys renew` creates this file.
fn is_next(file: &Path) -> bool {
    file.file_stem().is_some_and(|stem| stem == "next")
}

fn described(certificate: &Certificate) -> String {
    format!(
        "  fingerprint: {}\n  agents: {}\n  valid until: {}\n",
        certificate.fingerprint(),
        agents(certificate),
        valid_until(certificate)
    )
}

/// The last day of validity, with a note if the certificate is not valid now or expires soon.
fn valid_until(certificate: &Certificate) -> String {
    let date = date(certificate.validity().1);
    match Holding::at(SystemTime::now(), certificate).problem() {
        Some(note) => format!("{date} ({note})"),
        None => date,
    }
}

/// Returns the advice about a certificate that is not valid now; empty for others.
fn validity_note(certificate: &Certificate, whose: Whose) -> String {
    let now = SystemTime::now();
    let holding = Holding::at(now, certificate);
    match (holding, holding.problem(), holding.advice(now, whose)) {
        (Holding::Ended | Holding::NotYet, Some(problem), Some(advice)) => format!(
            "note: the certificate of {} {problem}; {advice}\n",
            escape(certificate.certified().mts())
        ),
        _ => String::new(),
    }
}

/// The agents for which the host of the certificate may send.
fn agents(certificate: &Certificate) -> String {
    match certificate.certified().agents() {
        [] => "all".to_owned(),
        agents => {
            let escaped: Vec<_> = agents.iter().map(|agent| escape(agent)).collect();
            escaped.join(", ")
        }
    }
}

/// The date in UTC of a time in seconds since 1970.
fn date(seconds: i64) -> String {
    let since = Duration::from_secs(u64::try_from(seconds).unwrap_or(0));
    let time = humantime::format_rfc3339_seconds(std::time::UNIX_EPOCH + since).to_string();
    time.chars().take_while(|c| *c != 'T').collect()
}

fn list(keys: &Keys, json: bool) -> Result<Result<(), Failure>, KeysError> {
    let own = match keys.own() {
        Ok(own) => Some(own),
        Err(KeysError::Missing(_)) => None,
        Err(error) => return Err(error),
    };
    let (next, trusted, revoked) = (keys.next()?, keys.trusted()?, keys.revoked()?);
    if json {
        let all =
            |certificates: &[Certificate]| certificates.iter().map(to_json).collect::<Vec<_>>();
        return Ok(output::json(&json!({
            "dir": keys.dir().display().to_string(),
            "own": own.as_ref().map(to_json),
            "next": next.as_ref().map(to_json),
            "trusted": all(&trusted),
            "revoked": all(&revoked),
        })));
    }
    let dir = keys.dir().display();
    let missing = match own {
        Some(_) => String::new(),
        None => format!("{dir} has no keys; create them with `fipa keys init`\n"),
    };
    let all = [
        ("own", own.as_slice()),
        ("next", next.as_slice()),
        ("trusted", &trusted),
        ("revoked", &revoked),
    ];
    if all.iter().all(|(_, certificates)| certificates.is_empty()) {
        return Ok(output::text(&missing));
    }
    let mut table = output::table(["LIST", "GATEWAY", "AGENTS", "VALID UNTIL", "FINGERPRINT"]);
    for (list, certificates) in all {
        for certificate in certificates {
            table.add_row([
                list.to_owned(),
                escape(certificate.certified().mts()).into_owned(),
                agents(certificate),
                valid_until(certificate),
                certificate.fingerprint().to_string(),
            ]);
        }
    }
    let notes_of = |whose| move |certificate| validity_note(certificate, whose);
    let notes: String = own
        .iter()
        .chain(&next)
        .map(notes_of(Whose::Own))
        .chain(trusted.iter().map(notes_of(Whose::Peer)))
        .collect();
    Ok(output::text(&format!(
        "{dir}\n{}\n{missing}{notes}",
        table.trim_fmt()
    )))
}

fn to_json(certificate: &Certificate) -> Value {
    let (from, until) = certificate.validity();
    json!({
        "mts": certificate.certified().mts(),
        "agents": certificate.certified().agents(),
        "fingerprint": certificate.fingerprint().to_string(),
        "from": from,
        "until": until,
    })
}
