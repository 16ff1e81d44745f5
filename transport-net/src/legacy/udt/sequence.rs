//! Sequence numbers of packets: 31 bits on the wire, which wrap around (draft-gg-udt-03 section 2);
//! 64 bits here, which do not.

/// Number of values on the wire.
const MODULUS: u64 = 1 << 31;

/// The largest number on the wire.
pub(crate) const LARGEST: u32 = (MODULUS - 1) as u32;

/// Returns the number of the first packet of a connection, from the initial sequence number of its
/// handshake. It is so large that every near number is positive.
pub(crate) fn first(initial: u32) -> u64 {
    MODULUS + u64::from(initial & LARGEST)
}

/// Returns the number on the wire.
pub(crate) fn wire(sequence: u64) -> u32 {
    (sequence % MODULUS) as u32
}

/// Returns the sequence number that is nearest to `reference`, among those with this number on the
/// wire.
pub(crate) fn near(reference: u64, wire: u32) -> u64 {
    let ahead = (u64::from(wire & LARGEST) + MODULUS - reference % MODULUS) % MODULUS;
    if ahead < MODULUS / 2 {
        reference + ahead
    } else {
        (reference + ahead).saturating_sub(MODULUS)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_near_number_survives_the_wire(initial in 0..=LARGEST, offset in 0..1_u64 << 40, distance in -(1_i64 << 30)..1 << 30) {
            let reference = first(initial) + offset;
            let number = reference.saturating_add_signed(distance);
            prop_assume!(number >= MODULUS / 2);
            prop_assert_eq!(near(reference, wire(number)), number);
        }
    }

    #[test]
    fn numbers_wrap_around_after_31_bits() {
        let last = first(LARGEST);
        assert_eq!(wire(last), LARGEST);
        assert_eq!(wire(last + 1), 0);
        assert_eq!(near(last, 0), last + 1);
        assert_eq!(near(last + 1, LARGEST), last);
    }
}
