//! Sets of sequence numbers as ranges: the loss list of a sender, and what a receiver skips.

use std::collections::BTreeMap;
use std::ops::Range;

/// A set of numbers. Its memory and time depend on the number of its ranges.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub(crate) struct Ranges {
    /// The end of each range, by its start. Ranges neither overlap nor touch.
    by_start: BTreeMap<u64, u64>,
}

impl Ranges {
    pub(crate) fn is_empty(&self) -> bool {
        self.by_start.is_empty()
    }

    pub(crate) fn contains(&self, number: u64) -> bool {
        let before = self.by_start.range(..=number).next_back();
        before.is_some_and(|(_, end)| number < *end)
    }

    /// Returns the smallest number.
    pub(crate) fn first(&self) -> Option<u64> {
        self.by_start.first_key_value().map(|(start, _)| *start)
    }

    /// Adds the numbers of a range.
    pub(crate) fn insert(&mut self, range: Range<u64>) {
        let Range { mut start, mut end } = range;
        if start >= end {
            return;
        }
        // Each pass removes a range that touches the new one.
        while let Some((other, its_end)) = self
            .by_start
            .range(..=end)
            .next_back()
            .map(|(other, its_end)| (*other, *its_end))
            .filter(|(_, its_end)| *its_end >= start)
        {
            self.by_start.remove(&other);
            start = start.min(other);
            end = end.max(its_end);
        }
        self.by_start.insert(start, end);
    }

    /// Removes the numbers of a range.
    pub(crate) fn remove(&mut self, range: Range<u64>) {
        let Range { start, end } = range;
        if start >= end {
            return;
        }
        while let Some((other, its_end)) = self
            .by_start
            .range(..end)
            .next_back()
            .map(|(other, its_end)| (*other, *its_end))
            .filter(|(_, its_end)| *its_end > start)
        {
            self.by_start.remove(&other);
            if its_end > end {
                self.by_start.insert(end, its_end);
            }
            if other < start {
                self.by_start.insert(other, start);
            }
        }
    }

    /// Removes and returns the smallest number.
    pub(crate) fn pop_first(&mut self) -> Option<u64> {
        let (start, end) = self.by_start.pop_first()?;
        if start + 1 < end {
            self.by_start.insert(start + 1, end);
        }
        Some(start)
    }

    /// Returns the ranges in ascending order.
    #[cfg(test)]
    pub(crate) fn iter(&self) -> impl Iterator<Item = Range<u64>> {
        self.by_start.iter().map(|(start, end)| *start..*end)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[derive(Debug, Clone)]
    enum Step {
        Insert(Range<u64>),
        Remove(Range<u64>),
        PopFirst,
    }

    fn step() -> impl Strategy<Value = Step> {
        let range = || (0..60_u64, 0..12_u64).prop_map(|(start, len)| start..start + len);
        prop_oneof![
            4 => range().prop_map(Step::Insert),
            2 => range().prop_map(Step::Remove),
            1 => Just(Step::PopFirst),
        ]
    }

    proptest! {
        #[test]
        fn they_match_a_set_of_numbers(steps in prop::collection::vec(step(), 0..60)) {
            let (mut ranges, mut numbers) = (Ranges::default(), BTreeSet::new());
            for step in steps {
                match step {
                    Step::Insert(range) => {
                        ranges.insert(range.clone());
                        numbers.extend(range);
                    }
                    Step::Remove(range) => {
                        ranges.remove(range.clone());
                        numbers.retain(|number| !range.contains(number));
                    }
                    Step::PopFirst => {
                        prop_assert_eq!(ranges.pop_first(), numbers.pop_first());
                    }
                }
                let all: BTreeSet<u64> = ranges.iter().flatten().collect();
                prop_assert_eq!(&all, &numbers);
                prop_assert_eq!(ranges.first(), numbers.first().copied());
                prop_assert_eq!(ranges.is_empty(), numbers.is_empty());
                let bounds: Vec<Range<u64>> = ranges.iter().collect();
                prop_assert!(bounds.windows(2).all(|pair| pair[0].end < pair[1].start));
                for number in 0..80 {
                    prop_assert_eq!(ranges.contains(number), numbers.contains(&number));
                }
            }
        }
    }
}
