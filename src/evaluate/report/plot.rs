//! Lines over time as inline SVG, with the values in a table for those who cannot see it.

use std::fmt::Write as _;

use super::{Table, escape, figure};

const WIDTH: f64 = 920.0;
const HEIGHT: f64 = 340.0;
const LEFT: f64 = 74.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 46.0;
/// A line has at most so many stretches; of each, the lowest and the highest point are drawn.
const STRETCHES: usize = 450;
/// Rows of the table beside a plot.
const TABLE_ROWS: usize = 16;

/// How the values of an axis are laid out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Scale {
    /// Evenly, over all values.
    #[default]
    Linear,
    /// Evenly, between these; what lies outside is drawn at the edge.
    Between(f64, f64),
    /// By powers of ten, between these; what lies outside is drawn at the edge.
    Logarithmic(f64, f64),
}

/// An axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// What and in which unit.
    pub label: String,
    /// How it is laid out.
    pub scale: Scale,
}

impl Axis {
    /// A linear axis over all values.
    pub fn new(label: &str) -> Self {
        Self::scaled(label, Scale::Linear)
    }

    /// An axis laid out so.
    pub fn scaled(label: &str, scale: Scale) -> Self {
        Self { label: label.to_owned(), scale }
    }
}

/// Colour and dashes of a line; both differ from style to style.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// What is looked at.
    Ours,
    /// What it is held against.
    Truth,
    /// The first other.
    First,
    /// The second other.
    Second,
    /// The third other.
    Third,
    /// The fourth other.
    Fourth,
}

impl Style {
    const fn class(self) -> &'static str {
        match self {
            Style::Ours => "s-ours",
            Style::Truth => "s-truth",
            Style::First => "s-first",
            Style::Second => "s-second",
            Style::Third => "s-third",
            Style::Fourth => "s-fourth",
        }
    }
}

/// One line; points in order of x.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// In the legend.
    pub name: String,
    /// Of the line.
    pub style: Style,
    /// (x, y); what is not finite interrupts the line.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// A line.
    pub fn new(name: &str, style: Style, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.to_owned(), style, points }
    }
}

/// A stretch of x that is shaded.
#[derive(Clone, Debug, PartialEq)]
pub struct Band {
    /// x.
    pub from: f64,
    /// x.
    pub to: f64,
    /// What was there.
    pub label: String,
}

/// Lines with their axes.
#[derive(Clone, Debug, PartialEq)]
pub struct Plot {
    /// What it shows.
    pub title: String,
    /// What there is to see, for those who hear it, and below the plot.
    pub description: String,
    /// Usually time.
    pub x: Axis,
    /// Usually an error.
    pub y: Axis,
    /// The lines; drawn in this order, so the last one is on top.
    pub series: Vec<Series>,
    /// Shaded below the lines.
    pub bands: Vec<Band>,
}

/// From values to places.
#[derive(Clone, Copy)]
struct Map {
    scale: Scale,
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Map {
    fn new(axis: &Axis, values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (low, high) = match axis.scale {
            Scale::Between(low, high) | Scale::Logarithmic(low, high) => (low, high),
            Scale::Linear => {
                let start = (f64::INFINITY, f64::NEG_INFINITY);
                let ends = values
                    .filter(|value| value.is_finite())
                    .fold(start, |(low, high), value| (low.min(value), high.max(value)));
                if ends.0 > ends.1 { (0.0, 1.0) } else { ends }
            }
        };
        let pad = if axis.scale == Scale::Linear { 0.04 * (high - low).max(1e-9) } else { 0.0 };
        Self { scale: axis.scale, low: low - pad, high: high + pad, from, to }
    }

    /// x axes are not padded.
    fn tight(mut self, axis: &Axis) -> Self {
        if axis.scale == Scale::Linear {
            let pad = 0.04 / 1.08 * (self.high - self.low);
            (self.low, self.high) = (self.low + pad, self.high - pad);
        }
        self
    }

    fn place(&self, value: f64) -> f64 {
        let part = match self.scale {
            Scale::Logarithmic(..) => {
                let value = value.max(self.low);
                libm::log10(value / self.low) / libm::log10(self.high / self.low)
            }
            _ => (value - self.low) / (self.high - self.low),
        };
        self.from + part.clamp(0.0, 1.0) * (self.to - self.from)
    }

    fn ticks(&self, about: usize) -> Vec<f64> {
        if let Scale::Logarithmic(..) = self.scale {
            let (first, last) = (libm::log10(self.low).ceil() as i32, libm::log10(self.high).floor() as i32);
            return (first..=last).map(|power| libm::pow(10.0, f64::from(power))).collect();
        }
        let rough = (self.high - self.low) / about as f64;
        let power = libm::pow(10.0, libm::log10(rough).floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|size| size * power).into_iter().find(|step| *step >= rough);
        let step = step.unwrap_or(10.0 * power);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last).map(|index| index as f64 * step).collect()
    }
}

