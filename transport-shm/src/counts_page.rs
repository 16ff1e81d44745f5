//! Counters in memory that other processes read: a shared mapping of a file.

use std::fs::File;
use std::io;

use fipa_transport::counts::Counts;
use rustix::mm::{MapFlags, ProtFlags, mmap};

use crate::memory::Mapping;

/// The counters of this process in a file that other processes read.
///
/// In a forked child, the counters still belong to the parent, and nothing may count there.
#[derive(Debug)]
pub struct CountsPage(Mapping);

impl CountsPage {
    /// Maps a file with the counters of this process.
    ///
    /// # Errors
    /// Fails if the file is too short, is not open for reading and writing, or cannot be mapped.
    pub fn map(file: &File) -> io::Result<Self> {
        check(file)?;
        let mapping = Mapping::new(file, Counts::LEN, ProtFlags::READ | ProtFlags::WRITE)?;
        let page = Self(mapping);
        page.as_ref().begin();
        Ok(page)
    }

    /// Counts in another file from now on, which has the present values already. Counts of other threads at the same
    /// time may be lost.
    ///
    /// # Errors
    /// Fails like [`map`](Self::map). The counters then stay in the former file.
    pub fn move_to(&self, file: &File) -> io::Result<()> {
        check(file)?;
        let start = self.0.start().as_ptr().cast();
        // SAFETY: the range is that of the mapping of `self`, which stays mapped as long as `self` exists. The kernel
        // replaces the pages at once: a thread that counts meanwhile writes to the former file or to the new one, both
        // of which are at least as long as the range.
        let moved = unsafe {
            mmap(
                start,
                self.0.len(),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED | MapFlags::FIXED,
                file,
                0,
            )
        };
        moved.map(drop).map_err(io::Error::from)
    }
}

impl AsRef<Counts> for CountsPage {
    fn as_ref(&self) -> &Counts {
        // SAFETY: the mapping exists as long as self, is aligned to a page and as long as `Counts`, of which every bit
        // pattern is valid. This process accesses it atomically, and others read the file. The pages exist: `check`
        // finds the file long enough, and its creator has written it. Only this user may write to the file, and no process
        // of the domain shortens it.
        unsafe { self.0.start().cast::<Counts>().as_ref() }
    }
}

/// Checks the length: an access to a page beyond the end would be a signal.
fn check(file: &File) -> io::Result<()> {
    match file.metadata()?.len() >= Counts::LEN as u64 {
        true => Ok(()),
        false => Err(io::Error::new(
            io::ErrorKind::InvalidData,
            "the file of the counters is too short",
        )),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::io::{Read as _, Seek as _, Write as _};

    use fipa_transport::Kind;
    use fipa_transport::counts::{Direction, LetterOutcome, Totals};

    use super::*;

    fn values_in(mut file: &File) -> Totals {
        let mut page = Vec::new();
        file.rewind().unwrap();
        file.read_to_end(&mut page).unwrap();
        Totals::from_page(&page).unwrap()
    }

    #[test]
    fn a_file_shows_the_counts_as_long_as_they_are_in_it() {
        let counted = |totals: &Totals| {
            totals.letters(Direction::Sent, Some(Kind::Shm), LetterOutcome::Delivered)
        };
        let mut first = tempfile::tempfile().unwrap();
        assert!(CountsPage::map(&first).is_err(), "an empty file");
        first.write_all(&Totals::default().to_page()).unwrap();
        let page = CountsPage::map(&first).unwrap();
        let count = || {
            let via = Some(Kind::Shm);
            page.as_ref()
                .letter(Direction::Sent, via, LetterOutcome::Delivered);
        };
        count();
        assert_eq!(counted(&values_in(&first)), 1);

        let mut second = tempfile::tempfile().unwrap();
        assert!(page.move_to(&second).is_err(), "an empty file");
        count();
        assert_eq!(counted(&values_in(&first)), 2);
        second.write_all(&page.as_ref().totals().to_page()).unwrap();
        page.move_to(&second).unwrap();
        count();
        assert_eq!(counted(&values_in(&first)), 2);
        assert_eq!(counted(&values_in(&second)), 3);
    }
}
