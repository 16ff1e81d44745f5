//! The decisions of a pairing, without I/O and clock: bytes of the other host go in, bytes for it come out.
//!
//! Each step returns the next one, so that no message can be taken in another order:
//!
//! | step | message | bytes |
//! |---|---|---|
//! | [`Greeting`] | hello | [`MAGIC`], the message of SPAKE2 ([`HELLO`] bytes) |
//! | [`Unconfirmed`] | confirmation | the tag of an empty body ([`TAG`] bytes) |
//! | [`Confirmed`] | certificate | length (u32, big-endian), DER, its tag |
//! | [`Confirmed`] | verdict | 1 if the sender trusts the certificate of the other host, else 0; its tag |
//!
//! A tag is the HMAC-SHA-256 of both hellos and the body. Its key is derived from the key of SPAKE2, the role of the
//! sender and the kind of the message. So no message counts as another one, in another pairing or from the other side.

use rand_core::{CryptoRng, RngCore};
use ring::hmac;
use spake2::{Ed25519Group, Identity, Password, Spake2};

use super::code::Code;
use super::error::PairingError;

/// The start of a hello: the protocol and its version.
const MAGIC: [u8; 16] = *b"fipa pairing 1\r\n";

/// Length of the message of SPAKE2, in bytes: its side and a point.
const POINT: usize = 33;

/// Length of a hello, in bytes.
pub(super) const HELLO: usize = MAGIC.len() + POINT;

/// Length of a tag, in bytes.
pub(super) const TAG: usize = 32;

/// The confirmation of a host that got a wrong one. No host computes it, except with a probability of 2^-256.
pub(super) const REFUSAL: [u8; TAG] = [0; TAG];

/// The side of a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    /// The host that made the code.
    Listening,
    /// The host on which the code is typed.
    Dialing,
}

impl Role {
    fn other(self) -> Self {
        match self {
            Self::Listening => Self::Dialing,
            Self::Dialing => Self::Listening,
        }
    }

    fn name(self) -> &'static [u8] {
        match self {
            Self::Listening => b"listening",
            Self::Dialing => b"dialing",
        }
    }
}

/// The kind of a message after the hello.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Confirmation,
    Certificate,
    Verdict,
}

impl Kind {
    fn name(self) -> &'static [u8] {
        match self {
            Self::Confirmation => b"confirmation",
            Self::Certificate => b"certificate",
            Self::Verdict => b"verdict",
        }
    }
}

/// A host that waits for the hello of the other one.
pub(super) struct Greeting {
    role: Role,
    spake: Spake2<Ed25519Group>,
    hello: [u8; HELLO],
}

impl Greeting {
    /// Starts a pairing with secret random numbers.
    pub(super) fn new(role: Role, code: &Code, random: impl CryptoRng + RngCore) -> Self {
        let password = Password::new(code.digits());
        let [dialing, listening] = [Role::Dialing, Role::Listening].map(Role::name);
        let ids = [dialing, listening].map(Identity::new);
        let [dialing, listening] = &ids;
        let (spake, point) = match role {
            Role::Dialing => Spake2::start_a_with_rng(&password, dialing, listening, random),
            Role::Listening => Spake2::start_b_with_rng(&password, dialing, listening, random),
        };
        let mut hello = [0; HELLO];
        let bytes = MAGIC.iter().chain(&point);
        hello
            .iter_mut()
            .zip(bytes)
            .for_each(|(to, from)| *to = *from);
        Self { role, spake, hello }
    }

    /// The hello of this host.
    pub(super) fn hello(&self) -> &[u8; HELLO] {
        &self.hello
    }

    /// Takes the hello of the other host.
    ///
    /// # Errors
    /// If it is not the hello of the other side in this version.
    pub(super) fn greeted(self, theirs: &[u8; HELLO]) -> Result<Unconfirmed, PairingError> {
        let point = theirs.strip_prefix(&MAGIC);
        let point = point.ok_or(PairingError::NotPairing)?;
        let shared = self.spake.finish(point);
        let shared = shared.map_err(|_| PairingError::NotPairing)?;
        let [first, second] = match self.role {
            Role::Dialing => [&self.hello, theirs],
            Role::Listening => [theirs, &self.hello],
        };
        Ok(Unconfirmed(Tags {
            role: self.role,
            shared: hmac::Key::new(hmac::HMAC_SHA256, &shared),
            hellos: [*first, *second].concat(),
        }))
    }
}

/// A host that has a key, and does not know whether the other host has the same one.
pub(super) struct Unconfirmed(Tags);

impl Unconfirmed {
    /// The confirmation of this host. It lets the other host test one code. So the listening host sends it only after
    /// it has got the right confirmation.
    pub(super) fn confirmation(&self) -> Vec<u8> {
        self.0.tagged(Kind::Confirmation, &[])
    }

    /// Takes the confirmation of the other host.
    ///
    /// # Errors
    /// If the other host has another code.
    pub(super) fn confirmed(self, theirs: &[u8; TAG]) -> Result<Confirmed, PairingError> {
        match self.0.verify(Kind::Confirmation, &[], theirs) {
            true => Ok(Confirmed(self.0)),
            false => Err(PairingError::WrongCode),
        }
    }
}

/// A host that knows that the other host has the same code.
pub(super) struct Confirmed(Tags);

impl Confirmed {
    /// Returns a body with its tag.
    pub(super) fn tagged(&self, kind: Kind, body: &[u8]) -> Vec<u8> {
        self.0.tagged(kind, body)
    }

    /// Checks the tag of the other host at the end of a message, and returns the body before it.
    ///
    /// # Errors
    /// If the other host did not send this message.
    pub(super) fn body<'a>(&self, kind: Kind, message: &'a [u8]) -> Result<&'a [u8], PairingError> {
        let (body, tag) = message.split_last_chunk().ok_or(PairingError::Altered)?;
        match self.0.verify(kind, body, tag) {
            true => Ok(body),
            false => Err(PairingError::Altered),
        }
    }
}

/// Makes and checks tags.
struct Tags {
    role: Role,
    shared: hmac::Key,
    /// The hello of the dialing host, then that of the listening one.
    hellos: Vec<u8>,
}

impl Tags {
    /// The key of the messages of this kind from this side.
    fn key(&self, from: Role, kind: Kind) -> hmac::Key {
        let label = [&MAGIC, kind.name(), b" from ", from.name()].concat();
        let key = hmac::sign(&self.shared, &label);
        hmac::Key::new(hmac::HMAC_SHA256, key.as_ref())
    }

    fn tagged(&self, kind: Kind, body: &[u8]) -> Vec<u8> {
        let key = self.key(self.role, kind);
        let tag = hmac::sign(&key, &[&self.hellos, body].concat());
        [body, tag.as_ref()].concat()
    }

    fn verify(&self, kind: Kind, body: &[u8], tag: &[u8; TAG]) -> bool {
        let key = self.key(self.role.other(), kind);
        hmac::verify(&key, &[&self.hellos, body].concat(), tag).is_ok()
    }
}