/// A tick's number without the dust of its arithmetic.
fn tick_text(value: f64) -> String {
    let text = format!("{value:.6}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

impl Plot {
    /// The figure; `number` counts the plots of a page.
    pub(super) fn html(&self, number: usize) -> String {
        let id = format!("plot-{number}");
        let (title, description) = (escape(&self.title), escape(&self.description));
        let mut html = format!(
            "<figure>\n<figcaption><strong>{title}</strong></figcaption>\n\
             <svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-labelledby=\"{id}-title {id}-description\">\n\
             <title id=\"{id}-title\">{title}</title>\n<desc id=\"{id}-description\">{description}</desc>\n"
        );
        html += &self.svg();
        html += "</svg>\n<ul class=\"legend\">\n";
        for series in &self.series {
            html += &format!(
                "<li><svg viewBox=\"0 0 32 8\" width=\"32\" height=\"8\" aria-hidden=\"true\"><path class=\"line {}\" \
                 d=\"M0 4H32\"/></svg> {}</li>\n",
                series.style.class(),
                escape(&series.name)
            );
        }
        html += &format!("</ul>\n<p class=\"note\">{description}</p>\n");
        html += "<details>\n<summary>Values of this plot</summary>\n";
        html += &self.table().html();
        html += "</details>\n</figure>\n";
        html
    }

    fn svg(&self) -> String {
        let values = |of: fn(&(f64, f64)) -> f64| {
            self.series.iter().flat_map(move |series| series.points.iter().map(of))
        };
        let x = Map::new(&self.x, values(|point| point.0), LEFT, WIDTH - RIGHT).tight(&self.x);
        let y = Map::new(&self.y, values(|point| point.1), HEIGHT - BOTTOM, TOP);
        let mut svg = String::new();
        let mut put = |text: std::fmt::Arguments<'_>| {
            svg.write_fmt(text).expect("a string takes everything");
            svg.push('\n');
        };
        for band in &self.bands {
            let (from, to) = (x.place(band.from), x.place(band.to));
            put(format_args!(
                "<rect class=\"band\" x=\"{from:.1}\" y=\"{TOP}\" width=\"{:.1}\" height=\"{:.1}\"/>\
                 <text class=\"band-label\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                to - from,
                HEIGHT - BOTTOM - TOP,
                from + 4.0,
                TOP + 13.0,
                escape(&band.label)
            ));
        }
        for tick in y.ticks(5) {
            let place = y.place(tick);
            put(format_args!(
                "<path class=\"grid\" d=\"M{LEFT} {place:.1}H{:.1}\"/><text class=\"tick end\" x=\"{:.1}\" \
                 y=\"{:.1}\">{}</text>",
                WIDTH - RIGHT,
                LEFT - 6.0,
                place + 4.0,
                tick_text(tick)
            ));
        }
        for tick in x.ticks(9) {
            let place = x.place(tick);
            put(format_args!(
                "<path class=\"grid\" d=\"M{place:.1} {TOP}V{:.1}\"/><text class=\"tick middle\" x=\"{place:.1}\" \
                 y=\"{:.1}\">{}</text>",
                HEIGHT - BOTTOM,
                HEIGHT - BOTTOM + 17.0,
                tick_text(tick)
            ));
        }
        put(format_args!(
            "<text class=\"axis middle\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            0.5 * (LEFT + WIDTH - RIGHT),
            HEIGHT - 8.0,
            escape(&self.x.label)
        ));
        let middle = 0.5 * (TOP + HEIGHT - BOTTOM);
        put(format_args!(
            "<text class=\"axis middle\" transform=\"translate(16 {middle:.1}) rotate(-90)\">{}</text>",
            escape(&self.y.label)
        ));
        for series in &self.series {
            let path = path(&series.points, &x, &y);
            put(format_args!("<path class=\"line {}\" d=\"{path}\"/>", series.style.class()));
        }
        svg
    }

    /// Each line at even steps of x: the nearest point before.
    fn table(&self) -> Table {
        let all = || self.series.iter().flat_map(|series| series.points.iter().map(|point| point.0));
        let (first, last) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
        let names = self.series.iter().map(|series| series.name.as_str());
        let header: Vec<&str> = std::iter::once(self.x.label.as_str()).chain(names).collect();
        let mut table = Table::new(&format!("{}: {}", self.title, self.y.label), &header);
        if first > last {
            return table;
        }
        for row in 0..TABLE_ROWS {
            let at = first + (last - first) * row as f64 / (TABLE_ROWS - 1) as f64;
            let value = |series: &Series| {
                let after = series.points.partition_point(|point| point.0 <= at);
                let before = after.checked_sub(1).and_then(|index| series.points.get(index));
                before.map_or("–".to_owned(), |point| figure(point.1))
            };
            let cells: Vec<String> = self.series.iter().map(value).collect();
            table.row(&figure(at), &cells);
        }
        table
    }
}

/// The line through the points; where there are many, through the lowest and the highest of each stretch.
fn path(points: &[(f64, f64)], x: &Map, y: &Map) -> String {
    let mut path = String::new();
    let mut pen_down = false;
    let mut draw = |point: &(f64, f64)| {
        if !point.0.is_finite() || !point.1.is_finite() {
            pen_down = false;
            return;
        }
        let command = if pen_down { 'L' } else { 'M' };
        pen_down = true;
        write!(path, "{command}{:.1} {:.1}", x.place(point.0), y.place(point.1))
            .expect("a string takes everything");
    };
    if points.len() <= 2 * STRETCHES {
        points.iter().for_each(&mut draw);
        return path;
    }
    for stretch in points.chunks(points.len().div_ceil(STRETCHES)) {
        let lowest = stretch.iter().min_by(|a, b| a.1.total_cmp(&b.1));
        let highest = stretch.iter().max_by(|a, b| a.1.total_cmp(&b.1));
        let (Some(lowest), Some(highest)) = (lowest, highest) else { continue };
        let (first, second) = if lowest.0 <= highest.0 { (lowest, highest) } else { (highest, lowest) };
        draw(first);
        if second.0 > first.0 {
            draw(second);
        }
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        let axis = Axis::scaled("", Scale::Between(-0.03, 0.47));
        let map = Map::new(&axis, std::iter::empty(), 0.0, 1.0);
        let texts: Vec<String> = map.ticks(5).into_iter().map(tick_text).collect();
        assert_eq!(texts, ["0", "0.1", "0.2", "0.3", "0.4"]);
        let axis = Axis::scaled("", Scale::Logarithmic(0.001, 50.0));
        let map = Map::new(&axis, std::iter::empty(), 0.0, 1.0);
        let texts: Vec<String> = map.ticks(5).into_iter().map(tick_text).collect();
        assert_eq!(texts, ["0.001", "0.01", "0.1", "1", "10"]);
        assert_eq!(map.place(1e-9), 0.0);
        assert_eq!(map.place(1e9), 1.0);
    }

    #[test]
    fn thinned_line_keeps_its_peaks() {
        let mut points: Vec<(f64, f64)> = (0..100_000).map(|index| (f64::from(index), 0.0)).collect();
        points[31_415].1 = 7.0;
        let axis = Axis::new("");
        let x = Map::new(&axis, points.iter().map(|point| point.0), 0.0, 900.0);
        let y = Map::new(&axis, points.iter().map(|point| point.1), 100.0, 0.0);
        let path = path(&points, &x, &y);
        assert!(path.contains(&format!(" {:.1}", y.place(7.0))), "the peak is drawn");
        assert!(path.len() < 40_000, "{}", path.len());
    }
}
