//! Typing errors in the names of protocols and performatives.

/// Whether the texts differ in one inserted, omitted or changed character, or in two neighbors that
/// changed places. Short names are never near.
#[must_use]
pub fn one_edit_apart(one: &str, other: &str) -> bool {
    let (short, long): (Vec<char>, Vec<char>) = if one.len() <= other.len() {
        (one.chars().collect(), other.chars().collect())
    } else {
        (other.chars().collect(), one.chars().collect())
    };
    let same = short.iter().zip(&long).take_while(|(a, b)| a == b).count();
    // All names of one or two characters would be near.
    if short.len() < 3 {
        return false;
    }
    let (short_rest, long_rest) = (short.get(same + 1..), long.get(same + 1..));
    match long.len().checked_sub(short.len()) {
        Some(0) => {
            let swapped = short.get(same) == long.get(same + 1)
                && short.get(same + 1) == long.get(same)
                && short.get(same + 2..) == long.get(same + 2..);
            short_rest == long_rest || swapped
        }
        Some(1) => short.get(same..) == long_rest,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_typing_error_makes_names_near() {
        for near in [
            "fipa-reqest",
            "fipa-requestt",
            "fipa-reqeust",
            "fipa-requesd",
        ] {
            assert!(one_edit_apart("fipa-request", near), "{near}");
            assert!(one_edit_apart(near, "fipa-request"), "{near}");
        }
        for far in [
            "fipa-query",
            "fipa-rqeeust",
            "fipa-rzeuest",
            "fipa-rqzuest",
            "fipa-request-when",
            "",
        ] {
            assert!(!one_edit_apart("fipa-request", far), "{far}");
        }
        assert!(!one_edit_apart("ab", "ac"));
    }
}
