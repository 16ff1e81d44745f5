//! `fipa keys`: who this host is, and which others it speaks with.

use std::path::{self, Path, PathBuf};
use std::time::Duration;

use clap::builder::NonEmptyStringValueParser;
use clap::{Args, Subcommand};
use comfy_table::{Table, presets};
use fipa::keys::{Certificate, Holding, Keys, KeysError, VALID};
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::options::{self, Global};
use crate::report::Failure;
use crate::{input, output};

/// Make this host's keys, and say which other hosts are trusted
///
/// Hosts that have keys speak TLS 1.3 with each other, and with nobody else: both prove who they are
/// by a certificate that the owner of the other one has been given, and trusts. There is no
/// authority in between.
///
/// A gateway that runs uses what has changed within a second or two.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples, on the host of rover-mts and on that of crex-mts alike:
  fipa keys init                           once; says where the certificate is
  fipa keys trust crex.pem                 the file own.pem of the other host
  fipa up --set security.keys=$HOME/.config/fipa/keys --set transport.tcp.listen=0.0.0.0:7788")]
pub(crate) struct Arguments {
    /// The directory of the keys [default: security.keys, else ~/.config/fipa/keys]
    #[arg(long, value_name = "DIRECTORY", global = true)]
    dir: Option<PathBuf>,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Make a key and a certificate for this host
    ///
    /// The certificate is of the gateway that mts.name names. Give the file own.pem to the owners of
    /// other hosts; keep own.key to yourself.
    #[command(after_help = "\
Examples:
  fipa keys init
  fipa keys init --agent rover --agent 'arm_*'     it speaks for these agents only
  fipa keys init --valid 90days --set mts.name=rover-mts")]
    Init {
        /// An agent that this host may speak for; one that ends with * stands for all that begin so
        /// [default: every agent]
        #[arg(long = "agent", value_name = "NAME", value_parser = NonEmptyStringValueParser::new())]
        agents: Vec<String>,
        /// How long the certificate holds [default: ten years]
        #[arg(long, value_name = "DURATION", value_parser = options::duration)]
        valid: Option<Duration>,
    },

    /// Trust the certificates in a file
    ///
    /// Compare the fingerprint with what `fipa keys list` shows on the other host.
    #[command(after_help = "\
Examples:
  fipa keys trust crex.pem
  ssh crex cat .config/fipa/keys/own.pem | fipa keys trust -")]
    Trust {
        /// The file own.pem of another host; - for standard input
        file: PathBuf,
    },

    /// Show this host's certificate, the next one, and those that are trusted or revoked
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

    /// Trust a host no more
    ///
    /// Its connections end, and its certificate is never trusted again.
    #[command(after_help = "\
Examples:
  fipa keys revoke crex-mts
  fipa keys revoke 5d41402abc4b")]
    Revoke {
        /// The name of its gateway, or the first 8 or more digits of a fingerprint
        which: String,
    },

    /// Make the next key and certificate, and change over to them when all peers trust them
    #[command(after_help = "\
Examples:
  fipa keys renew              makes next.pem, to be trusted by the owners of other hosts
  fipa keys renew --use        uses it from now on")]
    Renew {
        /// Use what was made before
        #[arg(long = "use", conflicts_with = "valid")]
        change_over: bool,
        /// How long the certificate holds [default: ten years]
        #[arg(long, value_name = "DURATION", value_parser = options::duration)]
        valid: Option<Duration>,
    },
}

