//! Configuration files and overrides: any text gives a configuration or names its mistakes; what is
//! shown of a configuration reads as the same one.

use fipa::fuzzing;

/// Reads the text before a zero byte as a file, and what follows as overrides.
pub fn play(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let mut parts = text.split('\0');
    let file = parts.next().unwrap_or_default();
    let set: Vec<&str> = parts.take(8).collect();
    match fuzzing::config(file, &set) {
        Ok(effective) => {
            effective
                .config()
                .check()
                .expect("what is loaded is checked");
            let shown = effective.render();
            let again = fuzzing::config(&shown, &[]);
            let again = again.unwrap_or_else(|error| panic!("{error} in {shown}"));
            assert_eq!(again.config(), effective.config());
            assert_eq!(
                effective.config().differences(again.config()),
                Vec::<String>::new()
            );
        }
        Err(error) => {
            let lines = file.split('\n').count();
            let told = error.to_string();
            assert!(!told.is_empty());
            assert!(told.lines().count() <= 40 * (lines + set.len() + 10));
        }
    }
}
