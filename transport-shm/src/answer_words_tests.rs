//! Tests of the words for answers, in one thread. `tests/interleavings.rs` has those with several.

use crate::answer_words::{AnswerWords, LentWords, WORDS, WordPlace};

const PAGE: u64 = 7;

fn page<const N: usize>(first: u64) -> (AnswerWords<N>, LentWords<N>) {
    let (words, lent) = (AnswerWords::default(), LentWords::new([PAGE, first]));
    words.set_page(lent.page());
    (words, lent)
}

#[test]
fn each_word_is_lent_to_one_parcel_at_a_time() {
    let (words, lent) = page::<WORDS>(1);
    let all: Vec<_> = (0..WORDS).map(|_| lent.lend(&words)).collect();
    for (index, (token, place)) in all.iter().enumerate() {
        assert!(words.has(*place));
        assert_eq!(place.word as usize, index);
        assert_eq!(words.code(*place, *token), None);
        words.answer(*place, *token, 1);
        assert_eq!(words.code(*place, *token), Some(1));
    }
    let (token, none) = lent.lend(&words);
    assert_eq!(none, WordPlace::NONE);
    assert!(!words.has(none));
    assert_eq!(words.code(none, token), None);
    lent.give_back(none);
    assert_eq!(lent.lend(&words).1, WordPlace::NONE);
    lent.give_back(all[9].1);
    let (later, again) = lent.lend(&words);
    assert_eq!(again, all[9].1);
    assert!(later > token);
    assert_eq!(words.code(again, later), None);
}

#[test]
fn a_late_answer_does_not_pass_for_that_to_a_later_parcel() {
    let (words, lent) = page::<1>(u64::MAX);
    let (abandoned, place) = lent.lend(&words);
    lent.give_back(place);
    let (later, again) = lent.lend(&words);
    assert_eq!(again, place);
    words.answer(place, abandoned, 3);
    assert_eq!(words.code(place, later), None);
    words.answer(place, later, 1);
    words.answer(place, abandoned, 2);
    assert_eq!(words.code(place, later), Some(1));
    assert_eq!(words.code(place, abandoned), None);
}

#[test]
fn words_of_other_pages_and_beyond_the_end_are_refused() {
    let (words, lent) = page::<2>(1);
    let (token, place) = lent.lend(&words);
    let beyond = WordPlace { word: 2, ..place };
    let other = WordPlace { page: 8, ..place };
    assert!(words.has(place));
    assert!(
        ![beyond, other, WordPlace::NONE]
            .iter()
            .any(|it| words.has(*it))
    );
    words.answer(beyond, token, 1);
    assert_eq!(words.code(beyond, token), None);
    assert_eq!(words.code(place, token), None);
    // Before the process has set the number of its page.
    assert!(!AnswerWords::<2>::default().has(WordPlace::NONE));
    assert!(!AnswerWords::<2>::default().has(place));
}

/// Another process answers with tokens that no parcel has.
#[test]
fn a_word_that_is_wrong_is_not_lent_and_answers_nothing() {
    let (words, lent) = page::<2>(1);
    let (token, place) = lent.lend(&words);
    for (other, code) in [(token - 1, 0), (token, 0), (token, 16), (u64::MAX, 15)] {
        words.answer(place, other, code);
        assert_eq!(words.code(place, token), None, "{other} {code}");
    }
    lent.give_back(place);
    let places = [(); 3].map(|()| lent.lend(&words).1);
    assert_eq!(places[0], WordPlace::NONE);
    assert_eq!(places[1].word, 1);
    assert_eq!(places[2], WordPlace::NONE);
}
