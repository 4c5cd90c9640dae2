//! Rows of figures, one a method, with a verdict.

use serde::Serialize;

use super::super::report::Table;
use crate::baselines::Kind;

/// One figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cell {
    /// What decides; smaller is better. `None` where the method has nothing of the kind.
    pub value: Option<f64>,
    /// As shown.
    pub text: String,
}

impl Cell {
    /// A figure, shown as `text`.
    pub fn new(value: f64, text: String) -> Self {
        if value.is_finite() { Self { value: Some(value), text } } else { Self::none() }
    }

    /// The method has nothing of the kind.
    pub fn none() -> Self {
        Self { value: None, text: "–".to_owned() }
    }
}

/// One figure of every method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// What and in which unit.
    pub name: String,
    /// In the order of [`Kind::ALL`].
    pub cells: Vec<Cell>,
    /// Whether ours is ahead; if not, why.
    pub verdict: String,
}

impl Row {
    /// A row. If ours is not the smallest, `why_not` is asked with those that are ahead; it has a reason only where
    /// figures at hand show it.
    pub fn new(name: &str, cells: Vec<Cell>, why_not: impl Fn(&[Kind]) -> Option<String>) -> Self {
        let verdict = verdict(&cells, why_not);
        Self { name: name.to_owned(), cells, verdict }
    }

    /// Whether ours is ahead of all others that have a figure.
    pub fn is_ahead(&self) -> bool {
        self.verdict.starts_with("ahead")
    }
}

/// Ours is the first cell.
fn verdict(cells: &[Cell], why_not: impl Fn(&[Kind]) -> Option<String>) -> String {
    let Some(ours) = cells.first().and_then(|cell| cell.value) else { return "has none".to_owned() };
    let others = || cells.iter().zip(Kind::ALL).skip(1).filter_map(|(cell, kind)| Some((kind, cell.value?)));
    let (kinds, names): (Vec<Kind>, Vec<String>) = others()
        .filter(|(_, other)| *other <= ours)
        .map(|(kind, other)| (kind, margin(kind.title(), other, ours)))
        .unzip();
    match (others().next(), kinds.is_empty()) {
        (None, _) => "alone".to_owned(),
        (_, true) => "ahead".to_owned(),
        (_, false) => {
            let why = why_not(&kinds).map_or_else(String::new, |why| format!(": {why}"));
            format!("not ahead of {}{why}", names.join(", "))
        }
    }
}

/// A method with its figure as a part of ours.
pub(crate) fn margin(title: &str, other: f64, ours: f64) -> String {
    match ours > 0.0 {
        true => format!("{title} ({:.2} of ours)", other / ours),
        false => format!("{title} (equal)"),
    }
}

/// A table of rows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sheet {
    /// Above it.
    pub caption: String,
    /// Names of the columns; the first one is that of the rows' names, the last that of the verdicts, if they have any.
    pub header: Vec<String>,
    /// The rows.
    pub rows: Vec<Row>,
    /// Below it.
    pub notes: Vec<String>,
}

impl Sheet {
    /// One column a method, and a verdict.
    pub fn of_methods(caption: &str) -> Self {
        let methods = Kind::ALL.into_iter().map(|kind| kind.title().to_owned());
        let header = std::iter::once(String::new()).chain(methods).chain(["holdfast is".to_owned()]);
        Self { caption: caption.to_owned(), header: header.collect(), rows: Vec::new(), notes: Vec::new() }
    }

    /// For a page or a terminal. What verdicts have to explain goes below the table.
    pub fn table(&self) -> Table {
        let header: Vec<&str> = self.header.iter().map(String::as_str).collect();
        let mut table = Table::new(&self.caption, &header);
        let mut why = Vec::new();
        for row in &self.rows {
            let mut cells: Vec<String> = row.cells.iter().map(|cell| cell.text.clone()).collect();
            if cells.len() + 1 < header.len() {
                cells.push(match row.verdict.split_once(": ") {
                    Some((short, reason)) => {
                        why.push(format!("{}: {short}: {reason}.", row.name));
                        short.to_owned()
                    }
                    None => row.verdict.clone(),
                });
            }
            table.row(&row.name, &cells);
        }
        why.iter().chain(&self.notes).for_each(|note| table.note(note));
        table
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(values: [Option<f64>; 5]) -> Row {
        let cell =
            |value: Option<f64>| value.map_or(Cell::none(), |value| Cell::new(value, value.to_string()));
        Row::new("error, cm", values.map(cell).into(), |ahead| {
            ahead.contains(&Kind::Tsif).then(|| "it must be so".to_owned())
        })
    }

    #[test]
    fn a_row_says_who_is_ahead_and_why() {
        assert!(row([Some(1.0), Some(2.0), Some(1.5), None, Some(9.0)]).is_ahead());
        let behind = row([Some(1.0), Some(0.5), Some(1.5), None, Some(1.0)]);
        assert!(!behind.is_ahead());
        assert_eq!(
            behind.verdict,
            "not ahead of TSIF (0.50 of ours), dead reckoning (1.00 of ours): it must be so"
        );
        let unexplained = row([Some(1.0), Some(2.0), Some(0.951), None, None]);
        assert_eq!(unexplained.verdict, "not ahead of MSF (0.95 of ours)");
        assert_eq!(row([Some(1.0), None, None, None, None]).verdict, "alone");
        let mut sheet = Sheet::of_methods("Errors");
        sheet.rows.push(behind);
        let text = sheet.table().text();
        let why =
            "error, cm: not ahead of TSIF (0.50 of ours), dead reckoning (1.00 of ours): it must be so.";
        assert!(text.contains(why), "{text}");
    }
}
