//! A grid of letters with colours, and what a terminal must be told to show it.

use std::fmt::Write;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colour {
    /// 24 bits.
    True([u8; 3]),
    /// Of the 256 that most terminals have; the first sixteen are the terminal's own.
    Indexed(u8),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// None: the terminal's own.
    pub front: Option<Colour>,
    pub back: Option<Colour>,
    pub bold: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Cell {
    letter: char,
    style: Style,
}

/// A rectangle of a canvas.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Area {
    pub column: usize,
    pub row: usize,
    pub columns: usize,
    pub rows: usize,
}

impl Area {
    /// The upper part of so many rows, as far as there are, and the rest.
    pub fn split_rows(self, rows: usize) -> (Self, Self) {
        let rows = rows.min(self.rows);
        (Self { rows, ..self }, Self { row: self.row + rows, rows: self.rows - rows, ..self })
    }

    /// The left part of so many columns, as far as there are, and the rest.
    pub fn split_columns(self, columns: usize) -> (Self, Self) {
        let columns = columns.min(self.columns);
        let right = Self { column: self.column + columns, columns: self.columns - columns, ..self };
        (Self { columns, ..self }, right)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Canvas {
    columns: usize,
    cells: Vec<Cell>,
}

impl Canvas {
    pub fn new(columns: usize, rows: usize) -> Self {
        let empty = Cell { letter: ' ', style: Style::default() };
        Self { columns, cells: vec![empty; columns * rows] }
    }

    pub fn area(&self) -> Area {
        let rows = self.cells.len().checked_div(self.columns).unwrap_or(0);
        Area { column: 0, row: 0, columns: self.columns, rows }
    }

    /// Draws a letter; beyond the edge there is nothing.
    pub fn put(&mut self, column: usize, row: usize, letter: char, style: Style) {
        if column >= self.columns {
            return;
        }
        if let Some(cell) = self.cells.get_mut(row * self.columns + column) {
            // What would command the terminal is no letter.
            let letter = if letter.is_control() { '?' } else { letter };
            *cell = Cell { letter, style };
        }
    }

    /// Draws the first letters of a text into the first row of an area, as many as fit; gives the rest of the row.
    pub fn text(&mut self, area: Area, text: &str, style: Style) -> Area {
        if area.rows == 0 {
            return area;
        }
        let letters = text.chars().take(area.columns);
        letters
            .clone()
            .enumerate()
            .for_each(|(at, letter)| self.put(area.column + at, area.row, letter, style));
        area.split_columns(letters.count()).1
    }

    /// Draws a frame with a title; gives what is inside.
    pub fn frame(&mut self, area: Area, title: &str) -> Area {
        let Area { column, row, columns, rows } = area;
        if columns < 2 || rows < 2 {
            return Area { columns: 0, rows: 0, ..area };
        }
        let (right, bottom, style) = (column + columns - 1, row + rows - 1, Style::default());
        for at in column + 1..right {
            self.put(at, row, '─', style);
            self.put(at, bottom, '─', style);
        }
        for at in row + 1..bottom {
            self.put(column, at, '│', style);
            self.put(right, at, '│', style);
        }
        for (at, row, letter) in
            [(column, row, '┌'), (right, row, '┐'), (column, bottom, '└'), (right, bottom, '┘')]
        {
            self.put(at, row, letter, style);
        }
        let inside = Area { column: column + 1, row: row + 1, columns: columns - 2, rows: rows - 2 };
        self.text(Area { row, rows: 1, ..inside }, title, style);
        inside
    }

    /// What a terminal that shows `before` must be told to show this; of another size, or of nothing known, all of it.
    pub fn changes(&self, before: Option<&Self>) -> String {
        let before =
            before.filter(|before| before.columns == self.columns && before.cells.len() == self.cells.len());
        let mut told = String::new();
        if before.is_none() {
            told.push_str("\x1b[0m\x1b[2J");
        }
        // Where the terminal's cursor is, and how it draws.
        let (mut cursor, mut drawn) = (usize::MAX, Style::default());
        for (at, cell) in self.cells.iter().enumerate() {
            if before.is_some_and(|before| before.cells[at] == *cell) {
                continue;
            }
            if cursor != at {
                let (row, column) = (at / self.columns + 1, at % self.columns + 1);
                // Writing to a String cannot fail.
                let _ = write!(told, "\x1b[{row};{column}H");
            }
            if drawn != cell.style {
                told.push_str(&cell.style.command());
                drawn = cell.style;
            }
            told.push(cell.letter);
            // At a row's end terminals differ in where the cursor is.
            cursor = if (at + 1).is_multiple_of(self.columns) { usize::MAX } else { at + 1 };
        }
        if drawn != Style::default() {
            told.push_str("\x1b[0m");
        }
        told
    }

    /// The letters of a row.
    #[cfg(test)]
    pub fn row(&self, row: usize) -> String {
        self.cells[row * self.columns..(row + 1) * self.columns].iter().map(|cell| cell.letter).collect()
    }

    #[cfg(test)]
    pub fn style(&self, column: usize, row: usize) -> Style {
        self.cells[row * self.columns + column].style
    }
}

impl Style {
    pub fn of(colour: Option<Colour>) -> Self {
        Self { front: colour, ..Self::default() }
    }

    /// What tells a terminal to draw like this, whatever it did before.
    fn command(self) -> String {
        let mut command = "\x1b[0".to_owned();
        if self.bold {
            command.push_str(";1");
        }
        for (ground, colour) in [(38, self.front), (48, self.back)] {
            let _ = match colour {
                None => Ok(()),
                Some(Colour::True([red, green, blue])) => write!(command, ";{ground};2;{red};{green};{blue}"),
                Some(Colour::Indexed(number)) => write!(command, ";{ground};5;{number}"),
            };
        }
        command + "m"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_has_changed_is_told() {
        let mut canvas = Canvas::new(4, 2);
        let before = canvas.clone();
        assert_eq!(canvas.changes(Some(&before)), "");
        let red = Style::of(Some(Colour::Indexed(1)));
        canvas.text(Area { column: 1, row: 1, columns: 3, rows: 1 }, "ab\x1bcd", red);
        assert_eq!(canvas.row(1), " ab?", "no more than fits, and nothing that commands");
        assert_eq!(canvas.changes(Some(&before)), "\x1b[2;2H\x1b[0;38;5;1mab?\x1b[0m");
        assert!(canvas.changes(Some(&Canvas::new(5, 2))).starts_with("\x1b[0m\x1b[2J"), "another size");
    }

    #[test]
    fn what_does_not_fit_is_cut_off() {
        let mut canvas = Canvas::new(3, 3);
        let inside = canvas.frame(canvas.area(), "title");
        assert_eq!((canvas.row(0), canvas.row(2)), ("┌t┐".into(), "└─┘".into()));
        assert_eq!(inside, Area { column: 1, row: 1, columns: 1, rows: 1 });
        let mut tiny = Canvas::new(1, 1);
        assert_eq!(tiny.frame(tiny.area(), "title").rows, 0);
        Canvas::new(0, 0).put(5, 5, 'x', Style::default());
    }
}
