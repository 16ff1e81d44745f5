//! The state of the screen that keys change. No I/O and no clock.

use fipa::Matcher;
use fipa_acl::escape;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::table::{Column, Order};

/// Maximum length of a typed pattern, in characters.
const MAX_PATTERN: usize = 200;

/// A pattern of agents: its text and its parsed form.
#[derive(Debug, Clone)]
pub(super) struct Filter {
    pub(super) text: String,
    pub(super) matcher: Matcher,
}

impl Filter {
    pub(super) fn parse(text: &str) -> Result<Self, fipa::error::PatternError> {
        Ok(Self {
            text: text.to_owned(),
            matcher: Matcher::parse(text)?,
        })
    }
}

/// A pattern that the user is typing.
#[derive(Debug, Clone, Default)]
pub(super) struct Input {
    pub(super) text: String,
    pub(super) error: Option<String>,
}

/// The state of the screen.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) order: Order,
    pub(super) filter: Option<Filter>,
    pub(super) input: Option<Input>,
    pub(super) paused: bool,
    pub(super) help: bool,
    /// Number of agents above the first shown one.
    pub(super) first: usize,
}

impl View {
    pub(super) fn new(column: Column, filter: Option<Filter>) -> Self {
        Self {
            order: Order {
                column,
                reversed: false,
            },
            filter,
            input: None,
            paused: false,
            help: false,
            first: 0,
        }
    }

