//! Poses become tracks: cut into segments at gaps and at GNSS outages, thinned if asked, placed on the earth,
//! and handed to the layout of a format, one segment at a time.

use std::io::{self, Write};

use super::geojson::GeoJson;
use super::gpx::Gpx;
use super::kml::Kml;
use super::plain::{Csv, Tum};
use crate::frames::geodesy::{Geodetic, SiteFrame};
use crate::lie::Vec3;
use crate::time::{Span, Stamp};

/// A segment of more poses is cut, so that memory is bounded and readers get lines that they can draw.
const SEGMENT_POSES_MAX: usize = 50_000;
/// No machine is so far from the origin of its frame, m: half around the earth.
const POSITION_MAX_M: f64 = 2.0e7;
/// A quaternion whose length is off by more is no rotation with rounded digits.
const LENGTH_OFF_MAX: f64 = 0.1;

/// A pose of a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackPose {
    /// When.
    pub stamp: Stamp,
    /// In the track's frame, m.
    pub position: Vec3,
    /// Rotation from the body to that frame: x, y, z, w.
    pub quaternion_xyzw: [f64; 4],
}

impl TrackPose {
    /// Whether it can be a place on the earth, and a rotation: no NaN, nothing beyond all bounds.
    pub fn is_fit(&self) -> bool {
        let length = self.quaternion_xyzw.iter().map(|part| part * part).sum::<f64>().sqrt();
        self.position.iter().all(|part| part.abs() <= POSITION_MAX_M)
            && (length - 1.0).abs() <= LENGTH_OFF_MAX
    }
}

/// A time without trustworthy fixes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outage {
    /// From here on.
    pub start: Stamp,
    /// The first moment after it; `None` if it does not end.
    pub end: Option<Stamp>,
    /// What was wrong with the fixes.
    pub cause: String,
}

/// What a file of tracks can be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `t x y z qx qy qz qw`, one trajectory, for evo and its like.
    Tum,
    /// A table of all poses.
    Csv,
    /// RFC 7946: a LineString for each segment, its times as `coordTimes`.
    GeoJson,
    /// GPX 1.1: a `trk` for each machine.
    Gpx,
    /// KML 2.2 with Google's `gx:Track`.
    Kml,
}

impl Format {
    /// All of them.
    pub const ALL: [Format; 5] = [Format::Tum, Format::Csv, Format::GeoJson, Format::Gpx, Format::Kml];

    /// The name, which is also the usual end of a file's name.
    pub const fn name(self) -> &'static str {
        match self {
            Format::Tum => "tum",
            Format::Csv => "csv",
            Format::GeoJson => "geojson",
            Format::Gpx => "gpx",
            Format::Kml => "kml",
        }
    }

    /// The format of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.name().eq_ignore_ascii_case(name))
    }

    /// What HTTP calls it.
    pub const fn media_type(self) -> &'static str {
        match self {
            Format::Tum => "text/plain; charset=utf-8",
            Format::Csv => "text/csv; charset=utf-8",
            Format::GeoJson => "application/geo+json",
            Format::Gpx => "application/gpx+xml",
            Format::Kml => "application/vnd.google-earth.kml+xml",
        }
    }

    /// Whether it is in WGS84, and needs the origin of the site.
    pub const fn needs_origin(self) -> bool {
        matches!(self, Format::GeoJson | Format::Gpx | Format::Kml)
    }

    /// Whether it holds one track only.
    pub const fn one_track(self) -> bool {
        matches!(self, Format::Tum)
    }
}

/// How tracks are to be written.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// As what.
    pub format: Format,
    /// Where the world frame of the poses is on the earth; without it there is no place in WGS84.
    pub site: Option<SiteFrame>,
    /// Poses further apart begin another segment.
    pub gap: Span,
    /// The first pose of each such period is written; `None`: all.
    pub period: Option<Span>,
}