/// Longest text with certificates, in bytes.
const MAX_PEM: u64 = 1 << 20;

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let keys = match arguments.dir {
        Some(dir) => Keys::at(dir),
        None if !config.security.keys.is_empty() => Keys::at(&config.security.keys),
        None => Keys::at(usual_place()?),
    };
    match arguments.action {
        Action::Init { agents, valid } => {
            let made = keys.init(&config.mts.name, &agents, valid.unwrap_or(VALID));
            let made = made.map_err(|error| failed(&error, &keys))?;
            output::text(&format!(
                "made a key and a certificate for {}\n{}\
                 give {} to the owners of other hosts, and use it:\n\n\
                 [security]\nkeys = {:?}\n",
                escape(made.certified().mts()),
                described(&made),
                keys.own_file().display(),
                // From wherever the gateway is started.
                path::absolute(keys.dir())
                    .as_deref()
                    .unwrap_or(keys.dir())
                    .display()
                    .to_string(),
            ))
        }
        Action::Trust { file } => {
            let pem = input::read(&file, MAX_PEM)?;
            let trusted = keys.trust(&pem).map_err(|error| match error {
                KeysError::NoCertificate
                | KeysError::PrivateKey
                | KeysError::Own
                | KeysError::Certificate(_) => Failure::failed(
                    error.to_string(),
                    file.display().to_string(),
                    "use the file own.pem of the other host",
                ),
                other => failed(&other, &keys),
            })?;
            let mut text = String::new();
            for certificate in &trusted {
                text.push_str(&format!(
                    "trusts {}\n",
                    escape(certificate.certified().mts())
                ));
                text.push_str(&described(certificate));
            }
            output::text(&text)
        }
        Action::List { json } => list(&keys, json).map_err(|error| failed(&error, &keys))?,
        Action::Revoke { which } => {
            let revoked = keys.revoke(&which);
            let revoked = revoked.map_err(|error| failed(&error, &keys))?;
            let mut text = String::new();
            for certificate in &revoked {
                text.push_str(&format!(
                    "trusts {} no more\n{}",
                    escape(certificate.certified().mts()),
                    described(certificate)
                ));
            }
            output::text(&text)
        }
        Action::Renew { change_over, valid } => {
            let renewed = match change_over {
                true => keys.switch(),
                false => keys.renew(valid.unwrap_or(VALID)),
            };
            let renewed = renewed.map_err(|error| failed(&error, &keys))?;
            let what = match change_over {
                true => "is used from now on".to_owned(),
                false => format!(
                    "is in {}: give it to the owners of other hosts, then `fipa keys renew --use`",
                    keys.next_file().display()
                ),
            };
            output::text(&format!("the certificate {what}\n{}", described(&renewed)))
        }
    }
}

/// Where keys are when nothing else is said.
fn usual_place() -> Result<PathBuf, Failure> {
    let home = std::env::var_os("HOME").filter(|home| !home.is_empty());
    let home = home.ok_or_else(|| {
        Failure::wrong_usage(
            "it is not known where the keys are",
            "$HOME is not set",
            "name their directory with --dir, or as security.keys",
        )
    })?;
    Ok(PathBuf::from(home).join(".config/fipa/keys"))
}

fn failed(error: &KeysError, keys: &Keys) -> Failure {
    let advice = match error {
        KeysError::Exists(file) if is_next(file) => {
            "give next.pem to the owners of other hosts, then `fipa keys renew --use`"
        }
        KeysError::Exists(_) => "`fipa keys renew` makes the next ones",
        KeysError::Validity(_) => "use more than 0, and nothing beyond the year 9999",
        KeysError::Certificate(_) => "use other names (mts.name, --agent)",
        KeysError::Contents { .. } => "put a right file in its place, or take it away",
        KeysError::Which { .. } => "give the name of a gateway, or more of a fingerprint",
        KeysError::Revoked(_) => "ask for another certificate (`fipa keys renew` there)",
        KeysError::Missing(_) | KeysError::NoNext(_) => {
            "`fipa keys init` makes keys, `fipa keys renew` the next ones"
        }
        _ => "see whether this user may read and write there",
    };
    Failure::failed(error.to_string(), keys.dir().display().to_string(), advice)
}

/// Whether the file is one that `fipa keys renew` makes.
fn is_next(file: &Path) -> bool {
    file.file_stem().is_some_and(|stem| stem == "next")
}

fn described(certificate: &Certificate) -> String {
    format!(
        "  fingerprint {}\n  speaks for {}\n  holds until {}\n",
        certificate.fingerprint(),
        spoken_for(certificate),
        ends(certificate)
    )
}

/// The day until which it holds, and what is to be said of that.
fn ends(certificate: &Certificate) -> String {
    let date = date(certificate.validity().1);
    match Holding::of(certificate).told() {
        Some(what) => format!("{date} ({what})"),
        None => date,
    }
}

/// The agents that its host may speak for.
fn spoken_for(certificate: &Certificate) -> String {
    match certificate.certified().agents() {
        [] => "every agent".to_owned(),
        agents => {
            let escaped: Vec<_> = agents.iter().map(|agent| escape(agent)).collect();
            escaped.join(", ")
        }
    }
}

/// A day in UTC.
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
        None => format!("there are no keys in {dir}; make them with `fipa keys init`\n"),
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
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["", "gateway", "speaks for", "until", "fingerprint"]);
    for (what, certificates) in all {
        for certificate in certificates {
            table.add_row([
                what.to_owned(),
                escape(certificate.certified().mts()).into_owned(),
                spoken_for(certificate),
                ends(certificate),
                certificate.fingerprint().to_string(),
            ]);
        }
    }
    Ok(output::text(&format!("{dir}\n{table}\n{missing}")))
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
