//! The secret of a domain: random digits in the names of its files in `/dev/shm`.
//!
//! Every user may create files there. Without the secret, another user could create a file with the
//! name of one that the first process of the domain needs, and the domain would have no shared memory.
//! The names are visible while the domain has processes, so the secret ends with the last of them.
//!
//! The last digit states the layout of the structures in shared memory, which processes of another layout
//! must not read.
//!
//! The secret is the target of a symbolic link in the private directory of the domain, because a link
//! is created together with its target: no process reads half a secret.

use std::io;
use std::path::{Path, PathBuf};

/// Name of the link.
const LINK: &str = "secret";

/// Number of random hexadecimal digits of a secret. One more states the layout.
const RANDOM: usize = 16;

/// The layout of this process: the bytes of a pointer, which iceoryx2 has in shared memory. One more for the other
/// byte order.
pub(crate) const LAYOUT: char = match (usize::BITS, cfg!(target_endian = "little")) {
    (32, true) => '4',
    (32, false) => '5',
    (_, true) => '8',
    (_, false) => '9',
};

/// Names the processes of a layout.
pub(crate) fn layout_name(layout: char) -> &'static str {
    match layout {
        '4' => "32-bit",
        '8' => "64-bit",
        '5' | '9' => "big-endian",
        _ => "other",
    }
}

/// The secret of a domain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Secret(String);

impl Secret {
    /// Returns the secret of the domain in this directory. `None` if the domain has no process, or
    /// another program has removed or changed the link.
    pub(crate) fn read(root: &Path) -> io::Result<Option<Self>> {
        match std::fs::read_link(path(root)) {
            Ok(target) => Ok(target.to_str().and_then(Self::parse)),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Draws a secret.
    pub(crate) fn draw() -> io::Result<Self> {
        let drawn = getrandom::u64().map_err(io::Error::other)?;
        Ok(Self(format!("{drawn:0RANDOM$x}{LAYOUT}")))
    }

    /// Whether the processes of the domain lay out shared memory as this one does.
    pub(crate) fn has_this_layout(&self) -> bool {
        self.layout() == LAYOUT
    }

    /// The layout of the processes of the domain.
    pub(crate) fn layout(&self) -> char {
        self.0.chars().last().unwrap_or_default()
    }

    /// Makes this the secret of a domain without one. The caller must hold the domain's lock.
    pub(crate) fn store(&self, root: &Path) -> io::Result<()> {
        // Another program may have left something else in its place.
        remove(root);
        std::os::unix::fs::symlink(&self.0, path(root))
    }

    /// Returns the secret in the name of a file of a domain, which begins with its prefix.
    pub(crate) fn in_name(prefix: &str, name: &str) -> Option<Self> {
        let rest = name.strip_prefix(prefix)?.strip_prefix('_')?;
        Self::parse(rest.split_once('_')?.0)
    }

    /// Returns the hexadecimal digits.
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }

    fn parse(text: &str) -> Option<Self> {
        let is_secret =
            text.len() == RANDOM + 1 && text.bytes().all(|digit| digit.is_ascii_hexdigit());
        is_secret.then(|| Self(text.to_owned()))
    }
}

/// Removes the secret. The caller must hold the domain's lock, and no process of the domain runs.
pub(crate) fn remove(root: &Path) {
    // The next process that starts uses a secret that could not be removed.
    let _ = std::fs::remove_file(path(root));
}

/// The link with the secret of the domain in this directory.
pub(crate) fn path(root: &Path) -> PathBuf {
    root.join(LINK)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_read_until_it_is_removed() {
        let root = tempfile::tempdir().unwrap();
        assert_eq!(Secret::read(root.path()).unwrap(), None);
        let secret = Secret::draw().unwrap();
        assert_ne!(Secret::draw().unwrap(), secret);
        secret.store(root.path()).unwrap();
        assert_eq!(Secret::read(root.path()).unwrap(), Some(secret));
        remove(root.path());
        assert_eq!(Secret::read(root.path()).unwrap(), None);
    }

    #[test]
    fn a_secret_states_the_layout_of_the_domain() {
        assert!(Secret::draw().unwrap().has_this_layout());
        let [narrow, wide] = [4, 8].map(|width| Secret(format!("0123456789abcdef{width}")));
        assert_ne!(narrow.has_this_layout(), wide.has_this_layout());
        assert_eq!(layout_name(narrow.layout()), "32-bit");
        assert_eq!(layout_name(wide.layout()), "64-bit");
    }

    #[test]
    fn the_secret_is_read_from_the_name_of_a_file() {
        let secret = Secret("0123456789abcdef8".to_owned());
        for (name, found) in [
            ("fipa_x_0123456789abcdef8_17.page", Some(secret)),
            ("fipa_x_0123456789abcdef8", None),
            ("fipa_x_0123456789abcdef_17.page", None),
            ("fipa_y_0123456789abcdef8_17.page", None),
            ("fipa_x0123456789abcdef8_17.page", None),
        ] {
            assert_eq!(Secret::in_name("fipa_x", name), found, "{name}");
        }
    }

    #[test]
    fn a_link_with_another_target_is_replaced() {
        let root = tempfile::tempdir().unwrap();
        for target in [
            "",
            "0123456789abcdef",
            "../../../../x/y",
            "0123456789abcdef80",
        ] {
            remove(root.path());
            if std::os::unix::fs::symlink(target, path(root.path())).is_err() {
                // There is no link to an empty path.
                continue;
            }
            assert_eq!(Secret::read(root.path()).unwrap(), None, "{target}");
            Secret::draw().unwrap().store(root.path()).unwrap();
        }
    }
}