impl Options {
    /// Rates in Hz and gaps in s that make sense.
    pub const RANGE: std::ops::RangeInclusive<f64> = 1e-3..=1e6;
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// Tracks, those without a pose included.
    pub tracks: u64,
    /// Poses.
    pub poses: u64,
    /// Poses that were left out because of [`Options::period`].
    pub thinned: u64,
    /// Gaps between poses, longer than [`Options::gap`].
    pub gaps: u64,
}

/// What is known of the fixes at some time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Gnss {
    Unknown,
    Good,
    Out(String),
}

impl Gnss {
    pub(super) const fn name(&self) -> &'static str {
        match self {
            Gnss::Unknown => "unknown",
            Gnss::Good => "good",
            Gnss::Out(_) => "outage",
        }
    }

    pub(super) fn cause(&self) -> Option<&str> {
        match self {
            Gnss::Out(cause) => Some(cause),
            Gnss::Unknown | Gnss::Good => None,
        }
    }
}

/// A pose and its place, where that is known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub(super) pose: TrackPose,
    pub(super) place: Option<Geodetic>,
}

/// Poses without a gap and with the fixes in one state.
pub(super) struct Segment<'a> {
    pub(super) track: &'a str,
    /// From 0 in its track.
    pub(super) index: u64,
    pub(super) gnss: &'a Gnss,
    /// The pose before, if there is no gap between: a line begins there.
    pub(super) before: Option<&'a Point>,
    /// At least one.
    pub(super) points: &'a [Point],
}

impl<'a> Segment<'a> {
    /// Those of the line: the one before, then its own; each has its place.
    pub(super) fn line(&self) -> impl Iterator<Item = (Stamp, Geodetic)> + Clone + 'a {
        let points = self.before.into_iter().chain(self.points);
        points.filter_map(|point| point.place.map(|place| (point.pose.stamp, place)))
    }

    /// First and last moment of the line.
    pub(super) fn span(&self) -> (Stamp, Stamp) {
        let first = self.before.unwrap_or(&self.points[0]).pose.stamp;
        let last = self.points.last().map_or(first, |point| point.pose.stamp);
        (first, last)
    }
}

/// How a format lays tracks out.
pub(super) trait Layout: Send {
    fn begin(&mut self, _out: &mut dyn Write) -> io::Result<()> {
        Ok(())
    }
    fn begin_track(&mut self, _out: &mut dyn Write, _track: &str) -> io::Result<()> {
        Ok(())
    }
    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()>;
    fn end_track(&mut self, _out: &mut dyn Write) -> io::Result<()> {
        Ok(())
    }
    fn end(&mut self, _out: &mut dyn Write) -> io::Result<()> {
        Ok(())
    }
}

/// Writes tracks, one after another, their poses in the order of their stamps.
pub struct TrackWriter<W> {
    out: W,
    layout: Box<dyn Layout>,
    options: Options,
    track: Option<Current>,
    written: Written,
}

/// The track that is being written.
struct Current {
    name: String,
    outages: Option<Vec<Outage>>,
    segments: u64,
    gnss: Gnss,
    before: Option<Point>,
    points: Vec<Point>,
    last: Option<Stamp>,
    last_period: Option<i64>,
}

impl<W: Write> TrackWriter<W> {
    /// Begins the file.
    ///
    /// # Errors
    /// What the writer says; a format that needs the origin has none.
    pub fn new(mut out: W, options: Options) -> io::Result<Self> {
        if options.format.needs_origin() && options.site.is_none() {
            return Err(refused(format!("{} needs the origin of the site", options.format.name())));
        }
        let mut layout: Box<dyn Layout> = match options.format {
            Format::Tum => Box::new(Tum),
            Format::Csv => Box::new(Csv { with_place: options.site.is_some() }),
            Format::GeoJson => Box::new(GeoJson::default()),
            Format::Gpx => Box::new(Gpx::default()),
            Format::Kml => Box::new(Kml),
        };
        layout.begin(&mut out)?;
        Ok(Self { out, layout, options, track: None, written: Written::default() })
    }

