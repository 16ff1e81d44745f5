//! Configuration files and overrides. Any text gives a configuration or an error that names the
//! mistakes. The rendered configuration reads as the same configuration.

use fipa::fuzzing;

/// Reads the text before the first zero byte as a file, and the parts after it as overrides.
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
                .expect("a loaded configuration is valid");
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
