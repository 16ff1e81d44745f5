//! The body of a hello frame, with which two endpoints introduce themselves.
//!
//! A fixed part of 28 bytes, little-endian (incarnation 8, largest letter 8, maximum number of
//! parcels in flight 4, serial number of this connection 8), then texts, each preceded by its
//! length in two bytes: name, domain, host, the location that was dialed (empty from the side that
//! accepted), and then, after their number in one byte, the addresses that the endpoint listens on.
//! On a connection for [large letters](Load::Large), a byte 1 follows. Later versions may append bytes, which are
//! ignored.

use bytes::{BufMut, Bytes, BytesMut};
use fipa_transport::{Incarnation, Location};
use zerocopy::little_endian::{U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::Identity;

/// Longest body of a hello, in bytes.
pub(crate) const MAX_HELLO: usize = 16 * 1024;

/// Longest text of a location with kind and incarnation, in bytes.
const MAX_DIALED: usize = Location::MAX_ADDRESS + 32;

/// Maximum number of listening addresses in a hello; the best come first.
const MAX_LISTENING: usize = 16;

#[derive(FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned)]
#[repr(C)]
struct Fixed {
    incarnation: U64,
    max_letter: U64,
    max_in_flight: U32,
    serial: U64,
}

/// The letters that a connection is for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub(crate) enum Load {
    /// All parcels, as far as there is no connection for large letters.
    #[default]
    Any,
    /// Large letters, and those that follow them in their stream. They do not delay the parcels of the connection
    /// for all.
    Large,
}

/// The last byte of a hello for [`Load::Large`].
const LARGE: u8 = 1;

/// The introduction that each side sends when a connection begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Hello {
    pub(crate) identity: Identity,
    /// Largest accepted letter, in bytes.
    pub(crate) max_letter: u64,
    /// Maximum number of parcels that the peer may send before it has read answers to earlier ones.
    pub(crate) max_in_flight: u32,
    /// Increases with every connection that this endpoint opens.
    pub(crate) serial: u64,
    /// The location that the dialing side opened this connection for.
    pub(crate) dialed: String,
    /// Addresses the endpoint listens on, best first.
    pub(crate) listening: Vec<String>,
    /// The letters that the dialing side opened this connection for.
    pub(crate) load: Load,
}

impl Hello {
    pub(crate) fn encode(&self) -> Bytes {
        let fixed = Fixed {
            incarnation: U64::new(self.identity.incarnation.as_u64()),
            max_letter: U64::new(self.max_letter),
            max_in_flight: U32::new(self.max_in_flight),
            serial: U64::new(self.serial),
        };
        let mut out = BytesMut::new();
        out.put_slice(fixed.as_bytes());
        let Identity {
            name, domain, host, ..
        } = &self.identity;
        for text in [name, domain, host, &self.dialed] {
            put_text(&mut out, text);
        }
        let listening = self.listening.iter().take(MAX_LISTENING);
        out.put_u8(listening.len() as u8);
        listening.for_each(|text| put_text(&mut out, text));
        if self.load == Load::Large {
            out.put_u8(LARGE);
        }
        out.freeze()
    }

    pub(crate) fn decode(body: &[u8]) -> Option<Self> {
        let (fixed, mut rest) = Fixed::read_from_prefix(body).ok()?;
        let incarnation = Incarnation::from_u64(fixed.incarnation.get());
        if !incarnation.is_known() {
            return None;
        }
        let identity = Identity {
            name: text(&mut rest, Identity::MAX_TEXT)?,
            incarnation,
            domain: text(&mut rest, Identity::MAX_TEXT)?,
            host: text(&mut rest, Identity::MAX_TEXT)?,
        };
        let dialed = text(&mut rest, MAX_DIALED)?;
        let (&count, after) = rest.split_first()?;
        rest = after;
        if usize::from(count) > MAX_LISTENING {
            return None;
        }
        let listening = (0..count)
            .map(|_| text(&mut rest, Location::MAX_ADDRESS))
            .collect::<Option<_>>()?;
        let load = match rest.first() {
            Some(&LARGE) => Load::Large,
            _ => Load::Any,
        };
        Some(Self {
            identity,
            max_letter: fixed.max_letter.get(),
            max_in_flight: fixed.max_in_flight.get(),
            serial: fixed.serial.get(),
            dialed,
            listening,
            load,
        })
    }
}

fn put_text(out: &mut BytesMut, text: &str) {
    let text = fipa_transport::wire::truncated(text, MAX_DIALED);
    out.put_u16_le(text.len() as u16);
    out.put_slice(text.as_bytes());
}

fn text(rest: &mut &[u8], max: usize) -> Option<String> {
    let (len, after) = rest.split_first_chunk()?;
    let len = usize::from(u16::from_le_bytes(*len));
    let (text, after) = after.split_at_checked(len)?;
    *rest = after;
    let text = std::str::from_utf8(text).ok()?;
    (len <= max).then(|| text.to_owned())
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    pub(crate) fn sample(incarnation: u64) -> Hello {
        Hello {
            identity: Identity {
                name: "crex-mts".into(),
                incarnation: Incarnation::from_u64(incarnation),
                domain: "default".into(),
                host: "crex".into(),
            },
            max_letter: 1 << 20,
            max_in_flight: 8,
            serial: 3,
            dialed: "tcp://10.0.0.2:7788".into(),
            listening: vec!["10.0.0.1:7788".into(), "[::1]:7788".into()],
            load: Load::Any,
        }
    }

    #[test]
    fn a_hello_round_trips_and_may_grow() {
        let hello = sample(7);
        let mut body = hello.encode().to_vec();
        assert_eq!(Hello::decode(&body), Some(hello.clone()));
        body.extend_from_slice(b"from a later version");
        assert_eq!(Hello::decode(&body), Some(hello));
        let large = Hello {
            load: Load::Large,
            ..sample(7)
        };
        assert_eq!(Hello::decode(&large.encode()), Some(large));
    }

    #[test]
    fn every_truncation_and_an_unknown_incarnation_are_refused() {
        let body = sample(7).encode();
        for len in 0..body.len() {
            assert_eq!(Hello::decode(&body[..len]), None, "{len}");
        }
        assert_eq!(Hello::decode(&sample(0).encode()), None);
    }

    #[test]
    fn the_longest_hello_fits() {
        let mut hello = sample(7);
        hello.dialed = "x".repeat(MAX_DIALED);
        hello.listening = vec!["x".repeat(Location::MAX_ADDRESS); MAX_LISTENING + 1];
        let body = hello.encode();
        assert!(body.len() <= MAX_HELLO);
        assert_eq!(Hello::decode(&body).unwrap().listening.len(), MAX_LISTENING);
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_decode_without_panic(body in prop::collection::vec(any::<u8>(), 0..400)) {
            if let Some(hello) = Hello::decode(&body) {
                prop_assert_eq!(Hello::decode(&hello.encode()), Some(hello));
            }
        }
    }
}