    /// Begins a track. `outages`, in their order, are those of its machine; `None` if they are not known.
    ///
    /// # Errors
    /// What the writer says; the format takes one track only, and has it.
    pub fn begin_track(&mut self, name: &str, outages: Option<Vec<Outage>>) -> io::Result<()> {
        self.end_track()?;
        if self.options.format.one_track() && self.written.tracks > 0 {
            return Err(refused(format!("a {} file takes one track", self.options.format.name())));
        }
        self.written.tracks += 1;
        self.layout.begin_track(&mut self.out, name)?;
        self.track = Some(Current {
            name: name.to_owned(),
            outages,
            segments: 0,
            gnss: Gnss::Unknown,
            before: None,
            points: Vec::new(),
            last: None,
            last_period: None,
        });
        Ok(())
    }

    /// Adds a pose to the track.
    ///
    /// # Errors
    /// What the writer says.
    ///
    /// # Panics
    /// Without a track.
    pub fn pose(&mut self, pose: &TrackPose) -> io::Result<()> {
        let track = self.track.as_mut().expect("begin_track comes before pose");
        let gap = track.last.is_some_and(|last| pose.stamp - last > self.options.gap);
        track.last = Some(pose.stamp);
        if gap {
            self.written.gaps += 1;
            flush(&mut *self.layout, &mut self.out, track)?;
            track.before = None;
        }
        if let Some(period) = self.options.period {
            let this = pose.stamp.as_nanos().div_euclid(period.as_nanos().max(1));
            if !gap && track.last_period == Some(this) {
                self.written.thinned += 1;
                return Ok(());
            }
            track.last_period = Some(this);
        }
        let gnss = track.gnss_at(pose.stamp);
        if gnss != track.gnss || track.points.len() >= SEGMENT_POSES_MAX {
            flush(&mut *self.layout, &mut self.out, track)?;
            track.gnss = gnss;
        }
        let place = self.options.site.as_ref().map(|site| site.to_geodetic(&pose.position));
        track.points.push(Point { pose: *pose, place });
        self.written.poses += 1;
        Ok(())
    }

    fn end_track(&mut self) -> io::Result<()> {
        if let Some(mut track) = self.track.take() {
            flush(&mut *self.layout, &mut self.out, &mut track)?;
            self.layout.end_track(&mut self.out)?;
        }
        Ok(())
    }

    /// Ends the file and flushes the writer.
    ///
    /// # Errors
    /// What the writer says.
    pub fn finish(mut self) -> io::Result<(W, Written)> {
        self.end_track()?;
        self.layout.end(&mut self.out)?;
        self.out.flush()?;
        Ok((self.out, self.written))
    }
}

impl Current {
    fn gnss_at(&self, stamp: Stamp) -> Gnss {
        let Some(outages) = &self.outages else { return Gnss::Unknown };
        let holds = |outage: &&Outage| outage.start <= stamp && outage.end.is_none_or(|end| stamp < end);
        outages.iter().find(holds).map_or(Gnss::Good, |outage| Gnss::Out(outage.cause.clone()))
    }
}

/// Hands the segment over, if it has poses.
fn flush(layout: &mut dyn Layout, out: &mut dyn Write, track: &mut Current) -> io::Result<()> {
    let Some(last) = track.points.last().copied() else { return Ok(()) };
    layout.segment(
        out,
        &Segment {
            track: &track.name,
            index: track.segments,
            gnss: &track.gnss,
            before: track.before.as_ref(),
            points: &track.points,
        },
    )?;
    track.segments += 1;
    track.before = Some(last);
    track.points.clear();
    Ok(())
}

fn refused(message: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, message)
}

/// RFC 3339, UTC, with as many decimals as it takes.
pub(super) fn utc(stamp: Stamp) -> jiff::Timestamp {
    let nanos = i128::from(stamp.as_nanos());
    jiff::Timestamp::from_nanosecond(nanos).expect("64 bits of nanoseconds end in the year 2262")
}

/// Text between tags or in quotes of XML; what XML cannot hold becomes `?`.
pub(super) fn xml(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\t' | '\n' | '\r' => escaped.push(' '),
            '\u{0}'..='\u{1f}' | '\u{fffe}' | '\u{ffff}' => escaped.push('?'),
            other => escaped.push(other),
        }
    }
    escaped
}
