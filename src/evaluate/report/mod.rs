//! A page that is read offline, printed and heard: tables, and plots as inline SVG with a table beside each.
//!
//! One file without scripts and without anything from elsewhere; light and dark by the reader's wish. The same
//! tables go to a terminal as text. Knows nothing of estimators: who has figures fills in tables and plots.

mod plot;
mod table;

use std::fmt::Write as _;

pub use plot::{Axis, Band, Plot, Scale, Series, Style};
pub use table::Table;

const STYLE: &str = include_str!("style.css");

/// A page, block by block.
#[derive(Clone, Debug, Default)]
pub struct Page {
    title: String,
    blocks: Vec<Block>,
}

#[derive(Clone, Debug)]
enum Block {
    Heading(String),
    Text(String),
    Table(Table),
    Plot(Plot),
}

impl Page {
    /// An empty page.
    pub fn new(title: &str) -> Self {
        Self { title: title.to_owned(), blocks: Vec::new() }
    }

    /// A heading; what follows belongs to it.
    pub fn heading(&mut self, text: &str) -> &mut Self {
        self.blocks.push(Block::Heading(text.to_owned()));
        self
    }

    /// A paragraph of plain text.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.blocks.push(Block::Text(text.to_owned()));
        self
    }

    /// A table.
    pub fn table(&mut self, table: Table) -> &mut Self {
        self.blocks.push(Block::Table(table));
        self
    }

    /// A plot, with its values as a table that can be unfolded.
    pub fn plot(&mut self, plot: Plot) -> &mut Self {
        self.blocks.push(Block::Plot(plot));
        self
    }

    /// The tables, for a terminal.
    pub fn tables(&self) -> impl Iterator<Item = &Table> {
        self.blocks.iter().filter_map(|block| match block {
            Block::Table(table) => Some(table),
            _ => None,
        })
    }

    /// The whole page.
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let mut html = format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
             content=\"width=device-width, initial-scale=1\">\n<meta name=\"color-scheme\" content=\"light dark\">\n\
             <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        );
        let mut plots = 0;
        for block in &self.blocks {
            match block {
                Block::Heading(text) => html += &format!("<h2>{}</h2>\n", escape(text)),
                Block::Text(text) => html += &format!("<p>{}</p>\n", escape(text)),
                Block::Table(table) => html += &table.html(),
                Block::Plot(plot) => {
                    plots += 1;
                    html += &plot.html(plots);
                }
            }
        }
        html += "</main>\n</body>\n</html>\n";
        html
    }
}

/// Text as HTML and SVG take it.
fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped += "&amp;",
            '<' => escaped += "&lt;",
            '>' => escaped += "&gt;",
            '"' => escaped += "&quot;",
            other => escaped.push(other),
        }
    }
    escaped
}

/// A number with three or four digits that count, and no more.
pub fn figure(value: f64) -> String {
    let size = value.abs();
    let mut text = String::new();
    let written = if !value.is_finite() {
        write!(text, "–")
    } else if size >= 1000.0 || size == 0.0 {
        write!(text, "{value:.0}")
    } else if size >= 100.0 {
        write!(text, "{value:.1}")
    } else if size >= 0.1 {
        write!(text, "{value:.2}")
    } else if size >= 0.01 {
        write!(text, "{value:.3}")
    } else if size >= 0.0001 {
        write!(text, "{value:.4}")
    } else {
        write!(text, "{value:.1e}")
    };
    written.expect("a string takes everything");
    text
}

/// Mean and standard deviation, with the digits that count beside the latter.
pub fn spread(mean: f64, sd: f64) -> String {
    if !mean.is_finite() || !sd.is_finite() {
        return "–".to_owned();
    }
    let decimals = match sd {
        100.0.. => 0,
        10.0.. => 1,
        0.1.. => 2,
        0.01.. => 3,
        _ => 4,
    };
    // No minus before a zero.
    let mean = format!("{mean:.decimals$}");
    let mean =
        if mean.trim_matches(['-', '0', '.']).is_empty() { mean.trim_start_matches('-') } else { &mean };
    format!("{mean} ± {sd:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page() -> Page {
        let mut page = Page::new("A <report> & more");
        let mut table = Table::new("Errors", &["", "ours", "theirs"]);
        table.row("RMSE, cm", &["0.30".to_owned(), "0.40".to_owned()]);
        table.note("Simulated.");
        let wave =
            |shift: f64| (0..500).map(|index| f64::from(index) * 0.1).map(move |x| (x, (x + shift).sin()));
        page.heading("First").text("One < two.").table(table).plot(Plot {
            title: "Waves".to_owned(),
            description: "Two sines, one after the other.".to_owned(),
            x: Axis::new("time, s"),
            y: Axis::new("error, cm"),
            series: vec![
                Series::new("a", Style::Ours, wave(0.0).collect()),
                Series::new("b & c", Style::Second, wave(1.0).collect()),
            ],
            bands: vec![Band { from: 10.0, to: 20.0, label: "no GNSS".to_owned() }],
        });
        page
    }

    #[test]
    fn page_is_whole_offline_and_named_for_those_who_hear_it() {
        let html = page().html();
        assert!(html.starts_with("<!doctype html>") && html.ends_with("</html>\n"));
        for part in [
            "<title>A &lt;report&gt; &amp; more</title>",
            "<html lang=\"en\">",
            "role=\"img\"",
            "aria-labelledby=\"plot-1-title plot-1-description\"",
            "<title id=\"plot-1-title\">Waves</title>",
            "<desc id=\"plot-1-description\">",
            "<caption>Errors</caption>",
            "<th scope=\"col\">ours</th>",
            "<th scope=\"row\">RMSE, cm</th>",
            "prefers-color-scheme: dark",
            "@media print",
            "b &amp; c",
            "<summary>Values of this plot</summary>",
        ] {
            assert!(html.contains(part), "{part}");
        }
        for part in ["http://", "https://", "<script", "url(", "NaN"] {
            assert!(!html.contains(part), "{part}");
        }
        let opened = |tag: &str| html.matches(&format!("<{tag}")).count();
        for tag in ["table", "svg", "figure", "details", "tbody"] {
            assert_eq!(opened(tag), html.matches(&format!("</{tag}>")).count(), "{tag}");
        }
    }

    #[test]
    fn table_as_text_has_its_columns_in_line() {
        let page = page();
        let text = page.tables().next().expect("one").text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "Errors");
        assert_eq!(lines[1].chars().count(), lines[2].chars().count(), "{text}");
        assert!(lines[1].ends_with("theirs") && lines[2].ends_with("0.40"), "{text}");
        assert!(lines[3].contains("Simulated."), "{text}");
    }

    #[test]
    fn figures_have_the_digits_that_count() {
        let cases = [(0.0, "0"), (12_345.6, "12346"), (123.44, "123.4"), (1.234, "1.23"), (0.0123, "0.012")];
        for (value, text) in cases {
            assert_eq!(figure(value), text);
        }
        assert_eq!(figure(f64::NAN), "–");
        assert_eq!(spread(-0.0004, 1.467), "0.00 ± 1.47");
        assert_eq!(spread(-9.68, 18.52), "-9.7 ± 18.5");
    }
}