    /// Handles a key. Returns whether the command ends.
    pub(super) fn handle_key(&mut self, key: KeyEvent) -> bool {
        if key.kind == KeyEventKind::Release {
            return false;
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        if control && matches!(key.code, KeyCode::Char('c' | 'd')) {
            return true;
        }
        if self.input.is_some() {
            self.type_key(key.code);
            return false;
        }
        if self.help {
            self.help = false;
            return key.code == KeyCode::Char('q');
        }
        match key.code {
            KeyCode::Char('q') => return true,
            KeyCode::Char('?' | 'h') => self.help = true,
            KeyCode::Char('p' | ' ') => self.paused = !self.paused,
            KeyCode::Char('r') => self.order.reversed = !self.order.reversed,
            KeyCode::Char('/') => {
                let text = self.filter.as_ref().map(|it| it.text.clone());
                self.input = Some(Input {
                    text: text.unwrap_or_default(),
                    error: None,
                });
            }
            KeyCode::Char('<') | KeyCode::Left => self.sort_by_neighbor(Column::ALL.len() - 1),
            KeyCode::Char('>') | KeyCode::Right => self.sort_by_neighbor(1),
            KeyCode::Char(digit @ '1'..='8') => {
                let number = digit.to_digit(10).and_then(|it| usize::try_from(it).ok());
                let column = number.and_then(|it| Column::ALL.get(it.checked_sub(1)?));
                self.sort_by(column.copied());
            }
            KeyCode::Up => self.first = self.first.saturating_sub(1),
            KeyCode::Down => self.first = self.first.saturating_add(1),
            KeyCode::PageUp => self.first = self.first.saturating_sub(10),
            KeyCode::PageDown => self.first = self.first.saturating_add(10),
            KeyCode::Home => self.first = 0,
            KeyCode::Esc => self.filter = None,
            _ => {}
        }
        false
    }

    fn type_key(&mut self, key: KeyCode) {
        let Some(input) = &mut self.input else {
            return;
        };
        match key {
            KeyCode::Char(c) if input.text.chars().count() < MAX_PATTERN => input.text.push(c),
            KeyCode::Backspace => drop(input.text.pop()),
            KeyCode::Esc => self.input = None,
            KeyCode::Enter if input.text.is_empty() => {
                self.filter = None;
                self.input = None;
            }
            KeyCode::Enter => match Filter::parse(&input.text) {
                Ok(filter) => {
                    self.filter = Some(filter);
                    self.input = None;
                    self.first = 0;
                }
                Err(error) => {
                    let error = error.to_string();
                    let line = error.lines().last().unwrap_or_default();
                    input.error = Some(escape(line).into_owned());
                }
            },
            _ => {}
        }
    }

    fn sort_by_neighbor(&mut self, distance: usize) {
        let columns = Column::ALL;
        let current = columns.iter().position(|it| *it == self.order.column);
        let next = current.map(|current| (current + distance) % columns.len());
        self.sort_by(next.and_then(|next| columns.get(next)).copied());
    }

    /// Sorts by a column; a second time in the reverse order.
    fn sort_by(&mut self, column: Option<Column>) {
        let Some(column) = column else {
            return;
        };
        let reversed = column == self.order.column && !self.order.reversed;
        self.order = Order { column, reversed };
        self.first = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn press(view: &mut View, code: KeyCode) -> bool {
        view.handle_key(KeyEvent::new(code, KeyModifiers::NONE))
    }

    fn type_text(view: &mut View, text: &str) {
        for c in text.chars() {
            assert!(!press(view, KeyCode::Char(c)), "{c}");
        }
    }

    #[test]
    fn q_and_control_c_end_the_command() {
        let mut view = View::new(Column::Sent, None);
        assert!(press(&mut view, KeyCode::Char('q')));
        let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
        assert!(view.handle_key(control_c));
        // In a pattern, q is a letter.
        type_text(&mut view, "/q");
        assert_eq!(view.input.as_ref().unwrap().text, "q");
        assert!(view.handle_key(control_c));
    }

    #[test]
    fn columns_are_chosen_by_arrows_and_digits() {
        let mut view = View::new(Column::Agent, None);
        press(&mut view, KeyCode::Left);
        assert_eq!(view.order.column, Column::Via);
        press(&mut view, KeyCode::Char('>'));
        assert_eq!(view.order.column, Column::Agent);
        press(&mut view, KeyCode::Char('4'));
        let failed = Order {
            column: Column::Failed,
            reversed: false,
        };
        assert_eq!(view.order, failed);
        press(&mut view, KeyCode::Char('4'));
        assert!(view.order.reversed);
        press(&mut view, KeyCode::Char('r'));
        assert_eq!(view.order, failed);
    }

    #[test]
    fn a_pattern_is_typed_and_removed() {
        let mut view = View::new(Column::Sent, None);
        type_text(&mut view, "/arm_(");
        press(&mut view, KeyCode::Enter);
        assert!(view.filter.is_none());
        assert!(view.input.as_ref().unwrap().error.is_some());
        press(&mut view, KeyCode::Backspace);
        type_text(&mut view, ".*");
        press(&mut view, KeyCode::Enter);
        let filter = view.filter.as_ref().unwrap();
        assert_eq!(filter.text, "arm_.*");
        assert!(filter.matcher.matches("arm_7") && view.input.is_none());
        // The next input begins with it; Esc keeps the filter, a further one removes it.
        press(&mut view, KeyCode::Char('/'));
        assert_eq!(view.input.as_ref().unwrap().text, "arm_.*");
        press(&mut view, KeyCode::Esc);
        assert!(view.filter.is_some());
        press(&mut view, KeyCode::Esc);
        assert!(view.filter.is_none());
    }

    #[test]
    fn a_typed_pattern_is_bounded() {
        let mut view = View::new(Column::Sent, None);
        press(&mut view, KeyCode::Char('/'));
        for _ in 0..2 * MAX_PATTERN {
            press(&mut view, KeyCode::Char('x'));
        }
        assert_eq!(view.input.unwrap().text.len(), MAX_PATTERN);
    }

    #[test]
    fn any_key_closes_the_help() {
        let mut view = View::new(Column::Sent, None);
        press(&mut view, KeyCode::Char('?'));
        assert!(view.help);
        press(&mut view, KeyCode::Char('p'));
        assert!(!view.help && !view.paused);
        press(&mut view, KeyCode::Char('p'));
        assert!(view.paused);
    }
}
